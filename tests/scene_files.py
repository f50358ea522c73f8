"""Scene files for the tests, and a capture to go with them."""

import jax.numpy as jnp
import numpy as np

from pgjax.render import Gaussians, save_ply
from pgjax.scenes import plan, read_scene

MODEL = """
[model]
ply = "ball.ply"
size = 0.5
"""
GRID = """
[grid]
lower = [-0.5, -0.5, -0.2]
upper = [0.5, 0.5, 0.8]
spacing = 0.1
[time]
frames = 3
fps = 25
"""
JELLY = """
[[material]]
law = "fixed-corotated"
E = 2e4
nu = 0.3
density = 1000
"""
TWO_MATERIALS = """
[[material]]
law = "fixed-corotated"
E = 2e4
nu = 0.3
density = 1000
region = { lower = [-1, -1, -1], upper = [1, 1, 0.25] }
[[material]]
law = "stvk-hencky"
E = 2e4
nu = 0.3
density = 500
plasticity = { type = "von-mises", yield_stress = 200 }
"""
DROP = (
    """
name = "drop"
[model]
ply = "drop.ply"
size = 0.5"""
    + GRID
    + """[forces]
gravity = [0, 0, -9.81]
"""
    + TWO_MATERIALS
    + """[[boundary]]
type = "half-space"
point = [0, 0, -0.1]
normal = [0, 0, 1]
contact = "separating"
friction = 0.3
[camera]
width = 64
height = 48
"""
)
CAMERA = """
[camera]
width = 64
height = 48
"""


def ball(n=200, *, radius=0.4, seed=0, opacities=None):
    """Gaussians that fill a ball, y down as in a capture."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    x *= radius * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(x, axis=1, keepdims=True)
    parts = (
        x,
        rng.normal(size=(n, 4)),
        np.exp(rng.normal(-3, 0.3, (n, 3))),
        np.full(n, 0.9) if opacities is None else opacities,
        rng.normal(size=(n, 4, 3)),
    )
    return Gaussians.from_scales(*(jnp.asarray(a) for a in parts))


def sphere(n=3000, *, size=0.06, seed=1):
    """A sphere of radius 1 of which only the surface was captured, in thin discs."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The quaternion that takes z to the normal.
    q = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(n)], axis=1)
    scales = np.tile([size, size, size / 10], (n, 1))
    sh = np.zeros((n, 4, 3))
    sh[:, 0] = [1.0, -0.5, 0.2]
    parts = (normal, q, scales, np.full(n, 0.95), sh)
    return Gaussians.from_scales(*(jnp.asarray(a) for a in parts))


def changed(text, *changes):
    """A scene file with some of its text changed."""
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return text


def write(folder, *parts, name="scene.toml"):
    """The path of a scene file of the given parts."""
    path = folder / name
    path.write_text("\n".join(parts))
    return path


def planned(folder, *parts, **options):
    """The plan of a scene of the given parts, with a ball of Gaussians if it needs one."""
    if not (folder / "ball.ply").exists():
        save_ply(folder / "ball.ply", ball())
    return plan(read_scene(write(folder, *parts)), **options)
