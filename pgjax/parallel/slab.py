"""What a device does that has a slab of the grid and the particles in it."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._across import AXIS
from pgjax._types import Array, Bool, Float, Int
from pgjax.exchange import is_finite
from pgjax.grid import PAD, Grid
from pgjax.parallel.layout import Parts, Places
from pgjax.parallel.migration import migrated
from pgjax.parallel.neighbours import Row
from pgjax.parallel.plan import AbstractPlan
from pgjax.result import Condition
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.transfer import Stencil


def layer_of(cells: Float[Array, " p"], count: int) -> Int[Array, " p"]:
    """The layer of cells, at the edge of the grid for what is outside or not finite."""
    cells = jnp.where(jnp.isfinite(cells), cells, 0)
    return jnp.clip(jnp.floor(cells), 0, count - 1).astype(jnp.int32)


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
        layer = layer_of(jax.vmap(grid.cells)(position)[:, self.axis], self.cells)
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
