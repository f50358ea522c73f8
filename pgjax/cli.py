"""The command line: `pgjax run`, `pgjax fit`, `pgjax view` and `pgjax info`."""

import argparse
import contextlib
import os
import platform
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pgjax.scenes import Plan
    from pgjax.view import Live, Show

# jaxlib builds that compile float scatter-add on a GPU to a compare-and-swap loop.
_SLOW_SCATTER = ("0.10.2", "0.11.0")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    _use_compilation_cache()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = _print_warning
            return options.command(options)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"pgjax: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pgjax: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pgjax", description="Make captured scenes move: material simulation of Gaussians."
    )
    parser.add_argument("--version", action="version", version=f"pgjax {metadata.version('pgjax')}")
    commands = parser.add_subparsers(required=True, metavar="command")

    _add_run(commands)
    _add_view(commands)
    _add_fit(commands)
    info = commands.add_parser("info", help="print versions, devices and what will be used")
    info.set_defaults(command=_info)
    return parser


def _add_run(commands: Any) -> None:
    run = commands.add_parser("run", help="simulate a scene and write a video of it")
    run.add_argument("scene", help="name of a preset, or a scene file (.toml)")
    run.add_argument("--ply", type=Path, help="a captured scene in place of the scene's own model")
    run.add_argument("--frames", type=int, help="number of frames, in place of the scene's own")
    run.add_argument("--out", type=Path, help="output folder, new or empty (default: out/NAME)")
    run.add_argument(
        "--save-ply", action="store_true", help="also write each frame as a .ply for splat viewers"
    )
    run.add_argument(
        "--save-trajectory",
        action="store_true",
        help="also write t, x, v and F of the particles of each frame as .npz",
    )
    run.add_argument(
        "--resume", action="store_true", help="go on with an unfinished run in the output folder"
    )
    run.add_argument(
        "--dry-run",
        action="store_true",
        help="say what would be compiled, needed and written, and write nothing",
    )
    run.set_defaults(command=_run)


def _add_view(commands: Any) -> None:
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


def _add_fit(commands: Any) -> None:
    fit = commands.add_parser("fit", help="find parameters of a scene from what was recorded of it")
    fit.add_argument("case", type=Path, help="a case file (.toml)")
    fit.add_argument(
        "--data",
        type=Path,
        help="a video, a folder of numbered pictures or an .npz, in place of the case's own",
    )
    fit.add_argument("--out", type=Path, help="output folder, new or empty (default: out/NAME)")
    fit.add_argument(
        "--dry-run", action="store_true", help="check everything, say what it costs, write nothing"
    )
    fit.set_defaults(command=_fit)


def _run(options: argparse.Namespace) -> int:
    # Imported here: `pgjax --help` and errors in the arguments should not wait for JAX.
    from pgjax.scenes import plan, read_scene, resolve, summary
    from pgjax.scenes.record import require_empty

    if options.frames is not None and options.frames < 1:
        raise ValueError(f"Argument `--frames` must be at least 1, but is {options.frames}.")
    if options.out is not None and not options.resume:
        require_empty(options.out)
    file = read_scene(resolve(options.scene))
    folder, frames = options.out, options.frames
    if options.resume:
        folder, frames = _unfinished(options, file.name)
    elif folder is None:
        folder = _next_folder(file.name)
    planned = plan(file, ply=options.ply, frames=frames)
    print(summary(planned))
    if options.dry_run:
        _foretell(options, planned, folder)
        return 0
    return _simulate(options, planned, folder)


def _simulate(options: argparse.Namespace, planned: "Plan", folder: Path) -> int:
    """Run, with a bar; what can be gone on with says how."""
    from tqdm import tqdm

    from pgjax.result import SimulationError
    from pgjax.scenes import run
    from pgjax.scenes.record import unfinished

    try:
        with _gentle_interrupts() as stop, tqdm(total=planned.frames, unit="frame") as bar:

            def show(frame: int, _: int) -> None:
                stop()
                if options.resume and not bar.n:
                    # What was there already was not simulated in the time the bar shows.
                    bar.initial = bar.n = max(frame - 1, 0)
                bar.update(frame - bar.n)

            video = run(
                planned,
                folder,
                ply_frames=options.save_ply,
                trajectory_frames=options.save_trajectory,
                resume=options.resume,
                progress=show,
            )
    except SimulationError:
        # The same would happen again.
        raise
    except (KeyboardInterrupt, OSError, RuntimeError) as error:
        if unfinished(folder) is None:
            raise
        was_stopped = isinstance(error, KeyboardInterrupt)
        reason = "interrupted" if was_stopped else str(error).rstrip(".")
        print(f"pgjax: {reason}; go on with: {_go_on(options, folder)}", file=sys.stderr)
        return 130 if was_stopped else 1
    print(f"wrote      {video}")
    return 0


@contextlib.contextmanager
def _gentle_interrupts() -> Iterator[Callable[[], None]]:
    """A function that raises `KeyboardInterrupt` if Ctrl-C was pressed; again, it acts at once.

    Raised anywhere, it may be lost: exceptions in the callbacks of garbage collection are ignored.
    """
    came: list[int] = []

    def stop() -> None:
        if came:
            raise KeyboardInterrupt

    def note(number: int, frame: Any) -> None:
        if came:
            signal.default_int_handler(number, frame)
        came.append(number)
        print("\nstopping after this frame; Ctrl-C again stops at once", file=sys.stderr)

    in_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT)
    # Who started it in the background may have had it ignored.
    if not in_main or before is signal.SIG_IGN:
        yield stop
        return
    signal.signal(signal.SIGINT, note)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


