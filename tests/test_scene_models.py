"""Models of scene files: where they stand, how they fly, several of them, splitting and filling."""

import re

import numpy as np
import pytest
from scene_files import GRID, JELLY, MODEL, ball, planned, sphere, write
from scipy.spatial.transform import Rotation

from pgjax import simulate
from pgjax.render import Camera, concatenate, load_ply, render, save_ply
from pgjax.scenes import SceneError, plan, read_scene

WIDE = GRID.replace("-0.5, -0.5, -0.2", "-1, -1, -0.4").replace("0.5, 0.5, 0.8", "1, 1, 1.2")


def positions(folder, *lines, grid=WIDE):
    return np.asarray(planned(folder, MODEL + "\n".join(lines), grid, JELLY).state.x)


def test_position(tmp_path):
    x = positions(tmp_path)
    moved = positions(tmp_path, "position = [0.3, -0.2, 0.1]")
    np.testing.assert_allclose(moved, x + np.array([0.3, -0.2, 0.1]), atol=1e-6)


TURNS = {
    "rotation = 30": Rotation.from_euler("z", 30, degrees=True),
    "rotation = [{ axis = [0, 0, 2], angle = 30 }]": Rotation.from_euler("z", 30, degrees=True),
    "rotation = [{ axis = [1, 0, 0], angle = 90 }, { axis = [0, 0, 1], angle = -20 }]": (
        Rotation.from_euler("xz", [90, -20], degrees=True)
    ),
    "rotation = []": Rotation.identity(),
}


@pytest.mark.parametrize("line", TURNS)
def test_rotation(tmp_path, line):
    """Turned, then scaled to the size again and put on its foot."""
    x = positions(tmp_path) @ TURNS[line].as_matrix().T
    lower, upper = x.min(axis=0), x.max(axis=0)
    x = (x - [*((lower + upper) / 2)[:2], lower[2]]) * 0.5 / (upper - lower).max()
    np.testing.assert_allclose(positions(tmp_path, line), x, atol=1e-6)


def test_flight_and_spin(tmp_path):
    """The start is a rigid motion: a free body keeps it, without any stress."""
    model = MODEL + "velocity = [0.5, 0, 1]\nangular_velocity = [0, 0, 90]"
    p = planned(tmp_path, model, WIDE, JELLY)
    x, v = np.asarray(p.state.x), np.asarray(p.state.v)
    mass = np.asarray(p.scene.masses)[:, None]
    center = (mass * x).sum(0) / mass.sum()
    spin = np.array([0, 0, np.pi / 2])
    np.testing.assert_allclose(v, np.array([0.5, 0, 1]) + np.cross(spin, x - center), atol=1e-6)
    L = np.asarray(p.state.C)
    np.testing.assert_allclose(L, np.broadcast_to(np.cross(np.eye(3), spin), L.shape), atol=1e-9)
    moved = simulate(p.scene, p.state, dt=p.dt, frames=1, substeps=1).final
    np.testing.assert_allclose(np.asarray(moved.F) - np.eye(3) - p.dt * L, 0, atol=1e-5)


TWO = """
[[model]]
name = "left"
ply = "ball.ply"
size = 0.4
position = [-0.4, 0, 0]
region = { lower = [-9, -9, -9], upper = [9, 0.25, 9] }
[[model]]
name = "right"
ply = "other.ply"
size = 0.6
position = [0.4, 0, 0]
velocity = [-1, 0, 0]
"""
LEFT, RIGHT = JELLY + 'model = "left"', JELLY.replace("2e4", "5e4") + 'model = "right"'


@pytest.fixture
def two(tmp_path):
    save_ply(tmp_path / "ball.ply", ball())
    save_ply(tmp_path / "other.ply", ball(150, seed=5))
    np.save(tmp_path / "labels.npy", np.arange(150) % 3)
    return tmp_path


