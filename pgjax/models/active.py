"""Active stress: fibres that pull, as muscle does."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Float, Matrix3, Scalar, Vector3, parameter, require


@final
class ActiveStress(eqx.Module):
    """Contractile fibres: `τ_active = a s(t) (F f₀)(F f₀)ᵀ`, f₀ the fibre direction at rest.

    In other words a second Piola–Kirchhoff stress `a s(t) f₀ f₀ᵀ` added to the passive one:
    a > 0 pulls along the fibre, a < 0 pushes. F is the total deformation: fibres are carried by
    the material also where it flows.

    Both the pattern (`activation`, `direction`) and the signal can be sought by gradient: give
    `signal` as an `eqx.Module` whose arrays are the unknowns; its fields declared with
    `parameter()` may hold one value per particle, e.g. phases of a travelling wave.

    Args:
        direction: f₀, `(3,)` or one per particle `(p, 3)`; only its direction counts.
        activation: a, Pa. One value or one per particle.
        signal: `t -> s`, dimensionless, t in s; 1 at all times if None. The stable time step is
            that of s = 1: keep it within [−1, 1].
    """

    direction: Array = parameter(metadata={"rank": 1})
    activation: Array = parameter()
    signal: Callable[[Any], Any] | None = None

    def __check_init__(self):
        if self.direction.ndim not in (1, 2) or self.direction.shape[-1] != 3:
            raise ValueError(
                f"Argument `direction` must have shape (3,) or (p, 3), but has shape "
                f"{self.direction.shape}."
            )
        require("direction", self.direction, "be finite", jnp.isfinite)
        length = jnp.sum(self.direction**2, axis=-1)
        require("direction", length, "not be zero", lambda a: a > 0)
        require("activation", self.activation, "be finite (Pa)", jnp.isfinite)

    def _fibre(self, H: Matrix3) -> Vector3:
        """`F f₀/|f₀|`."""
        f0 = self.direction / jnp.sqrt(jnp.sum(self.direction**2))
        return f0 + H @ f0

    def kirchhoff(self, H: Matrix3, t: Float[Array, ""]) -> Matrix3:
        """`a s(t) (F f₀)(F f₀)ᵀ`, Pa, of one particle, from the total `H = F − I`."""
        m = self._fibre(H)
        a = self.activation
        if self.signal is not None:
            a = a * jnp.asarray(self.signal(t)).astype(a.dtype)
        return a * m[:, None] * m[None, :]

    def rest_modulus(self) -> Array:
        """What it adds to `ρ₀ c²` at rest, Pa: `max(a, 0)` (s = 1)."""
        return jnp.maximum(self.activation, 0)

    def tangent_bound(self, H: Matrix3) -> Scalar:
        """What it adds to the bound of the tangent: `max(a, 0) |F f₀|²`, Pa (s = 1)."""
        m = self._fibre(H)
        return jnp.maximum(self.activation, 0) * jnp.sum(m * m)
