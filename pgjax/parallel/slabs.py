"""A grid cut into slabs, one for each device, with the particles in them."""

import math
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._across import AXIS
from pgjax._types import Array, Bool, Float, Int, concrete, whole_numbers
from pgjax.exchange import is_finite
from pgjax.grid import PAD, Grid
from pgjax.parallel.layout import Parts, Places
from pgjax.parallel.migration import migrated
from pgjax.parallel.neighbours import Row
from pgjax.parallel.plan import AbstractLayout, AbstractPlan
from pgjax.result import Condition
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.transfer import Stencil

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
    return np.asarray(_layer_of(jax.vmap(grid.cells)(position)[:, axis], grid.shape[axis]))


def _layer_of(cells: Float[Array, " p"], count: int) -> Int[Array, " p"]:
    """The layer of cells, at the edge of the grid for what is outside or not finite."""
    cells = jnp.where(jnp.isfinite(cells), cells, 0)
    return jnp.clip(jnp.floor(cells), 0, count - 1).astype(jnp.int32)


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


@final
class SlabPlan(AbstractPlan):
    """A grid cut into slabs.

    The nodes of a device are those of its slab and `reach` layers on either side, in an array that
    is as long as that of the widest slab.
    """

    places: Places = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    edges: tuple[int, ...] = eqx.field(static=True)
    closed: bool = eqx.field(static=True)
    margin: int = eqx.field(static=True)
    every: int = eqx.field(static=True)

    @property
    def cells(self) -> int:
        """Of the grid, along the axis."""
        return self.edges[-1]

    @property
    def row(self) -> Row:
        """The devices, the last one beside the first where the direction is periodic."""
        return Row(self.places.devices, self.closed)

    @property
    def reach(self) -> int:
        """Layers of nodes beyond a slab."""
        return self.margin + PAD

    def _slab(self) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """First cell and number of cells of this device's slab."""
        index = jax.lax.axis_index(AXIS)
        edges = jnp.asarray(self.edges, jnp.int32)
        return edges[index], edges[index + 1] - edges[index]

    def _owner(self, grid: Grid, position: Float[Array, "p d"]) -> Int[Array, " p"]:
        """The device in whose slab each particle is."""
        layer = _layer_of(jax.vmap(grid.cells)(position)[:, self.axis], self.cells)
        cuts = jnp.asarray(self.edges[1:-1], jnp.int32)
        return jnp.sum(layer[:, None] >= cuts[None, :], axis=1, dtype=jnp.int32)

    def seats(self, scene: Scene, state: State) -> tuple[Int[Array, " _"], Int[Array, " devices"]]:
        """Particles of each slab in their order."""
        places, columns, lost = self.places, [], 0
        owner = self._owner(scene.grid, state.position)
        for size, part, start in zip(places.sizes, scene.slices, places.starts, strict=True):
            own = owner[part]
            order = jnp.argsort(own).astype(jnp.int32)
            everyone = jnp.arange(places.devices, dtype=jnp.int32)
            counts = jnp.sum(own[:, None] == everyone[None, :], axis=0, dtype=jnp.int32)
            column = jnp.arange(size, dtype=jnp.int32)[None, :]
            rank = (jnp.cumsum(counts, dtype=jnp.int32) - counts)[:, None] + column
            seat = order[jnp.minimum(rank, max(own.size - 1, 0))] if own.size else rank
            taken = column < counts[:, None]
            columns.append(jnp.where(taken, seat + start, places.particles))
            lost = lost + jnp.maximum(counts - size, 0)
        ids = jnp.concatenate(columns, axis=1).reshape(-1)
        return ids, jnp.broadcast_to(jnp.asarray(lost, jnp.int32), (places.devices,))

    def grid(self, grid: Grid) -> Grid:
        """The nodes of this device."""
        widest = max(np.diff(self.edges)) + 2 * self.margin
        shape, periodic = list(grid.shape), list(grid.periodic)
        shape[self.axis], periodic[self.axis] = int(widest), False
        part = Grid(grid.origin, shape, grid.h, periodic=periodic)
        first, _ = self._slab()
        numbers = first - self.reach + jnp.arange(part.padded_shape[self.axis], dtype=jnp.int32)
        if self.closed:
            numbers = numbers % self.cells
        given = tuple(numbers if i == self.axis else None for i in range(grid.dimension))
        return eqx.tree_at(lambda g: g.numbers, part, given, is_leaf=lambda a: a is None)

    def stencil(self, scene: Scene, state: State) -> tuple[State, Stencil, Bool[Array, " p"]]:
        """Stencils that fit in the whole grid, but not here, are those of lost particles."""
        grid, spline = scene.grid, scene.spline
        _, width = self._slab()
        # Index of the last node that a stencil may begin at, where the first node has index −PAD.
        last = (width + 2 * self.reach + 1 - PAD - spline.width).astype(state.dtype)
        centre = jnp.asarray(self.grid(grid).shape, state.dtype) / 2

        def of_one(x: Float[Array, " d"]) -> tuple[Array, Bool[Array, ""], Bool[Array, ""]]:
            whole = grid.cells(jnp.where(jnp.isfinite(x), x, 0))
            inside = grid.contains(spline.base(whole), spline.width)
            xi = self._shifted(whole)
            first = spline.base(xi)[self.axis]
            here = (first >= -PAD) & (first <= last)
            return jnp.where(inside & here, xi, centre), inside, here

        xi, inside, here = jax.vmap(of_one)(state.position)
        lost = state.alive & is_finite(state.position) & inside & ~here
        count = {Condition.OVERFLOW: jnp.sum(lost, dtype=jnp.int32)}
        status = state.status.note(count, state.step)
        state = eqx.tree_at(lambda s: (s.alive, s.status), state, (state.alive & ~lost, status))
        return state, Stencil(xi, spline), inside & here

    def _shifted(self, cells: Float[Array, " d"]) -> Float[Array, " d"]:
        """A position in cells relative to the first cell of this device's grid."""
        first, _ = self._slab()
        # Whole numbers, so that nothing is rounded.
        x = cells[self.axis] - (first - self.margin).astype(cells.dtype)
        if self.closed:
            # The image that is nearest to the slab.
            period = jnp.asarray(self.cells, x.dtype)
            x = x - period * jax.lax.stop_gradient(jnp.floor((x + PAD) / period))
        return cells.at[self.axis].set(x)

    def local(self, grid: Grid, position: Float[Array, "p d"]) -> Float[Array, "p d"]:
        """Relative to the first cell of this device's grid, m."""
        return jax.vmap(lambda x: self._shifted(grid.cells(x)) * grid.h)(position)

    def added(self, nodes: Float[Array, "*grid c"]) -> Float[Array, "*grid c"]:
        """The sum over the two devices that have a layer."""
        _, width = self._slab()
        depth = 2 * self.reach + 1
        moved = jnp.moveaxis(nodes, self.axis, 0)
        left = moved[:depth]
        right = jax.lax.dynamic_slice_in_dim(moved, width, depth)
        from_left, from_right = self.row.to_right(right), self.row.to_left(left)
        # Two terms, whose sum is the same to the last bit on both devices.
        moved = moved.at[:depth].add(from_left)
        moved = jax.lax.dynamic_update_slice_in_dim(moved, right + from_right, width, axis=0)
        return jnp.moveaxis(moved, 0, self.axis)

    def own(self, nodes: Float[Array, "*grid c"]) -> Bool[Array, "*grid 1"]:
        """The nodes of the slab, and beyond it at the ends of the grid."""
        _, width = self._slab()
        place = jnp.arange(nodes.shape[self.axis], dtype=jnp.int32) - self.reach
        index = jax.lax.axis_index(AXIS)
        first, last = index == 0, index == self.places.devices - 1
        below, above = (end & (not self.closed) for end in (first, last))
        own = ((place >= 0) | below) & ((place < width) | above)
        shape = [1] * (nodes.ndim - 1)
        shape[self.axis] = -1
        return jnp.broadcast_to(own.reshape(*shape, 1), (*nodes.shape[:-1], 1))

    def regrouped(self, grid: Grid, kinds: Any, parts: Parts) -> Parts:
        """Particles that left the slab go to the neighbour, every so many steps."""
        # Of evenly spread particles no more can have come out of a slab.
        share = min(1.0, 2 * (self.margin + 1) / int(np.diff(self.edges).min()))

        def regroup(parts: Parts) -> Parts:
            owner = self._owner(grid, parts.state.position)
            return migrated(parts, kinds, owner, self.places, self.row, share)

        if self.every == 1:
            return regroup(parts)
        due = parts.step % self.every == 0
        return jax.lax.cond(due, regroup, lambda parts: parts, parts)
