"""The procedural ficus: a solid that hangs together, and a picture of a potted plant."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pgjax.render import Camera, deform, render
from pgjax.scenes.procedural import MODELS
from pgjax.scenes.procedural.bodies import join
from pgjax.scenes.procedural.ficus import _LEAF_S, _LEAVES, _STALK, _tree, _wood, ficus

SEEDS = (0, 1, 2)
PER_LEAF = len(_LEAF_S)
IN_LEAVES = _LEAVES * PER_LEAF


@pytest.fixture(scope="module", params=SEEDS)
def plant(request):
    return ficus(request.param)


@pytest.fixture(scope="module")
def view():
    return Camera.orbit(
        (0, 0, 0.5),
        up=(0, 0, 1),
        azimuth=-0.6,
        elevation=0.2,
        radius=2.2,
        width=96,
        height=96,
        fov_y=0.6,
    )


@pytest.fixture(scope="module")
def picture(view):
    return render(ficus(), view, background=(0.96, 0.96, 0.96))


def components(points, distance):
    tree = KDTree(points)
    return connected_components(tree.sparse_distance_matrix(tree, distance))[0]


def mean_color(image, camera, point, half=3):
    (u, v), _ = (np.asarray(a)[0] for a in camera.project(jnp.asarray([point], dtype=float)))
    rows, columns = (slice(int(c) - half, int(c) + half + 1) for c in (v, u))
    return np.asarray(image.rgb)[rows, columns].mean(axis=(0, 1))


def test_a_seed_decides_everything():
    first, again, other = MODELS["ficus"](3), ficus(3), ficus(4)
    assert all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True)
    )
    crowns = (np.asarray(g.means)[-IN_LEAVES:] for g in (first, other))
    assert np.abs(np.subtract(*crowns)).max() > 0.05


def test_gaussians_are_finite_and_have_volume(plant):
    assert 5000 <= len(plant) <= 10_000
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(plant))
    assert plant.means.dtype == jnp.zeros(()).dtype
    scales = np.sqrt(np.linalg.eigvalsh(np.asarray(plant.covariances, dtype=np.float64)))
    assert scales.min() > 5e-4
    assert scales.max() < 0.02
    opacities = np.asarray(plant.opacities)
    assert opacities.min() >= 0.9
    assert opacities.max() <= 1


def test_the_size_is_that_of_a_plant_one_metre_high(plant):
    means = np.asarray(plant.means)
    x, y, z = means.T
    assert z.max() == pytest.approx(1, abs=1e-6)
    assert 0 < z.min() < 0.01
    pot = means[z < 0.25]
    assert np.ptp(pot[:, :2], axis=0) == pytest.approx([0.335, 0.335], abs=0.03)
    assert pot[:, :2].mean(axis=0) == pytest.approx([0, 0], abs=0.01)
    crown = np.hypot(x, y)[z > 0.35]
    assert 0.25 < crown.max() < 0.55


def test_it_is_one_body_without_loose_particles(plant):
    means = np.asarray(plant.means, dtype=np.float64)
    nearest = KDTree(means).query(means, k=2)[0][:, 1]
    assert nearest.max() < 0.03
    assert components(means, 0.03) == 1
    occupied = np.zeros((40, 40, 40), dtype=bool)
    cells = np.floor(means / 0.04).astype(int) + np.array([20, 20, 5])
    occupied[tuple(cells.T)] = True
    assert ndimage.label(occupied, structure=np.ones((3, 3, 3)))[1] == 1


def test_the_solid_hangs_together_without_its_leaves(plant):
    solid = np.asarray(plant.means, dtype=np.float64)[:-IN_LEAVES]
    assert components(solid, 0.026) == 1


def test_leaves_hang_on_stalks_that_begin_at_a_branch(plant):
    means = np.asarray(plant.means, dtype=np.float64)
    leaves = means[-IN_LEAVES:].reshape(-1, PER_LEAF, 3)
    assert KDTree(means[:-IN_LEAVES]).query(leaves[:, 0])[0].max() < 0.02
    # The stalk and the first Gaussian of the blade.
    gaps = np.linalg.norm(np.diff(leaves[:, : _STALK + 1], axis=1), axis=-1)
    assert gaps.max() < 0.015
    assert max(components(leaf, 0.025) for leaf in leaves) == 1


def test_the_pot_is_filled(plant):
    rng = np.random.default_rng(0)
    means = np.asarray(plant.means, dtype=np.float64)
    radius, angle, z = rng.uniform([0, 0, 0.02], [1, 2 * math.pi, 0.22], (4000, 3)).T
    radius = np.sqrt(radius) * 0.11
    inside = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    assert KDTree(means).query(inside)[0].max() < 0.022


@pytest.mark.parametrize("seed", SEEDS)
def test_branches_are_filled_and_thick_enough_for_the_grid(seed):
    rng = np.random.default_rng(seed)
    branches = _tree(rng)
    assert min(branch.radii[:-1].min() for branch in branches) > 0.02
    points, tangents, radii = join(branches)
    # Places anywhere in the cross sections.
    offset = np.cross(tangents, rng.normal(size=(20, *points.shape)))
    offset *= rng.uniform(0, 1, (20, len(points), 1)) / np.linalg.norm(offset, axis=-1)[..., None]
    inside = (points + radii[:, None] * offset).reshape(-1, 3)
    wood = _wood(branches, rng)
    assert KDTree(wood.means).query(inside)[0].max() < 0.02


def test_the_picture_shows_a_green_crown_on_a_brown_pot(view, picture):
    rgb = np.asarray(picture.rgb)
    assert rgb[:4, :4] == pytest.approx(0.96, abs=1e-3)
    red, green, blue = mean_color(picture, view, (0, 0, 0.75))
    assert green > 1.3 * red
    assert green > 1.5 * blue
    red, green, blue = mean_color(picture, view, (0, 0, 0.12))
    assert red > 1.4 * green > 1.4 * blue
    # The wall of the pot has no holes.
    (u, v), _ = (np.asarray(a)[0] for a in view.project(jnp.asarray([[0, 0, 0.12]])))
    wall = np.asarray(picture.alpha)[int(v) - 5 : int(v) + 6, int(u) - 7 : int(u) + 8]
    assert wall.min() > 0.98


def test_a_shear_of_the_crown_bends_the_picture(view, picture):
    plant = ficus()
    x = plant.means
    # A shear that grows with the height above the pot.
    height = jnp.maximum(x[:, 2] - 0.28, 0)
    F = jnp.tile(jnp.eye(3, dtype=x.dtype), (len(plant), 1, 1)).at[:, 0, 2].set(1.2 * height)
    bent = deform(plant, x.at[:, 0].add(0.6 * height * height), F)
    before, after = (np.asarray(image.alpha) for image in (picture, render(bent, view)))
    assert after.sum() == pytest.approx(before.sum(), rel=0.1)
    assert np.abs(after - before).max() > 0.9
    below = slice(round(view.height * 0.75), None)
    np.testing.assert_allclose(after[below], before[below], atol=1e-6)
