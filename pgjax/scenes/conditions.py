"""What acts on particles in a scene file: `[[particles]]`."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from pgjax.boundary import (
    AbstractParticleCondition,
    ParticleForce,
    ParticleImpulse,
    ParticleMotion,
    Steady,
    Wind,
    release_times,
)
from pgjax.scenes.motions import ZERO, motion, window
from pgjax.scenes.reader import REQUIRED, Table
from pgjax.scenes.regions import Selection, selection

# A condition from a mask of the particles and the positions of all.
Make = Callable[[np.ndarray, np.ndarray], AbstractParticleCondition]


@dataclasses.dataclass(frozen=True)
class ParticlesPart:
    """A condition on some of the particles.

    Attributes:
        make: the condition from a mask of the particles and the positions of all.
        takes: which particles.
    """

    make: Make
    takes: Selection


def particles(t: Table) -> ParticlesPart:
    """A condition of particles from its table."""
    return ParticlesPart(t.kind("type", TYPES), selection(t))


def _hold(t: Table) -> Make:
    times = window(t)
    return lambda mask, _: ParticleMotion(mask, Steady(ZERO), **times)


def _move(t: Table) -> Make:
    led, times = t.table("motion").read(motion), window(t)
    return lambda mask, x: ParticleMotion(mask, led(x[mask].mean(axis=0)), **times)


def _velocity(t: Table) -> Make:
    """A motion with one velocity, in short."""
    velocity, times = t.vector("velocity"), window(t)
    return lambda mask, _: ParticleMotion(mask, Steady(velocity), **times)


def _impulse(t: Table) -> Make:
    momentum = t.vector("momentum")
    start, duration = t.number("start", 0.0), t.number("duration", 0.0, at_least=0)
    return lambda mask, _: ParticleImpulse(mask, momentum, start, duration)


def _force(t: Table) -> Make:
    force, times = t.vector("force"), window(t)
    return lambda mask, _: ParticleForce(mask, force, **times)


def _release(t: Table) -> Make:
    """Held from the beginning, and let go one after the other along a direction."""
    direction = t.vector("direction")
    if not any(direction):
        raise t.error("direction", "not be zero")
    times = window(t, start=0.0, end=REQUIRED)
    layers = t.integer("layers", None, at_least=2)

    def make(mask: np.ndarray, x: np.ndarray) -> AbstractParticleCondition:
        ends = np.full(len(mask), math.inf)
        ends[mask] = release_times(x[mask], direction, layers=layers, **times)
        return ParticleMotion(mask, Steady(ZERO), start=-math.inf, end=ends)

    return make


def _wind(t: Table) -> Make:
    velocity = t.vector("velocity")
    rate, quadratic = t.number("rate", 0.0, at_least=0), t.number("quadratic", 0.0, at_least=0)
    if rate == quadratic == 0:
        raise t.error("rate", "be positive, or `quadratic`, so that there is a drag")
    times = window(t)
    return lambda mask, _: Wind(velocity, rate, quadratic, mask, **times)


TYPES: dict[str, Callable[[Table], Make]] = {
    "hold": _hold,
    "move": _move,
    "velocity": _velocity,
    "impulse": _impulse,
    "force": _force,
    "release": _release,
    "wind": _wind,
}
"""The conditions by name."""
