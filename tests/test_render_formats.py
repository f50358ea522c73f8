"""Gaussians in compressed `.ply`, `.splat` and `.spz`, against encoders written here."""

import gzip
import math
import struct
import tracemalloc

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.render import load_capture, load_gaussians, load_ply, save_ply
from pgjax.render.harmonics import basis

HALF_TURN = np.array([1.0, -1.0, -1.0])
Y0 = math.sqrt(1 / (4 * math.pi))


def zipped(data):
    """A gzip stream without the time, so that the same bytes name the same test everywhere."""
    return gzip.compress(data, mtime=0)


def scene(n=6, k=16, seed=0):
    """Means, quaternions wxyz (each component is the largest of some), log scales, colours, …"""
    rng = np.random.default_rng(seed)
    q = 0.4 * rng.uniform(-1, 1, (n, 4))
    q[np.arange(n), np.arange(n) % 4] = np.where(np.arange(n) % 3, 1.0, -1.0)
    return {
        "means": rng.uniform(-3, 3, (n, 3)),
        "quaternions": q / np.linalg.norm(q, axis=1, keepdims=True),
        "logs": rng.uniform(-6, -1, (n, 3)),
        "opacities": rng.uniform(0, 1, n),
        "rgb": rng.uniform(0, 1, (n, 3)),
        "rest": rng.uniform(-0.9, 0.9, (n, k - 1, 3)),
    }


def covariances(quaternions, logs):
    R = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    return np.einsum("nij,nj,nkj->nik", R, np.exp(2 * logs), R)


def directions(n=50):
    d = np.random.default_rng(5).normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def colours(sh, d):
    """Colour less 1/2 of each Gaussian along each direction, of shape (n, directions, 3)."""
    sh = np.asarray(sh, dtype=np.float64)
    return np.einsum("dk,nkc->ndc", basis(d, math.isqrt(sh.shape[1]) - 1), sh)


def write(folder, name, content):
    (folder / name).write_bytes(content)
    return folder / name


def assert_covariances(gaussians, expected, rtol):
    size = np.trace(expected, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(gaussians.covariances / size, expected / size, atol=rtol)


# Compressed .ply


def pack(fractions, widths):
    word = 0
    for fraction, width in zip(fractions, widths, strict=True):
        word = word << width | round(float(fraction) * (2**width - 1))
    return word


def packed_rotation(q):
    largest = int(np.argmax(np.abs(q)))
    q = q * np.sign(q[largest])
    others = [q[i] / math.sqrt(2) + 0.5 for i in range(4) if i != largest]
    return largest << 30 | pack(others, (10, 10, 10))


def compressed_ply(s, colour_bounds=True, chunk_kind="float", chunks=None, rest_names=None):
    """The bytes of a file in PlayCanvas' layout, encoded one Gaussian at a time."""
    n = len(s["means"])
    axes = [f"{end}_{name}" for end in ("min", "max") for name in "xyz"]
    axes += [f"{end}_scale_{name}" for end in ("min", "max") for name in "xyz"]
    axes += [f"{end}_{name}" for end in ("min", "max") for name in "rgb"] if colour_bounds else []
    values = [s["means"], s["logs"]] + ([s["rgb"]] if colour_bounds else [])
    bounds, words = b"", b""
    for start in range(0, n, 256):
        rows = slice(start, start + 256)
        low = [v[rows].min(axis=0) for v in values]
        high = [v[rows].max(axis=0) for v in values]
        ends = np.concatenate([np.concatenate(pair) for pair in zip(low, high, strict=True)])
        bounds += ends.astype("<f4").tobytes()
        for i in range(*rows.indices(n)):
            fractions = [
                (v[i] - a) / (b - a) for v, a, b in zip(values, low, high, strict=True)
            ] + ([] if colour_bounds else [s["rgb"][i]])
            words += struct.pack(
                "<4I",
                pack(fractions[0], (11, 10, 11)),
                packed_rotation(s["quaternions"][i]),
                pack(fractions[1], (11, 10, 11)),
                pack([*fractions[2], s["opacities"][i]], (8, 8, 8, 8)),
            )
    rest = s["rest"].transpose(0, 2, 1).reshape(n, -1)
    sh = np.clip((rest / 8 + 0.5) * 256, 0, 255).astype(np.uint8)
    packed = ("position", "rotation", "scale", "color")
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"element chunk {-(-n // 256) if chunks is None else chunks}"]
    header += [f"property {chunk_kind} {name}" for name in axes]
    header += [f"element vertex {n}"] + [f"property uint packed_{name}" for name in packed]
    if rest.shape[1]:
        names = rest_names or [f"f_rest_{i}" for i in range(rest.shape[1])]
        header += [f"element sh {n}"] + [f"property uchar {name}" for name in names]
    return "\n".join([*header, "end_header", ""]).encode() + bounds + words + sh.tobytes()


