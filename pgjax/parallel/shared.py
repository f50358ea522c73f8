"""Particles spread over devices, each of which has the whole grid."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._across import AXIS, total
from pgjax._types import Array, Bool, Float, Int
from pgjax.grid import Grid
from pgjax.parallel.layout import Parts, Places
from pgjax.parallel.plan import AbstractLayout, AbstractPlan
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.transfer import Stencil, stencil


@final
class SharedGrid(AbstractLayout):
    """Every device has the whole grid; the particles are dealt out once.

    Each device scatters its own particles to the whole grid, the grids are summed over the
    devices, and all of them do the same with the sum. A step communicates the grid once,
    whatever the number of particles.
    """

    def planned(self, scene: Scene, state: State, devices: int) -> "WholeGrid":
        """Equal shares of each material."""
        del state
        sizes = tuple(-(-count // devices) for count in scene.counts)
        return WholeGrid(Places(devices, scene.counts, sizes))


@final
class WholeGrid(AbstractPlan):
    """Each device has the whole grid."""

    places: Places = eqx.field(static=True)

    def seats(self, scene: Scene, state: State) -> tuple[Int[Array, " _"], Int[Array, " devices"]]:
        """Particles in their order, device by device."""
        del scene, state
        places, columns = self.places, []
        devices = np.arange(places.devices)[:, None]
        for size, count, start in zip(places.sizes, places.counts, places.starts, strict=True):
            own = devices * size + np.arange(size)[None, :]
            columns.append(np.where(own < count, own + start, places.particles))
        ids = np.concatenate(columns, axis=1).reshape(-1)
        return jnp.asarray(ids, jnp.int32), jnp.zeros((places.devices,), jnp.int32)

    def grid(self, grid: Grid) -> Grid:
        """As it is."""
        return grid

    def stencil(self, scene: Scene, state: State) -> tuple[State, Stencil, Bool[Array, " p"]]:
        """As on one device."""
        at, inside = stencil(scene.grid, scene.spline, state.position)
        return state, at, inside

    def added(self, nodes: Float[Array, "*grid c"]) -> Float[Array, "*grid c"]:
        """The sum over the devices."""
        return total(nodes)

    def own(self, nodes: Float[Array, "*grid c"]) -> Bool[Array, "*grid 1"]:
        """The first device accounts for all of them."""
        return jnp.full((*nodes.shape[:-1], 1), jax.lax.axis_index(AXIS) == 0)

    def local(self, grid: Grid, position: Float[Array, "p d"]) -> Float[Array, "p d"]:
        """As they are."""
        del grid
        return position

    def regrouped(self, grid: Grid, kinds: Any, parts: Parts) -> Parts:
        """Particles stay on their device."""
        del grid, kinds
        return parts
