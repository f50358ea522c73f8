"""Reading `.spz` files (Niantic), versions 1 to 3.

A gzip stream of a header of 16 bytes and one array after the other: positions, opacities, colours,
scales, rotations and harmonics, all quantised. The axes of the file are right, up, back; those of a
capture in `.ply` are right, down, front. The half turn about x, `(x, y, z) → (x, −y, −z)`, leads
from one to the other.

Reference: Niantic, "spz", README of nianticlabs/spz, 2025.
"""

import math
import struct
import warnings
import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from pgjax._files import require_memory
from pgjax.render.compressed import with_largest
from pgjax.render.harmonics import COUNTS, MAX_DEGREE, basis

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBx")
_VERSIONS = (1, 2, 3)
_ANTIALIASED = 1
_COLOUR_SCALE = 0.15
# Deflate cannot shrink anything further than 258 bytes to 2 bits. No capture shrinks as far as the
# second, which holds for more than so many bytes.
_MAX_RATIO, _REAL_RATIO, _SMALL = 1032, 50, 64 << 20
_CHUNK = 1 << 20
# A byte becomes a number in double precision.
_IN_MEMORY = 8
_HALF_TURN = np.array([1.0, -1.0, -1.0])


class _Header(NamedTuple):
    magic: bytes
    version: int
    number: int
    degree: int
    fractional_bits: int
    flags: int

    @property
    def widths(self) -> list[int]:
        """Bytes per Gaussian of each array, in the order of the file."""
        position = 6 if self.version == 1 else 9
        rotation = 4 if self.version == 3 else 3
        return [position, 1, 3, 3, rotation, 3 * (COUNTS[self.degree] - 1)]


def read_spz(file: Path) -> list[np.ndarray]:
    """The arguments of `Gaussians.from_scales` in the axes of a `.ply`, in double precision.

    Raises:
        ValueError: the file is not a complete gzip stream of a known version, or its header
            promises more than the file can hold.
    """
    with file.open("rb") as source:
        stream = _Stream(file, source)
        header = _read_header(file, stream.take(_HEADER.size), file.stat().st_size)
        needed = header.number * sum(header.widths)
        # One byte more than needed, so that the check sum at the end is reached and verified.
        body = stream.take(needed + 1)
    if len(body) > needed:
        raise ValueError(
            f"The file {file} goes on after the {header.number} Gaussians that its header declares."
        )
    if len(body) < needed or not stream.eof:
        raise ValueError(
            f"The file {file} is truncated: it declares {header.number} Gaussians, which take "
            f"{needed} bytes, but holds {len(body)}."
        )
    if header.flags & _ANTIALIASED:
        warnings.warn(
            f"The Gaussians in {file} were trained with antialiasing: give `antialiased=True` to "
            "`render`.",
            stacklevel=3,
        )
    return _decoded(header, body)


class _Stream:
    """A gzip stream that is expanded as far as it is asked for, whatever lies behind that."""

    def __init__(self, file: Path, source: BinaryIO):
        self._file, self._source = file, source
        self._inflater = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
        self._data = source.read(_CHUNK)
        if self._data[:4] == _MAGIC:
            version = int.from_bytes(self._data[4:8], "little")
            raise ValueError(
                f"The file {file} is an .spz of version {version} that is not a gzip stream. "
                "Versions 1 to 3, which are, can be read."
            )

    @property
    def eof(self) -> bool:
        """Whether the end was reached, and its check sum is right."""
        return self._inflater.eof

    def take(self, count: int) -> bytearray:
        """The next bytes, at most so many; fewer where the stream ends."""
        taken = bytearray()
        while len(taken) < count and self._data and not self.eof:
            try:
                taken += self._inflater.decompress(self._data, count - len(taken))
            except zlib.error as error:
                fault = f"cannot be read as .spz: {error}"
                raise ValueError(f"The file {self._file} {fault}.") from None
            self._data = self._inflater.unconsumed_tail or self._source.read(_CHUNK)
        return taken


