"""How much a motion magnifies a change: beyond what growth its derivatives say nothing."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Float
from pgjax.inverse.levenberg import Point
from pgjax.inverse.observations import AbstractObservation
from pgjax.inverse.problem import AbstractProblem, Problem
from pgjax.simulate import simulate

# A change of a millionth then moves a body by as much as it moves at all.
LARGEST_GROWTH = 1e6


class Growth(NamedTuple):
    """How far changes of the initial velocities carry the particles, beside free flight.

    Attributes:
        t: times of the frames, s, `(frames,)`.
        values: `‖δx(t)‖/(t ‖δv₀‖)` of the changes that were tried, the largest, `(frames,)`. 1 in
            free flight, less where walls or viscosity take the motion; exponential in t where it is
            unstable or chaotic.
    """

    t: np.ndarray
    values: np.ndarray

    @property
    def largest(self) -> float:
        """Over all frames."""
        return float(self.values.max())

    @property
    def messages(self) -> list[str]:
        """A warning where the growth is beyond `LARGEST_GROWTH`; else nothing."""
        beyond = np.flatnonzero(self.values > LARGEST_GROWTH)
        if not len(beyond):
            return []
        frame = int(beyond[0]) + 1
        return [
            f"A change of the initial velocities has grown by {self.values[beyond[0]]:.1e} at "
            f"frame {frame} ({self.t[frame - 1]:.4g} s): {_ADVICE}"
        ]

    def __str__(self) -> str:
        rows = [f"{t:10.4g} s {value:11.3e}" for t, value in zip(self.t, self.values, strict=True)]
        return "\n".join([f"{'time':>12} {'growth':>11}", *rows, *self.messages])


_ADVICE = (
    "the motion is unstable or chaotic, and its derivatives say nothing of changes that matter. "
    "Use fewer frames (`problem.until`), and look at the time step."
)


def growth(
    problem: Problem, values: dict[str, Any] | None = None, *, directions: int = 2, seed: int = 0
) -> Growth:
    """The growth report: `|∂x(t)/∂v₀|` over t, by forward mode.

    Tried are one push of the whole body along each axis, and random velocities of all particles:
    what grows exponentially is part of any of these.

    Args:
        problem: whose motion; of a `Joint` look at each of its `problems`.
        values: where, in physical units; at the first guess if None.
        directions: number of random changes.
        seed: of these.
    """
    space = problem.space
    u = space.start if values is None else space.vector({n: values[n] for n in space.free})
    u = jnp.asarray(u, jnp.zeros(()).dtype)
    _, state = problem.build(space.values(u))
    count, d = state.v.shape
    pushes = np.tile(np.eye(d)[:, None], (1, count, 1))
    random = np.random.default_rng(seed).standard_normal((directions, count, d))
    changes = np.concatenate([pushes, random])
    changes /= np.linalg.norm(changes, axis=(1, 2), keepdims=True)
    moved = np.asarray(_moved(problem, u, jnp.asarray(changes, state.dtype)), np.float64)
    t = problem.frame_dt * np.arange(1, problem.frames + 1)
    # A derivative that is not finite any more has grown beyond all numbers.
    values_ = np.nan_to_num(moved, nan=np.inf, posinf=np.inf).max(axis=0) / t
    return Growth(t, values_)


@eqx.filter_jit
def _moved(
    problem: Problem, u: Float[Array, " size"], changes: Float[Array, "k p d"]
) -> Float[Array, "k frames"]:
    """`‖δx‖` in each frame for each change of the initial velocities."""
    scene, state = problem.build(problem.space.values(u))

    def path(v: Array) -> Array:
        """Positions in each frame, over the initial velocities."""
        trajectory = simulate(
            scene,
            eqx.tree_at(lambda s: s.v, state, v),
            dt=problem.dt,
            frames=problem.frames,
            substeps=problem.substeps,
            save=lambda s: s.position,
            throw=False,
            allow_unstable=True,
        )
        return trajectory.saved[1:]

    def one(change: Array) -> Array:
        _, moved = jax.jvp(path, (state.v,), (change,))
        # Scaled, so that in single precision no square overflows.
        scale = jnp.max(jnp.abs(moved), axis=(1, 2), keepdims=True)
        parts = moved / jnp.where(scale > 0, scale, 1)
        return scale[:, 0, 0] * jnp.sqrt(jnp.sum(parts * parts, axis=(1, 2)))

    return jax.vmap(one)(changes)


def magnified(problem: AbstractProblem, point: Point) -> list[str]:
    """Which coordinates change what is seen too much for the derivative to mean anything.

    The change of what is seen, over how much that varies at all, per change of a coordinate by one
    (of a logarithm: by its value), or by itself where it is larger.
    """
    size = np.sqrt(sum(_variation(o) for o in problem.watched))
    if not size > 0:
        return []
    change = np.linalg.norm(point.rows, axis=1) * np.maximum(1, np.abs(point.u))
    return [
        f"{name}: what is seen changes by {ratio:.1e} times as much as it varies, per relative "
        f"change of it: {_ADVICE}"
        for name, ratio in zip(problem.names, change / size, strict=True)
        if ratio > LARGEST_GROWTH
    ]


def _variation(o: AbstractObservation) -> float:
    """Squared sum of the deviations of the data from their mean, in units of their noise."""
    data, sigma = np.asarray(o.data, np.float64), np.asarray(o.sigma, np.float64)
    weights = np.asarray(o.weights, np.float64).reshape(-1, *(1,) * (data.ndim - 1))
    if not np.isfinite(data).any():
        return 0.0
    return float(np.nansum(weights * ((data - np.nanmean(data)) / sigma) ** 2))
