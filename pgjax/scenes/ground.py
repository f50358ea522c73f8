"""The ground plane of a capture, and with it the direction that points up.

Captures have y down as a rule, and a ground that the rest stands on: a plane is taken for it if it
covers what is seen along its normal and has nearly everything on one side.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy import ndimage

USUAL_UP = np.array([0.0, -1.0, 0.0])
"""Captures have y down as a rule."""

# Points that planes are tried on, planes of each kind that are tried, steps of the last fit.
_TRIED_ON, _TRIES, _STEPS = 8000, 300, 8
# A Gaussian is flat if its shortest axis is below this part of the middle one; areas above this
# quantile count as that.
_FLAT, _LARGEST = 0.4, 0.99
# Half the thickness of a plane while it is searched, over the diagonal of the capture.
_THICKNESS = 0.012
# Cells across the view along a normal, at most and at least; points in each on average.
_MOST_CELLS, _FEWEST_CELLS, _PER_CELL = 18, 4, 6
# A direction within this cosine of the usual one is as good as it; others have to be this much
# better, and clearer.
_USUAL, _UNUSUAL = np.cos(np.radians(40)), 0.6
# What is demanded: covered part of the view, part of the rest that is above, part that is free.
_DEMANDS_USUAL, _DEMANDS_UNUSUAL = (0.55, 0.6, 0.25), (0.8, 0.9, 0.4)
# Planes turned less than this against an axis lie across it, degrees.
_LEVEL = 2.0
# The layer of the ground: so many standard deviations, at least so much of the diagonal.
_LAYER, _THINNEST = 4.0, 0.002


@dataclasses.dataclass(frozen=True)
class Ground:
    """A plane that the rest stands on, `x · up = height`, in the coordinates of the capture.

    Attributes:
        up: unit vector, away from the ground, `(3,)`.
        height: of the plane along `up`.
        layer: height above the plane up to which Gaussians belong to the ground.
        coverage: part of the capture, as seen along `up`, that it lies under.
        above: part of what is not in the plane that is above it.
        free: part of the plane that has nothing above it.
        tilt: angle that `up` was turned by to lie along an axis, or between them, degrees.
    """

    up: np.ndarray
    height: float
    layer: float
    coverage: float
    above: float
    free: float
    tilt: float


def find_ground(x: np.ndarray, factors: np.ndarray, seed: int = 0) -> Ground | None:
    """The ground of a capture, or None if no plane looks like one. The same input, the same plane.

    Args:
        x: centres without those far outside, `(n, 3)`.
        factors: of the Gaussians, `(n, 3, 3)`.
        seed: of the planes that are tried.
    """
    rng = np.random.default_rng(seed)
    diagonal = float(np.linalg.norm(np.ptp(x, axis=0)))
    if len(x) < 3 or not diagonal > 0:
        return None
    thickness = _THICKNESS * diagonal
    samples, normals = _samples(x, factors, rng)
    best, worth = None, 0.0
    for up, height in _planes(samples, normals, rng):
        if _could_be(samples, up, height, thickness):
            found = _judged(samples, up, height, thickness)
            if _worth(found) > worth:
                best, worth = found, _worth(found)
    return None if best is None else _settled(x, samples, best, thickness)


def _samples(
    x: np.ndarray, factors: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points spread over the Gaussians, and the normals of these (zero where they are not flat).

    One half is drawn by number, the other by area: a ground often consists of few large ones.
    """
    finite = np.all(np.isfinite(factors), axis=(1, 2))
    U, sigma, _ = np.linalg.svd(np.where(finite[:, None, None], factors, 0))
    area = sigma[:, 0] * sigma[:, 1]
    area = np.minimum(area, np.quantile(area, _LARGEST)) + 1e-300
    rows = rng.choice(len(x), _TRIED_ON // 2)
    large = rng.choice(len(x), _TRIED_ON - len(rows), p=area / area.sum())
    rows = np.concatenate([rows, large])
    offset = np.clip(rng.normal(size=(len(rows), 2)), -2, 2) * sigma[rows, :2]
    flat = sigma[rows, 2] < _FLAT * sigma[rows, 1]
    return (
        x[rows] + np.einsum("nij,nj->ni", U[rows, :, :2], offset),
        np.where(flat[:, None], U[rows, :, 2], 0),
    )


def _planes(
    x: np.ndarray, normals: np.ndarray, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, float]]:
    """Planes to try, each with both sides up: of flat Gaussians, of three points, across axes."""
    found: list[tuple[np.ndarray, np.ndarray]] = []
    flat = np.flatnonzero(np.any(normals != 0, axis=1))
    if len(flat):
        found += [(normals[i], x[i]) for i in rng.choice(flat, _TRIES)]
    for i, j, k in rng.integers(len(x), size=(_TRIES, 3)):
        n = np.cross(x[j] - x[i], x[k] - x[i])
        length = np.linalg.norm(n)
        if length > 0:
            found.append((n / length, x[i]))
    for axis in np.eye(3):
        along = x @ axis
        counts, edges = np.histogram(along, 64)
        middles = (edges[1:] + edges[:-1]) / 2
        found += [(axis, middles[k] * axis) for k in np.argsort(-counts, kind="stable")[:3]]
    for n, point in found:
        yield n, float(n @ point)
        yield -n, float(-n @ point)


