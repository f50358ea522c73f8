"""Signed distances sampled from meshes and from points, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pgjax import boundary, sampling
from pgjax.boundary.shapes import normal

pytestmark = pytest.mark.float64


def ball_mesh(radius=0.5, n=3000, center=(0.1, 0.2, 0.3)):
    """A convex mesh with its vertices on a sphere, faces seen counter-clockwise from outside."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    points = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=-1)
    faces = ConvexHull(points).simplices.astype(np.int64)
    a, b, c = (points[faces[:, i]] for i in range(3))
    inwards = np.sum(np.cross(b - a, c - a) * (a + b + c), axis=1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return radius * points + np.array(center), faces


def cube_mesh(size=1.0):
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) * size
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])
    return vertices, faces


def at(shape, x):
    return np.asarray(jax.vmap(shape.signed_distance)(jnp.asarray(x)))


def test_mesh_of_a_ball():
    shape = boundary.sample_mesh(ball_mesh(), spacing=0.05)
    x = np.random.default_rng(0).uniform(-0.6, 0.9, (500, 3))
    exact = np.linalg.norm(x - [0.1, 0.2, 0.3], axis=1) - 0.5
    near = abs(exact) < 0.15
    assert abs(at(shape, x) - exact)[near].max() < 2e-3
    assert abs(at(shape, x) - exact)[exact < 0].max() < 0.02  # the centre has a kink
    n = np.asarray(jax.vmap(lambda x: normal(shape, x))(jnp.asarray(x[near])))
    outward = (x - [0.1, 0.2, 0.3]) / np.linalg.norm(x - [0.1, 0.2, 0.3], axis=1)[:, None]
    assert np.sum(n * outward[near], axis=1).min() > np.cos(np.radians(4))


