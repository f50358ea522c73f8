"""Robust losses, as functions of a residual vector whose half squared sum is the loss."""

from typing import final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Float, as_float_array, positive, require


@final
class Huber(eqx.Module):
    """Huber's loss: quadratic up to k standard deviations, then linear.

    A residual r is replaced by `sign(r) √(2 ρ(r))` with `ρ = r²/2` up to k and `k|r| − k²/2`
    beyond, so that half the squared sum is the robust loss and Gauss–Newton applies to it as it is.

    Args:
        k: in standard deviations of the noise; 1.345 keeps 95 % of the efficiency.
    """

    k: Array = eqx.field(default=1.345, converter=as_float_array)

    def __check_init__(self):
        require("k", self.k, "be positive and finite", positive)

    def __call__(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """The transformed residual."""
        k = self.k.astype(r.dtype)
        size = jnp.abs(r)
        # The root of what is beyond k only: its derivative is infinite at k²/2.
        beyond = jnp.where(size > k, 2 * k * size - k * k, k * k)
        return jnp.where(size > k, jnp.sign(r) * jnp.sqrt(beyond), r)


@final
class Cauchy(eqx.Module):
    """Cauchy's loss `ρ = k²/2 log(1 + (r/k)²)`: outliers hardly count.

    Args:
        k: in standard deviations of the noise; 2.385 keeps 95 % of the efficiency.
    """

    k: Array = eqx.field(default=2.385, converter=as_float_array)

    def __check_init__(self):
        require("k", self.k, "be positive and finite", positive)

    def __call__(self, r: Float[Array, "..."]) -> Float[Array, "..."]:
        """The transformed residual `r √(log(1 + s)/s)`, `s = (r/k)²`."""
        s = (r / self.k.astype(r.dtype)) ** 2
        small = s < 1e-4
        large = jnp.where(small, 1, s)
        # log(1 + s)/s = 1 − s/2 + s²/3 …, whose first terms are exact to rounding below 1e-4.
        series = 1 - s * (0.5 - s / 3)
        return r * jnp.where(small, jnp.sqrt(series), jnp.sqrt(jnp.log1p(large) / large))
