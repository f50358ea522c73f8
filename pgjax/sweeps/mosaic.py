"""The last pictures of all members side by side, over the values they have."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pgjax._files import replacing
from pgjax.render.media import load_image
from pgjax.sweeps.table import FAILED, Table

# Pixels along the longer side of a small picture, and of the whole.
_SMALL, _LARGE = 120, 6000
# Beside a side this long not every value is written.
_MOST_LABELS = 40
_GREY, _RED, _FRAME = 0.85, (0.85, 0.1, 0.1), 3


def save_mosaic(path: Path, table: Table, pictures: Path) -> None:
    """Draw the pictures in a grid: the last parameter to the right, the others downwards.

    Members that failed have a red frame; of those that were not simulated there is a grey field.

    Args:
        path: of the picture (.png).
        table: of the members.
        pictures: a folder with `00000.png` for each member, where there is one.
    """
    columns = table.shape[-1] if len(table.shape) > 1 else math.ceil(math.sqrt(len(table)))
    rows = -(-len(table) // columns)
    whole = tiled(table, pictures, rows, columns)
    height, width = whole.shape[:2]
    figure = Figure(figsize=(width / 100 + 1.6, height / 100 + 1), layout="constrained")
    axes = figure.subplots()
    axes.imshow(whole, extent=(0, columns, rows, 0), aspect=height / rows / (width / columns))
    axes.tick_params(length=0)
    _label(axes, table, rows, columns)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100)


def tiled(table: Table, pictures: Path, rows: int, columns: int) -> np.ndarray:
    """The small pictures side by side, member after member, `(height, width, 3)`."""
    paths = {i: pictures / f"{i:05d}.png" for i in range(len(table))}
    paths = {i: path for i, path in paths.items() if path.is_file()}
    sizes = (load_image(path).shape[:2] for path in paths.values())
    height, width = next(sizes, (_SMALL, _SMALL))
    small = max(1, min(_SMALL, _LARGE // max(rows, columns)))
    # Squares of so many pixels are averaged: no library is needed for that.
    factor = -(-max(height, width) // small)
    shape = (height // factor, width // factor)
    whole = np.full((rows * shape[0], columns * shape[1], 3), 1.0)
    for i, status in enumerate(table["status"]):
        known = i in paths
        tile = _shrunk(load_image(paths[i]), factor) if known else np.full((*shape, 3), _GREY)
        if status == FAILED:
            tile = _framed(tile)
        row, column = divmod(i, columns)
        y, x = row * shape[0], column * shape[1]
        whole[y : y + shape[0], x : x + shape[1]] = tile
    return whole


def _shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    height, width = (n // factor for n in image.shape[:2])
    cut = image[: height * factor, : width * factor]
    return cut.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))


def _framed(tile: np.ndarray) -> np.ndarray:
    made = np.broadcast_to(np.asarray(_RED), tile.shape).copy()
    edge = min(_FRAME, *(n // 4 for n in tile.shape[:2]))
    inside = slice(edge, tile.shape[0] - edge), slice(edge, tile.shape[1] - edge)
    made[inside] = tile[inside]
    return made


def _label(axes: Axes, table: Table, rows: int, columns: int) -> None:
    """Values along both sides; where the members are a list, their numbers."""
    *others, last = table.parameters
    if len(table.shape) > 1:
        below = [_text(value) for value in table[last][:columns]]
        left = [", ".join(_text(table[n][r * columns]) for n in others) for r in range(rows)]
        titles = last, ", ".join(others)
    elif others:
        below, left = [""] * columns, [str(row * columns) for row in range(rows)]
        titles = "", "member"
    else:
        below, left = [""] * columns, [_text(table[last][row * columns]) for row in range(rows)]
        titles = "", f"{last}, from left to right"
    for axis, texts, title in zip((axes.xaxis, axes.yaxis), (below, left), titles, strict=True):
        every = -(-len(texts) // _MOST_LABELS)
        axis.set_ticks(np.arange(0, len(texts), every) + 0.5, texts[::every])
        axis.set_label_text(title)


def _text(value: Any) -> str:
    return " ".join(f"{v:.4g}" for v in np.atleast_1d(value))
