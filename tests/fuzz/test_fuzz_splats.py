"""Damaged captures: read, or refused with a `ValueError` that names the file, at little cost."""

import gzip
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mutations import cheaply, damaged_bytes, fuzz, refused

from pgjax import _files
from pgjax.render import load_gaussians

COLUMNS = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
PROPERTIES = "".join(f"property float {name}\n" for name in COLUMNS.split())
BINARY = "ply\nformat binary_little_endian 1.0\n"
ROW = struct.pack("<14f", *[0.0] * 10, 1.0, 0.0, 0.0, 0.0)


def ply(*lines, vertices=3, rows=3, first=BINARY):
    """A .ply of equal Gaussians; more lines of its header come after the columns."""
    header = f"{first}element vertex {vertices}\n{PROPERTIES}{''.join(lines)}end_header\n"
    return header.encode() + rows * ROW


def text_ply():
    header = ply(first="ply\nformat ascii 1.0\n", rows=0)
    return header + 3 * b"0 0 0 0 0 0 0 0 0 0 1 0 0 0\n"


def compressed_ply():
    bounds = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
    bounds += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    words = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    header = f"{BINARY}element chunk 1\n"
    header += "".join(f"property float {name}\n" for name in bounds)
    header += "element vertex 3\n" + "".join(f"property uint {name}\n" for name in words)
    return (header + "end_header\n").encode() + bytes(48) + np.arange(12, dtype="<u4").tobytes()


def splat():
    record = struct.pack("<6f", 0, 0, 0, 0.1, 0.1, 0.1) + bytes([9, 9, 9, 200, 255, 128, 128, 128])
    return 3 * record


def spz(number=3, body=None, degree=1, version=2):
    head = struct.pack("<4sIIBBBx", b"NGSP", version, number, degree, 12, 0)
    content = bytes(range(28)) * number if body is None else body
    return gzip.compress(head + content, mtime=0)


FILES = {
    "a.ply": ply("element face 1\nproperty list uchar int i\n") + b"\1" + bytes(4),
    "text.ply": text_ply(),
    "compressed.ply": compressed_ply(),
    "a.splat": splat(),
    "a.spz": spz(),
    "unknown": spz(),
}


def load(folder, name, content):
    path = folder / name
    path.write_bytes(content)
    return load_gaussians(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("splats")


@pytest.mark.parametrize("name", FILES)
def test_the_whole_is_valid(folder, name):
    assert len(load(folder, name, FILES[name])) == 3


@pytest.mark.parametrize("name", FILES)
@fuzz(80)
@given(data=st.data())
def test_damaged_bytes(folder, name, data):
    content = data.draw(damaged_bytes(FILES[name]))
    with refused(ValueError) as refusal:
        load(folder, name, content)
    assert refusal.error is None or name in str(refusal)


@fuzz(80)
@given(data=st.data())
def test_damaged_content_of_an_spz(folder, data):
    """Behind the check sum."""
    content = data.draw(damaged_bytes(gzip.decompress(FILES["a.spz"])))
    with refused(ValueError):
        load(folder, "a.spz", gzip.compress(content, mtime=0))


@fuzz(80)
@given(
    content=st.binary(max_size=200),
    start=st.sampled_from([b"", b"ply\n", b"\x1f\x8b\x08", b"NGSP"]),
)
def test_noise(folder, content, start):
    for name in ("a.ply", "a.splat", "a.spz", "unknown"):
        with refused(ValueError):
            load(folder, name, start + content)


# A header of few bytes that asks for much, or for nothing.
HUGE = [
    b"ply",
    ply(vertices=10**12),
    ply(vertices="9" * 5000),
    ply(vertices=-1),
    ply("element big 1000000000000\nproperty float q\n"),
    ply("element big 1000000000000\nproperty list uchar int q\n"),
    # Another reader of headers goes on after this comment.
    ply("comment end_header\nelement big 1000000000000\nproperty float q\n"),
    ply("comment x\rend_header\nelement big 1000000000000\nproperty float q\n"),
    ply("element f 1\nproperty list uint double q\n") + struct.pack("<I", 2**32 - 1),
    ply("element f 3000000\nproperty list uchar int q\n") + bytes(3_000_000),
    ply(*[f"comment {i}\n" for i in range(40_000)]),
    ply(*[f"property float q{i}\n" for i in range(20_000)]),
    ply(*[f"element e{i} 0\n" for i in range(20_000)]),
]  # fmt: skip


@pytest.mark.parametrize("content", HUGE, ids=range(len(HUGE)))
def test_headers_that_ask_for_much_are_refused_at_once(folder, content):
    with cheaply(), pytest.raises(ValueError, match=r"a\.ply"):
        load(folder, "a.ply", content)


def test_elements_of_nothing_take_nothing(folder):
    with cheaply():
        assert len(load(folder, "a.ply", ply("element big 1000000000000\n"))) == 3


def test_a_bomb_that_says_what_it_is(folder):
    """Its header tells the truth: 190 MB of zeros in 185 kB."""
    content = spz(10_000_000, bytes(190_000_000), degree=0)
    assert len(content) < 200_000
    (folder / "bomb.spz").write_bytes(content)
    del content
    with cheaply(), pytest.raises(ValueError, match="take 190000000 bytes, more than its 184"):
        load_gaussians(folder / "bomb.spz")


@pytest.mark.parametrize("name", ["huge.ply", "huge.splat", "huge.spz"])
def test_files_with_holes_take_no_memory(folder, name):
    """A terabyte that takes no room on the disk."""
    rows = 2**34
    with (folder / name).open("wb") as file:
        if name.endswith(".ply"):
            file.write(ply(vertices=rows, rows=0))
        file.truncate(file.tell() + 56 * rows if name.endswith(".ply") else 1 << 40)
    with cheaply(), pytest.raises(ValueError, match=name):
        load_gaussians(folder / name)
    (folder / name).unlink()


def test_what_follows_a_stream_is_not_read(folder):
    with (folder / "long.spz").open("wb") as file:
        file.write(FILES["a.spz"])
        file.truncate(1 << 40)
    with cheaply():
        assert len(load_gaussians(folder / "long.spz")) == 3
    (folder / "long.spz").unlink()


@pytest.mark.parametrize("name", FILES)
def test_more_than_the_machine_has_is_refused(folder, name, monkeypatch):
    monkeypatch.setattr(_files, "memory", lambda: 100.0)
    with pytest.raises(ValueError, match="is too large: its content takes"):
        load(folder, name, FILES[name])
