"""Camera files: the same cameras in every format, projection by hand, and what is refused."""

import json
import math
import struct

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.render import load_cameras

SIZE = (64, 48)
FOCALS = (50.0, 55.0)
CENTER = (32.0, 24.0)
# Camera to world, OpenCV axes, and where the cameras are.
TURNS = Rotation.from_quat(
    [[1, 0, 0, 0], [0.8, -0.3, 0.4, 0.2], [0.1, 0.9, -0.2, 0.3]], scalar_first=True
)
POSITIONS = np.array([[0.0, 0, -4], [1, 2, -3], [0.5, -1, 2]])
NAMES = ["b/0002.png", "b/0001.png", "a 3.png"]
GL = np.diag([1.0, -1.0, -1.0])


def points():
    """Four points in front of each camera, of shape (3, 4, 3), in the world."""
    local = np.array([[0.1, 0.2, 2], [-0.5, 0.3, 3], [0, 0, 1], [0.4, -0.6, 4]])
    return np.stack([TURNS[i].apply(local) + POSITIONS[i] for i in range(3)])


def inria(**change):
    entries = []
    for i, name in enumerate(NAMES):
        entry = {"id": i, "img_name": name, "width": SIZE[0], "height": SIZE[1]}
        entry |= {"position": POSITIONS[i].tolist(), "rotation": TURNS[i].as_matrix().tolist()}
        entries.append(entry | {"fx": FOCALS[0], "fy": FOCALS[1]})
    entries[1] |= change
    return entries


def transforms(shared=None, frame=None, without=()):
    """A `transforms.json`; `shared` and `frame` (the second one) change and add keys."""
    content = {"fl_x": FOCALS[0], "fl_y": FOCALS[1], "w": SIZE[0], "h": SIZE[1]} | (shared or {})
    frames = []
    for i, name in enumerate(NAMES):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = TURNS[i].as_matrix() @ GL, POSITIONS[i]
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    frames[1] |= frame or {}
    content["frames"] = frames
    for key in without:
        content.pop(key, None)
        frames[1].pop(key, None)
    return content


def save(folder, content):
    path = folder / "scene.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def poses():
    """Quaternions wxyz and translations of the world-to-camera maps."""
    back = TURNS.inv()
    return back.as_quat(scalar_first=True), -back.apply(POSITIONS)


def colmap_text(folder, model="PINHOLE", parameters=(*FOCALS, *CENTER), images=None):
    q, t = poses()
    numbers = " ".join(repr(float(a)) for a in parameters)
    cameras = f"# Camera list\n9 FOV 8 8 1 1 4 4 0.5\n7 {model} {SIZE[0]} {SIZE[1]} {numbers}\n"
    (folder / "cameras.txt").write_text(cameras)
    lines = ["# Image list", "#   POINTS2D[] as (X, Y, POINT3D_ID)"]
    seen = ["12.5 3 -1 4.5 20 88", "", "1 2 3"]
    for i, name in enumerate(NAMES):
        pose = " ".join(repr(float(a)) for a in (*q[i], *t[i]))
        lines += [f"{i + 1} {pose} 7 {name}", seen[i]]
    (folder / "images.txt").write_text("\n".join(lines) + "\n" if images is None else images)
    return folder


def colmap_binary(folder, number=1, parameters=(*FOCALS, *CENTER), cut=(None, None), more=b""):
    q, t = poses()
    cameras = struct.pack("<Q", 2) + struct.pack("<IiQQ5d", 9, 7, 8, 8, 1, 1, 4, 4, 0.5)
    cameras += struct.pack(f"<IiQQ{len(parameters)}d", 7, number, *SIZE, *parameters)
    images = struct.pack("<Q", 3)
    for i, name in enumerate(NAMES):
        images += struct.pack("<I7dI", i + 1, *q[i], *t[i], 7) + name.encode() + b"\0"
        images += struct.pack("<Q", i) + i * struct.pack("<ddq", 1.5, 2.5, -1)
    (folder / "cameras.bin").write_bytes(cameras[: cut[0]])
    (folder / "images.bin").write_bytes(images[: cut[1]] + more)
    return folder


