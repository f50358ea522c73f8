"""Boundary conditions of the grid and prescribed motion of particles.

A condition of the grid is one function of one node, `(x, v, t) -> v`: any callable will do.
Walls are planes independent of the grid: the nodes on a wall and everything behind it are held.
"""

import abc
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp

from pgjax._safe import safe_divide, safe_norm
from pgjax._types import Array, Bool, Float, Scalar, as_float_array, concrete, parameter, require

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
        return v - jnp.sum(v * normal) * normal


@final
class Separating(AbstractContact):
    """The material may leave the wall; while pressed on it, Coulomb friction acts.

    Args:
        friction: coefficient μ ≥ 0.
    """

    friction: Array = parameter(default=0.0)

    def __check_init__(self):
        require("friction", self.friction, "be at least 0 and finite", _nonnegative)

    def __call__(self, v: Vector, normal: Vector) -> Vector:
        """`v ← v_t max(0, 1 − μ |v_n|/|v_t|)` if `v_n = v·n < 0`, else unchanged."""
        normal_speed = jnp.sum(v * normal)
        tangential = v - normal_speed * normal
        speed = safe_norm(tangential)
        # The impulse that stops the normal motion also brakes the sliding, at most to rest.
        loss = safe_divide(-self.friction * normal_speed, speed)
        slid = tangential * jnp.maximum(1 - loss, 0)
        return jnp.where(normal_speed < 0, slid, v)


class AbstractGridCondition(eqx.Module):
    """A boundary condition of the grid."""

    @abc.abstractmethod
    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """New velocity of the node at x at time t."""


@final
class HalfSpace(AbstractGridCondition):
    """A plane wall: material is on the side the normal points to.

    Args:
        point: any point of the plane, m.
        normal: points into the material; need not have length 1.
        contact: `Sticky()`, `Slip()` or `Separating(friction)`.
    """

    point: Array = eqx.field(converter=as_float_array)
    normal: Array = eqx.field(converter=as_float_array)
    contact: AbstractContact = eqx.field(default_factory=Separating)

    def __check_init__(self):
        _vector_like("normal", self.normal, "point", self.point)
        normal = concrete(self.normal)
        if normal is not None and not (normal * normal).sum() > 0:
            raise ValueError(f"Argument `normal` must not be zero, but is {normal}.")

    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """Apply the contact on the plane and behind it."""
        del t
        normal = self.normal / safe_norm(self.normal)
        behind = jnp.sum((x - self.point) * normal) <= _tolerance(x, self.point)
        return jnp.where(behind, self.contact(v, normal), v)


@final
class Box(AbstractGridCondition):
    """Six walls (four in two dimensions) that keep the material inside a box.

    Args:
        lower: lower corner, m.
        upper: upper corner, m.
        contact: `Sticky()`, `Slip()` or `Separating(friction)`.
    """

    lower: Array = eqx.field(converter=as_float_array)
    upper: Array = eqx.field(converter=as_float_array)
    contact: AbstractContact = eqx.field(default_factory=Separating)

    def __check_init__(self):
        _vector_like("upper", self.upper, "lower", self.lower)
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
                normal = jnp.zeros_like(x).at[axis].set(sign)
                behind = sign * (x[axis] - corner[axis]) <= _tolerance(x, corner)
                v = jnp.where(behind, self.contact(v, normal), v)
        return v


@final
class GridVelocity(AbstractGridCondition):
    """Prescribed velocity of the nodes in a box, in a time window.

    The box moves with the velocity while the window lasts.

    Args:
        center: centre of the box at the start of the window, m.
        half_size: half its extents, m.
        velocity: m/s.
        start: start of the window, s.
        end: end of the window, s.
    """

    center: Array = eqx.field(converter=as_float_array)
    half_size: Array = eqx.field(converter=as_float_array)
    velocity: Array = eqx.field(converter=as_float_array)
    start: Array = parameter(default=0.0)
    end: Array = parameter(default=float("inf"))

    def __check_init__(self):
        _vector_like("half_size", self.half_size, "center", self.center)
        _vector_like("velocity", self.velocity, "center", self.center)
        require("half_size", self.half_size, "be positive (m)", lambda a: a > 0)
        _window(self.start, self.end)

    def __call__(self, x: Vector, v: Vector, t: Scalar) -> Vector:
        """The velocity inside the box, unchanged outside."""
        center = self.center + self.velocity * jnp.maximum(t - self.start, 0)
        inside = jnp.all(jnp.abs(x - center) <= self.half_size + _tolerance(x, center))
        active = (t >= self.start) & (t < self.end)
        return jnp.where(inside & active, self.velocity, v)


