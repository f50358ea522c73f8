"""What is computed: one block of material, described in numbers every code understands.

A lattice of eight particles per cell, strained and strained further by its velocity, leaves a
corner of a box with slippery walls under gravity. Nothing here needs JAX, Taichi or Warp.
"""

import dataclasses
import math

import numpy as np

E, NU, DENSITY = 1e5, 0.3, 1000.0
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
FRICTION_ANGLE, YIELD_STRESS = 30.0, 1000.0
ALPHA = math.sqrt(2 / 3) * 2 * math.sin(math.radians(FRICTION_ANGLE))
ALPHA /= 3 - math.sin(math.radians(FRICTION_ANGLE))
GRAVITY = (0.0, 0.0, -9.81)

H = 1 / 64
# Nodes up to this one, and as many at the other end, are behind a wall.
WALL = 3
# The stable bound of ∇w is 0.71 h/c, that of MLS h/c.
DT = 0.4 * H / math.sqrt((3 * LAM + 2 * MU) / DENSITY)

MATERIALS = ("neo-Hookean", "fixed corotated", "Drucker-Prager", "von Mises")
# Particles along an edge of the block.
SIZES = {"8k": 20, "64k": 40, "512k": 80, "2M": 126}


@dataclasses.dataclass(frozen=True)
class Case:
    """One block.

    Attributes:
        material: a name of `MATERIALS`.
        side: particles along an edge; two per cell.
        cells: cells along an edge of the cubic grid.
    """

    material: str
    side: int
    cells: int

    @property
    def particles(self) -> int:
        """Number of particles."""
        return self.side**3

    @property
    def volume(self) -> float:
        """Rest volume of one particle, m³."""
        return (H / 2) ** 3


def grid_cells(side: int) -> int:
    """64, or the next multiple of 32 that leaves the block a dozen cells to move in."""
    return max(64, 32 * math.ceil((side / 2 + 2 * WALL + 12) / 32))


@dataclasses.dataclass(frozen=True)
class Start:
    """The initial condition in single precision: `x`, `v` `(p, 3)`, `F` `(p, 3, 3)`."""

    x: np.ndarray
    v: np.ndarray
    F: np.ndarray


def start(case: Case) -> Start:
    """Half a cell from three walls, moving towards them, turning and shearing; F is not I."""
    axis = (WALL + 0.5) * H + (np.arange(case.side) + 0.5) * H / 2
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    centred = x - x.mean(axis=0)
    rates = np.array([[1.0, -4.0, 2.0], [5.0, -2.0, 3.0], [-1.0, -4.0, 1.0]])
    v = np.array([-0.5, -0.3, -1.0]) + centred @ rates.T
    phases = np.arange(9).reshape(3, 3)
    waves = np.sin(x.sum(axis=1)[:, None, None] / (4 * H) + 2.4 * phases)
    F = np.eye(3) + 0.04 * waves
    return Start(*(a.astype(np.float32) for a in (x, v, F)))
