"""Key frames of a camera in a scene file."""

import dataclasses
import json
import math
import re
import sys

import jax
import numpy as np
import pytest
from scene_files import GRID, JELLY, ball, planned, write

from pgjax.render import Camera, concatenate, load_cameras, render, save_ply
from pgjax.scenes import SceneError, read_scene, run
from pgjax.scenes.run import _Painter
from pgjax.scenes.views import seen_from

DOUBLE = jax.config.jax_enable_x64
TIGHT = 1e-9 if DOUBLE else 2e-5
# The upper part of the ball moves, the rest stands still.
MODEL = """
[model]
ply = "ball.ply"
region = { lower = [-9, -9, -9], upper = [9, 0.1, 9] }
size = 0.4
"""
SIZE = "width = 64\nheight = 48"
# Frames 5, 15 and 30 of 25 a second.
ORBITS = f"""
[camera]
{SIZE}
radius = 1.2
[[camera.keyframes]]
time = 0.2
azimuth = 20
[[camera.keyframes]]
time = 0.6
azimuth = 200
elevation = 80
radius = 1.5
fov = 30
[[camera.keyframes]]
time = 1.2
azimuth = 400
elevation = -20
target = [0.1, 0, 0.3]
"""
LOOKS = f"""
[camera]
{SIZE}
target = [0, 0, 0.2]
[[camera.keyframes]]
time = 0.2
eye = [1, 0, 0.3]
[[camera.keyframes]]
time = 0.6
eye = [0, 1.5, 1]
fov = 60
[[camera.keyframes]]
time = 1.2
target = [0.1, 0.1, 0.1]
"""


def planned_path(folder, text):
    return planned(folder, MODEL, GRID, JELLY, text)


def assert_cameras(found, expected, tight=TIGHT):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=tight, atol=tight)
    assert (found.width, found.height) == (expected.width, expected.height)


def orbit(azimuth, elevation, radius, fov, target):
    return Camera.orbit(
        target,
        up=(0, 0, 1),
        azimuth=math.radians(azimuth),
        elevation=math.radians(elevation),
        radius=radius,
        fov_y=math.radians(fov),
        width=64,
        height=48,
    )


def test_orbits_are_those_of_the_keys(tmp_path):
    p = planned_path(tmp_path, ORBITS)
    middle = (0.0, 0.0, 0.16)
    # What is left out stays as before.
    keys = {
        5: (20, 12, 1.2, 40, middle),
        15: (200, 80, 1.5, 30, middle),
        30: (400, -20, 1.5, 30, (0.1, 0, 0.3)),
    }
    for frame, key in keys.items():
        assert_cameras(p.camera(frame), orbit(*key))
    assert_cameras(p.camera(0), p.camera(5), tight=1e-15)
    assert_cameras(p.camera(99), p.camera(30), tight=1e-15)


def test_looks_are_those_of_the_keys(tmp_path):
    p = planned_path(tmp_path, LOOKS)
    keys = {
        5: ((1, 0, 0.3), (0, 0, 0.2), 40),
        15: ((0, 1.5, 1), (0, 0, 0.2), 60),
        30: ((0, 1.5, 1), (0.1, 0.1, 0.1), 60),
    }
    for frame, (eye, target, fov) in keys.items():
        view = {"fov_y": math.radians(fov), "width": 64, "height": 48}
        assert_cameras(p.camera(frame), Camera.look_at(eye, target, up=(0, 0, 1), **view))
    assert_cameras(p.camera(99), p.camera(30), tight=1e-15)


@pytest.mark.parametrize("text", [ORBITS, LOOKS])
def test_paths_are_smooth_and_never_roll(tmp_path, text):
    p = planned_path(tmp_path, text)
    times = np.linspace(0, 1.4, 141)
    cameras = [p.view.view.at(float(t), p.to_simulation) for t in times]
    poses = np.stack([np.asarray(c.world_to_camera, np.float64) for c in cameras])
    np.testing.assert_allclose(poses[:, 0, 2], 0, atol=TIGHT)
    # The image of the vertical points up.
    assert np.all(poses[:, 1, 2] < 0)
    focal = np.asarray([float(c.fy) for c in cameras])
    for rows in (poses.reshape(len(times), -1), focal[:, None]):
        once = np.abs(np.diff(rows, axis=0)).max()
        assert once < 0.7 * np.abs(rows[2:] - rows[:-2]).max() + TIGHT


def shots(folder):
    base = {"fx": 130.0, "fy": 120.0, "width": 90, "height": 70}
    entries = []
    for i, angle in enumerate((0.0, 1.0, 2.5)):
        R = np.asarray(
            [
                [math.cos(angle), 0, math.sin(angle)],
                [0, 1, 0],
                [-math.sin(angle), 0, math.cos(angle)],
            ]
        )
        position = (-2 * R[:, 2]).tolist()
        entries.append(base | {"img_name": f"s{i}", "rotation": R.tolist(), "position": position})
    (folder / "cameras.json").write_text(json.dumps(entries))


SHOTS = """
[camera]
file = "cameras.json"
width = 45
[[camera.keyframes]]
time = 0.2
name = "s2"
[[camera.keyframes]]
time = 0.6
index = 1
[[camera.keyframes]]
time = 1.2
"""


