"""Conditions of particles: prescribed motion, release, pushes, forces, wind.

A condition is one function `(particles, t, dt) -> particles`, applied at the start of each step:
any callable will do.
"""

import abc
import reprlib
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._across import total
from pgjax._safe import safe_divide, safe_norm
from pgjax._types import (
    Array,
    Bool,
    Float,
    Scalar,
    as_float_array,
    concrete,
    nonnegative,
    numbers,
    parameter,
    require,
    require_number,
    require_vector,
)
from pgjax.boundary.motion import AbstractMotion, step_of
from pgjax.boundary.window import require_window, require_windows, within


class Particles(NamedTuple):
    """What a condition of particles sees and changes, in world coordinates.

    Attributes:
        x: positions, m, `(p, d)`; not to be changed.
        v: velocities, m/s, `(p, d)`.
        C: affine velocities, 1/s, `(p, d, d)`.
        mass: kg, `(p,)`; 0 for a particle that was masked.
        held: which particles keep v and C through the step, whatever pulls at them, `(p,)`; nodes
            most of whose mass is theirs move with them.
    """

    x: Float[Array, "p d"]
    v: Float[Array, "p d"]
    C: Float[Array, "p d d"]
    mass: Float[Array, " p"]
    held: Bool[Array, " p"]


class AbstractParticleCondition(eqx.Module):
    """Something that acts on some of the particles.

    Attributes:
        leads: whether it may set `held`; then the nodes around are led, too, which costs time.
    """

    mask: eqx.AbstractVar[Array | None]
    leads: ClassVar[bool] = True

    @abc.abstractmethod
    def __call__(self, particles: Particles, t: Scalar, dt: Scalar) -> Particles:
        """The particles at the start of the step from t to t + dt."""


def _as_mask(value: Any) -> Array:
    """Which particles; what it is if it is no mask is said later."""
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"Argument `mask` must be a boolean vector, one entry per particle, but is "
            f"{reprlib.repr(value)}."
        ) from None


@final
class ParticleMotion(AbstractParticleCondition):
    """Particles of a region are led along a rigid motion, whatever pulls at them.

    So are the nodes most of whose mass is theirs: what hangs from them is clamped there.
    `ParticleMotion(mask, Steady((0, 0, 0)))` holds them where they are. In a time window they are
    led from where they are when it starts, and free again when it ends; one end per particle
    releases them one after the other (`release_times`).

    Args:
        mask: which particles, boolean `(p,)`.
        motion: how they move.
        start: start of the window, s; one value or one per particle.
        end: end of the window, s; one value or one per particle.
    """

    mask: Array = eqx.field(converter=_as_mask)
    motion: AbstractMotion
    start: Array = eqx.field(default=-float("inf"), converter=numbers("start"))
    end: Array = eqx.field(default=float("inf"), converter=numbers("end"))

    def __check_init__(self):
        _check_mask(self.mask)
        require_windows(self.start, self.end, self.mask)

    def __call__(self, particles: Particles, t: Scalar, dt: Scalar) -> Particles:
        """Velocities that carry the particles along the motion in this step, and its spin."""
        led = self.mask & within(t, self.start, self.end)

        def one(x: Float[Array, " d"]) -> tuple[Array, Array]:
            return step_of(self.motion, x, t, dt)

        v, C = jax.vmap(one)(particles.x)
        return particles._replace(
            v=jnp.where(led[:, None], v, particles.v),
            C=jnp.where(led[:, None, None], C, particles.C),
            held=particles.held | led,
        )


def release_times(
    x: Any, direction: Any, *, start: float, end: float, layers: int | None = None
) -> np.ndarray:
    """When each particle is released if they are let go along a direction, s, `(p,)`.

    The particle furthest back along `direction` is released at `start`, the one furthest ahead at
    `end`, those between in proportion, or in equal `layers`.

    Args:
        x: positions, m, `(p, d)`.
        direction: need not have length 1.
        start: s.
        end: s, after `start`.
        layers: number of layers, at least 2; one by one if None.
    """
    x = np.asarray(as_float_array(x, "x"), np.float64)
    n = np.asarray(as_float_array(direction, "direction"), np.float64)
    if x.ndim != 2 or n.shape != x.shape[1:] or not (n * n).sum() > 0:
        raise ValueError(
            f"Argument `direction` must be a vector other than 0 like the positions "
            f"{x.shape}, but is {n}."
        )
    for name, value in (("start", start), ("end", end), ("layers", layers)):
        require_number(name, value)
    require("start", start, "be finite (s)", np.isfinite)
    require("end", end, f"be after `start` = {start} s", lambda a: a > start)
    if layers is not None:
        require("layers", layers, "be at least 2", lambda a: a >= 2)
    along = x @ n
    extent = np.ptp(along)
    part = (along - along.min()) / (extent if extent > 0 else 1)
    if layers is not None:
        part = np.minimum(np.floor(part * layers), layers - 1) / (layers - 1)
    return start + (end - start) * part


@final
class ParticleImpulse(AbstractParticleCondition):
    """A push on a region of particles: a total momentum, independent of how many they are.

    Args:
        mask: which particles, boolean `(p,)`.
        momentum: total momentum given, kg·m/s; shared in proportion to mass.
        start: when the push starts, s.
        duration: how long it lasts, s; at least one step is taken.
    """

    leads: ClassVar[bool] = False
    mask: Array = eqx.field(converter=_as_mask)
    momentum: Array = eqx.field(converter=numbers("momentum"))
    start: Array = parameter(default=0.0)
    duration: Array = parameter(default=0.0)

    def __check_init__(self):
        _check_mask(self.mask)
        _require_some(self.mask)
        require_vector("momentum", self.momentum)
        for name in ("start", "duration"):
            require_number(name, getattr(self, name))
        require("duration", self.duration, "be at least 0 s", lambda a: a >= 0)

    def __call__(self, particles: Particles, t: Scalar, dt: Scalar) -> Particles:
        """`v + P f/M` with f the part of the push that falls into this step."""
        # A sudden push lasts one step: shared by two where it starts between them.
        lasting = jnp.maximum(self.duration, dt)
        part = _overlap(t, dt, self.start, self.start + lasting) / lasting
        return _pushed(particles, self.mask, part * self.momentum)


