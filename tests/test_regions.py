"""Regions of scene files, and values per Gaussian that follow the particles."""

import re

import numpy as np
import pytest
from plyfile import PlyData
from scene_files import CAMERA, GRID, JELLY, MODEL, ball, planned, sphere, write

from pgjax.render import save_ply
from pgjax.scenes import SceneError, read_scene
from pgjax.scenes.regions import (
    BoxRegion,
    CylinderRegion,
    HalfSpaceRegion,
    LabelRegion,
    Points,
    SphereRegion,
)

RNG = np.random.default_rng(3)
X = RNG.uniform(-1, 1, (500, 3))


def points(x):
    x = np.atleast_2d(np.asarray(x, float))
    return Points(x, np.arange(len(x)))


def test_box():
    box = BoxRegion((-0.5, -0.2, 0), (0.5, 0.3, 1))
    expected = [-0.5 <= x <= 0.5 and -0.2 <= y <= 0.3 and 0 <= z <= 1 for x, y, z in X]
    np.testing.assert_array_equal(box.contains(points(X)), expected)
    assert box.contains(points([[0.5, 0.3, 1]])).all()


def test_sphere():
    region = SphereRegion((0.1, 0.2, 0.3), 0.6)
    distance = np.linalg.norm(X - [0.1, 0.2, 0.3], axis=1)
    np.testing.assert_array_equal(region.contains(points(X)), distance <= 0.6)


def test_cylinder():
    """Along an oblique axis: the same as along z after turning the points."""
    R, _ = np.linalg.qr(RNG.normal(size=(3, 3)))
    start, end = np.array([0.1, 0, -0.4]), np.array([0.1, 0, 0.7])
    upright = (np.hypot(X[:, 0] - 0.1, X[:, 1]) <= 0.5) & (X[:, 2] >= -0.4) & (X[:, 2] <= 0.7)
    region = CylinderRegion(tuple(R @ start), tuple(R @ end), 0.5)
    np.testing.assert_array_equal(region.contains(points(X @ R.T)), upright)
    assert 0 < upright.sum() < len(X)


def test_half_space():
    region = HalfSpaceRegion((0, 0, 0.5), (0, 0, 2))
    np.testing.assert_array_equal(region.contains(points(X)), X[:, 2] >= 0.5)


def test_labels():
    labels = RNG.integers(0, 5, 100)
    rows = RNG.integers(0, 100, 300)
    region = LabelRegion(labels, (1, 4))
    where = region.contains(Points(np.zeros((300, 3)), rows))
    np.testing.assert_array_equal(where, (labels[rows] == 1) | (labels[rows] == 4))


REGIONS = {
    "{ lower = [-1, -1, -1], upper = [1, 1, 0.2] }": lambda x: x[:, 2] <= 0.2,
    '{ shape = "box", lower = [-1, -1, -1], upper = [1, 1, 0.2] }': lambda x: x[:, 2] <= 0.2,
    '{ shape = "sphere", center = [0, 0, 0.25], radius = 0.15 }': (
        lambda x: np.linalg.norm(x - [0, 0, 0.25], axis=1) <= 0.15
    ),
    '{ shape = "cylinder", start = [0, 0, 0], end = [0, 0, 1], radius = 0.1 }': (
        lambda x: np.hypot(x[:, 0], x[:, 1]) <= 0.1
    ),
    '{ shape = "half-space", point = [0, 0, 0.3], normal = [0, 0, -1] }': lambda x: x[:, 2] <= 0.3,
}


@pytest.mark.parametrize("text", REGIONS)
def test_regions_of_materials_and_conditions(tmp_path, text):
    inside = REGIONS[text]
    soft = JELLY + f"region = {text}"
    push = f'[[particles]]\ntype = "impulse"\nmomentum = [1, 0, 0]\nregion = {text}'
    p = planned(tmp_path, MODEL, GRID, soft, JELLY, push)
    x = np.asarray(p.state.x)
    first = p.scene.counts[0]
    np.testing.assert_array_equal(np.arange(len(x)) < first, inside(x))
    np.testing.assert_array_equal(p.scene.particle_conditions[0].mask, inside(x))
    assert 0 < first < len(x)


