"""Particles that go over to the device beside theirs."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._across import AXIS, total
from pgjax._types import Array, Bool, Int
from pgjax.parallel.layout import ALL, Parts, Places
from pgjax.parallel.neighbours import Row


class Traffic(NamedTuple):
    """How many particles of one material this device sends and takes.

    Attributes:
        to_left, to_right: that it sends.
        from_left, from_right: that it takes.
    """

    to_left: Int[Array, ""]
    to_right: Int[Array, ""]
    from_left: Int[Array, ""]
    from_right: Int[Array, ""]


def agreed(
    leaving: tuple[Int[Array, ""], Int[Array, ""]],
    free: Int[Array, ""],
    row: Row,
) -> Traffic:
    """No device sends more than its neighbour has places for.

    Args:
        leaving: how many want to go to the left and to the right.
        free: empty places on this device, before anything has left.
        row: the devices.
    """
    index = jax.lax.axis_index(AXIS)
    mine = jnp.arange(row.devices, dtype=jnp.int32)[:, None] == index
    known = jnp.stack([*leaving, free])
    # The same on every device: one row for each of them.
    table = total(jnp.where(mine, known[None, :], 0))

    def taken(device: Array) -> tuple[Array, Array]:
        from_left = jnp.minimum(row.of_neighbour(table[:, 1], device, -1), table[device, 2])
        left_over = table[device, 2] - from_left
        return from_left, jnp.minimum(row.of_neighbour(table[:, 0], device, 1), left_over)

    own = taken(index)
    from_lefts, from_rights = jax.vmap(taken)(jnp.arange(row.devices, dtype=jnp.int32))
    return Traffic(
        to_left=row.of_neighbour(from_rights, index, -1),
        to_right=row.of_neighbour(from_lefts, index, 1),
        from_left=own[0],
        from_right=own[1],
    )


class Move(NamedTuple):
    """Places of one material that are vacated and filled; the number of places means none.

    Attributes:
        to_left, to_right: of the particles that go.
        from_left, from_right: of those that come.
    """

    to_left: Int[Array, " _"]
    to_right: Int[Array, " _"]
    from_left: Int[Array, " _"]
    from_right: Int[Array, " _"]


def _planned(
    left: Bool[Array, " s"], right: Bool[Array, " s"], empty: Bool[Array, " s"], room: int, row: Row
) -> Move:
    """Who of those that want to go can, and where those that come are put."""
    size = left.size
    wanting = [jnp.minimum(jnp.sum(a, dtype=jnp.int32), room) for a in (left, right)]
    traffic = agreed((wanting[0], wanting[1]), jnp.sum(empty, dtype=jnp.int32), row)
    column = jnp.arange(room, dtype=jnp.int32)

    def first(mask: Array, count: Array) -> Array:
        chosen = jnp.nonzero(mask, size=room, fill_value=size)[0].astype(jnp.int32)
        return jnp.where(column < count, chosen, size)

    # Filled are places that were empty before: what leaves makes room for the next time.
    free = jnp.nonzero(empty, size=2 * room, fill_value=size)[0].astype(jnp.int32)
    after = free[traffic.from_left + column]
    return Move(
        to_left=first(left, traffic.to_left),
        to_right=first(right, traffic.to_right),
        from_left=jnp.where(column < traffic.from_left, free[:room], size),
        from_right=jnp.where(column < traffic.from_right, after, size),
    )


def migrated(
    parts: Parts, kinds: Any, owner: Int[Array, " _"], places: Places, row: Row, share: float
) -> Parts:
    """Particles that are in another device's slab go one device nearer to it.

    As many as fit: a neighbour without an empty place takes none, and at most a part `share` of
    the places can change over at once. The others stay where they are, and are served there as
    long as their stencil fits.

    Args:
        parts: of this device.
        kinds: of the leaves of `parts.scene` and `parts.state`.
        owner: the device in whose slab each particle is.
        places: how many there are.
        row: the devices.
        share: in (0, 1].
    """
    empty = parts.ids >= places.particles
    # Whoever is masked stays where it is.
    away = jnp.where(parts.state.alive & ~empty, owner - jax.lax.axis_index(AXIS), 0)
    if row.closed:
        # The shorter way round.
        half = row.devices // 2
        away = (away + half) % row.devices - half
    moves = [
        _planned(away[part] < 0, away[part] > 0, empty[part], math.ceil(share * size), row)
        for part, size in zip(places.slices, places.sizes, strict=True)
        if size
    ]
    index = dict(zip([i for i, size in enumerate(places.sizes) if size], moves, strict=True))
    index[ALL] = _joined(index, places)
    return _carried_out(parts, kinds, index, places.particles, row)


def _joined(index: dict[int, Move], places: Places) -> Move:
    """The places of all materials, counted from the first place of the device."""
    none = sum(places.sizes)

    def shifted(kind: int, rows: Array) -> Array:
        start, size = places.slices[kind].start, places.sizes[kind]
        return jnp.where(rows < size, rows + start, none)

    moved = [Move(*(shifted(kind, rows) for rows in move)) for kind, move in index.items()]
    return Move(*(jnp.concatenate(rows) for rows in zip(*moved, strict=True)))


def _carried_out(parts: Parts, kinds: Any, index: dict[int, Move], nobody: int, row: Row) -> Parts:
    """Send, vacate and fill."""
    own = (parts.scene, parts.state, parts.ids)
    leaves, structure = jax.tree.flatten(own)
    moves = [index[kind] for kind in jax.tree.leaves((kinds, ALL))]

    def taken(a: Array, rows: Array) -> Array:
        return a.at[rows].get(mode="fill", fill_value=0)

    from_right = row.to_left([taken(a, m.to_left) for a, m in zip(leaves, moves, strict=True)])
    from_left = row.to_right([taken(a, m.to_right) for a, m in zip(leaves, moves, strict=True)])
    new = [
        a.at[m.from_left].set(left, mode="drop").at[m.from_right].set(right, mode="drop")
        for a, m, left, right in zip(leaves, moves, from_left, from_right, strict=True)
    ]
    scene, state, ids = jax.tree.unflatten(structure, new)
    gone = jnp.concatenate([index[ALL].to_left, index[ALL].to_right])
    state = eqx.tree_at(lambda s: s.alive, state, state.alive.at[gone].set(False, mode="drop"))
    ids = ids.at[gone].set(nobody, mode="drop")
    return eqx.tree_at(lambda p: (p.scene, p.state, p.ids), parts, (scene, state, ids))
