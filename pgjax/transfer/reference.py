"""The two transfers in plain JAX: every platform, every transformation.

Both come from one multilinear form. In units of cells, with a payload `(a, B, S)` per particle
and values g per node,

    Φ = Σ_p Σ_i g_i · [ w_ip (a_p + B_p (x_i − x_p)) + S_p ∇w_ip ],

`scatter` is ∂Φ/∂g and `gather` is ∂Φ/∂(a, B, S): each is the other's transpose. Only the first m
of the c channels have a gradient B, S. S may be left out: its last axis then has length 0.
"""

import functools

import jax
import jax.numpy as jnp

from pgjax._types import Array, Float, Int
from pgjax.grid import PAD
from pgjax.splines import BSpline


def stencil(
    degree: int, xi: Float[Array, " d"]
) -> tuple[Int[Array, " d"], Float[Array, "k d"], Float[Array, "k d"], Float[Array, "k d"]]:
    """First node in the padded array; `w`, `∇w` and `x_i − x_p` at the nodes, one row per node."""
    spline = BSpline(degree)
    base = jax.lax.stop_gradient(spline.base(xi))
    offset = xi - base
    w, dw = spline.weights(offset)
    dx = jnp.arange(spline.width, dtype=xi.dtype)[:, None] - offset[None, :]
    return base.astype(jnp.int32) + PAD, w, dw, dx


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
    a: Float[Array, " c"],
    B: Float[Array, "c d"],
    S: Float[Array, "c _"],
) -> Array:
    """`w (a + B (x_i − x_p)) + S ∇w` at the nodes of one particle, `(k, …, k, c)`."""
    d = w.shape[1]
    rows = [w[:, i] for i in range(d)]

    def channels(u: Array) -> Array:
        return u.reshape((1,) * d + (-1,))

    def along(j: int, row: Array, others: list[Array]) -> Array:
        return _outer([row if i == j else others[i] for i in range(d)])[..., None]

    ones = [jnp.ones_like(row) for row in rows]
    affine = channels(a) + sum(along(j, dx[:, j], ones) * channels(B[:, j]) for j in range(d))
    values = _outer(rows)[..., None] * affine
    if S.shape[1]:
        values = values + sum(along(j, dw[:, j], rows) * channels(S[:, j]) for j in range(d))
    return values


def scatter(
    xi: Float[Array, "p d"],
    a: Float[Array, "p c"],
    B: Float[Array, "p m d"],
    S: Float[Array, "p m _"],
    *,
    degree: int,
    nodes: tuple[int, ...],
) -> Float[Array, "*nodes c"]:
    """P2G: the sum over particles of `w (a + B (x_i − x_p)) + S ∇w` at every node."""
    d, c = xi.shape[1], a.shape[1]
    # Channels without a gradient: that of the mass.
    B, S = (jnp.pad(m, ((0, 0), (0, c - m.shape[1]), (0, 0))) for m in (B, S))
    first, w, dw, dx = jax.vmap(functools.partial(stencil, degree))(xi)
    values = jax.vmap(_node_values)(w, dw, dx, a, B, S)
    # One window per particle. Without the barrier XLA fuses the arithmetic into the scatter's
    # inner loop, which costs a third more.
    first, values = jax.lax.optimization_barrier((first, values))
    dimensions = jax.lax.ScatterDimensionNumbers(
        update_window_dims=tuple(range(1, d + 2)),
        inserted_window_dims=(),
        scatter_dims_to_operand_dims=tuple(range(d)),
    )
    start = jnp.zeros((*nodes, c), values.dtype)
    return jax.lax.scatter_add(start, first, values, dimensions, mode="promise_in_bounds")


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
    xi: Float[Array, "p d"],
    g: Float[Array, "*nodes c"],
    *,
    degree: int,
    graded: int,
    slope: bool,
) -> tuple[Float[Array, "p c"], Float[Array, "p m d"], Float[Array, "p m _"]]:
    """G2P: `Σ w g`, `Σ w g (x_i − x_p)ᵀ` and, with `slope`, `Σ g ∇wᵀ` for every particle.

    Args:
        xi: positions in cells.
        g: values of the nodes.
        degree: of the spline.
        graded: m, the number of channels whose gradients are wanted.
        slope: whether the last of the three is wanted.
    """
    d, k, c = xi.shape[1], degree + 1, g.shape[-1]
    first, w, dw, dx = jax.vmap(functools.partial(stencil, degree))(xi)
    dimensions = jax.lax.GatherDimensionNumbers(
        offset_dims=tuple(range(1, d + 2)),
        collapsed_slice_dims=(),
        start_index_map=tuple(range(d)),
    )
    sizes = (*(k,) * d, c)
    windows = jax.lax.gather(g, first, dimensions, slice_sizes=sizes, mode="promise_in_bounds")
    windows = jax.lax.optimization_barrier(windows)
    value, moment, slopes = jax.vmap(_moments)(w, dw, dx, windows)
    return value, moment[:, :graded], slopes[:, :graded, : d if slope else 0]