@pytest.mark.parametrize(
    ("text", "inside"),
    [
        ('{ shape = "sphere", center = [0, 0, 0], radius = 0.2 }', lambda r: r <= 0.2),
        (
            '{ shape = "half-space", point = [0, 0, 0], normal = [0, -1, 0] }',
            None,
        ),
    ],
)
def test_the_region_of_a_model_is_in_its_own_coordinates(tmp_path, text, inside):
    model = MODEL + f"region = {text}"
    p = planned(tmp_path, model, GRID, JELLY)
    x = np.asarray(ball().means)
    mask = inside(np.linalg.norm(x, axis=1)) if inside else x[:, 1] <= 0
    assert p.scene.particle_count == mask.sum()
    assert len(p.still) == (~mask).sum()
    back = np.asarray(p.to_simulation.inverse().apply(p.moving.means))
    np.testing.assert_allclose(back, x[mask], atol=1e-6)


@pytest.fixture
def labelled(tmp_path):
    """A capture whose labels say in which octant a Gaussian is, some too transparent to be used."""
    n = 300
    opacities = np.where(np.arange(n) % 7 == 3, 0.01, 0.9)
    capture = ball(n, opacities=opacities)
    save_ply(tmp_path / "ball.ply", capture)
    labels = (np.asarray(capture.means) > 0) @ np.array([1, 2, 4])
    np.save(tmp_path / "labels.npy", labels.astype(np.int32))
    np.save(tmp_path / "E.npy", 1e4 * (1 + labels))
    np.save(tmp_path / "row.npy", 100.0 + np.arange(n))
    return tmp_path, capture, labels


def octants(p):
    """The labels of the particles by where they are in the capture."""
    back = np.asarray(p.to_simulation.inverse().apply(p.moving.means))
    return (back > 0) @ np.array([1, 2, 4])


def test_labels_are_carried_through_filtering_selection_and_ordering(labelled):
    folder, capture, labels = labelled
    model = MODEL + 'region = { shape = "labels", file = "labels.npy", values = [0, 1, 2, 5, 6] }'
    first = JELLY + 'region = { shape = "labels", file = "labels.npy", values = [5, 1] }'
    second = JELLY + 'region = { shape = "labels", file = "labels.npy", values = [6] }'
    hold = (
        '[[particles]]\ntype = "hold"\n'
        'region = { shape = "labels", file = "labels.npy", values = [0, 6] }'
    )
    p = planned(folder, model, GRID, first, second, JELLY, hold)
    found = octants(p)
    used = np.asarray(capture.opacities) > 0.02
    assert p.scene.particle_count == np.isin(labels[used], [0, 1, 2, 5, 6]).sum()
    assert len(p.still) == np.isin(labels[used], [3, 4, 7]).sum()
    ends = np.cumsum(p.scene.counts)
    assert set(found[: ends[0]]) == {1, 5}
    assert set(found[ends[0] : ends[1]]) == {6}
    assert set(found[ends[1] :]) == {0, 2}
    np.testing.assert_array_equal(p.scene.particle_conditions[0].mask, np.isin(found, [0, 6]))


def test_values_per_gaussian_follow_the_particles(labelled):
    folder, capture, _ = labelled
    stiff = JELLY.replace("2e4", '{ file = "E.npy" }').replace("1000", '{ file = "row.npy" }')
    low = '\nregion = { shape = "labels", file = "labels.npy", values = [0, 1, 4, 5] }'
    p = planned(folder, MODEL, GRID, stiff + low, stiff)
    found = octants(p)
    E = np.concatenate([np.asarray(m.elasticity.E) for m in p.scene.materials])
    np.testing.assert_allclose(E, 1e4 * (1 + found))
    rows = np.concatenate([np.asarray(m.density) for m in p.scene.materials]) - 100
    back = np.asarray(p.to_simulation.inverse().apply(p.moving.means))
    np.testing.assert_allclose(back, np.asarray(capture.means)[rows.astype(int)], atol=1e-6)
    # And the simulator takes them.
    assert p.scene.masses.shape == (p.scene.particle_count,)
    assert 0 < p.dt < 1


