"""Configuration files of PhysGaussian: their scenes, places and values, and what is refused.

The six public files are rebuilt here from the values that are known of them.
"""

import json
import math
import tomllib
import types

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.boundary import Box, Collider, ParticleImpulse, ParticleMotion, Separating, Sticky
from pgjax.boundary.particles import Particles
from pgjax.cli import main
from pgjax.render import Gaussians, save_ply
from pgjax.scenes import SceneError, plan
from pgjax.scenes.physgaussian import convert, placing

ALWAYS = {"start_time": 0, "end_time": 1e3}
BOX = {"type": "bounding_box"}


def pin(point, size, velocity=(0, 0, 0), **times):
    """A box of particles that is led with one velocity."""
    times = times or ALWAYS
    return {
        "type": "enforce_particle_translation",
        "point": list(point),
        "size": list(size),
        "velocity": list(velocity),
        **times,
    }


def cuboid(point, size, **others):
    """A box of nodes at rest."""
    return {"type": "cuboid", "point": point, "size": size, "velocity": [0, 0, 0], **others}


def twist(scale, start, end, *, point=(1.025, 0.7, 0.975), normal=(0, 1, 0), size=(0.2, 0.1)):
    """A cylinder of particles that is turned."""
    return {
        "type": "enforce_particle_velocity_rotation",
        "point": list(point),
        "normal": list(normal),
        "half_height_and_radius": list(size),
        "rotation_scale": scale,
        "translation_scale": 0.0,
        "start_time": start,
        "end_time": end,
    }


