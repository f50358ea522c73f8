"""Accounts of a rollout against formulas of their own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
from pgjax import boundary, models, sampling

G = 9.81
GRID = pgjax.Grid((0, 0, 0), (16, 12, 12), 1 / 12)
E, NU = 2e4, 0.3


def block(center=(0.5, 0.5, 0.5), size=0.25):
    return sampling.block(np.subtract(center, size / 2), np.add(center, size / 2), spacing=1 / 24)


def scene_of(volumes, material=None, **settings):
    material = models.Material(models.NeoHookean(E, NU)) if material is None else material
    return pgjax.Scene(GRID, material, volumes, **settings)


def run(scene, state, *, frames=6, substeps=20, frame=0.02, **settings):
    return pgjax.simulate(
        scene, state, dt=frame / substeps, frames=frames, substeps=substeps, ledger=True, **settings
    )


def falling(**settings):
    """A block that falls on a rough floor, turning."""
    x, volumes = block(center=(0.5, 0.5, 0.33))
    floor = boundary.Box((0.1, 0.1, 0.167), (1.2, 0.9, 0.9), boundary.Separating(0.3))
    scene = scene_of(volumes, gravity=(0, 0, -G), boundaries=[floor], **settings)
    return scene, pgjax.initial_state(scene, x, (0.5, 0.2, -1.5))


def whole(state):
    return state


def neo_hookean(F):
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    log_J = np.log(np.linalg.det(F))
    return mu / 2 * (np.sum(F**2, axis=(-1, -2)) - 3) - mu * log_J + lam / 2 * log_J**2


def test_the_motion_is_the_same():
    scene, state = falling()
    with_it = run(scene, state)
    without = pgjax.simulate(scene, state, dt=0.001, frames=6, substeps=20)
    assert without.ledger is None
    for a, b in zip(jax.tree.leaves(with_it.saved), jax.tree.leaves(without.saved), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 if a.dtype == jnp.float64 else 1e-5)


@pytest.mark.float64
def test_each_frame_against_its_particles():
    scene, state = falling()
    made = run(scene, state, save=whole)
    ledger, kept = made.ledger, jax.tree.map(np.asarray, made.saved)
    m, D = np.asarray(scene.masses), (1 / 12) ** 2 / 4
    x, v, C = kept.position + np.asarray(GRID.origin), kept.v, kept.C
    momentum = np.einsum("p,fpi->fi", m, v)
    skew = np.stack([C[..., i, j] - C[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1)
    spin = np.einsum("p,fpi->fi", m, np.cross(x, v) + D * skew)
    kinetic = np.sum(m * (np.sum(v**2, -1) + D * np.sum(C**2, (-1, -2))), -1) / 2
    F = kept.He + np.eye(3)
    elastic = np.sum(np.asarray(scene.volumes) * neo_hookean(F), axis=-1)
    np.testing.assert_allclose(ledger.mass, np.sum(m), rtol=1e-13)
    np.testing.assert_allclose(ledger.momentum, momentum, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ledger.angular_momentum, spin, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ledger.kinetic, kinetic, rtol=1e-12)
    np.testing.assert_allclose(ledger.elastic, elastic, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(ledger.potential, G * np.sum(m * x[..., 2], -1), rtol=1e-12)
    np.testing.assert_allclose(ledger.smallest_volume, np.min(np.linalg.det(F), -1), rtol=1e-12)


@pytest.mark.float64
def test_momentum_comes_from_somewhere():
    """`P(t) − P(0) = M g t + of the walls + of forces and what is led`."""
    x, volumes = block(center=(0.5, 0.5, 0.33))
    floor = boundary.Box((0.1, 0.1, 0.167), (1.2, 0.9, 0.9), boundary.Separating(0.3))
    scene = scene_of(
        volumes,
        gravity=(0, 0, -G),
        boundaries=[floor],
        particle_conditions=[
            boundary.ParticleForce(x[:, 2] > 0.4, (2.0, 0.0, 0.0)),
            boundary.ParticleMotion(x[:, 1] < 0.4, boundary.Steady((0.0, 0.3, 0.0))),
        ],
    )
    made = run(scene, pgjax.initial_state(scene, x, (0.5, 0.2, -1.5)))
    ledger = made.ledger
    gained = np.asarray(ledger.momentum) - np.asarray(ledger.momentum)[0]
    weight = np.outer(made.t, [0, 0, -G]) * np.sum(scene.masses)
    given = weight + ledger.flows.impulse + ledger.flows.push
    np.testing.assert_allclose(gained, given, atol=1e-11)
    assert np.max(np.abs(ledger.flows.impulse)) > 1
    assert np.max(np.abs(ledger.flows.push)) > 0.1


@pytest.mark.float64
def test_friction_takes_what_it_should(measure):
    """A block that slides to rest: `W = −½ m v²` of the walls, and their impulse is `m g t` up."""
    size, speed, friction = 0.25, 0.8, 0.4
    x, volumes = block(center=(0.5, 0.5, 0.167 + size / 2), size=size)
    floor = boundary.Box((-1, -1, 0.167), (9, 9, 9), boundary.Separating(friction))
    law = models.Material(models.NeoHookean(2e5, 0.2))
    scene = scene_of(volumes, law, gravity=(0, 0, -G), boundaries=[floor], grid_damping=20.0)
    resting = pgjax.simulate(
        scene, pgjax.initial_state(scene, x), dt=1e-3, frames=1, substeps=400
    ).final
    scene = scene_of(volumes, law, gravity=(0, 0, -G), boundaries=[floor])
    pushed = resting.v + jnp.broadcast_to(jnp.asarray([speed, 0, 0]), resting.v.shape)
    state = eqx.tree_at(lambda s: s.v, resting, pushed)
    made = run(scene, state, frames=10, substeps=40)
    ledger, m = made.ledger, float(np.sum(scene.masses))
    work = float(ledger.flows.walls[-1]) / (m * speed**2 / 2)
    measure(
        "ledger", "friction: work over the kinetic energy at the start", -work, within=(0.94, 1.0)
    )
    up = float(ledger.flows.impulse[-1, 2]) / (m * G * float(made.t[-1] - made.t[0]))
    measure("ledger", "friction: normal impulse over m g t", up, within=(0.97, 1.03))
    along = float(ledger.flows.impulse[-1, 0]) / (m * speed)
    measure("ledger", "friction: tangential impulse over m v", -along, within=(0.97, 1.0))


@pytest.mark.float64
def test_damping_takes_what_it_should():
    x, volumes = block()
    scene = scene_of(volumes, grid_damping=3.0)
    made = run(scene, pgjax.initial_state(scene, x, (0.5, 0.2, -0.4)))
    ledger = made.ledger
    left = ledger.kinetic[0] * np.exp(-2 * 3.0 * np.asarray(made.t))
    np.testing.assert_allclose(ledger.kinetic, left, rtol=1e-11)
    np.testing.assert_allclose(ledger.flows.damping, ledger.kinetic[0] - left, rtol=1e-10)
    np.testing.assert_allclose(ledger.numerical, 0, atol=1e-11)


@pytest.mark.float64
@pytest.mark.parametrize(
    "plasticity",
    [
        pytest.param(models.VonMises(400.0), id="VM"),
        pytest.param(models.HerschelBulkley(500.0, 20.0), id="HB", marks=pytest.mark.slow),
    ],
)
def test_plastic_flow_takes_the_rest(measure, plasticity):
    """Sheared in free space: what motion and stress lose, flow takes, and with Δt → 0 all of it."""
    law = (
        models.StVKHencky(E, NU)
        if isinstance(plasticity, models.VonMises)
        else models.DevVolNeoHookean(E, NU)
    )
    C = np.zeros((3, 3))
    C[0, 1] = 12.0
    x = np.array([[0.5, 0.5, 0.5]])
    rest = []
    for substeps in (40, 80):
        scene = scene_of(np.array([1e-4]), models.Material(law, plasticity))
        state = pgjax.initial_state(scene, x, C=C[None])
        ledger = run(scene, state, frames=10, substeps=substeps, frame=0.01).ledger
        taken = ledger.total[0] - ledger.total[-1]
        assert np.all(np.diff(ledger.flows.plastic) >= -1e-15)
        assert taken > 0.3 * ledger.total[0]
        rest.append(abs(float(ledger.numerical[-1] / taken)))
    name = type(plasticity).__name__
    measure("ledger", f"{name}: part of the loss not plastic", rest[1], below=0.1)
    measure("ledger", f"{name}: the same at twice Δt, ratio", rest[0] / rest[1], within=(1.6, 2.4))


def test_what_is_lost_does_not_count():
    x, volumes = block(center=(1.2, 0.5, 0.5))
    scene = scene_of(volumes)
    state = pgjax.initial_state(scene, x, (2.0, 0, 0))
    ledger = run(scene, state, frames=10, throw=False).ledger
    assert ledger.near_edge[0] == 0
    assert np.max(ledger.near_edge) > 0
    assert ledger.lost[-1] == len(x)
    np.testing.assert_allclose(ledger.mass[-1], 0)
    np.testing.assert_allclose(ledger.momentum[-1], 0)
    np.testing.assert_allclose(ledger.cfl[0], 1e-3 * 2.0 * 12, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.float64
def test_is_differentiable_and_batched():
    scene, state = falling()

    def ends(speed):
        moving = pgjax.initial_state(scene, state.x, jnp.stack([speed, 0 * speed, 0 * speed]))
        ledger = run(scene, moving, frames=1, substeps=4, throw=False).ledger
        return ledger.kinetic[0], ledger.flows.impulse[-1, 2]

    kinetic, impulse = jax.jacfwd(ends)(jnp.asarray(0.5))
    np.testing.assert_allclose(kinetic, 0.5 * np.sum(scene.masses), rtol=1e-12)
    assert np.isfinite(impulse)
    several = jax.vmap(ends)(jnp.asarray([0.1, 0.5]))
    one = ends(jnp.asarray(0.5))
    np.testing.assert_allclose([a[1] for a in several], one, rtol=1e-12)


def test_plane_has_one_component_of_spin():
    grid = pgjax.Grid((0, 0), (12, 12), 1 / 12)
    x, volumes = sampling.block((0.4, 0.4), (0.6, 0.6), spacing=1 / 24)
    scene = pgjax.Scene(grid, models.Material(models.FixedCorotated(E, NU)), volumes)
    state = pgjax.initial_state(scene, x, np.stack([-x[:, 1], x[:, 0]], axis=1))
    ledger = run(scene, state, frames=1, substeps=4).ledger
    expected = np.sum(np.asarray(scene.masses) * np.sum(x**2, axis=1))
    np.testing.assert_allclose(ledger.angular_momentum[0], [expected], rtol=1e-5)


def test_plot():
    scene, state = falling()
    made = run(scene, state)
    figure = made.plot()
    labels = {text.get_text() for text in figure.axes[0].get_legend().get_texts()}
    assert {"kinetic", "elastic", "potential", "work of walls"} <= labels
    assert "dissipated" not in labels
    with pytest.raises(ValueError, match="ledger=True"):
        pgjax.simulate(scene, state, dt=1e-3, frames=1, substeps=1).plot()


def test_a_law_without_energy_is_named():
    class Nameless(models.AbstractElasticity):
        E: jax.Array
        nu: jax.Array

        def kirchhoff(self, H, L, history=None):
            del L, history
            return self.mu * (H + H.T)

    x, volumes = block()
    scene = scene_of(volumes, models.Material(Nameless(jnp.asarray(E), jnp.asarray(NU))))
    with pytest.raises(NotImplementedError, match="Nameless has no `energy"):
        run(scene, pgjax.initial_state(scene, x))
