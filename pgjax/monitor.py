"""Conditions that are looked at once a frame: they warn, and change nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._across import total
from pgjax._types import Array, Bool, Float, Matrix3, Scalar
from pgjax.models.material import cast, particle_axes
from pgjax.models.strain import principal_stretches
from pgjax.result import Condition
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.timestep import above_bound

# What float32 resolves: terms in the sum of one node, and the ratio of extreme stretches.
CROWDED_CELL = 30_000
LARGEST_STRETCH_RATIO = 1e5


def note_start(scene: Scene, state: State, dt: Scalar) -> State:
    """The same for the state before the first step; one that goes on has been looked at."""
    noted = note_frame(scene, state, dt)
    status = jax.tree.map(lambda a, b: jnp.where(state.step == 0, a, b), noted.status, state.status)
    return eqx.tree_at(lambda s: s.status, state, status)


def note_frame(scene: Scene, state: State, dt: Scalar) -> State:
    """Count DT_ABOVE_BOUND, ELLIPTICITY_LOST and, in single precision, F32_RESOLUTION."""
    scene = cast(scene, state.dtype)
    events = {
        Condition.DT_ABOVE_BOUND: above_bound(scene, state, dt),
        Condition.ELLIPTICITY_LOST: state.alive & ~_elliptic(scene, state),
    }
    if state.dtype == jnp.float32:
        events[Condition.F32_RESOLUTION] = state.alive & _unresolved(scene, state)
    counts = {condition: jnp.sum(a, dtype=jnp.int32) for condition, a in events.items()}
    return eqx.tree_at(lambda s: s.status, state, state.status.note(counts, state.step))


def _elliptic(scene: Scene, state: State) -> Bool[Array, " p"]:
    parts = []
    for material, part in zip(scene.materials, scene.slices, strict=True):

        def law(material, H):
            return material.elasticity.elliptic(H)

        axes = (particle_axes(material, part.stop - part.start), 0)
        parts.append(jax.vmap(law, in_axes=axes)(material, state.He[part]))
    return jnp.concatenate(parts)


def _unresolved(scene: Scene, state: State) -> Bool[Array, " p"]:
    def extreme(H: Matrix3) -> Bool[Array, ""]:
        sigma, _, _ = principal_stretches(H)
        return sigma[0] > LARGEST_STRETCH_RATIO * jnp.abs(sigma[2])

    return jax.vmap(extreme)(state.He) | (_neighbours(scene, state) > CROWDED_CELL)


def _neighbours(scene: Scene, state: State) -> Float[Array, " p"]:
    """Number of particles in the cell of each particle."""
    shape = scene.grid.shape

    def cell(x: Float[Array, " d"]) -> Float[Array, " d"]:
        return jnp.clip(jnp.floor(scene.grid.cells(x)), 0, jnp.asarray(shape, x.dtype) - 1)

    position = jnp.where(state.alive[:, None], state.position, 0)
    cells = jax.vmap(cell)(position).astype(jnp.int32)
    index = tuple(cells[:, i] for i in range(len(shape)))
    counts = jnp.zeros(shape, state.dtype).at[index].add(state.alive.astype(state.dtype))
    # Who holds a part of the grid has all the particles of its cells.
    is_part = any(numbers is not None for numbers in scene.grid.numbers)
    return (counts if is_part else total(counts))[index]
