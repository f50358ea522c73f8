"""A scene is run in one setting: where its Gaussians go, and what a frame takes."""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, final

import jax
import numpy as np

from pgjax.result import ERRORS
from pgjax.scenes.build import Plan, plan
from pgjax.scenes.run import advance, placed
from pgjax.scenes.schema import SceneFile
from pgjax.scenes.settings import Setting, applied

# So many Gaussians say how far motions are apart.
_MOST = 30_000
# What a run takes before one is known: to load and compile, s; a particle-step, s.
_COMPILING, _STEP = 15.0, 3e-7


@dataclasses.dataclass(frozen=True)
class Trial:
    """What came of a setting.

    Attributes:
        what: it was run for.
        setting: the setting.
        double: whether double precision was switched on for it.
        particles: how many there are.
        substeps: steps in a frame.
        seconds: that a frame takes to simulate: the median, without the first.
        x: where the Gaussians are in each frame, m, `(frames + 1, n, 3)`; None if a particle
            was lost.
        messages: what the simulation says of it.
    """

    what: str
    setting: Setting
    double: bool
    particles: int
    substeps: int
    seconds: float
    x: np.ndarray | None
    messages: tuple[str, ...]

    @property
    def work(self) -> int:
        """Particle-steps of a frame."""
        return self.particles * self.substeps


def prepared(file: SceneFile, setting: Setting, frames: int) -> Plan:
    """The plan of a scene in a setting."""
    return plan(applied(file, setting), frames=frames)


def tried(made: Plan, setting: Setting, what: str, double: bool) -> Trial:
    """Run all frames of a plan."""
    chosen = _some(len(made.moving))
    state, moved, seconds = made.state, [_places(made, made.state, chosen)], []
    while len(moved) <= made.frames and bool(state.status.ok):
        started = time.perf_counter()
        state = jax.block_until_ready(advance(made, state)).final
        seconds.append(time.perf_counter() - started)
        moved.append(_places(made, state, chosen))
    lost = state.status.messages(ERRORS)
    return Trial(
        what,
        setting,
        double,
        made.scene.particle_count,
        made.substeps,
        # The first has compiled the step.
        float(np.median(seconds[1:] or seconds)),
        None if lost else np.stack(moved),
        tuple(lost or state.status.messages()),
    )


def _places(made: Plan, state: Any, chosen: np.ndarray) -> np.ndarray:
    """Where some of the Gaussians are drawn, m, in single precision."""
    x, _, _ = placed(made, state.x, state.F)
    return np.asarray(x, np.float32)[chosen]


def _some(count: int) -> np.ndarray:
    """Numbers of the Gaussians that are compared, the same for every setting."""
    if count <= _MOST:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, _MOST, replace=False))


@final
class Trials:
    """Runs a scene in one setting after the other, each at most once.

    Args:
        file: the scene.
        frames: how many to run; at least 2, since the first compiles.
        budget: seconds from now within which runs have to end.
        report: called with what is going to be run.

    Attributes:
        done: what was run, in order.
        left_out: what would have taken too long, by its name, with its cost.
    """

    def __init__(
        self,
        file: SceneFile,
        *,
        frames: int,
        budget: float = math.inf,
        report: Callable[[str], None] | None = None,
    ):
        if frames < 2:
            raise ValueError(f"Argument `frames` must be at least 2, but is {frames}.")
        if not budget > 0:
            raise ValueError(f"Argument `budget` must be above 0, but is {budget:g}.")
        self.file, self.frames = file, frames
        self.done: list[Trial] = []
        self.left_out: dict[str, str] = {}
        self._report = report
        self._deadline = time.perf_counter() + budget
        self._compiling, self._step = _COMPILING, _STEP

    def run(self, what: str, setting: Setting, *, double: bool = False) -> Trial | None:
        """What comes of a setting; None if that would take too long."""
        for trial in self.done:
            if (trial.setting, trial.double) == (setting, double):
                return trial
        with jax.enable_x64(True) if double else contextlib.nullcontext():
            return self._run(what, setting, double)

    def _run(self, what: str, setting: Setting, double: bool) -> Trial | None:
        started = time.perf_counter()
        made = prepared(self.file, setting, self.frames)
        work = made.scene.particle_count * made.substeps * made.frames
        seconds = self._compiling + work * self._step * (2 if double else 1)
        text = f"{what}: {setting}; {work:.3g} particle-steps, about {seconds:.0f} s"
        if started + seconds > self._deadline:
            self.left_out[f"{what}: {setting}"] = text
            return None
        if self._report is not None:
            self._report(text)
        trial = tried(made, setting, what, double)
        self._step = trial.seconds / trial.work
        self._compiling = max(time.perf_counter() - started - work * self._step, 0.0)
        self.done.append(trial)
        return trial
