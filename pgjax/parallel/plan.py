"""What a way to share a scene among devices has to say."""

import abc
from typing import Any

import equinox as eqx

from pgjax._types import Array, Bool, Float, Int
from pgjax.grid import Grid
from pgjax.parallel.layout import Parts, Places
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.transfer import Stencil


class AbstractLayout(eqx.Module):
    """How a scene is shared, as the caller asks for it."""

    @abc.abstractmethod
    def planned(self, scene: Scene, state: State, devices: int) -> "AbstractPlan":
        """The same with everything decided.

        Raises:
            ValueError: it cannot be done for this scene and as many devices.
        """


class AbstractPlan(eqx.Module):
    """What the devices do beside a step of their own particles.

    All methods but `seats` are called on each device, inside `shard_map`.
    """

    places: eqx.AbstractVar[Places]

    @abc.abstractmethod
    def seats(self, scene: Scene, state: State) -> tuple[Int[Array, " _"], Int[Array, " devices"]]:
        """The particle in each place of all devices, and how many found none on theirs."""

    @abc.abstractmethod
    def grid(self, grid: Grid) -> Grid:
        """The grid of this device."""

    @abc.abstractmethod
    def stencil(self, scene: Scene, state: State) -> tuple[State, Stencil, Bool[Array, " p"]]:
        """Stencils in the grid of this device, and whether they fit in the whole grid.

        Particles that fit in the whole grid, but not here, are masked in the state and counted.
        """

    @abc.abstractmethod
    def added(self, nodes: Float[Array, "*grid c"]) -> Float[Array, "*grid c"]:
        """The nodes of this device with what all other devices sent to them."""

    @abc.abstractmethod
    def own(self, nodes: Float[Array, "*grid c"]) -> Bool[Array, "*grid 1"]:
        """The nodes this device accounts for: each node is accounted for by one device."""

    @abc.abstractmethod
    def local(self, grid: Grid, position: Float[Array, "p d"]) -> Float[Array, "p d"]:
        """Positions in the whole grid relative to the first cell of this device's grid, m."""

    @abc.abstractmethod
    def regrouped(self, grid: Grid, kinds: Any, parts: Parts) -> Parts:
        """After a step: particles that belong to another device go there.

        `kinds` are those of the leaves of `parts.scene` and `parts.state`.
        """