def test_several_models(two):
    hold = '[[particles]]\ntype = "hold"\nmodel = "left"'
    push = (
        '[[particles]]\ntype = "impulse"\nmomentum = [1, 0, 0]\nmodel = "right"\n'
        'region = { shape = "labels", file = "labels.npy", values = [2] }'
    )
    p = planned(two, TWO, WIDE, RIGHT, LEFT, hold, push)
    x, v = np.asarray(p.state.x), np.asarray(p.state.v)
    count = p.scene.counts[0]
    assert count == 150
    assert np.all(x[:count, 0] > 0)
    assert np.all(x[count:, 0] < 0)
    assert len(x) + len(p.still) == 350
    assert len(p.still) > 0
    np.testing.assert_allclose(np.ptp(x[:count], axis=0).max(), 0.6, rtol=1e-5)
    np.testing.assert_allclose(np.ptp(x[count:], axis=0).max(), 0.4, rtol=1e-5)
    np.testing.assert_allclose(v[:count], np.broadcast_to([-1, 0, 0], (count, 3)))
    np.testing.assert_allclose(v[count:], 0)
    held, pushed = (np.asarray(c.mask) for c in p.scene.particle_conditions)
    np.testing.assert_array_equal(held, np.arange(len(x)) >= count)
    np.testing.assert_array_equal(np.flatnonzero(pushed), np.arange(2, 150, 3))
    # Pictures and files are in the coordinates of the first.
    back = np.asarray(p.to_simulation.inverse().apply(p.moving.means))[count:]
    first = np.asarray(load_ply(two / "ball.ply").means)
    np.testing.assert_allclose(back, first[first[:, 1] <= 0.25], atol=1e-5)
    assert len(p.notes) == 2
    with pytest.raises(SceneError, match=r"with one \[model\] only"):
        planned(two, TWO, WIDE, JELLY, ply=two / "ball.ply")


FAULTS = [
    (TWO, JELLY + 'model = "rigt"', "one of left, right (did you mean `right`?), but is 'rigt'"),
    (
        TWO,
        JELLY + 'region = { shape = "labels", file = "labels.npy", values = [2] }',
        "`model` must say which of the 2 models the values in the file belong to",
    ),
    (
        TWO,
        LEFT + '\nregion = { shape = "labels", file = "labels.npy", values = [2] }',
        "one value for each of the 200 Gaussians of",
    ),
    (TWO.replace("right", "left"), JELLY, "[[model]] 1: `name` must differ from model to model"),
    (TWO, LEFT, "150 particles are in the region of no [[material]]"),
    ("model = []", JELLY, "`model` must hold at least one [[model]]"),
    ("model = 3", JELLY, "`model` must be a table"),
    ("", JELLY, "`model` is missing"),
    (TWO.replace("other", "balls"), JELLY, "balls.ply (did you mean `ball.ply`?)"),
    (TWO.replace("position", "positon"), JELLY, "[[model]] 1: `positon` is not a known key (did"),
]


@pytest.mark.parametrize(("models", "material", "words"), FAULTS)
def test_mistakes_with_several_models(two, models, material, words):
    with pytest.raises(SceneError, match=re.escape(words)):
        planned(two, models, WIDE, material)