WRITERS = {
    "cameras.json": lambda folder: save(folder, inria()),
    "transforms.json": lambda folder: save(folder, transforms()),
    "text": colmap_text,
    "binary": colmap_binary,
}


def assert_same(actual, expected):
    tol = 1e-12 if jnp.zeros(()).dtype == jnp.float64 else 1e-6
    for name in ("world_to_camera", "fx", "fy", "cx", "cy", "near"):
        np.testing.assert_allclose(
            getattr(actual, name), getattr(expected, name), rtol=tol, atol=tol, err_msg=name
        )
    assert (actual.width, actual.height) == (expected.width, expected.height)


# The same cameras in all formats


def by_hand(kind, i, p):
    """Pixels by the formulas of each format, not through a world-to-camera matrix."""
    R, c = TURNS[i].as_matrix(), POSITIONS[i]
    if kind == "cameras.json":
        x, y, z = (p - c) @ R[:, 0], (p - c) @ R[:, 1], (p - c) @ R[:, 2]
    elif kind == "transforms.json":
        right, up, back = (R @ GL).T
        x, y, z = (p - c) @ right, -(p - c) @ up, -(p - c) @ back
    else:
        q, t = poses()
        x, y, z = (Rotation.from_quat(q[i], scalar_first=True).apply(p) + t[i]).T
    return np.stack([FOCALS[0] * x / z + CENTER[0], FOCALS[1] * y / z + CENTER[1]], axis=-1), z