def _read_header(file: Path, head: bytearray, size: int) -> _Header:
    """Check the header, also against the size of the file, before anything else is expanded."""
    if len(head) < _HEADER.size or head[:4] != _MAGIC:
        raise ValueError(f"The file {file} is not an .spz: its content does not begin with NGSP.")
    header = _Header(*_HEADER.unpack(head))
    if header.version not in _VERSIONS:
        raise ValueError(
            f"The file {file} must be an .spz of version 1, 2 or 3, but has version "
            f"{header.version}."
        )
    if header.degree > MAX_DEGREE:
        raise ValueError(
            f"The file {file} must have harmonics of degree 0 to 3, but has degree {header.degree}."
        )
    if header.flags & ~_ANTIALIASED:
        raise ValueError(
            f"The file {file} has extensions (flags {header.flags:#x}), which are not read. "
            "Write it again without them."
        )
    if header.number == 0:
        raise ValueError(f"The file {file} holds no Gaussians.")
    needed = header.number * sum(header.widths)
    if needed > (_MAX_RATIO if needed <= _SMALL else _REAL_RATIO) * size:
        raise ValueError(
            f"The file {file} is truncated or its header is wrong: it declares {header.number} "
            f"Gaussians, which take {needed} bytes, more than its {size} bytes can expand to."
        )
    require_memory(file, _IN_MEMORY * needed)
    return header


def _decoded(header: _Header, body: bytearray) -> list[np.ndarray]:
    n = header.number
    ends = np.cumsum([n * width for width in header.widths])[:-1]
    parts = np.split(np.frombuffer(body, dtype=np.uint8), ends)
    position, opacity, colour, scale, rotation, rest = (part.reshape(n, -1) for part in parts)
    dc = (colour / 255 - 0.5) / _COLOUR_SCALE
    harmonics = ((rest - 128.0) / 128).reshape(n, -1, 3)
    sh = np.concatenate([dc[:, None], harmonics], axis=1)
    quaternions = _smallest_three(rotation) if header.version == 3 else _first_three(rotation)
    return [
        _HALF_TURN * _positions(header, position),
        # Q R Qᵀ has the axis of R turned, and Q S Qᵀ = S.
        np.append(1.0, _HALF_TURN) * quaternions,
        np.exp(scale / 16 - 10),
        opacity[:, 0] / 255,
        _signs(header.degree)[:, None] * sh,
    ]


def _positions(header: _Header, part: np.ndarray) -> np.ndarray:
    """Half-precision numbers in version 1, later 24-bit fixed-point numbers."""
    if header.version == 1:
        return np.ascontiguousarray(part).view("<f2").astype(np.float64)
    low, middle, high = np.moveaxis(part.reshape(-1, 3, 3).astype(np.int32), -1, 0)
    unsigned = low | middle << 8 | high << 16
    return np.ldexp((unsigned ^ 0x800000) - 0x800000, -header.fractional_bits)


def _first_three(part: np.ndarray) -> np.ndarray:
    """Quaternions wxyz from bytes `127.5 (1 + q)` of x, y, z; w is not negative."""
    return with_largest(np.zeros(len(part), dtype=np.intp), part / 127.5 - 1)


def _smallest_three(part: np.ndarray) -> np.ndarray:
    """Quaternions wxyz from words of the index of the largest of xyzw and the other three.

    Each of the three takes a sign and 9 bits for its size as a fraction of 1/√2.
    """
    words = np.ascontiguousarray(part).view("<u4")
    fields = (words >> np.array([20, 10, 0], dtype=np.uint32)) & 0x3FF
    size = math.sqrt(0.5) * (fields & 0x1FF) / 0x1FF
    others = np.where(fields & 0x200, -size, size)
    xyzw = with_largest((words[:, 0] >> 30).astype(np.intp), others)
    return xyzw[:, [3, 0, 1, 2]]


def _signs(degree: int) -> np.ndarray:
    """The half turn of the harmonics: `Y(d) = ± Y(Q d)`, each with the sign that it has.

    Q flips two axes, and each harmonic is even or odd in each axis or multiplied with one that is.
    """
    generic = np.array([0.36, 0.48, 0.8])
    return np.sign(basis(generic, degree) * basis(_HALF_TURN * generic, degree))
