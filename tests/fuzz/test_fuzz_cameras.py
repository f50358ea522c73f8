"""Damaged camera files: read, or refused with a `ValueError` that names the file."""

import json
import struct
import tomllib

import everything
import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from mutations import cheaply, damaged, damaged_bytes, fuzz, refused
from scene_files import DROP, changed

from pgjax.render import load_cameras
from pgjax.scenes import SceneError, read_scene

POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
INRIA = [
    {
        "id": 0,
        "img_name": name,
        "width": 64,
        "height": 48,
        "position": [0, 0, -3],
        "rotation": np.eye(3).tolist(),
        "fx": 50.0,
        "fy": 50,
    }
    for name in ("a", "b")
]
NERF = {
    "camera_model": "OPENCV",
    "fl_x": 50.0,
    "camera_angle_y": 0.9,
    "cx": 32,
    "w": 64,
    "h": 48,
    "k1": 0.0,
    "distortion_params": [0, 0, 0, 0],
    "frames": [
        {"file_path": "a", "transform_matrix": POSE},
        {"file_path": "b", "transform_matrix": POSE[:3], "fl_x": 40, "cy": 20},
    ],
}
TEXT = {
    "cameras.txt": b"# cameras\n1 PINHOLE 64 48 50 50 32 24\n2 SIMPLE_PINHOLE 64 48 50 32 24\n",
    "images.txt": b"# images\n1 1 0 0 0 0 0 3 1 a.png\n1.5 2.5 -1\n2 1 0 0 0 0 0 3 2 b.png\n\n",
}
BINARY = {
    "cameras.bin": struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50, 50, 32, 24),
    "images.bin": struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 3, 1)
    + b"a.png\0"
    + struct.pack("<Q2dq", 1, 1.5, 2.5, -1),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cameras")
    everything.write_files(folder)
    return folder


def written(folder, files, name="model"):
    """A folder that holds these files alone."""
    place = folder / name
    place.mkdir(exist_ok=True)
    for old in place.iterdir():
        old.unlink()
    for name, content in files.items():
        (place / name).write_bytes(content)
    return place


def load(folder, content):
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    (folder / "some.json").write_bytes(text)
    return load_cameras(folder / "some.json")


@pytest.mark.parametrize("content", [INRIA, NERF])
def test_json_is_valid(folder, content):
    assert list(load(folder, content)) == ["a", "b"]


@pytest.mark.parametrize(("files", "count"), [(TEXT, 2), (BINARY, 1)])
def test_models_are_valid(folder, files, count):
    assert len(load_cameras(written(folder, files))) == count


@pytest.mark.parametrize("content", [INRIA, NERF])
@fuzz(60)
@given(data=st.data())
def test_damaged_values(folder, content, data):
    with refused(ValueError):
        load(folder, data.draw(damaged(content, [None])))


@pytest.mark.parametrize("content", [INRIA, NERF])
@fuzz(60)
@given(data=st.data())
def test_damaged_text(folder, content, data):
    with refused(ValueError):
        load(folder, data.draw(damaged_bytes(json.dumps(content).encode())))


@pytest.mark.parametrize("files", [TEXT, BINARY])
@fuzz(60)
@given(data=st.data())
def test_damaged_models(folder, files, data):
    name = data.draw(st.sampled_from(sorted(files)))
    content = data.draw(damaged_bytes(files[name]))
    place = written(folder, files | {name: content})
    with refused(ValueError):
        load_cameras(place)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 10**400}, "`fx` must hold numbers, but holds 1000000000"),
        ({"width": 10**400}, "`width` must hold numbers, but holds 1000000000"),
        ({"width": 1e300}, "`width` must be a whole number, at most 2147483647"),
        ({"rotation": "x" * 100_000}, "`rotation` must hold numbers, but holds 'xxx"),
        ({"position": [1e308, 1e308, 1e308]}, None),
    ],
)
def test_found_by_fuzzing(folder, change, words):
    """A message shows as much of a value as fits into a line."""
    if words is None:
        with refused(ValueError):
            load(folder, [INRIA[0] | change])
        return
    with pytest.raises(ValueError, match=words) as error:
        load(folder, [INRIA[0] | change])
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("line", [b"1 PINHOLE %s 48 50 50 32 24\n", b"%s PINHOLE 64 48 1 1 1 1\n"])
def test_numbers_of_any_length_in_a_model(folder, line):
    for digits in (400, 5000):
        place = written(folder, TEXT | {"cameras.txt": line % (b"9" * digits)})
        with pytest.raises(ValueError, match=r"cameras\.txt|images\.txt"):
            load_cameras(place)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[" * 1_000_000, "is not valid JSON: maximum recursion depth"),
        (b'[{"img_name": "a", "rotation": ' + b"[" * 900 + b"]" * 900 + b"}]", "must hold numbers"),
        (b"9" * 5000, "is not valid JSON"),
        (b'"\xff\xfe"', "is not valid JSON: 'utf-8' codec"),
        (b"[]" + b" " * (1 << 24), "it is larger than 16 MiB"),
    ],
    ids=["deep", "deep rotation", "digits", "no text", "long"],
)
def test_files_made_to_take_long_are_refused_at_once(folder, content, words):
    with cheaply(), pytest.raises(ValueError, match=words):
        load(folder, content)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_counts_that_no_file_holds(folder, name):
    content = struct.pack("<Q", 2**64 - 1) + BINARY[name][8:]
    with cheaply(), pytest.raises(ValueError, match=r"\.bin is truncated"):
        load_cameras(written(folder, BINARY | {name: content}))


@pytest.mark.parametrize(("width", "height"), [(16385, 16), (16, 16385), (10**9, 10**9)])
def test_pictures_that_fit_into_no_memory_are_refused(folder, width, height):
    """The size of a camera of the capture is that of the pictures."""
    content = [INRIA[0] | {"width": width, "height": height}]
    (folder / "large.json").write_text(json.dumps(content))
    scene = tomllib.loads(changed(DROP, ("drop.ply", "ball.ply")))
    scene["camera"] = {"file": "large.json"}
    (folder / "scene.toml").write_text(tomli_w.dumps(scene))
    with pytest.raises(SceneError, match=r"`width` must make a picture of at most 16384 x 16384"):
        read_scene(folder / "scene.toml")
