"""Level 6, one step: both modes and differences agree, finite at every kink (G1, G4, G5)."""

import equinox as eqx
import impact
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Separating

pytestmark = pytest.mark.float64


def deformations():
    """F − I: rest, rotation, two equal stretches, flow in shear, expansion, compression."""
    H = np.zeros((6, 3, 3))
    H[1, :2, :2] = [[np.cos(0.4) - 1, -np.sin(0.4)], [np.sin(0.4), np.cos(0.4) - 1]]
    H[2] = np.diag([0.02, 0.02, 0.0])
    H[3, 0, 1] = 0.3
    H[4] = 0.05 * np.eye(3)
    H[5] = -0.03 * np.eye(3)
    H[5, 0, 1] = 0.002
    return H


def step_problem(d, degree, x=None, H=None, v=1.0, gained=0.01, **changes):
    """Six particles of each material at a wall with friction."""
    rng = np.random.default_rng(5)
    p = impact.parameters() | changes
    H = deformations() if H is None else H
    n, count = len(H), impact.COUNT * len(H)
    normal = np.eye(d)[0] + 0.3
    scene = pgjax.Scene(
        pgjax.Grid(np.zeros(d), (12,) * d, impact.H),
        impact.materials(p),
        impact.H**d * rng.uniform(0.05, 0.2, count),
        counts=(n,) * impact.COUNT,
        gravity=v * rng.normal(size=d),
        boundaries=(Collider(HalfSpace(np.full(d, 0.413), normal), Separating(0.2)),),
        spline=pgjax.BSpline(degree),
        grid_damping=0.7,
        shear_damping=3.0,
    )
    x = 0.35 + 0.3 * rng.random((count, d)) if x is None else np.tile(x, (impact.COUNT, 1))
    state = pgjax.initial_state(
        scene,
        x,
        v * rng.normal(size=(count, d)),
        C=v * rng.normal(size=(count, d, d)),
        F=np.tile(np.eye(3) + H, (impact.COUNT, 1, 1)),
    )
    # What the metal hardened and the cohesive sand gained at the tip.
    history = tuple(None if h is None else jnp.full_like(h, gained) for h in state.history)
    return scene, eqx.tree_at(lambda s: s.history, state, history)


@eqx.filter_jit
def step_derivatives(problem, tangent, weights, dt):
    """Of one step: `J t` by jvp and by differences, `Jᵀ u` by vjp, and the new state."""
    dynamic, static = eqx.partition(problem, eqx.is_inexact_array)

    def advance(dynamic):
        after = pgjax.step(*eqx.combine(dynamic, static), dt)
        return eqx.filter(after, eqx.is_inexact_array), after

    _, forward, after = jax.jvp(advance, (dynamic,), (tangent,), has_aux=True)
    _, pull, _ = jax.vjp(advance, dynamic, has_aux=True)
    size = jnp.asarray([1e-7, -1e-7])
    moved = jax.lax.map(
        lambda s: advance(jax.tree.map(lambda a, t: a + s * t, dynamic, tangent))[0], size
    )
    difference = jax.tree.map(lambda a: (a[0] - a[1]) / (size[0] - size[1]), moved)
    return forward, difference, pull(weights)[0], after


def random_like(tree, seed, scaled):
    """Normal numbers like every floating array, times its size if `scaled`."""
    rng = np.random.default_rng(seed)

    def one(a):
        known = np.abs(np.where(np.isfinite(a), a, 0))
        size = max(known.max(initial=0), 0.1) if scaled else 1.0
        return jnp.asarray(size * rng.standard_normal(a.shape))

    return jax.tree.map(one, eqx.filter(tree, eqx.is_inexact_array))


def masked(tree, own):
    """Zero in every array of one row per particle where `own` is False."""

    def rows(a):
        mask = jnp.asarray(own).reshape(-1, *(1,) * (a.ndim - 1))
        return jnp.where(mask, a, 0) if a.shape[:1] == own.shape else a

    return jax.tree.map(rows, tree)


