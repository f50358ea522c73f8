"""Level 2: solutions the discrete equations have exactly (V15–V19)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SCHEMES, MissingTimeStep, lattice, positions, roll

import pgjax.models as pm
from pgjax.boundary import HalfSpace, Separating
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state

H = 0.1
F64 = pytest.param(jnp.float64, id="f64", marks=pytest.mark.float64)
F32 = pytest.param(jnp.float32, id="f32")


def largest(error):
    return np.max(np.abs(np.asarray(error, np.float64)))


def blob(d, name, gravity, *, scheme=None):
    """An irregular soft body in a periodic box."""
    rng = np.random.default_rng(5)
    spline, standard, _ = SCHEMES[name]
    x = 0.25 + 0.35 * rng.random((40, d))
    grid = Grid(np.zeros(d), (9, 8, 7)[:d], H, periodic=(True,) * d)
    material = pm.Material(pm.FixedCorotated(1e4, 0.3))
    volumes = H**d * rng.uniform(0.05, 0.3, 40)
    scheme = standard if scheme is None else scheme
    return Scene(grid, material, volumes, gravity=gravity, spline=spline, scheme=scheme), x


def fall(scene, x, g, dt, steps, dtype):
    """Worst relative error of velocity and displacement, and of F, in free fall."""
    state = initial_state(scene, x, dtype=dtype)
    end, _ = roll(scene, state, dt, steps)
    travelled = g * dt**2 * steps * (steps + 1) / 2
    v = largest(end.v - g * dt * steps) / largest(g * dt * steps)
    moved = np.asarray(end.position, np.float64) - np.asarray(state.position)
    return v, largest(moved - travelled) / largest(travelled), largest(end.He)


@pytest.mark.parametrize("dtype", [F64, F32])
@pytest.mark.parametrize(("d", "name"), [(2, "quadratic-mls"), (2, "cubic-grad"), (3, "quadratic-grad"), (3, "cubic-mls")])
def test_v15_free_fall_and_v16_translation(measure, d, name, dtype):
    exact = dtype == jnp.float64
    rng = np.random.default_rng(6)
    g = rng.normal(size=d)
    scene, x = blob(d, name, g)
    dt, steps = 5e-3, 200
    v, moved, F = fall(scene, x, g, dt, steps, dtype)
    case, tolerance = f"{name}, {d}-D, {dtype.__name__}", 1e-12 if exact else 1e-5
    measure("V15", f"v = g n Δt, {case}", v, below=tolerance)
    measure("V15", f"x = x₀ + g Δt² n(n+1)/2, {case}", moved, below=tolerance)
    measure("V15", f"F = I, {case}", F, below=tolerance)

    direction = rng.normal(size=d)
    velocity = 12 * H / (dt * steps) * direction / np.linalg.norm(direction)
    resting = eqx.tree_at(lambda s: s.gravity, scene, jnp.zeros(d))
    state = initial_state(resting, x, velocity, dtype=dtype)
    end, _ = roll(resting, state, dt, steps)
    assert largest(np.linalg.norm(end.position - state.position, axis=1)) > 10 * H
    error = largest(end.v - np.asarray(state.v)) / largest(velocity)
    measure("V16", f"v constant, {case}", error, below=tolerance)
    measure("V16", f"F = I, {case}", largest(end.He), below=tolerance)
