"""How the particles of a scene are laid out over devices, and how they come back in order.

Every device has the same number of places for each material; an empty place holds a copy of some
particle that is not alive. Arrays of all devices are one array, split along its first axis.
"""

import dataclasses
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Int
from pgjax.ledger import Flows
from pgjax.models.material import particle_axes
from pgjax.result import Condition, Status
from pgjax.scene import Scene
from pgjax.state import State

# What the first axis of an array counts: nothing, all particles, or those of material 0, 1, ….
SHARED, ALL = -2, -1


@final
class Parts(eqx.Module):
    """What the devices carry from step to step.

    Attributes:
        scene: the arrays of the scene that hold one entry per particle, else None.
        state: those of the state.
        ids: the particle in each place in the caller's order; their number where it is empty.
        status: what happened on each device, `(devices, conditions)`.
        flows: what flowed on each device, `(devices, ...)`, where a ledger is kept.
        step: steps taken.
    """

    scene: Any
    state: Any
    ids: Int[Array, " _"]
    status: Status
    flows: Flows | None
    step: Int[Array, ""]


class Places(NamedTuple):
    """How many places there are.

    Attributes:
        devices: number of devices.
        counts: particles of each material in the scene.
        sizes: places for each material on each device.
    """

    devices: int
    counts: tuple[int, ...]
    sizes: tuple[int, ...]

    @property
    def slices(self) -> tuple[slice, ...]:
        """The places of each material on a device."""
        ends = np.cumsum(self.sizes)
        return tuple(slice(int(e) - s, int(e)) for e, s in zip(ends, self.sizes, strict=True))

    @property
    def starts(self) -> tuple[int, ...]:
        """The first particle of each material."""
        return tuple(int(e) - c for e, c in zip(np.cumsum(self.counts), self.counts, strict=True))

    @property
    def particles(self) -> int:
        """Of the scene."""
        return sum(self.counts)

    def of_kind(self, kind: int, ids: Int[Array, " _"]) -> tuple[Int[Array, " _"], int]:
        """For arrays of a kind: the entry of each place, and the number that means empty."""
        if kind == ALL:
            return ids, self.particles
        by_device = ids.reshape(-1, sum(self.sizes))
        own = by_device[:, self.slices[kind]].reshape(-1)
        count = self.counts[kind]
        return jnp.where(own < self.particles, own - self.starts[kind], count), count


def scene_kinds(scene: Scene) -> Any:
    """The kind of every leaf of a scene, as a tree like it.

    Per particle are the volumes, X0, the parameters of materials that are given per particle, and
    the fields of particle conditions that have as many entries.
    """
    kinds = jax.tree.map(lambda _: SHARED, scene)
    materials = tuple(
        _material_kinds(material, count, index)
        for index, (material, count) in enumerate(zip(scene.materials, scene.counts, strict=True))
    )
    conditions = tuple(_condition_kinds(c, scene.particle_count) for c in scene.particle_conditions)
    X0 = None if scene.X0 is None else ALL
    return eqx.tree_at(
        lambda s: (s.materials, s.particle_conditions, s.volumes, s.X0),
        kinds,
        (materials, conditions, ALL, X0),
        is_leaf=lambda leaf: leaf is None,
    )


def _material_kinds(material: Any, count: int, index: int) -> Any:
    axes = particle_axes(material, count)

    def kind(axis: int | None, leaf: Any) -> int | None:
        if leaf is None:
            return None
        return SHARED if axis is None else index

    return jax.tree.map(kind, axes, material, is_leaf=lambda leaf: leaf is None)


def _condition_kinds(condition: Any, particles: int) -> Any:
    kinds = jax.tree.map(lambda _: SHARED, condition)
    if not isinstance(condition, eqx.Module):
        return kinds
    for field in dataclasses.fields(condition):
        value = getattr(condition, field.name)
        if eqx.is_array(value) and value.shape[:1] == (particles,):
            kinds = eqx.tree_at(lambda c, name=field.name: getattr(c, name), kinds, ALL)
    return kinds


