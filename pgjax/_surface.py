"""The surface of a captured body: which cells of a grid are inside, and by what part.

A ball is rolled over the Gaussians from the outside (a morphological closing). What it cannot reach
is inside, which tells on which side of each surface element the body lies; the tangent planes of
the elements then place the surface to a fraction of a cell.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

_BUDGET = 1 << 23  # cells of the grid; its working memory is about 60 bytes for each of them
_NEIGHBOURS = 10  # surface elements that define a normal
_TANGENTS = 6  # tangent planes that place the surface in a cell
GAP = 2.5  # the widest gap among scattered points, in distances to the 6th neighbour
_DISC = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if 0 < i * i + j * j < 6]


class Lattice(NamedTuple):
    """Cells of edge `h`; the centre of cell i is `origin + i h`."""

    origin: np.ndarray
    h: float
    shape: tuple[int, int, int]

    def flat_index(self, x: np.ndarray) -> np.ndarray:
        """Flat index of the cell nearest to each point."""
        cell = np.rint((x - self.origin) / self.h).astype(np.int64)
        return np.asarray(np.ravel_multi_index(tuple(cell.T), self.shape, mode="clip"))

    def centers(self, flat: np.ndarray) -> np.ndarray:
        """Centres of the cells of given flat index."""
        return self.origin + self.h * np.stack(np.unravel_index(flat, self.shape), axis=-1)


class Elements(NamedTuple):
    """Elements of surface, each the mean of the Gaussians within half a cell."""

    x: np.ndarray
    A: np.ndarray  # second moments: disc covariances and scatter of the centres
    reach: np.ndarray  # distance to the 6th neighbour
    distance: float  # what 90 % of these are below
    tree: KDTree


def lattice(means: np.ndarray, h: float, margin: float) -> Lattice:
    """The grid around the means that leaves room for the outside; refused if it is too large."""
    low, high = means.min(axis=0), means.max(axis=0)
    with np.errstate(over="ignore"):
        counts = np.ceil((high - low) / h + 2 * (margin / h + 3))
        excess = np.prod(np.cbrt(counts / _BUDGET ** (1 / 3)))  # the product itself may overflow
    if not excess <= 1:
        coarser = 1.05 * h * excess
        raise ValueError(
            f"Argument `spacing` must be about {coarser:.3g} or more for Gaussians that extend "
            f"over {high - low} m, with {margin:.3g} m around them that `seal` needs (at most "
            f"{_BUDGET} cells), but is {h}. Remove floaters far away, or raise `spacing`."
        )
    shape = tuple(int(c) for c in counts)
    origin = (low + high) / 2 - (counts - 1) / 2 * h
    return Lattice(origin, h, (shape[0], shape[1], shape[2]))


def elements(
    means: np.ndarray, covariances: np.ndarray, weights: np.ndarray, lattice: Lattice
) -> Elements:
    """Gaussians merged within half a cell: mean and second moment of each mixture."""
    half = np.floor((means - lattice.origin) / (lattice.h / 2)).astype(np.int64)
    _, group = np.unique(
        np.ravel_multi_index(tuple(half.T), tuple(2 * n for n in lattice.shape), mode="clip"),
        return_inverse=True,
    )
    total = np.bincount(group, weights)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, weights * values) / total

    x = np.stack([mean(means[:, i]) for i in range(3)], axis=-1)
    tree = KDTree(x)
    k = min(6, len(x) - 1)
    reach = tree.query(x, k=k + 1, workers=-1)[0][:, -1] if k else np.full(1, lattice.h)
    # A disc wider than the distance of the neighbours says nothing about the surface here.
    bounded = _bounded(covariances, reach[group] ** 2)
    shift = means - x[group]
    A = np.empty((len(x), 3, 3))
    for i in range(3):
        for j in range(3):
            A[:, i, j] = mean(bounded[:, i, j] + shift[:, i] * shift[:, j])
    reach = np.maximum(reach, 1e-3 * lattice.h)
    return Elements(x, A, reach, float(np.quantile(reach, 0.9)), tree)


def _bounded(A: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Covariances with eigenvalues in `[0, largest]`."""
    wide = np.flatnonzero(np.trace(A, axis1=1, axis2=2) > largest)
    bounded = A.copy()
    values, vectors = np.linalg.eigh((A[wide] + np.swapaxes(A[wide], 1, 2)) / 2)
    values = np.clip(values, 0, largest[wide, None])
    bounded[wide] = np.einsum("nij,nj,nkj->nik", vectors, values, vectors)
    return bounded


