"""Boundary conditions of the grid: obstacles and containers.

A condition of the grid is one function of one node, `(x, v, t) -> v`: any callable will do. The
nodes on a wall and everything behind it are held, wherever the grid lies.
"""

import abc
import functools
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._safe import dot
from pgjax._types import (
    Array,
    Bool,
    Float,
    Int,
    Scalar,
    as_float_array,
    concrete,
    numbers,
    parameter,
    require_kind,
    require_like,
    require_vector,
)
from pgjax.boundary.contact import AbstractContact, Separating, Sticky
from pgjax.boundary.motion import AbstractMotion
from pgjax.boundary.nodes import Region, change_if
from pgjax.boundary.shapes import AbstractShape, normal
from pgjax.boundary.window import require_window, within

Vector = Float[Array, " d"]
Vectors = Float[Array, "d n"]


class AbstractGridCondition(eqx.Module):
    """A boundary condition of the grid. A new one implements `__call__` only."""

    @abc.abstractmethod
    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """New velocity of the node at x at time t."""

    def on_nodes(self, x: Vectors, v: Vectors, t: Scalar, region: Region) -> Vectors:
        """The same for many nodes, components first, which makes vector code of it.

        Args:
            x: `(d, n)`, m.
            v: `(d, n)`, m/s.
            t: s.
            region: holds every node that matters; the others have no mass.
        """
        del region
        return jax.vmap(self, in_axes=(1, 1, None), out_axes=1)(x, v, t)


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
            None
            if surface_velocity is None
            else as_float_array(surface_velocity, "surface_velocity")
        )
        self.start = start
        self.end = end

    def __check_init__(self):
        require_kind("shape", self.shape, AbstractShape)
        require_kind("contact", self.contact, AbstractContact)
        require_kind("motion", self.motion, AbstractMotion, type(None))
        if self.surface_velocity is not None:
            require_vector("surface_velocity", self.surface_velocity)
        require_window(self.start, self.end)

    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """Apply the contact on the body and inside it."""
        return jnp.where(self._holds(x, t), self._touched(x, v, t), v)

    def on_nodes(self, x: Vectors, v: Vectors, t: Scalar, region: Region) -> Vectors:
        """The same, if any node of the region is in the body."""
        inside = jax.vmap(self._holds, in_axes=(1, None))(x, t)
        inside = inside & region.holds(x)

        def touched(v: Vectors) -> Vectors:
            new = jax.vmap(self._touched, in_axes=(1, 1, None), out_axes=1)(x, v, t)
            return jnp.where(inside, new, v)

        return change_if(jnp.any(inside), touched, v)

    def _holds(self, x: Vector, t: Scalar) -> Bool[Array, ""]:
        at_rest = x if self.motion is None else self.motion.at(t).to_rest(x)
        inside = self.shape.signed_distance(at_rest) <= _tolerance(x, at_rest)
        return inside & within(t, self.start, self.end)

    def _touched(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """The velocity of a node in the body."""
        wall = jnp.zeros_like(v) if self.surface_velocity is None else self.surface_velocity
        if self.motion is None:
            n = normal(self.shape, x)
        else:
            pose = self.motion.at(t)
            n = pose.turned(normal(self.shape, pose.to_rest(x)))
            wall = pose.velocity_at(x) + pose.turned(wall)
        # Without a normal (in the centre of a sphere) the material moves with the body.
        contact = jnp.where(dot(n, n) != 0, self.contact(v - wall, n), Sticky()(v, n))
        return wall + contact


@final
class Box(AbstractGridCondition):
    """Six walls (four in two dimensions) that keep the material inside a box.

    In edges and corners each wall acts in turn. From outside, a box is `Collider(Cuboid(...))`.

    Args:
        lower: lower corner, m.
        upper: upper corner, m.
        contact: `Sticky()`, `Slip()` or `Separating(friction)`.
    """

    lower: Array = eqx.field(converter=numbers("lower"))
    upper: Array = eqx.field(converter=numbers("upper"))
    contact: AbstractContact = eqx.field(default_factory=Separating)

    def __check_init__(self):
        require_kind("contact", self.contact, AbstractContact)
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
        anywhere = jnp.full_like(x, jnp.inf)
        return self.on_nodes(x[:, None], v[:, None], t, Region(-anywhere, anywhere))[:, 0]

    def on_nodes(self, x: Vectors, v: Vectors, t: Scalar, region: Region) -> Vectors:
        """Each pair of walls in turn, if the region reaches one of them."""
        del t
        for axis in range(x.shape[0]):
            # The region is half a cell too wide, which is more than rounding.
            low = region.low[axis] <= self.lower[axis]
            high = region.high[axis] >= self.upper[axis]
            walls = functools.partial(self._walls, axis, x)
            v = change_if(low | high, walls, v)
        return v

    def sides(self, axes: Sequence[Float[Array, " _"]]) -> list[Int[Array, " _"]]:
        """For the nodes of a grid along each direction: −1 behind the lower wall, 1 the upper."""
        farthest = jnp.stack([jnp.max(jnp.abs(x)) for x in axes])
        found = []
        for i, x in enumerate(axes):
            low = x - self.lower[i] <= _tolerance(farthest, self.lower)
            high = self.upper[i] - x <= _tolerance(farthest, self.upper)
            found.append(high.astype(jnp.int8) - low.astype(jnp.int8))
        return found

    def _walls(self, axis: int, x: Vectors, v: Vectors) -> Vectors:
        """The two walls across one direction; no node is behind both."""
        lower, upper = self.lower[:, None], self.upper[:, None]
        low = (x - lower)[axis] <= _tolerance(x, lower)
        high = (upper - x)[axis] <= _tolerance(x, upper)
        sign = jnp.where(high, -1, 1).astype(v.dtype)
        inward = jnp.stack([sign if i == axis else 0 * sign for i in range(x.shape[0])])
        touched = jax.vmap(self.contact, in_axes=(1, 1), out_axes=1)(v, inward)
        return jnp.where(low | high, touched, v)


def _tolerance(x: Array, *others: Array) -> Array:
    """A node that lies on a wall up to rounding counts as on the wall; no absolute length."""
    entries = [jnp.abs(a[i]) for a in (x, *others) for i in range(a.shape[0])]
    size = functools.reduce(jnp.maximum, entries)
    return 16 * jnp.asarray(jnp.finfo(x.dtype).eps, x.dtype) * size
