"""`pgjax convert`: a configuration of PhysGaussian becomes a scene file."""

import argparse
from pathlib import Path
from typing import Any


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    convert = commands.add_parser(
        "convert", help="make a scene file of a configuration file of PhysGaussian"
    )
    convert.add_argument("config", type=Path, help="the configuration file (.json)")
    convert.add_argument(
        "--model", type=Path, required=True, help="folder of the trained model, or its .ply"
    )
    convert.add_argument(
        "-o", "--out", type=Path, help="scene file, a new one (default: NAME.toml)"
    )
    convert.add_argument(
        "--legacy",
        action="store_true",
        help="keep what published results owe to defects, as far as that can be expressed",
    )
    convert.set_defaults(command=_convert)


def _convert(options: argparse.Namespace) -> int:
    from pgjax.scenes.physgaussian import convert

    out = options.out or Path(f"{options.config.stem}.toml")
    _require_new(out)
    converted = convert(options.config, options.model, legacy=options.legacy)
    beside = [] if converted.labels is None else [out.with_name(converted.labels_name)]
    for path in beside:
        _require_new(path)
    # What is written is known to be readable.
    converted.scene()
    converted.write(out)
    print("\n".join(f"{'note':10} {note}" for note in converted.notes))
    print(f"wrote      {', '.join(map(str, (out, *beside)))}")
    return 0


def _require_new(path: Path) -> None:
    if path.suffix != ".toml" and path.suffix != ".npy":
        raise ValueError(f"Argument `--out` must end with .toml, but is {path}.")
    if path.exists():
        raise ValueError(f"Argument `--out` must name a new file, but {path} is there already.")