@pytest.mark.parametrize("kind", WRITERS)
def test_points_are_projected_as_by_hand(tmp_path, kind):
    cameras = load_cameras(WRITERS[kind](tmp_path))
    assert list(cameras) == NAMES
    for i, camera in enumerate(cameras.values()):
        p = points()[i]
        pixels, depths = camera.project(jnp.asarray(p, dtype=jnp.zeros(()).dtype))
        expected, z = by_hand(kind, i, p)
        np.testing.assert_allclose(pixels, expected, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(depths, z, rtol=1e-5)
        np.testing.assert_allclose(depths, [2, 3, 1, 4], rtol=1e-5)
        np.testing.assert_allclose(camera.position, POSITIONS[i], atol=1e-5)
        assert (camera.width, camera.height) == SIZE


@pytest.mark.parametrize("kind", list(WRITERS)[1:])
def test_all_formats_give_the_same_cameras(tmp_path, kind):
    expected = load_cameras(save(tmp_path, inria()))
    actual = load_cameras(WRITERS[kind](tmp_path))
    for name in NAMES:
        assert_same(actual[name], expected[name])


# Intrinsics


def test_a_frame_of_a_transforms_file_overrides_what_is_shared(tmp_path):
    own = {"fl_x": 70, "fl_y": 71, "cx": 30.5, "cy": 20.25, "w": 60, "h": 40}
    first, second, _ = load_cameras(save(tmp_path, transforms(frame=own))).values()
    assert (float(first.fx), float(first.cx), first.width) == (50, 32, 64)
    assert [float(getattr(second, a)) for a in ("fx", "fy", "cx", "cy")] == [70, 71, 30.5, 20.25]
    assert (second.width, second.height) == (60, 40)


def test_opening_angles_become_focal_lengths(tmp_path):
    angle = 2 * math.atan(32 / 40)
    without = ("fl_x", "fl_y")
    content = transforms({"camera_angle_x": angle}, {"camera_angle_x": 2 * angle / 3}, without)
    first, second, _ = load_cameras(save(tmp_path, content)).values()
    np.testing.assert_allclose([first.fx, first.fy], [40, 40], rtol=1e-6)
    np.testing.assert_allclose(second.fx, 32 / math.tan(angle / 3), rtol=1e-6)
    np.testing.assert_allclose(second.fy, second.fx, rtol=1e-6)
    both = {"camera_angle_x": angle, "camera_angle_y": 2 * math.atan(24 / 36)}
    camera = next(iter(load_cameras(save(tmp_path, transforms(both, None, without))).values()))
    np.testing.assert_allclose([camera.fx, camera.fy], [40, 36], rtol=1e-6)
    # The x of a frame alone means square pixels; given together, lengths win over angles.
    content = transforms({"camera_angle_x": angle}, {"fl_x": 45})
    first, second, _ = load_cameras(save(tmp_path, content)).values()
    np.testing.assert_allclose([first.fx, first.fy, second.fx, second.fy], [50, 55, 45, 45])


def test_three_rows_of_a_pose_are_enough(tmp_path):
    content = transforms()
    expected = load_cameras(save(tmp_path, content))
    for frame in content["frames"]:
        del frame["transform_matrix"][3]
    for name, camera in load_cameras(save(tmp_path, content)).items():
        assert_same(camera, expected[name])


PINHOLES = {
    "SIMPLE_PINHOLE": (0, (50, 30, 20), (50, 50)),
    "PINHOLE": (1, (50, 55, 30, 20), (50, 55)),
    "SIMPLE_RADIAL": (2, (50, 30, 20, 0), (50, 50)),
    "RADIAL": (3, (50, 30, 20, 0, 0), (50, 50)),
    "OPENCV": (4, (50, 55, 30, 20, 0, 0, 0, 0), (50, 55)),
    "FULL_OPENCV": (6, (50, 55, 30, 20, *(0,) * 8), (50, 55)),
    "FOV": (7, (50, 55, 30, 20, 0), (50, 55)),
}
FISHEYES = {
    "OPENCV_FISHEYE": (5, 8),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
    "THIN_PRISM_FISHEYE": (10, 12),
}


@pytest.mark.parametrize("model", PINHOLES)
def test_models_of_colmap_without_distortion_are_pinholes(tmp_path, model):
    number, parameters, focals = PINHOLES[model]
    text = load_cameras(colmap_text(tmp_path, model, parameters))
    binary = load_cameras(colmap_binary(tmp_path, number, parameters))
    for name in NAMES:
        assert_same(text[name], binary[name])
        assert [float(getattr(text[name], a)) for a in ("fx", "fy", "cx", "cy")] == [
            *focals,
            30,
            20,
        ]


@pytest.mark.parametrize("model", list(PINHOLES)[2:])
def test_distortion_of_colmap_is_refused(tmp_path, model):
    number, parameters, _ = PINHOLES[model]
    bent = (*parameters[:-1], -1e-9)
    pattern = rf"cameras\.{{}} has the camera '7' of the model {model} with lens distortion "
    pattern += r"\(\w+ = -1e-09\).*image_undistorter"
    with pytest.raises(ValueError, match=pattern.format("txt")):
        load_cameras(colmap_text(tmp_path, model, bent))
    with pytest.raises(ValueError, match=pattern.format("bin")):
        load_cameras(colmap_binary(tmp_path, number, bent))


@pytest.mark.parametrize("model", FISHEYES)
def test_a_fisheye_is_no_pinhole_even_without_coefficients(tmp_path, model):
    number, count = FISHEYES[model]
    parameters = (50.0, 50, 32, 24, *(0,) * count)[:count]
    message = f"'7' of the model {model}, which is not a pinhole"
    with pytest.raises(ValueError, match=message):
        load_cameras(colmap_text(tmp_path, model, parameters))
    with pytest.raises(ValueError, match=message):
        load_cameras(colmap_binary(tmp_path, number, parameters))


@pytest.mark.parametrize(
    ("shared", "frame", "message"),
    [
        ({"k1": 0.1, "p2": 0, "camera_model": "OPENCV"}, {}, r"0002.* OPENCV .*\(k1 = 0.1\)"),
        ({}, {"k3": -2, "p1": 1}, r"0001.* OPENCV .*\(k3 = -2.0, p1 = 1.0\).*image_undistorter"),
        ({"distortion_params": [0, 0.5, 0, 0, 0, 0]}, {}, r"\(distortion_params\[1\] = 0.5\)"),
        ({"camera_model": "OPENCV_FISHEYE"}, {}, "OPENCV_FISHEYE, which is not a pinhole"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, "EQUIRECTANGULAR, which is not a pinhole"),
        ({"is_fisheye": True}, {}, "which is not a pinhole"),
    ],
)
def test_distortion_of_a_transforms_file_is_refused(tmp_path, shared, frame, message):
    with pytest.raises(ValueError, match=message) as error:
        load_cameras(save(tmp_path, transforms(shared, frame)))
    assert "scene.json" in str(error.value)


def test_coefficients_of_zero_are_no_distortion(tmp_path):
    shared = {"k1": 0, "k2": 0.0, "p1": 0, "distortion_params": [0] * 6, "is_fisheye": False}
    assert len(load_cameras(save(tmp_path, transforms(shared, {"k1": 0})))) == 3
    # What a frame says overrides the file here, too.
    assert len(load_cameras(save(tmp_path, transforms({}, {"camera_model": "PINHOLE"})))) == 3


# Files that are wrong


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is not valid JSON"),
        ("[1, 2", "is not valid JSON"),
        ('"text"', "must be a list of cameras .* or have the key `frames`"),
        ({"fl_x": 3}, "must be a list of cameras .* or have the key `frames`"),
        ([], "holds no cameras"),
        ([1], "must hold a list of objects"),
        (inria(img_name=3), "no text under the key `img_name` of entry 1"),
        (inria(img_name=NAMES[0]), "two cameras of the name 'b/0002.png'"),
        (
            inria(rotation=[[1, 0], [0, 1]]),
            r"0001.*`rotation` must have shape \(3, 3\), but .*2, 2",
        ),
        (inria(rotation=[[1, 0], [0]]), "0001.*`rotation` must hold numbers"),
        (inria(rotation=np.diag([1, 1, 1.01]).tolist()), "0001.*must be a rotation"),
        (inria(rotation=np.diag([1, 1, -1]).tolist()), "0001.*must be a rotation"),
        (inria(position=[1, 2, math.nan]), "0001.*`position` must be finite"),
        (inria(position=None), "0001.*`position` must (hold numbers|have shape|be finite)"),
        (inria(fx=0), "0001.*`fx` must be positive"),
        (inria(fx="wide"), "0001.*`fx` must hold numbers, but holds 'wide'"),
        (inria(width=64.5), "0001.*`width` must be a whole number"),
        (inria(height=0), "0001.*`height` must be at least 1"),
        ([{"img_name": "x"}], "'x': The key `rotation` is missing"),
        ({"frames": []}, "holds no cameras"),
        ({"frames": 3}, "must hold a list of objects"),
        (transforms(without=("file_path",)), "no text under the key `file_path` of entry 1"),
        (transforms(without=("transform_matrix",)), "0001.*`transform_matrix` is missing"),
        (transforms(without=("fl_x",)), "`fl_x` and `camera_angle_x` are both missing"),
        (transforms(without=("h",)), "The keys `w` and `h` are missing. Add"),
        (transforms(frame={"fl_x": -3}), "0001.*`fl_x` must be positive, but is -3"),
        (transforms(frame={"cx": []}), r"0001.*`cx` must have shape \(\), but has \(0,\)"),
        (transforms(frame={"camera_angle_x": 4}), "0001.*`camera_angle_x` must be between 0 and π"),
        (transforms(frame={"transform_matrix": np.eye(3).tolist()}), r"shape \(4, 4\) or \(3, 4\)"),
        (transforms(frame={"transform_matrix": (2 * np.eye(4)).tolist()}), "must end with 0 0 0 1"),
        (
            transforms(frame={"transform_matrix": np.diag([2, 2, 2, 1]).tolist()}),
            "0001.*must be a rotation",
        ),
    ],
)
def test_wrong_json_files_are_refused(tmp_path, content, message):
    with pytest.raises(ValueError, match=message) as error:
        load_cameras(save(tmp_path, content))
    assert "scene.json" in str(error.value)


