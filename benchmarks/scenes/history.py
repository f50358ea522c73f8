"""A run of a scene, as the checks look at it."""

import dataclasses
from functools import cached_property
from pathlib import Path

import numpy as np

from pgjax.scenes import Plan


@dataclasses.dataclass(frozen=True)
class History:
    """What a run with `--save-trajectory` left, and the plan it began with."""

    plan: Plan
    folder: Path

    @cached_property
    def X(self) -> np.ndarray:
        """Positions at the start, m, `(p, 3)`."""
        return np.asarray(self.plan.state.x, np.float64)

    @cached_property
    def last(self) -> dict[str, np.ndarray]:
        """Time, positions, velocities and deformation gradients at the end."""
        return self.frame(self.plan.frames)

    @cached_property
    def positions(self) -> np.ndarray:
        """Positions of all frames, m, `(f, p, 3)`."""
        return np.stack([self.frame(f)["x"] for f in range(self.plan.frames + 1)])

    @property
    def h(self) -> float:
        """Spacing of the grid, m."""
        return float(self.plan.scene.grid.h)

    @property
    def volumes(self) -> np.ndarray:
        """Rest volumes, m³, `(p,)`."""
        return np.asarray(self.plan.scene.volumes)

    def frame(self, number: int) -> dict[str, np.ndarray]:
        """What is kept of a frame: t, x, v, F."""
        with np.load(self.folder / "trajectory" / f"{number:05d}.npz") as stored:
            return dict(stored)

    def material(self, index: int) -> np.ndarray:
        """Which particles are of a material of the scene file, boolean `(p,)`."""
        ends = np.cumsum(self.plan.scene.counts)
        mine = np.zeros(len(self.X), bool)
        mine[slice(ends[index] - self.plan.scene.counts[index], ends[index])] = True
        return mine

    def box(self, lower, upper) -> np.ndarray:
        """Which particles start within a box, boolean `(p,)`."""
        return np.all((lower <= self.X) & (upper >= self.X), axis=-1)