def test_values_skip_gaussians_that_are_broken(labelled):
    """Files count the Gaussians of the model's file, those that cannot be used included."""
    folder, capture, _ = labelled
    file = PlyData.read(folder / "ball.ply", mmap=False)
    file["vertex"]["x"][[4, 50, 51, 200]] = np.nan
    file.write(folder / "ball.ply")
    means = np.asarray(capture.means).copy()
    means[[4, 50, 51, 200]] = np.nan
    dense = JELLY.replace("1000", '{ file = "row.npy" }')
    with pytest.warns(UserWarning, match="4 of the 300 Gaussians"):
        p = planned(folder, MODEL, GRID, dense)
    rows = (np.asarray(p.scene.materials[0].density) - 100).astype(int)
    used = (np.asarray(capture.opacities) > 0.02) & np.isfinite(means[:, 0])
    np.testing.assert_array_equal(rows, np.flatnonzero(used))
    back = np.asarray(p.to_simulation.inverse().apply(p.moving.means))
    np.testing.assert_allclose(back, means[rows], atol=1e-6)


def test_values_are_carried_through_splitting(labelled):
    folder, capture, _ = labelled
    dense = JELLY.replace("1000", '{ file = "row.npy" }')
    p = planned(folder, MODEL + "split_longer_than = 0.4", GRID, dense)
    (material,) = p.scene.materials
    rows = (np.asarray(material.density) - 100).astype(int)
    assert len(rows) > (np.asarray(capture.opacities) > 0.02).sum()
    back = np.asarray(p.to_simulation.inverse().apply(p.moving.means))
    sigma = np.linalg.svd(np.asarray(capture.factors), compute_uv=False)[:, 0]
    distance = np.linalg.norm(back - np.asarray(capture.means)[rows], axis=1)
    assert np.all(distance <= 3 * sigma[rows])
    longest = np.linalg.svd(np.asarray(capture.factors[rows]), compute_uv=False)[:, 0]
    scale = float(p.to_simulation.scale)
    times = np.bincount(rows)[rows]
    np.testing.assert_array_equal(times > 1, scale * longest > 0.4 * 0.1)


def test_a_filled_particle_takes_the_label_of_the_nearest_gaussian(tmp_path):
    shell = sphere()
    save_ply(tmp_path / "ball.ply", shell)
    upper = np.asarray(shell.means)[:, 1] < 0  # y is down
    np.save(tmp_path / "labels.npy", upper)
    np.save(tmp_path / "E.npy", np.where(upper, 3e4, 1e4))
    top = '\nregion = { shape = "labels", file = "labels.npy", values = [1] }'
    soft = JELLY.replace("2e4", '{ file = "E.npy" }')
    p = planned(tmp_path, MODEL + "fill = {}", GRID, soft + top, soft)
    x, first = np.asarray(p.state.x), p.scene.counts[0]
    assert len(x) > len(shell) + 200
    assert np.all(p.scene.materials[0].elasticity.E == 3e4)
    assert np.all(p.scene.materials[1].elasticity.E == 1e4)
    inner = np.linalg.norm(x - [0, 0, 0.25], axis=1) < 0.2
    above = x[:, 2] > 0.25
    assert inner.sum() > 100
    agree = (np.arange(len(x)) < first) == above
    # Near the middle plane the nearest Gaussian may be on the other side.
    assert np.all(agree | (np.abs(x[:, 2] - 0.25) < 0.05))


def save(name, values):
    return lambda folder: np.save(folder / name, values, allow_pickle=values.dtype == object)


def raw(content):
    return lambda folder: (folder / "labels.npy").write_bytes(content)


def truncated(folder):
    np.save(folder / "labels.npy", np.arange(200))
    content = (folder / "labels.npy").read_bytes()
    (folder / "labels.npy").write_bytes(content[:-80])


