"""Scenes that the tests of the renderer share."""

import jax.numpy as jnp
import numpy as np

from pgjax.render import Camera, Gaussians


def floats(array):
    return jnp.asarray(array, dtype=jnp.zeros(()).dtype)


def hard_scene(seed, n=96):
    """Behind, at the near plane, outside, huge, needles, tiny, clear, opaque, tied in depth."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1.5, -1.5, 2], [1.5, 1.5, 5], (n, 3))
    scales = np.exp(rng.uniform(np.log(0.01), np.log(0.3), (n, 3)))
    opacities = rng.uniform(0, 1, n)
    means[:8, 2] = rng.uniform(-3, 0.0, 8)
    means[8:12, 2] = [0.01, 0.0100001, 0.02, 0.1]
    means[12:20] *= [6, 6, 1]
    scales[20:24] = 30.0
    scales[24:32] = [2.0, 1e-3, 1e-3]
    scales[32:40] = 1e-8
    opacities[40:44] = [0, 1 / 256, 1 / 254, 1e-9]
    opacities[44:56] = 1.0
    means[56:72, 2] = 3.0
    opacities[20:24] = 0.05
    quaternions, sh = rng.normal(size=(n, 4)), 0.4 * rng.normal(size=(n, 16, 3))
    return Gaussians.from_scales(*map(floats, (means, quaternions, scales, opacities, sh)))


def looking(width, height, focal=45.0):
    return Camera.look_at(
        [0, 0, 0], [0, 0, 1], up=[0, -1, 0], focal=focal, width=width, height=height
    )


def smooth_scene(seed):
    """The hard scene, but that none of it is within a step of the near plane or of opacity 0."""
    scene = hard_scene(seed)
    means = scene.means.at[8:12, 2].set(floats([0.05, 0.1, 0.3, 0.5]))
    opacities = scene.opacities.at[jnp.asarray([40, 43])].set(1e-3)
    return Gaussians(means, scene.factors, opacities, scene.sh, scene.frames)
