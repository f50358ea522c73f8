"""Cameras: OpenCV axes, orbits and what they refuse."""

import jax.numpy as jnp
import numpy as np
import pytest

from pgjax.render import Camera

SIZE = {"width": 64, "height": 48}


def floats(array):
    return jnp.asarray(array, dtype=jnp.zeros(()).dtype)


def test_look_at_centres_the_target_with_opencv_axes():
    camera = Camera.look_at([1, 2, 3], [1, 2, 7], up=[0, -1, 0], focal=50, **SIZE)
    # Looking along z with y down the camera axes are the world axes.
    np.testing.assert_allclose(camera.world_to_camera[:3, :3], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(camera.position, [1, 2, 3], atol=1e-5)
    points = floats([[1, 2, 7], [3, 2, 7], [1, 3, 8]])
    pixels, depths = camera.project(points)
    np.testing.assert_allclose(pixels, [[32, 24], [32 + 25, 24], [32, 24 + 10]], rtol=1e-5)
    np.testing.assert_allclose(depths, [4, 4, 5], rtol=1e-6)


def test_the_vertical_opening_angle_spans_the_height():
    camera = Camera.look_at([0, 0, 0], [0, 0, 1], up=[0, -1, 0], fov_y=np.pi / 2, **SIZE)
    np.testing.assert_allclose(camera.fy, 24, rtol=1e-6)
    pixels, _ = camera.project(floats([[0, -2, 2.0], [0, 2, 2]]))
    np.testing.assert_allclose(pixels[:, 1], [0, 48], atol=1e-4)


def test_orbit_turns_by_the_right_hand_rule_and_rises_with_elevation():
    def orbit(azimuth, elevation=0.0, up=(0, 0, 1)):
        view = {"azimuth": azimuth, "elevation": elevation, "radius": 2, "focal": 50}
        return Camera.orbit([1, 1, 1], up=up, **view, **SIZE)

    np.testing.assert_allclose(orbit(0.0).position, [3, 1, 1], atol=1e-6)
    np.testing.assert_allclose(orbit(np.pi / 2).position, [1, 3, 1], atol=1e-6)
    np.testing.assert_allclose(orbit(0.0, np.pi / 6).position, [1 + np.sqrt(3), 1, 2], atol=1e-6)
    np.testing.assert_allclose(orbit(0.0, up=(1, 0, 0)).position, [1, 3, 1], atol=1e-6)
    pixels, depths = orbit(0.3, 0.4).project(floats([[1, 1, 1], [1, 1, 2]]))
    np.testing.assert_allclose(pixels[0], [32, 24], atol=1e-4)
    np.testing.assert_allclose(depths[0], 2, rtol=1e-6)
    # What is higher in the world is higher in the image.
    assert pixels[1, 1] < 23


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": [0, 0, 0]}, "`target` must differ from `eye`"),
        ({"up": [0, 0, 2]}, "`up` must not be zero or along the view"),
        ({"up": [0, 0, 0]}, "`up` must not be zero or along the view"),
        ({"eye": [0, np.nan, 0]}, "`eye` must be finite"),
        ({"eye": [0, 0]}, "`eye` must be three numbers"),
        ({"focal": None}, "Exactly one of the arguments `fov_y` and `focal`"),
        ({"fov_y": 1.0}, "Exactly one of the arguments `fov_y` and `focal`"),
        ({"focal": None, "fov_y": 90}, "`fov_y` must be between 0 and π"),
        ({"focal": -1.0}, "`fx` must be positive"),
        ({"width": 0}, "`width` must be at least 1"),
    ],
)
def test_views_that_make_no_sense_are_refused(change, message):
    view = {"eye": [0, 0, 0], "target": [0, 0, 1], "up": [0, -1, 0], "focal": 50, **SIZE, **change}
    with pytest.raises(ValueError, match=message):
        Camera.look_at(view.pop("eye"), view.pop("target"), **view)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": 0}, "`radius` must be positive"),
        ({"elevation": 1.6}, "`elevation` must be inside"),
        ({"up": [0, 0, 0]}, "`up` must not be zero"),
    ],
)
def test_orbits_that_make_no_sense_are_refused(change, message):
    view = {"up": [0, 0, 1], "azimuth": 0, "elevation": 0, "radius": 1, "focal": 50} | change
    with pytest.raises(ValueError, match=message):
        Camera.orbit([0, 0, 0], **view, **SIZE)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, 1, -1, 1]), r"`world_to_camera\[:3, :3\]` must be a rotation"),
        (np.eye(4) + np.eye(4)[[3]].T @ np.eye(4)[[0]], "must end with the row"),
        (np.full((4, 4), np.nan), "`world_to_camera` must be finite"),
    ],
)
def test_only_rigid_maps_are_cameras(matrix, message):
    with pytest.raises(ValueError, match=message):
        Camera(floats(matrix), 50, 50, 32, 24, 64, 48)
