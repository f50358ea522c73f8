"""Particles that are let go layer by layer between two planes."""

import math
from typing import Any

import numpy as np

# A particle on the first plane, up to rounding, is in the first layer.
_ROUNDING = 1e-6


def releases(
    x: np.ndarray,
    domain: float,
    axis: int,
    planes: tuple[float, float],
    layers: int,
    until: float,
) -> list[dict[str, Any]]:
    """The `[[particles]]` tables of a sequential release.

    Boxes that shrink towards the last plane hold particles, on both sides of it: of those at the
    distance `(1 − s) L` from it the layer `k = ⌈layers s⌉` is let go at `until k/layers`. A
    `release` counts its layers from the first to the last particle it has, so that its times are
    those to within one layer.

    Args:
        x: positions, m, `(n, 3)`.
        domain: edge of the grid, m.
        axis: along which particles are let go.
        planes: the first and the last, a distance L apart, m.
        layers: number of layers between the planes.
        until: when the particles at the last plane are let go, s.
    """
    first, last = planes
    # What lies on the last plane belongs to the first side.
    margin = _ROUNDING * (first - last)
    sides = (
        _one_side(x, domain, axis, (first + margin, last - margin), planes, layers, until),
        _one_side(x, domain, axis, (2 * last - first, last - 2 * margin), planes, layers, until),
    )
    return [side for side in sides if side is not None]


def _one_side(
    x: np.ndarray,
    domain: float,
    axis: int,
    slab: tuple[float, float],
    planes: tuple[float, float],
    layers: int,
    until: float,
) -> dict[str, Any] | None:
    """The release of the particles in a slab, the outermost first."""
    first, last = planes
    lower, upper = [0.0] * 3, [domain] * 3
    lower[axis], upper[axis] = min(slab), max(slab)
    there = np.all((x >= lower) & (x <= upper), axis=1)
    if not there.any():
        return None
    s = 1 - np.abs(x[there, axis] - last) / abs(first - last)
    k = np.clip(np.ceil(layers * s - _ROUNDING), 1, layers)
    early, late = until * float(k.min()) / layers, until * float(k.max()) / layers
    region = {"region": {"lower": lower, "upper": upper}}
    if early == late:
        return {"type": "hold", "end": late} | region
    direction = [0.0] * 3
    direction[axis] = math.copysign(1.0, slab[1] - slab[0])
    times = {"start": early, "end": late, "layers": round(float(k.max() - k.min())) + 1}
    return {"type": "release", "direction": direction} | times | region
