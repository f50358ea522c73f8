"""`pgjax preview`: a scene as it is set up, in one picture, before it runs."""

import argparse
from pathlib import Path
from typing import Any


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    preview = commands.add_parser("preview", help="draw how a scene is set up, in seconds")
    preview.add_argument("scene", help="name of a preset, or a scene file (.toml)")
    preview.add_argument(
        "--ply", type=Path, help="a captured scene in place of the scene's own model"
    )
    preview.add_argument(
        "--quality", help="one of the scene's own qualities, e.g. paper, in place of its default"
    )
    preview.add_argument(
        "--out", type=Path, default=Path("preview.png"), help="the picture (default: preview.png)"
    )
    preview.set_defaults(command=_preview)


def _preview(options: argparse.Namespace) -> int:
    # Imported here: `pgjax --help` should not wait for JAX.
    from pgjax._files import with_suffix
    from pgjax.scenes import plan, read_scene, resolve, summary
    from pgjax.scenes.preview import preview

    out = with_suffix(options.out, (".png",))
    planned = plan(read_scene(resolve(options.scene), options.quality), ply=options.ply)
    print(summary(planned))
    print(f"wrote      {preview(planned, out)}")
    return 0
