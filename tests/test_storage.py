"""States and trajectories on disk: exact, complete or not at all, and never trusted."""

import io
import os
import pathlib
import re
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from pgjax.storage import load_state, load_trajectory, save_state, save_trajectory

JELLY = pm.Material(pm.NeoHookean(2e4, 0.2), density=500.0)
METAL = pm.Material(pm.StVKHencky(1e4, 0.3), pm.VonMises(20.0, hardening=0.1), density=1000.0)
SAND = pm.Material(pm.StVKHencky(1e4, 0.3), pm.DruckerPrager(30.0), density=1000.0)
DT, SUBSTEPS = 1e-3, 5


def scene_of(materials=JELLY, n=10, d=2, origin=-0.2, **kwargs):
    grid = pgjax.Grid([origin] * d, (12,) * d, 0.1)
    return pgjax.Scene(grid, materials, np.full(n, 1e-3), **kwargs)


def started(scene, dtype=None):
    rng = np.random.default_rng(1)
    shape = (scene.particle_count, scene.grid.dimension)
    x = 0.2 + 0.3 * rng.random(shape)
    return pgjax.initial_state(scene, x, rng.normal(size=shape), dtype=dtype)


def rolled(scene, state, frames):
    return pgjax.simulate(scene, state, dt=DT, frames=frames, substeps=SUBSTEPS)


