"""The `.npz` files of `storage` as a reader meets them: nothing in them is taken on trust.

Headers are compared with the room there is before anything large is read.
"""

import contextlib
import math
import os
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

FORMAT = "format"
VERSION = 1
# Kinds of dtype that `.npy` stores as they are: bool, integers, floats, complex numbers.
NUMBERS = "biufc"
_LONGEST_FORMAT = 256


class Entry(NamedTuple):
    """An array of a file as its header describes it."""

    shape: tuple[int, ...]
    dtype: np.dtype


class Found(NamedTuple):
    """An open file whose headers have been read and fit the size of what follows them."""

    file: Path
    archive: zipfile.ZipFile
    entries: dict[str, Entry]

    def refused(self, rule: str, fault: str) -> ValueError:
        """The error of a file that breaks a rule."""
        return ValueError(f"The file {self.file} must {rule}, but {fault}.")

    def read(self, name: str) -> np.ndarray:
        """The array of a name; the checksum is compared on the way."""
        with _naming(self.file), self.archive.open(f"{name}.npy") as stream:
            array = np.lib.format.read_array(stream, allow_pickle=False)
            # The checksum is known at the end only.
            stream.read(1)
        return array


@contextlib.contextmanager
def opened(path: str | os.PathLike[str], kind: str) -> Iterator[Found]:
    """Open a file and read its headers, no more."""
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"There is no file {file}.")
    with _naming(file):
        archive = zipfile.ZipFile(file)
    with archive:
        entries = {}
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name in entries:
                raise _damaged(file, f"`{name}` is there twice")
            entries[name] = _entry(file, archive, info)
        found = Found(file, archive, entries)
        _require_kind(found, kind)
        del entries[FORMAT]
        for name, entry in entries.items():
            if entry.dtype.kind not in NUMBERS:
                raise found.refused("hold numbers only", f"`{name}` is of type {entry.dtype}")
        yield found


def _entry(file: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Entry:
    """What the header of an array says, compared with the room there is for it in the file."""
    room = file.stat().st_size - info.header_offset
    if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
        raise _damaged(file, f"`{info.filename}` is compressed, which pgjax never does")
    if not 0 <= info.file_size <= room:
        raise _damaged(
            file, f"`{info.filename}` claims {info.file_size} bytes where {room} are left"
        )
    with _naming(file), archive.open(info) as stream:
        shape, dtype, header = _array_header(stream)
    size = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or (header + size != info.file_size and not dtype.hasobject):
        raise _damaged(
            file,
            f"`{info.filename}` claims the shape {shape}, but holds {info.file_size} bytes",
        )
    return Entry(shape, dtype)


def _array_header(stream: Any) -> tuple[tuple[int, ...], np.dtype, int]:
    """Shape, dtype and length of the header of a `.npy`."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"version {version} of .npy is unknown")
    return shape, dtype, stream.tell()


def _require_kind(found: Found, kind: str) -> None:
    """Raise unless the file says that it is what is wanted, of the version known here."""
    entry = found.entries.get(FORMAT)
    text = ""
    if entry and entry.dtype.kind == "U" and not entry.shape:
        text = str(found.read(FORMAT)) if entry.dtype.itemsize <= _LONGEST_FORMAT else ""
    match = re.fullmatch(r"pgjax (\w+) (\d+)", text)
    if match is None:
        raise found.refused(f"be a {kind} written by pgjax", "does not say that it is")
    if match[1] != kind:
        raise found.refused(f"hold a {kind}", f"holds a {match[1]}")
    if int(match[2]) != VERSION:
        raise found.refused(
            f"be of version {VERSION}, the one this pgjax reads", f"is of version {match[2]}"
        )


def _damaged(file: Path, fault: Any) -> ValueError:
    return ValueError(
        f"The file {file} must be a complete .npz, but is truncated or damaged: {fault}."
    )


@contextlib.contextmanager
def _naming(file: Path) -> Iterator[None]:
    """Whatever a damaged file makes the readers of zip and numpy raise, name the file."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        raise _damaged(file, str(error).rstrip(".") or type(error).__name__) from error
