"""What can go wrong in a rollout: conditions, when they first held, and how they are reported."""

import enum
import warnings
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Bool, Int, concrete

NEVER = np.iinfo(np.int32).max


class Condition(enum.IntEnum):
    """One kind of event of a rollout."""

    NONFINITE = 0
    OUT_OF_DOMAIN = 1
    INVERTED = 2
    CLAMPED = 3
    DT_ABOVE_BOUND = 4
    ELLIPTICITY_LOST = 5
    F32_RESOLUTION = 6
    OVERFLOW = 7


ERRORS = (Condition.NONFINITE, Condition.OUT_OF_DOMAIN, Condition.OVERFLOW)

_MEANING = {
    Condition.NONFINITE: (
        "{count} particle(s) became NaN or infinite and were masked. The usual causes are a time "
        "step above the stable one (see `stable_dt`) and NaN in a force or a boundary."
    ),
    Condition.OUT_OF_DOMAIN: (
        "{count} particle(s) left the grid and were masked. Enlarge the grid, or add a boundary "
        "(`pgjax.boundary.Box`) that keeps them in."
    ),
    Condition.INVERTED: (
        "particles were turned inside out (det F ≤ 0), {count} particle-step(s). The motion is "
        "suspect there: use a smaller time step, a finer grid or a stiffer material."
    ),
    Condition.CLAMPED: (
        "the constitutive law was continued beyond its domain (volume ratio below 1e-2 or stretch "
        "below 1e-4), {count} particle-step(s)."
    ),
    Condition.DT_ABOVE_BOUND: (
        "the time step was above the stable one for the state of {count} particle-frame(s); "
        "deformation and speed lower it. Use a smaller `dt`."
    ),
    Condition.ELLIPTICITY_LOST: (
        "the Hencky law lost ellipticity (stretch above about 2.7) for {count} "
        "particle-frame(s): the material, not the time step, is unstable there."
    ),
    Condition.F32_RESOLUTION: (
        "single precision does not resolve {count} particle-frame(s) (more than 30 000 particles "
        "in a cell, or a ratio of stretches beyond 1e5). Use float64."
    ),
    Condition.OVERFLOW: (
        "{count} particle(s) left their slab and could not go over to the next one, and were "
        "masked. Give `Slabs` a larger `capacity`, a smaller `every` or a larger `margin`."
    ),
}


class SimulationError(RuntimeError):
    """A rollout met a condition after which its result cannot be trusted."""


class SimulationWarning(UserWarning):
    """A rollout met a condition that makes part of its result doubtful."""


@final
class Status(eqx.Module):
    """Per `Condition`, the first step at which it held and how often.

    Attributes:
        first: step, or `NEVER`, int32 `(conditions,)`.
        count: number of events (particles lost; particle-steps; particle-frames), int32.
    """

    first: Int[Array, "*batch conditions"]
    count: Int[Array, "*batch conditions"]

    @staticmethod
    def clear() -> "Status":
        """Nothing has happened yet."""
        k = len(Condition)
        return Status(jnp.full((k,), NEVER, jnp.int32), jnp.zeros((k,), jnp.int32))

    def note(self, events: dict[Condition, Int[Array, ""]], step: Int[Array, ""]) -> "Status":
        """Count the events of one step: how many there were of each kind."""
        first, count = self.first, self.count
        for condition, n in events.items():
            first = first.at[condition].min(jnp.where(n > 0, step, NEVER))
            # Saturating: a count never wraps round.
            total = count[condition]
            count = count.at[condition].set(jnp.where(total > NEVER - n, NEVER, total + n))
        return Status(first, count)

    def merged(self, other: "Status") -> "Status":
        """What happened in one of two rollouts."""
        total = jnp.where(self.count > NEVER - other.count, NEVER, self.count + other.count)
        return Status(jnp.minimum(self.first, other.first), total)

    def happened(self, condition: Condition) -> Bool[Array, "*batch"]:
        """Whether the condition ever held."""
        return self.count[..., condition] > 0

    @property
    def ok(self) -> Bool[Array, "*batch"]:
        """Whether no error condition ever held."""
        return ~jnp.any(self.count[..., jnp.asarray(ERRORS)] > 0, axis=-1)

    def messages(self, conditions: tuple[Condition, ...] = tuple(Condition)) -> list[str]:
        """One sentence for each of the conditions that held, with step, count and cure."""
        first, count = np.asarray(self.first), np.asarray(self.count)
        return [
            f"{c.name} from step {first[c]} on: {_MEANING[c].format(count=count[c])}"
            for c in conditions
            if count[c] > 0
        ]

    def check(self) -> None:
        """Raise `SimulationError` for errors, warn for the rest; nothing while being traced.

        Raises:
            SimulationError: a particle left the grid, became NaN or found no place on its device.
        """
        if concrete(self.count) is None or self.count.ndim != 1:
            return
        soft = tuple(c for c in Condition if c not in ERRORS)
        for message in self.messages(soft):
            warnings.warn(message, SimulationWarning, stacklevel=3)
        errors = self.messages(ERRORS)
        if errors:
            raise SimulationError(" ".join(errors))
