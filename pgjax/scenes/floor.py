"""The grid is put so that its nodes lie on what the material rests on.

A wall holds the nodes that are on it and behind it: between nodes it would act up to a spacing too
low, and elsewhere on every grid, so that finer grids would not approach anything.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pgjax.boundary import Box, Collider, Cuboid, HalfSpace, Offset
from pgjax.grid import Grid
from pgjax.scenes.regions import Triple

# In spacings: a floor so little above its nodes is left there; one that is no further below them
# than by rounding is on them.
_ABOVE, _ROUNDING = 0.05, 1e-5


def on_floor(grid: Grid, walls: Sequence[Callable], gravity: Triple) -> tuple[Grid, str | None]:
    """The grid moved by less than a spacing, so that nodes lie on the first floor.

    A floor is a wall at rest with a face across gravity, which must be along an axis: a half-space,
    a cuboid that is not turned, or a box. The lower corner is moved outwards; the grid gets a layer
    of nodes for it.

    Returns:
        The grid, the same if there is no floor in it or nodes are there already, and how far it was
        moved, if it was.
    """
    axis = int(np.argmax(np.abs(gravity)))
    if np.count_nonzero(gravity) != 1 or grid.periodic[axis]:
        return grid, None
    up = -float(np.sign(gravity[axis]))
    origin, h = np.array(grid.origin, np.float64), float(grid.h)
    for number, wall in enumerate(walls, 1):
        level = _level(wall, axis, up)
        cells = None if level is None else (level - origin[axis]) / h
        if cells is None or not 0 < cells < grid.shape[axis]:
            continue
        beyond = float(np.ceil(cells - _ABOVE) - cells)
        if beyond <= _ROUNDING:
            return grid, None
        origin[axis] -= beyond * h
        shape = [n + (i == axis) for i, n in enumerate(grid.shape)]
        note = (
            f"grid moved by {-1e3 * beyond * h:.3g} mm along {'xyz'[axis]}: its nodes are on "
            f"boundary {number}"
        )
        return Grid(origin.tolist(), shape, h, periodic=grid.periodic), note
    return grid, None


def _level(wall: Any, axis: int, up: float) -> float | None:
    """Where the face of a wall that material rests on is along an axis, m; None if it has none."""
    if isinstance(wall, Box):
        return float((wall.lower if up > 0 else wall.upper)[axis])
    if not isinstance(wall, Collider) or wall.motion is not None:
        return None
    shape, out = wall.shape, 0.0
    if isinstance(shape, Offset):
        shape, out = shape.shape, float(shape.distance)
    if isinstance(shape, Cuboid) and shape.turn is None:
        return float(shape.center[axis] + up * (shape.half_size[axis] + out))
    if isinstance(shape, HalfSpace):
        n = np.asarray(shape.normal, np.float64)
        if n[axis] * up > 0 and np.count_nonzero(n) == 1:
            return float(shape.point[axis]) + up * out
    return None