def test_shots_are_those_of_the_capture(tmp_path):
    shots(tmp_path)
    p = planned_path(tmp_path, SHOTS)
    given = list(load_cameras(tmp_path / "cameras.json").values())
    for frame, shot in ((5, 2), (15, 1), (30, 0)):
        expected = seen_from(given[shot], p.to_simulation)
        found = p.camera(frame)
        assert (found.width, found.height) == (45, 35)
        np.testing.assert_allclose(
            found.world_to_camera, expected.world_to_camera, rtol=TIGHT, atol=TIGHT
        )
        np.testing.assert_allclose(found.fx, expected.fx / 2, rtol=TIGHT)


FIRST, SECOND = "[[camera.keyframes]]\ntime = 0\n", "[[camera.keyframes]]\ntime = 1\n"
KEY = "scene.toml [camera] [[keyframes]] "
FAULTS = [
    (FIRST, "scene.toml [camera]: `keyframes` must hold at least two key frames"),
    ("keyframes = []", "`keyframes` must hold at least two key frames"),
    ("keyframes = 1", "`keyframes` must be written as [[keyframes]] tables"),
    (SECOND + FIRST, KEY + "2: `time` must be after that of the key frame before, 1 s"),
    (FIRST + FIRST, KEY + "2: `time` must be after that of the key frame before, 0 s"),
    (FIRST + "[[camera.keyframes]]\nazimuth = 3", KEY + "2: `time` is missing"),
    ("turn = 9\n" + FIRST + SECOND, "`turn` must be left out where there are `keyframes`"),
    (FIRST + "elevation = 90\n" + SECOND, KEY + "1: `elevation` must be a finite number above -90"),
    (FIRST + SECOND + "radius = 0", KEY + "2: `radius` must be a finite number above 0"),
    (FIRST + "width = 64\n" + SECOND, KEY + "1: `width` is not a known key; allowed are time, "),
    (FIRST + SECOND + "eye = [1, 0, 0]", KEY + "1: `eye` is missing"),
    (
        FIRST + "eye = [1, 0, 0]\n" + SECOND + "azimuth = 3",
        KEY + "2: `azimuth` must be left out where key frames have an `eye`",
    ),
    (
        "radius = 2\n" + FIRST + "eye = [1, 0, 0]\n" + SECOND,
        "[camera]: `radius` must be left out where key frames have an `eye`",
    ),
    (
        FIRST + "eye = [1, 0, 0]\n" + SECOND + "target = [1, 0, 0]",
        KEY + "2: `eye` must differ from `target` = [1.0, 0.0, 0.0]",
    ),
    (
        "target = [0, 0, 0]\n" + FIRST + "eye = [-1, 0, 1]\n" + SECOND + "eye = [1, 0, 1]",
        "must not look straight up or down or meet its target on its way, but does at 0.5 s",
    ),
    (
        'file = "cameras.json"\nindex = 0\n' + FIRST + SECOND,
        "`index` must be left out where there are `keyframes`",
    ),
    ('file = "cameras.json"\n' + FIRST + SECOND + "index = 3", KEY + "2: `index` must be below 3"),
    (
        'file = "cameras.json"\n' + FIRST + SECOND + "azimuth = 3",
        KEY + "2: `azimuth` is not a known key; allowed are time, index, name",
    ),
]


@pytest.mark.parametrize(("lines", "words"), FAULTS)
def test_mistakes(tmp_path, lines, words):
    save_ply(tmp_path / "ball.ply", ball())
    shots(tmp_path)
    path = write(tmp_path, MODEL, GRID, JELLY, f"[camera]\n{lines}")
    with pytest.raises(SceneError, match=re.escape(words)):
        read_scene(path)


@pytest.mark.parametrize("text", [f"[camera]\n{SIZE}", ORBITS])
def test_frames_show_all_gaussians_by_depth(tmp_path, monkeypatch, text):
    """Still ones are projected again only when the camera has moved."""
    p = planned_path(tmp_path, text)
    assert len(p.still) > 10
    cameras = []

    def counted(still, camera):
        cameras.append(camera)
        return prepare(still, camera)

    scene_run = sys.modules[_Painter.__module__]
    prepare = scene_run.prepare_surroundings
    monkeypatch.setattr(scene_run, "prepare_surroundings", counted)
    painter = _Painter(p)
    frames = (0, 3, 5, 10, 15, 40, 50)
    for frame in frames:
        moved = dataclasses.replace(p.moving, means=p.moving.means + 0.01 * frame)
        image = painter.paint(moved, frame)
        expected = render(concatenate([moved, p.still]), p.camera(frame), background=(1, 1, 1))
        np.testing.assert_allclose(image, np.clip(expected.rgb, 0, 1), atol=1e-5)
    assert len(cameras) == (4 if text == ORBITS else 1)


def test_a_run_along_a_path_ends_in_a_video(tmp_path):
    text = ORBITS.replace("time = 0.2", "time = 0").replace("time = 0.6", "time = 0.08")
    folder = tmp_path / "out"
    assert run(planned_path(tmp_path, text), folder).stat().st_size > 0
    assert (folder / "first.png").read_bytes() != (folder / "last.png").read_bytes()
