"""Bodies some of whose particles are held or led: clamped there, against beams and rigid motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
from pgjax import boundary, models, sampling
from pgjax.boundary import ParticleMotion, Steady

LENGTH, HEIGHT, HELD = 1.0, 0.2, 0.2
DENSITY, E, G = 1000.0, 1e6, 2.0
REST = Steady((0.0, 0.0))


def beam(cells, *, E=E, gravity=G, walls=(), conditions=None):
    """A beam along x, `cells` thick, whose part at x < 0 is held."""
    h = HEIGHT / cells
    x, volumes = sampling.block((-HELD, -HEIGHT / 2), (LENGTH, HEIGHT / 2), spacing=h / 2)
    grid = pgjax.Grid((-0.4, -0.6), (round(1.8 / h), round(1.2 / h)), h)
    if conditions is None:
        conditions = [ParticleMotion(x[:, 0] < 0, REST)]
    material = models.Material(models.FixedCorotated(E, 0.0), density=DENSITY)
    scene = pgjax.Scene(
        grid,
        material,
        volumes,
        gravity=(0.0, -gravity),
        boundaries=walls,
        particle_conditions=conditions,
    )
    return scene, pgjax.initial_state(scene, x)


def tip(state, x0):
    """Mean height of the free end."""
    end = x0[:, 0] > LENGTH - 0.05
    return jnp.sum(jnp.where(end, state.x[:, 1], 0)) / float(end.sum())


def swing(scene, state, *, seconds, part=1.0):
    """How far the tip is from where it was at each of fifty frames, m."""
    x0 = np.asarray(state.x)
    frame = seconds / 50
    dt = part * pgjax.stable_dt(scene, state, frame=frame)
    substeps = round(frame / dt)
    made = pgjax.simulate(
        scene, state, dt=frame / substeps, frames=50, substeps=substeps, save=lambda s: tip(s, x0)
    )
    return np.asarray(made.saved - made.saved[0])


def test_a_held_end_carries_a_beam(measure):
    """It swings between 0 and twice the static deflection, with its first mode's period.

    Timoshenko's `q L⁴/8EI + q L²/2κGA`, with κ = 5/6; the first bending mode of a cantilever has
    `ω = 3.516 √(EI/ρA L⁴)` (S. S. Rao, Mechanical Vibrations, §8.5). The load is light: 1.5 cm.
    """
    gravity = 0.2
    inertia, area, load = HEIGHT**3 / 12, HEIGHT, DENSITY * HEIGHT * gravity
    shear = E / 2
    static = load * LENGTH**4 / (8 * E * inertia) + load * LENGTH**2 / (2 * 5 / 6 * shear * area)
    omega = 3.516 * np.sqrt(E * inertia / (DENSITY * area * LENGTH**4))
    period = 2 * np.pi / omega
    sag = -swing(*beam(8, gravity=gravity), seconds=period)
    measure(
        "held beam", "deepest sag / twice the static", sag.max() / (2 * static), within=(0.95, 1.08)
    )
    # Lowest in the middle, and back where it was a period later.
    half = np.argmax(sag) / 50 * period
    measure("held beam", "half a period / first mode", 2 * half / period, within=(0.93, 1.1))
    measure("held beam", "sag after one period", sag[-1] / sag.max(), below=0.08)


def test_held_particles_are_a_sticky_wall():
    """What is held clamps what a wall at the same place clamps, and does not creep."""
    wall = boundary.Collider(boundary.HalfSpace((0.0, 0.0), (1.0, 0.0)), boundary.Sticky())
    held = swing(*beam(6), seconds=2.0)
    fixed = swing(*beam(6, walls=[wall], conditions=[]), seconds=2.0)
    assert np.abs(held).max() == pytest.approx(np.abs(fixed).max(), rel=0.08)
    assert np.abs(held[30:]).min() < 0.15 * np.abs(held).max()


@pytest.mark.slow
def test_nothing_creeps_at_a_longer_step():
    """A dashpot would give way in proportion to Δt."""
    scene, state = beam(4)
    coarse, fine = swing(scene, state, seconds=1.0), swing(scene, state, seconds=1.0, part=0.4)
    np.testing.assert_allclose(coarse, fine, atol=0.04 * np.abs(fine).max())


def test_a_body_goes_with_the_half_that_turns():
    """A stiff block, of which one half is turned about its middle, turns as a whole."""
    spin = 2.0
    x, volumes = sampling.block((-0.3, -0.1), (0.3, 0.1), spacing=1 / 60)
    grid = pgjax.Grid((-0.6, -0.6), (36, 36), 1 / 30)
    turning = ParticleMotion(x[:, 0] < 0, Steady((0.0, 0.0), spin, (0.0, 0.0)))
    material = models.Material(models.FixedCorotated(1e6, 0.2), density=DENSITY)
    scene = pgjax.Scene(grid, material, volumes, particle_conditions=[turning])
    rigid = np.stack([-spin * x[:, 1], spin * x[:, 0]], axis=1)
    C = np.broadcast_to(spin * np.array([[0.0, -1], [1, 0]]), (len(x), 2, 2))
    state = pgjax.initial_state(scene, x, rigid, C=C)
    dt = pgjax.stable_dt(scene, state, frame=0.05)
    made = pgjax.simulate(scene, state, dt=dt, frames=10, substeps=round(0.05 / dt))
    angle = spin * made.t[-1]
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    np.testing.assert_allclose(made.saved.x[-1], np.asarray(x) @ turn.T, atol=2e-3)


def test_once_let_go_it_falls_freely():
    """When the window ends nothing leads any node: the momentum is that of the weight since."""
    scene, state = beam(4, conditions=[])
    x, let_go = np.asarray(state.x), 0.1
    held = [ParticleMotion(np.ones(len(x), bool), REST, end=let_go)]
    scene, state = beam(4, conditions=held)
    dt = 5e-4
    made = pgjax.simulate(scene, state, dt=dt, frames=2, substeps=round(let_go / dt))
    np.testing.assert_allclose(made.saved.x[1], x, atol=1e-6)
    np.testing.assert_allclose(made.saved.v[2, :, 1], -G * let_go, rtol=0.02)


@pytest.mark.slow
@pytest.mark.float64
def test_derivatives_through_led_nodes():
    """Forward, reverse and differences agree, of stiffness and of the speed of what leads.

    Of the mean height: what the clamp carries.
    """

    def end(E, speed):
        x, _ = sampling.block((-HELD, -HEIGHT / 2), (LENGTH, HEIGHT / 2), spacing=HEIGHT / 8)
        lead = ParticleMotion(x[:, 0] < 0, Steady(jnp.stack([0 * speed, speed])))
        scene, state = beam(4, E=E, conditions=[lead])
        made = pgjax.simulate(
            scene, state, dt=5e-4, frames=1, substeps=40, save=lambda s: jnp.mean(s.x[:, 1])
        )
        return made.saved[-1]

    at = (jnp.asarray(E), jnp.asarray(0.1))
    reverse = jax.jit(jax.grad(end, argnums=(0, 1)))(*at)
    forward = jax.jit(jax.jacfwd(end, argnums=(0, 1)))(*at)
    run = jax.jit(end)
    for k, step in enumerate((30.0, 1e-5)):
        moved = [list(at), list(at)]
        moved[0][k] -= step
        moved[1][k] += step
        difference = (run(*moved[1]) - run(*moved[0])) / (2 * step)
        np.testing.assert_allclose(forward[k], difference, rtol=1e-5)
        np.testing.assert_allclose(reverse[k], forward[k], rtol=1e-9)


@pytest.mark.float64
def test_what_leads_is_accounted_for():
    """The momentum of all and the energy that a moving clamp puts in."""
    x, _ = sampling.block((-HELD, -HEIGHT / 2), (LENGTH, HEIGHT / 2), spacing=HEIGHT / 12)
    lead = ParticleMotion(x[:, 0] < 0, Steady((0.0, 0.3)))
    scene, state = beam(6, conditions=[lead])
    dt = pgjax.stable_dt(scene, state, frame=0.02)
    substeps = round(0.02 / dt)
    made = pgjax.simulate(
        scene, state, dt=0.02 / substeps, frames=10, substeps=substeps, ledger=True
    )
    ledger = made.ledger
    assert ledger is not None
    gained = np.asarray(ledger.momentum) - np.asarray(ledger.momentum)[0]
    weight = np.outer(made.t, [0.0, -G]) * np.sum(scene.masses)
    np.testing.assert_allclose(gained, weight + ledger.flows.push, atol=1e-9)
    np.testing.assert_allclose(ledger.flows.impulse, 0, atol=1e-10)
    size = np.max(np.abs(ledger.flows.forces))
    assert size > 5
    assert np.max(np.abs(ledger.numerical)) < 0.1 * size