BAD_LABELS = [
    (lambda _: None, "`file` must name a file, but there is no"),
    (save("label.npy", np.zeros(200, int)), "labels.npy (did you mean `label.npy`?)"),
    (raw(b"1 2 3"), "must be an array of numbers in .npy format"),
    (raw(b""), "must be an array of numbers in .npy format"),
    (raw(b"PK\x03\x04 and so on"), "must be an array of numbers in .npy format"),
    (truncated, "must be an array of numbers in .npy format"),
    (save("labels.npy", np.array([1, "a", None] * 4, object)), "in .npy format"),
    (save("labels.npy", np.ones(200)), "must hold whole numbers, but holds float64"),
    (save("labels.npy", np.array(["a"] * 200)), "must hold whole numbers, but holds <U1"),
    (save("labels.npy", np.ones((200, 2), int)), "must have the shape n, but has (200, 2)"),
    (save("labels.npy", np.ones(0, int)), "labels.npy"),
    (save("labels.npy", np.array(1)), "must have the shape n, but has ()"),
    (save("labels.npy", np.arange(199)), "one value for each of the 200 Gaussians of"),
    (save("labels.npy", np.array([0, 3, 7, 9] * 50)), "which holds 0, 3, 7, 9 and no 1"),
]


@pytest.mark.parametrize(("make", "words"), BAD_LABELS)
@pytest.mark.parametrize("table", ["model", "material", "particles"])
def test_bad_labels(tmp_path, table, make, words):
    make(tmp_path)
    text = '\nregion = { shape = "labels", file = "labels.npy", values = [1] }'
    hold = '[[particles]]\ntype = "hold"'
    parts = {"model": MODEL, "material": JELLY, "particles": hold}
    parts[table] += text
    with pytest.raises(SceneError, match=re.escape(words)) as error:
        planned(tmp_path, *parts.values(), GRID, *([JELLY] if table == "material" else []))
    assert "scene.toml [" in str(error.value)
    assert "labels.npy" in str(error.value)


BAD_REGIONS = [
    ("{ lower = [0, 0, 0] }", "`upper` is missing"),
    ("{ lower = [0, 0, 0], upper = [1, 1, 0] }", "`upper` must be above `lower`"),
    ("{ lower = [0, 0, 0], uper = [1, 1, 0] }", "`upper` is missing (is `uper` meant?)"),
    ('{ shape = "bal" }', "be one of box, sphere, cylinder, half-space, labels, but is 'bal'"),
    ('{ shape = "spher" }', "did you mean `sphere`?"),
    ("{ shape = 3 }", "`shape` must be a string"),
    ('{ shape = "sphere", center = [0, 0, 0], radius = 0 }', "`radius` must be a finite number"),
    ('{ shape = "sphere", centre = [0, 0, 0], radius = 1 }', "is `centre` meant?"),
    (
        '{ shape = "sphere", center = [0, 0, 0], radius = 1, lower = [0, 0, 0] }',
        '`lower` is not a known key with shape = "sphere"; allowed are shape, center, radius',
    ),
    (
        '{ shape = "cylinder", start = [0, 0, 1], end = [0, 0, 1], radius = 1 }',
        "`end` must differ from `start`",
    ),
    ('{ shape = "half-space", point = [0, 0, 1], normal = [0, 0, 0] }', "`normal` must not be"),
    ('{ shape = "labels", file = "labels.npy", values = [] }', "be a list of whole numbers"),
    ('{ shape = "labels", file = "labels.npy", values = [0.5] }', "be a list of whole numbers"),
    ('{ shape = "labels", file = "labels.npy", values = 1 }', "be a list of whole numbers"),
    ('{ shape = "labels", file = 1, values = [1] }', "`file` must be a string"),
    ("[0, 1]", "`region` must be a table"),
]


@pytest.mark.parametrize(("text", "words"), BAD_REGIONS)
def test_bad_regions(tmp_path, text, words):
    np.save(tmp_path / "labels.npy", np.arange(10))
    path = write(tmp_path, MODEL, GRID, JELLY + f"region = {text}", CAMERA)
    with pytest.raises(SceneError, match=re.escape(words)) as error:
        read_scene(path)
    assert str(error.value).startswith("scene.toml [[material]] 1")
