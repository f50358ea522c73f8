"""`pgjax init`: a capture goes in, a scene file that runs comes out."""

import argparse
import shlex
from pathlib import Path
from typing import Any


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    init = commands.add_parser("init", help="look at a capture and write a scene file for it")
    init.add_argument("model", type=Path, help="a capture (.ply, .splat or .spz)")
    init.add_argument(
        "--out", type=Path, help="the scene file, new (default: NAME.toml in this folder)"
    )
    init.set_defaults(command=_init)


def _init(options: argparse.Namespace) -> int:
    model: Path = options.model
    out: Path = options.out or Path(f"{_stem(model)}.toml")
    _require_new(out)
    # Imported here: errors in the arguments should not wait for JAX.
    from pgjax.scenes.draft import draft
    from pgjax.scenes.draft_text import (
        ground_in_words,
        object_in_words,
        particles_in_words,
        up_in_words,
    )

    made = draft(model, out)
    found, planned = made.findings, made.plan
    # Not `replacing`: another file of this name that came meanwhile is not overwritten either.
    with out.open("x", encoding="utf-8") as file:
        file.write(made.text)
    print(f"capture    {model}: {found.total} Gaussians, {found.floaters} far outside")
    print(f"up         {up_in_words(found)}")
    print(f"ground     {ground_in_words(found)}")
    print(f"object     {object_in_words(found)}")
    print(f"particles  {particles_in_words(planned)}")
    print(
        f"grid       {' x '.join(map(str, planned.scene.grid.shape))} cells of "
        f"{made.choices.spacing:g} m, for an object of {made.choices.size:g} m (guessed)"
    )
    print(
        f"time       {planned.frames} frames of {planned.substeps} steps, about "
        f"{made.seconds:.0f} s on two cores"
    )
    print(f"wrote      {out}")
    name = shlex.quote(str(out))
    print(f"next       pgjax preview {name}, then pgjax run {name}")
    return 0


def _stem(model: Path) -> str:
    """The name of the capture without all of its suffixes."""
    return model.name.split(".")[0] or "scene"


def _require_new(out: Path) -> None:
    if out.suffix != ".toml":
        raise ValueError(f"Argument `--out` must end with .toml, but is {out.name!r}.")
    if out.exists():
        raise ValueError(
            f"Argument `--out` must name a file that is not there yet, but there is {out}."
        )
    if not out.parent.is_dir():
        raise ValueError(
            f"Argument `--out` must lie in an existing folder, but there is no {out.parent}."
        )
