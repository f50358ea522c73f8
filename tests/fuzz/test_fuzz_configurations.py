"""Damaged configurations of PhysGaussian and odd captures: scenes, or named errors."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mutations import cheaply, damaged, damaged_bytes, fuzz, refused
from scene_files import ball

from pgjax.render import Gaussians, save_ply
from pgjax.scenes import SceneError, plan
from pgjax.scenes.draft import draft
from pgjax.scenes.inspect import inspect
from pgjax.scenes.physgaussian import convert
from pgjax.scenes.physgaussian.keys import read_config

TIMES = {"start_time": 0, "end_time": 1.0}
BOX = {"point": [1, 1, 1], "size": [0.6, 0.6, 0.2]}
EVERYTHING = {
    "material": "sand",
    "E": 1e5,
    "nu": 0.3,
    "density": 500,
    "friction_angle": 30,
    "g": [0, 0, -9.8],
    "n_grid": 20,
    "grid_lim": 2,
    "substep_dt": 1e-3,
    "frame_dt": 0.04,
    "frame_num": 3,
    "grid_v_damping_scale": 0.999,
    "rpic_damping": 0.1,
    "opacity_threshold": 0.02,
    "rotation_degree": [30, 10],
    "rotation_axis": [0, 2],
    "sim_area": [-1, 1, -1, 1, -1, 0.3],
    "scale": 0.8,
    "particle_filling": {"n_grid": 20, "max_partciels_per_cell": 2, "density_threshold": 5.0},
    "additional_material_params": [BOX | {"E": 2e5, "nu": 0.2, "density": 700}],
    "boundary_conditions": [
        {"type": "bounding_box"},
        {"type": "cuboid", "velocity": [0, 0, 0.1], "reset": 1, **BOX, **TIMES},
        {
            "type": "surface_collider",
            "point": [1, 1, 0.4],
            "normal": [0, 0, 1],
            "surface": "slip",
            "friction": 0.2,
            **TIMES,
        },
        {"type": "particle_impulse", "force": [0, 0, 0.1], "num_dt": 2, "start_time": 0, **BOX},
        {"type": "enforce_particle_translation", "velocity": [0, 0, 0], **BOX, **TIMES},
        {
            "type": "enforce_particle_velocity_rotation",
            "point": [1, 1, 1],
            "normal": [0, 1, 0],
            "half_height_and_radius": [0.3, 0.2],
            "rotation_scale": 1.0,
            "translation_scale": 0.1,
            **TIMES,
        },
        {
            "type": "release_particles_sequentially",
            "normal": [1, 0, 0],
            "start_position": 1.4,
            "end_position": 0.6,
            "num_layers": 5,
            **TIMES,
        },
    ],
    "mpm_space_viewpoint_center": [1, 1, 1],
    "mpm_space_vertical_upward_axis": [0, 0, 1],
    "default_camera_index": -1,
    "init_azimuthm": 30.0,
    "init_elevation": 10.0,
    "init_radius": 3.0,
    "move_camera": True,
    "delta_a": 1.0,
    "delta_e": 0.0,
    "delta_r": 0.0,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("configurations")
    save_ply(folder / "ball.ply", ball(300))
    return folder


def written(folder, content):
    path = folder / "config.json"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    return path


def test_the_whole_is_valid(folder):
    made = convert(written(folder, EVERYTHING), folder / "ball.ply")
    assert plan(made.scene()).scene.particle_count > 100
    assert {wall["type"] for wall in made.table["boundary"]} >= {"box", "velocity", "half-space"}
    assert {part["type"] for part in made.table["particles"]} >= {"hold", "move", "impulse"}


@fuzz(80)
@given(content=damaged(EVERYTHING), legacy=st.booleans())
def test_damaged_values(folder, content, legacy):
    with refused(SceneError), cheaply():
        read_config(written(folder, content), legacy=legacy)


@fuzz(40)
@given(content=damaged_bytes(json.dumps(EVERYTHING).encode()))
def test_damaged_text(folder, content):
    with refused(SceneError):
        read_config(written(folder, content))


@fuzz(25)
@given(content=damaged(EVERYTHING), legacy=st.booleans())
def test_damaged_conversions(folder, content, legacy):
    with refused(SceneError):
        convert(written(folder, content), folder / "ball.ply", legacy=legacy).scene()


@pytest.mark.parametrize(
    "content",
    [
        b"{" + b",".join(b'"k%d": 1' % i for i in range(60_000)) + b"}",
        b"[" * 100_000,
        b'{"E": ' + b"9" * 100_000 + b"}",
        b'{"g": [NaN, 0, 0]}',
        b'{"E": Infinity}',
        b'{"E": 1, "E": 2}',
        b"\xff\xfe",
        b"",
    ],
    ids=["keys", "brackets", "digits", "nan", "infinity", "twice", "encoding", "empty"],
)
def test_hostile_text_is_refused_cheaply(folder, content):
    with cheaply(), pytest.raises(SceneError):
        read_config(written(folder, content))


def gaussians(x, scales=None, opacity=0.9):
    """Round Gaussians at some places."""
    n = len(x)
    scales = np.full((n, 3), 0.02) if scales is None else scales
    turns = np.tile([1.0, 0, 0, 0], (n, 1))
    parts = (x, turns, scales, np.full(n, opacity), np.zeros((n, 1, 3)))
    return Gaussians.from_scales(*(jnp.asarray(a, dtype=float) for a in parts))


@st.composite
def captures(draw):
    """Clusters, planes, lines and single points, near and far, of any number and size."""
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    n = draw(st.integers(1, 200))
    shape = np.array(draw(st.sampled_from([(1, 1, 1), (1, 1, 0), (1, 0, 0), (0, 0, 0)])))
    x = rng.normal(size=(n, 3)) * shape * draw(st.sampled_from([1e-3, 1, 1e3]))
    x[: draw(st.integers(0, n))] *= draw(st.sampled_from([0, 1e-6, 1, 1e4]))
    scales = np.exp(rng.normal(draw(st.sampled_from([-8, -3, 1])), 2, (n, 3)))
    return gaussians(x, scales, draw(st.sampled_from([0.01, 0.5, 1.0])))


@fuzz(25)
@given(capture=captures())
def test_odd_captures_are_looked_at_or_refused(capture):
    with refused(ValueError):
        found = inspect(capture)
        assert found.moves.any()
        assert np.isclose(np.linalg.norm(found.up), 1)
        assert np.isfinite([*found.lower, *found.upper, found.foot]).all()


@fuzz(4)
@given(capture=captures())
def test_odd_captures_become_scenes_or_are_refused(folder, capture):
    path = folder / "odd.ply"
    with refused(ValueError):
        save_ply(path, capture)
        assert draft(path, folder / "odd.toml")