def of_block(tangent, b):
    """The part of a tangent that changes the particles and the material of block b, and walls."""
    scene, state = masked(tangent, np.arange(tangent[0].volumes.shape[0]) // 6 == b)

    def only(parts):
        return tuple(
            jax.tree.map(jnp.zeros_like, part) if i != b else part for i, part in enumerate(parts)
        )

    scene = eqx.tree_at(lambda s: s.materials, scene, only(scene.materials))
    return scene, eqx.tree_at(lambda s: s.history, state, only(state.history))


def product(a, b):
    """Terms of the inner product of two trees."""
    return np.concatenate(
        [np.ravel(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)]
    )


def all_finite(tree):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("d", "degree"),
    [(3, 2), (2, 3)],
    ids=["3d-quadratic", "2d-cubic"],
)
def test_step_derivatives(d, degree, measure):
    """G1: one step of every law from rest, rotation, equal stretches, flow, tip, compression."""
    problem = step_problem(d, degree)
    dt = pgjax.stable_dt(problem[0], fraction=0.4)
    everything = random_like(problem, 0, scaled=True)
    weights = random_like(problem[1], 1, scaled=False)
    for b, block in enumerate(impact.BLOCKS):
        tangent = of_block(everything, b)
        forward, difference, reverse, after = step_derivatives(problem, tangent, weights, dt)
        u_J_t, t_J_u = product(weights, forward), product(tangent, reverse)
        kind = f"step d = {d}, degree {degree}, {block}"
        gap = abs(u_J_t.sum() - t_J_u.sum()) / np.abs(u_J_t).sum()
        measure("G1", f"{kind}: JVP = VJP", gap, below=1e-11)
        gaps = jax.tree.map(
            lambda a, b: np.linalg.norm(a - b) / max(np.linalg.norm(a), 1e-300), forward, difference
        )
        measure("G1", f"{kind}: JVP = difference", max(jax.tree.leaves(gaps)), below=1e-6)
    plastic = np.linalg.solve(after.Fe, after.F).reshape(impact.COUNT, 6, 3, 3)
    flowed = np.abs(plastic - np.eye(3)).max(axis=(2, 3)) > 1e-3
    b_elastic = np.asarray(after.Fe @ jnp.swapaxes(after.Fe, 1, 2)).reshape(impact.COUNT, 6, 3, 3)
    for b, block in enumerate(impact.BLOCKS):
        # The sheared particle flows wherever a law can; the sand that expands is at its tip.
        assert flowed[b, 3] == bool(impact.BLOCKS[block]), block
        assert impact.BLOCKS[block] or not flowed[b].any(), block
        expanded = b_elastic[b, 4] / b_elastic[b, 4, 0, 0]
        assert np.allclose(expanded, np.eye(3), rtol=0, atol=1e-12) == ("sand" in block), block


AWKWARD_POSITIONS = {
    "on a node": (0.4, 0.5, 0.6),
    "on the faces of a cell": (0.55, 0.65, 0.45),
    "on one face": (0.55, 0.51, 0.62),
    "with another": (0.63, 0.52, 0.47),
    "with the other": (0.63, 0.52, 0.47),
    "alone": (1.05, 1.05, 1.05),
}


@pytest.mark.parametrize("strain", [0.0, -0.03, 0.03], ids=["rest", "compressed", "expanded"])
@pytest.mark.parametrize("friction_angle", [0.0, 30.0])
def test_derivatives_are_finite_at_kinks(measure, strain, friction_angle):
    """G4, H39: ε̂ = 0, equal stretches, φ = 0, v = 0, exact nodes and faces, empty nodes."""
    H = np.tile(strain * np.eye(3), (6, 1, 1))
    angle = jnp.asarray(friction_angle)
    sands = {
        name: impact.parameters()[name] | {"friction_angle": angle}
        for name in ("sand", "cohesive sand")
    }
    x = np.array(list(AWKWARD_POSITIONS.values()))
    problem = step_problem(3, 2, x=x, H=H, v=0.0, gained=0.0, **sands)
    dt = pgjax.stable_dt(problem[0], fraction=0.4)
    tangent = random_like(problem, 0, scaled=True)
    weights = random_like(problem[1], 1, scaled=False)
    forward, _, reverse, after = step_derivatives(problem, tangent, weights, dt)
    assert np.asarray(after.alive).all()
    what = f"strain {strain:g}, φ = {friction_angle:g}°"
    lost = sum(np.sum(~np.isfinite(a)) for a in jax.tree.leaves((forward, reverse)))
    measure("G4", f"derivatives that are not finite, {what}", lost, below=0)
    u_J_t, t_J_u = product(weights, forward), product(tangent, reverse)
    gap = abs(u_J_t.sum() - t_J_u.sum()) / np.abs(u_J_t).sum()
    measure("G4", f"JVP = VJP, {what}", gap, below=1e-11)