def _could_be(x: np.ndarray, up: np.ndarray, height: float, thickness: float) -> bool:
    """Whether the plane holds some of the points and most others are above: cheap to say."""
    d = x @ up - height
    inside = np.count_nonzero(np.abs(d) < thickness)
    below = np.count_nonzero(d <= -thickness)
    return bool(inside > 0.05 * len(x) and below < 0.5 * (len(x) - inside))


def _judged(x: np.ndarray, up: np.ndarray, height: float, thickness: float) -> Ground:
    """The plane as a ground, by what it covers of the view along `up`, holes in it included."""
    d = x @ up - height
    inside, above = np.abs(d) < thickness, d >= thickness
    across = x @ across_plane(up).T
    lower, upper = across.min(axis=0), across.max(axis=0)
    cells = int(np.clip(np.sqrt(len(x) / _PER_CELL), _FEWEST_CELLS, _MOST_CELLS))
    size = np.maximum(upper - lower, 1e-300)
    row, column = np.minimum((cells * (across - lower) / size).astype(int), cells - 1).T

    def view(which: np.ndarray) -> np.ndarray:
        number = np.bincount(row[which] * cells + column[which], minlength=cells**2)
        there = np.pad(number.reshape(cells, cells) > 1, 1)
        return np.asarray(ndimage.binary_fill_holes(ndimage.binary_closing(there)), bool)

    whole, plane = view(np.ones(len(x), bool)), view(inside)
    return Ground(
        up=up,
        height=height,
        layer=thickness,
        coverage=float(np.count_nonzero(plane) / max(np.count_nonzero(whole), 1)),
        above=float(np.count_nonzero(above) / max(np.count_nonzero(~inside), 1)),
        free=float(np.count_nonzero(plane & ~view(above)) / max(np.count_nonzero(plane), 1)),
        tilt=0.0,
    )


def across_plane(up: np.ndarray) -> np.ndarray:
    """Two unit vectors across `up`, `(2, 3)`."""
    first = np.eye(3)[np.argmin(np.abs(up))]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)])


def _worth(ground: Ground) -> float:
    """How good a ground it is; 0 if it is none."""
    usual = ground.up @ USUAL_UP > _USUAL
    coverage, above, free = _DEMANDS_USUAL if usual else _DEMANDS_UNUSUAL
    if ground.coverage < coverage or ground.above < above or ground.free < free:
        return 0.0
    return ground.coverage * ground.above**2 * (1 if usual else _UNUSUAL)


def _settled(x: np.ndarray, samples: np.ndarray, rough: Ground, thickness: float) -> Ground | None:
    """The plane fitted to its points, level if it nearly is, and how thick its layer is."""
    up, height = rough.up, rough.height
    for _ in range(_STEPS):
        near = samples[np.abs(samples @ up - height) < thickness]
        if len(near) < 3:
            break
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        up = normal if normal @ up > 0 else -normal
        height = float(up @ middle)
    axis = np.zeros(3)
    axis[np.argmax(np.abs(up))] = np.sign(up[np.argmax(np.abs(up))])
    tilt = float(np.degrees(np.arccos(np.clip(up @ axis, -1, 1))))
    if tilt < _LEVEL:
        up = axis
    d = x @ up
    near = d[np.abs(d - height) < (2 if tilt < _LEVEL else 1) * thickness]
    if len(near):
        height = float(np.median(near))
    spread = 1.4826 * float(np.median(np.abs(near - height))) if len(near) else 0.0
    judged = _judged(samples, up, height, thickness)
    if _worth(judged) == 0:
        return None
    layer = max(_LAYER * spread, _THINNEST / _THICKNESS * thickness)
    return dataclasses.replace(judged, layer=layer, tilt=tilt)
