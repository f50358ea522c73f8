"""Gaussians before they are lit, and the light that is baked into their colours."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pgjax.render.gaussians import Gaussians

UP = np.array([0.0, 0.0, 1.0])
LIGHT = np.array([0.55, -0.45, 0.70]) / np.linalg.norm([0.55, -0.45, 0.70])
"""The direction of the sun."""


class Body(NamedTuple):
    """Unlit Gaussians: orthonormal axes in the columns of `frames`, the last one the normal."""

    means: np.ndarray
    frames: np.ndarray
    scales: np.ndarray
    albedo: np.ndarray
    gloss: np.ndarray


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of shape (…, 3) divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def join(records: Sequence[tuple]) -> Iterator[np.ndarray]:
    """The fields of several records, each in one array."""
    return (np.concatenate(fields) for fields in zip(*records, strict=True))


def select(body: Body, kept: np.ndarray) -> Body:
    """The Gaussians that a mask selects."""
    return Body(*(part[kept] for part in body))


def axes(normals: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Right-handed orthonormal axes: near `along`, across it, and the normal; (n, 3, 3)."""
    across = unit(np.cross(normals, along))
    return np.stack([np.cross(across, normals), across, normals], axis=-1)


def disks_and_balls(
    means: np.ndarray, normals: np.ndarray, surface: np.ndarray, spacing: float, albedo: np.ndarray
) -> Body:
    """Overlapping flat disks where `surface` holds, and smaller balls that stay hidden inside."""
    flat, ball = np.array([0.66, 0.66, 0.15]) * spacing, np.full(3, 0.42 * spacing)
    along = np.where(np.abs(normals[:, 2:]) > 0.9, np.array([1.0, 0.0, 0.0]), UP)
    scales = np.where(surface[:, None], flat, ball)
    return Body(means, axes(normals, along), scales, albedo, np.full(len(means), 0.03))


def transmittance(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Light that reaches points from a direction, through balls that widen along a cone.

    `T = exp(−Σ ρ a Δt / 2)`, with ρ the Gaussians per volume in a ball, a the area of one of them,
    and Δt the diameter of the ball.
    """
    tree, area, depth = KDTree(points), 1.5e-4, np.zeros(len(points))
    for distance, radius in ((0.07, 0.03), (0.15, 0.05), (0.27, 0.07)):
        count = tree.query_ball_point(points + distance * direction, radius, return_length=True)
        depth += count / (4 / 3 * math.pi * radius**3) * area * 2 * radius / 2
    return np.exp(-depth)


def lit(body: Body, sky: np.ndarray, sun: np.ndarray) -> Gaussians:
    """Bake the light into the harmonics: sky and sun at degree 0, gloss at degree 1.

    `c(d) = c₀ + g (r · −d)` with r the mirror image of the sun, for the viewing direction d.

    Args:
        body: what is lit, n Gaussians.
        sky: how much of the sky each of them sees, from 0 to 1, `(n,)`.
        sun: how much of the sun, likewise.
    """
    normal = body.frames[..., 2]
    facing = normal @ LIGHT
    # Seen from either side, and through what is glossy, as leaves are, a little light passes.
    facing_sun = np.maximum(facing + 0.25, 0) / 1.25
    facing_sun += 0.3 * np.maximum(-facing, 0) * (body.gloss > 0.1)
    skylight, sunlight = (0.75 + 0.25 * normal[:, 2]) * sky, 0.85 * facing_sun * sun
    light = 0.3 + 0.5 * skylight[:, None] + sunlight[:, None] * np.array([1.0, 0.97, 0.88])
    color = np.clip(body.albedo * light, 0.02, 1.0)
    mirror = 2 * facing[:, None] * normal - LIGHT
    strength = (body.gloss * (0.2 + sunlight))[:, None, None] * np.ones(3)
    c0, c1 = math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi))
    # The basis at degree 1 is c1 (−y, z, −x).
    linear = mirror[:, [1, 2, 0]] * [1, -1, 1] / c1
    sh = np.concatenate([(color[:, None] - 0.5) / c0, linear[:, :, None] * strength], axis=1)
    quaternions = np.roll(Rotation.from_matrix(body.frames).as_quat(), 1, axis=-1)
    parts = (body.means, quaternions, body.scales, np.full(len(normal), 0.95), sh)
    return Gaussians.from_scales(*(jnp.asarray(part, dtype=float) for part in parts))
