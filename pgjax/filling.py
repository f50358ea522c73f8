"""Interior particles of a body of which only the surface was captured, and the volumes of all.

The surface is known by scattered Gaussians. A ball of diameter `seal` is rolled over it from the
outside: what the ball cannot reach is inside, so that gaps between the Gaussians and holes narrower
than `seal` are closed, while an open cup stays open. All is computed on a grid of its own, with
cells of the wanted particle distance.
"""

import warnings
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from pgjax import _surface
from pgjax._surface import Lattice
from pgjax._types import require
from pgjax.sampling import neighbour_volumes


@final
@dataclass(frozen=True)
class FillReport:
    """What `fill` found.

    Attributes:
        spacing: edge of a cell, m.
        seal: width of the holes that were closed, m.
        cells: number of cells of the grid.
        bodies: closed bodies, each one connected.
        volume: what they enclose, m³.
        caps: holes that were closed without any Gaussian near (a missing underside is one).
        filled: interior particles.
        surface: Gaussians that carry a share of the enclosed volume.
        loose: Gaussians that belong to no body: sheets, open shells, floaters.
        broken: Gaussians whose covariance is not finite; they count as points.
    """

    spacing: float
    seal: float
    cells: int
    bodies: int
    volume: float
    caps: int
    filled: int
    surface: int
    loose: int
    broken: int

    def __str__(self) -> str:
        return (
            f"{self.bodies} closed bodies of {self.volume:.4g} m³: {self.filled} particles inside, "
            f"{self.surface} Gaussians on them, {self.loose} on open sheets or loose; "
            f"{self.caps} holes closed (seal {self.seal:.3g} m), {self.cells} cells of "
            f"{self.spacing:.3g} m"
        )


@final
@dataclass(frozen=True)
class Filled:
    """Interior particles, and the rest volumes of all particles.

    Attributes:
        points: interior particles, `(m, 3)`, m.
        nearest: index of the Gaussian nearest to each of them, to within two spacings, `(m,)`.
        volumes: rest volumes of the n Gaussians, then of the m points, `(n + m,)`, m³; positive.
            Those of the points and of the Gaussians that are not loose add up to `report.volume`.
        loose: whether a Gaussian belongs to no closed body, `(n,)`.
        report: counts.
    """

    points: np.ndarray
    nearest: np.ndarray
    volumes: np.ndarray
    loose: np.ndarray
    report: FillReport


def fill(
    means: Any,
    covariances: Any,
    opacities: Any,
    *,
    spacing: float,
    seal: float | None = None,
    seed: int = 0,
    max_particles: int = 2_000_000,
) -> Filled:
    """Fill the closed bodies among captured Gaussians with particles, and give all their volumes.

    A surface that encloses nothing (an open cup of a single wall, a cloth) stays a sheet; a cup
    whose wall has two faces has its wall filled if these are at least three spacings apart, and
    twice the distance of a Gaussian to its sixth neighbour.

    One jittered particle is put into each cell that lies wholly inside and holds no Gaussian. The
    volume of the other cells, cut by the surface where they are, goes to the Gaussians in them.
    Loose Gaussians get `sampling.neighbour_volumes`: a layer as thick as their distance.

    Gaussians that are nearly transparent should be left out by the caller.

    Args:
        means: centres, `(n, 3)`, m.
        covariances: `(n, 3, 3)`, m². Those that are not finite count as points, with a warning.
        opacities: in [0, 1], `(n,)`: the weight of a Gaussian in the place of the surface.
        spacing: wanted distance of the particles, m.
        seal: holes narrower than this are closed, m; by default the gaps between the Gaussians
            themselves. The cap over a hole of width w sags inwards by
            `(seal − √(seal² − w²))/2`, and clefts narrower than `seal` may fill up.
        seed: of the jitter. The same seed gives the same points, bit by bit.
        max_particles: most interior particles to allow.

    Raises:
        ValueError: bad input; a spacing too fine for 2²³ cells or `max_particles`.
    """
    means, covariances, opacities, broken = _checked(means, covariances, opacities)
    require("spacing", spacing, "be positive and finite (m)", lambda a: (a > 0) & np.isfinite(a))
    lattice = _surface.lattice(means, float(spacing), 0.0)
    elements = _surface.elements(means, covariances, opacities, lattice)
    if seal is None:
        seal = max(2 * lattice.h, _surface.GAP * elements.distance)
    require("seal", seal, "be positive and finite (m)", lambda a: (a > 0) & np.isfinite(a))
    # Cells are found to be outside by their centres: half a cell more closes what lies between.
    radius = max(seal / 2, lattice.h) + lattice.h / 2
    margin = radius + 1.2 * _surface.widest_disc(elements, radius)
    lattice = _surface.lattice(means, lattice.h, margin)
    near, depth = _surface.closing(means, covariances, elements, lattice, radius)
    fraction = _surface.fractions(elements, near, depth, lattice, radius)
    fraction, bodies = _surface.drop_stray(fraction, depth, max(lattice.h / 2, elements.distance))
    far = max(2 * lattice.h, _surface.GAP / 2 * elements.distance)
    caps = _surface.count_caps(fraction, near, far)
    volumes, loose, empty = _share(means, fraction, lattice)
    if len(empty) > max_particles:
        raise ValueError(
            f"Argument `spacing` must give at most `max_particles` = {max_particles} interior "
            f"particles, but {spacing} gives {len(empty)}: raise `spacing` or `max_particles`."
        )
    # Such a cell lies deeper than h/2 at its centre; a shift below h/2 keeps its particle inside.
    jitter = np.random.default_rng(seed).uniform(-0.25, 0.25, (len(empty), 3))
    points = lattice.centers(empty) + lattice.h * jitter
    nearest = _nearest(means, empty, lattice)
    report = FillReport(
        spacing=lattice.h,
        seal=float(seal),
        cells=fraction.size,
        bodies=bodies,
        volume=float(fraction.sum() * lattice.h**3),
        caps=caps,
        filled=len(points),
        surface=int(np.count_nonzero(~loose)),
        loose=int(np.count_nonzero(loose)),
        broken=broken,
    )
    inside = fraction.reshape(-1)[empty] * lattice.h**3
    return Filled(points, nearest, np.concatenate([volumes, inside]), loose, report)


