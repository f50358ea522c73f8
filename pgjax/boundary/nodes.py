"""Conditions of the grid on all its nodes at once, evaluated where there is mass only."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from pgjax._types import Array, Bool, Float
from pgjax.grid import Grid

Vector = Float[Array, " d"]
Vectors = Float[Array, "d n"]

# A loop over a slab of fewer nodes costs more than it saves.
_SMALLEST_SLAB = 2048


class Region(NamedTuple):
    """A box that holds every node with mass, m: corners `(d,)`."""

    low: Vector
    high: Vector

    def holds(self, x: Vectors) -> Bool[Array, " n"]:
        """Which of the nodes at x are in it."""
        return jnp.all((x >= self.low[:, None]) & (x <= self.high[:, None]), axis=0)


def branches() -> bool:
    """Whether work is skipped by a branch.

    On an accelerator a branch waits for the host; inside `shard_map` its two results would have
    to vary over the same mesh axes.
    """
    return jax.default_backend() == "cpu" and not jax.sharding.get_abstract_mesh().manual_axes


def change_if(needed: Bool[Array, ""], change: Callable[[Array], Array], v: Array) -> Array:
    """`change(v)`, which leaves v as it is unless `needed`; then it is skipped where that pays."""
    return jax.lax.cond(needed, change, lambda v: v, v) if branches() else change(v)


def sweep(
    grid: Grid,
    one: Callable[[Vectors, Float[Array, "c n"], Region], Float[Array, "c n"]],
    values: Float[Array, "*grid c"],
    region: Region,
) -> Float[Array, "*grid c"]:
    """`one(x, values, region)` for the nodes of every slab that reaches into the region, else 0.

    A slab is a few layers of nodes across the first direction. Components come first, `(d, n)`:
    what is written for one node then becomes vector code over many.

    Args:
        grid: the grid.
        one: new values for each of n nodes at x, m.
        values: of the nodes.
        region: where there is mass.
    """
    d = grid.dimension
    first, *others = (a + start for a, start in zip(grid.axes(), grid.origin, strict=True))

    def everything(x0: Float[Array, " k"], values: Array, region: Region) -> Array:
        x = jnp.stack(jnp.meshgrid(x0, *others, indexing="ij")).reshape(d, -1)
        new = one(x, values.reshape(-1, values.shape[-1]).T, region)
        return new.T.reshape(values.shape)

    def nothing(x0: Float[Array, " k"], values: Array, region: Region) -> Array:
        del x0, region
        return jnp.zeros_like(values)

    def slab(args: tuple[Float[Array, " k"], Array]) -> Array:
        x0, values = args
        low, high = region.low.at[0].max(x0[0]), region.high.at[0].min(x0[-1])
        here = Region(low, high)
        return jax.lax.cond(low[0] <= high[0], everything, nothing, x0, values, here)

    layers = _layers(grid.node_shape)
    if layers == grid.node_shape[0] or not branches():
        return jax.checkpoint(everything)(first, values, region)
    # Slabs go in and out as a list: the derivative of a grid that is carried along and updated in
    # place copies the whole of it for each slab.
    slabs = tuple(a.reshape(-1, layers, *a.shape[1:]) for a in (first, values))
    return jax.lax.map(jax.checkpoint(slab, prevent_cse=False), slabs).reshape(values.shape)


def _layers(nodes: Sequence[int]) -> int:
    """How many layers of nodes make a slab: a divisor of their number."""
    across = math.prod(nodes[1:])
    divisors = (k for k in range(1, nodes[0]) if nodes[0] % k == 0)
    return next((k for k in divisors if k * across >= _SMALLEST_SLAB), nodes[0])
