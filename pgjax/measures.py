"""What a motion did to a body: slopes of heaps, bends that stay, change of volume.

Torn pieces are counted by `pgjax.sampling.pieces`.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pgjax._types import require

# The flank of a heap: parts of its height.
_FLANK = (0.25, 0.75)
# Cells whose planes are the least that a slope is taken from.
_FEWEST = 8


def heap_angle(x: Any, *, cell: float) -> float:
    """Slope of the flanks of a heap, degrees: the angle of repose of one that came to rest.

    The highest particle of each column of a square lattice makes the surface; in each 3 × 3
    columns between a quarter and three quarters of the height a plane is fitted to it. The angle
    is the median of their slopes, so that walls left standing and single grains count little.

    Args:
        x: positions with z up, m, `(p, 3)`, finite.
        cell: width of a column, m: about twice the distance of the particles.

    Raises:
        ValueError: an argument is out of range, or there is too little flank: fewer than 8 planes.
    """
    points = np.asarray(x, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise ValueError(f"Argument `x` must have shape (p, 3), but has shape {points.shape}.")
    require("x", points, "be finite", np.isfinite)
    require("cell", cell, "be positive and finite (m)", lambda a: (a > 0) & np.isfinite(a))
    top = _surface(points, cell)
    low, high = (np.nanmin(top) + part * (np.nanmax(top) - np.nanmin(top)) for part in _FLANK)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(top, 1, constant_values=np.nan), (3, 3)
    )
    flank = (top > low) & (top < high) & np.isfinite(windows).all(axis=(-2, -1))
    if flank.sum() < _FEWEST:
        raise ValueError(
            f"Argument `x` must be a heap of at least {_FEWEST} columns of flank at `cell` = "
            f"{cell:g} m, but {int(flank.sum())} were found."
        )
    planes = windows[flank]
    slopes = [(planes * k).sum(axis=(-2, -1)) / (6 * cell) for k in (_AHEAD, _AHEAD.T)]
    return float(np.degrees(np.median(np.arctan(np.hypot(*slopes)))))


_AHEAD = np.array([[-1.0, -1, -1], [0, 0, 0], [1, 1, 1]])


def _surface(x: np.ndarray, cell: float) -> np.ndarray:
    """The highest particle of each column, NaN where there is none."""
    columns = np.floor((x[:, :2] - x[:, :2].min(axis=0)) / cell).astype(int)
    top = np.full(columns.max(axis=0) + 1, -np.inf)
    np.maximum.at(top, tuple(columns.T), x[:, 2])
    return np.where(np.isfinite(top), top, np.nan)


def turn_between(X: Any, x: Any, first: Any, second: Any) -> float:
    """By how much one part of a body has turned against another, degrees, from 0 to 180.

    Of each part the rotation that fits its motion best (Kabsch) is taken: what is left of a bend
    or a twist, whatever the body as a whole did.

    Args:
        X: positions before, m, `(p, 3)`, finite.
        x: positions after, likewise.
        first: which particles are of the one part, boolean `(p,)`, at least three.
        second: of the other.
    """
    X, x = np.asarray(X, np.float64), np.asarray(x, np.float64)
    if X.ndim != 2 or X.shape[1] != 3 or X.shape != x.shape:
        raise ValueError(
            f"Arguments `X` and `x` must have the same shape (p, 3), but have {X.shape} and "
            f"{x.shape}."
        )
    turns = []
    for name, part in (("first", first), ("second", second)):
        part = np.asarray(part)
        if part.dtype != bool or part.shape != X.shape[:1] or part.sum() < 3:
            raise ValueError(
                f"Argument `{name}` must be boolean, one entry per particle, with at least three "
                f"that are true, but is {part.dtype} of shape {part.shape}, {int(part.sum())} true."
            )
        require("x", x[part], "be finite", np.isfinite)
        before, after = X[part] - X[part].mean(axis=0), x[part] - x[part].mean(axis=0)
        turns.append(Rotation.align_vectors(after, before)[0])
    return float(np.degrees((turns[1] * turns[0].inv()).magnitude()))


def volume_change(F: Any, volumes: Any) -> float:
    """Change of the volume of a body as a part of its rest volume: `Σ V₀ J / Σ V₀ − 1`.

    Args:
        F: deformation gradients, `(p, d, d)`.
        volumes: rest volumes, m³, `(p,)`, positive.
    """
    F, volumes = np.asarray(F, np.float64), np.asarray(volumes, np.float64)
    if F.ndim != 3 or F.shape[1] != F.shape[2] or volumes.shape != F.shape[:1]:
        raise ValueError(
            f"Arguments `F` and `volumes` must have shapes (p, d, d) and (p,), but have {F.shape} "
            f"and {volumes.shape}."
        )
    require("volumes", volumes, "be positive", lambda a: a > 0)
    return float(np.average(np.linalg.det(F), weights=volumes) - 1)
