"""Prescribed rigid motion: of a collider, or of particles that are led."""

import abc
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import (
    Array,
    Float,
    Scalar,
    as_float_array,
    concrete,
    parameter,
    require,
    require_like,
    require_vector,
)
from pgjax.boundary.window import require_window, slack, within
from pgjax.linalg import apply, rotation_change

Vector = Float[Array, " d"]
Matrix = Float[Array, "d d"]
Turn = Float[Array, " k"]


class Pose(NamedTuple):
    """Where a rigid body is at one instant, and how fast.

    Attributes:
        pivot: at rest, m, `(d,)`.
        center: the pivot now, m, `(d,)`.
        R: rotation since rest, `(d, d)`.
        velocity: of the pivot, m/s, `(d,)`.
        W: spin `Ṙ Rᵀ`, 1/s, `(d, d)`.
    """

    pivot: Vector
    center: Vector
    R: Matrix
    velocity: Vector
    W: Matrix

    def to_rest(self, x: Vector) -> Vector:
        """Where the point of the body that is at x now is at rest."""
        return apply(self.R.T, x - self.center) + self.pivot

    def turned(self, vector: Vector) -> Vector:
        """A vector of the body at rest as it is now."""
        return apply(self.R, vector)

    def velocity_at(self, x: Vector) -> Vector:
        """Velocity of the body at x, m/s."""
        return apply(self.W, x - self.center) + self.velocity


class AbstractMotion(eqx.Module):
    """A rigid motion `x(t) = R(t) (X − pivot) + pivot + shift(t)`, X the place at rest.

    A new one says `shift(t)` and `turn(t)`, each differentiable in t: velocities are their exact
    derivatives. `turn` is the rotation vector (axis times angle, rad), `(3,)`; in two dimensions
    the angle, `(1,)`.
    """

    pivot: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def shift(self, t: Scalar) -> Vector:
        """Displacement of the pivot at time t, m."""

    @abc.abstractmethod
    def turn(self, t: Scalar) -> Turn:
        """Rotation vector at time t, rad."""

    def rotation(self, t: Scalar) -> Matrix:
        """R(t)."""
        change = rotation_change(self.turn(t))
        return change + jnp.eye(change.shape[0], dtype=change.dtype)

    def at(self, t: Scalar) -> Pose:
        """Place and rates of the body at time t."""

        def place(t: Scalar) -> tuple[Vector, Matrix]:
            return self.pivot + self.shift(t), self.rotation(t)

        (center, R), (rate, dR) = jax.jvp(place, (t,), (jnp.ones_like(t),))
        W = dR @ R.T
        # Behind a barrier, so that the compiler does not compute them anew at each node.
        pose = jax.lax.optimization_barrier((center, R, rate, (W - W.T) / 2))
        return Pose(self.pivot, *pose)


@final
class Steady(AbstractMotion):
    """Constant velocity and angular velocity in a time window, at rest before and after it.

    A body that turned stays turned. `Steady((0, 0, 0))` is a body at rest.

    Args:
        velocity: of the pivot, m/s, `(d,)`.
        angular_velocity: rad/s: the vector `(3,)`, right-handed; in two dimensions a number,
            counter-clockwise. None if it does not turn.
        pivot: the point it turns about, m, `(d,)`; it moves with `velocity`.
        start: when it starts to move, s.
        end: when it stops, s.
    """

    linear: Array
    angular: Array
    pivot: Array
    start: Array = parameter()
    end: Array = parameter()

    def __init__(
        self,
        velocity: Any,
        angular_velocity: Any = None,
        pivot: Any = None,
        start: Any = 0.0,
        end: Any = float("inf"),
    ):
        self.linear = as_float_array(velocity, "velocity")
        self.pivot = (
            jnp.zeros_like(self.linear) if pivot is None else as_float_array(pivot, "pivot")
        )
        self.angular = turn_like(angular_velocity, self.linear)
        self.start = start
        self.end = end

    def __check_init__(self):
        require_vector("velocity", self.linear)
        require_like("pivot", self.pivot, "velocity", self.linear)
        require_turn("angular_velocity", self.angular, self.linear)
        # From −∞ on it would be infinitely far by now.
        require("start", self.start, "be finite (s)", np.isfinite)
        require_window(self.start, self.end)

    def _elapsed(self, t: Scalar) -> Scalar:
        before_or_after = jnp.where(t < self.start, 0, self.end - self.start)
        return jnp.where(within(t, self.start, self.end), t - self.start, before_or_after)

    def shift(self, t: Scalar) -> Vector:
        """`velocity` times the time spent in the window."""
        return self._elapsed(t) * self.linear

    def turn(self, t: Scalar) -> Turn:
        """`angular_velocity` times the time spent in the window."""
        return self._elapsed(t) * self.angular


