"""Which splats touch which tiles of the image, as lists of a fixed length, in plain JAX.

A splat is drawn where `σ = p (dx − m dy)² + q dy²` is at most `s = log(opacity / alpha_min)`, an
ellipse: on one pixel row an interval, over the rows of a tile a union of intervals.
"""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax import native
from pgjax._types import Array, Bool, Float, Int

_SMALL_IMAGE = 400


@final
class TileGrid(eqx.Module):
    """The tiles of an image, numbered row by row.

    Attributes:
        tile: width of a tile in pixels.
        columns: tiles side by side.
        rows: tiles on top of each other.
    """

    tile: int = eqx.field(static=True)
    columns: int = eqx.field(static=True)
    rows: int = eqx.field(static=True)

    @classmethod
    def of(cls, width: int, height: int) -> "TileGrid":
        """Tiles of 8² pixels in small images, where they halve the work, else of 16²."""
        tile = 8 if max(width, height) < _SMALL_IMAGE else 16
        return cls(tile, -(-width // tile), -(-height // tile))

    @property
    def count(self) -> int:
        """How many tiles there are."""
        return self.columns * self.rows

    def first(self, low: Array, count: int) -> Array:
        """First tile with a pixel centre at or above `low`, between 0 and count."""
        return jnp.clip(jnp.ceil((low + 0.5) / self.tile - 1), 0, count).astype(jnp.int32)

    def last(self, high: Array, count: int) -> Array:
        """Last tile with a pixel centre at or below `high`, between −1 and count − 1."""
        return jnp.clip(jnp.floor((high - 0.5) / self.tile), -1, count - 1).astype(jnp.int32)


def row_range(
    shape: Float[Array, "n 6"], reach: Float[Array, " n"], grid: TileGrid
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """First and last row of tiles that each splat may touch; none where its reach is negative."""
    v, q = shape[:, 1], shape[:, 4]
    half_height = jnp.sqrt(_enlarged(reach) / q) + _margin(v)
    top = grid.first(v - half_height, grid.rows)
    bottom = grid.last(v + half_height, grid.rows)
    return top, jnp.where(reach >= 0, bottom, top - 1)


def columns_in_row(
    shape: Float[Array, "n 6"], reach: Float[Array, " n"], row: Int[Array, " n"], grid: TileGrid
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """First tile, and how many side by side, that each splat touches in its row of tiles."""
    u, v, m, p, q = shape[:, :5].T
    reach = _enlarged(reach)
    limit = jnp.sqrt(reach / q)
    row_top = (row * grid.tile).astype(v.dtype) + 0.5
    low = jnp.clip(row_top - v, -limit, limit)
    high = jnp.clip(row_top + (grid.tile - 1) - v, -limit, limit)
    # The rightmost point of the ellipse lies at dy = turn, the leftmost at −turn.
    turn = m / q * jnp.sqrt(reach / (1 / p + m * m / q))

    def edge(sign: int) -> Array:
        dy = jnp.clip(sign * turn, low, high)
        width = jnp.sqrt(jnp.maximum(reach - q * dy * dy, 0) / p)
        return u + m * dy + sign * (width + _margin(u) + _margin(m * dy))

    first, last = grid.first(edge(-1), grid.columns), grid.last(edge(+1), grid.columns)
    return first, jnp.maximum(last - first + 1, 0)


def _enlarged(reach: Array) -> Array:
    """Rounding in single precision moves σ by far less than this."""
    return jnp.maximum(reach, 0) * (1 + 1e-3) + 1e-3


def _margin(position: Array) -> Array:
    """In pixels; far outside of the image positions are rounded."""
    return 0.01 + 4 * jnp.finfo(position.dtype).eps * jnp.abs(position)


def count_pairs(
    shape: Float[Array, "n 6"], reach: Float[Array, " n"], grid: TileGrid
) -> Int[Array, ""]:
    """Length of the lists that `list_pairs` needs (2³⁰ stands for that and more)."""
    top, bottom = row_range(shape, reach, grid)

    def add(total: Array, row: Array) -> tuple[Array, None]:
        count = columns_in_row(shape, reach, jnp.broadcast_to(row, top.shape), grid)[1]
        return total + _total(jnp.where((row >= top) & (row <= bottom), count, 0)), None

    _, zero = native.varying(reach, jnp.zeros(()))
    pairs, _ = jax.lax.scan(add, zero, jnp.arange(grid.rows, dtype=jnp.int32))
    needed = jnp.maximum(pairs, _total(bottom - top + 1))
    # In floating-point numbers, which do not wrap around; one part in 10⁶ is their rounding.
    needed = jnp.where(needed > 2**22, needed * (1 + 1e-6) + 1, needed)
    return jnp.clip(needed, 0, 2**30).astype(jnp.int32)


def _total(counts: Int[Array, " n"]) -> Float[Array, ""]:
    return jnp.sum(counts.astype(jnp.zeros(()).dtype))


def list_pairs(
    shape: Float[Array, "n 6"], reach: Float[Array, " n"], grid: TileGrid, capacity: int
) -> tuple[Int[Array, " c"], Int[Array, " c"]]:
    """The pairs (tile, splat), sorted by tile and in the order of the splats within.

    Entries beyond the last pair have the tile `grid.count` and the splat n. Lists that are too
    short for what `count_pairs` says are cut off.
    """
    n = shape.shape[0]
    top, bottom = row_range(shape, reach, grid)
    splat, below, used = _expanded(bottom - top + 1, capacity)
    row = top[splat] + below
    first, count = columns_in_row(shape[splat], reach[splat], row, grid)
    span, beside, used = _expanded(jnp.where(used, count, 0), capacity)
    tile = jnp.where(used, row[span] * grid.columns + first[span] + beside, grid.count)
    splat = jnp.where(used, splat[span], n)
    tile, splat = jax.lax.sort((tile, splat), num_keys=1, is_stable=True)
    return tile, splat


def work_items(
    tile: Int[Array, " c"], grid: TileGrid, size: int, number: int
) -> tuple[Int[Array, " i"], Int[Array, "i size"]]:
    """Cut each tile's run of pairs into items of at most `size`.

    Returns the tile of each item, and the places of its pairs in the list (c where there is none).
    `number` items suffice if it is at least c / size + the number of tiles.
    """
    c = tile.shape[0]
    begin = jnp.searchsorted(tile, jnp.arange(grid.count + 1, dtype=jnp.int32)).astype(jnp.int32)
    owner, piece, used = _expanded(-(-jnp.diff(begin) // size), number)
    index = begin[owner, None] + size * piece[:, None] + jnp.arange(size, dtype=jnp.int32)[None]
    inside = (index < begin[owner + 1, None]) & used[:, None]
    return jnp.where(used, owner, grid.count), jnp.where(inside, index, c)


def _expanded(
    count: Int[Array, " n"], length: int
) -> tuple[Int[Array, " length"], Int[Array, " length"], Bool[Array, " length"]]:
    """Each i count[i] times, beside 0 … count[i] − 1, and which entries are in use."""
    end = jnp.cumsum(count, dtype=jnp.int32)
    place = jnp.arange(length, dtype=jnp.int32)
    index = jnp.searchsorted(end, place, side="right", method="sort").astype(jnp.int32)
    used = index < count.shape[0]
    index = jnp.minimum(index, count.shape[0] - 1)
    return index, jnp.where(used, place - (end - count)[index], 0), used
