"""Reading `.splat` files: 32 bytes for each Gaussian, without header or harmonics.

A record is `x y z` and the three scales (not their logarithms) as little-endian float32, red,
green, blue and opacity as bytes `255 c`, and the quaternion wxyz as bytes `128 + 128 q`.

Reference: K. Kwok, "WebGL 3D Gaussian Splat Viewer" (antimatter15/splat), README and `convert.py`.
"""

import math
from pathlib import Path

import numpy as np

from pgjax._files import require_memory

_RECORD = np.dtype(
    [
        ("position", "<f4", 3),
        ("scale", "<f4", 3),
        ("rgb", "u1", 3),
        ("opacity", "u1"),
        ("quaternion", "u1", 4),
    ]
)


def read_splat(file: Path) -> list[np.ndarray]:
    """The arguments of `Gaussians.from_scales`, in double precision.

    Raises:
        ValueError: the file is empty, is not a whole number of records, or holds negative scales.
    """
    size = file.stat().st_size
    if size == 0 or size % _RECORD.itemsize:
        raise ValueError(
            f"The file {file} is not a complete .splat: it must hold a positive multiple of "
            f"{_RECORD.itemsize} bytes, but holds {size}."
        )
    # Numbers in double precision, the harmonics by themselves.
    require_memory(file, 4 * size)
    records = np.fromfile(file, dtype=_RECORD)
    negative = int(np.count_nonzero((records["scale"] < 0).any(axis=1)))
    if negative:
        raise ValueError(
            f"The file {file} is not a .splat: {negative} of its {len(records)} records have "
            "negative scales."
        )
    return [
        records["position"].astype(np.float64),
        (records["quaternion"] - 128.0) / 128,
        records["scale"].astype(np.float64),
        records["opacity"] / 255,
        constant_harmonic(records["rgb"] / 255)[:, None],
    ]


def constant_harmonic(rgb: np.ndarray) -> np.ndarray:
    """Coefficient of degree 0 of a colour: `c = (rgb − 1/2) / Y₀`, `Y₀ = 1/√(4π)`."""
    return (rgb - 0.5) * math.sqrt(4 * math.pi)
