"""A grid cut into slabs, one for each device, with the particles in them."""

import math
from typing import final

import equinox as eqx
import jax
import numpy as np

from pgjax._types import Array, Float, concrete, whole_numbers
from pgjax.grid import PAD, Grid
from pgjax.parallel.layout import Places
from pgjax.parallel.plan import AbstractLayout
from pgjax.parallel.slab import SlabPlan, layer_of
from pgjax.scene import Scene
from pgjax.state import State

# Room for particles over that of the fullest slab at the start.
_ROOM = 1.5


@final
class Slabs(AbstractLayout):
    """Each device has a slab of the grid and the particles in it; neighbours exchange layers.

    A step communicates the layers that two neighbours have in common, and the particles that
    change over. The halo reaches `margin` + 1 cells beyond a slab: as far a particle may have
    moved since it was last looked at. One that is farther, because it moved faster or because
    there was no place for it, is masked and counted: OVERFLOW.

    Args:
        axis: the direction that is cut; the longest one of the grid if None.
        starts: the first cell of each slab but the first, increasing. If None, slabs that hold
            equally many particles at the start, or equally wide ones while positions are traced.
        capacity: places for particles on each device: one number per material, or one for each of
            them. If None, half as many again as the fullest slab has at the start, or all of them
            while positions are traced. An empty place costs as much time as a particle.
        margin: cells, at least 0.
        every: steps after which particles may change over, at least 1.
    """

    axis: int | None = eqx.field(default=None, static=True)
    starts: tuple[int, ...] | None = eqx.field(
        default=None,
        converter=lambda a: None if a is None else whole_numbers("starts", a),
        static=True,
    )
    capacity: int | tuple[int, ...] | None = eqx.field(
        default=None,
        converter=lambda a: a if a is None or isinstance(a, int) else whole_numbers("capacity", a),
        static=True,
    )
    margin: int = eqx.field(default=0, static=True)
    every: int = eqx.field(default=1, static=True)

    def __check_init__(self):
        for name, least in (("margin", 0), ("every", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(
                    f"Argument `{name}` must be a whole number ≥ {least}, but is {value!r}."
                )

    def planned(self, scene: Scene, state: State, devices: int) -> "SlabPlan":
        """Where the cuts are and how many places there are."""
        axis = self._axis(scene.grid)
        cells = scene.grid.shape[axis]
        layers = _layers(scene.grid, axis, state.position)
        narrowest = 2 * (self.margin + PAD) + 1
        edges = self._edges(cells, devices, layers, narrowest)
        found = None if layers is None else _fullest(layers, edges, scene.slices)
        sizes = self._sizes(scene.counts, found)
        places = Places(devices, scene.counts, sizes)
        closed = scene.grid.periodic[axis]
        return SlabPlan(places, axis, edges, closed, self.margin, self.every)

    def _axis(self, grid: Grid) -> int:
        if self.axis is None:
            return int(np.argmax(grid.shape))
        if self.axis not in range(grid.dimension):
            raise ValueError(
                f"Argument `axis` must be a direction from 0 to {grid.dimension - 1}, but is "
                f"{self.axis!r}."
            )
        return self.axis

    def _edges(
        self, cells: int, devices: int, layers: np.ndarray | None, narrowest: int
    ) -> tuple[int, ...]:
        """The first cell of each slab, and the number of cells."""
        if devices * narrowest > cells:
            raise ValueError(
                f"Argument `devices` must be at most {cells // narrowest} for slabs of at least "
                f"{narrowest} cells across {cells} cells, but are {devices}: choose another "
                f"`axis`, fewer devices or a smaller `margin`."
            )
        if self.starts is None:
            weights = None if layers is None else np.bincount(layers, minlength=cells)
            return _balanced(cells, devices, weights, narrowest)
        edges = (0, *self.starts, cells)
        if len(edges) != devices + 1 or min(np.diff(edges)) < narrowest:
            raise ValueError(
                f"Argument `starts` must hold {devices - 1} cells that make slabs of at least "
                f"{narrowest} cells across {cells}, but is {self.starts}."
            )
        return edges

    def _sizes(self, counts: tuple[int, ...], found: tuple[int, ...] | None) -> tuple[int, ...]:
        """Places for each material."""
        if self.capacity is None:
            wanted = counts if found is None else [math.ceil(_ROOM * n) for n in found]
            return tuple(min(size, n) for size, n in zip(wanted, counts, strict=True))
        given = self.capacity
        wanted = (given,) * len(counts) if isinstance(given, int) else given
        least = (1,) * len(counts) if found is None else found
        if len(wanted) != len(counts) or any(w < n for w, n in zip(wanted, least, strict=True)):
            raise ValueError(
                f"Argument `capacity` must be at least {least}, the particles of each material in "
                f"the fullest slab at the start, but is {given}."
            )
        return tuple(min(size, n) for size, n in zip(wanted, counts, strict=True))


def _layers(grid: Grid, axis: int, position: Float[Array, "p d"]) -> np.ndarray | None:
    """The layer of cells of each particle; None while positions are being traced."""
    if concrete(position) is None or concrete(grid.h) is None:
        return None
    return np.asarray(layer_of(jax.vmap(grid.cells)(position)[:, axis], grid.shape[axis]))


def _balanced(
    cells: int, devices: int, weights: np.ndarray | None, narrowest: int
) -> tuple[int, ...]:
    """Cuts between equally many particles, as near as whole layers and the narrowest slab allow."""
    weights = np.ones(cells) if weights is None else weights
    below = np.concatenate([[0], np.cumsum(weights)])
    edges = [0]
    for k in range(1, devices):
        ideal = int(np.argmin(np.abs(below - below[-1] * k / devices)))
        low, high = edges[-1] + narrowest, cells - (devices - k) * narrowest
        edges.append(min(max(ideal, low), high))
    return (*edges, cells)


def _fullest(
    layers: np.ndarray, edges: tuple[int, ...], slices: tuple[slice, ...]
) -> tuple[int, ...]:
    """The largest number of particles of each material in a slab."""
    slabs = np.searchsorted(edges[1:-1], layers, side="right")
    return tuple(int(np.bincount(slabs[part], minlength=1).max(initial=0)) for part in slices)