@pytest.mark.parametrize("k", [1, 4, 9, 16])
@pytest.mark.parametrize("colour_bounds", [True, False])
def test_compressed_ply(tmp_path, k, colour_bounds):
    s = scene(n=259, k=k)
    path = write(tmp_path, "a.compressed.ply", compressed_ply(s, colour_bounds))
    gaussians = load_gaussians(path)
    # Half a step of 11 (y: 10) bits between the bounds; both chunks are narrower than 6.
    error = np.abs(np.asarray(gaussians.means) - s["means"]).max(axis=0)
    assert (error < 1.01 * 3 / np.array([2047, 1023, 2047])).all()
    np.testing.assert_allclose(gaussians.opacities, s["opacities"], atol=0.51 / 255)
    assert_covariances(gaussians, covariances(s["quaternions"], s["logs"]), 0.012)
    assert gaussians.sh.shape == (259, k, 3)
    np.testing.assert_allclose(Y0 * gaussians.sh[:, 0] + 0.5, s["rgb"], atol=0.51 / 255)
    np.testing.assert_allclose(gaussians.sh[:, 1:], s["rest"], atol=4.01 / 256)
    d = directions()
    expected = np.concatenate([((s["rgb"] - 0.5) / Y0)[:, None], s["rest"]], axis=1)
    # Steps of 1/32 in k coefficients, whose functions have the mean square 1/(4π).
    error = np.sqrt(np.mean((colours(gaussians.sh, d) - colours(expected, d)) ** 2))
    assert error < 0.01 * math.sqrt(k)


def test_compressed_ply_keeps_what_its_bounds_hold(tmp_path):
    """The ends of the ranges and the opacities 0 and 1 come back as they were."""
    s = scene(n=2, k=4)
    s["opacities"] = np.array([0.0, 1.0])
    s["rest"][0], s["rest"][1] = -4.0, 4.0
    gaussians = load_gaussians(write(tmp_path, "a.ply", compressed_ply(s)))
    # In float32 the bounds; all of x, y and z of two Gaussians are bounds.
    np.testing.assert_allclose(gaussians.means, s["means"], rtol=3e-7)
    np.testing.assert_allclose(Y0 * gaussians.sh[:, 0] + 0.5, s["rgb"], rtol=1e-6)
    np.testing.assert_array_equal(gaussians.opacities, [0, 1])
    # -4 and 4 are the outermost bytes.
    np.testing.assert_allclose(gaussians.sh[:, 1:], s["rest"], rtol=1e-6)


def test_the_compressed_capture(reference_data):
    gaussians = load_gaussians(reference_data / "splats" / "guitar.compressed.ply")
    assert (len(gaussians), gaussians.degree) == (90854, 0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaussians))
    # It stands upright (along y), with the heavy body at the bottom (y is down).
    solid = np.asarray(gaussians.means)[np.asarray(gaussians.opacities) > 0.5]
    low, middle, high = np.percentile(solid, [1, 50, 99], axis=0)
    assert high[1] - low[1] > 2 * max(high[0] - low[0], high[2] - low[2])
    assert high[1] - middle[1] < middle[1] - low[1]


