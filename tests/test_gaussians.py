"""Gaussians under deformation and changes of coordinates, and the harmonics that turn with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.render import (
    Camera,
    Gaussians,
    Similarity,
    bound_stretch,
    concatenate,
    deform,
    render,
)
from pgjax.render.gaussians import rotation_of
from pgjax.render.harmonics import basis, harmonics, rotate_coefficients

EPS = float(jnp.finfo(jnp.zeros(()).dtype).eps)


def floats(array):
    return jnp.asarray(array, dtype=jnp.zeros(()).dtype)


def random_gaussians(n=12, k=16, seed=0):
    rng = np.random.default_rng(seed)
    parts = (
        rng.uniform(-1, 1, (n, 3)),
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(-3, -1, (n, 3))),
        rng.uniform(0.1, 1, n),
        0.3 * rng.normal(size=(n, k, 3)),
    )
    return Gaussians.from_scales(*map(floats, parts))


def random_rotations(n, seed=1):
    return floats(Rotation.random(n, rng=np.random.default_rng(seed)).as_matrix())


def similarity(seed=2):
    return Similarity(floats(1.7), random_rotations(1, seed)[0], floats([0.3, -0.2, 0.9]))


def repeated(F, n=12):
    return floats(np.tile(np.asarray(F), (n, 1, 1)))


# Harmonics


def test_harmonics_are_orthonormal_with_the_documented_signs():
    # Gauss–Legendre in z and equal weights in the angle integrate degree 6 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * np.pi / 8
    r = np.sqrt(1 - z * z)[:, None]
    d = np.stack([r * np.cos(angle), r * np.sin(angle), z[:, None] + 0 * angle], axis=-1)
    Y = basis(d, 3)
    gram = np.einsum("z,zak,zal->kl", weight * np.pi / 8, Y, Y)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-14)
    c1 = 0.48860251190291992
    np.testing.assert_allclose(
        basis(np.eye(3), 1)[:, 1:], -c1 * np.eye(3)[:, [1, 2, 0]] * [1, -1, 1]
    )


def test_harmonics_agree_in_jax_and_numpy():
    d = random_rotations(5)[:, 0]
    for degree in range(4):
        ours = jax.vmap(lambda d, degree=degree: harmonics(d, degree))(d)
        np.testing.assert_allclose(ours, basis(np.asarray(d), degree), atol=10 * EPS)


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_rotated_coefficients_evaluate_to_the_turned_function(k):
    rng = np.random.default_rng(4)
    R = Rotation.random(6, rng=rng).as_matrix()
    sh, d = rng.normal(size=(6, k, 3)), rng.normal(size=(6, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    degree = int(k**0.5) - 1
    turned = np.einsum("nk,nkc->nc", basis(np.einsum("nji,nj->ni", R, d), degree), sh)
    rotated = np.einsum("nk,nkc->nc", basis(d, degree), rotate_coefficients(sh, R))
    np.testing.assert_allclose(rotated, turned, atol=1e-13)


# Gaussians


def test_rotation_of_a_quaternion():
    q = np.random.default_rng(0).normal(size=(7, 4))
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(jax.vmap(rotation_of)(floats(q)), expected, atol=10 * EPS)


def test_selecting_and_concatenating():
    low, high = random_gaussians(5, 4), random_gaussians(3, 16, seed=1)
    both = concatenate([low, high])
    assert (len(both), both.degree, low.degree) == (8, 3, 1)
    np.testing.assert_array_equal(both[5:].sh, high.sh)
    np.testing.assert_array_equal(both[np.arange(8) < 5].sh[:, :4], low.sh)
    assert not np.any(both.sh[:5, 4:])
    np.testing.assert_array_equal(both[jnp.array([6, 0])].means, both.means[jnp.array([6, 0])])
    with pytest.raises(ValueError, match="must select an array"):
        both[0]
    with pytest.raises(ValueError, match="`parts` must hold at least one"):
        concatenate([])


def test_wrong_fields_are_refused():
    g = random_gaussians()
    with pytest.raises(ValueError, match="`sh` must have shape \\(12, k, 3\\) with k = 1, 4, 9"):
        Gaussians(g.means, g.factors, g.opacities, g.sh[:, :5], g.frames)
    with pytest.raises(ValueError, match=r"`opacities` must be in \[0, 1\], but is 1.5"):
        Gaussians(g.means, g.factors, g.opacities.at[2].set(1.5), g.sh, g.frames)


@pytest.mark.parametrize(
    ("scale", "rotation", "message"),
    [
        (0.0, np.eye(3), "`scale` must be positive"),
        (1.0, np.diag([1.0, 1, -1]), "`rotation` must be a rotation .* determinant is -1"),
        (1.0, 2 * np.eye(3), "`rotation` must be a rotation .* orthonormality is 3"),
    ],
)
def test_only_similarities_are_accepted(scale, rotation, message):
    with pytest.raises(ValueError, match=message):
        Similarity(floats(scale), floats(rotation), floats(np.zeros(3)))


def test_similarity_maps_points_and_gaussians_there_and_back():
    T, g = similarity(), random_gaussians()
    expected = 1.7 * np.asarray(g.means) @ np.asarray(T.rotation).T + np.asarray(T.translation)
    np.testing.assert_allclose(T.apply(g.means), expected, atol=20 * EPS)
    moved = g.transformed(T)
    A = np.asarray(T.rotation) @ np.asarray(g.covariances) @ np.asarray(T.rotation).T * 1.7**2
    np.testing.assert_allclose(moved.covariances, A, atol=20 * EPS)
    back = moved.transformed(T.inverse())
    for ours, theirs in zip(jax.tree.leaves(back), jax.tree.leaves(g), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=20 * EPS)


# Deformation


def test_deformation_carries_covariances_and_frames():
    g = random_gaussians()
    R, stretch = random_rotations(12), np.diag([2.0, 0.7, 1.1])
    V = random_rotations(12, seed=5)
    F = R @ V @ floats(stretch) @ jnp.swapaxes(V, 1, 2)
    moved = deform(g, g.means + 1, F)
    np.testing.assert_array_equal(moved.means, g.means + 1)
    A = np.asarray(F) @ np.asarray(g.covariances) @ np.swapaxes(F, 1, 2)
    np.testing.assert_allclose(moved.covariances, A, atol=20 * EPS)
    np.testing.assert_allclose(moved.frames, R, atol=100 * EPS)


def test_a_stretch_is_drawn_by_what_was_stretched():
    # Plastic or not: 2.01 is 2.01.
    g = random_gaussians()
    F = repeated(np.diag([2.01, 1, 1]))
    moved = deform(deform(g, g.means, F), g.means, repeated(np.eye(3)))
    widths = np.sqrt(np.asarray(moved.covariances)[:, 0, 0] / np.asarray(g.covariances)[:, 0, 0])
    np.testing.assert_allclose(widths, 2.01, rtol=20 * EPS)
    np.testing.assert_allclose(moved.frames, repeated(np.eye(3)), atol=20 * EPS)


def test_successive_deformations_compose():
    g, first, second = random_gaussians(), random_rotations(12), random_rotations(12, seed=8)
    twice = deform(deform(g, g.means, first), g.means, second)
    once = deform(g, g.means, second @ first)
    np.testing.assert_allclose(twice.factors, once.factors, atol=20 * EPS)
    np.testing.assert_allclose(twice.frames, once.frames, atol=100 * EPS)


def test_an_inverted_deformation_keeps_a_rotation():
    moved = deform(random_gaussians(), floats(np.zeros((12, 3))), repeated(np.diag([1, 1, -0.5])))
    np.testing.assert_allclose(np.linalg.det(moved.frames), 1, atol=100 * EPS)
    assert np.linalg.eigvalsh(np.asarray(moved.covariances)).min() > 0


def test_simulation_axes_and_world_axes_give_the_same_gaussians():
    g, T = random_gaussians(), similarity()
    rng = np.random.default_rng(6)
    F = floats(np.eye(3) + 0.3 * rng.normal(size=(12, 3, 3)))
    x = T.apply(g.means) + floats(0.1 * rng.normal(size=(12, 3)))
    in_world = deform(g, T.inverse().apply(x), T.pull_back(F))
    in_simulation = deform(g.transformed(T), x, F)
    expected = in_simulation.transformed(T.inverse())
    for ours, theirs in zip(jax.tree.leaves(in_world), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=200 * EPS)
    # A_world = Qᵀ A_sim Q / s², and the harmonics are evaluated at Qᵀ Rᵀ Q d.
    Q = np.asarray(T.rotation, dtype=np.float64)
    A = Q.T @ np.asarray(in_simulation.covariances) @ Q / 1.7**2
    np.testing.assert_allclose(in_world.covariances, A, atol=200 * EPS)
    U, _, Vt = np.linalg.svd(np.asarray(F, dtype=np.float64))
    R = U * np.array([1, 1, 1]) @ Vt
    proper = np.linalg.det(R) > 0
    assert proper.sum() > 6
    turned = np.swapaxes(in_world.frames, 1, 2)[proper]
    np.testing.assert_allclose(turned, (Q.T @ np.swapaxes(R, 1, 2) @ Q)[proper], atol=500 * EPS)


def test_turning_the_scene_is_turning_the_camera():
    g = random_gaussians(40)
    R = random_rotations(1, seed=9)[0]
    camera = Camera.look_at([0, 0, -5], [0, 0, 0], up=[0, -1, 0], focal=60, width=32, height=32)
    W = camera.world_to_camera
    turned_camera = Camera(W.at[:3, :3].set(W[:3, :3] @ R), 60, 60, 16, 16, 32, 32)
    rotated = deform(g, g.means @ R.T, repeated(R, 40))
    tolerance = {"atol": 2e-10 if EPS < 1e-10 else 5e-3}
    expected = render(g, turned_camera).rgb
    np.testing.assert_allclose(render(rotated, camera).rgb, expected, **tolerance)
    # The colours do depend on the direction, so that this says something.
    fixed = Gaussians(rotated.means, rotated.factors, rotated.opacities, rotated.sh, g.frames)
    assert np.abs(render(fixed, camera).rgb - expected).max() > 0.05


def test_shapes_of_a_deformation_are_checked():
    g = random_gaussians()
    with pytest.raises(ValueError, match="`x` and `F` must have shapes"):
        deform(g, g.means[:3], g.factors[:3])


def test_bound_stretch_bounds_and_counts():
    rng = np.random.default_rng(5)
    F = rng.normal(size=(40, 3, 3)) * np.exp(rng.normal(0, 2, (40, 1, 1)))
    F[0], F[1] = np.eye(3), np.diag([2.0, 1.0, 0.5])
    bounded, beyond = bound_stretch(floats(F), 2.0)
    bounded, beyond = np.asarray(bounded), np.asarray(beyond)
    sigma = np.linalg.svd(bounded)[1]
    assert sigma.max() < 2 + 1e-5
    assert sigma.min() > 0.5 - 1e-5
    assert not beyond[:2].any()
    assert beyond[2:].sum() > 30
    np.testing.assert_array_equal(bounded[~beyond], F[~beyond].astype(bounded.dtype))
    # Directions and orientation stay: the bounded F has the same singular vectors.
    U, _, Vt = np.linalg.svd(F[beyond])
    inner = np.swapaxes(U, 1, 2) @ bounded[beyond] @ np.swapaxes(Vt, 1, 2)
    off = inner - np.einsum("nii->ni", inner)[:, :, None] * np.eye(3)
    assert np.abs(off).max() < 1e5 * EPS
    np.testing.assert_array_equal(np.sign(np.linalg.det(bounded)), np.sign(np.linalg.det(F)))


def test_bound_stretch_refuses_to_flatten():
    with pytest.raises(ValueError, match="`largest` must be at least 1"):
        bound_stretch(jnp.eye(3)[None], 0.5)
