"""How many steps a frame of a problem needs: decided once, for the stiffest scene."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pgjax.inverse.parameters import Parameter, Space, Values
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.timestep import stable_dt, substeps_for

Build = Callable[[Values], tuple[Scene, State]]


class _Limit(NamedTuple):
    """The time step of one scene, s: the one that is used, and the sharp one at rest."""

    used: float
    rest: float


def steps_per_frame(
    space: Space, build: Build, frame_dt: float, substeps: int | None, fraction: float
) -> int:
    """Steps per frame that are enough for the stiffest scene within the bounds."""

    def limit(u: np.ndarray) -> _Limit:
        scene, state = build(space.values(u))
        rest = float(scene.rest_limit())
        return _Limit(
            stable_dt(scene, state, fraction=fraction) if substeps is None else rest, rest
        )

    worst = _stiffest(space, limit)
    needed = substeps_for(frame_dt, limit(worst).used)
    if substeps is None:
        return needed
    if isinstance(substeps, bool) or not isinstance(substeps, int | np.integer) or substeps < 1:
        raise ValueError(f"Argument `substeps` must be a whole number ≥ 1, but is {substeps!r}.")
    if substeps < needed:
        at = ", ".join(f"{n} = {v}" for n, v in space.known(worst).items())
        raise ValueError(
            f"Argument `substeps` must be at least {needed}, for the stable time step at the "
            f"stiffest the bounds allow ({at}), but is {substeps}."
        )
    return int(substeps)


def _stiffest(space: Space, limit: Callable[[np.ndarray], _Limit]) -> np.ndarray:
    """The corner of the bounds with the smallest time step, found parameter by parameter.

    Exact where the limit is monotone in each parameter, as it is in moduli and densities. All
    entries of a parameter move together.
    """
    u = space.start.copy()
    lower, upper = space.bounds()
    best, place = limit(u), 0
    for name, parameter in space.free.items():
        own = slice(place, place + parameter.start.size)
        place = own.stop
        for bound, sign, side in ((lower[own], -1, "lower"), (upper[own], 1, "upper")):
            trial = u.copy()
            known = np.isfinite(bound)
            trial[own][known] = bound[known]
            if known.any():
                at_bound = limit(trial)
                # Of equal ones the farther: together with the next it may be the smallest.
                if at_bound.used <= best.used:
                    u, best = trial, at_bound
            if not known.all():
                _require_no_limit(name, side, parameter, limit, u, own, sign, best)
    return u


def _require_no_limit(
    name: str,
    side: str,
    parameter: Parameter,
    limit: Callable[[np.ndarray], _Limit],
    u: np.ndarray,
    own: slice,
    sign: int,
    best: _Limit,
) -> None:
    """Raise if the time step at rest falls on the side where nothing bounds a parameter."""
    for far in (1e-2, 1.0, 4.0):
        trial = u.copy()
        trial[own] += sign * far * (1.0 if parameter.log else np.maximum(1, np.abs(trial[own])))
        reason = "the stable time step depends on it, and is decided once for the stiffest scene"
        try:
            falls = limit(trial).rest < best.rest * (1 - 1e-4)
        except ValueError as error:
            falls, reason = True, str(error)
        if falls:
            raise ValueError(
                f"Argument `{side}` of parameter {name!r} must be given: {reason.rstrip('.')}."
            )
