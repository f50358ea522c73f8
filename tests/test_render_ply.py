"""Files of captured Gaussians: round trips, and every way in which a file can be wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.render import Camera, Gaussians, deform, load_ply, render, save_ply
from pgjax.render.ply import columns, quaternions_of


def floats(array):
    return jnp.asarray(array, dtype=jnp.zeros(()).dtype)


def random_gaussians(n=30, k=16):
    rng = np.random.default_rng(0)
    parts = (
        rng.uniform(-1, 1, (n, 3)),
        rng.normal(size=(n, 4)),
        np.exp(rng.uniform(-8, -1, (n, 3))),
        rng.uniform(0, 1, n),
        0.3 * rng.normal(size=(n, k, 3)),
    )
    return Gaussians.from_scales(*map(floats, parts))


def ply_bytes(n=3, k=4, names=None, count=None, fill=None, kind="float"):
    """A small file in the expected layout; `fill` sets single values (row, column)."""
    names = names or columns(k)
    rng = np.random.default_rng(1)
    table = rng.uniform(-1, 1, (n, len(names))).astype("<f4" if kind == "float" else "<f8")
    for (row, name), value in (fill or {}).items():
        table[row, names.index(name)] = value
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {n if count is None else count}",
    ]
    header += [f"property {kind} {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode() + table.tobytes()


@pytest.fixture
def file(tmp_path):
    def write(content):
        (tmp_path / "scene.ply").write_bytes(content)
        return tmp_path / "scene.ply"

    return write


def assert_same(actual, expected, rtol=2e-6):
    assert len(actual) == len(expected)
    for name in ("means", "opacities", "sh"):
        ours, theirs = getattr(actual, name), getattr(expected, name)
        np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=rtol, err_msg=name)
    A = np.asarray(expected.covariances)
    size = np.trace(A, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(actual.covariances / size, A / size, atol=rtol)
    # Flat Gaussians stay as flat as they were.
    thin = [np.linalg.svd(np.asarray(g.factors))[1][:, 2] for g in (actual, expected)]
    np.testing.assert_allclose(*thin, rtol=1e-3)


# Reading what is there


def test_columns_become_activated_values(file):
    names = columns(4)
    content = ply_bytes(fill={(1, "opacity"): 0.0, (1, "scale_2"): np.log(3.0)})
    gaussians = load_ply(file(content))
    table = np.frombuffer(content[-3 * 4 * len(names) :], "<f4").reshape(3, -1)
    row = dict(zip(names, table[1], strict=True))
    assert (len(gaussians), gaussians.degree) == (3, 1)
    np.testing.assert_allclose(gaussians.means[1], [row["x"], row["y"], row["z"]], rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacities[1], 0.5, rtol=1e-6)
    # f_rest holds all of red, then all of green, then all of blue.
    green = [row["f_dc_1"], *(row[f"f_rest_{i}"] for i in (3, 4, 5))]
    np.testing.assert_allclose(gaussians.sh[1, :, 1], green, rtol=1e-6)
    q = [row[f"rot_{i}"] for i in range(4)]
    R = Rotation.from_quat(q, scalar_first=True).as_matrix()
    scales = np.exp([row[f"scale_{i}"] for i in range(3)])
    np.testing.assert_allclose(gaussians.factors[1], R * scales, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(gaussians.frames, np.tile(np.eye(3), (3, 1, 1)))


def test_text_doubles_and_other_orders_are_read(file, tmp_path):
    expected = load_ply(file(ply_bytes()))
    table = np.frombuffer(ply_bytes()[-3 * 4 * 26 :], "<f4").reshape(3, 26)
    order = np.random.default_rng(2).permutation(26)
    names = [columns(4)[i] for i in order]
    rows = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in table[:, order])
    properties = "\n".join(f"property double {name}" for name in names)
    text = f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}\nend_header\n{rows}\n"
    (tmp_path / "text.ply").write_text(text)
    assert_same(load_ply(tmp_path / "text.ply"), expected, rtol=1e-7)


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_round_trip(tmp_path, k):
    gaussians = random_gaussians(k=k)
    save_ply(tmp_path / "a.ply", gaussians)
    first = load_ply(tmp_path / "a.ply")
    assert_same(first, gaussians)
    save_ply(tmp_path / "b.ply", first)
    assert_same(load_ply(tmp_path / "b.ply"), first)
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0].decode().splitlines()
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 30"]
    assert header[3:] == [f"property float {name}" for name in columns(k)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.ply"]


@pytest.mark.parametrize("name", ["pc_short", "playbot_1873", "train3pts"])
def test_captures_survive_a_round_trip(reference_data, tmp_path, name):
    gaussians = load_ply(reference_data / "splats" / f"{name}.ply")
    save_ply(tmp_path / "a.ply", gaussians)
    assert_same(load_ply(tmp_path / "a.ply"), gaussians)


def test_opacities_at_the_ends_survive(tmp_path):
    gaussians = random_gaussians(n=2)
    ends = Gaussians(
        gaussians.means, gaussians.factors, floats([0, 1]), gaussians.sh, gaussians.frames
    )
    save_ply(tmp_path / "a.ply", ends)
    np.testing.assert_allclose(load_ply(tmp_path / "a.ply").opacities, [0, 1], atol=1e-20)


def test_a_deformed_scene_looks_the_same_from_its_file(tmp_path):
    gaussians = random_gaussians()
    F = np.eye(3) + 0.4 * np.random.default_rng(3).normal(size=(30, 3, 3))
    moved = deform(gaussians, gaussians.means + 0.1, floats(F))
    assert np.abs(np.asarray(moved.frames) - np.eye(3)).max() > 0.5
    save_ply(tmp_path / "a.ply", moved)
    camera = Camera.look_at([0, 0, -4], [0, 0, 0], up=[0, -1, 0], focal=60, width=40, height=40)
    ours, theirs = render(load_ply(tmp_path / "a.ply"), camera).rgb, render(moved, camera).rgb
    error = np.abs(ours - theirs).max(axis=-1)
    # The cutoff at 1/255 is a jump: a rounding may move it across a pixel.
    assert np.quantile(error, 0.99) < 2e-5
    assert error.max() < 0.01


def test_quaternions_of_all_rotations():
    q = np.concatenate([np.eye(4), np.random.default_rng(0).normal(size=(200, 4))])
    R = Rotation.from_quat(q, scalar_first=True)
    expected = R.as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(quaternions_of(R.as_matrix()), expected, atol=1e-14)


# Files that are wrong


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"solid cube\n", "is not a .ply"),
        (b"", "is not a .ply"),
        (b"ply\nformat binary_little_endian 1.0\nelement", "its header has no end"),
        (b"ply\nproperty float x\nend_header\n", "broken header line: 'property float x'"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "broken header line"),
        (b"ply\nelement face 0\nend_header\n", "holds no Gaussians"),
        (ply_bytes(n=0), "holds no Gaussians"),
        (ply_bytes()[:-10], r"truncated .* 3 vertex, which take 312 bytes, but only 302 follow"),
        (ply_bytes(count=10**15), "declares 1000000000000000 vertex"),
        (ply_bytes(count=-1), "declares -1 rows"),
        (ply_bytes(names=columns(4)[:-2]), "lacks the columns `rot_2`, `rot_3`"),
        (
            ply_bytes(names=[n.replace("opacity", "opacities") for n in columns(1)]),
            r"lacks the columns `opacity` \(is it `opacities`\?\)",
        ),
        (ply_bytes(names=[*columns(4), "f_rest_9"]), "must have 0, 9, 24 or 45 columns"),
        (ply_bytes(names=["x", "y", "z", "red", "green", "blue"]), "lacks the columns `f_dc_0`"),
        (ply_bytes(names=["packed_position", "packed_color"]), "compressed layout of PlayCanvas"),
        (ply_bytes().replace(b"float opacity", b"list uchar float opacity"), "one number per"),
        (ply_bytes().replace(b"float opacity", b"quux opacity"), "one number per Gaussian"),
        (ply_bytes().replace(b"1.0", b"2.0"), "cannot be read as .ply"),
        (ply_bytes(fill={(i, "x"): np.nan for i in range(3)}), "no usable Gaussians: all 3"),
    ],
)
def test_wrong_files_are_refused(file, content, message):
    path = file(content)
    with pytest.raises(ValueError, match=message) as error:
        load_ply(path)
    assert "scene.ply" in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    for path in (tmp_path / "missing.ply", tmp_path):
        with pytest.raises(ValueError, match=f"There is no file .*{path.name}"):
            load_ply(path)


def test_the_compressed_capture_is_handed_over(reference_data):
    assert len(load_ply(reference_data / "splats" / "guitar.compressed.ply")) == 90854


def test_broken_gaussians_are_left_out_and_counted(file):
    fill = {(0, "y"): np.nan, (1, "scale_0"): 1e4, (2, "opacity"): np.inf, (3, "f_rest_2"): -np.inf}
    fill |= {(4, f"rot_{i}"): 0.0 for i in range(4)}
    path = file(ply_bytes(n=7, fill=fill))
    with pytest.warns(UserWarning, match="5 of the 7 Gaussians in .*scene.ply"):
        gaussians = load_ply(path)
    assert len(gaussians) == 2
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaussians))


# Failures to write


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    gaussians = random_gaussians(n=4)
    save_ply(tmp_path / "a.ply", gaussians)
    before = (tmp_path / "a.ply").read_bytes()

    def fail(_, path):
        with open(path, "w") as stream:
            stream.write("half")
        raise OSError("no space left on device")

    monkeypatch.setattr("pgjax.render.ply.PlyData.write", fail)
    with pytest.raises(OSError, match="no space left"):
        save_ply(tmp_path / "a.ply", gaussians)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    assert (tmp_path / "a.ply").read_bytes() == before


def test_what_cannot_be_written_is_refused(tmp_path):
    gaussians = random_gaussians(n=4)
    with pytest.raises(ValueError, match="must hold at least one Gaussian"):
        save_ply(tmp_path / "a.ply", gaussians[:0])
    with pytest.raises(ValueError, match="must lie in an existing folder"):
        save_ply(tmp_path / "missing" / "a.ply", gaussians)
    broken = deform(gaussians, gaussians.means, gaussians.factors.at[0, 0, 0].set(jnp.nan))
    with pytest.raises(ValueError, match="must be finite, but 1 of 4 are not"):
        save_ply(tmp_path / "a.ply", broken)
    assert not list(tmp_path.iterdir())
