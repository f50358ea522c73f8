"""What each member needs: steps for a frame; and which cannot be simulated at all, and why."""

import dataclasses
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Scalar
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.sweeps.members import Members, Values
from pgjax.timestep import ADVECTIVE_FRACTION, DEFORMATION_FRACTION, limits, substeps_for

Build = Callable[[Values], tuple[Scene, State]]

# Members that are looked at in one call.
_AT_ONCE = 64


@final
@dataclasses.dataclass(frozen=True)
class Need:
    """Of n members.

    Attributes:
        substeps: steps per frame, `(n,)`; 0 of a member that cannot be simulated.
        errors: of those, why, by number.
    """

    substeps: np.ndarray
    errors: dict[int, str]


def needs(
    build: Build,
    members: Members,
    frame_dt: float,
    *,
    dt: float | None,
    fraction: float,
    allow_unstable: bool,
) -> Need:
    """The steps per frame of each member, and the errors of those that cannot be simulated.

    A member whose scene cannot be built has the error that `build` raises. As that takes long, not
    all are built: the allowed values of a parameter are taken for an interval, whose ends are
    looked for from the smallest and the largest value inwards.
    """
    errors = _refused(build, members)
    recommended, rest = _limits(build, members, fraction)
    substeps = np.zeros(len(members), np.int64)
    for i in range(len(members)):
        if i in errors:
            continue
        try:
            wanted = _step(recommended[i], rest[i], dt, allow_unstable)
            substeps[i] = substeps_for(frame_dt, wanted)
        except ValueError as error:
            errors[i] = _reason(build, members, i) or str(error)
    return Need(substeps, errors)


def _step(recommended: float, rest: float, dt: float | None, allow_unstable: bool) -> float:
    """The longest step of a member, s: the given one, or the recommended."""
    if not rest > 0 or not recommended > 0:
        raise ValueError(
            f"The stable time step must be positive, but is {min(rest, recommended):g} s: is a "
            f"parameter outside of its range?"
        )
    if dt is None:
        return recommended
    if dt > rest * (1 + 1e-6) and not allow_unstable:
        raise ValueError(
            f"Argument `dt` must be at most {rest:.4g} s, the largest stable time step of this "
            f"member at rest, but is {dt:.4g} s."
        )
    return dt


def _reason(build: Build, members: Members, index: int) -> str | None:
    """Why a scene cannot be built; None if it can."""
    try:
        build(members.some(index))
    except ValueError as error:
        return str(error)
    return None


def _refused(build: Build, members: Members) -> dict[int, str]:
    """The members whose scene cannot be built, and why."""
    errors: dict[int, str] = {}
    asked: set[int] = set()

    def refused(index: int) -> bool:
        if index not in asked:
            asked.add(index)
            reason = _reason(build, members, index)
            if reason is not None:
                errors[index] = reason
        return index in errors

    def refused_everywhere(having: np.ndarray) -> bool:
        """Whether all members with a value are refused; of some it may be for another's sake."""
        # From the middle on, where the other values are rather those that are allowed.
        return all(refused(int(i)) for i in np.roll(having, -(len(having) // 2)))

    for values in members.values.values():
        _, which = np.unique(values, axis=0, return_inverse=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        having = np.split(order, np.flatnonzero(np.diff(which.reshape(-1)[order])) + 1)
        # From both ends inwards: what is allowed is an interval.
        for inwards in (having, having[::-1]):
            for some in inwards:
                if not refused_everywhere(some):
                    break
    return errors


def _limits(build: Build, members: Members, fraction: float) -> tuple[np.ndarray, np.ndarray]:
    """The recommended time step and the sharp bound at rest of each member, s, `(n,)`."""
    arrays, static = eqx.partition(build, eqx.is_array)

    def one(arrays: Any, values: Values) -> tuple[Scalar, Scalar]:
        scene, state = eqx.combine(arrays, static)(values)
        rest = scene.rest_limit()
        now = jax.tree.map(jnp.min, limits(scene, state))
        elastic = fraction * jnp.minimum(rest, now.elastic.astype(rest.dtype))
        others = (ADVECTIVE_FRACTION * now.advective, DEFORMATION_FRACTION * now.deformation)
        return jnp.min(jnp.stack([a.astype(rest.dtype) for a in (elastic, *others)])), rest

    @jax.jit
    def some(arrays: Any, values: Values) -> tuple[Array, Array]:
        # One after the other: memory for one.
        return jax.lax.map(lambda one_of: one(arrays, one_of), values)

    found = []
    for first in range(0, len(members), _AT_ONCE):
        indices = np.arange(first, first + _AT_ONCE)
        batch = members.some(np.minimum(indices, len(members) - 1))
        found.append([np.asarray(a, np.float64) for a in some(arrays, batch)])
    recommended, rest = (np.concatenate(a)[: len(members)] for a in zip(*found, strict=True))
    return recommended, rest
