"""Real spherical harmonics of degree 0 to 3, with the signs of 3D Gaussian Splatting."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Float

MAX_DEGREE = 3
COUNTS = (1, 4, 9, 16)
"""Number of coefficients up to degree 0, 1, 2, 3."""


def _polynomials(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """The basis functions as polynomials, for any array type, in the order of the files."""
    c0 = math.sqrt(1 / (4 * math.pi))
    c1 = math.sqrt(3 / (4 * math.pi))
    values = [c0 + 0 * x]
    if degree >= 1:
        values += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c2 = math.sqrt(15 / (4 * math.pi))
        values += [
            c2 * x * y,
            -c2 * y * z,
            math.sqrt(5 / (16 * math.pi)) * (2 * z * z - x * x - y * y),
            -c2 * x * z,
            c2 / 2 * (x * x - y * y),
        ]
    if degree >= 3:
        c33 = math.sqrt(35 / (32 * math.pi))
        c32 = math.sqrt(105 / (4 * math.pi))
        c31 = math.sqrt(21 / (32 * math.pi))
        values += [
            -c33 * y * (3 * x * x - y * y),
            c32 * x * y * z,
            -c31 * y * (4 * z * z - x * x - y * y),
            math.sqrt(7 / (16 * math.pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c31 * x * (4 * z * z - x * x - y * y),
            c32 / 2 * z * (x * x - y * y),
            -c33 * x * (x * x - 3 * y * y),
        ]
    return values


def harmonics(direction: Float[Array, "3"], degree: int) -> Float[Array, " k"]:
    """`Y_lm(d)` for l = 0 … degree at the unit vector d; k = (degree + 1)².

    The order is m = −l … l, and the signs at degree 1 are (−y, z, −x).
    """
    x, y, z = direction
    return jnp.stack(_polynomials(x, y, z, degree))


def basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """`Y_lm` at unit vectors of shape (…, 3) in numpy; the result has shape (…, k)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return np.stack(_polynomials(x, y, z, degree), axis=-1)


def _directions(count: int = 32) -> np.ndarray:
    """Directions spread over the sphere on a spiral of the golden angle, of shape (count, 3)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)


def rotate_coefficients(sh: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Coefficients `D(R) c` of the turned functions: `Y(d) · D(R) c = Y(Rᵀ d) · c` for every d.

    A rotation mixes the harmonics of one degree among themselves, by the matrix
    `D_l = Y_l(P)⁺ Y_l(P R)` with fixed directions P as rows (exact to rounding, as Y_l(P) has full
    column rank).

    Args:
        sh: coefficients, of shape (n, k, 3).
        rotations: rotations R, of shape (n, 3, 3).
    """
    degree = math.isqrt(sh.shape[1]) - 1
    directions = _directions()
    fixed = basis(directions, degree)
    turned = basis(directions @ rotations, degree)
    rotated = np.array(sh, dtype=np.float64)
    for l in range(1, degree + 1):
        band = slice(l * l, (l + 1) ** 2)
        rotation = np.linalg.pinv(fixed[:, band]) @ turned[:, :, band]
        rotated[:, band] = rotation @ rotated[:, band]
    return rotated
