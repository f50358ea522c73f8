"""What a sweep keeps on disk while it goes on: results so far, and what they are of."""

import contextlib
import dataclasses
import json
import os
import shutil
import uuid
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, final

import numpy as np

from pgjax._files import read_text
from pgjax.storage import digest, flush, save_arrays
from pgjax.sweeps.layout import Layout
from pgjax.sweeps.program import Task
from pgjax.sweeps.results import Results

_VERSION = 1
_LONGEST_RECORD = 1 << 20


@final
@dataclasses.dataclass(frozen=True)
class Store:
    """A folder of results, a file for some calls of the program each.

    Attributes:
        folder: of the sweep.
        lanes: members in a group.
    """

    folder: Path
    lanes: int

    @property
    def parts(self) -> Path:
        """Where the files are."""
        return self.folder / "parts"

    def add(self, results: Sequence[Results]) -> None:
        """Keep the results of some calls, in one file."""
        whole = {name: np.concatenate([r[name] for r in results]) for name in results[0]}
        # No member is run twice: the first one names the file.
        save_arrays(self.parts / f"{whole['member'][0]:07d}.npz", whole)

    def results(self) -> list[Results]:
        """All that was kept so far."""
        found = []
        for path in sorted(self.parts.glob("[0-9]*.npz")):
            with np.load(path, allow_pickle=False) as file:
                found.append(dict(file))
        return found

    def clear(self) -> None:
        """Remove what is needed to go on."""
        shutil.rmtree(self.parts)


def open_store(
    folder: Path, marks: Mapping[str, str], lanes: int, *, resume: bool, shared: bool
) -> Store:
    """The store of a new sweep in an empty folder, or of the one that goes on in it.

    Args:
        folder: of the sweep.
        marks: what it is of (`fingerprint`).
        lanes: members in a group, if it is new.
        resume: whether it goes on.
        shared: whether other processes work on the same one, and may have begun it.

    Raises:
        ValueError: the folder holds something else.
    """
    path = folder / "parts" / "sweep.json"
    if resume and not shared and not path.is_file():
        finished = (folder / "sweep.csv").is_file()
        raise ValueError(
            f"Argument `resume` must go with the folder of an unfinished sweep, but "
            f"{f'the one in {folder} is finished' if finished else f'{folder} holds none'}."
        )
    if not path.is_file():
        require_empty(folder, shared=shared)
        path.parent.mkdir(parents=True, exist_ok=shared)
        _create(path, {"version": _VERSION, "lanes": lanes, "of": dict(marks)})
    elif not resume and not shared:
        raise ValueError(
            f"Argument `folder` must be a new or an empty folder, so that nothing is overwritten, "
            f"but {folder} holds an unfinished sweep, which goes on with `resume`."
        )
    return Store(folder, _checked(path, marks))


def _create(path: Path, record: Mapping[str, Any]) -> None:
    """Write the record, unless another process has just done so."""
    temporary = path.with_name(f".{uuid.uuid4().hex}.json")
    temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    flush(temporary)
    with contextlib.suppress(FileExistsError):
        os.link(temporary, path)
    temporary.unlink()


def require_empty(folder: Path, *, shared: bool) -> None:
    """Raise a `ValueError` if the folder holds anything that is not of a shared sweep."""
    kept = {"parts", "sweep.csv"} if shared else set()
    if folder.is_file() or (folder.is_dir() and any(p.name not in kept for p in folder.iterdir())):
        raise ValueError(
            f"Argument `folder` must be a new or an empty folder, so that nothing is overwritten, "
            f"but {folder} is not."
        )


def _checked(path: Path, marks: Mapping[str, str]) -> int:
    """The number of lanes of the record, if it is of the same sweep."""
    try:
        record = json.loads(read_text(path, _LONGEST_RECORD))
        version, lanes, then = record["version"], record["lanes"], dict(record["of"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(
            f"The file {path} must be the record of a sweep, but is broken: {error!r}."
        ) from error
    if version != _VERSION or type(lanes) is not int or lanes < 1:
        raise ValueError(f"The file {path} must be of version {_VERSION}, but is of {version}.")
    changed = [
        f"`{name}` ({then.get(name, 'absent')} then, {marks.get(name, 'absent')} now)"
        for name in sorted(then.keys() | marks.keys())
        if then.get(name) != marks.get(name)
    ]
    if changed:
        raise ValueError(
            f"Argument `folder` must be that of the same sweep, but in {path.parent.parent} these "
            f"differ: {', '.join(changed)}."
        )
    return lanes


def fingerprint(layout: Layout, task: Task) -> dict[str, str]:
    """All that decides the results, by name, as far as it can be seen.

    Of `build` it is the scene and state that it makes of the first member that can be simulated.
    """
    scene, state = task.build(layout.members.some(layout.first))
    parts = {
        "vary": layout.members.values,
        "steps": layout.need.substeps,
        "scene": scene,
        "state": state,
        "measure": task.measure,
        "save": task.save,
    }
    plain = {"frames": str(task.frames), "frame_dt": str(task.frame_dt)}
    versions = {name: metadata.version(name) for name in ("pgjax", "jax", "jaxlib")}
    kind = {"precision": state.dtype.name, "platform": layout.devices[0].platform}
    return {name: digest(value)[:12] for name, value in parts.items()} | plain | versions | kind
