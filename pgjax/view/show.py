"""What the viewer can show: a series of frames, and from where it is seen first."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pgjax.render import Camera, Gaussians, load_gaussians
from pgjax.result import ERRORS
from pgjax.scenes import Plan
from pgjax.scenes.run import carried, states
from pgjax.scenes.summary import facts
from pgjax.state import State
from pgjax.view.splats import Splats, splats

Triple = tuple[float, float, float]

UP: dict[str, Triple] = {
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
"""Directions that point up, by name."""


class Frame(NamedTuple):
    """One frame.

    Attributes:
        moving: the splats that differ from frame to frame.
        messages: what went wrong so far, a sentence each.
        is_lost: whether nothing comes after it, since a particle was masked.
    """

    moving: Splats
    messages: tuple[str, ...] = ()
    is_lost: bool = False


@dataclasses.dataclass(frozen=True)
class Show:
    """Frames to come, and all that is known before the first.

    Attributes:
        name: of what is shown.
        count: number of frames, the one at rest included.
        fps: frames per second.
        camera: from where it is seen first; also where colours are seen from.
        up: the direction that points up.
        background: colour.
        facts: lines about it, each with what it is about.
        frames: makes the frames, one after the other.
        still: splats that are the same in all frames.
        materials: names of the materials with their number of particles.
    """

    name: str
    count: int
    fps: float
    camera: Camera
    up: Triple
    background: Triple
    facts: tuple[tuple[str, str], ...]
    frames: Callable[[], Iterator[Frame]]
    still: Splats | None = None
    materials: tuple[str, ...] = ()


def show_plan(plan: Plan) -> Show:
    """A scene, simulated while it is looked at."""
    camera = plan.camera(0)
    scene = plan.scene
    return Show(
        name=plan.name,
        count=plan.frames + 1,
        fps=plan.fps,
        camera=camera,
        up=UP["z"],
        background=plan.view.background,
        facts=tuple(facts(plan)),
        frames=lambda: _simulated(plan, camera),
        still=splats(plan.still, camera.position) if len(plan.still) else None,
        materials=tuple(
            f"{type(m.elasticity).__name__}, {n} particles"
            for m, n in zip(scene.materials, scene.counts, strict=True)
        ),
    )


def _simulated(plan: Plan, camera: Camera) -> Iterator[Frame]:
    # The frame at rest is there before the step is compiled.
    yield _frame(plan, plan.state, camera)
    for number, state in states(plan, plan.state, 0):
        if number > 0:
            yield _frame(plan, state, camera)


def _frame(plan: Plan, state: State, camera: Camera) -> Frame:
    gaussians, _ = carried(plan, state.x, state.F)
    moving = splats(gaussians, camera.position)
    return Frame(moving, tuple(state.status.messages()), bool(state.status.messages(ERRORS)))


def show_run(folder: Path, up: str = "-y") -> Show:
    """The frames of a run that were written with `pgjax run --save-ply`.

    Raises:
        ValueError: there are none, or the first is unusable.
    """
    files = sorted((folder / "ply").glob("*.ply"))
    if not files:
        raise ValueError(
            f"Argument `target` must be a folder of a run with frames in `ply/`, but {folder} has "
            f"none. A run writes them with `pgjax run SCENE --save-ply`."
        )
    first = load_gaussians(files[0])
    camera = _around(first, UP[up])
    return Show(
        name=folder.resolve().name,
        count=len(files),
        fps=_fps(folder / "run.json"),
        camera=camera,
        up=UP[up],
        background=(1.0, 1.0, 1.0),
        facts=(("run", f"{folder}: {len(files)} frames of {len(first)} Gaussians"),),
        frames=lambda: (Frame(splats(load_gaussians(f), camera.position)) for f in files),
    )


def _fps(record: Path) -> float:
    """Frames per second by the record of a run; 25 where there is none."""
    try:
        fps = float(json.loads(record.read_text(encoding="utf-8"))["fps"])
    except (OSError, ValueError, KeyError, TypeError):
        return 25.0
    return fps if math.isfinite(fps) and fps > 0 else 25.0


def show_capture(path: Path, up: str = "-y") -> Show:
    """A captured scene at rest.

    Raises:
        ValueError: the file is missing or unusable.
    """
    gaussians = load_gaussians(path)
    camera = _around(gaussians, UP[up])
    return Show(
        name=path.stem,
        count=1,
        fps=25.0,
        camera=camera,
        up=UP[up],
        background=(1.0, 1.0, 1.0),
        facts=(("capture", f"{path}: {len(gaussians)} Gaussians, degree {gaussians.degree}"),),
        frames=lambda: iter([Frame(splats(gaussians, camera.position))]),
    )


def _around(gaussians: Gaussians, up: Triple) -> Camera:
    """A camera that sees nine in ten of the Gaussians, from a little above."""
    means = np.asarray(gaussians.means, np.float64)
    center = np.median(means, axis=0)
    extent = float(np.quantile(np.linalg.norm(means - center, axis=1), 0.9))
    return Camera.orbit(
        center.tolist(),
        up=up,
        azimuth=math.radians(-60),
        elevation=math.radians(12),
        radius=3 * extent if extent > 0 else 1.0,
        fov_y=math.radians(40),
        width=480,
        height=480,
    )
