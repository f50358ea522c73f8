"""Particles: lattices that fill simple shapes, volumes of captured points, pieces of bodies."""

from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pgjax._types import require

# Averaging over these neighbours makes the estimate right within 3 % both for a cubic lattice,
# where neighbours come in shells, and for points scattered at random.
_NEIGHBOURS = (7, 18)


def block(lower: Any, upper: Any, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A lattice that fills a box, in two or three dimensions.

    Args:
        lower: lower corner, m.
        upper: upper corner, m.
        spacing: wanted distance of the particles, m; adjusted so that the box is filled exactly.

    Returns:
        Positions `(p, d)` and rest volumes `(p,)`, which add up to the volume of the box.
    """
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    if low.shape != high.shape or low.shape not in ((2,), (3,)):
        raise ValueError(
            f"Arguments `lower` and `upper` must be vectors of 2 or 3 numbers, but have shapes "
            f"{low.shape} and {high.shape}."
        )
    require("upper", high, f"be above `lower` = {low}", lambda a: a > low)
    require("spacing", spacing, "be positive and finite (m)", lambda a: (a > 0) & np.isfinite(a))
    counts = np.maximum(np.round((high - low) / spacing), 1).astype(int)
    step = (high - low) / counts
    axes = [lo + (np.arange(n) + 0.5) * s for lo, n, s in zip(low, counts, step, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(low))
    return x, np.full(len(x), np.prod(step))


def ball(center: Any, radius: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A lattice that fills a ball (a disc in two dimensions).

    Returns:
        Positions `(p, d)` and rest volumes `(p,)`, which add up to the volume of the ball.
    """
    middle = np.asarray(center, np.float64)
    require("radius", radius, "be positive and finite (m)", lambda a: (a > 0) & np.isfinite(a))
    x, _ = block(middle - radius, middle + radius, spacing)
    x = x[np.sum((x - middle) ** 2, axis=1) <= radius**2]
    exact = np.pi * radius**2 if len(middle) == 2 else 4 / 3 * np.pi * radius**3
    return x, np.full(len(x), exact / len(x))


def pieces(x: Any, reach: float) -> np.ndarray:
    """Which piece of a body each particle belongs to: particles within reach of each other are one.

    A grid tears a body where neighbours are further apart than its spacing h, whatever the law:
    with `reach = h` more pieces than at the start mean that it did. A valid motion goes on from
    there; whether the body should have torn is for a finer grid, or more particles, to say.

    Args:
        x: positions, `(p, d)`, finite: `trajectory.saved.x[frame]`.
        reach: m.

    Returns:
        Numbers of pieces `(p,)`, the largest piece being 0; `max() + 1` is how many there are.
    """
    points = np.asarray(x, np.float64)
    require("x", points, "be finite", np.isfinite)
    require("reach", reach, "be positive and finite (m)", lambda a: (a > 0) & np.isfinite(a))
    a, b = KDTree(points).query_pairs(reach, output_type="ndarray").T
    links = coo_array((np.ones(len(a)), (a, b)), shape=(len(points),) * 2)
    _, labels = connected_components(links, directed=False)
    order = np.argsort(-np.bincount(labels), kind="stable")
    return np.argsort(order)[labels]


def neighbour_volumes(x: np.ndarray) -> np.ndarray:
    """Rest volumes of points in space from the distances to their neighbours, m³.

    The sphere that reaches to the k-th neighbour holds about k points, so
    `V = mean_k 4π r_k³/(3 k)`, k = 7 … 18: it depends on the points alone, not on any grid.
    Points of a thin shell count as a layer one spacing thick. Coincident and isolated points are
    bounded to between 1/64 and 8 times the median.

    Args:
        x: positions, `(p, 3)`, finite, at least two different ones.

    Returns:
        Volumes `(p,)`, all positive.
    """
    x = np.asarray(x, np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 2:
        raise ValueError(
            f"Argument `x` must have shape (p, 3) with p ≥ 2, but has shape {x.shape}."
        )
    require("x", x, "be finite", np.isfinite)
    first, last = _NEIGHBOURS
    last = min(last, len(x) - 1)
    ks = np.arange(min(first, last), last + 1)
    distances, _ = KDTree(x).query(x, k=last + 1)  # the first is the point itself
    volumes = np.mean(4 / 3 * np.pi * distances[:, ks] ** 3 / ks[None, :], axis=1)
    positive = volumes[volumes > 0]
    if len(positive) == 0:
        raise ValueError("Argument `x` must hold different points, but all of them coincide.")
    median = np.median(positive)
    return np.clip(volumes, median / 64, 8 * median)
