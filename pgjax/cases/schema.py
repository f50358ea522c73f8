"""The case file of `pgjax fit`: a scene, what was recorded of it, and what is not known."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from pgjax._files import is_file
from pgjax.cases.unknowns import Unknown, counted, unknown
from pgjax.inverse import Stage
from pgjax.scenes import SceneFile, read_scene, resolve
from pgjax.scenes.camera import CameraPart, camera
from pgjax.scenes.reader import Table, content, nearest, parse
from pgjax.scenes.schema import scene_from

# All that was recorded is held in memory.
_MOST_FRAMES = 100_000


@dataclasses.dataclass(frozen=True)
class SolverPart:
    """How the case is solved; as the arguments of `pgjax.inverse.fit`."""

    starts: int
    trials: int
    tolerance: float
    stages: tuple[Stage, ...]


@dataclasses.dataclass(frozen=True)
class CaseFile:
    """A case file, read and checked.

    Attributes:
        path: of the file.
        name: of the case.
        scene: the scene file, whose numbers stand for everything that is known.
        scene_path: where it is.
        unknowns: by key.
        frame_rate: of the data, 1/s.
        first: number of the picture that shows the initial state.
        fit_frames: last frame that is fitted.
        frames: last frame that is predicted and compared.
        channel: "rgb" or "silhouette".
        coarser: pictures are compared through squares of so many pixels.
        noise: standard deviation of a pixel, or of a position in m.
        views: tables with pictures, and the camera of each; the scene's if None.
        track: table of a track; None if there is none.
        solver: settings.
    """

    path: Path
    name: str
    scene: SceneFile
    scene_path: Path
    unknowns: tuple[Unknown, ...]
    frame_rate: float
    first: int
    fit_frames: int
    frames: int
    channel: str
    coarser: int
    noise: float
    views: tuple[tuple[Table, CameraPart | None], ...]
    track: Table | None
    solver: SolverPart


def read_case(path: Path, data: Path | None = None) -> CaseFile:
    """Read a case file.

    Args:
        path: of the file.
        data: a video, a folder of pictures or an .npz in place of the data of the file.

    Raises:
        SceneError: a key is unknown, missing, of the wrong type or out of range.
    """
    return parse(path).read(lambda t: _case(t, path, data))


def _case(t: Table, path: Path, data: Path | None) -> CaseFile:
    scene_name = t.text("scene")
    beside = t.path("scene")
    scene_path = beside if is_file(beside) else resolve(scene_name)
    scene = read_scene(scene_path)
    frames = t.integer("frames", min(scene.time.frames, _MOST_FRAMES), at_most=_MOST_FRAMES)
    fit_frames = t.integer("fit_frames", frames, at_most=frames)
    unknowns = tuple(part.read(unknown) for part in t.tables("unknown", required=True))
    if not unknowns:
        raise t.error("unknown", "hold at least one [[unknown]]")
    keys = [u.key for u in unknowns]
    if len(set(keys)) < len(keys):
        raise t.error("unknown", "name each `key` once")
    views, track = _data(t, scene, data)
    channel = t.choice("channel", {"rgb": "rgb", "silhouette": "silhouette"}, "rgb")
    return CaseFile(
        path=path,
        name=t.file_name("name", path.stem),
        scene=scene,
        scene_path=scene_path,
        unknowns=unknowns,
        frame_rate=t.number("frame_rate", scene.time.fps, above=0),
        first=t.integer("first", 0, at_least=0, at_most=_MOST_FRAMES),
        fit_frames=fit_frames,
        frames=frames,
        channel=channel,
        coarser=t.integer("coarser", 1),
        noise=t.number("noise", 0.05 if track is None else 1e-3, above=0),
        views=views,
        track=track,
        solver=t.table("solver", {}).read(lambda s: _solver(s, keys, fit_frames)),
    )


def _data(
    t: Table, scene: SceneFile, data: Path | None
) -> tuple[tuple[tuple[Table, CameraPart | None], ...], Table | None]:
    """Views or a track, from the file or in their place."""
    views = [
        (view, view.optional("camera", lambda c: camera(c, scene.models[0])))
        for view in t.tables("view")
    ]
    track = t.table("track") if t.has("track") else None
    if track is None:
        t.optional("track", lambda table: table)
    if data is not None:
        path = str(data.absolute())
        if data.suffix == ".npz":
            return (), Table(f"{t.name} --data", {"file": path})
        if len(views) > 1:
            raise t.error("view", "be one where `--data` replaces it")
        kept = views[0][1] if views else None
        kind = "frames" if data.is_dir() else "video"
        return ((Table(f"{t.name} --data", {kind: path}), kept),), None
    if bool(views) == (track is not None):
        raise t.error("view", "be given as [[view]] tables, or a [track], but not both")
    return tuple(views), track


def _solver(t: Table, keys: list[str], fit_frames: int) -> SolverPart:
    return SolverPart(
        starts=t.integer("starts", 1),
        trials=t.integer("trials", 20),
        tolerance=t.number("tolerance", 1e-4, above=0),
        stages=tuple(
            part.read(lambda s: _stage(s, keys, fit_frames)) for part in t.tables("stage")
        ),
    )


def _stage(t: Table, keys: list[str], fit_frames: int) -> Stage:
    frames = t.integer("frames", None, at_most=fit_frames)
    free = t.texts("free", None)
    for key in free or ():
        if key not in keys:
            raise t.error("free", f"name unknowns ({', '.join(keys)}){nearest(key, keys)}")
    return Stage(frames, free, t.integer("coarser", 1), t.boolean("keep", False))


def fitted_content(case: CaseFile, values: dict[str, Any], dt: float) -> dict[str, Any]:
    """The scene file with values of the unknowns in it, for any folder, and the fit's time step.

    Raises:
        SceneError: a key of the case is not one of the scene file.
    """
    made = content(case.scene_path)
    for u in case.unknowns:
        _replace(made, u.key.split("."), values[u.key])
    made.setdefault("time", {})["dt"] = dt
    _relocate(made, case.scene_path.parent)
    scene_from(Table(f"{case.path.name}: the scene with its unknowns", made), case.name)
    return made


def _replace(tree: Any, names: list[str], value: Any) -> None:
    """Write a value where a key of the case says; a table of one needs no number."""
    *path, last = names
    for name in path:
        if counted(name) is not None:
            tree = tree[int(name) - 1] if isinstance(tree, list) else tree
            continue
        if isinstance(tree, list):
            (tree,) = tree
        tree = tree.setdefault(name, {})
    if isinstance(tree, list):
        (tree,) = tree
    tree[last] = np.asarray(value).tolist()


def _relocate(tree: Any, old: Path) -> None:
    """Files are named relative to the scene file."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        if isinstance(value, dict | list):
            _relocate(value, old)
        elif key in ("ply", "file") and not Path(value).expanduser().is_absolute():
            tree[key] = str((old / value).resolve())
