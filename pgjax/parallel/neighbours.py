"""What devices in a row send to the next one and to the one before."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pgjax._across import AXIS
from pgjax._types import Array


class Row(NamedTuple):
    """Devices in a row.

    Attributes:
        devices: how many.
        closed: whether the last one is beside the first.
    """

    devices: int
    closed: bool

    def to_right(self, tree: Any) -> Any:
        """What the device on the left has; zeros where there is none."""
        return self._moved(tree, 1)

    def to_left(self, tree: Any) -> Any:
        """What the device on the right has; zeros where there is none."""
        return self._moved(tree, -1)

    def _moved(self, tree: Any, by: int) -> Any:
        n = self.devices
        pairs = [(i, (i + by) % n) for i in range(n) if self.closed or 0 <= i + by < n]
        if not pairs:
            return jax.tree.map(jnp.zeros_like, tree)
        leaves, structure = jax.tree.flatten(tree)
        packed = [jax.lax.ppermute(a, AXIS, pairs) for a in _packed(leaves)]
        return jax.tree.unflatten(structure, _unpacked(packed, leaves))

    def of_neighbour(self, values: Array, device: Array, by: int) -> Array:
        """The entry of the neighbour in a vector with one entry per device; 0 if it has none."""
        other = device + by
        there = self.closed | ((other >= 0) & (other < self.devices))
        return jnp.where(there, values[other % self.devices], 0)


def _is_floating(a: Array) -> bool:
    return jnp.issubdtype(a.dtype, jnp.floating)


def _packed(leaves: list[Array]) -> list[Array]:
    """One vector of all that is floating and one of all whole numbers: two messages at most."""
    floating = [a.reshape(-1) for a in leaves if _is_floating(a)]
    whole = [a.astype(jnp.int32).reshape(-1) for a in leaves if not _is_floating(a)]
    return [jnp.concatenate(group) for group in (floating, whole) if group]


def _unpacked(packed: list[Array], leaves: list[Array]) -> list[Array]:
    places, out = {False: 0, True: 0}, []
    for a in leaves:
        kind = _is_floating(a)
        vector = packed[0] if kind else packed[-1]
        piece = vector[places[kind] : places[kind] + a.size]
        places[kind] += a.size
        out.append(piece.reshape(a.shape).astype(a.dtype))
    return out
