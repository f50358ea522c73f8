"""Particles of a spacing of their own, and the Gaussians that they carry."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene_files import CAMERA, GRID, JELLY, MODEL, TWO_MATERIALS, ball, planned

from pgjax.inverse import Pictures
from pgjax.inverse.pictures import SMOOTH
from pgjax.render import load_ply, render, save_ply
from pgjax.scenes import SceneError, run
from pgjax.scenes.carriage import Carriage
from pgjax.scenes.record import fingerprint
from pgjax.scenes.run import carried, states

FINER = GRID.replace("spacing = 0.1", "spacing = 0.1\nparticle_spacing = {}")


def spaced(spacing):
    """The grid with particles of a spacing, m; its own is 0.1 m."""
    return FINER.format(spacing if isinstance(spacing, str) else 10 * spacing)


def between(points, particles, *, reach=1.0):
    kinds = np.zeros(len(points), int), np.zeros(len(particles), int)
    return Carriage.between(np.asarray(points), np.asarray(particles), kinds, reach)


def lattice(n=5):
    axis = np.arange(n, dtype=float)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def test_affine_motions_are_exact():
    rng = np.random.default_rng(0)
    particles, points = lattice(), rng.uniform(-0.5, 4.5, (50, 3))
    A, b = np.eye(3) + 0.5 * rng.normal(size=(3, 3)), rng.normal(size=3)
    x, F = between(points, particles)(
        jnp.asarray(particles @ A.T + b), jnp.broadcast_to(jnp.asarray(A), (len(particles), 3, 3))
    )
    tolerance = 1e-5 if x.dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(x, points @ A.T + b, atol=10 * tolerance)
    np.testing.assert_allclose(F, np.broadcast_to(A, F.shape), atol=tolerance)


def test_a_smooth_motion_is_of_second_order():
    """Halved, the spacing leaves a quarter of the error, of F half."""
    points = np.random.default_rng(1).uniform(1, 2, (200, 3))
    errors = []
    for n in (7, 13):
        particles = lattice(n) * (3 / (n - 1))

        def motion(x):
            return x + 0.1 * jnp.sin(2 * x[jnp.array([1, 2, 0])])

        x = jax.vmap(motion)(jnp.asarray(particles))
        F = jax.vmap(jax.jacfwd(motion))(jnp.asarray(particles))
        got, G = between(points, particles)(x, F)
        exact = jax.vmap(motion)(jnp.asarray(points))
        slopes = jax.vmap(jax.jacfwd(motion))(jnp.asarray(points))
        errors.append([float(jnp.abs(got - exact).max()), float(jnp.abs(G - slopes).max())])
    (coarse, coarse_F), (fine, fine_F) = errors
    assert fine < 0.35 * coarse < 0.01
    assert fine_F < 0.65 * coarse_F


def test_at_the_place_of_a_particle_it_moves_as_that_does():
    rng = np.random.default_rng(2)
    particles = rng.normal(size=(40, 3))
    x, F = (jnp.asarray(rng.normal(size=s)) for s in ((40, 3), (40, 3, 3)))
    got, G = between(particles, particles)(x, F)
    np.testing.assert_array_equal(got, x)
    np.testing.assert_array_equal(G, F)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_particles(count):
    """There may be fewer than there are parents."""
    particles = np.random.default_rng(3).normal(size=(count, 3))
    points = particles.mean(axis=0) + np.array([[0.1, 0, 0], [0, 3.0, 0]])
    x, _ = between(points, particles)(
        jnp.asarray(particles) + 1.0, jnp.broadcast_to(jnp.eye(3), (count, 3, 3))
    )
    np.testing.assert_allclose(x, points + 1, atol=1e-5)


def test_a_tear_stretches_nothing():
    """The halves of a block are drawn apart: each Gaussian goes with one of them, undeformed."""
    particles = lattice(6)
    points = np.random.default_rng(4).uniform(0.5, 4.5, (300, 3))
    right = particles[:, 0] > 2.5
    apart = jnp.asarray(np.where(right, 4.0, 0.0)[:, None] * np.array([[1.0, 0, 0]]))
    eye = jnp.broadcast_to(jnp.eye(3), (len(particles), 3, 3))
    x, F = between(points, particles)(jnp.asarray(particles) + apart, eye)
    moved = np.asarray(x)[:, 0] - points[:, 0]
    np.testing.assert_allclose(np.minimum(np.abs(moved), np.abs(moved - 4)), 0, atol=1e-5)
    # With the side that it was nearer to.
    np.testing.assert_array_equal(moved > 2, points[:, 0] > 2.5)
    np.testing.assert_allclose(F, np.broadcast_to(np.eye(3), F.shape), atol=1e-6)


def test_a_lost_particle_takes_no_other_gaussian_with_it():
    particles = lattice()
    points = particles + np.array([0.2, 0.1, 0.0])
    x = jnp.asarray(particles).at[62].set(jnp.nan)
    got, _ = between(points, particles)(x, jnp.broadcast_to(jnp.eye(3), (125, 3, 3)))
    lost = np.flatnonzero(~np.isfinite(np.asarray(got)).all(axis=1))
    np.testing.assert_array_equal(lost, [62])


@pytest.mark.float64
def test_derivative():
    rng = np.random.default_rng(5)
    particles, points = lattice(4), rng.uniform(0, 3, (20, 3))
    carriage = between(points, particles)
    x = jnp.asarray(particles + 0.2 * rng.normal(size=particles.shape))
    F = jnp.asarray(np.eye(3) + 0.2 * rng.normal(size=(64, 3, 3)))
    a, b = jnp.asarray(rng.normal(size=(20, 3))), jnp.asarray(rng.normal(size=(20, 3, 3)))

    def total(x, F):
        moved, G = carriage(x, F)
        return jnp.sum(a * moved) + jnp.sum(b * G)

    dx, dF = jnp.asarray(rng.normal(size=x.shape)), jnp.asarray(rng.normal(size=F.shape))
    slope = sum(
        jnp.vdot(g, d) for g, d in zip(jax.grad(total, (0, 1))(x, F), (dx, dF), strict=True)
    )
    e = 1e-6
    difference = (total(x + e * dx, F + e * dF) - total(x - e * dx, F - e * dF)) / (2 * e)
    np.testing.assert_allclose(slope, difference, rtol=1e-7)


@pytest.mark.parametrize("spacing", [0.1, 0.05, 0.02])
def test_volumes_masses_and_centres_are_kept(tmp_path, spacing):
    own = planned(tmp_path, MODEL, GRID, TWO_MATERIALS)
    p = planned(tmp_path, MODEL, spaced(spacing), TWO_MATERIALS)
    assert p.moving.means.shape == own.moving.means.shape
    assert len(p.body) == p.scene.particle_count == sum(p.scene.counts)
    for part, before in zip(p.scene.slices, own.scene.slices, strict=True):
        m, x = np.asarray(p.scene.masses)[part], np.asarray(p.state.x)[part]
        n, y = np.asarray(own.scene.masses)[before], np.asarray(own.state.x)[before]
        np.testing.assert_allclose(m.sum(), n.sum(), rtol=1e-5)
        np.testing.assert_allclose(m @ x / m.sum(), n @ y / n.sum(), atol=1e-6)
    # No two particles of a material in a cell, and none far larger than one.
    for part in p.scene.slices:
        cells = np.floor((np.asarray(p.state.x)[part] + [0.5, 0.5, 0.2]) / spacing + 1e-6)
        assert len(np.unique(cells, axis=0)) == len(cells)
    assert p.notes[-1] == (
        f"particles: 200 Gaussians are carried by {p.scene.particle_count} particles of "
        f"{spacing:g} m"
    )


def test_by_default_each_gaussian_is_a_particle(tmp_path):
    p = planned(tmp_path, MODEL, GRID, JELLY)
    assert p.carriage is None
    moved, _ = carried(p, p.state.x, p.state.F)
    np.testing.assert_array_equal(moved.means, p.state.x)


FLYING = MODEL + "velocity = [0.5, 0, 1]\nangular_velocity = [0, 0, 90]"


def test_a_body_that_flies_carries_its_gaussians(tmp_path):
    """A rigid motion is one of the Gaussians, too."""
    p = planned(tmp_path, FLYING, spaced(0.08), JELLY)
    X = np.asarray(p.moving.means, np.float64)
    start, _ = carried(p, p.state.x, p.state.F)
    np.testing.assert_allclose(start.means, X, atol=1e-6)
    *_, (_, end) = states(dataclasses.replace(p, frames=2), p.state, 0)
    moved, _ = carried(p, end.x, end.F)
    t, v = 2 / 25, np.asarray(p.scene.volumes)
    center = v @ np.asarray(p.state.x, np.float64) / v.sum()
    turn = np.array(
        [[np.cos(a := t * np.pi / 2), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]]
    )
    expected = center + (X - center) @ turn.T + t * np.array([0.5, 0, 1])
    np.testing.assert_allclose(moved.means, expected, atol=1e-3)


def test_conditions_take_particles_by_their_place(tmp_path):
    """A ball that is held below: what is there stays, and so do its Gaussians."""
    held = """