def _foretell(options: argparse.Namespace, planned: "Plan", folder: Path) -> None:
    """What a run would do, after all that could stop it at once has been checked."""
    from pgjax.scenes.record import require_same, require_unfinished
    from pgjax.scenes.summary import forecast

    ply, trajectory = options.save_ply, options.save_trajectory
    if options.resume:
        record = require_unfinished(folder)
        require_same(planned, folder, record)
        ply, trajectory = record.ply_frames, record.trajectory_frames
        print(f"resumes    after frame {max(record.frame, 0)} of {planned.frames}")
    print(forecast(planned, folder, ply_frames=ply, trajectory_frames=trajectory))


def _go_on(options: argparse.Namespace, folder: Path) -> str:
    """The command that goes on with the run; the run itself remembers the rest."""
    ply = [] if options.ply is None else ["--ply", str(options.ply)]
    return shlex.join(["pgjax", "run", options.scene, *ply, "--out", str(folder), "--resume"])


def _unfinished(options: argparse.Namespace, name: str) -> tuple[Path, int]:
    """The folder to go on in, and the number of frames: as they were unless given."""
    from pgjax.scenes.record import require_unfinished, unfinished

    folder = options.out
    if folder is None:
        folders = [folder for folder in _folders(name) if unfinished(folder) is not None]
        if len(folders) > 1:
            raise ValueError(
                f"Argument `--out` must say which run to resume: {', '.join(map(str, folders))} "
                f"are unfinished."
            )
        folder = folders[0] if folders else Path("out") / name
    record = require_unfinished(folder)
    return folder, record.frames if options.frames is None else options.frames


def _next_folder(name: str) -> Path:
    """`out/NAME`, or `out/NAME-2`, `out/NAME-3` and so on where that is taken."""
    folder = Path("out") / name
    for number, taken in enumerate(_folders(name), start=2):
        folder = taken.with_name(f"{name}-{number}")
    return folder


def _folders(name: str) -> Iterator[Path]:
    """`out/NAME`, `out/NAME-2` and so on, as far as they hold anything."""
    folder, number = Path("out") / name, 1
    while folder.exists() and any(folder.iterdir()):
        yield folder
        number += 1
        folder = folder.with_name(f"{name}-{number}")


def _fit(options: argparse.Namespace) -> int:
    from pgjax.cases import prepare, read_case, solve
    from pgjax.scenes.record import require_empty

    if options.out is not None:
        require_empty(options.out)
    case = read_case(options.case, options.data)
    folder = options.out or _next_folder(case.name)
    prepared = prepare(case)
    problem, particles = prepared.problem, prepared.plan.scene.particle_count
    for note in prepared.notes:
        print(f"warning: {note}", file=sys.stderr)
    print(
        f"fit        {', '.join(problem.names)} to {problem.frames} frames, "
        f"{particles} particles, {problem.substeps} steps a frame"
    )
    moved = particles * problem.substeps * problem.frames * (1 + problem.space.size)
    print(f"each point {moved:.2g} particle-steps, those of tangents included")
    if options.dry_run:
        return 0
    found, report = solve(prepared, folder, report=lambda line: print(line, flush=True))
    print(found.summary())
    print(f"wrote      {report}")
    return 0


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


def _info(options: argparse.Namespace) -> int:
    del options
    import jax
    import jax.numpy as jnp

    from pgjax.scenes import presets

    print(f"pgjax      {metadata.version('pgjax')}")
    print(f"python     {platform.python_version()} on {platform.platform()}")
    for name in ("jax", "jaxlib", "equinox", "optax", "numpy", "plyfile", "imageio-ffmpeg"):
        print(f"{name:10} {metadata.version(name)}")
    devices = jax.devices()
    print(f"devices    {', '.join(f'{d.platform} ({d.device_kind})' for d in devices)}")
    print(f"threads    {os.cpu_count()}")
    double = jnp.zeros(()).dtype == jnp.float64
    print(f"precision  {'double' if double else 'single'} (JAX_ENABLE_X64)")
    print(f"native     {_native()}")
    print(f"cache      {os.environ['JAX_COMPILATION_CACHE_DIR']}")
    print(f"presets    {', '.join(presets())}")
    version = metadata.version("jaxlib")
    if version in _SLOW_SCATTER and any(d.platform == "gpu" for d in devices):
        print(
            f"warning    jaxlib {version} compiles scatter-add on GPUs to a slow loop; set "
            "XLA_FLAGS=--xla_backend_extra_options=-nvptx-allow-ftz-atomics"
        )
    return 0


def _native() -> str:
    """Which kernels a CPU will run; compiles them if they are not there yet."""
    import jax.numpy as jnp

    from pgjax import native

    if not native.enabled():
        return "no (PGJAX_NATIVE=0)"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        library = native.library("transfer", jnp.zeros(()).dtype.name)
    if library is None:
        return "no: " + "; ".join(str(w.message) for w in caught)
    return f"{library.path} ({native.compiler()})"


def _use_compilation_cache() -> None:
    """Keep compiled programs between runs, unless JAX was told where already."""
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(base / "pgjax" / "xla"))


def _print_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Warnings as one line for a person, not as a line of source."""
    del category, filename, lineno, file, line
    print(f"warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
