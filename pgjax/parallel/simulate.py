"""Rollouts of one scene over several devices."""

import dataclasses
import reprlib
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from pgjax._across import AXIS
from pgjax._types import Array, Scalar, as_tuple, require_kind
from pgjax.boundary import Region
from pgjax.ledger import Flows, Ledger, balance, followed
from pgjax.models.material import cast
from pgjax.monitor import note_frame, note_start
from pgjax.parallel.layout import (
    SHARED,
    Parts,
    collect,
    scene_kinds,
    split,
    spread,
    state_kinds,
)
from pgjax.parallel.plan import AbstractLayout, AbstractPlan
from pgjax.parallel.shared import SharedGrid
from pgjax.result import Status
from pgjax.scene import Scene
from pgjax.simulate import (
    Blocks,
    Trajectory,
    check_arguments,
    kinematics,
    over_frames,
    repeated,
    reporter,
    times,
)
from pgjax.state import State
from pgjax.step import (
    Stages,
    forces_and_boundaries,
    grid_to_particles,
    impose,
    led,
    led_nodes,
    particles_to_grid,
)

# Along its first axis an array is spread over the devices; or each device has the whole of it.
_SPREAD, _WHOLE = PartitionSpec(AXIS), PartitionSpec()


def simulate(
    scene: Scene,
    state: State,
    *,
    dt: float | Array,
    frames: int | float,
    substeps: int | float,
    devices: Sequence[jax.Device] | None = None,
    layout: AbstractLayout | None = None,
    save: Callable[[State], Any] = kinematics,
    progress: bool | Callable[[int, int], None] = False,
    throw: bool = True,
    allow_unstable: bool = False,
    keep_states: bool = False,
    ledger: bool = False,
) -> Trajectory:
    """`pgjax.simulate` of one scene over several devices.

    Arguments and result are those of `pgjax.simulate`: the particles of `state`, of what `save`
    sees and of the trajectory are in the caller's order. The results are the same up to rounding:
    the sums at the nodes have another order. `jit`, `grad` and `jvp` apply to it.

    Conditions of particles and `body_force` are called on each device with its own particles, on
    which they may depend one by one. What looks at several at once takes `parallel.total` for its
    sums. Fields of a condition with one entry per particle are laid out like the particles; a
    function that has closed over such an array cannot be used.

    Args:
        scene: what is constant; at least four particles.
        state: where to start.
        dt: time step, s.
        frames: number of frames to run.
        substeps: steps per frame.
        devices: all that JAX knows by default, those of other hosts included.
        layout: `SharedGrid()`, the default, or `Slabs(...)`.
        save: any function of the state whose result is stacked over frames. Only what it uses of
            the particles is brought into the caller's order.
        progress: True shows a bar; a function is called as `progress(frame, frames)`.
        throw: raise `SimulationError` when a particle was masked.
        allow_unstable: accept a time step above the stable one.
        keep_states: reverse mode keeps the state of every step.
        ledger: keep accounts: `trajectory.ledger`.

    Raises:
        ValueError: an argument is out of range, or dt is above the stable bound at rest.
        SimulationError: a particle left the grid, became NaN, or found no place on its device
            (with `throw`).
    """
    frames, substeps = check_arguments(scene, state, dt, frames, substeps, allow_unstable)
    mesh = _mesh(devices)
    layout = SharedGrid() if layout is None else layout
    require_kind("layout", layout, AbstractLayout)
    if scene.particle_count < 4:
        raise ValueError(
            f"Argument `scene` must have at least 4 particles to be shared among devices, but has "
            f"{scene.particle_count}."
        )
    trajectory = _rollout(
        scene,
        state,
        jnp.asarray(dt, state.dtype),
        layout.planned(scene, state, mesh.size),
        mesh,
        frames,
        substeps,
        save,
        reporter(progress, frames),
        keep_states,
        ledger,
    )
    if throw:
        trajectory.status.check()
    return trajectory


def _mesh(devices: Sequence[jax.Device] | None) -> Mesh:
    chosen = tuple(jax.devices()) if devices is None else as_tuple("devices", devices)
    if not chosen or not all(isinstance(device, jax.Device) for device in chosen):
        raise ValueError(
            f"Argument `devices` must hold devices of JAX, at least one, but is "
            f"{reprlib.repr(devices)}."
        )
    if len(set(chosen)) < len(chosen):
        raise ValueError(f"Argument `devices` must name each device once, but is {chosen}.")
    return Mesh(np.asarray(chosen), (AXIS,))