def closing(
    means: np.ndarray,
    covariances: np.ndarray,
    elements: Elements,
    lattice: Lattice,
    radius: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each cell to the surface, and its depth below the reach of the rolling ball.

    The ball's centre may go where the distance to the surface exceeds its radius, if a way leads
    there from the edge of the grid. `depth` is the distance from there less the radius: zero on
    a surface, positive inside, and `−radius` where the centre may go.
    """
    surface = np.zeros(lattice.shape, bool)
    surface.reshape(-1)[lattice.flat_index(means)] = True
    _mark_discs(surface, means, covariances, elements, lattice, radius)
    near = _distance(~surface, lattice.h)
    free, _ = _labelled(near > radius)
    outside = free == free[0, 0, 0]  # the margin keeps the corner free
    # Centres of cells stop half a cell short of the radius on average.
    depth = _distance(~outside, lattice.h) - radius - lattice.h / 2 * ~outside
    return near, depth


def _labelled(mask: np.ndarray, neighbours: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    """Connected components of a mask, numbered from 1, and their number."""
    result: Any = ndimage.label(mask, neighbours)
    return result


def _distance(mask: np.ndarray, h: float) -> np.ndarray:
    """Distance from each cell of the mask to the nearest cell that is not in it."""
    distance: Any = ndimage.distance_transform_edt(mask, sampling=h)
    return distance.astype(np.float32)


def _mark_discs(
    surface: np.ndarray,
    means: np.ndarray,
    covariances: np.ndarray,
    elements: Elements,
    lattice: Lattice,
    radius: float,
) -> None:
    """Mark the cells under discs wider than a cell, out to √(5/4) standard deviations.

    Standard deviations are bounded by the distance to the neighbours, here and in general, and by
    the ball's radius: the samples, half of one apart, leave no gap that the ball could pass.
    """
    wide = np.flatnonzero(np.trace(covariances, axis1=1, axis2=2) > lattice.h**2)
    if len(wide) == 0:
        return
    A = covariances[wide]
    values, vectors = np.linalg.eigh((A + np.swapaxes(A, 1, 2)) / 2)
    reach = elements.reach[elements.tree.query(means[wide])[1]]
    widest = widest_disc(elements, radius)
    sigma = np.minimum(np.sqrt(np.maximum(values, 0)), np.minimum(reach, widest)[:, None])
    long, middle = (sigma[:, None, i] * vectors[:, :, i] for i in (2, 1))
    for a, b in _DISC:
        surface.reshape(-1)[lattice.flat_index(means[wide] + (a * long + b * middle) / 2)] = True


def widest_disc(elements: Elements, radius: float) -> float:
    """Bound of the standard deviations with which discs are marked."""
    return min(GAP / 2 * elements.distance, radius)


def _normals(elements: Elements, depth: np.ndarray, lattice: Lattice) -> np.ndarray:
    """Outward unit normals of the elements; zero where both sides are alike (sheets, floaters).

    The normal is the axis of the smallest second moment of an element and its neighbours; it
    points to where the depth falls.
    """
    k = min(_NEIGHBOURS, len(elements.x))
    member = elements.tree.query(elements.x, k=k, workers=-1)[1].reshape(len(elements.x), k)
    normals = np.empty_like(elements.x)
    for part in np.array_split(np.arange(len(member)), 1 + len(member) // 100_000):
        y = elements.x[member[part]]
        y = y - y.mean(axis=1, keepdims=True)
        moments = elements.A[member[part]].sum(axis=1) + np.einsum("nki,nkj->nij", y, y)
        normals[part] = np.linalg.eigh(moments)[1][:, :, 0]

    def depth_at(x: np.ndarray) -> np.ndarray:
        place = (x - lattice.origin) / lattice.h
        return ndimage.map_coordinates(depth, place.T, order=1, mode="nearest")

    step = lattice.h * normals
    fall = depth_at(elements.x - step) - depth_at(elements.x + step)
    clear = np.abs(fall) > lattice.h
    return normals * (np.sign(fall) * clear)[:, None]


def fractions(
    elements: Elements, near: np.ndarray, depth: np.ndarray, lattice: Lattice, radius: float
) -> np.ndarray:
    """The part of each cell that is inside, in [0, 1].

    With the signed distance φ of a cell's centre it is `1/2 − φ/h`, which a plane of any place
    makes exact on average. φ comes from the tangent planes where the surface is near, and from
    the depth below the rolling ball elsewhere (under caps, and deep inside).
    """
    h = lattice.h
    fraction = np.clip(0.5 + depth / h, 0, 1)
    # The ball sinks into gaps, but never by more than this: farther out all is outside.
    sag = max(1.5 * h, elements.distance / 2)
    uncertain = np.flatnonzero((near <= max(2 * h, radius)) & (depth > -sag))
    normals = _normals(elements, depth, lattice)
    flat, flat_near, flat_depth = (a.reshape(-1) for a in (fraction, near, depth))
    for part in _pieces(uncertain[flat_near[uncertain] <= 2 * h]) + _pieces(
        uncertain[flat_near[uncertain] > 2 * h]
    ):
        # Far from the surface only the sign matters, and nearly the nearest elements give it.
        slack = 0.0 if flat_near[part[0]] <= 2 * h else 0.5
        phi, sided, aligned = _signed_distance(elements, normals, lattice.centers(part), h, slack)
        tangent = sided & (aligned | (flat_near[part] <= h))
        # Where the surface has no sides only what lies well below it is inside.
        blunt = ~sided & (flat_depth[part] < h)
        flat[part] = np.where(tangent, np.clip(0.5 - phi / h, 0, 1), flat[part] * ~blunt)
    return fraction


def _pieces(index: np.ndarray) -> list[np.ndarray]:
    """An array in pieces of bounded size, none of them empty."""
    return [p for p in np.array_split(index, 1 + len(index) // 200_000) if len(p)]


def _signed_distance(
    elements: Elements, normals: np.ndarray, c: np.ndarray, h: float, slack: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance of points c (positive outside) from the tangent planes next to them.

    `φ = ½ Σ w n_j·(c − x_j)/Σ w + ½ n̄·(c − x̄)`: on a curved surface the planes lie outside it and
    the mean of the elements lies inside, by the same amount.

    Returns:
        φ, whether most of the elements have an outside, and whether c lies along their normals
        rather than beside the edge of a hole.
    """
    k = min(_TANGENTS, len(elements.x))
    distance, member = (
        a.reshape(len(c), k) for a in elements.tree.query(c, k=k, eps=slack, workers=-1)
    )
    width = np.maximum(distance[:, -1:], h) / 1.5
    w = np.exp(-((distance - distance[:, :1]) ** 2) / (2 * width**2))
    n, x = normals[member], elements.x[member]
    sided = w * np.any(n != 0, axis=-1)
    total = np.maximum(sided.sum(axis=1), 1e-300)
    planes = np.einsum("nk,nki,nki->n", sided, n, c[:, None] - x) / total
    normal = np.einsum("nk,nki->ni", sided, n)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    apart = c - np.einsum("nk,nki->ni", sided, x) / total[:, None]
    along = np.einsum("ni,ni->n", normal, apart)
    aligned = np.abs(along) > 0.5 * np.linalg.norm(apart, axis=1)
    return (planes + along) / 2, sided.sum(axis=1) > 0.5 * w.sum(axis=1), aligned


def drop_stray(fraction: np.ndarray, depth: np.ndarray, deep: float) -> tuple[np.ndarray, int]:
    """Keep the bodies that reach deeper than `deep` somewhere, and the cells that they cut.

    What is thinner is a sheet whose Gaussians scatter.
    """
    label, count = _labelled(fraction > 0.5)
    thick = np.zeros(count + 1, bool)
    thick[label[(fraction == 1) & (depth > deep)]] = True
    thick[0] = False
    kept = thick[label]
    beside: Any = ndimage.binary_dilation(kept, np.ones((3, 3, 3), bool))
    return np.where(kept | (beside & (fraction <= 0.5)), fraction, 0), int(thick.sum())


def count_caps(fraction: np.ndarray, near: np.ndarray, far: float) -> int:
    """Connected pieces of the boundary of the inside that are `far` from every Gaussian."""
    inside = fraction > 0.5
    core: Any = ndimage.binary_erosion(inside)
    boundary = inside & ~core
    bare = boundary & (near > far)
    return _labelled(bare, np.ones((3, 3, 3), int))[1]
