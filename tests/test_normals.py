"""Normals of Gaussians: shortest axes, turned to the camera, with their derivatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from render_scenes import floats, hard_scene, looking
from scene_files import sphere
from scipy.spatial.transform import Rotation

from pgjax.render import Camera, Gaussians, deform, normals, render

DOUBLE = jax.config.jax_enable_x64
TIGHT = 1e-9 if DOUBLE else 2e-4


def scattered(seed=0, n=50):
    """Gaussians with three different axes, and the rotations that made them."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(n, rng=seed)
    scales = floats(np.tile([0.3, 0.01, 0.1], (n, 1)))
    parts = (
        floats(rng.uniform([-1, -1, 2], [1, 1, 4], (n, 3))),
        floats(turns.as_quat(scalar_first=True)),
        scales,
        floats(np.full(n, 0.9)),
        floats(np.zeros((n, 1, 3))),
    )
    return Gaussians.from_scales(*parts), turns.as_matrix()


def towards(camera, gaussians, n):
    return np.einsum("ni,ni->n", n, np.asarray(gaussians.means) - np.asarray(camera.position))


def test_the_shortest_axis_is_turned_to_the_camera():
    camera = looking(45, 33)
    gaussians, turns = scattered()
    n = np.asarray(normals(gaussians, camera))
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", n, turns[:, :, 1])), 1, atol=TIGHT)
    assert np.all(towards(camera, gaussians, n) <= TIGHT)
    behind = Camera.look_at([0, 0, 9], [0, 0, 0], up=[0, -1, 0], focal=40, width=8, height=8)
    other = np.asarray(normals(gaussians, behind))
    assert np.all(towards(behind, gaussians, other) <= TIGHT)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", n, other)), 1, atol=TIGHT)


def test_deformed_gaussians_have_the_normals_of_their_deformed_shape():
    camera = looking(45, 33)
    gaussians, _ = scattered(1)
    rng = np.random.default_rng(1)
    F = floats(np.eye(3) + 0.3 * rng.normal(size=(50, 3, 3)))
    deformed = deform(gaussians, gaussians.means, F)
    n = np.asarray(normals(deformed, camera), np.float64)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=TIGHT)
    _, axes = np.linalg.eigh(np.asarray(deformed.covariances, np.float64))
    assert np.abs(np.einsum("ni,ni->n", n, axes[:, :, 0])).min() > 1 - 1e-4


def test_the_picture_of_a_sphere_shows_its_normals():
    ball = jax.tree.map(floats, sphere())
    camera = Camera.look_at([0, -4, 0], [0, 0, 0], up=[0, 0, 1], focal=60, width=48, height=48)
    image = render(ball, camera, features=normals(ball, camera))
    length = np.linalg.norm(image.features, axis=-1)
    seen = np.asarray(image.alpha) > 0.99
    assert seen.sum() > 400
    found = np.asarray(image.features)[seen] / length[seen][:, None]
    # Where the ray through a pixel meets the sphere of radius 1 is its normal, too.
    x, y = np.meshgrid(np.arange(48) + 0.5 - 24, np.arange(48) + 0.5 - 24)
    ray = np.stack([x, y, np.full_like(x, 60)], axis=-1) @ np.asarray(
        camera.world_to_camera[:3, :3]
    )
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    eye = np.asarray(camera.position)
    along = ray @ eye
    reach = -along - np.sqrt(np.maximum(along**2 - eye @ eye + 1, 0))
    expected = (eye + reach[..., None] * ray)[seen]
    assert np.median(np.einsum("ni,ni->n", found, expected)) > 0.99


def test_the_derivative_is_that_of_the_eigenvector():
    camera = looking(45, 33)
    gaussians, _ = scattered(2)
    rng = np.random.default_rng(2)
    step = floats(rng.normal(size=(50, 3, 3)) * 0.05)

    def of(factors):
        return normals(dataclasses.replace(gaussians, factors=factors), camera)

    h = 1e-6 if DOUBLE else 1e-2
    _, found = jax.jvp(of, (gaussians.factors,), (step,))
    ahead, back = of(gaussians.factors + h * step), of(gaussians.factors - h * step)
    expected = (ahead - back) / (2 * h)
    np.testing.assert_allclose(found, expected, atol=1e-6 if DOUBLE else 5e-2)
    bar = floats(rng.normal(size=(50, 3)))
    _, pull = jax.vjp(of, gaussians.factors)
    np.testing.assert_allclose(
        jnp.vdot(pull(bar)[0], step), jnp.vdot(bar, found), rtol=1e-9 if DOUBLE else 1e-3
    )


def test_balls_needles_and_nothing_have_finite_normals_and_derivatives():
    scene = hard_scene(0)
    factors = scene.factors.at[:3].set(0).at[3].set(jnp.eye(3, dtype=scene.factors.dtype))
    camera = looking(45, 33)

    def of(factors):
        return normals(dataclasses.replace(scene, factors=factors), camera)

    n, pull = jax.vjp(of, factors)
    assert np.all(np.isfinite(pull(jnp.ones_like(n))[0]))
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-5)
