"""The main job: a scene goes in, a video of it moving comes out.

Whatever ends a run before its time, another one goes on from what it left (`record`).
"""

import dataclasses
import shutil
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, final

import jax
import numpy as np

from pgjax.render import (
    Camera,
    Gaussians,
    Surroundings,
    bound_stretch,
    concatenate,
    deform,
    prepare_surroundings,
    save_image,
    save_ply,
    save_video,
)
from pgjax.render.media import load_image
from pgjax.result import ERRORS, Condition, SimulationError, SimulationWarning
from pgjax.scenes.build import Plan
from pgjax.scenes.record import (
    Record,
    begun,
    picture_path,
    record_path,
    reopened,
    state_path,
    write_json,
)
from pgjax.simulate import Trajectory, simulate
from pgjax.state import State
from pgjax.storage import durably_replacing, flush, load_state, save_arrays, save_state

# A state is kept once this many times as long has passed as keeping the last one took.
_PATIENCE = 20


def run(
    plan: Plan,
    folder: Path,
    *,
    ply_frames: bool = False,
    trajectory_frames: bool = False,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Simulate, draw and write frame by frame; memory does not grow with the length.

    Writes `video.mp4`, `first.png`, `last.png`, `run.json` and, if asked, `ply/00000.ply` …, the
    moving and the still Gaussians of each frame in the model's own coordinates, and
    `trajectory/00000.npz` …, each with the time `t` (s) and `x` (m), `v` (m/s) and `F` of the
    particles in those of the simulation.

    A run that was interrupted, was killed or ran out of disk leaves `resume/` in the folder. With
    `resume` it goes on, and the result is, on the CPU, the same to the last bit as if it had
    never stopped. Ctrl-C and a masked particle leave the video of the frames so far as well.

    Args:
        plan: what to run.
        folder: where to write; created, must be empty unless a run is resumed.
        ply_frames: whether to write each frame as a `.ply`. A resumed run goes on as it began.
        trajectory_frames: whether to write the particles of each frame; likewise.
        resume: go on with the unfinished run in the folder. The plan must be the one that it
            began with; `frames` may be larger.
        progress: called as `progress(frame, frames)` after each frame.

    Returns:
        The path of the video.

    Raises:
        SimulationError: a particle was masked. The frames up to then are written.
        ValueError: the folder is not empty, or holds nothing that this plan could go on with.
    """
    extras = {"ply_frames": ply_frames, "trajectory_frames": trajectory_frames}
    record = reopened(plan, folder, extras) if resume else begun(plan, folder, extras)
    recorder = _Recorder(plan, folder, record)
    try:
        recorder.play(progress)
    except KeyboardInterrupt:
        recorder.close()
        raise
    recorder.close()
    recorder.report()
    # Without its record nothing is taken for unfinished, whatever else is left.
    record_path(folder).unlink()
    shutil.rmtree(folder / "resume")
    return folder / "video.mp4"


@final
class _Recorder:
    """Draws frame after frame, and keeps in the folder what it takes to go on."""

    def __init__(self, plan: Plan, folder: Path, record: Record):
        self._plan = plan
        self._folder = folder
        self._painter = _Painter(plan)
        # The last frame of which all files are written, and its state.
        self._latest = record, _state_of(plan, folder, record)
        self._kept = record.frame
        # Files that may not have reached the disk yet.
        self._loose: list[Path] = []
        self._cost = 0.0
        self._kept_at = time.perf_counter()
        self._started = self._kept_at - record.seconds

    def play(self, progress: Callable[[int, int], None] | None) -> None:
        """Run what is left of the plan, as far as nothing goes wrong."""
        record, start = self._latest
        for frame, state in states(self._plan, start, max(record.frame, 0)):
            if frame > record.frame:
                self._add(frame, state)
            if frame > 0 and progress is not None:
                progress(frame, self._plan.frames)

    def _add(self, frame: int, state: State) -> None:
        """Draw and write a frame, and keep its state if it is time."""
        record, _ = self._latest
        moved, bounded = carried(self._plan, state.x, state.F)
        picture = picture_path(self._folder, frame)
        save_image(picture, self._painter.paint(moved, frame))
        files = record.files(self._folder, frame)
        for path in files:
            self._write(path, state, moved)
        self._loose += [picture, *files]
        record = dataclasses.replace(
            record, frame=frame, most_bounded=max(bounded, record.most_bounded)
        )
        self._latest = record, state
        if time.perf_counter() - self._kept_at >= _PATIENCE * self._cost:
            self._keep()

    def _write(self, path: Path, state: State, moved: Gaussians) -> None:
        if path.suffix == ".ply":
            gaussians = concatenate([moved, self._plan.still])
            save_ply(path, gaussians.transformed(self._plan.to_simulation.inverse()))
            return
        t = np.asarray(int(state.step) * self._plan.dt, state.dtype)
        x, v, F = (np.asarray(a) for a in (state.x, state.v, state.F))
        save_arrays(path, {"t": t, "x": x, "v": v, "F": F})

    def _keep(self) -> None:
        """From here on the run can go on from its latest frame."""
        started = time.perf_counter()
        record, state = self._latest
        record = dataclasses.replace(record, seconds=started - self._started)
        for path in {*self._loose, *(file.parent for file in self._loose)}:
            flush(path)
        path = state_path(self._folder, record.frame)
        save_state(path, state)
        # This decides: before it the previous state counts, after it the new one.
        record.write(self._folder)
        for other in path.parent.glob("state-*.npz"):
            if other != path:
                other.unlink()
        self._latest, self._kept, self._loose = (record, state), record.frame, []
        self._kept_at = time.perf_counter()
        self._cost = self._kept_at - started

    def close(self) -> None:
        """Keep the latest frame; write the video, the two pictures and `run.json`."""
        record, state = self._latest
        if record.frame < 0:
            return
        if record.frame > self._kept:
            self._keep()
        last, fps = record.frame, self._plan.fps
        # Read again, they become the same bytes as they were written as.
        pictures = (load_image(picture_path(self._folder, frame)) for frame in range(last + 1))
        save_video(self._folder / "video.mp4", pictures, fps=fps)
        for name, frame in (("first.png", 0), ("last.png", last)):
            with durably_replacing(self._folder / name) as temporary:
                shutil.copyfile(picture_path(self._folder, frame), temporary)
        seconds = time.perf_counter() - self._started
        write_json(self._folder / "run.json", _summed_up(self._plan, state, record, seconds))

    def report(self) -> None:
        """Warn of what makes the result doubtful, raise what makes it useless."""
        record, state = self._latest
        if record.most_bounded:
            warnings.warn(
                f"Up to {record.most_bounded} Gaussians in a frame were drawn with their stretch "
                f"bounded to `camera.max_stretch` = {self._plan.view.max_stretch:g}; the "
                f"simulation is not affected.",
                stacklevel=3,
            )
        errors = state.status.messages(ERRORS)
        for message in state.status.messages():
            if message not in errors:
                warnings.warn(message, SimulationWarning, stacklevel=3)
        if errors:
            raise SimulationError(f"Stopped at frame {record.frame}: {' '.join(errors)}")


def _state_of(plan: Plan, folder: Path, record: Record) -> State:
    """Where a run goes on."""
    if record.frame < 0:
        return plan.state
    path = state_path(folder, record.frame)
    state = load_state(path, plan.scene)
    steps = int(plan.state.step) + record.frame * plan.substeps
    if int(state.step) != steps:
        raise ValueError(
            f"The file {path} must hold the state after {steps} steps, but holds the one after "
            f"{int(state.step)}."
        )
    return state


def states(plan: Plan, state: State, frame: int) -> Iterator[tuple[int, State]]:
    """The given frame and state and those that follow, as far as nothing goes wrong.

    The next frame is already being simulated while the caller draws this one.
    """
    while True:
        goes_on = frame < plan.frames and bool(state.status.ok)
        ahead = advance(plan, state) if goes_on else None
        yield frame, state
        if ahead is None:
            return
        frame, state = frame + 1, ahead.final


def advance(plan: Plan, state: State) -> Trajectory:
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
            allow_unstable=plan.allow_unstable,
        )


def _nothing(state: State) -> None:
    """Frames are drawn from the final state of each call."""
    del state


def carried(plan: Plan, x: jax.Array, F: jax.Array) -> tuple[Gaussians, int]:
    """The moving Gaussians of a frame, deformed, and how many stretches were bounded."""
    x, F, beyond = placed(plan, x, F)
    return deform(plan.moving, x, F), int(beyond.sum())


def placed(plan: Plan, x: jax.Array, F: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where the moving Gaussians are, with what they are deformed, and where that was bounded."""
    F, beyond = bound_stretch(F, plan.view.max_stretch)
    if plan.carriage is None:
        return x, F, beyond
    x, F = plan.carriage(x, F)
    return x, F, beyond[plan.carriage.parents[:, 0]]


@final
class _Painter:
    """Draws frames; while the camera stands still, what does not move is projected once."""

    def __init__(self, plan: Plan):
        self._plan = plan
        self._around: Surroundings | None = None

    def paint(self, moved: Gaussians, frame: int) -> np.ndarray:
        camera = self._plan.camera(frame)
        if self._around is None or not _same(self._around.camera, camera):
            self._around = prepare_surroundings(self._plan.still, camera)
        image = self._around.render(moved, background=self._plan.view.background)
        return np.clip(np.asarray(image.rgb), 0, 1)


def _same(one: Camera, other: Camera) -> bool:
    """Whether two cameras are equal, number by number."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    sizes = (one.width, one.height) == (other.width, other.height)
    return sizes and all(np.array_equal(a, b) for a, b in pairs)


def _summed_up(plan: Plan, state: State, record: Record, seconds: float) -> dict[str, Any]:
    return {
        "scene": plan.name,
        "particles": plan.scene.particle_count,
        "still_gaussians": len(plan.still),
        "grid": plan.scene.grid.node_shape,
        "dt": plan.dt,
        "substeps": plan.substeps,
        "frames": record.frame,
        "finished": record.frame == plan.frames and bool(state.status.ok),
        "fps": plan.fps,
        "seconds": round(seconds, 3),
        "status": {
            c.name: {"first": int(state.status.first[c]), "count": int(state.status.count[c])}
            for c in Condition
            if int(state.status.count[c])
        },
        "jax": jax.__version__,
        "most_bounded_gaussians": record.most_bounded,
    }
