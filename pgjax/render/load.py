"""Reading Gaussians from a file of any format that is known."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pgjax.render.gaussians import Gaussians
from pgjax.render.ply import Capture, existing_file, finite_gaussians, read_ply
from pgjax.render.splat import read_splat
from pgjax.render.spz import read_spz

_READERS = {".ply": read_ply, ".splat": read_splat, ".spz": read_spz}
_BEGINNINGS = {b"ply\n": read_ply, b"ply\r": read_ply, b"\x1f\x8b": read_spz, b"NGSP": read_spz}


def load_gaussians(path: str | os.PathLike[str]) -> Gaussians:
    """Read Gaussians from `.ply` (3D Gaussian Splatting or PlayCanvas), `.splat` or `.spz`.

    The suffix tells the format; where it is another, the first bytes do (a `.splat` has none that
    would tell). All are returned in the world axes of a `.ply`: an `.spz`, whose y axis points up,
    is turned by half a turn about x, its harmonics included. Gaussians with NaN or infinite values,
    or with a quaternion of length zero, are left out and counted in a warning.

    Args:
        path: the file.

    Raises:
        ValueError: the file is missing, incomplete, of no known format, or holds nothing that can
            be drawn.
    """
    return finite_gaussians(*_content(path)).gaussians


def load_capture(path: str | os.PathLike[str]) -> Capture:
    """The same as `load_gaussians`, and which Gaussians of the file they are.

    For values that come beside a capture, one for each Gaussian of its file (labels of a
    segmentation, say): `values[capture.rows]` are those of `capture.gaussians`.
    """
    return finite_gaussians(*_content(path))


def _content(path: str | os.PathLike[str]) -> tuple[Path, list[np.ndarray]]:
    """The file, and what its reader finds in it."""
    file = existing_file(path)
    read = _READERS.get(file.suffix.lower()) or _recognised(file)
    return file, read(file)


def _recognised(file: Path) -> Callable[[Path], list[np.ndarray]]:
    """The reader that the first bytes of the file ask for."""
    with file.open("rb") as stream:
        head = stream.read(4)
    for beginning, read in _BEGINNINGS.items():
        if head.startswith(beginning):
            return read
    raise ValueError(
        f"The file {file} is of no known format, by its suffix {file.suffix!r} and its first "
        f"bytes {head!r}. Gaussians are read from .ply (3D Gaussian Splatting, and the compressed "
        "layout of PlayCanvas), .splat and .spz."
    )
