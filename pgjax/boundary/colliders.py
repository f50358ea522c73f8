"""Boundary conditions of the grid: obstacles and containers.

A condition of the grid is one function of one node, `(x, v, t) -> v`: any callable will do. The
nodes on a wall and everything behind it are held, wherever the grid lies.
"""

import abc
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import (
    Array,
    Float,
    Scalar,
    as_float_array,
    concrete,
    parameter,
    require_like,
    require_vector,
)
from pgjax.boundary.contact import AbstractContact, Separating, Sticky
from pgjax.boundary.motion import AbstractMotion
from pgjax.boundary.shapes import AbstractShape, normal
from pgjax.boundary.window import require_window, within

Vector = Float[Array, " d"]


class AbstractGridCondition(eqx.Module):
    """A boundary condition of the grid."""

    @abc.abstractmethod
    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """New velocity of the node at x at time t."""


@final
class Collider(AbstractGridCondition):
    """A rigid body that the material cannot enter, at rest or moving.

    Where the body is, `v ← v_body + contact(v − v_body, n)`, `v_body` its velocity at the node and
    n its outward normal. Differentiable in friction, motion, and the shape through its normal; that
    a node comes to lie inside or outside is a jump and has no derivative. A wall that is thinner
    than the grid spacing, or sharper, is seen as the nodes see it.

    Args:
        shape: the body at rest; `Complement(shape)` for a container.
        contact: `Sticky()`, `Slip()` or `Separating(friction)`.
        motion: how it moves; at rest if None.
        surface_velocity: of the surface along itself (a conveyor belt), m/s, `(d,)`, turning with
            the body; the body itself stays.
        start: when it comes into being, s.
        end: when it is gone, s.
    """

    shape: AbstractShape
    contact: AbstractContact
    motion: AbstractMotion | None
    surface_velocity: Array | None
    start: Array = parameter()
    end: Array = parameter()

    def __init__(
        self,
        shape: AbstractShape,
        contact: AbstractContact | None = None,
        motion: AbstractMotion | None = None,
        *,
        surface_velocity: Any = None,
        start: Any = -float("inf"),
        end: Any = float("inf"),
    ):
        self.shape = shape
        self.contact = Separating() if contact is None else contact
        self.motion = motion
        self.surface_velocity = (
            None if surface_velocity is None else as_float_array(surface_velocity)
        )
        self.start = start
        self.end = end

    def __check_init__(self):
        if self.surface_velocity is not None:
            require_vector("surface_velocity", self.surface_velocity)
        require_window(self.start, self.end)

    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """Apply the contact on the body and inside it."""
        if self.motion is None:
            wall = jnp.zeros_like(v) if self.surface_velocity is None else self.surface_velocity
            return self._touched(x, x, v, t, wall, lambda n: n)
        pose = self.motion.at(t)
        wall = pose.velocity_at(x)
        if self.surface_velocity is not None:
            wall = wall + pose.turned(self.surface_velocity)
        return self._touched(x, pose.to_rest(x), v, t, wall, pose.turned)

    def _touched(
        self,
        x: Vector,
        at_rest: Vector,
        v: Vector,
        t: Scalar,
        wall: Vector,
        turned: Callable[[Vector], Vector],
    ) -> Vector:
        n = turned(normal(self.shape, at_rest))
        inside = self.shape.signed_distance(at_rest) <= _tolerance(x, at_rest)
        active = within(t, self.start, self.end)
        # Without a normal (in the centre of a sphere) the material moves with the body.
        contact = jnp.where(jnp.any(n != 0), self.contact(v - wall, n), Sticky()(v, n))
        return jnp.where(inside & active, wall + contact, v)


@final
class Box(AbstractGridCondition):
    """Six walls (four in two dimensions) that keep the material inside a box.

    In edges and corners each wall acts in turn. From outside, a box is `Collider(Cuboid(...))`.

    Args:
        lower: lower corner, m.
        upper: upper corner, m.
        contact: `Sticky()`, `Slip()` or `Separating(friction)`.
    """

    lower: Array = eqx.field(converter=as_float_array)
    upper: Array = eqx.field(converter=as_float_array)
    contact: AbstractContact = eqx.field(default_factory=Separating)

    def __check_init__(self):
        require_vector("lower", self.lower)
        require_like("upper", self.upper, "lower", self.lower)
        lower, upper = concrete(self.lower), concrete(self.upper)
        if lower is not None and upper is not None and not (upper > lower).all():
            raise ValueError(
                f"Argument `upper` must be above `lower` = {lower} in every direction, "
                f"but is {upper}."
            )

    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """Apply the contact at each wall in turn."""
        del t
        d = x.shape[0]
        for axis in range(d):
            for sign, corner in ((1, self.lower), (-1, self.upper)):
                inward = jnp.zeros_like(x).at[axis].set(sign)
                behind = sign * (x[axis] - corner[axis]) <= _tolerance(x, corner)
                v = jnp.where(behind, self.contact(v, inward), v)
        return v


def _tolerance(x: Vector, *others: Vector) -> Scalar:
    """A node that lies on a wall up to rounding counts as on the wall; no absolute length."""
    size = jnp.max(jnp.abs(jnp.stack([x, *others])))
    return 16 * jnp.asarray(jnp.finfo(x.dtype).eps, x.dtype) * size