def test_three_formats_hold_the_same_gaussians(reference_data):
    folder = reference_data / "splats"
    ply, splat, spz = (load_gaussians(folder / f"train3pts.{s}") for s in ("ply", "splat", "spz"))
    np.testing.assert_array_equal(splat.means, ply.means)
    np.testing.assert_allclose(spz.means, ply.means, atol=0.51 / 4096)
    for other, scale_error in ((splat, 0.02), (spz, 1 / 16)):
        np.testing.assert_allclose(other.opacities, ply.opacities, atol=1.01 / 255)
        np.testing.assert_allclose(other.sh[:, 0], ply.sh[:, 0], atol=1.01 / 255 / 0.15)
        assert_covariances(other, np.asarray(ply.covariances), scale_error)
    # The writer kept degree 1 to 1/16, the others to 1/8, and the signs of the half turn show.
    ours, theirs = np.asarray(spz.sh[:, 1:]), np.asarray(ply.sh[:, 1:])
    np.testing.assert_allclose(ours, theirs, atol=0.0665)
    clear = np.abs(ours) > 0.06
    assert clear.sum() > 10
    assert (np.sign(ours[clear]) == np.sign(theirs[clear])).all()


# .splat


def splat_bytes(s):
    def byte(value):
        return round(float(np.clip(value, 0, 255)))

    content = b""
    for i in range(len(s["means"])):
        content += struct.pack("<6f", *s["means"][i], *np.exp(s["logs"][i]))
        content += bytes(byte(255 * c) for c in [*s["rgb"][i], s["opacities"][i]])
        content += bytes(byte(128 + 128 * q) for q in s["quaternions"][i])
    return content


def test_splat(tmp_path):
    s = scene(k=1)
    gaussians = load_gaussians(write(tmp_path, "a.splat", splat_bytes(s)))
    np.testing.assert_allclose(gaussians.means, s["means"], rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, s["opacities"], atol=0.51 / 255)
    np.testing.assert_allclose(Y0 * gaussians.sh[:, 0] + 0.5, s["rgb"], atol=0.51 / 255)
    assert gaussians.degree == 0
    assert_covariances(gaussians, covariances(s["quaternions"], s["logs"]), 0.02)


# .spz


def spz_raw(s, version=3, degree=None, flags=0, count=None, bits=12):
    """The content of an `.spz` before gzip; s is in the axes of the file."""
    n, k = len(s["means"]), s["rest"].shape[1] + 1
    header = (version, n if count is None else count)
    degree = math.isqrt(k) - 1 if degree is None else degree
    content = b"NGSP" + struct.pack("<IIBBBB", *header, degree, bits, flags, 0)
    for x in s["means"].reshape(-1):
        fixed = round(float(x) * 2**bits) if version > 1 else 0
        content += struct.pack("<e", x) if version == 1 else struct.pack("<i", fixed)[:3]
    content += bytes(round(255 * float(a)) for a in s["opacities"])
    dc = (s["rgb"] - 0.5) / Y0
    content += bytes(round(255 * (0.15 * float(c) + 0.5)) for c in dc.reshape(-1))
    content += bytes(round(16 * (float(a) + 10)) for a in s["logs"].reshape(-1))
    for w, x, y, z in s["quaternions"]:
        content += spz_word((x, y, z, w)) if version == 3 else spz_triple(w, (x, y, z))
    return content + bytes(round(128 + 128 * float(c)) for c in s["rest"].reshape(-1))


def spz_triple(w, xyz):
    return bytes(round(127.5 * (1 + math.copysign(1, w) * float(a))) for a in xyz)


def spz_word(xyzw):
    largest = max(range(4), key=lambda i: abs(xyzw[i]))
    word = largest
    for i in range(4):
        if i != largest:
            negative = (xyzw[i] < 0) != (xyzw[largest] < 0)
            word = word << 10 | negative << 9 | round(511 * abs(float(xyzw[i])) * math.sqrt(2))
    return struct.pack("<I", word)


