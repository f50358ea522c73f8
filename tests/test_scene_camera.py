"""Cameras of scene files: the orbit, and those of the capture."""

import json
import re

import numpy as np
import pytest
from scene_files import GRID, JELLY, ball, planned, write
from scipy.spatial.transform import Rotation

from pgjax.render import concatenate, load_cameras, load_ply, render, save_ply
from pgjax.scenes import SceneError, read_scene

# The model is turned, moved, scaled and only in part simulated.
MODEL = """
[model]
ply = "ball.ply"
region = { lower = [-9, -9, -9], upper = [9, 0.1, 9] }
size = 0.4
position = [0.1, -0.05, 0.1]
rotation = 25
up = [0.1, -1, 0.2]
"""
SHOTS = {"north": (20, 30), "south.png": (200, -10), "top": (80, 70)}


def pose(azimuth, elevation):
    """World to camera, OpenCV axes, y down in the world, from 2 m away."""
    turn = Rotation.from_euler("yx", [azimuth, elevation], degrees=True).as_matrix().T
    return turn, np.array([0.05, -0.02, 2.0])


def inria(folder):
    entries = []
    for name, angles in SHOTS.items():
        R, t = pose(*angles)
        entries.append(
            {"img_name": name, "rotation": R.T.tolist(), "position": (-R.T @ t).tolist()}
            | {"fx": 130.0, "fy": 120.0, "width": 90, "height": 70}
        )
    (folder / "cameras.json").write_text(json.dumps(entries))
    return "cameras.json"


def transforms(folder):
    frames = []
    for name, angles in SHOTS.items():
        R, t = pose(*angles)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R.T @ np.diag([1, -1, -1]), -R.T @ t
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    shared = {"fl_x": 130.0, "fl_y": 120.0, "w": 90, "h": 70, "cx": 44.0, "cy": 36.0}
    (folder / "transforms.json").write_text(json.dumps(shared | {"frames": frames}))
    return "transforms.json"


def colmap(folder):
    sparse = folder / "sparse"
    sparse.mkdir()
    (sparse / "cameras.txt").write_text("1 PINHOLE 90 70 130 120 44 36\n")
    lines = []
    for i, (name, angles) in enumerate(SHOTS.items()):
        R, t = pose(*angles)
        q = Rotation.from_matrix(R).as_quat(scalar_first=True)
        numbers = " ".join(f"{a:.17g}" for a in (*q, *t))
        lines.append(f"{i + 1} {numbers} 1 {name}\n\n")
    (sparse / "images.txt").write_text("".join(lines))
    return "sparse"


@pytest.mark.parametrize("make", [inria, transforms, colmap])
@pytest.mark.parametrize(
    ("line", "name"),
    [("", "north"), ("index = 2", "top"), ('name = "south.png"', "south.png")],
)
def test_the_picture_is_that_of_the_capture(tmp_path, make, line, name):
    """At rest, through the file's camera: what the untransformed capture shows through it."""
    file = make(tmp_path)
    p = planned(tmp_path, MODEL, GRID, JELLY, f'[camera]\nfile = "{file}"\n{line}')
    assert len(p.still) > 10
    capture = load_ply(tmp_path / "ball.ply")
    expected = render(capture, load_cameras(tmp_path / file)[name])
    found = render(concatenate([p.moving, p.still]), p.camera(2))
    assert found.rgb.shape == (70, 90, 3)
    assert float(expected.alpha.max()) > 0.9
    tolerance = 1e-5 if found.rgb.dtype == np.float64 else 2e-3
    # A Gaussian at the cutoff of 1/255 may be drawn in one and not in the other.
    difference = np.abs(np.asarray(found.rgb - expected.rgb)).max(axis=-1)
    assert np.quantile(difference, 0.999) < tolerance
    assert difference.max() < 2e-2
    # Depths are in metres of the simulation.
    scale = float(p.to_simulation.scale)
    np.testing.assert_allclose(
        found.depth, scale * np.asarray(expected.depth), rtol=2e-2, atol=1e-3
    )


def test_width(tmp_path):
    file = inria(tmp_path)
    p = planned(tmp_path, MODEL, GRID, JELLY, f'[camera]\nfile = "{file}"\nwidth = 45')
    camera = p.camera(0)
    assert (camera.width, camera.height) == (45, 35)
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [65, 60, 22.5, 17.5])


def test_orbit(tmp_path):
    text = "[camera]\nazimuth = 0\nelevation = 0\nradius = 2\ntarget = [0, 0, 0.3]\nturn = 90"
    p = planned(tmp_path, MODEL, GRID, JELLY, text)
    np.testing.assert_allclose(p.camera(0).position, [2, 0, 0.3], atol=1e-6)
    # 25 frames are one second.
    np.testing.assert_allclose(p.camera(25).position, [0, 2, 0.3], atol=1e-6)


def test_the_default_orbit_looks_at_the_model(tmp_path):
    p = planned(tmp_path, MODEL, GRID, JELLY, "[camera]\nelevation = 0\nazimuth = 0")
    np.testing.assert_allclose(p.camera(0).position, [0.1 + 2.4 * 0.4, -0.05, 0.26], atol=1e-6)


FAULTS = [
    ('file = "camera.json"', "`file` must name a file, but there is no"),
    ('file = "camera.json"', "camera.json (did you mean `cameras.json`?)"),
    ('file = "ball.ply"', "is not valid JSON"),
    ('file = "cameras.json"\nname = "nort"', "be one of the file's 3 (did you mean `north`?)"),
    ('file = "cameras.json"\nindex = 3', "`index` must be below 3, the number of cameras"),
    ('file = "cameras.json"\nindex = -1', "`index` must be a whole number, at least 0,"),
    ('file = "cameras.json"\nindex = 0\nname = "north"', "`index` must be left out where `name`"),
    (
        'file = "cameras.json"\nazimuth = 30',
        "`azimuth` is not a known key; allowed are file, index, name, width, keyframes, ",
    ),
    ("index = 1", "`index` is not a known key; allowed are file, target"),
    ("azimut = 1", "did you mean `azimuth`?"),
    ("elevation = 90", "`elevation` must be a finite number above -90 and below 90"),
    ("fov = 170", "`fov` must be a finite number above 0 and below 170"),
    ("width = 8", "`width` must be a whole number, at least 16"),
    ("radius = 0", "`radius` must be a finite number above 0"),
    ("max_stretch = 0.5", "`max_stretch` must be a finite number at least 1"),
    ("background = 1", "`background` must be a list of 3 numbers"),
]


@pytest.mark.parametrize(("lines", "words"), FAULTS)
def test_mistakes(tmp_path, lines, words):
    save_ply(tmp_path / "ball.ply", ball())
    inria(tmp_path)
    path = write(tmp_path, MODEL, GRID, JELLY, f"[camera]\n{lines}")
    with pytest.raises(SceneError, match=re.escape(words)) as error:
        read_scene(path)
    assert str(error.value).startswith("scene.toml [camera]: ")