BAD = [
    ('ply = "bal.ply"', "[model]: `ply` must name a file, but there is no"),
    ('ply = "bal.ply"', "bal.ply (did you mean `ball.ply`?)"),
    ('ply = "~no-such-user/ball.ply"', "`ply` must name a file in a home folder that is known"),
    ('ply = "scene.toml"', "[model]: The file"),
    ('procedural = "oak"', "`procedural` must be one of ficus"),
    ('procedural = "ficuss"', "did you mean `ficus`?"),
    ('procedural = "ficus"\nseed = -1', "`seed` must be a whole number, at least 0,"),
    ('ply = "ball.ply"\nseed = 1', "`seed` is not a known key"),
    ('ply = "ball.ply"\nprocedural = "ficus"', "but not both"),
    ("size = 1", "`ply` must be given, or `procedural`"),
    ('ply = "ball.ply"\nup = [0, 0, 0]', "`up` must not be zero"),
    ('ply = "ball.ply"\nup = [0, 0, inf]', "be a list of 3 numbers, each a finite number"),
    ('ply = "ball.ply"\nup = ["a", "b", "c"]', "`up` must be a list of 3 numbers"),
    ('ply = "ball.ply"\nup = "abc"', "`up` must be a list of 3 numbers"),
    ('ply = "ball.ply"\nopacity_above = 1', "at least 0 and below 1"),
    ('ply = "ball.ply"\nopacity_above = 0.95', "none of them in the region"),
    ('ply = "ball.ply"\nsize = 0', "`size` must be a finite number above 0"),
    ('ply = "ball.ply"\nposition = [0, 0]', "`position` must be a list of 3 numbers"),
    ('ply = "ball.ply"\nposition = [5, 0, 0]', "must lie inside the grid"),
    ('ply = "ball.ply"\nrotation = "x"', "`rotation` must be a number"),
    ('ply = "ball.ply"\nrotation = [30]', "`rotation` must be written as [[rotation]] tables"),
    ('ply = "ball.ply"\nrotation = [{ axis = [0, 0, 0], angle = 1 }]', "`axis` must not be zero"),
    ('ply = "ball.ply"\nrotation = [{ axis = [0, 0, 1] }]', "[[rotation]] 1: `angle` is missing"),
    ('ply = "ball.ply"\nvelocity = 1', "`velocity` must be a list of 3 numbers"),
    ('ply = "ball.ply"\nsplit_longer_than = 0', "`split_longer_than` must be a finite number"),
    ('ply = "ball.ply"\nsplit_longer_than = 1e-9', "[model]: Argument `longest` must give at"),
    ('ply = "ball.ply"\nfill = true', "`fill` must be a table"),
    ('ply = "ball.ply"\nfill = { spcing = 1 }', "[fill]: `spcing` is not a known key (did you"),
    ('ply = "ball.ply"\nfill = { spacing = 0 }', "`spacing` must be a finite number above 0"),
    ('ply = "ball.ply"\nfill = { spacing = 1e-5 }', "[model]: Argument `spacing`"),
    ('ply = "ball.ply"\nfill = { max_particles = 0 }', "`max_particles` must be a whole number"),
    ('ply = "one.ply"', "must not all be at the same place"),
]


@pytest.mark.parametrize(("lines", "words"), BAD)
def test_mistakes(tmp_path, lines, words):
    save_ply(tmp_path / "one.ply", ball(1))
    with pytest.raises(SceneError, match=re.escape(words)) as error:
        planned(tmp_path, "[model]", lines, GRID, JELLY)
    assert str(error.value).startswith("scene.toml")


def test_a_model_in_place_of_the_files_own(tmp_path):
    """Its up is that of its kind, unless the file says otherwise."""
    save_ply(tmp_path / "ball.ply", ball())
    file = read_scene(write(tmp_path, '[model]\nprocedural = "ficus"\nsize = 0.5', GRID, JELLY))
    p = plan(file, ply=tmp_path / "ball.ply")
    np.testing.assert_allclose(p.state.x, planned(tmp_path, MODEL, GRID, JELLY).state.x, atol=1e-7)
    with pytest.raises(SceneError, match="there is no"):
        plan(file, ply=tmp_path / "bell.ply")


def test_notes_tell_of_needles_and_splitting(tmp_path):
    needles, split = planned(tmp_path, MODEL + "split_longer_than = 0.3", GRID, JELLY).notes
    assert needles.startswith("needles: 200 Gaussians (0 not finite)")
    assert "longer than 0.1 m (grid)" in needles
    before, after = (int(n) for n in re.findall(r"\d+", split))
    assert split.startswith("splitting: ")
    assert after > before == 200