@pytest.mark.parametrize(
    ("version", "k"), [(1, 1), (2, 4), (2, 16), (3, 1), (3, 4), (3, 9), (3, 16)]
)
def test_spz(tmp_path, version, k):
    s = scene(n=8, k=k)
    gaussians = load_gaussians(write(tmp_path, "a.spz", zipped(spz_raw(s, version))))
    # x right, y up, z back becomes x right, y down, z front.
    step = 0.51 / 4096 if version > 1 else 2e-3
    np.testing.assert_allclose(gaussians.means, HALF_TURN * s["means"], atol=step)
    np.testing.assert_allclose(gaussians.opacities, s["opacities"], atol=0.51 / 255)
    A = covariances(s["quaternions"], np.round(16 * s["logs"]) / 16)
    # A quaternion without w is poor where w is small.
    turned = HALF_TURN[:, None] * A * HALF_TURN
    assert_covariances(gaussians, turned, 0.006 if version == 3 else 0.06)
    dc = (s["rgb"] - 0.5) / Y0
    np.testing.assert_allclose(gaussians.sh[:, 0], dc, atol=0.51 / 255 / 0.15)
    # What is seen along d in the world is seen along the turned d in the file.
    file_sh = np.concatenate([dc[:, None], np.round(128 * s["rest"]) / 128], axis=1)
    d = directions()
    np.testing.assert_allclose(
        colours(gaussians.sh, d),
        colours(file_sh, d * HALF_TURN),
        atol=0.51 * Y0 / 255 / 0.15 + 1e-6,
    )


def test_spz_of_other_precision_and_with_antialiasing(tmp_path):
    s = scene(k=1)
    raw = spz_raw(s, bits=20, flags=1)
    with pytest.warns(UserWarning, match="trained with antialiasing"):
        gaussians = load_gaussians(write(tmp_path, "a.spz", zipped(raw)))
    np.testing.assert_allclose(gaussians.means, HALF_TURN * s["means"], atol=1e-6)


# Which format it is


def test_content_tells_the_format_where_the_suffix_does_not(tmp_path):
    s = scene(k=4)
    raw = zipped(spz_raw(s))
    expected = load_gaussians(write(tmp_path, "a.SPZ", raw))
    actual = load_gaussians(write(tmp_path, "b.bin", raw))
    np.testing.assert_array_equal(actual.means, expected.means)
    save_ply(tmp_path / "a.ply", expected)
    for name in ("b.PLY", "b.dat"):
        again = load_gaussians(write(tmp_path, name, (tmp_path / "a.ply").read_bytes()))
        np.testing.assert_allclose(again.means, expected.means, rtol=1e-6)


@pytest.mark.parametrize("content", [b"", b"solid", b"\x00" * 64])
def test_an_unknown_format_names_those_that_can_be_read(tmp_path, content):
    with pytest.raises(ValueError, match=r"no known format.*'.obj'.*\.ply .*\.splat and \.spz"):
        load_gaussians(write(tmp_path, "a.obj", content))
    with pytest.raises(ValueError, match=r"There is no file .*missing.spz"):
        load_gaussians(tmp_path / "missing.spz")


# Files that are wrong


def altered(old, new):
    return compressed_ply(scene()).replace(old, new)


