"""Sums over the devices that share one scene; on one device they are what is summed."""

import jax

from pgjax._types import Array

# The axis of the mesh over which the particles of one scene are spread.
AXIS = "pgjax_parts"


def total(a: Array) -> Array:
    """The sum over all devices that share the particles of a scene; `a` itself on one device.

    A function of particles that looks at more than one of them at a time, such as a mean velocity,
    needs it: it is called on each device with that device's particles.
    """
    shared = AXIS in jax.sharding.get_abstract_mesh().manual_axes
    return jax.lax.psum(a, AXIS) if shared else a