@eqx.filter_jit
def _rollout(
    scene: Scene,
    state: State,
    dt: Scalar,
    plan: AbstractPlan,
    mesh: Mesh,
    frames: int,
    substeps: int,
    save: Callable[[State], Any],
    report: Callable[[int, int], None] | None,
    keep_states: bool,
    ledger: bool,
) -> Trajectory:
    """The nested scans: steps inside `shard_map`, frames outside of it."""
    blocks = Blocks.of(frames, substeps, keep_states)
    kinds = scene_kinds(scene), state_kinds(state)
    _, rest = split((scene, state), kinds)
    arrays, static = eqx.partition(rest, eqx.is_array)
    own_kinds = jax.tree.map(lambda kind: None if kind == SHARED else kind, kinds)

    def on_devices(run: Callable[[Parts, Device], Parts], parts: Parts) -> Parts:
        def one(parts: Parts, arrays: Any, dt: Scalar) -> Parts:
            return run(parts, Device(plan, own_kinds, eqx.combine(arrays, static), dt))

        own = jax.tree.map(lambda a: _SPREAD if a.ndim else _WHOLE, parts)
        shared = jax.shard_map(one, mesh=mesh, in_specs=(own, _WHOLE, _WHOLE), out_specs=own)
        return shared(parts, arrays, dt)

    def frame(parts: Parts, device: Device) -> Parts:
        advanced = jax.checkpoint(lambda parts: device.advanced(parts))
        parts = repeated(advanced, parts, substeps, block=blocks.steps)
        return device.noted(note_frame, parts)

    def collected(parts: Parts) -> State:
        """Whole on every device, so that every process can look at it."""
        everywhere = NamedSharding(mesh, _WHOLE)
        return jax.lax.with_sharding_constraint(collect(parts, state, plan.places), everywhere)

    def kept(parts: Parts) -> tuple[Any, Ledger | None]:
        whole = collected(parts)
        if parts.flows is None:
            return save(whole), None
        flows = jax.tree.map(lambda a: jnp.sum(a, axis=0), parts.flows)
        return save(whole), balance(scene, whole, flows, dt)

    ids, unplaced = plan.seats(scene, state)
    start = spread(scene, state, ids, unplaced, plan.places, ledger)
    start = on_devices(lambda parts, device: device.noted(note_start, parts), start)
    end, (saved, accounts) = over_frames(
        lambda parts: on_devices(frame, parts), kept, start, frames, blocks, report
    )
    final = collected(end)
    return Trajectory(saved, times(state, dt, frames, substeps), final, final.status, accounts)


@dataclasses.dataclass(frozen=True)
class Device:
    """One device: the plan, the kinds of its own leaves, what it shares with the others, and Δt."""

    plan: AbstractPlan
    kinds: Any
    shared: tuple[Scene, State]
    dt: Scalar

    def joined(self, parts: Parts) -> tuple[Scene, State]:
        """The scene and the state of this device's particles, in the whole grid."""
        shared_scene, shared_state = self.shared
        scene = eqx.combine(parts.scene, shared_scene)
        scene = dataclasses.replace(scene, counts=self.plan.places.sizes)
        status = jax.tree.map(lambda a: a[0], parts.status)
        state = eqx.combine(parts.state, shared_state)
        return scene, eqx.tree_at(lambda s: (s.step, s.status), state, (parts.step, status))

    def parted(self, parts: Parts, state: State, flows: Flows | None) -> Parts:
        """The parts after something has happened to the state."""
        own, _ = split(state, state_kinds(state))
        status, flows = jax.tree.map(lambda a: a[None], (state.status, flows))
        return Parts(parts.scene, own, parts.ids, status, flows, state.step)

    def advanced(self, parts: Parts) -> Parts:
        """One step later."""
        scene, state = self.joined(parts)
        stages = _step(self.plan, scene, state, self.dt)
        flows = None
        if parts.flows is not None:
            before = jax.tree.map(lambda a: a[0], parts.flows)
            flows = followed(scene, state, self._own(stages), before, self.dt)
        after = self.parted(parts, stages.after, flows)
        return self.plan.regrouped(scene.grid, self.kinds, after)

    def _own(self, stages: Stages) -> Stages:
        """With the nodes that this device accounts for alone."""
        own = self.plan.own(stages.nodes)
        of_nodes = {k: jnp.where(own, getattr(stages, k), 0) for k in ("nodes", "walled", "moved")}
        return stages._replace(**of_nodes)

    def noted(self, note: Callable[[Scene, State, Scalar], State], parts: Parts) -> Parts:
        """What is looked at once a frame."""
        scene, state = self.joined(parts)
        position = self.plan.local(scene.grid, state.position)
        scene = eqx.tree_at(lambda s: s.grid, scene, self.plan.grid(scene.grid))
        moved = eqx.tree_at(lambda s: s.position, state, position)
        status: Status = note(scene, moved, self.dt).status
        return eqx.tree_at(lambda p: p.status, parts, jax.tree.map(lambda a: a[None], status))


def _step(plan: AbstractPlan, scene: Scene, state: State, dt: Scalar) -> Stages:
    """`followed_step` of the particles of one device."""
    scene = cast(scene, state.dtype)
    t = state.step.astype(state.dtype) * dt
    held, imposed = impose(scene, state, t, dt)
    imposed, at, inside = plan.stencil(scene, imposed)
    scene = eqx.tree_at(lambda s: s.grid, scene, plan.grid(scene.grid))
    sent, finite, nodes = particles_to_grid(scene, imposed, at, inside, t, dt)
    nodes = plan.added(nodes)
    # Other devices' nodes are not known to lie anywhere.
    infinity = jnp.full((scene.grid.dimension,), jnp.inf, state.dtype)
    walled = forces_and_boundaries(scene, Region(-infinity, infinity), nodes, t, dt)
    leading = led_nodes(scene, sent, at, held)
    moved = led(walled, None if leading is None else plan.added(leading), held)
    after = grid_to_particles(scene, sent, at, finite, held, moved, dt)
    return Stages(imposed, nodes, walled, moved, after)