IMAGE = "1 1 0 0 0 0 0 0 7 a.png\n"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": ""}, "holds no cameras"),
        ({"images": "1 1 0 0 0 0 0 0 7\n\n"}, "images.txt must have IMAGE_ID QW .*the line '1 1 0"),
        ({"images": "1 one 0 0 0 0 0 0 7 a.png\n\n"}, "images.txt must have numbers"),
        ({"images": "1 0.5 0 0 0 0 0 0 7 a.png\n"}, "images.txt.*'a.png'.*length 1, but has 0.5"),
        ({"images": "1 nan 0 0 0 0 0 0 7 a.png\n"}, "images.txt.*'a.png'.*length 1, but has nan"),
        ({"images": "1 1 0 0 0 0 inf 0 7 a.png\n"}, "'a.png'.*`world_to_camera` must be finite"),
        ({"images": "1 1 0 0 0 0 0 0 8 a.png\n"}, "the image 'a.png' of the camera 8"),
        ({"images": 2 * IMAGE}, "images.txt must have POINTS2D.* after each image"),
        ({"images": 2 * IMAGE.replace("a.", "my photo a.")}, "must have POINTS2D"),
        ({"images": 2 * (IMAGE + "\n")}, "two cameras of the name 'a.png'"),
        ({"model": "MIRROR"}, "cameras.txt has the camera 7 of the unknown model MIRROR"),
        ({"parameters": (50, 55, 32)}, "cameras.txt must have 4 parameters for the camera 7"),
        ({"parameters": (50, -55, 32, 24)}, "images.txt.*0002.*`fy` must be positive"),
    ],
)
def test_wrong_text_models_are_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        load_cameras(colmap_text(tmp_path, **change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cut": (4, None)}, "cameras.bin is truncated"),
        ({"cut": (-8, None)}, "cameras.bin is truncated"),
        ({"cut": (None, 0)}, "images.bin is truncated"),
        ({"cut": (None, -1)}, "images.bin is truncated"),
        ({"cut": (None, 75)}, "images.bin is truncated within a name"),
        ({"more": b"x"}, "images.bin goes on after the last entry"),
        ({"cut": (None, 0), "more": bytes(8)}, "holds no cameras"),
        ({"cut": (None, 0), "more": b"\xff" * 8}, "images.bin is truncated"),
        ({"number": 77}, "cameras.bin has the camera 7 of the unknown model 77"),
        ({"number": -1}, "cameras.bin has the camera 7 of the unknown model -1"),
    ],
)
def test_wrong_binary_models_are_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        load_cameras(colmap_binary(tmp_path, **change))


def test_missing_files_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"There is no file or folder .*cameras.json"):
        load_cameras(tmp_path / "cameras.json")
    with pytest.raises(ValueError, match=r"not a sparse model .*cameras.bin and images.bin nor"):
        load_cameras(tmp_path)
    colmap_text(tmp_path)
    (tmp_path / "images.txt").unlink()
    with pytest.raises(ValueError, match=r"cameras.txt and images.txt"):
        load_cameras(tmp_path)


def test_two_cameras_of_one_number_are_refused(tmp_path):
    colmap_text(tmp_path)
    with (tmp_path / "cameras.txt").open("a") as file:
        file.write("7 PINHOLE 64 48 1 1 32 24\n")
    with pytest.raises(ValueError, match=r"cameras.txt has two cameras of the number 7"):
        load_cameras(tmp_path)