def state_kinds(state: State) -> State:
    """The kind of every leaf of a state, as a tree like it."""
    kinds = jax.tree.map(lambda _: ALL, state)
    history = tuple(None if a is None else index for index, a in enumerate(state.history))
    shared = jax.tree.map(lambda _: SHARED, (state.step, state.status, state.origin))
    return eqx.tree_at(
        lambda s: (s.history, s.step, s.status, s.origin),
        kinds,
        (history, *shared),
        is_leaf=lambda leaf: leaf is None,
    )


def split(tree: Any, kinds: Any) -> tuple[Any, Any]:
    """Its arrays that hold one entry per particle, and the rest; each with None for the other."""
    return eqx.partition(tree, jax.tree.map(lambda kind: kind != SHARED, kinds))


def place(own: Any, kinds: Any, ids: Int[Array, " _"], places: Places) -> Any:
    """Arrays in the caller's order laid out over the devices."""

    def placed(leaf: Array | None, kind: int | None) -> Array | None:
        if leaf is None or kind is None:
            return None
        index, count = places.of_kind(kind, ids)
        return leaf[jnp.minimum(index, max(count - 1, 0))] if count else leaf

    return jax.tree.map(placed, own, kinds, is_leaf=lambda leaf: leaf is None)


def restore(base: Any, placed: Any, kinds: Any, ids: Int[Array, " _"], places: Places) -> Any:
    """The inverse of `place`; a particle that has no place keeps its entry in `base`."""

    def restored(leaf: Array | None, old: Array | None, kind: int | None) -> Array | None:
        if leaf is None or old is None or kind is None:
            return old
        index, _ = places.of_kind(kind, ids)
        return old.at[index].set(leaf, mode="drop")

    return jax.tree.map(restored, placed, base, kinds, is_leaf=lambda leaf: leaf is None)


def spread(
    scene: Scene,
    state: State,
    ids: Int[Array, " _"],
    unplaced: Int[Array, " devices"],
    places: Places,
    ledger: bool,
) -> Parts:
    """A scene and a state over the devices, before anything has happened there."""
    of_scene, of_state = scene_kinds(scene), state_kinds(state)
    own_scene, _ = split(scene, of_scene)
    own_state, _ = split(state, of_state)
    placed = place(own_state, of_state, ids, places)
    placed = eqx.tree_at(lambda s: s.alive, placed, placed.alive & (ids < places.particles))
    # The first device goes on with what happened before.
    old, new = state.status, Status.clear()
    before = [old, *[new] * (places.devices - 1)]
    status = jax.tree.map(lambda *a: jnp.stack(a), *before)
    status = jax.vmap(lambda s, n: s.note({Condition.OVERFLOW: n}, state.step))(status, unplaced)

    def zeros(a: Array) -> Array:
        return jnp.zeros((places.devices, *a.shape), a.dtype)

    return Parts(
        scene=place(own_scene, of_scene, ids, places),
        state=placed,
        ids=ids,
        status=status,
        flows=jax.tree.map(zeros, Flows.none(state)) if ledger else None,
        step=state.step,
    )


def collect(parts: Parts, state: State, places: Places) -> State:
    """The state of all particles in the caller's order; `state` is that from the start."""
    kinds = state_kinds(state)
    missing = eqx.tree_at(lambda s: s.alive, state, jnp.zeros_like(state.alive))
    whole = restore(missing, parts.state, kinds, parts.ids, places)
    return eqx.tree_at(lambda s: (s.step, s.status), whole, (parts.step, merged(parts.status)))


def merged(status: Status) -> Status:
    """What happened on any of the devices."""
    whole = Status.clear()
    for first, count in zip(status.first, status.count, strict=True):
        whole = whole.merged(Status(first, count))
    return whole
