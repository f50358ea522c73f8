"""Particles of a spacing of their own: Gaussians are merged and cut up to be of that size."""

import dataclasses

import numpy as np

from pgjax.scenes.carriage import Carriage
from pgjax.scenes.crowd import Crowd
from pgjax.scenes.schema import GridPart

# Pieces no longer than this part of a spacing are put together again: particles are about alike.
_PIECE = 0.6
# Pieces of a scene that would fill the memory are not made.
_MOST = 40_000_000
_EIGHT = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) / 4


def merged(
    crowd: Crowd, counts: tuple[int, ...], grid: GridPart
) -> tuple[Crowd, tuple[int, ...], Carriage, str]:
    """Particles of the spacing s that the grid asks for, and how they carry the Gaussians.

    A Gaussian is a cube of its rest volume. Cubes longer than 0.6 s are cut into eight, again and
    again; all of a material and a model in one cell of a lattice of spacing s, which begins at the
    corner of the grid, become one particle: it has the sum of their volumes, is in the centre of
    it, and has the row of the Gaussian that has a piece nearest to its centre.

    Args:
        crowd: a particle for each Gaussian, in the order of the materials.
        counts: how many each material owns.
        grid: of the scene file; its `particle_spacing` is given.

    Returns:
        The new particles in the order of the materials, how many each owns, how they carry the
        Gaussians, and what was done, in words.

    Raises:
        ValueError: the spacing is too small for as much volume.
    """
    assert grid.particle_spacing is not None
    s = grid.particle_spacing * grid.spacing
    owner = np.repeat(np.arange(len(counts)), counts)
    source, x, volumes = _pieces(crowd.x.astype(np.float64), crowd.volumes, s)
    kind = _numbers(np.stack([owner, crowd.body], axis=1))
    cell = np.floor((x - np.asarray(grid.lower)) / s).astype(np.int64)
    index = _numbers(np.column_stack([owner[source], crowd.body[source], cell]))
    total = np.bincount(index, volumes)
    weighted = [np.bincount(index, volumes * x[:, axis]) for axis in range(3)]
    center = np.stack(weighted, axis=1) / total[:, None]
    nearest = source[_first(index, np.sum((x - center[index]) ** 2, axis=1))]
    made = dataclasses.replace(
        crowd, x=center, rows=crowd.rows[nearest], body=crowd.body[nearest], volumes=total
    )
    owned = np.bincount(owner[nearest], minlength=len(counts))
    carriage = Carriage.between(crowd.x.astype(np.float64), center, (kind, kind[nearest]), reach=s)
    note = f"particles: {len(crowd.x)} Gaussians are carried by {len(total)} particles of {s:.4g} m"
    return made, tuple(int(n) for n in owned), carriage, note


def _pieces(
    x: np.ndarray, volumes: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cubes cut up until they are short enough: of which Gaussian each is, centre, volume."""
    side = np.cbrt(volumes)
    times = np.maximum(np.ceil(np.log2(side / (_PIECE * spacing)) - 1e-9), 0)
    count = float(np.sum(8.0**times))
    if not count <= _MOST:
        raise ValueError(
            f"Argument `particle_spacing` must not cut the Gaussians into more than {_MOST} "
            f"pieces, but particles of {spacing:.3g} m take {count:.3g}."
        )
    source = np.arange(len(x))
    for level in range(int(times.max(initial=0))):
        big = times[source] > level
        a = side[source[big]] / 2**level
        eight = x[big][:, None] + a[:, None, None] * _EIGHT
        x = np.concatenate([x[~big], eight.reshape(-1, 3)])
        source = np.concatenate([source[~big], np.repeat(source[big], 8)])
    return source, x, volumes[source] / 8.0 ** times[source]


def _numbers(rows: np.ndarray) -> np.ndarray:
    """A number for each different row, in their lexical order, `(n,)`."""
    low = rows.min(axis=0)
    shape = tuple(int(n) for n in rows.max(axis=0) - low + 1)
    flat = np.ravel_multi_index(tuple((rows - low).T), shape)
    return np.unique(flat, return_inverse=True)[1]


def _first(index: np.ndarray, value: np.ndarray) -> np.ndarray:
    """For each number in `index` (0, 1 …) the place of its smallest value."""
    order = np.lexsort((value, index))
    return order[np.searchsorted(index[order], np.arange(index.max() + 1))]