[forces]
gravity = [2, 0, 0]
[[particles]]
type = "hold"
region = { lower = [-1, -1, -1], upper = [1, 1, 0.2] }
"""
    p = planned(tmp_path, MODEL, spaced(0.06), held, JELLY)
    *_, (_, end) = states(p, p.state, 0)
    low = np.asarray(p.state.x)[:, 2] <= 0.2
    np.testing.assert_allclose(end.x[low], p.state.x[low], atol=1e-5)
    moved, _ = carried(p, end.x, end.F)
    X = np.asarray(p.moving.means)
    shift = np.abs(np.asarray(moved.means) - X).max(axis=1)
    assert shift[X[:, 2] < 0.05].max() < 1e-4
    assert shift[X[:, 2] > 0.4].min() > 5e-3


def test_labels_and_values_are_of_the_nearest_gaussian(tmp_path):
    """Values per Gaussian go on to the particles; a particle of one colour keeps it."""
    save_ply(tmp_path / "ball.ply", ball())
    own = planned(tmp_path, MODEL, GRID, JELLY)
    E = np.where(np.asarray(own.state.x)[:, 0] > 0, 1e5, 1e4)
    np.save(tmp_path / "E.npy", E)
    jelly = JELLY.replace("2e4", '{ file = "E.npy" }')
    p = planned(tmp_path, MODEL, spaced(0.05), jelly)
    found = np.asarray(p.scene.materials[0].elasticity.E)
    x = np.asarray(p.state.x)[:, 0]
    assert set(found) == {1e4, 1e5}
    assert np.all(found[x > 0.06] == 1e5)
    assert np.all(found[x < -0.06] == 1e4)


def test_two_models_are_not_merged(tmp_path):
    save_ply(tmp_path / "ball.ply", ball())
    two = "\n".join(
        f'[[model]]\nname = "{name}"\nply = "ball.ply"\nsize = 0.4\nvelocity = [{v}, 0, 0]'
        for name, v in (("a", 1), ("b", -1))
    )
    p = planned(tmp_path, two, spaced(0.1), JELLY)
    v = np.asarray(p.state.v)[:, 0]
    np.testing.assert_array_equal(v, np.where(p.body == 0, 1, -1))
    # The Gaussians of both lie at the same places; each has parents of its own.
    parents = np.asarray(p.carriage.parents)
    of = np.repeat([0, 1], len(p.moving) // 2)
    weights = np.asarray(p.carriage.weights)
    assert np.all((p.body[parents] == of[:, None]) | (weights == 0))


@pytest.mark.parametrize(
    ("spacing", "words"),
    [
        ("1.5", "`particle_spacing` must be at most 1 spacing of the grid, but is 1.5"),
        ("0", "`particle_spacing` must be a finite number above 0"),
        ("1e-3", "must not cut the Gaussians into more than"),
    ],
)
def test_errors(tmp_path, spacing, words):
    with pytest.raises(SceneError) as caught:
        planned(tmp_path, MODEL, spaced(spacing), JELLY)
    assert words in str(caught.value)
    assert "[grid]" in str(caught.value)


def test_a_run_writes_and_resumes(tmp_path):
    """All files of a run with few particles, and the same after a stop."""
    save_ply(tmp_path / "ball.ply", ball())
    p = planned(tmp_path, MODEL, spaced(0.09), JELLY, CAMERA, frames=2)
    extras = {"ply_frames": True, "trajectory_frames": True}
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run(p, whole, **extras)

    def stop(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(p, parts, **extras, progress=stop)
    run(p, parts, **extras, resume=True)
    for name in ("last.png", "ply/00002.ply", "trajectory/00002.npz"):
        assert (whole / name).read_bytes() == (parts / name).read_bytes()
    assert len(load_ply(whole / "ply" / "00002.ply")) == 200
    with np.load(whole / "trajectory" / "00002.npz") as stored:
        assert stored["x"].shape == (p.scene.particle_count, 3)


def test_a_scene_is_resumed_with_its_own_particles_only(tmp_path):
    own = planned(tmp_path, MODEL, GRID, JELLY)
    other = planned(tmp_path, MODEL, spaced(0.09), JELLY)
    assert "carriage" not in fingerprint(own)
    assert "carriage" in fingerprint(other)


def test_pictures_of_what_is_carried(tmp_path):
    """Identification from pictures sees the Gaussians where the particles carry them."""
    p = planned(tmp_path, FLYING, spaced(0.09), JELLY, CAMERA)
    x = p.state.x + jnp.asarray([0.1, 0, 0], p.state.x.dtype)[None]
    state = dataclasses.replace(p.state, position=x - p.state.origin[None])
    camera, blank = p.camera(0), np.zeros((1, 48, 64, 3))
    seen = Pictures(p.moving, camera, blank, carry=p.carriage).see(state)
    there = dataclasses.replace(p.moving, means=p.moving.means + jnp.asarray([[0.1, 0, 0]]))
    np.testing.assert_allclose(seen, render(there, camera, rule=SMOOTH).rgb, atol=2e-3)