@final
class ParticleForce(AbstractParticleCondition):
    """A force on a region of particles: a total force, independent of how many they are.

    Args:
        mask: which particles, boolean `(p,)`; the few around a point for a point force.
        force: total force, N, `(d,)`; shared in proportion to mass.
        start: start of the window, s.
        end: end of the window, s.
    """

    leads: ClassVar[bool] = False
    mask: Array = eqx.field(converter=_as_mask)
    force: Array = eqx.field(converter=numbers("force"))
    start: Array = parameter(default=0.0)
    end: Array = parameter(default=float("inf"))

    def __check_init__(self):
        _check_mask(self.mask)
        _require_some(self.mask)
        require_vector("force", self.force)
        require_window(self.start, self.end)

    def __call__(self, particles: Particles, t: Scalar, dt: Scalar) -> Particles:
        """`v + Δt F/M`, with the part of Δt that lies in the window."""
        during = _overlap(t, dt, self.start, self.end)
        return _pushed(particles, self.mask, during * self.force)


@final
class Wind(AbstractParticleCondition):
    """Drag of a medium that streams through: `dv/dt = −(r + k |w|) w`, `w = v − u`.

    Integrated exactly over each step, so that no time step is too long for it. A thin body in air
    of density ρ_a has about `k = ρ_a c_d/(2 ρ thickness)`; give the mask of the particles that the
    wind reaches.

    Args:
        velocity: u, m/s: `(d,)`, or a function `(x, t) -> u` of one point.
        rate: r ≥ 0, 1/s (drag in proportion to the speed).
        quadratic: k ≥ 0, 1/m (in proportion to its square).
        mask: which particles, boolean `(p,)`; all if None.
        start: start of the window, s.
        end: end of the window, s.
    """

    leads: ClassVar[bool] = False
    velocity: Array | Callable[[Any, Any], Any]
    rate: Array = parameter()
    quadratic: Array = parameter()
    mask: Array | None
    start: Array = parameter()
    end: Array = parameter()

    def __init__(
        self,
        velocity: Any,
        rate: Any = 0.0,
        quadratic: Any = 0.0,
        mask: Any = None,
        *,
        start: Any = 0.0,
        end: Any = float("inf"),
    ):
        self.velocity = velocity if callable(velocity) else as_float_array(velocity, "velocity")
        self.rate = rate
        self.quadratic = quadratic
        self.mask = None if mask is None else _as_mask(mask)
        self.start = start
        self.end = end

    def __check_init__(self):
        if not callable(self.velocity):
            require_vector("velocity", self.velocity)
        for name in ("rate", "quadratic"):
            require(name, getattr(self, name), "be at least 0 and finite", nonnegative)
        if self.mask is not None:
            _check_mask(self.mask)
        require_window(self.start, self.end)

    def __call__(self, particles: Particles, t: Scalar, dt: Scalar) -> Particles:
        """`w ← w e^(−r Δt)/(1 + k |w| (1 − e^(−r Δt))/r)`."""
        if callable(self.velocity):
            wind = jax.vmap(self.velocity, in_axes=(0, None))(particles.x, t)
            wind = wind.astype(particles.v.dtype)
        else:
            wind = self.velocity[None, :]
        w = particles.v - wind
        during = _overlap(t, dt, self.start, self.end)
        decay, linear = jnp.exp(-self.rate * during), self.rate > 0
        # (1 − e^(−r Δt))/r, and Δt where r = 0.
        length = -jnp.expm1(-self.rate * during) / jnp.where(linear, self.rate, 1)
        length = jnp.where(linear, length, during)
        kept = decay / (1 + self.quadratic * safe_norm(w) * length)
        v = wind + kept[:, None] * w
        if self.mask is not None:
            v = jnp.where(self.mask[:, None], v, particles.v)
        return particles._replace(v=v)


def _overlap(t: Scalar, dt: Scalar, start: Array, end: Array) -> Scalar:
    """How much of the step from t to t + dt lies in a window, s."""
    # Differences from t first: t + dt would lose the digits of dt late in a float32 run.
    return jnp.maximum(jnp.minimum(dt, end - t) - jnp.maximum(start - t, 0), 0)


def _pushed(particles: Particles, mask: Array, momentum: Float[Array, " d"]) -> Particles:
    """A momentum shared among the particles of a mask in proportion to mass."""
    mass = total(jnp.sum(jnp.where(mask, particles.mass, 0)))
    kick = safe_divide(momentum, jnp.broadcast_to(mass, momentum.shape))
    return particles._replace(v=jnp.where(mask[:, None], particles.v + kick[None, :], particles.v))


def _check_mask(mask: Array) -> None:
    if mask.dtype != bool or mask.ndim != 1:
        raise ValueError(
            f"Argument `mask` must be a boolean vector, one entry per particle, but has dtype "
            f"{mask.dtype} and shape {mask.shape}."
        )


def _require_some(mask: Array) -> None:
    known = concrete(mask)
    if known is not None and not known.any():
        raise ValueError("Argument `mask` must select at least one particle, but selects none.")
