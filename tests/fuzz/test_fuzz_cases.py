"""Damaged case files, tracks, pictures and videos: read, or refused with a named error."""

import io
import struct
import tomllib
import zipfile
import zlib

import everything
import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from mutations import TOML_ONLY, cheaply, damaged, damaged_bytes, fuzz, refused
from scene_files import DROP, changed

from pgjax.cases import prepare, read_case
from pgjax.cases.footage import footage, track
from pgjax.render import load_image, load_video, save_image, save_video
from pgjax.scenes import SceneError
from pgjax.scenes.reader import Table

CASE = """
scene = "scene.toml"
name = "case"
frames = 3
fit_frames = 2
frame_rate = 25
noise = 0.01
channel = "rgb"
coarser = 1
[[unknown]]
key = "material.1.E"
start = 1e4
lower = 5e3
upper = 5e4
log = true
unit = "Pa"
prior = { mean = 1e4, deviation = 0.5 }
[[unknown]]
key = "model.velocity"
start = [0.1, 0, 0]
lower = -3
upper = 3
[solver]
starts = 2
trials = 8
tolerance = 1e-3
stage = [{ frames = 1, free = ["model.velocity"], coarser = 2 }]
[track]
file = "track.npz"
"""
TREE = tomllib.loads(CASE)
SIZE = (64, 48)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cases")
    everything.write_files(folder)
    (folder / "scene.toml").write_text(changed(DROP, ("drop.ply", "ball.ply")))
    np.savez(folder / "track.npz", x=np.zeros((4, 200, 3)))
    pictures = [np.full((48, 64, 3), 0.1 * i) for i in range(4)]
    (folder / "film").mkdir()
    for i, picture in enumerate(pictures):
        save_image(folder / "film" / f"{i:03}.png", picture)
    save_video(folder / "film.mp4", pictures, fps=25)
    return folder


def read(folder, content):
    path = folder / "case.toml"
    path.write_bytes(content)
    return read_case(path)


def table(folder, **content):
    return Table("case.toml [track]", content, folder)


def test_the_whole_is_valid(folder):
    prepared = prepare(read(folder, CASE.encode()))
    assert prepared.problem.names
    assert len(footage(table(folder, frames="film"), 25, 0, 3, SIZE).pictures) == 4
    assert len(footage(table(folder, video="film.mp4"), 25, 0, 3, SIZE).pictures) == 4


@fuzz(60)
@given(content=damaged(TREE, TOML_ONLY))
def test_damaged_values(folder, content):
    with refused(SceneError):
        read(folder, tomli_w.dumps(content).encode())


@fuzz(50)
@given(content=damaged_bytes(CASE.encode()))
def test_damaged_text(folder, content):
    with refused(SceneError):
        read(folder, content)


@fuzz(5)
@given(content=damaged(TREE))
def test_damaged_preparations(folder, content):
    with refused(ValueError):
        prepare(read(folder, tomli_w.dumps(content).encode()))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "case"', 'name = "../../elsewhere"', "`name` must name a folder"),
        ("frames = 3", "frames = 2147483647", "`frames` must be .* at most 100000"),
        ("noise", "first = 2147483647\nnoise", "`first` must be .* at most 100000"),
        ('scene = "scene.toml"', f'scene = "{"x" * 5000}"', "no such file"),
        ('scene = "scene.toml"', r'scene = "a\u0000b"', "no such file"),
        ("material.1.E", "material.².E", "`key` must say which of 2 tables"),
        ("material.1.E", f"material.{'9' * 5000}.E", "`key` must say which of 2 tables"),
        ("material.1.E", "material.0.E", "`key` must count"),
    ],
)  # fmt: skip
def test_found_by_fuzzing(folder, old, new, words):
    with pytest.raises(SceneError, match=words):
        prepare(read(folder, changed(CASE, (old, new)).encode()))


# --- Tracks --------------------------------------------------------------------------------------

X = np.zeros((3, 5, 3))


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"x": X[0]}, "must hold numbers x of shape"),
        ({"x": X[:0]}, "must hold numbers x of shape"),
        ({"x": X.astype(complex)}, "must hold numbers x of shape"),
        ({"x": X.astype("U1")}, "must hold numbers x of shape"),
        ({"x": X.astype(object)}, "must be an .npz file"),
        ({"y": X}, "must hold numbers x of shape"),
        ({"x": X, "frames": np.asarray(3)}, "one of `frames` per frame"),
        ({"x": X, "frames": np.asarray([0, 1, np.nan])}, "whole numbers `frames`"),
        ({"x": X, "frames": np.asarray([0, 1, 2.5])}, "whole numbers `frames`"),
        ({"x": X, "frames": np.asarray([0, 1, 2**62])}, "whole numbers `frames`"),
        ({"x": X, "frames": np.asarray([-1, 0, 1])}, "whole numbers `frames`"),
        ({"x": X, "frames": np.asarray(["a", "b", "c"])}, "whole numbers `frames`"),
        ({"x": X, "frames": np.zeros((3, 1), int)}, "whole numbers `frames`"),
        ({"x": X, "particles": np.asarray(["a"] * 5)}, "whole numbers `particles`"),
        ({"x": X, "particles": np.arange(5) - 1}, "whole numbers `particles`"),
        ({"x": X, "particles": np.arange(5) + 9}, "`particles` from 0 to 9"),
    ],
)
def test_wrong_tracks(folder, arrays, words):
    np.savez(folder / "wrong.npz", **arrays)
    with pytest.raises(SceneError, match=words):
        track(table(folder, file="wrong.npz"), 10, 2)