class AbstractParticleCondition(eqx.Module):
    """Prescribed motion of some of the particles."""

    mask: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def velocity(
        self, v: Float[Array, "p d"], mass: Float[Array, " p"], t: Scalar, dt: Scalar
    ) -> Float[Array, "p d"]:
        """New velocities at the start of the step from t to t + dt."""

    @abc.abstractmethod
    def held(self, t: Scalar) -> Bool[Array, " p"]:
        """Which particles follow the velocity exactly in the step that starts at t."""


@final
class ParticleVelocity(AbstractParticleCondition):
    """Particles of a region move with a given velocity in a time window, whatever pulls at them.

    Args:
        mask: which particles, boolean `(p,)`.
        value: the velocity, m/s; zero holds them.
        start: start of the window, s.
        end: end of the window, s.
    """

    mask: Array = eqx.field(converter=jnp.asarray)
    value: Array = eqx.field(converter=as_float_array)
    start: Array = parameter(default=0.0)
    end: Array = parameter(default=float("inf"))

    def __check_init__(self):
        _mask(self.mask)
        _window(self.start, self.end)

    def velocity(
        self, v: Float[Array, "p d"], mass: Float[Array, " p"], t: Scalar, dt: Scalar
    ) -> Float[Array, "p d"]:
        """The given velocity for particles that are held."""
        del mass, dt
        return jnp.where(self.held(t)[:, None], self.value[None, :], v)

    def held(self, t: Scalar) -> Bool[Array, " p"]:
        """The region, while the window lasts."""
        return self.mask & (t >= self.start) & (t < self.end)


@final
class ParticleImpulse(AbstractParticleCondition):
    """A push on a region of particles: a total momentum, independent of how many they are.

    Args:
        mask: which particles, boolean `(p,)`.
        momentum: total momentum given, kg·m/s; shared in proportion to mass.
        start: when the push starts, s.
        duration: how long it lasts, s; 0 gives all of it in one step.
    """

    mask: Array = eqx.field(converter=jnp.asarray)
    momentum: Array = eqx.field(converter=as_float_array)
    start: Array = parameter(default=0.0)
    duration: Array = parameter(default=0.0)

    def __check_init__(self):
        _mask(self.mask)
        require("duration", self.duration, "be at least 0 s", lambda a: a >= 0)
        mask = concrete(self.mask)
        if mask is not None and not mask.any():
            raise ValueError("Argument `mask` must select at least one particle, but selects none.")

    def velocity(
        self, v: Float[Array, "p d"], mass: Float[Array, " p"], t: Scalar, dt: Scalar
    ) -> Float[Array, "p d"]:
        """`v + P f/M` with f the part of the push that falls into this step."""
        end = self.start + self.duration
        overlap = jnp.maximum(jnp.minimum(t + dt, end) - jnp.maximum(t, self.start), 0)
        sudden = (t <= self.start) & (self.start < t + dt)
        lasting = self.duration > 0
        part = jnp.where(
            lasting, overlap / jnp.where(lasting, self.duration, 1), sudden.astype(t.dtype)
        )
        total = jnp.sum(jnp.where(self.mask, mass, 0))
        kick = part * safe_divide(self.momentum, total * jnp.ones_like(self.momentum))
        return jnp.where(self.mask[:, None], v + kick[None, :], v)

    def held(self, t: Scalar) -> Bool[Array, " p"]:
        """None: the particles move on freely."""
        del t
        return jnp.zeros_like(self.mask)


def _nonnegative(a: Any) -> Any:
    return (a >= 0) & (a < float("inf"))


def _tolerance(x: Vector, *others: Vector) -> Scalar:
    """A node that lies on a wall up to rounding counts as on the wall; no absolute length."""
    size = jnp.max(jnp.abs(jnp.stack([x, *others])))
    return 16 * jnp.asarray(jnp.finfo(x.dtype).eps, x.dtype) * size


def _vector_like(name: str, value: Array, other: str, reference: Array) -> None:
    if value.shape != reference.shape or value.ndim != 1:
        raise ValueError(
            f"Argument `{name}` must be a vector like `{other}` (shape {reference.shape}), "
            f"but has shape {value.shape}."
        )
    require(name, value, "be finite", lambda a: abs(a) < float("inf"))


def _window(start: Array, end: Array) -> None:
    first = concrete(start)
    require("end", end, f"be after `start` = {first} s", lambda a: first is None or (a > first))


def _mask(mask: Array) -> None:
    if mask.dtype != bool or mask.ndim != 1:
        raise ValueError(
            f"Argument `mask` must be a boolean vector, one entry per particle, but has dtype "
            f"{mask.dtype} and shape {mask.shape}."
        )
