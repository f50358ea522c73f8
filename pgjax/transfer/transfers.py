"""Particle–grid transfers of a grid and a spline: the physical side of the primitives."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._types import Array, Bool, Float, Int
from pgjax.grid import PAD, Grid
from pgjax.splines import BSpline
from pgjax.transfer import primitive


@final
class Payload(eqx.Module):
    """What each particle sends to its nodes: c channels, the first m of which have a gradient.

    Args:
        a: value, `(p, c)`.
        B: its gradient, `(p, m, d)`: node i receives `w (a + B (x_i − x_p))`.
        S: flux, `(p, m, d)`: node i receives `S ∇w`. None where no law needs it.
    """

    a: Float[Array, "p c"]
    B: Float[Array, "p m d"]
    S: Float[Array, "p m d"] | None


@final
class Stencil(eqx.Module):
    """The nodes around each particle.

    Args:
        xi: positions in cells from the grid's origin, `(p, d)`; every stencil fits in the grid.
        spline: the spline.
    """

    xi: Float[Array, "p d"]
    spline: BSpline

    @property
    def first(self) -> Int[Array, "p d"]:
        """Index of the first node in the padded array, `(p, d)`."""
        base = jax.vmap(self.spline.base)(jax.lax.stop_gradient(self.xi))
        return base.astype(jnp.int32) + PAD

    def span(self) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
        """The first and the last node of all stencils, in cells from the grid's origin."""
        xi = jax.lax.stop_gradient(self.xi)

        def both(a: tuple[Array, Array], b: tuple[Array, Array]) -> tuple[Array, Array]:
            return jnp.minimum(a[0], b[0]), jnp.maximum(a[1], b[1])

        # In one pass over the particles.
        infinity = jnp.asarray(jnp.inf, xi.dtype)
        least, most = jax.lax.reduce((xi, xi), (infinity, -infinity), both, dimensions=(0,))
        return self.spline.base(least), self.spline.base(most) + self.spline.degree


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

    def of_one(x: Float[Array, " d"]) -> tuple[Float[Array, " d"], Bool[Array, ""]]:
        # So that what is not finite has no derivative; the caller looks at it.
        xi = grid.cells(jnp.where(jnp.isfinite(x), x, 0))
        inside = grid.contains(spline.base(xi), spline.width)
        return jnp.where(inside, xi, centre), inside

    xi, inside = jax.vmap(of_one)(x)
    return Stencil(xi, spline), inside


def scatter(grid: Grid, at: Stencil, payload: Payload) -> Float[Array, "*grid c"]:
    """P2G: the sum over particles of `w (a + B (x_i − x_p)) + S ∇w` at every node."""
    S = payload.B[:, :, :0] if payload.S is None else payload.S / grid.h
    padded = primitive.scatter(
        at.xi, payload.a, payload.B * grid.h, S, degree=at.spline.degree, nodes=grid.padded_shape
    )
    return grid.fold(padded)


def gather(
    grid: Grid, at: Stencil, values: Float[Array, "*grid c"], *, slope: bool = True
) -> tuple[Float[Array, "p c"], Float[Array, "p c d"], Float[Array, "p c d"] | None]:
    """G2P: `Σ w g`, `Σ w g (x_i − x_p)ᵀ/h` and `Σ g ∇wᵀ` (if `slope`) for every particle.

    The second is per cell, not per metre: what divides it by `D` divides by h once.
    """
    value, moment, slopes = primitive.gather(
        at.xi,
        grid.unfold(values),
        degree=at.spline.degree,
        graded=values.shape[-1],
        slope=slope,
    )
    return value, moment, slopes / grid.h if slope else None
