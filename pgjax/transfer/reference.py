"""The two transfers in plain JAX: every platform, every transformation.

Both come from one bilinear form. With a payload `(a, B, S)` per particle and values g per node,

    Φ = Σ_p Σ_i g_i · [ w_ip (a_p + B_p (x_i − x_p)) + S_p ∇w_ip ],

`scatter` is ∂Φ/∂g and `gather` is ∂Φ/∂(a, B, S): each is the other's transpose.
"""

import functools
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._types import Array, Bool, Float, Int
from pgjax.grid import PAD, Grid
from pgjax.splines import BSpline


@final
class Payload(eqx.Module):
    """What each particle sends to its nodes, c channels.

    Args:
        a: value, `(p, c)`.
        B: its gradient, `(p, c, d)`: node i receives `w (a + B (x_i − x_p))`.
        S: flux, `(p, c, d)`: node i receives `S ∇w`. None where no law needs it.
    """

    a: Float[Array, "p c"]
    B: Float[Array, "p c d"]
    S: Float[Array, "p c d"] | None


@final
class Stencil(eqx.Module):
    """The nodes around each particle, and the spline there.

    Args:
        first: index of the first node in the padded array, `(p, d)`.
        w: weights, one row per node and direction, `(p, k, d)`.
        dw: ∇w along each direction, 1/m.
        dx: `x_i − x_p`, m.
    """

    first: Int[Array, "*p d"]
    w: Float[Array, "*p k d"]
    dw: Float[Array, "*p k d"]
    dx: Float[Array, "*p k d"]


def stencil(
    grid: Grid, spline: BSpline, x: Float[Array, "p d"]
) -> tuple[Stencil, Bool[Array, " p"]]:
    """The stencil of each particle, and whether it fits in the grid.

    A particle whose stencil does not fit gets the one of the grid's centre: the caller sets its
    payload to zero. No index is ever out of range.

    Args:
        grid: the grid.
        spline: the spline.
        x: positions relative to the grid's origin, m.
    """
    centre = jnp.asarray(grid.shape, x.dtype) / 2
    node = jnp.arange(spline.width, dtype=x.dtype)

    def of_one(x: Float[Array, " d"]) -> tuple[Stencil, Bool[Array, ""]]:
        xi = grid.cells(x)
        inside = grid.contains(spline.base(xi), spline.width)
        xi = jnp.where(inside, xi, centre)
        base = jax.lax.stop_gradient(spline.base(xi))
        offset = xi - base
        w, dw = spline.weights(offset)
        dx = (node[:, None] - offset[None, :]) * grid.h
        return Stencil(base.astype(jnp.int32) + PAD, w, dw / grid.h, dx), inside

    return jax.vmap(of_one)(x)


def _outer(rows: list[Float[Array, " k"]]) -> Array:
    """Product over the directions: `(k, …, k)` from d rows of k."""
    d = len(rows)
    shaped = [
        row.reshape([-1 if axis == i else 1 for axis in range(d)]) for i, row in enumerate(rows)
    ]
    return functools.reduce(jnp.multiply, shaped)


def _node_values(
    w: Float[Array, "k d"],
    dw: Float[Array, "k d"],
    dx: Float[Array, "k d"],
    payload: tuple[Float[Array, " c"], Float[Array, "c d"], Float[Array, "c d"] | None],
) -> Array:
    """`w (a + B (x_i − x_p)) + S ∇w` at the nodes of one particle, `(k, …, k, c)`."""
    a, B, S = payload
    d = w.shape[1]
    rows = [w[:, i] for i in range(d)]

    def channels(u: Array) -> Array:
        return u.reshape((1,) * d + (-1,))

    def along(j: int, row: Array, others: list[Array]) -> Array:
        return _outer([row if i == j else others[i] for i in range(d)])[..., None]

    ones = [jnp.ones_like(row) for row in rows]
    affine = channels(a) + sum(along(j, dx[:, j], ones) * channels(B[:, j]) for j in range(d))
    values = _outer(rows)[..., None] * affine
    if S is not None:
        values = values + sum(along(j, dw[:, j], rows) * channels(S[:, j]) for j in range(d))
    return values


def scatter(grid: Grid, at: Stencil, payload: Payload) -> Float[Array, "*grid c"]:
    """P2G: the sum over particles of `w (a + B (x_i − x_p)) + S ∇w` at every node."""
    d, c = grid.dimension, payload.a.shape[1]
    values = jax.vmap(_node_values)(at.w, at.dw, at.dx, (payload.a, payload.B, payload.S))
    # One window per particle. Without the barrier XLA fuses the arithmetic into the scatter's
    # inner loop, which costs a third more.
    first, values = jax.lax.optimization_barrier((at.first, values))
    dimensions = jax.lax.ScatterDimensionNumbers(
        update_window_dims=tuple(range(1, d + 2)),
        inserted_window_dims=(),
        scatter_dims_to_operand_dims=tuple(range(d)),
    )
    padded = jax.lax.scatter_add(
        jnp.zeros((*grid.padded_shape, c), values.dtype),
        first,
        values,
        dimensions,
        mode="promise_in_bounds",
    )
    return grid.fold(padded)


def _contract(row: Float[Array, " k"], window: Array) -> Array:
    """`Σ_i row_i window_i` over the leading axis, written out: faster than a batched matmul."""
    return functools.reduce(jnp.add, (row[i] * window[i] for i in range(row.shape[0])))


def _moments(
    w: Float[Array, "k d"], dw: Float[Array, "k d"], dx: Float[Array, "k d"], window: Array
) -> tuple[Array, Array, Array]:
    """`Σ w g`, `Σ w g (x_i − x_p)ᵀ` and `Σ g ∇wᵀ` of one particle, direction by direction."""
    value, first, slope = window, list[Array](), list[Array]()
    for j in range(w.shape[1]):
        wdx = w[:, j] * dx[:, j]
        first = [*(_contract(w[:, j], m) for m in first), _contract(wdx, value)]
        slope = [*(_contract(w[:, j], m) for m in slope), _contract(dw[:, j], value)]
        value = _contract(w[:, j], value)
    return value, jnp.stack(first, axis=-1), jnp.stack(slope, axis=-1)


def gather(
    grid: Grid, at: Stencil, values: Float[Array, "*grid c"]
) -> tuple[Float[Array, "p c"], Float[Array, "p c d"], Float[Array, "p c d"]]:
    """G2P: `Σ w g`, `Σ w g (x_i − x_p)ᵀ` and `Σ g ∇wᵀ` for every particle."""
    d, k, c = grid.dimension, at.w.shape[1], values.shape[-1]
    dimensions = jax.lax.GatherDimensionNumbers(
        offset_dims=tuple(range(1, d + 2)),
        collapsed_slice_dims=(),
        start_index_map=tuple(range(d)),
    )
    windows = jax.lax.gather(
        grid.unfold(values),
        at.first,
        dimensions,
        slice_sizes=(*(k,) * d, c),
        mode="promise_in_bounds",
    )
    windows = jax.lax.optimization_barrier(windows)
    return jax.vmap(_moments)(at.w, at.dw, at.dx, windows)
