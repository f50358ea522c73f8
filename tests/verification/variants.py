"""The same rollouts done in another way: on a larger grid, in another order, in another precision.

Every case of the verification rolls through `scenes.roll`; `instead` changes what that does.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scenes

from pgjax.grid import Grid
from pgjax.models.material import cast
from pgjax.scene import Scene
from pgjax.state import State

Variant = Callable[..., tuple[State, Any]]


def instead(monkeypatch, variant: Callable[[Variant], Variant]) -> None:
    """From here to the end of the test `scenes.roll` goes through `variant(usual)`."""
    monkeypatch.setattr(scenes, "_roll", variant(scenes._roll))


def roomier(scene: Scene, state: State, cells: int) -> tuple[Scene, State]:
    """On a grid with so many more cells on each side, where it is not periodic."""
    grid, room = scene.grid, np.where(scene.grid.periodic, 0, cells)
    shape = tuple(np.add(grid.shape, 2 * room).tolist())
    origin = grid.origin - room.astype(float) * grid.h
    larger = Grid(origin, shape, grid.h, periodic=grid.periodic)
    shift = (grid.origin - larger.origin).astype(state.dtype)
    state = eqx.tree_at(
        lambda s: (s.position, s.origin),
        state,
        (state.position + shift[None, :], larger.origin.astype(state.dtype)),
    )
    return eqx.tree_at(lambda s: s.grid, scene, larger), state


def with_room(cells: int) -> Callable[[Variant], Variant]:
    """On a larger grid; what is observed is told positions from the usual origin."""

    def variant(usual: Variant) -> Variant:
        def roll(scene, state, dt, steps, observe, after, every):
            def back(larger, moved):
                del larger
                shift, origin = moved.origin - state.origin, state.origin
                own = (moved.position + shift[None, :], origin)
                return observe(scene, eqx.tree_at(lambda s: (s.position, s.origin), moved, own))

            return usual(*roomier(scene, state, cells), dt, steps, back, after, every)

        return roll

    return variant


def nudged(size: float) -> Callable[[Variant], Variant]:
    """From positions that are off by so many cells, at random: what rounding may become."""

    def variant(usual: Variant) -> Variant:
        def roll(scene, state, *args):
            noise = size * np.random.default_rng(0).standard_normal(state.position.shape)
            moved = state.position + scene.grid.h * jnp.asarray(noise, state.dtype)
            return usual(scene, eqx.tree_at(lambda s: s.position, state, moved), *args)

        return roll

    return variant


def converted(tree: Any, dtype: Any) -> Any:
    """Every floating array of a tree in another precision."""

    def one(a):
        floating = eqx.is_array(a) and jnp.issubdtype(a.dtype, jnp.floating)
        return a.astype(dtype) if floating else a

    return jax.tree.map(one, tree)


def in_single_precision(usual: Variant) -> Variant:
    """The motion in float32; what is observed is computed from it in double precision."""

    def roll(scene, state, dt, steps, observe, after, every):
        def widened(narrow, state):
            del narrow
            return observe(scene, converted(state, jnp.float64))

        start, narrow = converted(state, jnp.float32), cast(scene, jnp.float32)
        return usual(narrow, start, dt.astype(jnp.float32), steps, widened, after, every)

    return roll