def assert_same(a, b):
    """Structure, dtypes and every bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        assert x.shape == y.shape
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


# --- What comes back is what was saved -----------------------------------------------------------

DTYPES = ["float32", pytest.param("float64", marks=pytest.mark.float64)]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: scene_of(), id="elastic, 2-D"),
        pytest.param(lambda: scene_of([METAL, JELLY], counts=(6, 4)), id="history and none, 2-D"),
        pytest.param(
            lambda: scene_of([SAND, METAL], d=3, counts=(4, 6)),
            id="flowing, 3-D",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            lambda: scene_of([METAL, JELLY], d=3, counts=(6, 4)),
            id="history and none, 3-D",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_going_on_from_a_file_changes_no_bit(tmp_path, make, dtype):
    scene = make()
    state = started(scene, dtype)
    whole = rolled(scene, state, 10)
    first = rolled(scene, state, 4)
    save_state(tmp_path / "state.npz", first.final)
    loaded = load_state(tmp_path / "state.npz", scene)
    assert_same(loaded, first.final)
    rest = rolled(scene, loaded, 6)
    assert_same(rest.final, whole.final)
    assert_same(rest.saved, jax.tree.map(lambda a: a[4:], whole.saved))
    assert_same(rest.t, whole.t[4:])
    if scene.is_plastic:
        assert any(h is not None and float(jnp.max(h)) > 0 for h in whole.final.history)


def test_masked_particles_and_the_status_stay(tmp_path):
    scene = scene_of()
    state = started(scene)
    state = pgjax.initial_state(scene, state.x, state.v.at[3].set(2e3))
    lost = pgjax.simulate(scene, state, dt=DT, frames=1, substeps=2, throw=False).final
    assert not lost.status.ok
    save_state(tmp_path / "lost.npz", lost)
    assert_same(load_state(tmp_path / "lost.npz", scene), lost)


def test_numpy_reads_a_state(tmp_path):
    scene = scene_of([METAL, JELLY], counts=(6, 4))
    state = started(scene)
    save_state(tmp_path / "state.npz", state)
    with np.load(tmp_path / "state.npz", allow_pickle=False) as file:
        assert str(file["format"]) == "pgjax state 1"
        assert file["history.0"].shape == (6,)
        assert "history.1" not in file
        np.testing.assert_array_equal(file["position"], state.position)


def test_a_trajectory_comes_back_by_name(tmp_path):
    scene = scene_of(n=7)
    trajectory = rolled(scene, started(scene), 3)
    save_trajectory(tmp_path / "t.npz", trajectory)
    read = load_trajectory(tmp_path / "t.npz")
    assert set(read) == {"t", "x", "v", "F", "status.first", "status.count"}
    for name in ("x", "v", "F"):
        assert_same(read[name], getattr(trajectory.saved, name))
    assert_same(read["t"], trajectory.t)
    assert_same(read["status.count"], trajectory.status.count)


@pytest.mark.parametrize(
    ("save", "names"),
    [
        (lambda s: {"energy": {"kinetic": jnp.sum(s.v**2)}, "alive": s.alive, "no": None},
         {"energy.kinetic", "alive"}),
        (lambda s: (s.step, [s.v]), {"0", "1.0"}),
        (lambda s: s.x, {"saved"}),
        (lambda s: {"t": s.step, "format": s.step, "../x y": s.step},
         {"saved.t", "saved.format", ".._x_y"}),
        (lambda _: None, set()),
    ],
)  # fmt: skip
def test_names_of_any_tree(tmp_path, save, names):
    scene = scene_of()
    trajectory = pgjax.simulate(
        scene, started(scene), dt=DT, frames=2, substeps=1, save=save, throw=False
    )
    save_trajectory(tmp_path / "t.npz", trajectory)
    read = load_trajectory(tmp_path / "t.npz")
    assert set(read) - {"t", "status.first", "status.count"} == names
    leaves = jax.tree.leaves(trajectory.saved)
    kept = [a for name, a in read.items() if name in names]
    assert sum(a.nbytes for a in kept) == sum(a.nbytes for a in leaves)


# --- What cannot be saved ------------------------------------------------------------------------


def test_tracers_batches_and_clashes_are_refused(tmp_path):
    scene = scene_of()
    state = started(scene)
    path = tmp_path / "a.npz"

    def traced(v):
        save_state(path, pgjax.initial_state(scene, state.x, v))
        return v

    with pytest.raises(
        ValueError, match=r"`state` must hold numbers, but `position` is being traced"
    ):
        jax.jit(traced)(state.v)

    def rollout(v):
        return rolled(scene, pgjax.initial_state(scene, state.x, v), 1)

    batch = jax.vmap(rollout)(jnp.stack([state.v, -state.v]))
    with pytest.raises(ValueError, match=r"must be one state .* is a batch .*\(2, 10, 2\)"):
        save_state(path, batch.final)
    with pytest.raises(ValueError, match=r"must be one rollout .* is a batch"):
        save_trajectory(path, batch)

    def with_saved(saved):
        whole = rolled(scene, state, 1)
        return pgjax.Trajectory(saved, whole.t, whole.final, whole.status)

    two = jnp.zeros(2)
    with pytest.raises(ValueError, match=r"two are called `a\.b`"):
        save_trajectory(path, with_saved({"a": {"b": two}, "a.b": two}))
    with pytest.raises(ValueError, match="`c` is bfloat16: convert it first"):
        save_trajectory(path, with_saved({"c": two.astype(jnp.bfloat16)}))
    with pytest.raises(ValueError, match="`c` is key<"):
        save_trajectory(path, with_saved({"c": jax.random.split(jax.random.key(0))}))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.npy", "must end with .npz, but is 'a.npy'"),
        ("none/a.npz", "must lie in an existing folder"),
        ("folder.npz", "is a folder"),
    ],
)
def test_bad_paths_are_refused(tmp_path, name, message):
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(ValueError, match=re.escape(message)):
        save_state(tmp_path / name, started(scene_of()))


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    scene = scene_of()
    state = started(scene)
    path = tmp_path / "state.npz"
    save_state(path, state)
    before = path.read_bytes()
    calls = []

    def full(stream, array, **kwargs):
        del kwargs
        calls.append(stream)
        if len(calls) == 4:
            raise OSError(28, "No space left on device")
        return write_array(stream, array, allow_pickle=False)

    write_array = np.lib.format.write_array
    monkeypatch.setattr(np.lib.format, "write_array", full)
    with pytest.raises(OSError, match="No space left"):
        save_state(path, rolled(scene, state, 1).final)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]


def test_all_of_it_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    """The order decides what a loss of power can do."""
    events = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (events.append("fsync"), fsync(fd)))
    monkeypatch.setattr(os, "replace", lambda a, b: (events.append("replace"), replace(a, b)))
    save_state(tmp_path / "state.npz", started(scene_of()))
    assert events == ["fsync", "replace", "fsync"]


# --- What must not be taken for a state ----------------------------------------------------------


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "state.npz"
    save_state(path, started(scene_of([METAL, JELLY], counts=(6, 4))))
    return path


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: scene_of(n=11), "must hold the 11 particles of the scene, but holds 10"),
        (lambda: scene_of(d=3), "must be of a scene in 3 dimensions, but is of one in 2"),
        (lambda: scene_of(), "has `H`, `history.0` (the total `H` is kept where a material flows"),
        (lambda: scene_of([METAL, METAL], counts=(6, 4)), "lacks `history.1`"),
        (lambda: scene_of([SAND, JELLY], counts=(6, 4)), "has `history.0` (`history` is what a"),
        (lambda: scene_of([METAL, JELLY], counts=(5, 5)),
         "must have `history.0` of shape (5,) and type float"),
        (lambda: scene_of([METAL, JELLY], counts=(6, 4), origin=-0.1),
         "must be of a grid with the origin [-0.1 -0.1], but is of one with [-0.2 -0.2]"),
    ],
)  # fmt: skip
def test_a_state_of_another_scene_is_refused(saved, make, message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        load_state(saved, make())
    assert str(error.value).startswith(f"The file {saved} must ")


@pytest.mark.float64
def test_double_precision_is_refused_where_it_is_off(saved):
    scene = scene_of([METAL, JELLY], counts=(6, 4))
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match="must be in float32 unless double precision"):
            load_state(saved, scene)
    finally:
        jax.config.update("jax_enable_x64", True)


def members(path):
    with np.load(path) as file:
        return dict(file)


def npy(array, **kwargs):
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array), **kwargs)
    return stream.getvalue()


def rewritten(path, changes=(), *, compression=zipfile.ZIP_STORED):
    """The file with some members replaced by other arrays or raw bytes, or left out (None)."""
    new = path.with_name("changed.npz")
    contents = members(path) | dict(changes)
    with zipfile.ZipFile(new, "w", compression) as archive:
        for name, value in contents.items():
            if value is not None:
                raw = value if isinstance(value, bytes) else npy(value)
                archive.writestr(f"{name}.npy", raw)
    return new


def huge_header(descr="<f8", shape=(10**6, 10**6)):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": descr, "fortran_order": False, "shape": shape}
    )
    return stream.getvalue() + b"\0" * 64


class Explosive:
    """Unpickling this would leave a file behind."""

    def __reduce__(self):
        return (pathlib.Path.touch, (pathlib.Path("exploded"),))


HOSTILE = [
    ({"v": None}, "must have velocities `v` of shape (p, d), but has none"),
    ({"C": None}, "lacks `C`"),
    ({"extra": np.zeros(3)}, "has `extra`"),
    ({"format": None}, "must be a state written by pgjax, but does not say that it is"),
    ({"format": np.asarray("pgjax state 2")}, "must be of version 1, the one this pgjax reads"),
    ({"format": np.asarray("pgjax trajectory 1")}, "must hold a state, but holds a trajectory"),
    ({"format": np.asarray("x" * 1000)}, "does not say that it is"),
    ({"format": np.asarray(["pgjax state 1"] * 2)}, "does not say that it is"),
    ({"v": np.zeros((10, 2), np.int64)}, "must be in float32 or float64, but is in int64"),
    ({"C": np.zeros((10, 2, 2), np.float16)}, "must have `C` of shape (10, 2, 2) and type float"),
    ({"C": np.zeros((10, 2, 2), ">f4")}, "must have `C` of shape (10, 2, 2) and type float"),
    ({"C": np.zeros((10, 4))}, "must have `C` of shape (10, 2, 2)"),
    ({"alive": np.ones(10, np.int8)}, "must have `alive` of shape (10,) and type bool"),
    ({"step": np.int64(0)}, "must have `step` of shape () and type int32"),
    ({"C": huge_header()}, "claims the shape (1000000, 1000000), but holds"),
    ({"C": huge_header(shape=(-1, 5))}, "claims the shape (-1, 5)"),
    ({"C": huge_header("|O", (10,))}, "must hold numbers only, but `C` is of type object"),
    ({"C": npy([Explosive()], allow_pickle=True)}, "must hold numbers only"),
    ({"C": b"no array at all"}, "is truncated or damaged"),
    ({"C": b""}, "is truncated or damaged"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), HOSTILE)
def test_broken_and_hostile_files_are_refused(saved, changes, message, monkeypatch):
    monkeypatch.chdir(saved.parent)
    scene = scene_of([METAL, JELLY], counts=(6, 4))
    path = rewritten(saved, changes)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        load_state(path, scene)
    assert str(error.value).startswith(f"The file {path} must ")
    assert not (saved.parent / "exploded").exists()


def test_nothing_large_is_read_before_it_fits(saved, monkeypatch):
    """Headers of a state of another scene are read, its arrays are not."""
    read = []
    original = np.lib.format.read_array

    def counting(stream, **kwargs):
        array = original(stream, **kwargs)
        read.append(array.nbytes)
        return array

    monkeypatch.setattr(np.lib.format, "read_array", counting)
    with pytest.raises(ValueError, match="must hold the 11 particles"):
        load_state(saved, scene_of(n=11))
    assert sum(read) < 100


def test_compressed_members_are_refused(saved):
    path = rewritten(saved, {"C": np.zeros((10**6,))}, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match="is compressed, which pgjax never does"):
        load_state(path, scene_of([METAL, JELLY], counts=(6, 4)))


def test_a_member_that_claims_more_than_the_file_holds(saved):
    raw = bytearray(saved.read_bytes())
    # Both sizes of the last entry of the list at the end of the archive.
    at = raw.rindex(b"PK\x01\x02")
    raw[at + 20 : at + 28] = (2**31).to_bytes(4, "little") * 2
    saved.write_bytes(raw)
    with pytest.raises(ValueError, match="claims 2147483648 bytes where"):
        load_state(saved, scene_of([METAL, JELLY], counts=(6, 4)))


def test_a_name_that_is_there_twice(saved):
    with (
        pytest.warns(UserWarning, match="Duplicate name"),
        zipfile.ZipFile(saved, "a") as archive,
    ):
        archive.writestr("C.npy", npy(np.zeros(3)))
    with pytest.raises(ValueError, match="`C` is there twice"):
        load_state(saved, scene_of([METAL, JELLY], counts=(6, 4)))


def test_files_that_are_not_there(tmp_path):
    for path in (tmp_path, tmp_path / "none.npz"):
        with pytest.raises(ValueError, match=f"There is no file {re.escape(str(path))}"):
            load_state(path, scene_of())
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(ValueError, match=r"must be a complete \.npz, but is truncated or damaged"):
        load_trajectory(tmp_path / "text.npz")


def test_no_part_of_a_file_passes_for_a_whole_one(saved):
    scene = scene_of([METAL, JELLY], counts=(6, 4))
    raw = saved.read_bytes()
    for length in [*range(0, len(raw), 97), len(raw) - 1]:
        saved.write_bytes(raw[:length])
        with pytest.raises(ValueError, match=r"must be a complete \.npz"):
            load_state(saved, scene)


def test_flipped_bits_are_named_or_harmless(saved):
    """A changed byte is an error that names the file, or changes nothing that is read."""
    scene = scene_of([METAL, JELLY], counts=(6, 4))
    raw, state = saved.read_bytes(), load_state(saved, scene)
    rng = np.random.default_rng(0)
    refused = 0
    for at in rng.choice(len(raw), 400, replace=False):
        changed = bytearray(raw)
        changed[at] ^= 1 << int(rng.integers(8))
        saved.write_bytes(changed)
        loaded, message = attempt(saved, scene)
        if loaded is None:
            assert message.startswith(f"The file {saved} must ")
            refused += 1
        else:
            assert_same(loaded, state)
    assert refused > 300


def attempt(path, scene):
    try:
        return load_state(path, scene), ""
    except ValueError as error:
        return None, str(error)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"t": None}, "must have times `t`, one for each frame, but has none"),
        ({"x": np.zeros((3, 7, 2))}, "must have 4 entries of `x`, as many as of `t`"),
        ({"x": np.zeros(())}, "must have 4 entries of `x`"),
        ({"x": np.asarray(["a"] * 4)}, "must hold numbers only, but `x` is of type <U1"),
        ({"format": np.asarray("pgjax state 1")}, "must hold a trajectory, but holds a state"),
    ],
)
def test_broken_trajectories_are_refused(tmp_path, changes, message):
    scene = scene_of(n=7)
    save_trajectory(tmp_path / "t.npz", rolled(scene, started(scene), 3))
    with pytest.raises(ValueError, match=re.escape(message)):
        load_trajectory(rewritten(tmp_path / "t.npz", changes))
