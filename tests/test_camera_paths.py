"""Paths of cameras through key frames, stacks of cameras."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import floats
from scipy.spatial.transform import Rotation

from pgjax.render import Camera, CameraPath, interpolate, stack_cameras
from pgjax.render.gaussians import rotation_of
from pgjax.render.paths import quaternion_of

DOUBLE = jax.config.jax_enable_x64
TIGHT = 1e-12 if DOUBLE else 5e-6
TIMES = [0.0, 0.7, 1.0, 2.5, 4.0]
SIZE = {"width": 64, "height": 48}
UP = (0.1, 0.0, 1.0)


def any_keys():
    """Poses of any kind, some of them half a turn apart, and other focal lengths."""
    rng = np.random.default_rng(0)
    turns = Rotation.random(5, rng=1).as_matrix()
    turns[1] = Rotation.from_rotvec([0, 3.1, 0]).as_matrix() @ turns[0]
    for R in turns:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R, rng.normal(size=3)
        fx, fy, cx, cy = rng.uniform([30, 30, 20, 20], [90, 90, 40, 30])
        yield Camera(floats(pose), fx, fy, cx, cy, 64, 48, rng.uniform(0.01, 0.1))


def level_keys():
    eyes = np.asarray([[3, 0, 1], [2, 2, 0.5], [0, 3, 2], [-3, 1, 0], [-1, -2, 3.0]])
    return [Camera.look_at(eye, [0, 0, 0.2], up=UP, fov_y=0.8, **SIZE) for eye in eyes]


PATHS = {
    "any": lambda: CameraPath(TIMES, list(any_keys())),
    "level": lambda: CameraPath(TIMES, level_keys(), up=UP),
    "two": lambda: CameraPath([1.0, 3.0], list(any_keys())[:2]),
}


def numbers(camera):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(camera)]


@pytest.mark.parametrize("make", PATHS.values(), ids=PATHS)
def test_a_path_goes_through_its_keys_and_rests_at_its_ends(make):
    path = make()
    times = np.asarray(path.times)
    for i, t in enumerate(times):
        key = jax.tree.map(lambda leaf, i=i: leaf[i], path.cameras)
        for found, expected in zip(numbers(path.at(t)), numbers(key), strict=True):
            np.testing.assert_allclose(found, expected, rtol=TIGHT, atol=TIGHT)
    for inside, outside in ((times[0], -10.0), (times[-1], 99.0)):
        for a, b in zip(numbers(path.at(inside)), numbers(path.at(outside)), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("make", PATHS.values(), ids=PATHS)
def test_a_path_has_no_jump_and_its_turns_are_rotations(make):
    path = make()
    t = jnp.linspace(-0.5, 4.5, 2001, dtype=jnp.zeros(()).dtype)
    cameras = jax.jit(jax.vmap(path.at))(t)
    R = np.asarray(cameras.world_to_camera[:, :3, :3], np.float64)
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max()
    assert error < TIGHT
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=TIGHT)
    assert np.all(np.asarray(cameras.fx) > 0)
    for leaf in jax.tree.leaves(cameras):
        rows = np.asarray(leaf, np.float64).reshape(len(t), -1)
        steps = np.abs(np.diff(rows, axis=0)).max()
        # Every other step: twice as far, if there is no jump.
        assert steps < 0.7 * np.abs(rows[2:] - rows[:-2]).max() + TIGHT


@pytest.mark.float64
@pytest.mark.parametrize("make", PATHS.values(), ids=PATHS)
def test_velocities_are_continuous(make):
    path = make()
    h = 1e-6

    def pose(t):
        return np.asarray(path.at(t).world_to_camera)

    for t in np.asarray(path.times):
        before, after = (pose(t) - pose(t - h)) / h, (pose(t + h) - pose(t)) / h
        np.testing.assert_allclose(before, after, atol=2e-4)


def test_two_rotations_are_joined_along_the_shortest_way():
    first, second = list(any_keys())[:2]
    path = CameraPath([0.0, 1.0], [first, second])
    a, b, middle = (
        Rotation.from_matrix(np.asarray(c.world_to_camera[:3, :3], np.float64))
        for c in (first, second, path.at(0.5))
    )
    whole = (b * a.inv()).magnitude()
    assert whole > 3
    np.testing.assert_allclose((middle * a.inv()).magnitude(), whole / 2, atol=1e-5)
    np.testing.assert_allclose((b * middle.inv()).magnitude(), whole / 2, atol=1e-5)


@pytest.mark.slow
def test_a_level_path_never_rolls():
    level, free = CameraPath(TIMES, level_keys(), up=UP), CameraPath(TIMES, level_keys())
    t = jnp.linspace(0, 4, 401, dtype=jnp.zeros(()).dtype)

    def roll(path):
        right = np.asarray(jax.jit(jax.vmap(path.at))(t).world_to_camera[:, 0, :3])
        return np.abs(right @ np.asarray(UP)).max()

    assert roll(level) < 10 * TIGHT
    # Without `up` the shortest turns roll on their way.
    assert roll(free) > 1e-2


def test_derivatives_are_finite_and_true():
    """With respect to time and keys, also where two keys are equal."""
    keys = level_keys()
    keys[2] = keys[1]
    stacked = stack_cameras(keys)

    def seen(t, shift):
        moved = stacked.world_to_camera.at[:, :3, 3].add(shift)
        keys = eqx.tree_at(lambda camera: camera.world_to_camera, stacked, moved)
        return CameraPath(TIMES, keys).at(t).project(floats([[0.3, 0.2, 0.1]]))[0].sum()

    zero = floats([0.0, 0, 0])
    for t in (0.3, 0.8, 1.7):
        slope, by_shift = jax.grad(seen, argnums=(0, 1))(floats(t), zero)
        assert np.all(np.isfinite(by_shift))
        h = 1e-6 if DOUBLE else 1e-2
        expected = (seen(floats(t + h), zero) - seen(floats(t - h), zero)) / (2 * h)
        np.testing.assert_allclose(slope, expected, rtol=1e-5 if DOUBLE else 5e-2, atol=1e-4)


def test_quaternions_of_rotations():
    turns = np.concatenate(
        [
            Rotation.random(50, rng=0).as_matrix(),
            Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix(),
            [np.eye(3)],
        ]
    )
    back = jax.vmap(lambda R: rotation_of(quaternion_of(R)))(floats(turns))
    np.testing.assert_allclose(back, turns, atol=TIGHT)


def test_a_curve_is_exact_for_a_straight_line_inside_and_flat_outside():
    times = [0.0, 1.0, 1.5, 3.0, 4.0]
    values = floats([[2 * t, 1 - t] for t in times])
    # Between inner keys a straight line stays one.
    np.testing.assert_allclose(interpolate(times, values, 2.0), [4, -1], rtol=1e-6)
    np.testing.assert_allclose(interpolate(times, values, 9.0), values[-1], rtol=1e-6)
    slope = jax.jacfwd(lambda t: interpolate(times, values, t))(floats(0.0))
    np.testing.assert_allclose(slope, [0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("times", "count", "options", "message"),
    [
        ([0.0], 1, {}, "`times` must be one number for each of at least two key frames"),
        ([0.0, 1.0], 3, {}, r"but has shape \(2,\) for 3"),
        ([0.0, 2.0, 1.0], 3, {}, "`times` must increase, but 2 is followed by 1"),
        ([0.0, 0.0], 2, {}, "`times` must increase, but 0 is followed by 0"),
        ([0.0, np.nan], 2, {}, "`times` must be finite"),
        ([0.0, 1.0], 2, {"up": [0, 0, 0]}, "`up` must not be zero"),
        ([0.0, 1.0], 2, {"up": [0, 0, 1]}, "`cameras` must not be rolled about `up`"),
    ],
)
def test_paths_that_make_no_sense_are_refused(times, count, options, message):
    with pytest.raises(ValueError, match=message):
        CameraPath(times, list(any_keys())[:count], **options)


def test_only_cameras_of_one_size_are_stacked():
    first = next(any_keys())
    other = dataclasses.replace(first, width=32)
    with pytest.raises(ValueError, match=r"one size \(width, height\), but has \(32, 48\), \(64"):
        stack_cameras([first, other])
    with pytest.raises(ValueError, match="at least one camera, but is empty"):
        stack_cameras([])
    stacked = stack_cameras([first, first])
    assert stacked.world_to_camera.shape == (2, 4, 4)
    assert (stacked.width, stacked.height) == (64, 48)
