"""An identification problem: unknowns, the simulation they give, and what was recorded of it."""

import abc
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Bool, Float, positive, require
from pgjax.inverse.observations import AbstractObservation
from pgjax.inverse.parameters import Parameter, Space, Values
from pgjax.inverse.steps import Build, steps_per_frame
from pgjax.result import Status
from pgjax.scene import Scene
from pgjax.simulate import simulate
from pgjax.state import State
from pgjax.timestep import ELASTIC_FRACTION

# Directions of the Jacobian that are computed at once.
_DIRECTIONS = 8


class Outcome(NamedTuple):
    """One simulation against the data.

    Attributes:
        residual: differences over their noise, `(m,)`.
        prior: the same of the priors, `(k,)`.
        status: what happened in the simulation.
    """

    residual: Float[Array, "*batch m"]
    prior: Float[Array, "*batch k"]
    status: Status

    @property
    def cost(self) -> Float[Array, "*batch"]:
        """Half the squared sum of residual and prior."""
        return (jnp.sum(self.residual**2, axis=-1) + jnp.sum(self.prior**2, axis=-1)) / 2

    @property
    def ok(self) -> Bool[Array, "*batch"]:
        """Whether no particle was lost and the residual is finite."""
        return self.status.ok & jnp.all(jnp.isfinite(self.residual), axis=-1)


class AbstractProblem(eqx.Module):
    """What a solver asks for: unknowns, and the residual they give.

    Attributes:
        space: the unknowns.
    """

    space: eqx.AbstractVar[Space]

    @property
    def names(self) -> list[str]:
        """Of the free coordinates."""
        return self.space.names

    @property
    @abc.abstractmethod
    def last(self) -> int:
        """Number of the last frame that is simulated."""

    @property
    @abc.abstractmethod
    def watched(self) -> tuple[AbstractObservation, ...]:
        """Everything that is compared."""

    @abc.abstractmethod
    def outcome(self, u: Float[Array, " size"]) -> Outcome:
        """Simulate at free coordinates u and compare. Pure; differentiable in u."""

    @abc.abstractmethod
    def until(self, frame: int) -> "AbstractProblem":
        """The problem of what was recorded up to a frame, with the same time step.

        Raises:
            ValueError: nothing was recorded by then.
        """

    @abc.abstractmethod
    def coarser(self, pixels: int) -> "AbstractProblem":
        """The problem in which pictures are seen through squares of so many pixels."""

    @abc.abstractmethod
    def moments(self) -> np.ndarray:
        """Which instant each entry of the residual is of: numbers that differ, `(m,)`."""

    @abc.abstractmethod
    def with_space(self, space: Space) -> "AbstractProblem":
        """The same motion and data with other starts, or others of the parameters fixed."""

    def freeing(self, names: Sequence[str], values: Mapping[str, Any]) -> "AbstractProblem":
        """The problem in which these parameters alone are free, the others fixed at `values`."""
        unknown = sorted(set(names) - set(self.space.free))
        if unknown:
            raise ValueError(
                f"Argument `names` must name free parameters ({', '.join(self.space.free)}), but "
                f"names {', '.join(unknown)}."
            )
        parameters = {
            name: p.replace(start=np.asarray(values[name]), fixed=p.fixed or name not in names)
            for name, p in self.space.parameters.items()
        }
        return self.with_space(Space(parameters))


