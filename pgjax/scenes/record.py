"""How far an unfinished run has come, and whether another one can go on with it.

While a run goes on, `resume/` in its folder holds the pictures drawn so far, the last state and
`run.json`, the record of how far both are complete.
"""

import dataclasses
import json
import math
import re
import reprlib
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

from pgjax._files import is_file, read_text
from pgjax.result import NEVER
from pgjax.scenes.build import Plan
from pgjax.storage import digest, durably_replacing

_VERSION = 1
_LONGEST_RECORD = 1 << 20
# Of the numbers of a record; none is NaN.
_RANGES = {
    "frames": (1, NEVER),
    "frame": (-1, NEVER),
    "most_bounded": (0, NEVER),
    "seconds": (0, math.inf),
}
# Parts of a plan that decide no frame: how many there are, and where the particles came from.
_IRRELEVANT = ("frames", "notes", "models", "body")
# What a killed run leaves of a file that it was writing.
_HALF_WRITTEN = re.compile(r"\..+-[0-9a-f]{12}\.\w+")
_END_OF_PNG = b"IEND\xaeB`\x82"


@dataclasses.dataclass(frozen=True)
class Record:
    """How far an unfinished run has come: what `resume/run.json` says.

    Attributes:
        fingerprint: what decides the frames, by name.
        frames: to run.
        ply_frames: whether each is written as a `.ply`.
        trajectory_frames: whether the particles of each are written.
        frame: the last one whose state and files are all there; -1 before the first.
        most_bounded: the largest number of Gaussians in a frame whose stretch was bounded.
        seconds: spent so far.
    """

    fingerprint: dict[str, str]
    frames: int
    ply_frames: bool
    trajectory_frames: bool
    frame: int = -1
    most_bounded: int = 0
    seconds: float = 0.0

    def write(self, folder: Path) -> None:
        """Replace the record in the folder of the run."""
        write_json(record_path(folder), {"version": _VERSION} | dataclasses.asdict(self))

    def files(self, folder: Path, frame: int) -> list[Path]:
        """What is written of a frame besides its picture."""
        ply = [folder / "ply" / f"{frame:05d}.ply"] if self.ply_frames else []
        npz = [folder / "trajectory" / f"{frame:05d}.npz"] if self.trajectory_frames else []
        return ply + npz


def unfinished(folder: Path) -> Record | None:
    """The record of the unfinished run in a folder, or None.

    Raises:
        ValueError: the record is broken, or of another version.
    """
    path = record_path(folder)
    if not is_file(path):
        return None
    try:
        return _parsed(json.loads(read_text(path, _LONGEST_RECORD)))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"The file {path} must be the record of an unfinished run, but is broken: {error}."
        ) from error


def _parsed(content: Any) -> Record:
    """The record from its JSON; nothing in it is taken on trust."""
    if not isinstance(content, dict) or content.get("version") != _VERSION:
        raise ValueError(f"it is not of version {_VERSION}, the one this pgjax reads")
    for field in dataclasses.fields(Record):
        value = content.get(field.name)
        if type(value) is not (dict if field.name == "fingerprint" else field.type):
            raise ValueError(f"`{field.name}` is {reprlib.repr(value)}")
    for name, (least, most) in _RANGES.items():
        if not least <= content[name] <= most:
            raise ValueError(f"`{name}` is {content[name]}")
    if not all(isinstance(mark, str) for mark in content["fingerprint"].values()):
        raise ValueError("`fingerprint` is not of texts")
    return Record(**{field.name: content[field.name] for field in dataclasses.fields(Record)})


def require_empty(folder: Path) -> None:
    """Raise a `ValueError` if the folder holds anything."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    is_unfinished = record_path(folder).is_file()
    raise ValueError(
        f"Argument `out` must be a new or an empty folder, so that nothing is overwritten, "
        f"but {folder} is not."
        + (" It holds an unfinished run, which goes on with `--resume`." if is_unfinished else "")
    )


def require_unfinished(folder: Path) -> Record:
    """The record of the unfinished run in a folder; a `ValueError` says what there is instead."""
    record = unfinished(folder)
    if record is not None:
        return record
    if not folder.is_dir():
        found = f"there is no folder {folder}"
    elif (folder / "run.json").is_file():
        found = f"the one in {folder} is finished"
    else:
        found = f"{folder} holds none"
    raise ValueError(
        f"Argument `resume` must go with the folder of an unfinished run, but {found}."
    )


def record_path(folder: Path) -> Path:
    """Where the record of a run is."""
    return folder / "resume" / "run.json"


def picture_path(folder: Path, frame: int) -> Path:
    """Where the picture of a frame is while a run goes on."""
    return folder / "resume" / "frames" / f"{frame:05d}.png"


def state_path(folder: Path, frame: int) -> Path:
    """Where the state after a frame is."""
    return folder / "resume" / f"state-{frame:05d}.npz"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file that appears complete or not at all."""
    with durably_replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def begun(plan: Plan, folder: Path, extras: dict[str, bool]) -> Record:
    """The record of a new run in an empty folder."""
    require_empty(folder)
    record = Record(fingerprint(plan), plan.frames, **extras)
    for path in (picture_path(folder, 0), *record.files(folder, 0)):
        path.parent.mkdir(parents=True)
    record.write(folder)
    return record