def test_dead_particles_have_no_derivative():
    """H51: 0 for what is NaN, left the grid or was dead; finite for all others."""
    scene, state = step_problem(3, 2)
    n = scene.particle_count
    nan, gone, dead = 3, 22, 41
    lost = np.isin(np.arange(n), (nan, gone, dead))
    position = state.position.at[nan].set(jnp.nan).at[gone].set(1e30)
    He = state.He.at[dead].set(jnp.nan)
    state = eqx.tree_at(
        lambda s: (s.position, s.He, s.alive),
        state,
        (position, He, state.alive.at[dead].set(False)),
    )
    problem = (scene, state)
    dt = pgjax.stable_dt(scene, fraction=0.4)
    tangent = random_like(problem, 0, scaled=True)

    # A loss of the living: what is lost keeps its place, so it would only see itself.
    weights = masked(random_like(state, 1, scaled=False), ~lost)
    history = tuple(
        None if h is None else h * (~lost[part]).astype(float)
        for h, part in zip(weights.history, scene.slices, strict=True)
    )
    weights = eqx.tree_at(lambda w: w.history, weights, history)
    forward, _, reverse, after = step_derivatives(problem, tangent, weights, dt)
    assert (np.asarray(after.alive) == ~lost).all()
    assert all_finite(reverse)
    assert all_finite(masked(forward, ~lost))
    of_scene, of_state = reverse
    for leaf in (of_scene.volumes, of_state.position, of_state.v, of_state.C, of_state.He):
        assert (np.asarray(leaf)[lost] == 0).all()
        assert (np.abs(np.asarray(leaf)[~lost]).reshape((~lost).sum(), -1).max(axis=1) > 0).all()


def drifting(v, E):
    """A small free block of neo-Hookean material under gravity."""
    rng = np.random.default_rng(8)
    x = 0.4 + 0.2 * rng.random((16, 2))
    scene = pgjax.Scene(
        pgjax.Grid(np.zeros(2), (10, 10), 0.1),
        pm.Material(pm.NeoHookean(E, 0.3), density=rng.uniform(500, 1500, 16)),
        rng.uniform(1e-3, 3e-3, 16),
        gravity=np.array([1.0, -9.8]),
    )
    return scene, pgjax.initial_state(scene, x, v)


def test_gradient_of_momentum_is_mass(measure):
    """G5: `∂(Σ m v)_x/∂v₀ = (m, 0)` whatever the internal forces did in 20 steps."""
    v, E = np.random.default_rng(9).normal(size=(16, 2)), 1e4
    scene, _ = drifting(v, E)
    dt = pgjax.stable_dt(scene)

    @jax.jit
    @jax.grad
    def gradient(v):
        scene, state = drifting(v, E)
        final = pgjax.simulate(scene, state, dt=dt, frames=1, substeps=20).final
        return jnp.sum(scene.masses * final.v[:, 0])

    exact = np.stack([scene.masses, np.zeros(16)], axis=1)
    error = np.abs(gradient(jnp.asarray(v)) - exact).max() / np.max(scene.masses)
    measure("G5", "gradient of momentum = mass, 20 steps", error, below=1e-12)


def test_gradient_of_kinetic_energy(measure):
    """G5: no force at F = I, so the energy of the first step does not depend on E."""
    v, E = jnp.asarray(np.random.default_rng(9).normal(size=(16, 2))), jnp.asarray(1e4)
    dt = pgjax.stable_dt(drifting(v, E)[0])

    @jax.jit
    def slopes(v, E):
        def energies(v, E):
            scene, state = drifting(v, E)
            after = pgjax.step(scene, state, dt)
            return [jnp.sum(scene.masses * jnp.sum(s.v**2, axis=1)) / 2 for s in (state, after)]

        return jax.grad(lambda v: energies(v, E)[0])(v), jax.jacrev(energies, 1)(v, E)

    by_v, by_E = slopes(v, E)
    measure("G5", "gradient of kinetic energy by E, t = 0 and one step", max(by_E), below=0)
    momentum = np.asarray(drifting(v, E)[0].masses)[:, None] * v
    error = np.max(np.abs(by_v - momentum)) / np.max(np.abs(momentum))
    measure("G5", "gradient of kinetic energy by v = momentum", error, below=1e-12)
