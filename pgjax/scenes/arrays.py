"""One value per Gaussian of a captured model, from a `.npy` file in the order of the model's file.

A particle takes the value of the Gaussian it is, was split from, or was filled in next to. Files
are read and their values checked with the scene file; whether there are as many values as
Gaussians is known, and checked, once the model is loaded.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pgjax.scenes.reader import REQUIRED, Range, SceneError, Table

_MAGIC = b"\x93NUMPY"


def field(t: Table, key: str, default: Any = REQUIRED, **bounds: float) -> Any:
    """A number, or `{ file = "x.npy" }`: an array with one number per Gaussian."""
    if not t.is_a(key, Mapping):
        return t.number(key, default, **bounds)
    return t.table(key).read(lambda table: _numbers(table, (), Range(**bounds)))


def vector_field(t: Table, key: str) -> Any:
    """Three numbers, or `{ file = "x.npy" }`: an array with three numbers per Gaussian."""
    if not t.is_a(key, Mapping):
        return t.vector(key)
    return t.table(key).read(lambda table: _numbers(table, (3,), Range()))


def label_field(t: Table, key: str) -> np.ndarray:
    """The whole numbers of a `.npy` file, one per Gaussian."""
    values, where = _load(t, key, ())
    if values.dtype.kind not in "iub":
        raise SceneError(f"{where} must hold whole numbers, but holds {values.dtype}.")
    return values.astype(np.int64)


def require_lengths(lengths: Mapping[str, int], count: int, model: str) -> None:
    """Raise unless every file that was read has one value for each Gaussian of the model."""
    for where, length in lengths.items():
        if length != count:
            raise SceneError(
                f"{where} must hold one value for each of the {count} Gaussians of {model}, but "
                f"holds {length}."
            )


def _numbers(t: Table, shape: tuple[int, ...], allowed: Range) -> np.ndarray:
    values, where = _load(t, "file", shape)
    if values.dtype.kind not in "fiu":
        raise SceneError(f"{where} must hold numbers, but holds {values.dtype}.")
    bad = np.argwhere(~allowed.holds(values))
    if len(bad):
        first = tuple(int(i) for i in bad[0])
        raise SceneError(
            f"{where} must hold numbers, each {allowed}, but value {first[0]} is "
            f"{values[first]!s} ({len(bad)} are not)."
        )
    return values.astype(np.float64)


def _load(t: Table, key: str, shape: tuple[int, ...]) -> tuple[np.ndarray, str]:
    """The array of shape `(n, *shape)` that a key names, and how messages call it."""
    path = t.existing_path(key)
    where = f"{t.name}: `{key}` = {path.name!r}"
    try:
        values = _read_npy(path)
    except Exception as error:  # Whatever is wrong with the file.
        raise SceneError(f"{where} must be an array of numbers in .npy format: {error}.") from error
    if values.ndim != 1 + len(shape) or values.shape[1:] != shape or len(values) == 0:
        rule = " x ".join(["n", *map(str, shape)])
        raise SceneError(f"{where} must have the shape {rule}, but has {values.shape}.")
    t.lengths[where] = len(values)
    return values, where


def _read_npy(path: Path) -> np.ndarray:
    with path.open("rb") as stream:
        head = stream.read(len(_MAGIC))
    if head != _MAGIC:
        raise ValueError(f"it begins with {head!r}, not with {_MAGIC!r}")
    # Mapped, a header that promises more than the file holds allocates nothing.
    return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
