"""A capture before it is a scene: which way is up, where the ground is, what the object is."""

import dataclasses
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from pgjax.render import Gaussians
from pgjax.scenes.ground import USUAL_UP, Ground, across_plane, find_ground
from pgjax.scenes.regions import AbstractRegion, BoxRegion, CylinderRegion, Points

OPACITY_ABOVE = 0.02
"""Gaussians that are fainter are left out, as a scene file does it."""

_FEWEST = 16
# Without floaters: between these quantiles, widened by this part of what is between them.
_QUANTILES, _WIDENED = (0.02, 0.98), 0.15
# A voxel in distances of a Gaussian to its sixth neighbour; cells along the longest side at most.
_NEIGHBOUR, _VOXEL, _FINEST = 6, 1.6, 128
# A part of the object besides the largest: part of its Gaussians, of its height; how far outside.
_PART, _TALL, _NEAR = 0.04, 0.1, 0.5
# A box that leaves fewer than this part outside is no split.
_SPLIT = 1e-3


@dataclasses.dataclass(frozen=True)
class Findings:
    """What a capture looks like, in its own coordinates.

    Attributes:
        total: Gaussians.
        opaque: which are opaque enough to be there, `(total,)`.
        lower: corner of the box without floaters, `(3,)`.
        upper: the other corner.
        floaters: Gaussians outside of it.
        up: unit vector that points up, `(3,)`.
        ground: what it stands on; None if there is no plane like a ground.
        region: the object; None if that is everything.
        moves: which Gaussians are in the region and opaque, `(total,)`.
        pieces: unconnected pieces the object consists of.
        foot: height of its lowest centre along `up`.
    """

    total: int
    opaque: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    floaters: int
    up: np.ndarray
    ground: Ground | None
    region: AbstractRegion | None
    moves: np.ndarray
    pieces: int
    foot: float

    @property
    def clearance(self) -> float:
        """How high the lowest Gaussian of the object is above the ground; 0 without one."""
        return 0.0 if self.ground is None else max(self.foot - self.ground.height, 0.0)


def inspect(gaussians: Gaussians) -> Findings:
    """Look at a capture; the same capture gives the same findings.

    Raises:
        ValueError: there are too few Gaussians that can be seen, or all are at one place.
    """
    x = np.asarray(gaussians.means, np.float64)
    opaque = np.asarray(gaussians.opacities) > OPACITY_ABOVE
    seen = np.flatnonzero(opaque)
    if len(seen) < _FEWEST:
        raise ValueError(
            f"The capture must hold at least {_FEWEST} Gaussians above the opacity "
            f"{OPACITY_ABOVE:g}, but holds {len(seen)} of {len(x)}."
        )
    lower, upper = _box(x[seen])
    if not np.linalg.norm(upper - lower) > 0:
        raise ValueError(f"The capture must not have all its Gaussians at one place, {x[seen[0]]}.")
    inner = seen[np.all((x[seen] >= lower) & (x[seen] <= upper), axis=1)]
    ground = find_ground(x[inner], np.asarray(gaussians.factors, np.float64)[inner])
    up = USUAL_UP if ground is None else ground.up
    chosen, pieces = _object(x, inner, ground)
    region = _region(x, seen, chosen, ground, up)
    moves = opaque.copy()
    if region is not None:
        moves &= region.contains(Points(x, np.arange(len(x))))
    return Findings(
        total=len(x),
        opaque=opaque,
        lower=lower,
        upper=upper,
        floaters=len(seen) - len(inner),
        up=up,
        ground=ground,
        region=region,
        moves=moves,
        pieces=pieces,
        foot=float((x[moves] @ up).min()),
    )


