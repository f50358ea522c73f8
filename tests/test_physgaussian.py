"""Configuration files of PhysGaussian become scenes: places, values, conditions, cameras."""

import math
import tomllib
import types

import jax.numpy as jnp
import numpy as np
import pytest
from physgaussian_files import (
    CONFIGS,
    SIDES,
    STEPS,
    cloud,
    converted,
    note,
    released,
    training,
    twist,
)
from scipy.spatial.transform import Rotation

from pgjax.boundary import Box, Collider, ParticleImpulse, ParticleMotion, Separating, Sticky
from pgjax.boundary.particles import Particles
from pgjax.scenes import SceneError, plan
from pgjax.scenes.physgaussian import placing


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """The folder of a training with two states and three cameras."""
    return training(tmp_path_factory.mktemp("trained"))


def expected_positions(config):
    """Where the reference has the Gaussians: turned, selected, scaled, centred at (1, 1, 1)."""
    gaussians = cloud()
    x = np.asarray(gaussians.means, np.float64)
    x = x[np.asarray(gaussians.opacities) > 0.02]
    for angle, axis in zip(
        config.get("rotation_degree", []), config.get("rotation_axis", []), strict=True
    ):
        x = x @ Rotation.from_euler("xyz"[axis], angle, degrees=True).as_matrix().T
    if "sim_area" in config:
        area = np.asarray(config["sim_area"])
        x = x[np.all((x > area[::2]) & (x < area[1::2]), axis=1)]
    lower, upper = x.min(axis=0), x.max(axis=0)
    return (x - (lower + upper) / 2) * config.get("scale", 1.0) / (upper - lower).max() + 1


@pytest.fixture(scope="module")
def public(tmp_path_factory, model):
    """All public configurations, converted and planned, with few particles inside."""
    folder = tmp_path_factory.mktemp("configs")
    made = {}
    for name, config in CONFIGS.items():
        fill = config.get("particle_filling")
        coarse = {} if fill is None else {"particle_filling": fill | {"n_grid": 12}}
        made[name] = converted(folder, model, name, **coarse)
    return {name: (one, plan(one.scene())) for name, one in made.items()}


@pytest.mark.parametrize("name", CONFIGS)
def test_particles_are_where_the_configuration_has_them(public, name):
    config, planned = CONFIGS[name], public[name][1]
    expected = expected_positions(config)
    x = np.asarray(planned.moving.means, np.float64)
    assert 20 < len(expected) <= 360
    assert (len(x) > len(expected)) == ("particle_filling" in config)
    # Particles are in the order of their materials, the filled ones last.
    x = x[: len(expected)]
    order = np.argsort(x[:, 0]), np.argsort(expected[:, 0])
    np.testing.assert_allclose(x[order[0]], expected[order[1]], atol=2e-6)
    still = 360 - len(expected)
    assert len(planned.still) == still


@pytest.mark.parametrize("name", CONFIGS)
def test_frames_and_steps(public, name):
    config, planned = CONFIGS[name], public[name][1]
    assert planned.substeps == STEPS[name]
    assert planned.frames == config["frame_num"]
    if name != "ficus":
        assert planned.dt == pytest.approx(config["substep_dt"], rel=1e-9)
    np.testing.assert_allclose(planned.scene.gravity, config["g"], rtol=1e-6)
    grid = planned.scene.grid
    assert float(grid.h) == pytest.approx(2 / config["n_grid"], rel=1e-6)
    # Moved down only, by less than a spacing, where a floor is between nodes.
    np.testing.assert_array_equal(grid.origin[:2], 0)
    assert -float(grid.h) < float(grid.origin[2]) <= 0
    layer = int(float(grid.origin[2]) < 0)
    assert tuple(grid.shape) == (config["n_grid"], config["n_grid"], config["n_grid"] + layer)


def test_written_scene_is_what_runs(public, tmp_path):
    made = public["vasedeck"][0]
    made.write(tmp_path / "flower.toml")
    text = (tmp_path / "flower.toml").read_text()
    assert tomllib.loads(text) == made.table
    assert all(f"# {line}\n" in text for line in made.notes)
    labels = np.load(tmp_path / "vasedeck-labels.npy")
    assert labels.shape == (400,)
    assert labels.sum() == len(expected_positions(CONFIGS["vasedeck"]))


def test_materials(public):
    wood, leaves = (public["ficus"][1].scene.materials[i] for i in (1, 0))
    for material, density in ((wood, 200), (leaves, 70)):
        assert type(material.elasticity).__name__ == "FixedCorotated"
        assert float(material.density) == density
        assert float(material.elasticity.E) == 2e6
    x, count = np.asarray(public["ficus"][1].moving.means), public["ficus"][1].scene.counts[0]
    assert (x[:count, 2] >= 1).all()
    assert (x[count:, 2] < 1).all()
    (metal,) = public["plane"][1].scene.materials
    assert type(metal.elasticity).__name__ == "StVKHencky"
    assert float(metal.plasticity.yield_stress) == 100
    assert metal.plasticity.hardening is None
    (sand,) = public["wolf"][1].scene.materials
    assert type(sand.plasticity).__name__ == "DruckerPrager"
    assert float(sand.plasticity.friction_angle) == 30
    assert public["wolf"][1].view.max_stretch == 1.25


