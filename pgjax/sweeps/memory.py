"""How many members are run at once: as the threads of a CPU want, and as memory allows."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._files import cores
from pgjax._files import memory as memory_of_machine
from pgjax._types import Array
from pgjax.scenes.summary import needed_memory
from pgjax.sweeps.members import Values
from pgjax.sweeps.need import Build
from pgjax.sweeps.program import Measure, Save, rollout

# Of the memory of a machine or an accelerator, all members at a time take at most this part.
_PART = {"cpu": 0.25, "gpu": 0.6, "tpu": 0.6}
# Particles that a thread of a CPU has to do in each operation, so that starting it costs little.
_PARTICLES_PER_THREAD = 2000
# Members for each thread of a CPU device that has several: they finish at different times.
_MEMBERS_PER_THREAD = 4


def lanes_within(
    memory: float | None,
    one: int,
    particles: int,
    devices: Sequence[jax.Device],
    members: int,
) -> int:
    """Members in a group.

    Args:
        memory: bytes that the groups of one device may take; a part of what it has if None.
        one: bytes that a member takes.
        particles: of a member.
        devices: where they run.
        members: how many there are.

    Raises:
        ValueError: `memory` is too small for one.
    """
    if memory is not None and one > memory:
        raise ValueError(
            f"Argument `memory` must be at least {one:.3g} (bytes), what one member takes, but is "
            f"{memory:.3g}."
        )
    limit = _available(devices) if memory is None else memory
    most = min(limit / one, members)
    if devices[0].platform == "cpu":
        most = min(most, _busy(particles, len(devices)))
    # As few calls as that takes, all of about the same size.
    most = max(int(most), 1)
    return math.ceil(members / math.ceil(members / most))


def _busy(particles: int, devices: int) -> int:
    """Members that keep the threads of one of several CPU devices busy."""
    threads = max(1, cores() // devices)
    each = math.ceil(_PARTICLES_PER_THREAD / particles)
    return each if threads == 1 else each * _MEMBERS_PER_THREAD * threads


def _available(devices: Sequence[jax.Device]) -> float:
    """Bytes that the groups of one device may take."""
    device = devices[0]
    part = _PART.get(device.platform, _PART["gpu"])
    if device.platform == "cpu":
        return part * memory_of_machine() / len(devices)
    known = device.memory_stats() or {}
    return part * known.get("bytes_limit", math.inf)


def per_member(
    build: Build, values: Values, measure: Measure, save: Save, frames: int
) -> tuple[int, int]:
    """Bytes that a member takes while it runs, from shapes alone, and its particles."""
    scene, state = build(values)
    running = sum(needed_memory(scene, state))

    def whole(scene: Any, state: Any, dt: Array, substeps: Array) -> Any:
        trajectory = rollout(scene, state, dt, substeps, frames, save)
        return trajectory.saved, measure(scene, state, trajectory)

    dt, substeps = jnp.zeros((), state.dtype), jnp.ones((), jnp.int32)
    kept = eqx.filter_eval_shape(whole, scene, state, dt, substeps)
    sizes = (math.prod(s.shape) * s.dtype.itemsize for s in jax.tree.leaves(kept))
    return running + sum(sizes), scene.particle_count
