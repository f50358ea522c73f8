"""Active fibres of a scene file: `active = { direction, activation, frequency, phase }`."""

import math
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Scalar, parameter
from pgjax.models import ActiveStress
from pgjax.scenes.arrays import field, vector_field
from pgjax.scenes.reader import Table


@final
class Sine(eqx.Module):
    """The signal `s(t) = sin(2π f t + φ)` of active fibres.

    Args:
        frequency: f, 1/s. One value or one per particle, as the phase.
        phase: φ, radians; one per particle makes a travelling wave.
    """

    frequency: Array = parameter()
    phase: Array = parameter(default=0.0)

    def __call__(self, t: Scalar) -> Scalar:
        """The signal at the time t, s."""
        return jnp.sin(2 * math.pi * self.frequency * t + self.phase)


def active(t: Table) -> ActiveStress:
    """Fibres that pull all the time, or as a sine where `frequency` is given."""
    direction, activation = vector_field(t, "direction"), field(t, "activation")
    signal: Any = None
    frequency, phase = field(t, "frequency", None, above=0), field(t, "phase", 0.0)
    if frequency is not None:
        signal = Sine(frequency, phase * (math.pi / 180))
    elif t.has("phase"):
        raise t.error("phase", "be left out where there is no `frequency`")
    return ActiveStress(direction, activation, signal)