def test_damping_is_a_rate(public):
    bread = public["tear_bread"][1].scene
    assert float(bread.grid_damping) == pytest.approx(-math.log(0.9995) / 1e-4, rel=1e-5)
    assert float(bread.shear_damping) == pytest.approx(math.log(2) / 1e-4, rel=1e-5)
    assert float(public["ficus"][1].scene.grid_damping) == pytest.approx(1.00005, rel=1e-5)
    assert "the rate 1 1/s" in note(public["ficus"][0], "grid_v_damping_scale")


def test_ficus_pot_and_push(public):
    made, planned = public["ficus"]
    (pot,), (push,) = planned.scene.boundaries, planned.scene.particle_conditions
    assert isinstance(pot, Collider)
    assert isinstance(pot.contact, Sticky)
    np.testing.assert_allclose(pot.shape.center, [1, 1, 0.5])
    np.testing.assert_allclose(pot.shape.half_size, [0.5, 0.5, 0.28], rtol=1e-6)
    assert isinstance(push, ParticleImpulse)
    assert int(push.mask.sum()) == 360
    np.testing.assert_allclose(push.momentum, [-0.18 * 1e-4 * 360, 0, 0], rtol=1e-5)
    assert float(push.duration) == pytest.approx(1e-4)
    assert "360 particles" in note(made, "particle_impulse")


def test_bounding_box_holds_the_nodes_of_the_reference(public):
    box, *others = public["plane"][1].scene.boundaries
    assert isinstance(box, Box)
    assert not others
    assert isinstance(box.contact, Separating)
    nodes = jnp.asarray(np.arange(121) * (2 / 120))
    side = np.asarray(box.sides([nodes, nodes, nodes])[0])
    np.testing.assert_array_equal(np.flatnonzero(side == -1), [0, 1, 2])
    np.testing.assert_array_equal(np.flatnonzero(side == 1)[:2], [117, 118])


def test_pillows_are_let_go(public):
    _, floor, left, right = public["pillow2sofa"][1].scene.boundaries
    assert [float(c.end) for c in (floor, left, right)] == [1000, 0.5, 1]
    np.testing.assert_allclose(floor.shape.center, [1, 1, 0.3], rtol=1e-6)
    np.testing.assert_allclose(right.shape.half_size, 0.1, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "spacing"),
    [("tear_bread", 0.0072), ("plane", 0.012), ("wolf", 0.012), ("pillow2sofa", 0.01)],
)
def test_fillings_have_the_distance_of_the_file(tmp_path, model, monkeypatch, name, spacing):
    """0.8/128/4^(1/3) of the pillows is finer than half a cell of 0.02."""
    seen = []

    def fake(part, grid):
        seen.append((part.fill, grid))
        if refused and len(seen) < 3:
            raise SceneError("Argument `spacing` must be larger.")
        return types.SimpleNamespace(moving=types.SimpleNamespace(means=np.ones((1, 3))))

    monkeypatch.setattr(placing, "body", fake)
    for refused in (False, True):
        seen.clear()
        wanted = spacing * (1.44 if refused else 1)
        made = converted(tmp_path, model, name)
        assert made.table["model"]["fill"]["spacing"] == pytest.approx(wanted)
        assert seen[-1][0].spacing == pytest.approx(wanted)
        assert seen[-1][0].max_particles == 2_000_000
        assert seen[-1][1] == pytest.approx(2 / CONFIGS[name]["n_grid"])
        is_coarser = refused or name == "pillow2sofa"
        assert ("was finer" in note(made, "particle_filling")) == is_coarser


def test_bread_is_pulled_by_the_last_condition_that_takes_a_particle(public):
    up, down = public["tear_bread"][1].scene.particle_conditions
    assert isinstance(up, ParticleMotion)
    np.testing.assert_allclose(up.motion.linear, [0, 0.2, 0], rtol=1e-6)
    np.testing.assert_allclose(down.motion.linear, [0, -0.2, 0], rtol=1e-6)
    assert float(up.end) == pytest.approx(2.2)
    x = np.asarray(public["tear_bread"][1].moving.means)
    np.testing.assert_array_equal(up.mask, np.abs(x[:, 1] - 1.25) < 0.1)