def without_crc(raw):
    return zipped(raw)[:-5] + b"12345"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.splat", b"", "positive multiple of 32 bytes, but holds 0"),
        ("a.splat", bytes(95), "positive multiple of 32 bytes, but holds 95"),
        (
            "a.splat",
            struct.pack("<6f", 0, 0, 0, 1, -1, 1) + bytes(8),
            "1 of its 1 records have neg",
        ),
        ("a.splat", bytes(24) + b"\0\0\0\0\x80\x80\x80\x80", "no usable Gaussians: all 1"),
        ("a.spz", b"", "not an .spz"),
        ("a.spz", b"garbage of no kind", "cannot be read as .spz"),
        ("a.spz", zipped(b"NGSP"), "not an .spz"),
        ("a.spz", zipped(bytes(400)), "not an .spz"),
        ("a.spz", b"NGSP" + struct.pack("<I", 4) + bytes(30), "version 4 that is not a gzip"),
        ("a.spz", zipped(spz_raw(scene(), version=4)), "1, 2 or 3, but has version 4"),
        ("a.spz", zipped(spz_raw(scene(), version=0)), "1, 2 or 3, but has version 0"),
        ("a.spz", zipped(spz_raw(scene(), degree=4)), "degree 0 to 3, but has degree 4"),
        ("a.spz", zipped(spz_raw(scene(), flags=2)), "has extensions"),
        ("a.spz", zipped(spz_raw(scene(), count=0)), "holds no Gaussians"),
        ("a.spz", zipped(spz_raw(scene(), count=7)), "truncated: it declares 7"),
        ("a.spz", zipped(spz_raw(scene(), count=5)), "goes on after the 5 Gaussians"),
        ("a.spz", zipped(spz_raw(scene()))[:-30], "truncated: it declares 6"),
        ("a.spz", zipped(spz_raw(scene()))[:-4], "truncated: it declares 6"),
        ("a.spz", without_crc(spz_raw(scene())), "cannot be read as .spz: .*incorrect data check"),
        ("a.spz", zipped(spz_raw(scene(), count=2**32 - 1)), "4294967295 Gauss.* expand to"),
        ("a.ply", compressed_ply(scene(258), chunks=1), "2 rows of 'chunk' for 258 Gauss.* has 1"),
        ("a.ply", compressed_ply(scene())[:-1], "is truncated or its header is wrong"),
        ("a.ply", compressed_ply(scene(k=6)), "9, 24 or 45 columns in its element 'sh'.*has 15"),
        ("a.ply", compressed_ply(scene(), chunk_kind="int"), "type float in its element 'chunk'"),
        ("a.ply", altered(b"d_scale", b"d_sized"), "lacks the columns `packed_scale`"),
        ("a.ply", altered(b"float max_g", b"float max_a"), "'chunk' lacks the columns `max_g`"),
        ("a.ply", altered(b"element chunk", b"element lumps"), "'chunk' lacks the columns `min_x`"),
        (
            "a.ply",
            compressed_ply(scene(k=4), rest_names=[f"f_rest_{i}" for i in range(1, 10)]),
            "'sh' lacks the columns `f_rest_0`",
        ),
        (
            "a.ply",
            altered(b"element sh 6", b"element sh 5"),
            "must have 6 rows of 'sh' for 6 Gaussians, but has 5",
        ),
        (
            "a.ply",
            altered(b"element vertex 6", b"element vertex 9999999"),
            "1 chunk, 9999999 vertex",
        ),
    ],
)
def test_wrong_files_are_refused(tmp_path, name, content, message):
    path = write(tmp_path, name, content)
    with pytest.raises(ValueError, match=message) as error:
        load_gaussians(path)
    assert name in str(error.value)


def test_a_gzip_bomb_takes_no_memory(tmp_path):
    raw = spz_raw(scene())
    path = write(tmp_path, "a.spz", gzip.compress(raw + bytes(64 << 20), compresslevel=1))
    assert path.stat().st_size < 1 << 20
    tracemalloc.start()
    with pytest.raises(ValueError, match="goes on after the 6 Gaussians"):
        load_gaussians(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 << 20


def test_broken_gaussians_are_left_out_and_counted(tmp_path):
    s = scene(n=4, k=1)
    s["means"][1, 2] = np.nan
    records = bytearray(splat_bytes(s))
    records[3 * 32 - 4 : 3 * 32] = bytes([128] * 4)
    far = scene(n=258, k=1)
    chunks = bytearray(compressed_ply(far))
    start = chunks.index(b"end_header\n") + len(b"end_header\n")
    # max_scale_x of the second chunk, which holds two Gaussians.
    chunks[start + 72 + 36 : start + 72 + 40] = struct.pack("<f", np.inf)
    for name, content, left, n in [
        ("a.splat", bytes(records), 2, 4),
        ("a.spz", zipped(spz_raw(s, version=1)), 1, 4),
        ("a.ply", bytes(chunks), 2, 258),
    ]:
        path = write(tmp_path, name, content)
        with pytest.warns(UserWarning, match=f"{left} of the {n} Gaussians in .*{name}"):
            gaussians = load_gaussians(path)
        assert len(gaussians) == n - left
        with pytest.warns(UserWarning, match=f"{left} of the {n}"):
            capture = load_capture(path)
        assert capture.total == n
        np.testing.assert_array_equal(capture.gaussians.means, gaussians.means)
        if name == "a.splat":
            np.testing.assert_array_equal(capture.rows, [0, 3])
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaussians))
    with pytest.warns(UserWarning, match="2 of the 258"):
        load_ply(path)
