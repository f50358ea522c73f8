"""Reading and writing `.ply` files in the layout of 3D Gaussian Splatting.

One vertex is one Gaussian: `x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*`, with a logit
opacity, logarithmic scales, a quaternion wxyz that need not be normalised, and the harmonics above
degree 0 channel by channel (all of red, then green, then blue). The compressed layout of PlayCanvas
is read, too: `compressed.py` knows what its columns mean.
"""

import difflib
import os
import warnings
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from pgjax._files import replacing, require_memory
from pgjax.render import compressed
from pgjax.render.gaussians import Gaussians
from pgjax.render.harmonics import COUNTS, rotate_coefficients

_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_MAX_HEADER = 1 << 18
# Rows of lists, of which Gaussians have none: each takes a microsecond.
_MOST_LISTS = 100_000
# In double precision, and once more on the way.
_IN_MEMORY = 4
# exp, log and logit stay finite in single precision within these.
_MAX_LOGIT, _MIN_SCALE = 50.0, 1e-35


def columns(k: int) -> list[str]:
    """Names of the columns, in order, for k harmonics of each colour."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return names


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians in the layout of 3D Gaussian Splatting, harmonics of degree 0 to 3.

    The compressed layout of PlayCanvas (`.compressed.ply`) is recognised and read as well.
    Gaussians with NaN or infinite values, or with a quaternion of length zero, are left out and
    counted in a warning.

    Raises:
        ValueError: the file is missing, is not a complete `.ply`, lacks columns, or holds nothing
            that can be drawn.
    """
    file = existing_file(path)
    return finite_gaussians(file, read_ply(file)).gaussians


def existing_file(path: str | os.PathLike[str]) -> Path:
    """The path, if there is a file."""
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"There is no file {file}.")
    return file


def read_ply(file: Path) -> list[np.ndarray]:
    """The arguments of `Gaussians.from_scales`, in double precision, of either layout.

    Raises:
        ValueError: as `load_ply`.
    """
    header = _read_header(file)
    if header.counts.get("vertex", 0) == 0:
        raise ValueError(f"The file {file} holds no Gaussians: it has no rows of 'vertex'.")
    if compressed.is_compressed(header.properties):
        compressed.require_layout(file, header.counts, header.properties)
        elements = _read_elements(file)
        return compressed.decode(elements["chunk"], elements["vertex"], elements.get("sh"))
    count = _checked_columns(file, header)
    return _activated(_read_elements(file)["vertex"], count)


def _read_elements(file: Path) -> dict[str, np.ndarray]:
    """Each element of the file as a structured array."""
    try:
        return {element.name: element.data for element in PlyData.read(str(file))}
    except (PlyParseError, ValueError, OSError, MemoryError) as error:
        raise ValueError(f"The file {file} cannot be read as .ply: {error}.") from error