CONFIGS = {
    "ficus": {
        "material": "jelly", "E": 2e6, "nu": 0.4, "density": 200, "g": [0, 0, 0],
        "n_grid": 50, "grid_lim": 2, "substep_dt": 1e-4, "frame_dt": 0.04, "frame_num": 125,
        "grid_v_damping_scale": 0.9999, "opacity_threshold": 0.02, "rpic_damping": 0.0,
        "additional_material_params": [
            {"point": [1, 1, 1.5], "size": [1, 1, 0.5], "E": 2e6, "nu": 0.4, "density": 70}
        ],
        "boundary_conditions": [
            cuboid([1, 1, 0.5], [0.5, 0.5, 0.28], start_time=0, end_time=1e3, reset=1),
            {"type": "particle_impulse", "force": [-0.18, 0, 0], "num_dt": 1, "start_time": 0},
        ],
        "mpm_space_viewpoint_center": [1, 1, 1], "mpm_space_vertical_upward_axis": [0, 0, 1],
        "default_camera_index": 1, "show_hint": False, "move_camera": False,
    },
    "vasedeck": {
        "material": "jelly", "E": 1e4, "nu": 0.3, "density": 40, "g": [0, 0, 0],
        "n_grid": 120, "substep_dt": 1e-4, "frame_dt": 0.04, "frame_num": 75,
        "rotation_degree": [135], "rotation_axis": [0],
        "sim_area": [-0.5, 0.5, -0.6, 0.7, -0.4, 0.4],
        "boundary_conditions": [
            twist(1.9, 0, 0.3), twist(0, 0.3, 0.6), twist(-1.9, 0.6, 0.9), twist(0, 0.9, 3),
            pin([1, 1.44, 1], [1, 0.1, 1]),
        ],
        "default_camera_index": 0, "move_camera": True,
    },
    "pillow2sofa": {
        "material": "jelly", "E": 1e4, "nu": 0.3, "density": 2000, "g": [0, 0, -5],
        "n_grid": 100, "substep_dt": 1e-4, "frame_dt": 0.02, "frame_num": 300,
        "sim_area": [-1, 1, -1, 1, -1, 0.8],
        "particle_filling": {
            "n_grid": 128, "density_threshold": 40.0, "search_threshold": 0.5,
            "search_exclude_direction": 5, "ray_cast_direction": 0, "max_partciels_per_cell": 4,
            "max_particles_num": 2e6, "boundary": [0.6, 1.4, 0.6, 1.4, 0.92, 1.72],
        },
        "boundary_conditions": [
            BOX,
            cuboid([1, 1, 0.3], [1, 1, 0.1], **ALWAYS),
            cuboid([0.8, 1, 1.3], [0.1, 0.1, 0.1], start_time=0, end_time=0.5),
            cuboid([1.2, 1, 1.3], [0.1, 0.1, 0.1], start_time=0, end_time=1.0),
            pin([1, 1, 0.5], [1, 1, 0.4]),
        ],
        "default_camera_index": 0,
    },
    "tear_bread": {
        "material": "jelly", "E": 2e3, "nu": 0.3, "density": 200, "g": [0, 0, 0],
        "n_grid": 150, "substep_dt": 1e-4, "frame_dt": 0.01, "frame_num": 300,
        "rpic_damping": 0.5, "grid_v_damping_scale": 0.9995, "scale": 0.6,
        "rotation_degree": [25], "rotation_axis": [1],
        "particle_filling": {
            "n_grid": 100, "density_threshold": 100, "search_threshold": 0.2,
            "search_exclude_direction": -1, "ray_cast_direction": 4, "smooth": True,
            "visualize": True, "boundary": [0.64, 1.36, 0.64, 1.36, 0.64, 1.36],
        },
        "boundary_conditions": [
            BOX,
            pin([1, 0.75, 1], [1, 0.1, 1], [0, -0.2, 0], start_time=0, end_time=1e3),
            pin([1, 1.25, 1], [1, 0.1, 1], [0, 0.2, 0], start_time=0, end_time=2.2),
        ],
        "default_camera_index": -1, "init_azimuthm": 30.0, "init_elevation": 20.0,
        "init_radius": 4.0, "move_camera": True, "delta_a": 0.4, "delta_e": 0.0, "delta_r": 0.0,
    },
    "plane": {
        "material": "metal", "E": 1e5, "nu": 0.3, "density": 1000, "yield_stress": 100,
        "g": [0, 0, 0], "n_grid": 120, "substep_dt": 1e-4, "frame_dt": 0.01, "frame_num": 400,
        "grid_v_damping_scale": 0.9999, "rotation_degree": [45, 6.5], "rotation_axis": [1, 2],
        "particle_filling": {
            "n_grid": 50, "density_threshold": 40, "search_threshold": 0.5,
            "search_exclude_direction": 0, "ray_cast_direction": 1,
            "boundary": [0.86, 1.46, 0.7, 1.3, 0.7, 1.3],
        },
        "boundary_conditions": [
            BOX,
            pin([0.6, 1, 1], [0.1, 1, 1]),
            pin([1, 1, 1], [0.05, 1, 1]),
            twist(1, 0, 0.5, point=(1.4, 1, 1), normal=(1, 0, 0), size=(0.1, 1)),
            twist(-1, 1, 2, point=(1.4, 1, 1), normal=(1, 0, 0), size=(0.1, 1)),
        ],
        "default_camera_index": 0,
    },
    "wolf": {
        "material": "sand", "E": 5e7, "nu": 0.3, "density": 2000, "friction_angle": 30,
        "g": [0, 0, -9.8], "n_grid": 200, "substep_dt": 2e-5, "frame_dt": 0.04, "frame_num": 50,
        "particle_filling": {
            "n_grid": 100, "density_threshold": 100, "search_threshold": 1.0,
            "search_exclude_direction": 2, "ray_cast_direction": 4, "smooth": True,
            "visualize": True, "boundary": [0.4, 1.6, 0.4, 1.6, 0.4, 1.6],
        },
        "boundary_conditions": [
            BOX,
            {"type": "surface_collider", "point": [1, 1, 0.48], "normal": [0, 0, 1],
             "surface": "sticky", "friction": 0.0, **ALWAYS},
            {"type": "release_particles_sequentially", "normal": [1, 0, 0],
             "start_position": 1.5, "end_position": 0.5, "num_layers": 50,
             "start_time": 0, "end_time": 1.5},
        ],
        "default_camera_index": 0,
    },
}  # fmt: skip
# The step of the ficus is above the bound √½ h/c, c² = (3 λ + 2 μ)/ρ of its light leaves.
FICUS_STEPS = math.ceil(0.04 / (0.5 * math.sqrt(0.5) * 0.04 / math.sqrt(1e7 / 70)))
STEPS = {"ficus": FICUS_STEPS, "vasedeck": 400, "pillow2sofa": 200, "tear_bread": 100, "plane": 100,
         "wolf": 2000}  # fmt: skip
# Shorter than the domain on each side, in the coordinates of the capture.
SIDES = np.array([1.6, 1.4, 1.5])


