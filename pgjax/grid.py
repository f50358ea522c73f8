"""The background grid: a rectangular box of nodes, fixed in space."""

import math
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import (
    Array,
    Bool,
    Float,
    Int,
    as_float_array,
    as_tuple,
    require,
    require_number,
    whole_numbers,
)

# Layers of nodes outside the box, so that the stencil of a particle at the edge fits.
PAD = 2


@final
class Grid(eqx.Module):
    """Nodes at `origin + i h`, `i = 0 … shape` along each direction.

    Along a periodic direction node `shape` is node 0; along the others `PAD` layers of nodes are
    added outside. A particle may be anywhere in the box and up to one cell outside of it.

    Args:
        origin: lower corner of the box, m, `(d,)`.
        shape: number of cells along each direction, d = 2 or 3.
        h: spacing, m.
        periodic: which directions are periodic; by default none.

    Attributes:
        numbers: along each direction, which nodes of a larger grid these are, where it is a part
            of one with the same origin; else None.
    """

    origin: Array
    shape: tuple[int, ...] = eqx.field(static=True)
    h: Array
    periodic: tuple[bool, ...] = eqx.field(static=True)
    numbers: tuple[Int[Array, " _"] | None, ...] = eqx.field(init=False)

    def __init__(
        self,
        origin: Any,
        shape: Sequence[int],
        h: Any,
        *,
        periodic: Sequence[bool] | None = None,
    ):
        self.origin = as_float_array(origin, "origin")
        self.shape = whole_numbers("shape", shape)
        self.h = as_float_array(h, "h")
        periodic = (False,) * len(self.shape) if periodic is None else periodic
        self.periodic = as_tuple("periodic", periodic)
        require("periodic", self.periodic, "hold true or false", lambda a: (a == 0) | (a == 1))
        self.periodic = tuple(bool(np.all(p)) for p in self.periodic)
        self.numbers = (None,) * len(self.shape)

    def __check_init__(self):
        d = len(self.shape)
        if d not in (2, 3):
            raise ValueError(f"Argument `shape` must have 2 or 3 entries, but is {self.shape}.")
        if self.origin.shape != (d,):
            raise ValueError(
                f"Argument `origin` must have shape ({d},) like `shape`, "
                f"but has shape {self.origin.shape}."
            )
        if len(self.periodic) != d:
            raise ValueError(f"Argument `periodic` must have {d} entries, but is {self.periodic}.")
        require("origin", self.origin, "be finite", np.isfinite)
        require_number("h", self.h)
        require("h", self.h, "be positive and finite (m)", lambda a: (a > 0) & np.isfinite(a))
        if min(self.shape) < 1:
            raise ValueError(f"Argument `shape` must be at least 1, but is {self.shape}.")
        for n, periodic in zip(self.shape, self.periodic, strict=True):
            if n < 4 and not periodic:
                raise ValueError(
                    f"Argument `shape` must be at least 4 along a direction that is not "
                    f"periodic, but is {self.shape}."
                )
        if math.prod(self.padded_shape) * 4 >= 2**31:
            raise ValueError(
                f"Argument `shape` must give fewer than 2^29 nodes, but {self.shape} gives "
                f"{math.prod(self.padded_shape):.3g}: choose a larger `h` or a smaller box."
            )

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.shape)

    @property
    def padded_shape(self) -> tuple[int, ...]:
        """Nodes of the array the kernels see, ghosts of periodic directions included."""
        return tuple(n + 1 + 2 * PAD for n in self.shape)

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Distinct nodes: `shape` along periodic directions, padded along the others."""
        return tuple(
            n if periodic else m
            for n, m, periodic in zip(self.shape, self.padded_shape, self.periodic, strict=True)
        )

    def axes(self) -> list[Float[Array, " n"]]:
        """Positions of the distinct nodes along each direction relative to the origin, m."""
        own = (
            jnp.arange(m, dtype=self.h.dtype) - (0 if periodic else PAD)
            for m, periodic in zip(self.node_shape, self.periodic, strict=True)
        )
        return [
            (given if numbers is None else numbers.astype(self.h.dtype)) * self.h
            for given, numbers in zip(own, self.numbers, strict=True)
        ]

    def nodes(self) -> Float[Array, "*grid d"]:
        """Positions of the distinct nodes relative to the origin, m."""
        return jnp.stack(jnp.meshgrid(*self.axes(), indexing="ij"), axis=-1)

    def cells(self, x: Float[Array, " d"]) -> Float[Array, " d"]:
        """A position relative to the origin in units of h, wrapped along periodic directions."""
        xi = x / self.h
        period = jnp.asarray(self.shape, xi.dtype)
        wrapped = xi - period * jax.lax.stop_gradient(jnp.floor(xi / period))
        return jnp.where(jnp.asarray(self.periodic), wrapped, xi)

    def contains(self, first: Float[Array, " d"], width: int) -> Bool[Array, ""]:
        """Whether a stencil of `width` nodes that starts at `first` fits; False for NaN."""
        last = jnp.asarray(self.padded_shape, first.dtype) - PAD - width
        return jnp.all((first >= -PAD) & (first <= last))

    def _images(self) -> list[Int[np.ndarray, " m"] | None]:
        """Along each periodic direction, the distinct node behind each padded one."""
        return [
            (np.arange(m) - PAD) % n if periodic else None
            for n, m, periodic in zip(self.shape, self.padded_shape, self.periodic, strict=True)
        ]

    def fold(self, padded: Float[Array, "*padded c"]) -> Float[Array, "*grid c"]:
        """Add what ghosts of periodic directions received to the nodes they stand for."""
        for axis, image in enumerate(self._images()):
            if image is not None:
                moved = jnp.moveaxis(padded, axis, 0)
                summed = jnp.zeros((self.shape[axis], *moved.shape[1:]), moved.dtype)
                padded = jnp.moveaxis(summed.at[image].add(moved), 0, axis)
        return padded

    def unfold(self, values: Float[Array, "*grid c"]) -> Float[Array, "*padded c"]:
        """Give the ghosts of periodic directions the values of the nodes they stand for."""
        for axis, image in enumerate(self._images()):
            if image is not None:
                values = jnp.take(values, image, axis=axis)
        return values
