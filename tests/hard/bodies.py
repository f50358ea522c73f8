"""Small bodies of every kind of material, whose programs the hard cases share."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from pgjax import boundary

E, NU, RHO, H, N = 1e4, 0.3, 1000.0, 0.1, 12
WALLS = boundary.Box((-9.0, -9.0), (9.0, 9.0))
FLOOR = boundary.Box((-9.0, 2 * H), (9.0, 9.0), boundary.Separating())

MATERIALS = {
    "FixedCorotated": pm.Material(pm.FixedCorotated(E, NU), density=RHO),
    "StVKHencky": pm.Material(pm.StVKHencky(E, NU), density=RHO),
    "NeoHookean": pm.Material(pm.NeoHookean(E, NU), density=RHO),
    "sand": pm.Material(pm.StVKHencky(E, NU), pm.DruckerPrager(30.0), RHO),
    "metal": pm.Material(pm.StVKHencky(E, NU), pm.VonMises(100.0), RHO),
    "paste": pm.Material(pm.DevVolNeoHookean(E, NU), pm.HerschelBulkley(50.0, 10.0), RHO),
}
# The others share their spectral form with sand; paste takes three times as long to compile.
QUICK = ("NeoHookean", "sand")
every_material = pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in MATERIALS]
)


def tolerance(double, single):
    """A bound for the precision of this run."""
    return double if jnp.zeros(()).dtype == jnp.float64 else single


def block(side=6, spacing=0.5 * H, center=(0.55, 0.55)):
    """Positions `(side², 2)` of a square of particles, in the first quarter of each cell."""
    line = spacing * (np.arange(side) - (side - 1) / 2)
    return np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2) + center


def world(material, x, *, grid=None, volumes=None, walls=WALLS, **kwargs):
    """A scene of one material, or several; the default walls are far away."""
    n = len(x)
    grid = pgjax.Grid((0.0, 0.0), (N, N), H) if grid is None else grid
    material = MATERIALS[material] if isinstance(material, str) else material
    volumes = np.full(n, 0.25 * H**2) if volumes is None else volumes
    boundaries = () if walls is None else (walls,)
    return pgjax.Scene(grid, material, volumes, boundaries=boundaries, **kwargs)


def run(scene, state, dt, steps):
    """So many steps; another number of them, or another dt, does not compile again."""
    return _run(scene, state, jnp.asarray(dt, state.dtype), jnp.asarray(steps))


@eqx.filter_jit
def _run(scene, state, dt, steps):
    return jax.lax.fori_loop(0, steps, lambda _, s: pgjax.step(scene, s, dt), state)


def slopes(scene, state, dt, seen=True):
    """Value and derivatives of a sum over the particles `seen` after five steps.

    Returns:
        The value, and the derivatives by all arrays of `(scene, state)`.
    """
    arrays, static = eqx.partition((scene, state), eqx.is_inexact_array)
    seen = jnp.broadcast_to(jnp.asarray(seen), (scene.particle_count,))
    return _slopes_of(arrays, static, jnp.asarray(dt, state.dtype), seen)


@eqx.filter_jit
def _slopes_of(arrays, static, dt, seen):
    def loss(arrays):
        scene, state = eqx.combine(arrays, static)
        end = pgjax.simulate(scene, state, dt=dt, frames=1, substeps=5).final
        sound = seen & end.alive
        parts = (end.position, end.v, end.C, end.He)
        return sum(jnp.sum(jnp.sin(jnp.where(sound, a.reshape(len(a), -1).T, 0))) for a in parts)

    return jax.value_and_grad(loss)(arrays)


def is_finite(*trees):
    """Whether every number of the trees is finite."""
    leaves = [
        a for a in jax.tree.leaves(trees) if jnp.issubdtype(jnp.asarray(a).dtype, jnp.inexact)
    ]
    return all(bool(np.isfinite(np.asarray(a)).all()) for a in leaves)


def motion(state):
    """What moves and deforms of a state."""
    return state.position, state.v, state.C, state.He


def bits(state):
    """The same as bytes."""
    return [np.asarray(a).tobytes() for a in motion(state)]


def momentum(scene, state):
    """Total momentum, kg m/s, in double precision."""
    return np.asarray(scene.masses, np.float64) @ np.asarray(state.v, np.float64)


def kinetic(scene, state):
    """Kinetic energy, J, with that of the affine velocities."""
    m, D = np.asarray(scene.masses, np.float64), float(scene.D)
    v, C = np.asarray(state.v, np.float64), np.asarray(state.C, np.float64)
    return float(m @ (np.sum(v**2, axis=1) + D * np.sum(C**2, axis=(1, 2)))) / 2


def largest(a):
    """The largest magnitude."""
    return float(np.max(np.abs(np.asarray(a, np.float64))))