def cloud(n=400, seed=0):
    """Gaussians that fill a box, some of them hardly there."""
    rng = np.random.default_rng(seed)
    x = (rng.random((n, 3)) - 0.5) * SIDES
    opacities = np.where(np.arange(n) % 10 == 0, 0.01, 0.9)
    q, scales = rng.normal(size=(n, 4)), np.full((n, 3), 0.02)
    return Gaussians.from_scales(
        *(jnp.asarray(a) for a in (x, q, scales, opacities, np.zeros((n, 1, 3))))
    )


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """The folder of a training with two states and three cameras."""
    folder = tmp_path_factory.mktemp("trained")
    for n in (7000, 30000):
        place = folder / "point_cloud" / f"iteration_{n}"
        place.mkdir(parents=True)
        save_ply(place / "point_cloud.ply", cloud(400 if n == 30000 else 5))
    camera = {"rotation": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "position": [0, -4, 0.0],
              "width": 80, "height": 60, "fx": 75.0, "fy": 75.0}  # fmt: skip
    cameras = [camera | {"id": i, "img_name": f"r_{i}", "position": [0, -4 - i, 0.0]}
               for i in range(3)]  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps(cameras))
    return folder


def written(folder, name="ficus", *without, **changes):
    """The path of a configuration: a public one, with changes."""
    config = {k: v for k, v in CONFIGS[name].items() if k not in without} | changes
    path = folder / f"{name}.json"
    path.write_text(json.dumps(config))
    return path


def converted(folder, model, name="ficus", *without, legacy=False, **changes):
    return convert(written(folder, name, *without, **changes), model, legacy=legacy)


def note(made, key):
    """The notes about a key."""
    found = [n for n in made.notes if n.startswith(f"{key}:")]
    assert found, (key, made.notes)
    return " ".join(found)


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
    np.testing.assert_array_equal(grid.origin, 0)
    assert tuple(grid.shape) == 3 * (config["n_grid"],)


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


def released(x, layers, *, first=1.5, last=0.5, until=1.5):
    """When the boxes of the reference let particles go, s."""
    held = np.zeros(len(x))
    for i in range(layers):
        size = abs(first - last) * (layers - i) / layers
        held[np.abs(x - last) < size] = until / layers * (i + 1)
    return held


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


# What is refused


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"densty": 1}, "`densty` is not a known key.*did you mean `density`"),
        ({"E": "stiff"}, "`E` must be a number, but is 'stiff'"),
        ({"nu": 0.5}, "`nu` must be .* below 0.5, but is 0.5"),
        ({"nu": -0.1}, "`nu` must be .* at least 0"),
        ({"grid_lim": 1}, r"`grid_lim` must be 2, .*but is 1"),
        ({"n_grid": 50.5}, "`n_grid` must be a whole number"),
        ({"material": "neo-hookean"}, "`material` must be one of jelly, .*'neo-hookean'"),
        ({"particle_filling": {"max_particles_per_cell": 2}},
         "`max_particles_per_cell` is not a known key.*did you mean `max_partciels_per_cell`"),
        ({"particle_filling": {"search_exclude_direction": [1, 2]}},
         "`search_exclude_direction` must be a whole number"),
        ({"rotation_degree": [10, 20], "rotation_axis": [1]}, "`rotation_degree` must be a list"),
        ({"rotation_degree": [10], "rotation_axis": [3]}, "`rotation_axis` must hold axes"),
        ({"sim_area": [0, 1, 1, 0, 0, 1]}, "`sim_area` must be .*each minimum below"),
        ({"sim_area": [7, 8, 7, 8, 7, 8]}, "`sim_area` must leave at least one Gaussian of 400"),
        ({"default_camera_index": 9}, "`index` must be below 3"),
        ({"boundary_conditions": [{"type": "cubiod"}]}, "`type` must be .*did you mean `cuboid`"),
        ({"boundary_conditions": [{"type": "bounding_box", "end_tme": 3}]},
         r"boundary_conditions\]\] 1: `end_tme` is not a known key.*did you mean `end_time`"),
        ({"boundary_conditions": [{**BOX, "start_time": 2, "end_time": 1}]},
         "`end_time` must be after `start_time` = 2 s, but is 1"),
        ({"scale": 2.5}, "outside|inside"),
    ],
)  # fmt: skip
def test_errors_name_key_rule_and_value(tmp_path, model, changes, message):
    with pytest.raises(ValueError, match=message):
        plan(converted(tmp_path, model, **changes).scene())


