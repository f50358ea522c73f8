"""What a wall does to the material that touches it."""

import abc
from typing import final

import equinox as eqx
import jax.numpy as jnp

from pgjax._safe import dot, safe_divide, safe_norm
from pgjax._types import Array, Float, nonnegative, parameter, require

Vector = Float[Array, " d"]


class AbstractContact(eqx.Module):
    """What a wall does to the velocity of the material that touches it."""

    @abc.abstractmethod
    def __call__(self, v: Vector, normal: Vector) -> Vector:
        """New velocity relative to the wall; `normal` points into the material."""


@final
class Sticky(AbstractContact):
    """The material moves with the wall."""

    def __call__(self, v: Vector, normal: Vector) -> Vector:
        """`v ← 0`."""
        del normal
        return jnp.zeros_like(v)


@final
class Slip(AbstractContact):
    """The material slides without friction and never leaves the wall."""

    def __call__(self, v: Vector, normal: Vector) -> Vector:
        """`v ← v − (v·n) n`."""
        return v - dot(v, normal) * normal


@final
class Separating(AbstractContact):
    """The material may leave the wall; while pressed on it, Coulomb friction acts.

    Args:
        friction: coefficient μ ≥ 0.
    """

    friction: Array = parameter(default=0.0)

    def __check_init__(self):
        require("friction", self.friction, "be at least 0 and finite", nonnegative)

    def __call__(self, v: Vector, normal: Vector) -> Vector:
        """`v ← v_t max(0, 1 − μ |v_n|/|v_t|)` if `v_n = v·n < 0`, else unchanged."""
        normal_speed = dot(v, normal)
        tangential = v - normal_speed * normal
        speed = safe_norm(tangential)
        # The impulse that stops the normal motion also brakes the sliding, at most to rest.
        loss = safe_divide(-self.friction * normal_speed, speed)
        slid = tangential * jnp.maximum(1 - loss, 0)
        return jnp.where(normal_speed < 0, slid, v)
