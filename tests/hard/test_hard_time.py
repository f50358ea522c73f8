"""Hard motions: fast, torn, unequal, at rest for long, chaotic, larger than the grid allows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from hard.bodies import (
    MATERIALS,
    NU,
    RHO,
    E,
    H,
    N,
    block,
    every_material,
    is_finite,
    kinetic,
    largest,
    momentum,
    motion,
    run,
    tolerance,
    world,
)
from pgjax import boundary
from pgjax.result import Condition

FLOOR = boundary.Box((-9.0, 2 * H), (9.0, 9.0), boundary.Separating())


def bits(state):
    return [np.asarray(a).tobytes() for a in motion(state)]


# --- Many particles in a cell ---------------------------------------------------------------------


@pytest.mark.parametrize("n", [20_000, 100_000])
def test_h25_one_crowded_cell(n, holds):
    """Single precision: what the sums lose is said from 30 000 on, and is no velocity gained.

    Mass and momentum of a node lose alike, so that their quotient stays below the largest speed.
    """
    x = np.random.default_rng(0).uniform(0.501, 0.599, (n, 2))
    scene = world("NeoHookean", x, volumes=np.full(n, H**2 / n))
    v = np.random.default_rng(1).uniform(0.9, 1.0, (n, 2))
    state = pgjax.initial_state(scene, x, v, dtype=np.float32)
    end = pgjax.simulate(scene, state, dt=1e-6, frames=1, substeps=1, throw=False).final
    crowded = n > 30_000
    assert bool(end.status.happened(Condition.F32_RESOLUTION)) == crowded
    assert largest(end.v) < 1 + 1e-5
    before, after = momentum(scene, state), momentum(scene, end)
    assert largest(after - before) < (3e-4 if crowded else 5e-5) * largest(before)
    outcome = "status: F32_RESOLUTION" if crowded else "holds"
    holds("H25", material="NeoHookean", precision="float32", outcome=outcome)


# --- Unequal neighbours ---------------------------------------------------------------------------


@every_material
@pytest.mark.parametrize(("density", "stiffness"), [(1e4, 1.0), (1.0, 1e4), (1e4, 1e4)])
def test_h26_unequal_neighbours(name, density, stiffness, holds):
    """Ten thousand times as heavy, as stiff: stable, and the light one hardly moves the heavy."""
    x = np.concatenate([block(center=(0.4, 0.55)), block(center=(0.7, 0.55))])
    other = pm.Material(pm.NeoHookean(E * stiffness, NU), density=RHO * density)
    scene = world((MATERIALS[name], other), x, counts=(36, 36))
    state = pgjax.initial_state(scene, x, np.repeat([[0.15, 0.03], [0, 0]], 36, axis=0))
    dt = pgjax.stable_dt(scene)
    assert dt <= pgjax.stable_dt(world(name, x)) * (1 + 1e-6)
    before, energy = momentum(scene, state), kinetic(scene, state)
    for _ in range(4):
        state = run(scene, state, dt, 100)
        assert kinetic(scene, state) < (1 + tolerance(1e-9, 1e-4)) * energy
    assert is_finite(state)
    assert bool(state.status.ok)
    change = largest(momentum(scene, state) - before)
    assert change < tolerance(1e-12, 2e-5) * largest(before)
    heavy = np.asarray(state.v)[36:].mean(axis=0)
    assert np.hypot(*heavy) <= 2.02 * 0.154 / density
    holds("H26", material=name)


def total_energy(scene, state):
    """Kinetic and elastic energy of what is left, J."""
    elastic = jax.vmap(scene.materials[0].elasticity.energy)(state.He)
    return kinetic(scene, state) + float(scene.volumes @ jnp.where(state.alive, elastic, 0))


# --- Fast -----------------------------------------------------------------------------------------


@every_material
def test_h28_impact_at_ten_times_the_speed_of_sound(name, holds):
    """Speed governs the step; nothing is lost without being counted, and no energy is made.

    Never more than at the start. That none comes back is true of the law that is not continued
    anywhere: of the others the energy is not that of the stress where they are clamped.
    """
    x = block(center=(0.55, 0.45))
    scene = world(name, x, walls=FLOOR)
    c = float(scene.rest_sound_speed())
    state = pgjax.initial_state(scene, x, (0.0, -10 * c))
    dt = pgjax.stable_dt(scene, state)
    assert dt < pgjax.stable_dt(scene)
    assert dt == pytest.approx(0.25 * H / (10 * c), rel=1e-5)
    first = least = total_energy(scene, state)
    for _ in range(100):
        state = run(scene, state, min(dt, pgjax.stable_dt(scene, state)), 4)
        assert is_finite(state)
        energy = total_energy(scene, state)
        assert energy < 1.01 * first
        assert name != "FixedCorotated" or energy < least + 0.01 * first
        least = min(least, energy)
    lost = int(jnp.sum(~state.alive))
    assert lost == int(state.status.count[Condition.NONFINITE : Condition.OUT_OF_DOMAIN + 1].sum())
    # Who was turned inside out is counted.
    inverted = np.linalg.det(np.asarray(state.Fe, np.float64))[np.asarray(state.alive)] <= 0
    assert int(state.status.count[Condition.INVERTED]) >= inverted.sum()
    names = [k.name for k in Condition if int(state.status.count[k])]
    holds("H28", material=name, outcome=f"status: {', '.join(names)}" if names else "holds")


@every_material
@pytest.mark.parametrize("cells", [1.2, 3.0, 20.0])
def test_h29_further_than_a_cell_in_a_step(name, cells, holds):
    """Said before the first step; a step as recommended goes a quarter of a cell."""
    x = block()
    scene = world(name, x)
    dt = pgjax.stable_dt(scene)
    state = pgjax.initial_state(scene, x, (cells * H / dt, 0.0))
    good = pgjax.stable_dt(scene, state)
    assert good * cells * H / dt <= 0.25 * H * (1 + 1e-5)
    end = pgjax.simulate(scene, state, dt=dt, frames=2, substeps=1, throw=False)
    assert int(end.status.first[Condition.DT_ABOVE_BOUND]) == 0
    assert is_finite(end.saved)
    gone = int(end.status.count[Condition.OUT_OF_DOMAIN])
    assert gone == (36 if cells == 20 else 0)
    end = pgjax.simulate(scene, state, dt=good, frames=2, substeps=1)
    assert not int(end.status.count.sum())
    holds("H29", material=name, outcome="status: DT_ABOVE_BOUND")


@every_material
def test_h29_no_tunnel_through_a_wall(name, holds):
    """At the step recommended a bar of four cells stops what would leap over it in one step."""
    x = block(center=(0.35, 0.55))
    bar = boundary.Collider(boundary.Cuboid((0.75, 0.55), (0.2, 2.0)), boundary.Sticky())
    scene = world(name, x, walls=bar)
    speed = 6 * H / pgjax.stable_dt(scene)
    state = pgjax.initial_state(scene, x, (speed, 0.0))
    for _ in range(30):
        state = run(scene, state, min(pgjax.stable_dt(scene, state), 0.1 * H / speed), 10)
    assert is_finite(state)
    assert float(jnp.max(jnp.where(state.alive, state.x[:, 0], 0))) < 0.95
    holds("H29", material=name)


# --- Thin and torn --------------------------------------------------------------------------------


@every_material
@pytest.mark.parametrize("shape", ["thread", "bent"])
def test_h31_a_thread_one_particle_wide(name, shape, holds):
    """One particle a cell: finite, momentum kept, no energy made.

    A line of particles resists bending only as its nodes see a body one cell thick.
    """
    along = np.linspace(0.3, 0.8, 6)
    x = np.stack([along, 0.55 + (0.1 * np.sin(6 * along) if shape == "bent" else 0 * along)], 1)
    scene = world(name, x, volumes=np.full(6, H**2))
    v = np.stack([0 * along, 0.1 * np.cos(9 * along)], 1)
    state = pgjax.initial_state(scene, x, v - v.mean(axis=0))
    energy, dt = kinetic(scene, state), pgjax.stable_dt(scene)
    scale = float(scene.masses @ jnp.abs(state.v[:, 1]))
    end = run(scene, state, dt, 300)
    assert is_finite(end)
    assert bool(end.status.ok)
    assert largest(momentum(scene, end)) < tolerance(1e-12, 1e-5) * scale
    assert kinetic(scene, end) < energy
    holds("H31", material=name)


@pytest.mark.parametrize("name", ["NeoHookean", "StVKHencky", "FixedCorotated"])
def test_h31_a_sheet_one_particle_thick(name, holds):
    """In space, one particle a cell, thrown on a ball: it drapes and stays finite."""
    line = 0.3 + H * np.arange(6)
    x = np.stack([*np.meshgrid(line, line, indexing="ij"), np.full((6, 6), 0.72)], -1)
    ball = boundary.Collider(boundary.Sphere((0.55, 0.55, 0.45), 0.2), boundary.Separating(0.3))
    scene = pgjax.Scene(
        pgjax.Grid(np.zeros(3), (11, 11, 10), H),
        MATERIALS[name],
        np.full(36, H**3),
        gravity=(0.0, 0.0, -9.8),
        boundaries=[ball],
    )
    state = pgjax.initial_state(scene, x.reshape(-1, 3), (0.0, 0.0, -0.5))
    end = run(scene, state, pgjax.stable_dt(scene), 40)
    assert is_finite(end)
    assert bool(end.status.ok)
    depth = 0.2 - np.linalg.norm(np.asarray(end.x) - [0.55, 0.55, 0.45], axis=1)
    assert depth.max() < 0.5 * H
    assert float(end.v[:, 2].max()) < 1.0
    holds("H31", material=name)


@every_material
def test_h32_torn_apart(name, holds):
    """Four particles a cell, drawn out to three times the length: pieces, whole and finite.

    Where neighbours are further apart than the stencil is wide they are separate bodies: that is
    fracture by the grid, and a valid state; no step looks for neighbours to say so.
    """
    x = block(side=5, spacing=0.5 * H)
    scene = world(name, x)
    rate = 2 * float(scene.rest_sound_speed()) / H
    v = (x - x.mean(axis=0)) * [rate, 0.0]
    state = pgjax.initial_state(scene, x, v, C=np.tile(np.diag([rate, 0.0]), (25, 1, 1)))
    scale = float(scene.masses @ jnp.abs(state.v[:, 0]))
    energy = kinetic(scene, state)
    width = float(np.ptp(np.asarray(state.x[:, 0])))
    for _ in range(60):
        state = run(scene, state, pgjax.stable_dt(scene, state), 5)
        if np.ptp(np.asarray(state.x[:, 0])) > 3 * width:
            break
    assert np.ptp(np.asarray(state.x[:, 0])) > 3 * width
    assert is_finite(state)
    assert bool(state.status.ok)
    assert largest(momentum(scene, state)) < tolerance(1e-12, 1e-5) * scale
    assert kinetic(scene, state) < energy
    holds("H32", material=name)


# --- Long -----------------------------------------------------------------------------------------


@every_material
def test_h46_nothing_moves_by_itself(name, holds):
    """Without force and velocity ten thousand steps change no bit."""
    x = block() + 0.01 * np.random.default_rng(0).normal(size=(36, 2))
    scene = world(name, x)
    state = pgjax.initial_state(scene, x)
    end = run(scene, state, pgjax.stable_dt(scene), 10_000)
    assert int(end.step) == 10_000
    assert bits(end) == bits(state)
    assert not int(end.status.count.sum())
    holds("H46", material=name)


def column(dtype):
    """A stiff column of 1 m at rest on a floor under gravity, already compressed by its weight."""
    stiff, g, top = 1e9, 9.8, 1.2
    x = np.stack(np.meshgrid([0.525, 0.575], 0.225 + 0.05 * np.arange(20), indexing="ij"), -1)
    x = x.reshape(-1, 2)
    material = pm.Material(pm.NeoHookean(stiff, 0.0), density=RHO)
    grid = pgjax.Grid((0.0, 0.0), (N, 16), H)
    options = {"gravity": (0.0, -g), "grid_damping": 500.0, "grid": grid}
    scene = world(material, x, walls=FLOOR, **options)
    F = np.tile(np.eye(3), (40, 1, 1))
    F[:, 1, 1] -= RHO * g * (top - x[:, 1]) / stiff
    return scene, pgjax.initial_state(scene, x, F=F, dtype=dtype), RHO * g * 1.0


def rest(steps):
    """Creep and change of stress of the column over so many steps after it has settled, f32."""
    scene, state, pressure = column(np.float32)
    dt = pgjax.stable_dt(scene)

    def stress(state):
        law = scene.materials[0].elasticity
        law = jax.tree.map(lambda a: a.astype(state.dtype), law)
        return np.asarray(jax.vmap(lambda H: law.kirchhoff(H, jnp.zeros_like(H)))(state.He))

    settled = run(scene, state, dt, 5000)
    end = run(scene, settled, dt, steps)
    assert bool(end.status.ok)
    creep = largest(end.position - settled.position) / H
    return creep, largest(stress(end) - stress(settled)) / pressure, stress(end)


@pytest.mark.parametrize("steps", [5000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_h36_at_rest_in_single_precision(steps, holds):
    """E = 1e9 Pa under gravity: `H = F − I` resolves a strain of 1e-5, and nothing creeps."""
    creep, noise, stress = rest(steps)
    assert creep < 1e-3
    assert noise < 1e-3
    # The column does carry its weight.
    assert -1.2 < stress[:, 1, 1].min() / (RHO * 9.8) < -0.8
    holds("H36", material="NeoHookean", precision="float32")


def spun(name, part, turns):
    """F of one particle after so many turns at this part of the stable step, and its spin."""
    x = np.full((1, 2), 0.55)
    scene = world(name, x, volumes=[2e-3])
    stable = pgjax.stable_dt(scene)
    omega = 0.1 / stable
    W = np.array([[0.0, -omega], [omega, 0.0]])
    state = pgjax.initial_state(scene, x, C=W[None])
    end = run(scene, state, part * stable, round(turns * 2 * np.pi / (0.1 * part)))
    C = np.asarray(end.C)[0]
    return np.asarray(end.Fe, np.float64)[0], (C[1, 0] - C[0, 1]) / (2 * omega)


@pytest.mark.parametrize("name", ["FixedCorotated", "StVKHencky", "NeoHookean"])
def test_h37_a_thousand_turns(name, holds):
    """What det(I + Δt W) > 1 adds in each step the stress takes back: the strain does not grow.

    It swings about zero, after a thousand turns no further than in the first; half the step at the
    same spin gives half of it. The spin is kept to rounding.
    """
    widest = {}
    for part in (1.0, 0.5):
        for when in ((1, 3, 11, 12), (999, 1000)):
            ends = [spun(name, part, turns) for turns in when]
            assert max(abs(spin - 1) for _, spin in ends) < tolerance(1e-12, 1e-5)
            widest[part, when[0]] = max(largest(F.T @ F - np.eye(3)) for F, _ in ends)
        assert widest[part, 999] < 1.05 * widest[part, 1]
    assert widest[0.5, 1] / widest[1.0, 1] == pytest.approx(0.5, abs=0.05)
    holds("H37", material=name)


@pytest.mark.float64
def test_h37_volume_of_a_prescribed_spin(holds):
    """Without stress `J = (1 + (ω Δt)²)^N`, 2π ω Δt a turn, and half of it for half the step."""
    x = block()
    weak = pm.Material(pm.NeoHookean(1e-12, 0.0), density=RHO)
    W, center = jnp.asarray([[0.0, -1.0], [1.0, 0.0]]), jnp.asarray([[0.55, 0.55]])

    def spin(particles, t, dt):
        del t, dt
        v = (particles.x - center) @ W.T
        return particles._replace(v=v, C=jnp.broadcast_to(W, particles.C.shape))

    gained = []
    for dt in (0.02, 0.01):
        scene = world(weak, x, particle_conditions=(spin,))
        steps = round(3 * 2 * np.pi / dt)
        end = run(scene, pgjax.initial_state(scene, x), dt, steps)
        logarithm = np.log(np.linalg.det(np.asarray(end.F)))
        # What leaves its circle is turned with the grid's velocity: the same rate everywhere.
        assert largest(logarithm / (steps * np.log1p(dt**2)) - 1) < 1e-6
        gained.append(logarithm.mean())
    assert gained[0] / gained[1] == pytest.approx(2, rel=1e-2)
    holds("H37", material="NeoHookean")


@every_material
def test_h50_derivative_through_a_thousand_steps(name, holds):
    """A block that bounces on the floor and off a corner: finite, however large."""
    x = block(center=(0.5, 0.45))
    box = boundary.Box((2 * H, 2 * H), (10 * H, 10 * H), boundary.Separating(0.2))
    scene = world(name, x, walls=box, gravity=(0.0, -9.8))
    dt = pgjax.stable_dt(scene)

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def landing(v, scene):
        state = pgjax.initial_state(scene, x)
        state = eqx.tree_at(lambda s: s.v, state, jnp.broadcast_to(v, state.v.shape))
        end = pgjax.simulate(scene, state, dt=dt / 2, frames=1, substeps=1000).final
        return jnp.mean(end.x[:, 0])

    value, slope = landing(jnp.asarray([[2.0, -1.0]]), scene)
    assert 2 * H < float(value) < 10 * H
    assert is_finite(slope)
    assert largest(slope) > 0
    holds("H50", material=name)


# --- Compiled once --------------------------------------------------------------------------------


def test_h55_scenes_of_several_sizes_in_turn(holds):
    """Each size compiles once; going back to the first gives its bits again."""
    traced = []

    def save(state):
        traced.append(state.v.shape)
        return state.x

    def motion_of(cells, stiffness, scale):
        x = block(side=cells - 4, center=(0.4, 0.4))
        material = pm.Material(pm.NeoHookean(stiffness, NU), density=RHO)
        scene = world(material, x, grid=pgjax.Grid((0.0, 0.0), (cells, 8), H * scale))
        state = pgjax.initial_state(scene, x, (0.3, 0.1))
        return pgjax.simulate(scene, state, dt=1e-3, frames=2, substeps=3, save=save)

    sizes = (8, 9, 10)
    first = [motion_of(n, E, 1.0) for n in sizes]
    count = len(traced)
    assert {shape[0] for shape in traced} == {16, 25, 36}
    for stiffness, scale in ((2 * E, 1.0), (E, 1.1), (E, 1.0)):
        again = [motion_of(n, stiffness, scale) for n in sizes]
    assert len(traced) == count
    for a, b in zip(first, again, strict=True):
        assert np.asarray(a.saved).tobytes() == np.asarray(b.saved).tobytes()
        assert bits(a.final) == bits(b.final)
    holds("H55", material="NeoHookean")
