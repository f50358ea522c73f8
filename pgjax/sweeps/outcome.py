"""What is measured of each member unless another function is given."""

import jax
import jax.numpy as jnp

from pgjax._types import Array, Float
from pgjax.exchange import where
from pgjax.models.strain import principal_stretches
from pgjax.scene import Scene
from pgjax.simulate import Trajectory
from pgjax.state import State

# Elastic and total deformation that differ by more: the particle has flowed.
_FLOWED = 1e-3
# At rest is what moves by less than this part of its size in a frame.
_AT_REST = 1e-3


def outcome(scene: Scene, start: State, trajectory: Trajectory) -> dict[str, Array]:
    """Numbers of the last state; masked particles do not count, but for `lost`.

    - `mean_height`, `lowest`, `highest`, m: against gravity; along the last axis without one.
    - `extent_x`, `extent_y`, `extent_z`, m: of the box around all particles.
    - `largest_displacement`, m: of a particle, from where it started.
    - `kinetic_energy`, J: `Σ m v²/2` of the particles.
    - `largest_stretch`: the largest singular value of a deformation gradient.
    - `plastic_part`: of the mass, where elastic and total deformation differ by more than 1e-3.
    - `at_rest`: whether the root mean square speed moves it by less than a thousandth of its
      largest extent in a frame; 1 or 0.
    - `lost`: number of particles that were masked.
    """
    end, alive = trajectory.final, trajectory.final.alive
    weights = jnp.where(alive, scene.masses.astype(end.dtype), 0)
    total = jnp.maximum(jnp.sum(weights), jnp.finfo(end.dtype).tiny)
    x = end.x
    heights = x @ _up(scene, end)
    extents = _highest(alive, x) - _lowest(alive, x)
    square_speed = jnp.sum(where(alive, end.v, 0) ** 2, axis=1)
    moved = jnp.sqrt(jnp.sum(where(alive, x - start.x, 0) ** 2, axis=1))
    energy = jnp.sum(weights * square_speed) / 2
    frame = trajectory.t[1] - trajectory.t[0]
    per_frame = frame.astype(end.dtype) * jnp.sqrt(2 * energy / total)
    return {
        "mean_height": jnp.sum(weights * jnp.where(alive, heights, 0)) / total,
        "lowest": _lowest(alive, heights),
        "highest": _highest(alive, heights),
        **{f"extent_{axis}": a for axis, a in zip("xyz", extents, strict=False)},
        "largest_displacement": jnp.max(moved),
        "kinetic_energy": energy,
        "largest_stretch": _highest(alive, _largest_stretch(end)),
        "plastic_part": jnp.sum(jnp.where(_flowed(end), weights, 0)) / total,
        "at_rest": (per_frame < _AT_REST * jnp.max(extents)).astype(end.dtype),
        "lost": jnp.sum(~alive).astype(jnp.int32),
    }


def _up(scene: Scene, state: State) -> Float[Array, " d"]:
    """Against gravity; the last axis where there is none."""
    g = scene.gravity.astype(state.dtype)
    size = jnp.sqrt(jnp.sum(g**2))
    last = jnp.zeros_like(g).at[-1].set(1)
    return jnp.where(size > 0, -g / jnp.where(size > 0, size, 1), last)


def _lowest(alive: Array, a: Array) -> Array:
    return jnp.min(where(alive, a, jnp.full_like(a, jnp.inf)), axis=0)


def _highest(alive: Array, a: Array) -> Array:
    return jnp.max(where(alive, a, jnp.full_like(a, -jnp.inf)), axis=0)


def _largest_stretch(state: State) -> Float[Array, " p"]:
    total = state.He if state.H is None else state.H
    return jax.vmap(lambda H: principal_stretches(H)[0][0])(total)


def _flowed(state: State) -> Array:
    if state.H is None:
        return jnp.zeros_like(state.alive)
    return jnp.any(jnp.abs(state.H - state.He) > _FLOWED, axis=(1, 2))