def test_missing_files_are_named(tmp_path, model, capsys):
    with pytest.raises(SceneError, match=r"there is no .*ficis\.json"):
        convert(tmp_path / "ficis.json", model)
    path = written(tmp_path)
    with pytest.raises(SceneError, match="`--model` must name a file"):
        convert(path, tmp_path / "nothing")
    with pytest.raises(SceneError, match="must hold point_cloud/iteration_N"):
        convert(path, tmp_path)
    broken = tmp_path / "broken.json"
    broken.write_text('{"E": 1, "E": 2}')
    with pytest.raises(SceneError, match="`E` twice"):
        convert(broken, model)
    assert main(["run", "--physgaussian", str(path)]) == 1
    assert "`--model` must be given" in capsys.readouterr().err
    assert main(["run"]) == 1
    assert "`scene` must be given" in capsys.readouterr().err
    assert main(["run", "ficus", "--legacy"]) == 1
    assert "`--legacy` must be left out" in capsys.readouterr().err


# What the reference gets wrong


def test_a_time_step_that_is_too_long_becomes_a_part_of_the_frame(tmp_path, model):
    made = converted(tmp_path, model, substep_dt=1e-3)
    planned = plan(made.scene())
    limit = float(planned.scene.rest_limit())
    assert planned.dt <= limit / 2
    assert planned.dt * planned.substeps == pytest.approx(0.04)
    assert f"{planned.substeps} steps" in note(made, "substep_dt")
    soft = converted(tmp_path, model, "ficus", "additional_material_params", substep_dt=1e-4)
    assert plan(soft.scene()).substeps == 400
    assert "0.79 of the largest" in note(soft, "frame_dt")


def test_a_time_step_above_the_bound_is_kept_in_legacy_only(tmp_path, model):
    fixed, kept = (plan(converted(tmp_path, model, legacy=on).scene()) for on in (False, True))
    assert float(fixed.scene.rest_limit()) < 1e-4
    assert fixed.dt <= 0.5 * float(fixed.scene.rest_limit()) * (1 + 1e-6)
    assert not fixed.allow_unstable
    assert kept.dt == pytest.approx(1e-4, rel=1e-6)
    assert kept.substeps == 400
    assert kept.allow_unstable


def test_truncated_frames(tmp_path, model):
    assert "2000 steps" in note(converted(tmp_path, model, "wolf", "particle_filling"), "frame_dt")
    made = converted(tmp_path, model, "wolf", "particle_filling", legacy=True)
    planned = plan(made.scene())
    assert planned.substeps == 1999
    assert planned.dt == pytest.approx(2e-5, rel=1e-6)
    assert "1999" in note(made, "frame_dt")


@pytest.mark.parametrize(
    ("surface", "friction", "contact"),
    [("sticky", 0, "sticky"), ("slip", 0, "slip"), ("slip", 0.3, "separating"),
     ("separate", 0.3, "separating"), ("cut", 0, "sticky")],
)  # fmt: skip
def test_surfaces_have_the_contact_asked_for(tmp_path, model, surface, friction, contact):
    wall = {"type": "surface_collider", "point": [1, 1, 0.4], "normal": [0, 0, 1],
            "surface": surface, "friction": friction, "start": 0, "end": 1e3}  # fmt: skip
    made = converted(tmp_path, model, boundary_conditions=[wall])
    assert made.table["boundary"][0]["contact"] == contact
    assert made.table["boundary"][0].get("friction", 0) == (friction if friction else 0)
    assert contact == "sticky" != surface or surface == "sticky" or surface in str(made.notes)
    kept = converted(tmp_path, model, boundary_conditions=[wall], legacy=True)
    assert kept.table["boundary"][0]["contact"] == "sticky"
    assert plan(made.scene()).scene.boundaries
    if surface == "cut":
        assert "not honoured" in note(made, "surface_collider")


def test_reset_freezes_the_world_only_after_the_cuboid(tmp_path, model):
    wall = cuboid([1, 1, 0.5], [0.5, 0.5, 0.28], start_time=1, end_time=2, reset=True)
    made = converted(tmp_path, model, boundary_conditions=[wall])
    _, after = made.table["boundary"]
    assert (after["start"], after["end"]) == (2, pytest.approx(2.0015))
    assert after["half_size"] == [2, 2, 2]
    assert "only after" in note(made, "cuboid")
    kept = converted(tmp_path, model, boundary_conditions=[wall], legacy=True)
    assert [w.get("end") for w in kept.table["boundary"]] == [2, 1, pytest.approx(2.0015)]


