"""`pgjax run`: a scene goes in, a video of it moving comes out."""

import argparse
import contextlib
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgjax.cli.folders import folders, next_folder

if TYPE_CHECKING:
    from pgjax.scenes import Plan, SceneFile


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    run = commands.add_parser("run", help="simulate a scene and write a video of it")
    run.add_argument("scene", nargs="?", help="name of a preset, or a scene file (.toml)")
    run.add_argument(
        "--physgaussian",
        type=Path,
        metavar="CONFIG",
        help="a configuration file of PhysGaussian (.json) in place of the scene",
    )
    run.add_argument("--model", type=Path, help="with it: folder of the trained model, or its .ply")
    run.add_argument(
        "--legacy",
        action="store_true",
        help="with it: keep what published results owe to defects (see `pgjax convert`)",
    )
    run.add_argument("--ply", type=Path, help="a captured scene in place of the scene's own model")
    run.add_argument(
        "--quality", help="one of the scene's own qualities, e.g. paper, in place of its default"
    )
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


def _run(options: argparse.Namespace) -> int:
    # Imported here: `pgjax --help` and errors in the arguments should not wait for JAX.
    from pgjax.scenes import plan, summary
    from pgjax.scenes.record import require_empty

    if options.frames is not None and options.frames < 1:
        raise ValueError(f"Argument `--frames` must be at least 1, but is {options.frames}.")
    if options.out is not None and not options.resume:
        require_empty(options.out)
    file = _scene(options)
    name = file.name if options.quality is None else f"{file.name}-{options.quality}"
    folder, frames = options.out, options.frames
    if options.resume:
        folder, frames = _unfinished(options, name)
    elif folder is None:
        folder = next_folder(name)
    planned = plan(file, ply=options.ply, frames=frames)
    print(summary(planned))
    if options.dry_run:
        _foretell(options, planned, folder)
        return 0
    return _simulate(options, planned, folder)


def _scene(options: argparse.Namespace) -> "SceneFile":
    """The scene, from its own file or from a configuration of PhysGaussian."""
    from pgjax.scenes import read_scene, resolve

    config = options.physgaussian
    if config is None:
        if options.scene is None:
            raise ValueError("Argument `scene` must be given, or `--physgaussian`, but is missing.")
        if options.model is not None or options.legacy:
            name = "--legacy" if options.model is None else "--model"
            raise ValueError(
                f"Argument `{name}` must be left out without `--physgaussian`, but is given."
            )
        return read_scene(resolve(options.scene), options.quality)
    for name in ("scene", "ply", "quality"):
        if getattr(options, name) is not None:
            raise ValueError(
                f"Argument `{name}` must be left out with `--physgaussian`, but is "
                f"{getattr(options, name)}."
            )
    if options.model is None:
        raise ValueError("Argument `--model` must be given with `--physgaussian`, but is missing.")
    from pgjax.scenes.physgaussian import convert

    converted = convert(config, options.model, legacy=options.legacy)
    print("\n".join(f"{'note':10} {note}" for note in converted.notes))
    return converted.scene()


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
    quality = [] if options.quality is None else ["--quality", options.quality]
    scene = [options.scene]
    if options.physgaussian is not None:
        scene = ["--physgaussian", str(options.physgaussian), "--model", str(options.model)]
        scene += ["--legacy"] if options.legacy else []
    return shlex.join(["pgjax", "run", *scene, *ply, *quality, "--out", str(folder), "--resume"])


def _unfinished(options: argparse.Namespace, name: str) -> tuple[Path, int]:
    """The folder to go on in, and the number of frames: as they were unless given."""
    from pgjax.scenes.record import require_unfinished, unfinished

    folder = options.out
    if folder is None:
        known = [folder for folder in folders(name) if unfinished(folder) is not None]
        if len(known) > 1:
            raise ValueError(
                f"Argument `--out` must say which run to resume: {', '.join(map(str, known))} "
                f"are unfinished."
            )
        folder = known[0] if known else Path("out") / name
    record = require_unfinished(folder)
    return folder, record.frames if options.frames is None else options.frames
