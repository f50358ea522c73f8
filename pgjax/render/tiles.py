"""Which splats touch which tiles of the image: exact lists, made on the host.

A splat is drawn where `σ ≤ s = log(opacity / alpha_min)`, an ellipse. With the covariance
`[[xx, xy], [xy, yy]]`, `m = xy / yy` and `det = xx yy − xy²`,

    2 σ = (dx − m dy)² yy / det + dy² / yy,

so on one pixel row the ellipse is an interval, and over the rows of a tile the union of intervals.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

# Pairs (splat, tile) held at once; an image that needs more is drawn in bands of tile rows.
_MAX_PAIRS = 1_000_000


class Spans(NamedTuple):
    """Runs of tiles [first, last] in one tile row that one splat touches; sorted by row."""

    splat: np.ndarray
    row: np.ndarray
    first: np.ndarray
    last: np.ndarray


def tile_spans(
    center: np.ndarray,
    variances: np.ndarray,
    covariance: np.ndarray,
    det: np.ndarray,
    reach: np.ndarray,
    *,
    tile: int,
    columns: int,
    rows: int,
) -> Spans:
    """The spans of splats that are given front to back; `reach` is s > 0.

    Within a row of tiles the splats stay in the given order. All arrays are float64.
    """
    # Rounding in single precision moves σ and the centre by far less than this.
    reach = reach * (1 + 1e-3) + 1e-3
    (u, v), (xx, yy) = center.T, variances.T
    # Pixel centres of tile row i lie at i·tile + 1/2 … i·tile + tile − 1/2.
    half_height = np.sqrt(2 * reach * yy) + 0.01
    top = _first_tile(v - half_height, tile, rows)
    bottom = _last_tile(v + half_height, tile, rows)
    splat, row = _expand(top, np.maximum(bottom - top + 1, 0))

    u, v, xx, yy = u[splat], v[splat], xx[splat], yy[splat]
    xy, det, reach = covariance[splat], det[splat], reach[splat]
    low = row * tile + 0.5 - v
    limit = np.sqrt(2 * reach * yy)
    high = np.minimum(low + (tile - 1), limit)
    low = np.maximum(np.minimum(low, limit), -limit)
    high = np.maximum(high, -limit)
    # The rightmost point of the ellipse lies at dy = turn, the leftmost at −turn.
    turn = xy * np.sqrt(2 * reach / xx)

    def edge(sign: int) -> np.ndarray:
        dy = np.clip(sign * turn, low, high)
        width = np.sqrt(np.maximum(2 * reach - dy * dy / yy, 0) * det / yy)
        return u + xy / yy * dy + sign * (width + 0.01)

    first = _first_tile(edge(-1), tile, columns)
    last = _last_tile(edge(+1), tile, columns)
    kept = np.flatnonzero(last >= first)
    kept = kept[np.argsort(_small(row[kept]), kind="stable")]
    return Spans(splat[kept], row[kept], first[kept], last[kept])


def pairs(spans: Spans, *, columns: int, rows: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs (splat, tile), sorted by tile and front to back within, in bands of whole tile rows.

    Tiles are numbered row by row. A band holds about a million pairs at most, or one tile row.
    """
    count = spans.last - spans.first + 1
    per_row = np.bincount(spans.row, weights=count, minlength=rows)
    starts = np.searchsorted(spans.row, np.arange(rows + 1))
    begin = 0
    while begin < rows:
        end, total = begin + 1, per_row[begin]
        while end < rows and total + per_row[end] <= _MAX_PAIRS:
            total += per_row[end]
            end += 1
        band = slice(starts[begin], starts[end])
        index, column = _expand(spans.first[band], count[band])
        tile = spans.row[band][index] * columns + column
        order = np.argsort(_small(tile - begin * columns), kind="stable")
        yield spans.splat[band][index][order], tile[order]
        begin = end


def work_items(tile: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut each tile's run of pairs into items of at most `size` pairs.

    Returns the tile of each item, and where in the list of pairs it begins and ends.
    """
    bounds = np.flatnonzero(np.diff(tile, prepend=-1, append=-1))
    lengths = np.diff(bounds)
    run, piece = _expand(np.zeros_like(lengths), -(-lengths // size))
    begin = bounds[:-1][run] + piece * size
    return tile[begin], begin, np.minimum(begin + size, bounds[1:][run])


def _first_tile(low: np.ndarray, tile: int, count: int) -> np.ndarray:
    """First tile with a pixel centre at or above `low`, between 0 and count."""
    return np.clip(np.ceil((low + 0.5) / tile - 1), 0, count).astype(np.int64)


def _last_tile(high: np.ndarray, tile: int, count: int) -> np.ndarray:
    """Last tile with a pixel centre at or below `high`, between −1 and count − 1."""
    return np.clip(np.floor((high - 0.5) / tile), -1, count - 1).astype(np.int64)


def _expand(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each i count[i] times, beside count[i] successive numbers from first[i]."""
    index = np.repeat(np.arange(len(count)), count)
    begins = np.cumsum(count) - count
    return index, np.arange(len(index)) - np.repeat(begins - first, count)


def _small(keys: np.ndarray) -> np.ndarray:
    """The keys in 16 bits where they fit: numpy then sorts them by radix, ten times faster."""
    return keys.astype(np.uint16) if keys.size and keys.max() < 2**16 else keys