def reopened(plan: Plan, folder: Path, extras: dict[str, bool]) -> Record:
    """The record of the run in the folder, if the plan can go on with it."""
    record = require_unfinished(folder)
    require_same(plan, folder, record)
    for name, wanted in extras.items():
        if wanted and not getattr(record, name):
            raise ValueError(
                f"Argument `{name}` must be False, since the run in {folder} did not write its "
                f"frames so from the beginning, but is True."
            )
    _require_files(folder, record)
    _sweep(folder, record)
    record = dataclasses.replace(record, frames=plan.frames)
    record.write(folder)
    return record


def require_same(plan: Plan, folder: Path, record: Record) -> None:
    """Raise a `ValueError` that names what differs from the plan that a run began with."""
    then, now = record.fingerprint, fingerprint(plan)
    changed = [
        f"`{name}` ({then.get(name, 'absent')} then, {now.get(name, 'absent')} now)"
        for name in sorted(then.keys() | now.keys())
        if then.get(name) != now.get(name)
    ]
    if changed:
        raise ValueError(
            f"Argument `resume` must go with the plan that the run in {folder} began with, but "
            f"these differ: {', '.join(changed)}. Take the scene, models and versions of then, or "
            f"start in another folder."
        )
    if plan.frames < record.frame:
        raise ValueError(
            f"Argument `frames` must be at least {record.frame}, which the run in {folder} has "
            f"reached, but is {plan.frames}."
        )


def fingerprint(plan: Plan) -> dict[str, str]:
    """All that decides the frames of a run, by name: numbers as they are, the rest as a hash.

    It is taken from the plan as it was decided, not from the files it was read from: a comment
    may change, but no model, camera or file of values.
    """
    parts: dict[str, Any] = {}
    for field in dataclasses.fields(plan):
        value = getattr(plan, field.name)
        if field.name in ("scene", "view"):
            for inner in dataclasses.fields(value):
                parts[f"{field.name}.{inner.name}"] = getattr(value, inner.name)
        elif field.name not in _IRRELEVANT and value is not None:
            parts[field.name] = value
    versions = {name: metadata.version(name) for name in ("pgjax", "jax", "jaxlib")}
    settings = {"precision": plan.state.dtype.name, "platform": jax.devices()[0].platform}
    return {name: _mark(value) for name, value in (parts | settings | versions).items()}


def _mark(value: Any) -> str:
    return str(value) if isinstance(value, str | int | float) else digest(value)[:12]


def _require_files(folder: Path, record: Record) -> None:
    """Raise unless all files of the frames so far are there."""
    for frame in range(record.frame + 1):
        picture = picture_path(folder, frame)
        for path in (picture, *record.files(folder, frame)):
            if not path.is_file() or (path == picture and not _is_whole(picture)):
                raise ValueError(
                    f"The folder {folder} must hold all files of the frames up to {record.frame} "
                    f"of the run to go on with, but {path} is missing or broken."
                )


def _is_whole(picture: Path) -> bool:
    """Whether a PNG has its end."""
    with picture.open("rb") as stream:
        stream.seek(max(picture.stat().st_size - len(_END_OF_PNG), 0))
        return stream.read() == _END_OF_PNG


def _sweep(folder: Path, record: Record) -> None:
    """Remove what was being written when the run ended, and what lies beyond its last state."""
    resume = folder / "resume"
    series = (resume / "frames", folder / "ply", folder / "trajectory")
    for place in filter(Path.is_dir, (folder, resume, *series)):
        for path in place.iterdir():
            beyond = place in series and path.stem.isdigit() and int(path.stem) > record.frame
            if beyond or _HALF_WRITTEN.fullmatch(path.name):
                path.unlink()
