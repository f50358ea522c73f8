"""The six public configurations of PhysGaussian, rebuilt from what is known, and a capture."""

import json
import math

import jax.numpy as jnp
import numpy as np

from pgjax.render import Gaussians, save_ply
from pgjax.scenes.physgaussian import convert

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


def training(folder):
    """The folder of a training with two states and three cameras."""
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


def released(x, layers, *, first=1.5, last=0.5, until=1.5):
    """When the boxes of the reference let particles go, s."""
    held = np.zeros(len(x))
    for i in range(layers):
        size = abs(first - last) * (layers - i) / layers
        held[np.abs(x - last) < size] = until / layers * (i + 1)
    return held
