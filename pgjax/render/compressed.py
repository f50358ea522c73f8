"""Decoding the compressed `.ply` layout of PlayCanvas (SuperSplat, splat-transform).

Element `chunk` holds, for every 256 Gaussians, the least and greatest position, log scale and (in
newer files) colour. Element `vertex` holds four 32-bit words per Gaussian:

- `packed_position`, `packed_scale`: 11, 10 and 11 bits of x, y, z between the bounds of the chunk;
- `packed_color`: 8 bits each of red, green, blue (between the bounds, if there are any), opacity;
- `packed_rotation`: 2 bits for which component of the quaternion wxyz is largest and therefore
  left out, and 10 bits for each of the others, between −1/√2 and 1/√2.

Element `sh`, if there is one, holds the harmonics above degree 0 as bytes `256 (c/8 + 1/2)`,
channel by channel. The file is unpacked in `ply.py`; here are only its numbers.

Reference: D. Hutchence, "Compressing Gaussian Splats", PlayCanvas blog, 2024.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pgjax.render.harmonics import COUNTS
from pgjax.render.splat import constant_harmonic

CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_GEOMETRY = ("x", "y", "z", "scale_x", "scale_y", "scale_z")
_COLOURS = ("r", "g", "b")
_KINDS = {
    "chunk": ("float", "float32"),
    "vertex": ("uint", "uint32"),
    "sh": ("uchar", "uint8"),
}


def is_compressed(properties: Mapping[str, Mapping[str, str]]) -> bool:
    """Whether a file with these columns of each element has the compressed layout."""
    return "packed_position" in properties["vertex"]


def require_layout(
    file: Path, counts: Mapping[str, int], properties: Mapping[str, Mapping[str, str]]
) -> None:
    """Refuse a file that lacks columns or rows, from its header alone."""
    required = {"vertex": list(_PACKED), "chunk": _bounds(_GEOMETRY)}
    if any(name in properties.get("chunk", {}) for name in _bounds(_COLOURS)):
        required["chunk"] += _bounds(_COLOURS)
    if "sh" in counts:
        rest = len(properties["sh"])
        if rest not in {3 * (k - 1) for k in COUNTS[1:]}:
            raise ValueError(
                f"The file {file} must have 9, 24 or 45 columns in its element 'sh' "
                f"(harmonics of degree 1 to 3), but has {rest}."
            )
        required["sh"] = _rest(rest)
    for element, names in required.items():
        _require_columns(file, element, names, properties.get(element, {}))
    n = counts["vertex"]
    for element, rows in {"chunk": -(-n // CHUNK), "sh": n}.items():
        if counts.get(element, rows) != rows:
            raise ValueError(
                f"The file {file} must have {rows} rows of {element!r} for {n} Gaussians, "
                f"but has {counts[element]}."
            )


def _require_columns(
    file: Path, element: str, names: list[str], present: Mapping[str, str]
) -> None:
    missing = [f"`{name}`" for name in names if name not in present]
    if missing:
        raise ValueError(
            f"The file {file} has the compressed layout of PlayCanvas, but its element "
            f"{element!r} lacks the columns {', '.join(missing)}."
        )
    kinds = _KINDS[element]
    wrong = [f"{present[name]} `{name}`" for name in names if present[name] not in kinds]
    if wrong:
        raise ValueError(
            f"The file {file} must have columns of type {kinds[0]} in its element "
            f"{element!r}, but has {', '.join(wrong)}."
        )


def decode(chunk: np.ndarray, vertex: np.ndarray, sh: np.ndarray | None) -> list[np.ndarray]:
    """The arguments of `Gaussians.from_scales`, in double precision.

    Args:
        chunk: structured array of the bounds, one row for 256 Gaussians.
        vertex: structured array of the packed words, one row per Gaussian.
        sh: structured array of the bytes of the harmonics, or None for degree 0.
    """
    n = len(vertex)
    rgba = _fractions(vertex["packed_color"], (24, 16, 8, 0), (8, 8, 8, 8))
    position = _fractions(vertex["packed_position"], (21, 11, 0), (11, 10, 11))
    scale = _fractions(vertex["packed_scale"], (21, 11, 0), (11, 10, 11))
    rgb = rgba[:, :3]
    if "min_r" in (chunk.dtype.names or ()):
        rgb = _between(chunk, _COLOURS, rgb)
    with np.errstate(over="ignore"):
        scales = np.exp(_between(chunk, _GEOMETRY[3:], scale))
    return [
        _between(chunk, _GEOMETRY[:3], position),
        _quaternions(vertex["packed_rotation"]),
        scales,
        rgba[:, 3],
        np.concatenate([constant_harmonic(rgb)[:, None], _harmonics(sh, n)], axis=1),
    ]


def _fractions(words: np.ndarray, shifts: tuple[int, ...], widths: tuple[int, ...]) -> np.ndarray:
    """Fields of each word, `width` bits from bit `shift` on, as fractions of their maximum."""
    masks = (1 << np.asarray(widths, dtype=np.uint32)) - 1
    return ((words[:, None] >> np.asarray(shifts, dtype=np.uint32)) & masks) / masks


def _between(chunk: np.ndarray, names: tuple[str, ...], fractions: np.ndarray) -> np.ndarray:
    """`(1 − t) min + t max` with the bounds of the chunk that each row belongs to."""
    which = np.arange(len(fractions)) // CHUNK
    low, high = (
        np.stack([chunk[f"{end}_{name}"] for name in names], axis=-1).astype(np.float64)[which]
        for end in ("min", "max")
    )
    with np.errstate(invalid="ignore"):
        return (1 - fractions) * low + fractions * high


def _quaternions(words: np.ndarray) -> np.ndarray:
    others = _fractions(words, (20, 10, 0), (10, 10, 10))
    return with_largest((words >> np.uint32(30)).astype(np.intp), math.sqrt(2) * (others - 0.5))


def with_largest(which: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Unit quaternions from three components and the index of the fourth, `√(1 − |others|²)`.

    Args:
        which: index of the component that was left out, of shape (n,).
        others: the other three in their order, of shape (n, 3).
    """
    places = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[which]
    largest = np.sqrt(np.maximum(0, 1 - np.sum(others**2, axis=-1, keepdims=True)))
    q = np.empty((len(others), 4))
    np.put_along_axis(q, places, others, axis=1)
    np.put_along_axis(q, which[:, None], largest, axis=1)
    return q


def _harmonics(sh: np.ndarray | None, n: int) -> np.ndarray:
    """Coefficients above degree 0, of shape (n, k − 1, 3): the middle of what a byte stands for."""
    if sh is None:
        return np.zeros((n, 0, 3))
    names = _rest(len(sh.dtype.names or ()))
    table = np.stack([sh[name] for name in names], axis=-1).astype(np.float64)
    # The outermost bytes also stand for everything beyond: their outer ends are taken.
    fraction = np.where(table == 0, 0, np.where(table == 255, 1, (table + 0.5) / 256))
    return (8 * (fraction - 0.5)).reshape(n, 3, -1).transpose(0, 2, 1)


def _bounds(names: tuple[str, ...]) -> list[str]:
    return [f"{end}_{name}" for end in ("min", "max") for name in names]


def _rest(count: int) -> list[str]:
    return [f"f_rest_{i}" for i in range(count)]
