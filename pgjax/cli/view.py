"""`pgjax view`: a scene in the browser while it is simulated."""

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pgjax.view import Live, Show


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    view = commands.add_parser(
        "view", help='look at a scene in the browser while it is simulated (extra "view")'
    )
    view.add_argument(
        "target",
        help="name of a preset, a scene file (.toml), the folder of a run with ply/, or a capture",
    )
    view.add_argument("--ply", type=Path, help="a captured scene in place of the scene's own model")
    view.add_argument("--frames", type=int, help="number of frames, in place of the scene's own")
    view.add_argument(
        "--up",
        choices=["x", "-x", "y", "-y", "z", "-z"],
        help="direction that points up in a capture or a run's ply/ (default: --up=-y)",
    )
    view.add_argument(
        "--port", type=int, help="port of the page (default: the first free from 8080)"
    )
    view.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to listen on; 0.0.0.0 lets other machines look (default: 127.0.0.1)",
    )
    view.add_argument("--no-open", action="store_true", help="open no browser")
    view.set_defaults(command=_view)


def _view(options: argparse.Namespace) -> int:
    """Serve a page until Ctrl-C."""
    from pgjax.view import App, free_port, require_viser

    require_viser()
    # Before the models are loaded.
    free_port(options.host, options.port)
    show, live = _shown(options)
    app = App(show, live=live, host=options.host, port=options.port)
    print(f"viewer     {app.url} (Ctrl-C ends it)", flush=True)
    if not options.no_open:
        _open(app.url)
    try:
        app.run()
    except KeyboardInterrupt:
        return 0
    return 0


def _shown(options: argparse.Namespace) -> "tuple[Show, Live | None]":
    """What to look at, and whether it can be simulated with other values."""
    from pgjax.scenes import resolve
    from pgjax.view import Live, show_capture, show_run

    if options.frames is not None and options.frames < 1:
        raise ValueError(f"Argument `--frames` must be at least 1, but is {options.frames}.")
    path = resolve(options.target)
    is_scene = path.suffix == ".toml" and not path.is_dir()
    unfit = ["up"] if is_scene else ["ply", "frames"]
    for name in unfit:
        if getattr(options, name) is not None:
            raise ValueError(
                f"Argument `--{name}` must be left out {'where' if is_scene else 'unless'} the "
                f"target is a scene, but is {getattr(options, name)}."
            )
    if is_scene:
        live = Live(path, ply=options.ply, frames=options.frames)
        show = live.show()
        print("\n".join(f"{name:10} {text}" for name, text in show.facts))
        return show, live
    up = options.up or "-y"
    return (show_run(path, up) if path.is_dir() else show_capture(path, up)), None


def _open(url: str) -> None:
    """Open a page in a browser, where there is a screen for one."""
    import webbrowser

    has_screen = sys.platform in ("darwin", "win32") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
    if has_screen:
        webbrowser.open(url)
