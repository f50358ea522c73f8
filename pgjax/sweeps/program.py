"""The compiled program of a sweep: groups of members, one on each device, from start to end."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pgjax._types import Array, Int, Scalar
from pgjax.monitor import note_frame, note_start
from pgjax.result import Status
from pgjax.scene import Scene
from pgjax.simulate import Trajectory
from pgjax.state import State
from pgjax.step import step
from pgjax.sweeps.members import Values
from pgjax.sweeps.need import Build

# What is kept of a member: numbers and arrays by name.
Measured = dict[str, Array]
Measure = Callable[[Scene, State, Trajectory], Measured]
Save = Callable[[State], Any]

_AXIS = "members"


def rollout(
    scene: Scene, state: State, dt: Scalar, substeps: Int[Array, ""], frames: int, save: Save
) -> Trajectory:
    """`simulate`, forward only: the number of steps per frame is not known to the compiler."""
    start = note_start(scene, state, dt)

    def frame(state: State, _: None) -> tuple[State, Any]:
        zero = jnp.zeros((), substeps.dtype)
        state = jax.lax.fori_loop(zero, substeps, lambda _, s: step(scene, s, dt), state)
        state = note_frame(scene, state, dt)
        return state, save(state)

    end, rest = jax.lax.scan(frame, start, None, length=frames)
    saved = jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), save(start), rest)
    steps = state.step + substeps * jnp.arange(frames + 1, dtype=substeps.dtype)
    return Trajectory(saved, steps.astype(dt.dtype) * dt, end, end.status)


@final
@dataclasses.dataclass(frozen=True)
class Task:
    """What is done with each member.

    Attributes:
        build: from values to scene and initial state.
        measure: what is kept of it.
        save: what its trajectory keeps of each frame.
        frames: to run.
        frame_dt: duration of a frame, s.
    """

    build: Build
    measure: Measure
    save: Save
    frames: int
    frame_dt: float


@final
class Program:
    """What runs one group of members on each device; compiled at the first call.

    Args:
        task: what is done with each member.
        devices: where to run.
        lanes: members in a group.
    """

    def __init__(self, task: Task, devices: Sequence[jax.Device], lanes: int):
        self.devices, self.lanes, self.frame_dt = tuple(devices), lanes, task.frame_dt
        self._mesh = Mesh(np.asarray(self.devices), (_AXIS,))
        # The arrays a `build` that is a module holds are operands, not constants of the program.
        arrays, static = eqx.partition(task.build, eqx.is_array)
        self._arrays = jax.device_put(arrays, NamedSharding(self._mesh, PartitionSpec()))
        # Of what is measured, in its own order: `jit` sorts the keys of a dict.
        self._names: list[str] = []
        one = _member(task, static, self._names)
        self._jitted = jax.jit(_on_each_device(one, self._mesh, lanes))
        self._compiled: Any = None

    def __call__(
        self, values: Values, substeps: np.ndarray
    ) -> tuple[dict[str, np.ndarray], Status, float]:
        """What is kept of `devices × lanes` members, their status, and the seconds it took.

        Args:
            values: of the members, group after group.
            substeps: steps per frame of each group.
        """
        sharding = NamedSharding(self._mesh, PartitionSpec(_AXIS))
        given = jax.device_put((values, jnp.asarray(substeps, jnp.int32)), sharding)
        if self._compiled is None:
            self._compiled = self._jitted.lower(self._arrays, *given).compile()
        began = time.perf_counter()
        measured, status = jax.device_get(self._compiled(self._arrays, *given))
        seconds = time.perf_counter() - began
        return {name: np.asarray(measured[name]) for name in self._names}, status, seconds


def _member(
    task: Task, static: Any, names: list[str]
) -> Callable[[Any, Values, Array], tuple[Measured, Status]]:
    """One member from its values and its steps per frame; `names` is filled when it is traced."""

    def one(arrays: Any, values: Values, substeps: Array) -> tuple[Measured, Status]:
        scene, state = eqx.combine(arrays, static)(values)
        dt = jnp.asarray(task.frame_dt, state.dtype) / substeps.astype(state.dtype)
        trajectory = rollout(scene, state, dt, substeps, task.frames, task.save)
        measured = task.measure(scene, state, trajectory)
        names[:] = measured
        return measured, trajectory.status

    return one


def _on_each_device(one: Callable[..., Any], mesh: Mesh, lanes: int) -> Callable[..., Any]:
    """A group of members on each device. Its loops end with its own members: nothing is sent."""

    def group(arrays: Any, values: Values, substeps: Array) -> Any:
        if lanes == 1:
            # A batch axis of length one would cost copies.
            found = one(arrays, jax.tree.map(lambda a: a[0], values), substeps[0])
            return jax.tree.map(lambda a: jnp.asarray(a)[None], found)
        return jax.vmap(one, in_axes=(None, 0, None))(arrays, values, substeps[0])

    spec = PartitionSpec(_AXIS)
    return jax.shard_map(
        group, mesh=mesh, in_specs=(PartitionSpec(), spec, spec), out_specs=spec, check_vma=False
    )
