"""Every argument of the public functions given values of any kind: `python arguments.py`.

Types are not checked here, as they are not where the package is used. Printed is what came out
other than a result or a `ValueError` that names its argument.
"""

import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import pgjax
from pgjax import boundary, models
from pgjax.render import Camera, CameraPath, Gaussians, Similarity

WRONG = [None, "soft", "", b"x", -1, 1.5j, math.nan, -math.inf, [], (), [[]], ["a"], {}, {"a": 1}]
WRONG += [[[1, 2], [3]], np.full(8, np.nan), np.array("a"), np.array([1, None], object), object()]
UNUSUAL = [True, 0, 1, 2.5, 10**30, 10**400, 1e308, -1e308, 1e-320, math.inf, [1.0], [1.0, 2.0]]
UNUSUAL += [[1.0, 2.0, 3.0], (1, 2, 3, 4), np.zeros(0), np.zeros((3, 3)), np.ones(8), range(3)]
UNUSUAL += [np.ones(8, bool), np.int64(3), jnp.float32(2.0), lambda *_: None]

X = np.full((8, 3), 0.4) + 1e-3 * np.arange(8)[:, None]
JELLY = models.Material(models.NeoHookean(1e4, 0.3))
GRID = pgjax.Grid((0.0, 0.0, 0.0), (8, 8, 8), 0.1)
SCENE = pgjax.Scene(GRID, JELLY, np.full(8, 1e-3))
STATE = pgjax.initial_state(SCENE, X)
MASK, ZERO, UP = np.ones(8, bool), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
LENS = {"fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48, "near": 0.01}
CAMERA = Camera(np.eye(4), **LENS)
SIZE = {"width": 64, "height": 48, "fov_y": 1.0}
TIMES = {"start": 0.0, "end": 1.0}

# Valid arguments of each function.
CALLS = {
    pgjax.Grid: {"origin": ZERO, "shape": (8, 8, 8), "h": 0.1, "periodic": None},
    pgjax.BSpline: {"degree": 2},
    pgjax.Scene: {
        "grid": GRID,
        "materials": JELLY,
        "volumes": np.full(8, 1e-3),
        "counts": (8,),
        "gravity": ZERO,
        "boundaries": (),
        "particle_conditions": (),
        "X0": X,
        "spline": None,
        "scheme": None,
        "grid_damping": 0.0,
        "shear_damping": 0.0,
    },
    pgjax.initial_state: {"scene": SCENE, "x": X, "v": 0.0, "C": 0.0, "F": None, "dtype": None},
    pgjax.stable_dt: {"scene": SCENE, "state": None, "frame": 0.1, "fraction": 0.5},
    models.Material: {"elasticity": models.NeoHookean(1e4, 0.3), "density": 1e3},
    models.FixedCorotated: {"E": 1e4, "nu": 0.3},
    models.Fluid: {"bulk_modulus": 1e5, "viscosity": 0.0, "gamma": 7.0},
    models.Snow: {"E": 1e4, "nu": 0.3, "hardening": 10.0},
    models.VonMises: {"yield_stress": 10.0, "hardening": 0.1},
    models.DruckerPrager: {"friction_angle": 30.0, "cohesion": 1.0},
    models.HerschelBulkley: {"yield_stress": 1.0, "viscosity": 1.0, "h": 1.0},
    models.KelvinVoigt: {"elasticity": models.NeoHookean(1e4, 0.3), "viscosity": 1.0},
    models.ActiveStress: {"direction": UP, "activation": 1.0},
    boundary.HalfSpace: {"point": ZERO, "normal": UP},
    boundary.Sphere: {"center": ZERO, "radius": 1.0},
    boundary.Cuboid: {"center": ZERO, "half_size": (1.0, 1.0, 1.0), "turn": None},
    boundary.Capsule: {"start": ZERO, "end": UP, "radius": 1.0},
    boundary.Box: {"lower": ZERO, "upper": (1.0, 1.0, 1.0), "contact": boundary.Slip()},
    boundary.Separating: {"friction": 0.1},
    boundary.Collider: {
        "shape": boundary.Sphere(ZERO, 1.0),
        "contact": None,
        "motion": None,
        "surface_velocity": None,
        **TIMES,
    },
    boundary.Steady: {"velocity": UP, "angular_velocity": None, "pivot": None, **TIMES},
    boundary.KeyFrames: {"times": [0, 1], "shifts": [ZERO, UP], "turns": None, "pivot": None},
    boundary.ParticleMotion: {"mask": MASK, "motion": boundary.Steady(ZERO), **TIMES},
    boundary.ParticleImpulse: {"mask": MASK, "momentum": UP, "start": 0.0, "duration": 0.1},
    boundary.ParticleForce: {"mask": MASK, "force": UP, **TIMES},
    boundary.Wind: {"velocity": UP, "rate": 1.0, "quadratic": 1.0, "mask": None, **TIMES},
    boundary.release_times: {"x": X, "direction": UP, "layers": None, **TIMES},
    Camera: {"world_to_camera": np.eye(4), **LENS},
    Camera.look_at: {"eye": UP, "target": ZERO, "up": (0.0, 1.0, 0.0), **SIZE},
    Camera.orbit: {
        "center": ZERO,
        "up": UP,
        "azimuth": 0.0,
        "elevation": 0.1,
        "radius": 1.0,
        **SIZE,
    },
    CameraPath: {"times": [0.0, 1.0], "cameras": [CAMERA, CAMERA], "up": None},
    Similarity: {"scale": 1.0, "rotation": np.eye(3), "translation": ZERO},
    Gaussians: {
        "means": np.zeros((2, 3)),
        "factors": np.zeros((2, 3, 3)),
        "opacities": np.ones(2),
        "sh": np.zeros((2, 1, 3)),
        "frames": np.zeros((2, 3, 3)),
    },
}
# Nothing is compiled: none of these is valid.
ROLLOUT = {"scene": SCENE, "state": STATE, "dt": 1e9, "frames": 1, "substeps": 1}
NAMED = ("Argument", "of the arguments", "fewer than 2^31 steps")


def fault(call, arguments):
    """What is wrong with what comes out; None if nothing is."""
    try:
        call(**arguments)
    except ValueError as error:
        if not any(words in str(error) for words in NAMED):
            return f"ValueError: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def faults():
    """All faults, a line each."""
    for call, valid in CALLS.items():
        call(**valid)
        for name in valid:
            for value in [*WRONG, *UNUSUAL]:
                found = fault(call, valid | {name: value})
                if found is not None:
                    yield f"{call.__qualname__}({name}={value!r:.40}): {found[:120]}"
    for name in ROLLOUT:
        for value in WRONG:
            found = fault(pgjax.simulate, ROLLOUT | {name: value})
            if found is not None:
                yield f"simulate({name}={value!r:.40}): {found[:120]}"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for line in faults():
        print(line)
