"""The models of all scenes: solids that hang together, the same each time, with colours."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from scene_files import DROP, ball, changed

from pgjax.render import concatenate, save_ply
from pgjax.sampling import pieces
from pgjax.scenes import SceneError, plan, presets, read_scene, resolve
from pgjax.scenes.procedural import MODELS, solids
from pgjax.scenes.procedural.solids import Places, Solid, filled, plain

# What is not one body: pillows, balls, a press above a can, jam above its slice.
LOOSE = {"sofa-suite": 4, "materials": 4, "can": 3, "jam": 2, "ruins": 9, "cake": 2}


# Left to `pytest -m slow` for the time that planning them takes.
LARGE = ("ruins", "cake", "vasedeck", "can", "sofa-suite", "fox", "wolf", "bread", "toast")


def some(names, slow):
    """Names of tests, of which some are slow."""
    return [pytest.param(n, marks=pytest.mark.slow) if n in slow else n for n in names]


@functools.cache
def planned(name):
    return plan(read_scene(resolve(name)))


def test_every_scene_has_a_model_of_its_name():
    assert set(presets()) == set(MODELS)
    assert len(MODELS) == 14


@pytest.mark.parametrize("name", some(MODELS, LARGE))
def test_a_model_is_whole(name):
    made = planned(name)
    model = concatenate([made.moving, made.still])
    assert 5_000 <= len(model) <= 60_000
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))
    scales = np.sqrt(np.linalg.eigvalsh(np.asarray(model.covariances, np.float64)))
    assert scales.min() > 2e-4
    assert scales.max() < 0.05
    colours = 0.5 + np.asarray(model.sh[:, 0]) / (2 * np.sqrt(np.pi))
    assert colours.min() >= 0
    assert colours.max() <= 1
    # Some contrast, and more than one hue.
    assert np.ptp(np.quantile(colours.mean(axis=1), [0.05, 0.95])) > 0.1
    assert np.abs(colours - colours.mean(axis=1, keepdims=True)).max() > 0.05
    _hangs_together(made, LOOSE.get(name, 1))


def _hangs_together(made, pieces_at_most):
    """Of few pieces, and with particles and a time step that go with the grid."""
    x = np.asarray(made.state.x, np.float64)
    h = float(made.scene.grid.h)
    labels = pieces(x, reach=h)
    # Crumbs apart: a leaf's tip may be further from its neighbours than a cell.
    large = (np.bincount(labels) > 0.002 * len(x)).sum()
    assert large <= pieces_at_most
    assert (labels < large).mean() > 0.99
    # About eight particles in a cell that holds any.
    cells = len(np.unique(np.floor(x / h).astype(int), axis=0))
    assert 1.5 < len(x) / cells < 16
    assert made.dt <= float(made.scene.rest_limit())


@pytest.mark.parametrize("name", presets())
def test_a_preset_says_what_it_is_and_has_its_paper_size(name):
    path = resolve(name)
    assert path.read_text().startswith("# ")
    paper, usual = read_scene(path, "paper"), read_scene(path)
    assert paper.grid.spacing <= usual.grid.spacing
    assert paper.time.frames / paper.time.fps >= 0.99 * usual.time.frames / usual.time.fps


def test_the_same_seed_makes_the_same_model():
    one, again = (jax.tree.leaves(MODELS["toast"](3, 1.0)) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(one, again, strict=True))


def test_detail_brings_gaussians_nearer():
    usual, fine = (len(MODELS["can"](0, detail)) for detail in (1.0, 1.3))
    assert fine / usual == pytest.approx(1.3**3, rel=0.2)


def test_a_ficus_has_one_detail():
    with pytest.raises(ValueError, match="`detail` must be 1"):
        MODELS["ficus"](0, 2.0)


def red(places: Places):
    return plain((0.5, 0.1, 0.1))(places)


SHAPES = {
    "ball": (solids.ball((0, 0, 0), 0.3), 4 / 3 * np.pi * 0.3**3),
    "box": (solids.box((0, 0, 0), (0.3, 0.2, 0.1)), 8 * 0.3 * 0.2 * 0.1),
    "cylinder": (solids.cylinder((0, 0, -0.2), (0, 0, 0.2), 0.2), np.pi * 0.2**2 * 0.4),
    "limb": (
        solids.limb((0, 0, -0.2), (0, 0, 0.2), 0.1),
        np.pi * 0.1**2 * (0.4 + 4 / 3 * 0.1),
    ),
    "ring": (solids.ring((0, 0, 0), (0, 0, 1), 0.25, 0.1), 2 * np.pi**2 * 0.25 * 0.1**2),
    "ellipsoid": (
        solids.ellipsoid((0, 0, 0), (0.3, 0.2, 0.15)),
        4 / 3 * np.pi * 0.3 * 0.2 * 0.15,
    ),
    "profile": (
        solids.turned_profile([(0, -0.2), (0.3, -0.2), (0, 0.2)]),
        np.pi * 0.3**2 * 0.4 / 3,
    ),
    "extrusion": (
        solids.extruded([(-0.2, -0.2), (0.2, -0.2), (0, 0.2)], 0.1),
        0.4 * 0.4 / 2 * 0.2,
    ),
    "hollow": (
        solids.hollow(solids.ball((0, 0, 0), 0.3), 0.1),
        4 / 3 * np.pi * (0.3**3 - 0.2**3),
    ),
    "difference": (
        solids.without(solids.ball((0, 0, 0), 0.3), solids.ball((0, 0, 0), 0.2)),
        4 / 3 * np.pi * (0.3**3 - 0.2**3),
    ),
    "turned": (
        solids.placed(solids.box((0, 0, 0), (0.3, 0.05, 0.1)), (0.02, 0, 0), (0, 0, 40)),
        8 * 0.3 * 0.05 * 0.1,
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_distance_bounds_its_volume_and_is_no_longer_than_the_way(name):
    distance, volume = SHAPES[name]
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.4, 0.4, (200_000, 3))
    d = distance(x)
    assert (d < 0).mean() * 0.8**3 == pytest.approx(volume, rel=0.03)
    # One step along the gradient by less than the distance does not cross the surface; that of an
    # ellipsoid is nearly right near it.
    out = x[(d > 0) & (d < 0.05)]
    ahead = out - 0.9 * d[(d > 0) & (d < 0.05), None] * solids.normals(distance, out)
    assert (distance(ahead) > -1e-3).mean() > 0.999


def test_filling_has_a_particle_for_each_cube_of_the_spacing():
    # A quarter of a spacing outside counts, and is drawn inwards.
    body = filled([Solid(SHAPES["ball"][0], red)], (-0.4,) * 3, (0.4,) * 3, 0.04)
    assert len(body) * 0.04**3 == pytest.approx(SHAPES["ball"][1], rel=0.12)
    x = np.asarray(body.means, np.float64)
    r = np.linalg.norm(x, axis=1)
    assert r.max() <= 0.3
    assert (r > 0.27).mean() > 0.2
    # Lit from above: the upper side is lighter than the lower one.
    brightness = np.asarray(body.sh[:, 0]).mean(axis=1)
    assert brightness[x[:, 2] > 0.25].mean() > brightness[x[:, 2] < -0.25].mean() + 0.1


def test_the_first_solid_owns_what_is_shared():
    blue = solids.ball((0.1, 0, 0), 0.2)
    body = filled(
        [Solid(solids.ball((0, 0, 0), 0.2), red), Solid(blue, plain((0.1, 0.1, 0.5)))],
        (-0.3,) * 3,
        (0.4,) * 3,
        0.04,
    )
    x, colour = np.asarray(body.means), np.asarray(body.sh[:, 0])
    is_red = colour[:, 0] > colour[:, 2]
    inside = np.linalg.norm(x, axis=1) < 0.18
    assert is_red[inside].all()
    assert not is_red[x[:, 0] > 0.22].any()


@pytest.mark.slow
def test_every_preset_takes_a_capture(tmp_path):
    path = tmp_path / "ball.ply"
    save_ply(path, ball(400))
    for name in presets():
        made = plan(read_scene(resolve(name)), ply=path)
        assert made.scene.particle_count > 200
        assert sum(made.scene.counts) == made.scene.particle_count
        x, grid = np.asarray(made.state.x, np.float64), made.scene.grid
        h, lower = float(grid.h), np.asarray(grid.origin)
        assert np.all(x > lower + h)
        assert np.all(x < lower + (np.asarray(grid.shape) - 1) * h)


LED = """
[[particles]]
type = "hold"
region = { lower = [-1, -1, 5], upper = [1, 1, 6] }
"""


def test_what_does_not_apply_to_a_capture_is_said(tmp_path):
    path, scene = tmp_path / "ball.ply", tmp_path / "scene.toml"
    save_ply(path, ball(400))
    scene.write_text(changed(DROP, ("upper = [1, 1, 0.25]", "upper = [1, 1, -0.9]")) + LED)
    with pytest.raises(SceneError, match=r"\[\[material\]\] 1 owns no particle"):
        plan(changed_model(read_scene(scene), path))
    made = plan(read_scene(scene), ply=path)
    assert made.scene.counts == (made.scene.particle_count,)
    assert not made.scene.particle_conditions
    for table in ("[[material]] 1", "[[particles]] 1"):
        note = f"capture: nothing is in the region of {table}, which is left out"
        assert note in made.notes
    wide = plan(read_scene(resolve("bread")), ply=path)
    assert any("the grid reaches from" in note for note in wide.notes)
    assert wide.scene.grid.shape[1] > planned("bread").scene.grid.shape[1]


def changed_model(file, path):
    """The scene with a capture that is written in it."""
    (model,) = file.models
    return dataclasses.replace(file, models=(dataclasses.replace(model, ply=path),))