@final
class Problem(AbstractProblem):
    """Which parameters make the simulation look like the data.

    The time step is decided once, for the stiffest scene the bounds allow, and is the same for
    every start, step and solver.

    Args:
        parameters: the unknowns by name.
        build: from the values by name to scene and initial state. It is traced: the number of
            particles and the grid must not depend on the values, and what is expensive belongs
            outside of it.
        observations: one, or several whose residuals are put one after the other.
        frame_dt: duration of a frame, s: one over the frame rate of the data.
        frames: number of frames to simulate; up to the last observed one if None.
        substeps: steps per frame; as many as the time step needs if None.
        fraction: part of the elastic limit of the time step, as for `stable_dt`.

    Raises:
        ValueError: an argument is out of range; the time step depends on a parameter that has no
            bound; `substeps` is too small for the stiffest scene.
    """

    space: Space
    build: Build
    observations: tuple[AbstractObservation, ...]
    frame_dt: float = eqx.field(static=True)
    frames: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True)

    def __init__(
        self,
        parameters: Mapping[str, Parameter],
        build: Build,
        observations: AbstractObservation | Sequence[AbstractObservation],
        *,
        frame_dt: float,
        frames: int | None = None,
        substeps: int | None = None,
        fraction: float = ELASTIC_FRACTION,
    ):
        self.space = Space(parameters)
        self.build = build
        single = isinstance(observations, AbstractObservation)
        self.observations = (observations,) if single else tuple(observations)
        if not self.observations:
            raise ValueError("Argument `observations` must hold at least one, but is empty.")
        require("frame_dt", frame_dt, "be positive and finite (s)", positive)
        self.frame_dt = float(frame_dt)
        last = max(o.frames[-1] for o in self.observations)
        self.frames = max(last, 1) if frames is None else int(frames)
        if self.frames < last:
            raise ValueError(
                f"Argument `frames` must reach the last observed frame, {last}, but is {frames}."
            )
        scene, _ = build(self.space.values(self.space.start))
        _check_particles(self.observations, scene)
        self.substeps = steps_per_frame(self.space, build, self.frame_dt, substeps, fraction)

    @property
    def dt(self) -> float:
        """Time step, s."""
        return self.frame_dt / self.substeps

    @property
    def last(self) -> int:
        """Number of the last frame that is simulated."""
        return self.frames

    @property
    def watched(self) -> tuple[AbstractObservation, ...]:
        """Everything that is compared."""
        return self.observations

    def until(self, frame: int) -> "Problem":
        """The problem of what was recorded up to a frame, with the same time step.

        Raises:
            ValueError: nothing was recorded by then.
        """
        kept = [part for o in self.observations if (part := o.until(frame)) is not None]
        if not kept or frame < 1:
            raise ValueError(
                f"Argument `frame` must be at least 1 and not before the first observed frame, but "
                f"is {frame}."
            )
        return self._with(self.space, tuple(kept), min(frame, self.frames))

    def coarser(self, pixels: int) -> "Problem":
        """The problem in which pictures are seen through squares of so many pixels."""
        seen = tuple(o.coarser(pixels) for o in self.observations)
        return self._with(self.space, seen, self.frames)

    def moments(self) -> np.ndarray:
        """Number of the frame each entry of the residual is of, `(m,)`."""

        def parts(values: Values) -> list[Array]:
            """The residual of each observation, of a body that stays where it is."""
            # The motion is not needed for its shape: the initial state, again and again.
            _, state = self.build(values)
            return [
                o.residual(
                    jax.tree.map(
                        lambda a: jnp.broadcast_to(a, (self.frames + 1, *a.shape)), o.see(state)
                    )
                )
                for o in self.observations
            ]

        shapes = jax.eval_shape(parts, self.space.values(self.space.start))
        return np.concatenate(
            [
                np.repeat(o.frames, part.size // len(o.frames))
                for o, part in zip(self.observations, shapes, strict=True)
            ]
        )

    def with_space(self, space: Space) -> "Problem":
        """The same motion and data with other starts, or others of the parameters fixed."""
        return self._with(space, self.observations, self.frames)

    def observing(
        self, observations: AbstractObservation | Sequence[AbstractObservation]
    ) -> "Problem":
        """The same unknowns and motion, observed in another way."""
        single = isinstance(observations, AbstractObservation)
        kept = (observations,) if single else tuple(observations)
        frames = max(self.frames, *(o.frames[-1] for o in kept))
        _check_particles(kept, self.build(self.space.values(self.space.start))[0])
        return self._with(self.space, kept, frames)

    def _with(
        self, space: Space, observations: tuple[AbstractObservation, ...], frames: int
    ) -> "Problem":
        """Without looking for the time step again."""
        new = object.__new__(Problem)
        for name, value in (
            ("space", space),
            ("build", self.build),
            ("observations", observations),
            ("frame_dt", self.frame_dt),
            ("frames", frames),
            ("substeps", self.substeps),
        ):
            object.__setattr__(new, name, value)
        return new

    def see(self, u: Float[Array, " size"]) -> tuple[tuple[Any, ...], Status]:
        """What each observation would see of all frames at free coordinates u, and the status."""
        return self._see(self.space.values(u))

    def _see(self, values: Values) -> tuple[tuple[Any, ...], Status]:
        scene, state = self.build(values)
        trajectory = simulate(
            scene,
            state,
            dt=self.dt,
            frames=self.frames,
            substeps=self.substeps,
            save=_Seen(self.observations),
            throw=False,
            allow_unstable=True,
        )
        return trajectory.saved, trajectory.status

    def outcome(self, u: Float[Array, " size"]) -> Outcome:
        """Simulate at free coordinates u and compare. Pure; differentiable in u."""
        residual, status = self.compared(self.space.values(u))
        return Outcome(residual, self.space.prior_residual(u).astype(residual.dtype), status)

    def compared(self, values: Values) -> tuple[Float[Array, " m"], Status]:
        """Residual of the data and status at values by name."""
        saved, status = self._see(values)
        parts = [o.residual(seen) for o, seen in zip(self.observations, saved, strict=True)]
        dtype = jnp.result_type(*parts)
        return jnp.concatenate([part.astype(dtype) for part in parts]), status


@final
class _Seen(eqx.Module):
    observations: tuple[AbstractObservation, ...]

    def __call__(self, state: State) -> tuple[Any, ...]:
        return tuple(o.see(state) for o in self.observations)


@eqx.filter_jit
def outcome(problem: AbstractProblem, u: Float[Array, " size"]) -> Outcome:
    """`problem.outcome`, compiled."""
    return problem.outcome(u)


@eqx.filter_jit
def costs(
    problem: AbstractProblem, us: Float[Array, "n size"], at_once: int
) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Costs of several points, and which of the simulations can be used."""

    def one(u: Array) -> tuple[Array, Array]:
        result = problem.outcome(u)
        return result.cost, result.ok

    return jax.lax.map(one, us, batch_size=at_once)


@eqx.filter_jit
def linearised(
    problem: AbstractProblem, u: Float[Array, " size"]
) -> tuple[Outcome, Float[Array, "p m"]]:
    """Outcome and the rows `∂r/∂u_j`, in forward mode, one tangent per coordinate.

    Up to eight tangents are computed beside one run.
    """
    size = u.shape[0]

    def push(direction: Array) -> tuple[Outcome, Array]:
        def residual(u: Array) -> tuple[Array, Outcome]:
            result = problem.outcome(u)
            return result.residual, result

        _, tangent, result = jax.jvp(residual, (u,), (direction,), has_aux=True)
        return result, tangent

    rows, result = [], None
    for first in range(0, size, _DIRECTIONS):
        directions = jnp.eye(size, dtype=u.dtype)[first : first + _DIRECTIONS]
        result, some = jax.vmap(push, out_axes=(None, 0))(directions)
        rows.append(some)
    assert result is not None
    return result, jnp.concatenate(rows)


@eqx.filter_jit
def cost_and_slope(
    problem: AbstractProblem, u: Float[Array, " size"]
) -> tuple[Outcome, Float[Array, " size"]]:
    """Outcome and the gradient of its cost, in reverse mode through checkpointed steps."""

    def cost(u: Array) -> tuple[Array, Outcome]:
        result = problem.outcome(u)
        return result.cost, result

    slope, result = jax.grad(cost, has_aux=True)(u)
    return result, slope


def _check_particles(observations: Sequence[AbstractObservation], scene: Scene) -> None:
    """What is observed is there; an index that is too large would be clamped in silence."""
    for o in observations:
        chosen = getattr(o, "particles", None)
        if chosen is not None and np.max(chosen) >= scene.particle_count:
            raise ValueError(
                f"Argument `particles` must hold numbers below {scene.particle_count}, the number "
                f"of particles, but holds {np.max(chosen)}."
            )
