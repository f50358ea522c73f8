"""`pgjax tune`: the cheapest setting of a scene within a given error, written into its file."""

import argparse
import math
import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pgjax.scenes import SceneFile
    from pgjax.scenes.tune import Row, Tuning


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    tune = commands.add_parser(
        "tune", help="find the cheapest grid, particles and time step within a given error"
    )
    tune.add_argument("scene", help="name of a preset, or a scene file (.toml)")
    tune.add_argument(
        "--error",
        default="2%",
        help="largest distance from the limit of refinement, as in 2%% or 0.02 (default: 2%%)",
    )
    tune.add_argument("--frames", type=int, help="tune on the first frames only; at least 2")
    tune.add_argument(
        "--budget", type=float, help="minutes: runs that would end later are left out"
    )
    tune.add_argument(
        "--out",
        type=Path,
        help="the tuned scene file, new, beside the scene (default: a scene file of your own is "
        "changed, and kept as it was in NAME.before-tune.toml; a preset becomes NAME.toml here)",
    )
    tune.add_argument(
        "--dry-run", action="store_true", help="say what would be run, and run nothing"
    )
    tune.set_defaults(command=_tune)


def _tune(options: argparse.Namespace) -> int:
    asked = _error(options.error)
    if options.frames is not None and options.frames < 2:
        raise ValueError(f"Argument `--frames` must be at least 2, but is {options.frames}.")
    if options.budget is not None and not options.budget > 0:
        raise ValueError(f"Argument `--budget` must be above 0, but is {options.budget:g}.")
    # Imported here: errors in the arguments should not wait for JAX.
    from pgjax.scenes import read_scene, resolve
    from pgjax.scenes.trial import Trials
    from pgjax.scenes.tune import tune

    path = resolve(options.scene)
    file = read_scene(path)
    target = _target(path, options.out)
    frames = file.time.frames if options.frames is None else options.frames
    if options.dry_run:
        _foretell(file, frames, target)
        return 0
    trials = Trials(
        file,
        frames=frames,
        budget=math.inf if options.budget is None else 60 * options.budget,
        report=lambda text: print(f"runs       {text}", flush=True),
    )
    found = tune(trials, asked)
    _print(found)
    if found.chosen is None:
        return 1
    return _write(file, path, target, found.chosen)


def _error(text: str) -> float:
    """An error from its text, in per cent or as a number."""
    number = text.strip()
    try:
        error = float(number[:-1]) / 100 if number.endswith("%") else float(number)
    except ValueError:
        error = math.nan
    if not 0 < error < 1:
        raise ValueError(
            f"Argument `--error` must be above 0 and below 100 %, as in 2% or 0.02, but is {text}."
        )
    return error


def _target(path: Path, out: Path | None) -> Path:
    """Where the tuned scene goes; no file that is there is lost."""
    from pgjax.scenes import PRESETS

    preset = path.parent == PRESETS
    if out is None and not preset:
        kept = _kept(path)
        if kept.exists():
            raise ValueError(
                f"The scene must not have been tuned before, or `--out` be given: {kept} is there, "
                f"and would be overwritten."
            )
        return path
    target = Path(path.name) if out is None else out
    if target.suffix != ".toml":
        raise ValueError(f"Argument `--out` must end with .toml, but is {target.name!r}.")
    if target.exists():
        raise ValueError(
            f"Argument `--out` must name a file that is not there yet, but there is {target}."
        )
    if not target.parent.is_dir():
        raise ValueError(
            f"Argument `--out` must lie in an existing folder, but there is no {target.parent}."
        )
    if not preset and target.parent.resolve() != path.parent.resolve():
        raise ValueError(
            f"Argument `--out` must lie in the folder of the scene, to which the paths in it are "
            f"relative, but is {target}."
        )
    return target


def _kept(path: Path) -> Path:
    """What a scene file is kept as before it is changed."""
    return path.with_name(f"{path.stem}.before-tune.toml")


def _foretell(file: "SceneFile", frames: int, target: Path) -> None:
    """Which runs there would be, and what they cost."""
    from pgjax.scenes.settings import own
    from pgjax.scenes.trial import prepared
    from pgjax.scenes.tune import choices, ladder

    rungs = ladder(file)
    runs = [("always", "its own", own(file)), *(("always", *rung) for rung in rungs[:3])]
    runs += [("once", what, s) for group in choices(rungs[1][1]) for what, s in group]
    runs += [("if needed", *rung) for rung in rungs[3:5]]
    print(f"{'':10} {'particle-steps':>14}  setting")
    for when, what, setting in runs:
        made = prepared(file, setting, frames)
        work = made.scene.particle_count * made.substeps * frames
        print(f"{when:10} {work:14.3g}  {what}: {setting}")
    print(
        "           choices are tried on the coarsest grid that is not too far off, here √2; those"
    )
    print("           that pay are run together")
    print(f"writes     {target}")


def _print(found: "Tuning") -> None:
    """The table, the choice, and what could not be resolved."""
    print(f"\n{'particles':>9} {'steps':>6} {'ms/frame':>9} {'error':>8}  setting")
    for row in found.rows:
        mark = "*" if row is found.chosen else " "
        error = "failed" if math.isinf(row.error) else f"{100 * row.error:.2f} %"
        trial = row.trial
        print(
            f"{trial.particles:9d} {trial.substeps:6d} {1e3 * trial.seconds:9.1f} {error:>8} "
            f"{mark} {trial.what}: {trial.setting}{', double' if trial.double else ''}"
        )
    if found.limit is not None:
        limit = found.limit
        print(
            f"limit      of refinement, in doubt by {100 * limit.doubt:.2f} %; observed order "
            f"{limit.order:.2f}; 100 % is {limit.scale:.3g} m"
        )
    for note in found.notes:
        print(f"note       {note}")
    if found.chosen is None:
        print("chosen     nothing")
    else:
        print(f"chosen     {found.chosen.trial.setting}")


def _write(file: "SceneFile", path: Path, target: Path, chosen: "Row") -> int:
    """Write the setting into the scene file, or into a copy of it."""
    from pgjax._files import read_text, replacing
    from pgjax.scenes.edit import LONGEST, edited
    from pgjax.scenes.settings import changes

    new = changes(file, chosen.trial.setting)
    if not new:
        print("           which is its own: nothing is written")
        return 0
    text = edited(read_text(path, LONGEST), new, path.name)
    if target == path:
        shutil.copyfile(path, _kept(path))
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
        print(f"kept       {_kept(path)}")
    else:
        with target.open("x", encoding="utf-8") as copy:
            copy.write(text)
    print(f"wrote      {target}")
    print(f"next       pgjax run {shlex.quote(str(target))}")
    return 0
