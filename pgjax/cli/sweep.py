"""`pgjax sweep`: many members of a scene, a table and a picture of what came of them."""

import argparse
import contextlib
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgjax.cli.folders import next_folder

if TYPE_CHECKING:
    from pgjax.sweeps.layout import Layout
    from pgjax.sweeps.study import Study


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    sweep = commands.add_parser(
        "sweep", help="simulate a scene with many values of its parameters, and tabulate"
    )
    sweep.add_argument("scene", help="name of a preset, or a scene file (.toml)")
    sweep.add_argument(
        "--vary",
        action="append",
        required=True,
        metavar="KEY=VALUES",
        help="values of a parameter, e.g. E=1e4:1e6:8:log or nu=.1,.3,.45; repeat it for all "
        "combinations",
    )
    sweep.add_argument(
        "--ply", type=Path, help="a captured scene in place of the scene's own model"
    )
    sweep.add_argument(
        "--quality", help="one of the scene's own qualities, e.g. paper, in place of its default"
    )
    sweep.add_argument("--frames", type=int, help="number of frames, in place of the scene's own")
    sweep.add_argument("--out", type=Path, help="output folder, new or empty (default: out/NAME)")
    sweep.add_argument(
        "--save-trajectory",
        action="store_true",
        help="also write t, x, v and F of all frames of each member as .npz",
    )
    sweep.add_argument(
        "--at-once", type=int, metavar="N", help="members in a group, all with one time step"
    )
    sweep.add_argument(
        "--memory", type=float, metavar="GB", help="what the members of one device may take at once"
    )
    sweep.add_argument(
        "--share",
        metavar="I/N",
        help="run the I-th of N shares (from 1); other processes run the rest in the same folder",
    )
    sweep.add_argument(
        "--resume", action="store_true", help="go on with an unfinished sweep in the output folder"
    )
    sweep.add_argument(
        "--dry-run", action="store_true", help="say what would be run, and write nothing"
    )
    sweep.set_defaults(command=_sweep)


def _sweep(options: argparse.Namespace) -> int:
    share = _share(options.share)
    folder: Path | None = options.out
    if folder is None and (options.resume or share):
        name = "--resume" if options.resume else "--share"
        raise ValueError(f"Argument `--out` must be given with `{name}`, but is missing.")
    # Imported here: `pgjax --help` and errors in the arguments should not wait for JAX.
    from pgjax.scenes.record import require_empty

    if folder is not None and not (options.resume or share or (folder / "parts").is_dir()):
        require_empty(folder)
    _use_all_cores()
    study = _study(options)
    folder = folder or next_folder(f"{study.plan.name}-sweep")
    memory = None if options.memory is None else options.memory * 1e9
    layout = study.layout(at_once=options.at_once, memory=memory)
    print(study.forecast(layout, folder))
    if options.dry_run:
        return 0
    return _run(options, study, layout, folder, share)


def _share(text: str | None) -> tuple[int, int] | None:
    """`I/N`, counted from 1."""
    if text is None:
        return None
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count)):
        raise ValueError(f"Argument `--share` must be I/N with 1 ≤ I ≤ N, but is {text!r}.")
    return int(index) - 1, int(count)


def _use_all_cores() -> None:
    """A member on each core at a time: faster than all cores on each member."""
    import jax

    from pgjax._files import cores

    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    # Too late where JAX runs already: then it has the devices that it has.
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", cores())


def _study(options: argparse.Namespace) -> "Study":
    from pgjax.scenes import plan, read_scene, resolve
    from pgjax.sweeps.study import study

    if options.frames is not None and options.frames < 1:
        raise ValueError(f"Argument `--frames` must be at least 1, but is {options.frames}.")
    file = read_scene(resolve(options.scene), options.quality)
    made = plan(file, ply=options.ply, frames=options.frames)
    return study(made, file.time, options.vary, trajectories=options.save_trajectory)


def _run(
    options: argparse.Namespace,
    study: "Study",
    layout: "Layout",
    folder: Path,
    share: tuple[int, int] | None,
) -> int:
    """Run, with a bar; what can be gone on with says how."""
    from tqdm import tqdm

    try:
        with tqdm(total=layout.able, unit="member") as bar:

            def show(done: int, _: int) -> None:
                bar.update(done - bar.n)

            table = study.run(
                layout,
                folder,
                show,
                resume=options.resume,
                share=share,
            )
    except (KeyboardInterrupt, OSError, RuntimeError) as error:
        if not (folder / "parts").is_dir():
            raise
        was_stopped = isinstance(error, KeyboardInterrupt)
        reason = "interrupted" if was_stopped else str(error).rstrip(".")
        print(f"pgjax: {reason}; go on with: {_go_on(options, folder)}", file=sys.stderr)
        return 130 if was_stopped else 1
    print(table.summary())
    for message, count in table.reasons():
        print(f"{count} of them: {message}")
    if not table.pending:
        print(f"wrote      {folder / 'sweep.csv'}, {folder / 'sweep.png'}")
    return 0


def _go_on(options: argparse.Namespace, folder: Path) -> str:
    """The command that goes on with the sweep."""
    words = ["pgjax", "sweep", options.scene]
    words += [word for text in options.vary for word in ("--vary", text)]
    for name in ("ply", "quality", "frames", "at_once", "memory"):
        value = getattr(options, name)
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    words += ["--save-trajectory"] if options.save_trajectory else []
    return shlex.join([*words, "--out", str(folder), "--resume"])
