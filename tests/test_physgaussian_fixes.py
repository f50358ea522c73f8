"""Configuration files of PhysGaussian: what is refused, what is set right, and the commands."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from physgaussian_files import (
    BOX,
    CONFIGS,
    converted,
    cuboid,
    note,
    pin,
    released,
    training,
    written,
)

from pgjax.boundary import Sticky
from pgjax.cli import main
from pgjax.scenes import SceneError, plan
from pgjax.scenes.physgaussian import convert


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """The folder of a training with two states and three cameras."""
    return training(tmp_path_factory.mktemp("trained"))


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