def test_twists_turn_against_the_normal(public):
    made, planned = public["vasedeck"]
    base, rest, back, hold, there = planned.scene.particle_conditions
    assert [float(c.start) for c in (there, hold, back, rest)] == pytest.approx([0, 0.3, 0.6, 0.9])
    np.testing.assert_allclose(there.motion.angular, [0, -1.9, 0], atol=1e-6)
    np.testing.assert_allclose(back.motion.angular, [0, 1.9, 0], atol=1e-6)
    np.testing.assert_allclose(there.motion.pivot, [1.025, 0.7, 0.975], rtol=1e-6)
    np.testing.assert_allclose(hold.motion.linear, 0)
    x = np.asarray(planned.moving.means) - [1.025, 0.7, 0.975]
    inside = (np.abs(x[:, 1]) < 0.2) & (np.hypot(x[:, 0], x[:, 2]) < 0.1)
    assert 0 < inside.sum() < len(x)
    np.testing.assert_array_equal(there.mask, inside)
    assert base.mask.any()
    assert "-1.9 rad/s" in note(made, "enforce_particle_velocity_rotation")


def test_a_particle_on_the_axis_turns(tmp_path, model):
    made = converted(tmp_path, model, boundary_conditions=[twist(1, 0, 1, point=(1, 1, 1))])
    planned = plan(made.scene())
    (led,) = planned.scene.particle_conditions
    n = len(planned.moving)
    first = np.flatnonzero(led.mask)[:2]
    x = np.array(planned.state.x) + np.asarray(planned.state.origin)
    x[first] = [[1, 1.1, 1], [1.05, 1, 1]]
    zero = jnp.zeros((n, 3))
    before = Particles(jnp.asarray(x), zero, jnp.zeros((n, 3, 3)), jnp.ones(n), jnp.zeros(n, bool))
    after = led(before, jnp.asarray(0.0), jnp.asarray(1e-6))
    assert jnp.isfinite(after.v).all()
    # About −y with 1 rad/s.
    np.testing.assert_allclose(after.v[first], [[0, 0, 0], [0, 0, 0.05]], atol=1e-5)


def test_wolf_is_released_as_in_the_reference(tmp_path, model):
    planned = plan(converted(tmp_path, model, "wolf", "particle_filling").scene())
    _, floor = planned.scene.boundaries
    assert isinstance(floor.contact, Sticky)
    (release,) = planned.scene.particle_conditions
    assert release.mask.all()
    expected = released(np.asarray(planned.moving.means)[:, 0], 50)
    assert np.ptp(expected) > 1.4
    # A layer may begin a rounding earlier.
    late = np.asarray(release.end) - expected
    assert np.abs(late).max() < 1.01 * 1.5 / 50
    assert np.mean(np.abs(late) < 1e-5) > 0.98


def test_cameras(public):
    eye = public["ficus"][1].camera(0)
    assert (eye.width, eye.height) == (80, 60)
    side = SIDES[0]
    world = np.linalg.inv(np.asarray(eye.world_to_camera, np.float64))
    # The second camera, 5 units before the middle of the capture.
    np.testing.assert_allclose(world[:3, 3], [1, 1 - 5 / side, 1], atol=0.03)
    assert note(public["vasedeck"][0], "move_camera")
    table = public["tear_bread"][0].table["camera"]
    assert table["azimuth"] == 30
    assert table["elevation"] == 20
    assert table["turn"] == pytest.approx(40)
    per_unit = 0.6 / np.ptp(_turned_bread(), axis=0).max()
    assert table["radius"] == pytest.approx(4 * per_unit, rel=1e-5)
    assert table["fov"] == pytest.approx(2 * math.degrees(math.atan(0.4)))


def _turned_bread():
    x = np.asarray(cloud().means, np.float64)[np.asarray(cloud().opacities) > 0.02]
    return x @ Rotation.from_euler("y", 25, degrees=True).as_matrix().T


def test_a_camera_that_rises_has_a_key_at_each_frame(tmp_path, model):
    made = converted(tmp_path, model, "tear_bread", "particle_filling",
                     frame_num=10, delta_e=1.5, delta_r=-0.1)  # fmt: skip
    planned = plan(made.scene())
    for frame in (0, 3, 10):
        pose = np.linalg.inv(np.asarray(planned.camera(frame).world_to_camera, np.float64))
        d = pose[:3, 3] - 1
        radius = made.table["camera"]["keyframes"][0]["radius"] * (4 - 0.1 * frame) / 4
        assert np.linalg.norm(d) == pytest.approx(radius, rel=1e-4)
        rise = math.degrees(math.asin(d[2] / np.linalg.norm(d)))
        assert rise == pytest.approx(20 + 1.5 * frame, abs=1e-2)
        turned = math.degrees(math.atan2(d[1], d[0]))
        assert turned == pytest.approx(30 + 0.4 * frame, abs=1e-2)
    with pytest.raises(SceneError, match=r"`delta_e` must keep .* reaches 170"):
        converted(tmp_path, model, "tear_bread", "particle_filling", delta_e=0.5)