def test_a_bounding_box_has_times(tmp_path, model):
    wall = {**BOX, "start_time": 0, "end_time": 1}
    made = converted(tmp_path, model, boundary_conditions=[wall])
    assert [w["type"] for w in made.table["boundary"]] == 6 * ["half-space"]
    assert {w["end"] for w in made.table["boundary"]} == {1}
    assert made.table["boundary"][1]["point"] == [pytest.approx(46.75 * 0.04), 1, 1]
    assert made.table["boundary"][1]["normal"] == [-1, 0, 0]
    kept = converted(tmp_path, model, boundary_conditions=[wall], legacy=True)
    assert kept.table["boundary"][0]["type"] == "box"
    assert "ignored" in note(kept, "bounding_box")


def test_a_moving_cuboid(tmp_path, model):
    wall = cuboid([1, 1, 1.5], [0.2, 0.2, 0.1]) | {"velocity": [0, 0, -0.5], "end_time": 0.5}
    (made,) = plan(converted(tmp_path, model, boundary_conditions=[wall]).scene()).scene.boundaries
    assert isinstance(made.contact, Sticky)
    np.testing.assert_allclose(made.motion.shift(jnp.asarray(0.2)), [0, 0, -0.1], atol=1e-6)
    assert float(made.end) == 0.5


def test_layers_are_those_asked_for(tmp_path, model):
    release = CONFIGS["wolf"]["boundary_conditions"][2] | {"num_layers": 5}
    for legacy, layers in ((False, 5), (True, 50)):
        made = converted(tmp_path, model, "wolf", "particle_filling",
                         boundary_conditions=[release], legacy=legacy)  # fmt: skip
        planned = plan(made.scene())
        (condition,) = planned.scene.particle_conditions
        ends = np.asarray(condition.end)
        assert len(np.unique(ends)) == layers
        expected = released(np.asarray(planned.moving.means)[:, 0], layers)
        assert np.mean(np.abs(ends - expected) < 1e-5) > 0.98
        assert str(layers) in note(made, "release_particles_sequentially")


def test_materials_that_flow(tmp_path, model):
    def law(material, **values):
        values = {"material": material, "E": 1e5, "nu": 0.3, "boundary_conditions": {}, **values}
        made = converted(tmp_path, model, "ficus", "additional_material_params", **values)
        return made, plan(made.scene()).scene.materials[0]

    made, metal = law("metal", yield_stress=50, hardening=1, xi=0.2)
    assert float(metal.plasticity.hardening) == pytest.approx(0.2)
    assert "factor" in note(made, "material")
    made, metal = law("metal", yield_stress=50, xi=0.2)
    assert metal.plasticity.hardening is None
    assert "not used" in note(made, "xi")
    made, foam = law("foam", yield_stress=10, plastic_viscosity=3)
    assert type(foam.elasticity).__name__ == "DevVolNeoHookean"
    assert float(foam.plasticity.viscosity) == 3
    assert made.table["material"][0]["plasticity"]["h"] == 1
    made, snow = law("snow")
    assert type(snow.elasticity).__name__ == "Snow"
    assert "also with `--legacy`" in note(made, "material")
    made, clay = law("plasticine", yield_stress=1e3)
    # The yield stress falls by 0.1 Pa for each unit of plastic strain, as in the reference.
    falls = float(clay.plasticity.softening) * 2 * 1e5 / (2 * 1.3)
    assert falls == pytest.approx(0.1, rel=1e-5)
    made, _ = law("jelly", friction_angle=30)
    assert "not used by jelly" in note(made, "friction_angle")


def test_flow_is_drawn_but_in_legacy(tmp_path, model):
    sand, still = (
        converted(tmp_path, model, "wolf", "particle_filling", legacy=legacy).table["camera"]
        for legacy in (False, True)
    )
    assert (sand["max_stretch"], still["max_stretch"]) == (1.25, 1.0)


def test_later_boxes_win(tmp_path, model):
    boxes = [
        {"point": [1, 1, 1.2], "size": [1, 1, 0.4], "E": 1e5, "nu": 0.3, "density": 70},
        {"point": [1, 1, 1.3], "size": [1, 1, 0.2], "E": 2e5, "nu": 0.2},
        {"point": [5, 1, 1], "size": [1, 1, 1], "E": 1, "nu": 0.2},
    ]
    made = converted(tmp_path, model, additional_material_params=boxes)
    planned = plan(made.scene())
    E = np.repeat([float(m.elasticity.E) for m in planned.scene.materials], planned.scene.counts)
    density = np.repeat([float(m.density) for m in planned.scene.materials], planned.scene.counts)
    z = np.asarray(planned.moving.means)[:, 2]
    second, first = np.abs(z - 1.3) < 0.2, np.abs(z - 1.2) < 0.4
    np.testing.assert_array_equal(E, np.where(second, 2e5, np.where(first, 1e5, 2e6)))
    # Without a density of its own a box keeps the one of the box before.
    np.testing.assert_array_equal(density, np.where(first, 70, 200))
    assert "left out" in note(made, "additional_material_params 3")