def _box(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A box around everything but what is far outside, as tight as what is in it."""
    low, high = np.quantile(x, _QUANTILES, axis=0)
    wide = _WIDENED * np.max(high - low)
    inner = np.all((x >= low - wide) & (x <= high + wide), axis=1)
    kept = x[inner] if inner.any() else x
    return kept.min(axis=0), kept.max(axis=0)


def _object(x: np.ndarray, inner: np.ndarray, ground: Ground | None) -> tuple[np.ndarray, int]:
    """Rows of the Gaussians of the object, and in how many pieces it is.

    It is the largest connected piece on a lattice of voxels, of those above the ground; large
    pieces beside it belong to it. What is near the middle of the capture counts more.
    """
    above = inner
    if ground is not None:
        high = inner[x[inner] @ ground.up > ground.height + ground.layer]
        above = high if len(high) >= _FEWEST else inner
    label = _connected(x[above])
    counts = np.bincount(label)
    middle = np.median(x[inner], axis=0)
    away = np.sum((x[above] - middle) ** 2, axis=1)
    radius = max(float(np.quantile(np.sum((x[inner] - middle) ** 2, axis=1), 0.8)), 1e-300)
    mean = np.bincount(label, away) / np.maximum(counts, 1)
    main = int(np.argmax(counts * np.exp(-mean / radius)))
    up = USUAL_UP if ground is None else ground.up
    pieces = [main, *_beside(x[above], label, main, up)]
    return above[np.isin(label, pieces)], len(pieces)


def _connected(x: np.ndarray) -> np.ndarray:
    """The number of the connected piece that each point belongs to, `(n,)`."""
    k = min(_NEIGHBOUR, len(x) - 1)
    tree: Any = KDTree(x)
    distance = float(np.median(tree.query(x, k=[k + 1])[0]))
    longest = float(np.ptp(x, axis=0).max())
    voxel = max(_VOXEL * distance, longest / _FINEST, 1e-300)
    at = np.floor((x - x.min(axis=0)) / voxel).astype(int)
    filled = np.zeros(at.max(axis=0) + 1, bool)
    filled[tuple(at.T)] = True
    labelled: Any = ndimage.label(filled, np.ones((3, 3, 3)))
    return labelled[0][tuple(at.T)]


def _beside(x: np.ndarray, label: np.ndarray, main: int, up: np.ndarray) -> list[int]:
    """Pieces that are large and tall enough, and near enough to the main one, to belong to it."""
    own = x[label == main]
    lower, upper = own.min(axis=0), own.max(axis=0)
    reach = _NEAR * np.max(upper - lower)
    counts, height = np.bincount(label), np.ptp(own @ up)
    found = []
    for piece in np.flatnonzero(counts >= _PART * counts[main]):
        points = x[label == piece]
        if piece == main or not np.ptp(points @ up) >= _TALL * height:
            continue
        if np.all(points.min(axis=0) >= lower - reach) and np.all(
            points.max(axis=0) <= upper + reach
        ):
            found.append(int(piece))
    return found


def _region(
    x: np.ndarray, seen: np.ndarray, chosen: np.ndarray, ground: Ground | None, up: np.ndarray
) -> AbstractRegion | None:
    """Around the object: a box, or a cylinder along `up` if that is along no axis."""
    margin = 0.01 * float(np.ptp(x[chosen], axis=0).max())
    lower, upper = x[chosen].min(axis=0) - margin, x[chosen].max(axis=0) + margin
    axis = int(np.argmax(np.abs(up)))
    upright = abs(up[axis]) == 1
    floor = -np.inf if ground is None else ground.height + ground.layer
    if upright and up[axis] > 0:
        lower[axis] = max(lower[axis], floor)
    elif upright:
        upper[axis] = min(upper[axis], -floor)
    region = BoxRegion(_triple(lower), _triple(upper))
    if not upright:
        region = _cylinder(x[chosen], up, floor, margin)
    outside = ~region.contains(Points(x[seen], seen))
    return region if np.count_nonzero(outside) > _SPLIT * len(seen) else None


def _cylinder(x: np.ndarray, up: np.ndarray, floor: float, margin: float) -> CylinderRegion:
    """The upright cylinder around points."""
    basis = across_plane(up)
    across, along = x @ basis.T, x @ up
    middle = (across.min(axis=0) + across.max(axis=0)) / 2
    radius = float(np.linalg.norm(across - middle, axis=1).max()) + margin
    foot, top = max(float(along.min()) - margin, floor), float(along.max()) + margin
    start, end = (middle @ basis + height * up for height in (foot, top))
    return CylinderRegion(_triple(start), _triple(end), radius)


def _triple(v: np.ndarray) -> tuple[float, float, float]:
    """Three numbers with four digits, as they are written."""
    x, y, z = (float(f"{a:.4g}") for a in v)
    return x, y, z