def test_mesh_of_a_cube_in_a_file(tmp_path):
    """Faces are placed exactly, edges rounded over about a spacing; `scale` is applied."""
    vertices, faces = cube_mesh(1000.0)
    lines = [f"v {v[0]} {v[1]} {v[2]}" for v in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    path = tmp_path / "cube.obj"
    path.write_text("\n".join(lines) + "\n")
    shape = boundary.sample_mesh(path, spacing=0.05, scale=1e-3)
    exact = boundary.Cuboid((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    rng = np.random.default_rng(1)
    x = rng.uniform(0.3, 0.7, (300, 3))
    x[:, 0] = rng.uniform(-0.1, 0.08, 300)  # near the middle of one face
    assert abs(at(shape, x) - at(exact, x)).max() < 1e-9
    x = rng.uniform(-0.15, 1.15, (500, 3))
    assert abs(at(shape, x) - at(exact, x)).max() < 0.03


def test_points_of_a_solid_block():
    """The closing puts the surface `thickness` outside the outermost points."""
    x, _ = sampling.block((0, 0, 0), (1.0, 0.6, 0.4), 0.05)
    shape = boundary.sample_points(x, spacing=0.05, radius=0.1, thickness=0.025)
    # The outermost particles are half a distance inside: their cells fill the block.
    exact = boundary.Cuboid((0.5, 0.3, 0.2), (0.5, 0.3, 0.2))
    rng = np.random.default_rng(2)
    q = rng.uniform([0.2, 0.2, 0.1], [0.8, 0.4, 0.5], (300, 3))
    distance = at(exact, q)
    near = abs(distance) < 0.07
    assert near.sum() > 30
    assert abs(at(shape, q) - distance)[near].max() < 0.012


def test_points_of_a_sheet_become_a_wall():
    """Random points of a plane: gaps closed, both faces `thickness` away, no hole."""
    rng = np.random.default_rng(3)
    x = np.column_stack([rng.uniform(0, 1, (4000, 2)), np.zeros(4000)])
    shape = boundary.sample_points(x, spacing=0.04, radius=0.08, thickness=0.04)
    q = np.column_stack([rng.uniform(0.2, 0.8, (300, 2)), rng.uniform(-0.1, 0.1, 300)])
    exact = abs(q[:, 2]) - 0.04
    near = abs(exact) < 0.025
    assert abs(at(shape, q) - exact)[near].max() < 0.012
    middle = q * [1, 1, 0]
    assert at(shape, middle).max() < -0.02


def test_a_ball_rests_on_a_sampled_floor(measure):
    """A drop comes to rest on the sampled mesh where it does on the half-space."""
    import pgjax
    from pgjax import models

    x, volumes = sampling.ball((0.5, 0.5, 0.42), 0.15, 0.05)
    grid = pgjax.Grid((0, 0, 0), (10, 10, 10), 0.1)
    vertices, faces = cube_mesh()
    slab = vertices * [2.0, 2.0, 0.4] + [-0.5, -0.5, -0.15]
    rests = []
    for shape in (
        boundary.HalfSpace((0, 0, 0.25), (0, 0, 1)),
        boundary.sample_mesh((slab, faces), spacing=0.05),
    ):
        floor = boundary.Collider(shape, boundary.Separating(0.5))
        material = models.Material(models.NeoHookean(3e4, 0.3), density=1000.0)
        options = {"gravity": (0, 0, -9.81), "boundaries": [floor], "grid_damping": 10.0}
        scene = pgjax.Scene(grid, material, volumes, **options)
        state = pgjax.initial_state(scene, x)
        dt = pgjax.stable_dt(scene, state, frame=0.6)
        end = pgjax.simulate(scene, state, dt=dt, frames=1, substeps=round(0.6 / dt))
        rests.append(np.asarray(end.final.x))
    gap = np.abs(rests[1] - rests[0]).max()
    assert rests[0][:, 2].min() > 0.2
    measure("colliders", "sampled floor against half-space, m", gap, below=1e-6)


def test_faces_may_all_point_inwards():
    vertices, faces = cube_mesh()
    x = np.random.default_rng(4).uniform(-0.2, 1.2, (100, 3))
    both = [boundary.sample_mesh((vertices, f), spacing=0.1) for f in (faces, faces[:, ::-1])]
    np.testing.assert_allclose(at(both[0], x), at(both[1], x), atol=1e-12)


BAD_MESHES = {
    r"vertices \(n, 3\)": (np.zeros((3, 2)), [[0, 1, 2]]),
    "must refer to vertices 0 to 2": (np.zeros((3, 3)), [[0, 1, 7]]),
    "must hold finite vertices, but 3": (np.full((3, 3), np.nan), [[0, 1, 2]]),
    "must enclose at least one node": (np.eye(3), [[0, 1, 2]]),
}


@pytest.mark.parametrize("words", BAD_MESHES)
def test_bad_meshes_are_refused(words):
    with pytest.raises(ValueError, match=words):
        boundary.sample_mesh(BAD_MESHES[words], spacing=0.1)


def test_bad_spacings_of_a_mesh_are_refused():
    for spacing, words in ((0.0, "`spacing` must be positive"), (1e-4, "`spacing` must be about")):
        with pytest.raises(ValueError, match=words):
            boundary.sample_mesh(cube_mesh(), spacing=spacing)


def test_bad_turns_of_a_mesh_are_refused():
    for turn, words in ((0.5, r"`turn` must have shape \(3,\)"), ((0, 0, np.nan), "be finite")):
        with pytest.raises(ValueError, match=words):
            boundary.sample_mesh(cube_mesh(), spacing=0.1, turn=turn)


BAD_POINTS = {
    "n ≥ 1": (np.zeros((0, 3)), 0.1, None),
    "`points` must be finite": (np.full((2, 3), np.inf), 0.1, None),
    "`radius` must be at least `spacing`": (np.zeros((1, 3)), 0.05, None),
    "`thickness` must be in": (np.zeros((1, 3)), 0.2, 0.3),
}


@pytest.mark.parametrize("words", BAD_POINTS)
def test_bad_points_are_refused(words):
    points, radius, thickness = BAD_POINTS[words]
    with pytest.raises(ValueError, match=words):
        boundary.sample_points(points, spacing=0.1, radius=radius, thickness=thickness)


def test_missing_and_broken_files_are_named(tmp_path):
    broken = tmp_path / "broken.obj"
    broken.write_text("hello\n")
    for path in (broken, tmp_path / "none.obj"):
        with pytest.raises(ValueError, match=path.stem):
            boundary.sample_mesh(path, spacing=0.1)
