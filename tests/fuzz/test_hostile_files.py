"""Pipes where files are expected, arrays and meshes that are not what they say."""

import os
import struct
import sys

import everything
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mutations import cheaply, damaged_bytes, fuzz, refused
from scene_files import DROP, changed

from pgjax.boundary import sample_mesh
from pgjax.render import load_cameras, load_gaussians, load_image, load_video
from pgjax.scenes import SceneError, read_scene
from pgjax.storage import load_trajectory

WALL = 'type = "half-space"\npoint = [0, 0, -0.1]\nnormal = [0, 0, 1]'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    everything.write_files(folder)
    return folder


def read(folder, *changes):
    (folder / "scene.toml").write_text(changed(DROP, ("drop.ply", "ball.ply"), *changes))
    return read_scene(folder / "scene.toml")


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
def test_nothing_waits_for_a_pipe(folder):
    """Opening one takes until somebody writes to it."""
    pipe = folder / "pipe"
    os.mkfifo(pipe)
    for load in (load_gaussians, load_cameras, load_image, load_video, load_trajectory, read_scene):
        with pytest.raises(ValueError, match="pipe"):
            load(pipe)
    with pytest.raises(ValueError, match=r"The mesh .*pipe does not exist"):
        sample_mesh(pipe, spacing=0.1)
    for old, new in [
        ("E = 2e4", 'E = { file = "pipe" }'),
        ("[camera]", '[camera]\nfile = "pipe"'),
        (WALL, 'type = "mesh"\nfile = "pipe"'),
        ("size = 0.5", 'size = 0.5\nregion = { shape = "labels", file = "pipe", values = [1] }'),
    ]:
        with pytest.raises(SceneError, match=r"must name a file, but there is no .*pipe"):
            read(folder, (old, new))


# --- Values per Gaussian -------------------------------------------------------------------------


def npy(shape, descr="'<f8'", body=b"", version=b"\1\0"):
    """An array as its header claims it."""
    head = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(head)) + head + body


@pytest.mark.parametrize(
    "content",
    [
        npy("(1000000000000,)"),
        npy(f"({10**30},)"),
        npy("(4611686018427387904, 4)"),
        npy("(-5,)"),
        npy("(2**62,)"),
        npy("(" * 200 + ")" * 200),
        npy("(3,)", "'O'", bytes(24)),
        npy("(3,)", "'|S9999999999'", bytes(24)),
        npy("(3,)", "[('a', '<f8')]", bytes(24)),
        npy("(3,)", "'<f8"),
        npy("(3,)", body=bytes(24), version=b"\7\0"),
        b"\x93NUMPY",
        b"PK\3\4",
    ],
    ids=range(13),
)
def test_arrays_that_are_none(folder, content):
    (folder / "wrong.npy").write_bytes(content)
    with cheaply(), pytest.raises(SceneError, match=r"'wrong\.npy' must"):
        read(folder, ("E = 2e4", 'E = { file = "wrong.npy" }'))


@fuzz(40)
@given(data=st.data())
def test_damaged_arrays(folder, data):
    content = data.draw(damaged_bytes((folder / "values.npy").read_bytes()))
    (folder / "damaged.npy").write_bytes(content)
    with refused(SceneError):
        read(folder, ("E = 2e4", 'E = { file = "damaged.npy" }'))


# --- Meshes --------------------------------------------------------------------------------------

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
OBJ += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES)
PLY = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
PLY += "property float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
PLY += "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS) + "".join(
    f"3 {a} {b} {c}\n" for a, b, c in FACES
)


def sample(folder, name, content):
    (folder / name).write_bytes(content)
    return sample_mesh(folder / name, spacing=0.25)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        # The reader frees the same memory twice.
        ("a.ply", PLY.replace("vertex_indices", "v\0rtex_indices").encode("latin-1")),
        ("b.ply", PLY.replace("vertex_indices", "lists").encode()),
        ("c.ply", PLY.replace("element vertex 4", "element vertex 4000000000").encode()),
        # Which claims 200 GB of triangles.
        ("d.stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50)),
        ("e.obj", OBJ.replace("f 1 3 2", "f 1 3 2000000000").encode()),
        ("f.obj", b"v nan nan nan\n" * 3 + b"f 1 2 3\n"),
        ("g.off", b"OFF\n2000000000 2000000000 0\n"),
        ("h.obj", b""),
    ],
)
def test_meshes_that_end_their_reader(folder, name, content):
    """Which is not this process."""
    with pytest.raises(ValueError, match=name):
        sample(folder, name, content)


def test_a_mesh_is_read(folder):
    body = sample(folder, "good.obj", OBJ.encode())
    assert min(body.coefficients.shape) > 4