@fuzz(80)
@given(data=st.data())
def test_damaged_tracks(folder, data):
    stream = io.BytesIO()
    np.savez_compressed(stream, x=X, frames=np.arange(3), particles=np.arange(5))
    (folder / "damaged.npz").write_bytes(data.draw(damaged_bytes(stream.getvalue())))
    with refused(SceneError):
        track(table(folder, file="damaged.npz"), 10, 2)


def bomb(path, name, shape, size):
    """An .npz of zeros, compressed; what its array claims to be may be more."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}}}".encode().ljust(117)
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(f"{name}.npy", "w", force_zip64=True) as stream,
    ):
        stream.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header + b"\n")
        for _ in range(size >> 20):
            stream.write(bytes(1 << 20))


def test_a_zip_bomb_is_not_unpacked(folder):
    bomb(folder / "bomb.npz", "x", "(1, 3145728, 3)", 72 << 20)
    assert (folder / "bomb.npz").stat().st_size < 1 << 20
    with cheaply(), pytest.raises(SceneError, match="would take 75497600 bytes"):
        track(table(folder, file="bomb.npz"), 10, 2)


def test_arrays_of_other_names_are_left_alone(folder):
    bomb(folder / "bomb.npz", "other", "(9437184,)", 72 << 20)
    with zipfile.ZipFile(folder / "bomb.npz", "a") as archive:
        stream = io.BytesIO()
        np.save(stream, X)
        archive.writestr("x.npy", stream.getvalue())
    with cheaply():
        assert track(table(folder, file="bomb.npz"), 10, 2).x.shape == X.shape


def test_a_claim_of_terabytes_takes_none(folder):
    bomb(folder / "bomb.npz", "x", "(1000000000000, 5, 3)", 0)
    with cheaply(size=1 << 50), pytest.raises(SceneError, match=r"must be an \.npz file"):
        track(table(folder, file="bomb.npz"), 10, 2)


# --- Pictures and videos -------------------------------------------------------------------------


def png(width, height, body):
    """A grey PNG of any claimed size."""

    def chunk(kind, data):
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(body)) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(10_000, 8_000), (2**31 - 1, 2**31 - 1), (0, 5)])
def test_a_picture_of_another_size_is_not_unpacked(folder, size):
    (folder / "bombs").mkdir(exist_ok=True)
    (folder / "bombs" / "0.png").write_bytes(png(*size, bytes(1 << 20)))
    with cheaply(), pytest.raises(SceneError, match=r"0\.png cannot be used as a picture"):
        footage(table(folder, frames="bombs"), 25, 0, 3, SIZE)


@fuzz(60)
@given(data=st.data())
def test_damaged_pictures(folder, data):
    content = (folder / "film" / "001.png").read_bytes()
    (folder / "damaged.png").write_bytes(data.draw(damaged_bytes(content)))
    with refused(ValueError):
        load_image(folder / "damaged.png", SIZE)


@fuzz(6)
@given(data=st.data())
def test_damaged_videos(folder, data):
    content = (folder / "film.mp4").read_bytes()
    (folder / "damaged.mp4").write_bytes(data.draw(damaged_bytes(content)))
    with refused(ValueError):
        load_video(folder / "damaged.mp4", 5, SIZE)


def test_a_video_of_another_size_or_length(folder):
    with pytest.raises(SceneError, match=r"must have 16 × 16 pixels, .* but has 64 × 48"):
        footage(table(folder, video="film.mp4"), 25, 0, 3, (16, 16))
    with pytest.raises(SceneError, match="is too large: its content takes"):
        footage(table(folder, video="film.mp4"), 25, 0, 100_000, (16384, 16384))


def test_a_playlist_fetches_nothing(folder):
    (folder / "list.mp4").write_text("#EXTM3U\n#EXTINF:1,\nhttp://localhost:1/a.ts\n")
    with pytest.raises(ValueError, match="is not a video that ffmpeg can read"):
        load_video(folder / "list.mp4", 1)