@final
class KeyFrames(AbstractMotion):
    """A path through given places: shift and rotation vector are linear between the key frames.

    Args:
        times: increasing, s, `(k,)`; before the first and after the last the body is at rest.
        shifts: displacements of the pivot, m, `(k, d)`.
        turns: rotation vectors, rad, `(k, 3)`; in two dimensions angles, `(k,)`. None: no turn.
        pivot: the point it turns about, m, `(d,)`; the origin if None.
    """

    times: Array
    shifts: Array
    turns: Array
    pivot: Array

    def __init__(self, times: Any, shifts: Any, turns: Any = None, pivot: Any = None):
        self.times = as_float_array(times, "times")
        self.shifts = as_float_array(shifts, "shifts")
        if self.times.ndim != 1 or self.shifts.ndim != 2:
            raise ValueError(
                f"Arguments `times` and `shifts` must have shapes (k,) and (k, d), but have shapes "
                f"{self.times.shape} and {self.shifts.shape}."
            )
        d, k = self.shifts.shape[-1], len(self.times)
        if turns is None:
            turns = jnp.zeros((k, 3 if d == 3 else 1), self.shifts.dtype)
        turns = as_float_array(turns, "turns")
        self.turns = turns[:, None] if turns.ndim == 1 else turns
        self.pivot = (
            jnp.zeros(d, self.shifts.dtype) if pivot is None else as_float_array(pivot, "pivot")
        )

    def __check_init__(self):
        k = self.times.shape[0]
        require("times", self.times, "be finite (s)", np.isfinite)
        times = concrete(self.times)
        if self.times.ndim != 1 or k < 2 or (times is not None and not (np.diff(times) > 0).all()):
            raise ValueError(
                f"Argument `times` must be at least two increasing numbers, but is {self.times}."
            )
        if self.shifts.shape not in ((k, 2), (k, 3)):
            raise ValueError(
                f"Argument `shifts` must have shape ({k}, 2) or ({k}, 3) for {k} times, but has "
                f"shape {self.shifts.shape}."
            )
        d = self.shifts.shape[1]
        if self.turns.shape != (k, 3 if d == 3 else 1):
            raise ValueError(
                f"Argument `turns` must give a rotation vector (an angle in two dimensions) for "
                f"each of {k} times, but has shape {self.turns.shape}."
            )
        require("shifts", self.shifts, "be finite (m)", np.isfinite)
        require("turns", self.turns, "be finite (rad)", np.isfinite)
        require_like("pivot", self.pivot, "shifts", self.shifts[0])

    def _at(self, t: Scalar, values: Float[Array, "k n"]) -> Float[Array, " n"]:
        last = self.times.shape[0] - 2
        i = jnp.clip(jnp.sum(self.times - t <= slack(t)) - 1, 0, last)
        t0, t1 = self.times[i], self.times[i + 1]
        inside = within(t, self.times[0], self.times[-1])
        s = jnp.where(inside, (t - t0) / (t1 - t0), jnp.where(t < t0, 0, 1))
        return values[i] + s * (values[i + 1] - values[i])

    def shift(self, t: Scalar) -> Vector:
        """Linear between the key frames."""
        return self._at(t, self.shifts)

    def turn(self, t: Scalar) -> Turn:
        """Linear between the key frames."""
        return self._at(t, self.turns)


def step_of(motion: AbstractMotion, x: Vector, t: Scalar, dt: Scalar) -> tuple[Vector, Matrix]:
    """Velocity that carries x along the motion in one step, and its gradient.

    The rates of the middle of the step, turned through exactly: a steady motion is followed to
    rounding, any other to second order in dt.
    """
    middle = motion.at(t + dt / 2)
    W = middle.W
    w = W[1, :1] if x.shape[0] == 2 else jnp.stack([W[2, 1], W[0, 2], W[1, 0]])
    chord = rotation_change(dt * w) / dt
    return apply(chord, x - motion.pivot - motion.shift(t)) + middle.velocity, chord


def turn_like(angular: Any, linear: Array) -> Array:
    """A rotation vector for vectors like `linear`; a number becomes `(1,)`, None no turn."""
    k = 3 if linear.shape[-1:] == (3,) else 1
    if angular is None:
        return jnp.zeros(k, linear.dtype)
    angular = as_float_array(angular, "turn")
    return angular[None] if angular.ndim == 0 else angular


def require_turn(name: str, turn: Array, linear: Array) -> None:
    """Refuse what is no rotation vector for vectors like `linear`."""
    expected = (3,) if linear.shape == (3,) else (1,)
    if turn.shape != expected:
        raise ValueError(
            f"Argument `{name}` must be a vector of 3 numbers (one number in two dimensions), but "
            f"has shape {turn.shape}."
        )
    require(name, turn, "be finite", np.isfinite)