def save_ply(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write Gaussians in the layout of 3D Gaussian Splatting (little-endian float32).

    The covariances are decomposed into rotation and scales, and the harmonics are rotated by the
    frames, so that the file shows the deformed Gaussians in any viewer. The file appears complete
    or not at all.

    Raises:
        ValueError: there are no Gaussians, some are not finite, or the folder does not exist.
    """
    if len(gaussians) == 0:
        raise ValueError("Argument `gaussians` must hold at least one Gaussian, but is empty.")
    table = _file_columns(gaussians)
    broken = np.count_nonzero(~np.isfinite(table).all(axis=1))
    if broken:
        raise ValueError(
            f"Argument `gaussians` must be finite, but {broken} of {len(gaussians)} are not."
        )
    names = columns(gaussians.sh.shape[1])
    vertex = np.empty(len(table), dtype=[(name, "<f4") for name in names])
    for name, column in zip(names, table.T, strict=True):
        vertex[name] = column
    with replacing(path) as temporary:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(temporary))


class _Header(NamedTuple):
    """Of each element its number of rows, and its columns with their types."""

    counts: dict[str, int]
    properties: dict[str, dict[str, str]]


def _read_header(file: Path) -> _Header:
    """Parse the header and compare what it promises with the size of the file."""
    with file.open("rb") as stream:
        head = stream.read(_MAX_HEADER)
    if head[:4].rstrip() != b"ply":
        raise ValueError(f"The file {file} is not a .ply: it does not begin with the line `ply`.")
    newline = _newline(head)
    lines = head.split(newline)
    # A line of its own: in a comment the words end nothing.
    end = next((i for i, line in enumerate(lines) if line.split() == [b"end_header"]), None)
    if end is None:
        raise ValueError(f"The file {file} is truncated: its header has no end.")
    counts: dict[str, int] = {}
    properties: dict[str, dict[str, str]] = {}
    name = ""
    binary = not any(line.split()[:2] == [b"format", b"ascii"] for line in lines[:end])
    for line in (line.decode("ascii", errors="replace") for line in lines[:end]):
        words = line.split()
        try:
            if words[:1] == ["element"]:
                name, counts[words[1]] = words[1], int(words[2])
                properties[name] = {}
            elif words[:1] == ["property"]:
                properties[name][words[-1]] = words[1]
        except (IndexError, KeyError, ValueError):
            raise ValueError(f"The file {file} has a broken header line: {line[:80]!r}.") from None
    header = _Header(counts, properties)
    size = sum(len(line) + len(newline) for line in lines[: end + 1])
    _require_room(file, header, size, binary)
    return header


def _newline(head: bytes) -> bytes:
    """What ends the first line, and every other one of the header."""
    after = head[3:5]
    return after if after == b"\r\n" else after[:1] or b"\n"


def _require_room(file: Path, header: _Header, header_size: int, binary: bool) -> None:
    """Refuse a number of rows that the file cannot hold, before anything is allocated for it."""
    available = file.stat().st_size - header_size
    needed = 0
    for name, count in header.counts.items():
        # In text a value takes a digit and a space; a list takes one byte for its length at least.
        sizes = (_SIZES.get(kind, 1) if binary else 2 for kind in header.properties[name].values())
        if count < 0:
            raise ValueError(f"The file {file} declares {count} rows of {name!r}.")
        needed += count * sum(sizes)
    if needed > available + (not binary):
        rows = ", ".join(f"{count} {name}" for name, count in header.counts.items())
        raise ValueError(
            f"The file {file} is truncated or its header is wrong: it declares {rows}, which take "
            f"{needed} bytes, but only {available} follow the header."
        )
    for name, kinds in header.properties.items():
        if "list" in kinds.values() and header.counts[name] > _MOST_LISTS:
            raise ValueError(
                f"The file {file} must have at most {_MOST_LISTS} rows of lists, but has "
                f"{header.counts[name]} of {name!r}."
            )
    require_memory(file, _IN_MEMORY * needed)


def _checked_columns(file: Path, header: _Header) -> int:
    """Number of harmonics k, after checking that all columns are there and of a number type."""
    present = header.properties["vertex"]
    rest = sum(name.startswith("f_rest_") for name in present)
    if rest not in {3 * (k - 1) for k in COUNTS}:
        raise ValueError(
            f"The file {file} must have 0, 9, 24 or 45 columns `f_rest_*` "
            f"(harmonics of degree 0 to 3), but has {rest}."
        )
    k = rest // 3 + 1
    required = [name for name in columns(k) if name not in {"nx", "ny", "nz"}]
    missing = [name for name in required if name not in present]
    if missing:
        raise ValueError(f"The file {file} lacks the columns {_with_hints(missing, present)}.")
    lists = [name for name in required if present[name] not in _SIZES]
    if lists:
        raise ValueError(
            f"The file {file} must have one number per Gaussian in the columns {', '.join(lists)}."
        )
    return k


def _with_hints(missing: list[str], present: dict[str, str]) -> str:
    """The missing names, each with the most similar column that the file does have."""
    required = set(columns(COUNTS[-1]))
    others = {name.lower(): name for name in present if name not in required}
    words = []
    for name in missing:
        close = difflib.get_close_matches(name, others, n=1, cutoff=0.5)
        words.append(f"`{name}`" + (f" (is it `{others[close[0]]}`?)" if close else ""))
    return ", ".join(words)


def _activated(vertex: np.ndarray, k: int) -> list[np.ndarray]:
    """The columns of the uncompressed layout as arguments of `Gaussians.from_scales`."""

    def group(*names: str) -> np.ndarray:
        return np.stack([np.asarray(vertex[name], dtype=np.float64) for name in names], axis=-1)

    n = len(vertex)
    rest = group(*columns(k)[9 : 9 + 3 * (k - 1)]) if k > 1 else np.zeros((n, 0))
    dc = group("f_dc_0", "f_dc_1", "f_dc_2")
    logit = np.asarray(vertex["opacity"], dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        return [
            group("x", "y", "z"),
            group("rot_0", "rot_1", "rot_2", "rot_3"),
            np.exp(group("scale_0", "scale_1", "scale_2")),
            np.where(np.isfinite(logit), 1 / (1 + np.exp(-logit)), np.nan),
            np.concatenate([dc[:, None], rest.reshape(n, 3, k - 1).transpose(0, 2, 1)], axis=1),
        ]


class Capture(NamedTuple):
    """The usable Gaussians of a file, n of them.

    Attributes:
        gaussians: in the order of the file.
        rows: the number of each in the file, counted from 0, `(n,)`.
        total: number of Gaussians in the file, those left out included.
    """

    gaussians: Gaussians
    rows: np.ndarray
    total: int


def finite_gaussians(file: Path, parts: list[np.ndarray]) -> Capture:
    """The usable Gaussians of a file in the default precision; a warning counts the others.

    Args:
        file: where they are from, for messages.
        parts: the arguments of `Gaussians.from_scales`.
    """
    means, quaternions, scales, opacities, sh = parts
    dtype, n = jnp.zeros(()).dtype, len(means)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        unit = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
        parts = [part.astype(dtype) for part in (means, unit, scales, opacities, sh)]
    good = np.ones(n, dtype=bool)
    for part in parts:
        good &= np.isfinite(part.reshape(n, -1)).all(axis=1)
    _report_left_out(file, n, int(np.count_nonzero(~good)))
    usable = Gaussians.from_scales(*(jnp.asarray(part[good]) for part in parts))
    return Capture(usable, np.flatnonzero(good), n)


def _report_left_out(file: Path, n: int, broken: int) -> None:
    problem = "have NaN or infinite values or a quaternion of length zero"
    if broken == n:
        raise ValueError(f"The file {file} holds no usable Gaussians: all {n} {problem}.")
    if broken:
        warnings.warn(
            f"{broken} of the {n} Gaussians in {file} {problem} and are left out.", stacklevel=4
        )


def _file_columns(gaussians: Gaussians) -> np.ndarray:
    """All columns of the file in double precision, of shape (n, number of columns)."""
    means, factors, opacities, sh, frames = (
        np.asarray(part, dtype=np.float64)
        for part in (
            gaussians.means,
            gaussians.factors,
            gaussians.opacities,
            gaussians.sh,
            gaussians.frames,
        )
    )
    finite = np.isfinite(factors).all(axis=(1, 2), keepdims=True)
    # M = U Σ Vᵀ gives A = U Σ² Uᵀ.
    U, scales, _ = np.linalg.svd(np.where(finite, factors, 0.0))
    U[:, :, 2] *= np.sign(np.linalg.det(U)).reshape(-1, 1)
    scales = np.where(finite.reshape(-1, 1), np.maximum(scales, _MIN_SCALE), np.nan)
    coefficients = rotate_coefficients(sh, frames)
    rest = coefficients[:, 1:].transpose(0, 2, 1).reshape(len(means), -1)
    with np.errstate(divide="ignore"):
        logit = np.log(opacities) - np.log1p(-np.minimum(opacities, 1))
    return np.concatenate(
        [
            means,
            np.zeros_like(means),
            coefficients[:, 0],
            rest,
            np.clip(logit, -_MAX_LOGIT, _MAX_LOGIT)[:, None],
            np.log(scales),
            quaternions_of(U),
        ],
        axis=1,
    )


def quaternions_of(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions wxyz, w ≥ 0, of rotation matrices of shape (n, 3, 3).

    With `K = 4 q qᵀ`, whose entries are linear in R, the column with the largest diagonal entry is
    a multiple of q, and dividing by its length is safe because that entry is at least 1.
    """
    R = np.moveaxis(rotations, 0, -1)
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    best = np.argmax(np.diagonal(K), axis=-1)
    q = K[:, best, np.arange(len(best))].T
    return q / np.linalg.norm(q, axis=-1, keepdims=True) * np.where(q[:, :1] < 0, -1, 1)
