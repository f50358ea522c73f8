"""Where the object of a capture stands in its scene, how fine it is simulated, from where seen."""

from typing import NamedTuple

import numpy as np

from pgjax.render import Gaussians, Similarity, measure_axes, split_long
from pgjax.scenes.capture import upright
from pgjax.scenes.inspect import Findings

NEEDLE = 0.5
"""Standard deviation in spacings of the grid above which a Gaussian is split."""

# Longest side of the object, m; captures have no units.
_SIZE = 1.0
# Gaussians in a cell that holds any; spacing in sizes of the object, at least and at most.
_PER_CELL, _FINEST, _COARSEST = 8, 1 / 48, 1 / 16
# Room around the object, in its size: to the sides, above it. It hovers no higher than that.
_BESIDE, _OVER, _HIGHEST = 0.5, 0.3, 3.0
# Needles are worth splitting if there is this part of them, and if that leaves so few particles.
_MANY_NEEDLES, _MOST_PARTICLES = 0.02, 200_000
# What begins below so many layers of the ground stands on it.
_STANDING = 1.5
# Variance along over that across, above which an object has a broad side.
_BROAD = 1.7


class Choices(NamedTuple):
    """What the scene file says; lengths in m of the simulation.

    Attributes:
        size: longest side of the object.
        hover: height of its foot above the ground.
        floor: height of the floor above the ground: under the foot if that was cut off the ground.
        half: half of its extents in x and y, and its height, `(3,)`.
        reach: the corners of what its particles take, long Gaussians split, over its foot `(2, 3)`.
        spacing: of the grid.
        per_cell: Gaussians in a cell that holds any, on average.
        needles: part of the Gaussians that are longer than `NEEDLE` spacings.
        split: whether they are split.
        fill: whether the inside is filled.
        azimuth: from where the object is seen, degrees.
    """

    size: float
    hover: float
    floor: float
    half: np.ndarray
    reach: np.ndarray
    spacing: float
    per_cell: float
    needles: float
    split: bool
    fill: bool
    azimuth: float

    @property
    def lower(self) -> np.ndarray:
        """Lower corner of the grid."""
        x, y, z = self.reach[0] - [_BESIDE * self.size, _BESIDE * self.size, 4 * self.spacing]
        return np.array([x, y, min(z + self.hover, -4 * self.spacing)])

    @property
    def upper(self) -> np.ndarray:
        """Upper corner of the grid."""
        room = self.size * np.array([_BESIDE, _BESIDE, _OVER])
        return self.reach[1] + room + [0, 0, self.hover]


def chosen(findings: Findings, gaussians: Gaussians) -> tuple[Choices, Gaussians]:
    """Where the object stands and how fine it is simulated; and its Gaussians placed there."""
    x = np.asarray(gaussians.means, np.float64)[findings.moves]
    rotation = upright(findings.up)
    turned = x @ rotation.T
    lower, upper = turned.min(axis=0), turned.max(axis=0)
    extent = upper - lower
    if not extent.max() > 0:
        raise ValueError("The object must not have all its Gaussians at one place.")
    scale = _SIZE / float(extent.max())
    foot = np.array([*(lower + upper)[:2] / 2, lower[2]])
    moving = gaussians[findings.moves].transformed(Similarity(scale, rotation, -scale * foot))
    half = scale * extent * np.array([0.5, 0.5, 1])
    hover = _rounded(min(scale * findings.clearance, _HIGHEST * _SIZE))
    layer = 0.0 if findings.ground is None else findings.ground.layer
    choices = Choices(
        size=_SIZE,
        hover=hover,
        floor=hover if findings.clearance <= _STANDING * layer else 0.0,
        half=half,
        reach=np.zeros((2, 3)),
        spacing=0.0,
        per_cell=0.0,
        needles=0.0,
        split=False,
        fill=True,
        azimuth=_azimuth(np.asarray(moving.means, np.float64)),
    )
    return with_spacing(choices, moving, _spacing(np.asarray(moving.means, np.float64))), moving


def _rounded(value: float) -> float:
    """Three digits."""
    return float(f"{value:.3g}")


def _spacing(x: np.ndarray) -> float:
    """The finest spacing at which a cell that holds any Gaussians holds enough of them."""
    for spacing in np.geomspace(_FINEST * _SIZE, _COARSEST * _SIZE, 24):
        if _occupancy(x, spacing) >= _PER_CELL:
            return float(spacing)
    return _COARSEST * _SIZE


def _occupancy(x: np.ndarray, spacing: float) -> float:
    cells = np.unique(np.floor(x / spacing).astype(np.int64), axis=0)
    return len(x) / len(cells)


def with_spacing(choices: Choices, moving: Gaussians, spacing: float) -> Choices:
    """The same at another spacing, of which it depends what is a needle."""
    spacing = float(f"{spacing:.2g}")
    needles = measure_axes(moving, NEEDLE * spacing).long / len(moving)
    split, parts = needles > _MANY_NEEDLES, moving
    if split:
        try:
            most = max(_MOST_PARTICLES, len(moving))
            parts, _ = split_long(moving, NEEDLE * spacing, max_gaussians=most)
        except ValueError:
            split = False
    x = np.asarray(parts.means, np.float64)
    reach = np.stack([x.min(axis=0), x.max(axis=0)])
    per_cell = _occupancy(np.asarray(moving.means, np.float64), spacing)
    return choices._replace(
        spacing=spacing, needles=needles, split=split, per_cell=per_cell, reach=reach
    )


def _azimuth(x: np.ndarray) -> float:
    """From where the broad side of the object is seen, on the side captures are often taken from.

    That is the side of −y of the simulation, which is −z of a capture with y down.
    """
    values, vectors = np.linalg.eigh(np.cov(x[:, :2].T))
    if values[1] < _BROAD * max(values[0], 0):
        return -60.0
    thin = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    # Of the two ends of the thin direction the one nearer to the usual view, and a little aside.
    near = min((thin, thin + 180), key=lambda a: abs((a + 60 + 180) % 360 - 180))
    return float(np.round((near + 20 + 180) % 360 - 180))
