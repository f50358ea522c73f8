"""What is drawn: captures and a procedural landscape, each whole in the frame of a camera."""

import jax.numpy as jnp
import numpy as np

from benchmarks.render.cases import Case
from pgjax.render import Camera, Gaussians, load_gaussians

BACKGROUND = (1.0, 1.0, 1.0)


def landscape(side: int) -> Gaussians:
    """Hills covered by side² flat Gaussians, each about as wide as their distance.

    The ground is a square of edge 2 in x and z; y points down. Sizes, opacities and shades are
    random numbers of a fixed seed. The harmonics have degree 1.
    """
    n, spacing = side * side, 2 / side
    generator = np.random.default_rng(0)
    axis = (np.arange(side) + 0.5) * spacing - 1
    x, z = np.meshgrid(axis, axis, indexing="ij")
    height = np.zeros_like(x)
    for octave in range(5):
        turn, frequency = 0.7 + 1.9 * octave, 2.0 * 2**octave
        along = frequency * (np.cos(turn) * x + np.sin(turn) * z) + octave
        across = 1.7 * frequency * (np.cos(2 * turn) * z - np.sin(2 * turn) * x)
        height += 0.18 / 2**octave * np.sin(along) * np.cos(across)
    slope_x, slope_z = np.gradient(-height, spacing)
    one, zero = np.ones_like(x), np.zeros_like(x)
    first = np.stack([one, slope_x, zero], axis=-1).reshape(n, 3)
    second = np.stack([zero, slope_z, one], axis=-1).reshape(n, 3)
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    spread = spacing * generator.uniform(0.5, 0.75, (n, 1, 1))
    light = np.clip(normal @ np.array([0.5, -0.8, 0.33]), 0.15, 1)
    share = np.clip((height.reshape(n, 1) + 0.12) / 0.4, 0, 1)
    ground = (1 - share) * np.array([0.25, 0.5, 0.15]) + share * np.array([0.85, 0.8, 0.75])
    sh = generator.normal(scale=0.05, size=(n, 4, 3))
    color = ground * light[:, None] * generator.uniform(0.85, 1.15, (n, 1))
    sh[:, 0] = (color - 0.5) * np.sqrt(4 * np.pi)
    parts = (
        np.stack([x, -height, z], axis=-1).reshape(n, 3),
        spread * np.stack([first, second, 0.1 * normal], axis=-1),
        generator.uniform(0.4, 0.95, n),
        sh,
        np.broadcast_to(np.eye(3), (n, 3, 3)),
    )
    return Gaussians(*(jnp.asarray(part, jnp.float32) for part in parts))


def view(case: Case) -> tuple[Gaussians, Camera]:
    """The Gaussians, and a camera around them that has all but stray ones in its frame."""
    gaussians = landscape(case.side) if case.file is None else load_gaussians(case.file)
    low, high = np.quantile(np.asarray(gaussians.means), [0.002, 0.998], axis=0)
    camera = Camera.orbit(
        (low + high) / 2,
        up=[0, -1, 0],
        azimuth=0.6,
        elevation=0.25 if case.file else 0.6,
        radius=1.3 * np.linalg.norm(high - low),
        width=case.size,
        height=case.size,
        fov_y=0.85,
    )
    return gaussians, camera


def directions(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the image in the differentiated sum, and a tangent of the means, both random."""
    generator = np.random.default_rng(0)
    weights = generator.normal(size=(camera.height, camera.width, 3))
    tangent = generator.normal(size=gaussians.means.shape)
    return weights.astype(np.float32), tangent.astype(np.float32)
