"""The main job: a scene goes in, a video of it moving comes out."""

import json
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
from jax.typing import ArrayLike

from pgjax.models import Material
from pgjax.render import (
    Gaussians,
    VideoWriter,
    bound_stretch,
    concatenate,
    deform,
    render,
    save_image,
    save_ply,
)
from pgjax.result import ERRORS, Condition, SimulationError, SimulationWarning
from pgjax.scenes.build import Plan
from pgjax.simulate import Trajectory, simulate
from pgjax.state import State


def run(
    plan: Plan,
    folder: Path,
    *,
    ply_frames: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Simulate, draw and write frame by frame; memory does not grow with the length.

    Writes `video.mp4`, `first.png`, `last.png`, `run.json` and, if asked, `ply/00000.ply` …, the
    moving and the still Gaussians of each frame in the model's own coordinates.

    Args:
        plan: what to run.
        folder: where to write; created, must be empty.
        ply_frames: whether to write each frame as a `.ply`.
        progress: called as `progress(frame, frames)` after each frame.

    Returns:
        The path of the video.

    Raises:
        SimulationError: a particle was masked. The frames up to then are written.
        ValueError: the folder is not empty.
    """
    require_empty(folder)
    (folder / "ply" if ply_frames else folder).mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    video = folder / "video.mp4"
    state, frame, bounded, image = plan.state, 0, 0, np.zeros((0, 0, 3))
    with VideoWriter(video, fps=plan.fps) as writer:
        for frame, state in enumerate(_states(plan)):
            gaussians, count = carried(plan, state.x, state.F)
            bounded = max(bounded, count)
            image = _draw(plan, gaussians, frame)
            writer.add(image)
            if frame == 0:
                save_image(folder / "first.png", image)
            elif progress is not None:
                progress(frame, plan.frames)
            if ply_frames:
                save_ply(
                    folder / "ply" / f"{frame:05d}.ply",
                    gaussians.transformed(plan.to_simulation.inverse()),
                )
    save_image(folder / "last.png", image)
    seconds = time.perf_counter() - started
    record = _record(plan, state, frame, seconds) | {"most_bounded_gaussians": bounded}
    (folder / "run.json").write_text(json.dumps(record, indent=1) + "\n")
    if bounded:
        warnings.warn(
            f"Up to {bounded} Gaussians in a frame were drawn with their stretch bounded to "
            f"`camera.max_stretch` = {plan.view.max_stretch:g}; the simulation is not affected.",
            stacklevel=2,
        )
    _report(state.status.messages(), state.status.messages(ERRORS), frame)
    return video


def require_empty(folder: Path) -> None:
    """Raise a `ValueError` if the folder holds anything."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(
            f"Argument `out` must be a new or an empty folder, so that nothing is overwritten, "
            f"but {folder} is not."
        )


def _states(plan: Plan) -> Iterator[State]:
    """The initial state and that after each frame, as far as nothing goes wrong.

    The next frame is already being simulated while the caller draws this one.
    """
    state = plan.state
    for _ in range(plan.frames):
        ahead = _advance(plan, state)
        yield state
        state = ahead.final
        if not bool(state.status.ok):
            break
    yield state


def _advance(plan: Plan, state: State) -> Trajectory:
    """One frame; JAX computes it while the caller goes on."""
    with warnings.catch_warnings():
        # The plan says once how far the time step is from its bound.
        warnings.simplefilter("ignore", SimulationWarning)
        return simulate(
            plan.scene,
            state,
            dt=plan.dt,
            frames=1,
            substeps=plan.substeps,
            save=_nothing,
            throw=False,
        )


def _nothing(state: State) -> None:
    """Frames are drawn from the final state of each call."""
    del state


def carried(plan: Plan, x: jax.Array, F: jax.Array) -> tuple[Gaussians, int]:
    """All Gaussians of a frame, the moving ones deformed, and how many stretches were bounded."""
    F, beyond = bound_stretch(F, plan.view.max_stretch)
    moved = deform(plan.moving, x, F)
    return concatenate([moved, plan.still]) if len(plan.still) else moved, int(beyond.sum())


def _draw(plan: Plan, gaussians: Gaussians, frame: int) -> np.ndarray:
    image = render(gaussians, plan.camera(frame), background=plan.view.background)
    return np.clip(np.asarray(image.rgb), 0, 1)


def _report(messages: list[str], errors: list[str], frame: int) -> None:
    for message in messages:
        if message not in errors:
            warnings.warn(message, SimulationWarning, stacklevel=3)
    if errors:
        raise SimulationError(f"Stopped at frame {frame}: {' '.join(errors)}")


def _record(plan: Plan, state: State, frame: int, seconds: float) -> dict:
    return {
        "scene": plan.name,
        "particles": plan.scene.particle_count,
        "still_gaussians": len(plan.still),
        "grid": plan.scene.grid.node_shape,
        "dt": plan.dt,
        "substeps": plan.substeps,
        "frames": frame,
        "fps": plan.fps,
        "seconds": round(seconds, 3),
        "status": {
            c.name: {"first": int(state.status.first[c]), "count": int(state.status.count[c])}
            for c in Condition
            if int(state.status.count[c])
        },
        "jax": jax.__version__,
    }


def summary(plan: Plan) -> str:
    """What will be compiled, in a few lines."""
    scene = plan.scene
    bound = float(scene.elastic_limit(scene.rest_sound_speed()))
    grid = scene.grid
    lines = [
        f"scene      {plan.name}: {scene.particle_count} particles"
        + (f", {len(plan.still)} Gaussians that do not move" if len(plan.still) else ""),
        *(
            f"material   {_describe(m)}, {count} particles"
            for m, count in zip(scene.materials, scene.counts, strict=True)
        ),
        f"grid       {' x '.join(map(str, grid.shape))} cells of {float(grid.h):.4g} m, "
        f"{'quadratic' if scene.spline.degree == 2 else 'cubic'} spline, "
        f"{type(scene.scheme).__name__}",
        f"time step  {plan.dt:.4g} s, {plan.dt / bound:.2f} of the stable one at rest; "
        f"{plan.substeps} steps a frame, {plan.frames} frames at {plan.fps:g} per second",
        f"computing  {state_kind(plan)} on {jax.devices()[0].platform.upper()}, "
        f"JAX {jax.__version__}",
    ]
    return "\n".join(lines)


def state_kind(plan: Plan) -> str:
    """The precision, in words."""
    return {"float32": "single precision", "float64": "double precision"}[plan.state.dtype.name]


def _describe(material: Material) -> str:
    law = type(material.elasticity).__name__
    if material.plasticity is not None:
        law += f" + {type(material.plasticity).__name__}"
    E, nu = (np.asarray(a) for a in (material.elasticity.E, material.elasticity.nu))
    return f"{law} (E {_range(E)} Pa, nu {_range(nu)}, {_range(material.density)} kg/m3)"


def _range(a: ArrayLike) -> str:
    a = np.asarray(a)
    return f"{a.min():.4g}" if a.min() == a.max() else f"{a.min():.4g} to {a.max():.4g}"