def test_filling_gives_volumes_and_a_hidden_inside(tmp_path):
    shell = sphere()
    save_ply(tmp_path / "ball.ply", shell)
    p = planned(tmp_path, MODEL + "fill = { spacing = 0.04, seed = 3 }", GRID, JELLY)
    n, volume = len(shell), 4 / 3 * np.pi * 0.25**3
    assert p.scene.particle_count > n + 300
    np.testing.assert_allclose(float(p.scene.volumes.sum()), volume, rtol=0.05)
    _, note = p.notes
    assert note.startswith("filling: 1 closed bodies")
    inside = p.moving[n:]
    # Round, nearly opaque, of the colour of the surface, whatever the direction.
    sigma = np.linalg.svd(np.asarray(inside.factors), compute_uv=False)
    np.testing.assert_allclose(sigma[:, 0], sigma[:, 2])
    assert sigma.max() <= 0.02 * (1 + 1e-6)
    np.testing.assert_allclose(inside.opacities, 0.99, rtol=1e-6)
    np.testing.assert_allclose(inside.sh[:, 0], np.broadcast_to([1, -0.5, 0.2], (len(inside), 3)))
    assert not np.any(inside.sh[:, 1:])
    camera = p.camera(0)
    whole, hollow = (np.asarray(render(g, camera).rgb) for g in (p.moving, p.moving[:n]))
    assert -10 * np.log10(np.mean((whole - hollow) ** 2)) > 40


def test_an_open_body_is_not_filled(tmp_path):
    shell = sphere()
    save_ply(tmp_path / "ball.ply", shell[np.asarray(shell.means)[:, 1] > 0])
    p = planned(tmp_path, MODEL + "fill = { spacing = 0.05, seal = 0.05 }", GRID, JELLY)
    assert p.scene.particle_count == np.sum(np.asarray(shell.means)[:, 1] > 0)
    assert p.scene.volumes.shape == (p.scene.particle_count,)


VIEWS = [(-60, 12), (30, 40), (150, -15)]
CAPTURES = {
    # Region in the capture, spacing of the grid, and the least PSNR of the three views in dB.
    "playbot_31000.ply": ("region = { lower = [-1.2, -1.3, -1.2], upper = [1.2, -0.14, 1.2] }", 37),
    "guitar.compressed.ply": ("", 45),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param("playbot_31000.ply", marks=pytest.mark.slow), "guitar.compressed.ply"],
)
def test_filled_captures_look_as_before(tmp_path, reference_data, name, measure):
    region, least = CAPTURES[name]
    path = reference_data / "splats" / name
    model = f'[model]\nply = "{path}"\n{region}\nfill = {{}}'
    grid = (
        "[grid]\nlower = [-0.8, -0.8, -0.2]\nupper = [0.8, 0.8, 1.2]\nspacing = 0.035\n"
        if region
        else "[grid]\nlower = [-0.8, -0.8, -0.2]\nupper = [0.8, 0.8, 1.2]\nspacing = 0.025\n"
    )
    p = planned(tmp_path, model, grid, JELLY)
    surface = int(re.search(r"(\d+) particles inside", p.notes[1])[1])
    bare = p.moving[: p.scene.particle_count - surface]
    for azimuth, elevation in VIEWS:
        camera = Camera.orbit(
            (0, 0, 0.4),
            up=(0, 0, 1),
            azimuth=np.radians(azimuth),
            elevation=np.radians(elevation),
            radius=2.2,
            fov_y=np.radians(36),
            width=320,
            height=320,
        )
        whole, hollow = (
            np.clip(np.asarray(render(g, camera, background=(1, 1, 1)).rgb), 0, 1)
            for g in (p.moving, bare)
        )
        psnr = -10 * np.log10(np.mean((whole - hollow) ** 2))
        measure("fill", f"{name} at {azimuth}, dB", psnr, above=least)


def test_surroundings_can_be_left_out(tmp_path):
    model = MODEL + "region = { lower = [-9, -9, -9], upper = [9, 0.1, 9] }\n"
    with_rest, without = (
        planned(tmp_path, model + line, GRID, JELLY) for line in ("", "surroundings = false")
    )
    assert len(with_rest.still) > 0
    assert len(without.still) == 0
    np.testing.assert_array_equal(with_rest.state.x, without.state.x)


def test_bodies_without_still_gaussians_are_drawn(tmp_path):
    p = planned(tmp_path, MODEL, GRID, JELLY)
    assert len(p.still) == 0
    assert len(concatenate([p.moving, p.still])) == p.scene.particle_count
