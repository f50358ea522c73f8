"""The same block in pgjax, Taichi and Warp: an elastic cube on a roller, in its first mode.

Without lateral contraction (ν = 0) fixed corotated elasticity is linear in a motion along one
direction: `u = a sin(π Z/(2 L)) sin(ω t)`, `ω = π c/(2 L)`, is exact at any strain, and nothing
moves sideways.

The codes are those of `benchmarks.speed`, which take their block from the constants of
`benchmarks.speed.cases` as they are imported: here another one is put there first.
"""

import dataclasses
import importlib
import math
import statistics
import time
from typing import Any

import numpy as np

from benchmarks.speed import cases

LOOKS = 8
CODES = {
    "pgjax MLS": ("pgjax", "MLS"),
    "pgjax ∇w": ("pgjax", "∇w"),
    # On one thread its other variant, with atomic additions, is slower.
    "Taichi": ("taichi", "serialised"),
    "Warp": ("warp", ""),
}


@dataclasses.dataclass(frozen=True)
class Cube:
    """A cube of 1 m, as the codes want a case to be described.

    Attributes:
        n: cells along an edge; eight particles in each.
        strain: largest strain of the motion.
    """

    n: int
    strain: float
    material = "fixed corotated"
    # The cube is not at the walls, but for the roller.
    aside = 2

    @property
    def particles(self) -> int:
        """Number of particles."""
        return (2 * self.n) ** 3

    @property
    def cells(self) -> int:
        """Cells along an edge of the grid."""
        return self.n + 2 * (cases.WALL + self.aside)

    @property
    def volume(self) -> float:
        """Rest volume of a particle, m³."""
        return (cases.H / 2) ** 3

    @property
    def places(self) -> np.ndarray:
        """Positions at rest, m, `(p, 3)`."""
        axis = (cases.WALL + (np.arange(2 * self.n) + 0.5) / 2) * cases.H
        aside = axis + self.aside * cases.H
        return np.stack(np.meshgrid(aside, aside, axis, indexing="ij"), axis=-1).reshape(-1, 3)

    @property
    def mode(self) -> np.ndarray:
        """Of displacements along the third axis, `(p,)`."""
        return np.sin(np.pi / 2 * (self.places[:, 2] - cases.WALL * cases.H))


def speed_of_waves() -> float:
    """`√(2μ/ρ)`, m/s."""
    return math.sqrt(2 * cases.MU / cases.DENSITY)


def start(cube: Cube) -> cases.Start:
    """At rest length, `v = strain c` at the top."""
    v = cube.strain * speed_of_waves() * np.stack([0 * cube.mode] * 2 + [cube.mode], axis=1)
    F = np.tile(np.eye(3), (cube.particles, 1, 1))
    return cases.Start(*(a.astype(np.float32) for a in (cube.places, v, F)))


def set_up(cube: Cube) -> None:
    """Put the cube where the codes find their block; before they are imported."""
    cases.NU = 0.0
    cases.MU, cases.LAM = cases.E / 2, 0.0
    cases.GRAVITY = (0.0, 0.0, 0.0)
    cases.H = 1 / cube.n
    cases.DT = 1 / steps(cube) / speed_of_waves()
    cases.start = start


def steps(cube: Cube) -> int:
    """Of one crossing `L/c`, each at most 0.4 h/c; a multiple of `LOOKS`."""
    return LOOKS * math.ceil(cube.n / 0.4 / LOOKS)


def point(code: str, n: int, strain: float, runs: int) -> dict[str, Any]:
    """RMS error of the velocity over one crossing, over that at the start, and the costs.

    Args:
        code: a name of `CODES`.
        n: cells along the cube.
        strain: of the motion.
        runs: how often it is timed.
    """
    cube, (name, variant) = Cube(n, strain), CODES[code]
    set_up(cube)
    module = importlib.import_module(f"benchmarks.speed.with_{name}")
    solver, count = module.Solver(cube, variant), steps(cube)
    off = []
    solver.reset()
    for look in range(1, LOOKS + 1):
        solver.run(count // LOOKS)
        time_now = count // LOOKS * look * cases.DT
        exact = cube.strain * speed_of_waves() * math.cos(np.pi / 2 * speed_of_waves() * time_now)
        v = velocities(solver)
        v[:, 2] -= exact * cube.mode
        off.append(np.sqrt(np.mean(np.sum(v * v, axis=1))))
    error = max(off) / (cube.strain * speed_of_waves() * np.sqrt(np.mean(cube.mode**2)))
    times = [seconds(solver, count) for _ in range(runs + 1)]
    return {
        "error": float(error),
        "seconds": statistics.median(times[1:]),
        "particles": cube.particles,
        "steps": count,
    }


def seconds(solver: Any, count: int) -> float:
    """Of so many steps from the start."""
    solver.reset()
    started = time.perf_counter()
    solver.run(count)
    return time.perf_counter() - started


def velocities(solver: Any) -> np.ndarray:
    """`(p, 3)`, in double precision, of any of the codes."""
    v = solver.final.v if hasattr(solver, "final") else solver.v
    for method in ("to_numpy", "numpy"):
        if hasattr(v, method):
            v = getattr(v, method)()
            break
    return np.array(v, np.float64)