def test_gravity_that_is_a_number_or_missing(tmp_path, model):
    made = converted(tmp_path, model, "ficus", "g")
    np.testing.assert_allclose(made.table["forces"]["gravity"], [0, 0, -9.8])
    assert "not given" in note(made, "g")
    made = converted(tmp_path, model, g=3, mpm_space_vertical_upward_axis=[0, 2, 0])
    np.testing.assert_allclose(made.table["forces"]["gravity"], [0, -3, 0])


def test_what_is_not_honoured_is_said(tmp_path, model):
    made = converted(tmp_path, model, pic_damping=0.1, rpic_damping=-1, show_hint=True)
    for key in ("pic_damping", "rpic_damping", "show_hint", "density", "n_grid", "frame_num"):
        assert note(made, key)
    # One step leaves nothing of the shear.
    assert math.exp(-made.table["forces"]["shear_damping"] * 1e-4) < 1e-40
    made = converted(tmp_path, model, boundary_conditions=[pin([9, 9, 9], [1, 1, 1]), BOX])
    assert "particles" not in made.table
    assert "left out" in note(made, "enforce_particle_translation")
    assert "not used" in note(public_filling(tmp_path, model), "particle_filling")
    made = converted(tmp_path, model, "vasedeck")
    assert note(made, "rotation_degree")


def public_filling(folder, model):
    fill = CONFIGS["plane"]["particle_filling"] | {"n_grid": 12}
    return converted(folder, model, "plane", boundary_conditions={}, particle_filling=fill)


def test_legacy_takes_a_domain_that_is_not_centred(tmp_path, model):
    made = converted(tmp_path, model, grid_lim=4, legacy=True)
    planned = plan(made.scene())
    x = np.asarray(planned.moving.means)
    np.testing.assert_allclose((x.min(axis=0) + x.max(axis=0)) / 2, 1, atol=1e-5)
    assert made.table["grid"]["upper"] == [4, 4, 4]
    assert "kept" in note(made, "grid_lim")


# The commands


def test_ficus_runs(tmp_path, model, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = written(tmp_path, n_grid=16, substep_dt=2e-4, frame_dt=2e-3)
    command = ["run", "--physgaussian", str(config), "--model", str(model), "--frames", "2"]
    assert main([*command, "--out", "out/a"]) == 0
    out = capsys.readouterr().out
    assert "note       grid_v_damping_scale: 0.9999 a step" in out
    assert "10 steps a frame" in out
    assert (tmp_path / "out/a/video.mp4").stat().st_size > 0
    record = json.loads((tmp_path / "out/a/run.json").read_text())
    assert record


def test_an_interrupted_run_says_how_to_go_on(tmp_path, model, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = written(tmp_path)
    monkeypatch.setattr("pgjax.scenes.run", _interrupted)
    monkeypatch.setattr("pgjax.scenes.record.unfinished", lambda folder: folder)
    options = ["--physgaussian", str(config), "--model", str(model), "--legacy"]
    assert main(["run", *options]) == 130
    go_on = f"go on with: pgjax run {' '.join(options)} --out out/ficus --resume"
    assert go_on in capsys.readouterr().err


def _interrupted(*_, **__):
    raise KeyboardInterrupt


def test_convert_writes_a_scene_file(tmp_path, model, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = written(tmp_path, "vasedeck", name_of_nothing=None)
    assert main(["convert", str(config), "--model", str(model)]) == 0
    out = capsys.readouterr().out
    assert "wrote      vasedeck.toml, vasedeck-labels.npy" in out
    assert main(["run", "vasedeck.toml", "--dry-run"]) == 0
    assert "400 steps a frame" in capsys.readouterr().out
    assert main(["convert", str(config), "--model", str(model)]) == 1
    assert "must name a new file" in capsys.readouterr().err


def test_a_capture_alone_has_no_cameras(tmp_path, model):
    ply = model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    made = converted(tmp_path, ply)
    assert made.table["camera"] == {"target": [1, 1, 1]}
    assert "orbit" in note(made, "default_camera_index")