def _checked(
    means: Any, covariances: Any, opacities: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The arrays in double precision, broken covariances zero, and how many these were."""
    x, A = np.asarray(means, np.float64), np.array(covariances, np.float64)
    weights = np.asarray(opacities, np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) == 0:
        raise ValueError(
            f"Argument `means` must have shape (n, 3) with n ≥ 1, but has shape {x.shape}."
        )
    for name, array, shape in [
        ("covariances", A, (len(x), 3, 3)),
        ("opacities", weights, (len(x),)),
    ]:
        if array.shape != shape:
            raise ValueError(
                f"Argument `{name}` must have shape {shape} for {len(x)} means, "
                f"but has shape {array.shape}."
            )
    require("means", x, "be finite", np.isfinite)
    require("opacities", weights, "be in [0, 1]", lambda a: (a >= 0) & (a <= 1 + 1e-6))
    finite = np.all(np.isfinite(A), axis=(1, 2))
    broken = int(np.count_nonzero(~finite))
    if broken:
        A[~finite] = 0
        warnings.warn(
            f"{broken} of {len(x)} covariances are not finite; their Gaussians count as points.",
            stacklevel=3,
        )
    return x, A, np.maximum(weights, 1e-3), broken


def _nearest(means: np.ndarray, cells: np.ndarray, lattice: Lattice) -> np.ndarray:
    """For each cell a Gaussian of the nearest cell that holds one."""
    held = np.full(lattice.shape, -1, np.int32)
    held.reshape(-1)[lattice.flat_index(means)] = np.arange(len(means))
    place: Any = ndimage.distance_transform_edt(
        held < 0, return_distances=False, return_indices=True
    )
    return held[tuple(axis.reshape(-1)[cells] for axis in place)].astype(np.int64)


def _share(
    means: np.ndarray, fraction: np.ndarray, lattice: Lattice
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Volumes of the Gaussians, which of them are loose, and the full cells left for particles.

    Each Gaussian takes part in the nearest cell that is inside by a quarter at least, if one is
    within √3 cells; a cell that is cut and has no Gaussian goes to the nearest of them.
    """
    flat = fraction.reshape(-1)
    owner = lattice.flat_index(means)
    strays = np.flatnonzero(flat[owner] < 0.25)
    solid = np.flatnonzero(flat >= 0.25)
    loose = np.zeros(len(means), bool)
    if len(solid) == 0:
        loose[:] = True
    elif len(strays):
        limit = 3**0.5 * lattice.h
        found: Any = KDTree(lattice.centers(solid)).query(means[strays], distance_upper_bound=limit)
        away, cell = found
        loose[strays] = ~np.isfinite(away)
        owner[strays[~loose[strays]]] = solid[cell[~loose[strays]]]
    bound = np.flatnonzero(~loose)
    cells = np.bincount(owner[bound], minlength=flat.size)
    volumes = np.zeros(len(means))
    volumes[bound] = flat[owner[bound]] / cells[owner[bound]] * lattice.h**3
    unclaimed = (flat > 0) & (cells == 0)
    empty, cut = np.flatnonzero(unclaimed & (flat == 1)), np.flatnonzero(unclaimed & (flat < 1))
    if len(bound) and len(cut):
        heir = bound[KDTree(means[bound]).query(lattice.centers(cut))[1]]
        np.add.at(volumes, heir, flat[cut] * lattice.h**3)
    volumes[loose] = _loose_volumes(means[loose], lattice.h)
    return volumes, loose, empty


def _loose_volumes(x: np.ndarray, h: float) -> np.ndarray:
    """A layer as thick as the distance of the points; h³ together if they are at one place."""
    if len(x) < 2 or np.all(x == x[0]):
        return np.full(len(x), h**3 / max(len(x), 1))
    return neighbour_volumes(x)
