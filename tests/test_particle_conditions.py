"""Conditions of particles: led ones, pushes, forces and wind, each against a closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pgjax import boundary
from pgjax.boundary.particles import Particles
from pgjax.models.material import cast

double = pytest.mark.float64
T0 = jnp.asarray(0.0)


def some(n=6, d=3, seed=0):
    rng = np.random.default_rng(seed)
    return Particles(
        jnp.asarray(rng.normal(size=(n, d))),
        jnp.asarray(rng.normal(size=(n, d))),
        jnp.asarray(rng.normal(size=(n, d, d))),
        jnp.asarray(rng.uniform(1, 2, n)),
        jnp.zeros(n, bool),
    )


@double
def test_led_particles_turn_rigidly_and_the_others_do_not():
    p, dt, t = some(), jnp.asarray(1e-3), jnp.asarray(0.2)
    mask = np.array([True, True, False, True, False, False])
    motion = boundary.Steady((0.2, -0.1, 0.3), (0.5, 1.0, -0.7), (0.1, 0.2, 0.3), 0.1, 0.9)
    led = boundary.ParticleMotion(mask, motion)(p, t, dt)
    np.testing.assert_array_equal(led.held, mask)
    np.testing.assert_array_equal(led.v[~mask], p.v[~mask])
    x = p.x + dt * led.v
    apart = np.linalg.norm(x[0] - x[1])
    np.testing.assert_allclose(apart, np.linalg.norm(p.x[0] - p.x[1]), rtol=1e-14)
    exact = jax.vmap(lambda x: motion.at(t).velocity_at(x))(p.x)
    np.testing.assert_allclose(led.v[mask], exact[mask], atol=2e-3)
    # C is the gradient of that velocity: affine transfers see one rigid field.
    np.testing.assert_allclose(led.C[0] @ (p.x[1] - p.x[0]), led.v[1] - led.v[0], rtol=1e-10)


@double
def test_windows_without_end_lead_from_the_beginning():
    """Open windows put no ∞ into velocities or derivatives."""
    lead = boundary.ParticleMotion(
        np.ones(6, bool), boundary.Steady((0.3, 0, 0), (0, 0, 1.0)), -np.inf, np.inf
    )

    def speed(v):
        motion = boundary.Steady(jnp.stack([v, 0 * v, 0 * v]))
        return boundary.ParticleMotion(lead.mask, motion, -np.inf)(some(), T0, T0 + 0.1).v[0, 0]

    led = lead(some(), T0, jnp.asarray(1e-3))
    assert bool(led.held.all())
    assert bool(jnp.isfinite(led.v).all())
    value, slope = jax.value_and_grad(speed)(jnp.asarray(0.3))
    np.testing.assert_allclose((value, slope), (0.3, 1.0), rtol=1e-12)


@double
def test_a_particle_on_the_axis_only_turns():
    p = some(1)._replace(x=jnp.asarray([[0.1, 0.2, 0.3]]))
    motion = boundary.Steady((0, 0, 0), (0, 0, 2.0), (0.1, 0.2, 0.0))
    led = boundary.ParticleMotion(np.ones(1, bool), motion)(p, T0, jnp.asarray(1e-3))
    np.testing.assert_allclose(led.v, 0, atol=1e-15)


@double
def test_release_goes_along_the_direction():
    x = np.array([[0.0, 1.0], [0.5, 0.0], [1.0, 3.0], [0.25, 0.0]])
    times = boundary.release_times(x, (2.0, 0.0), start=1.0, end=3.0)
    np.testing.assert_allclose(times, [1.0, 2.0, 3.0, 1.5])
    layers = boundary.release_times(x, (1.0, 0.0), start=1.0, end=3.0, layers=2)
    np.testing.assert_allclose(layers, [1.0, 3.0, 3.0, 1.0])
    hold = boundary.ParticleMotion(np.ones(4, bool), boundary.Steady((0.0, 0.0)), end=times)
    for t, held in ((0.9, [1, 1, 1, 1]), (1.2, [0, 1, 1, 1]), (2.5, [0, 0, 1, 0]), (3.0, [0] * 4)):
        led = hold(some(4, 2), jnp.asarray(t), jnp.asarray(0.1))
        np.testing.assert_array_equal(led.held, np.array(held, bool))
    for arguments, words in (
        ({"direction": (0.0, 0.0), "start": 0.0, "end": 1.0}, "`direction` must be a"),
        ({"direction": (1.0, 0.0), "start": 1.0, "end": 1.0}, "`end` must be after `start`"),
        (
            {"direction": (1.0, 0.0), "start": 0.0, "end": 1.0, "layers": 1},
            "`layers` must be",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            boundary.release_times(x, **arguments)


@double
def test_force_gives_its_impulse_whatever_the_step():
    """F (t₁ − t₀) in all, shared by mass, for windows that no step boundary meets."""
    force = np.array([3.0, -1.0, 2.0])
    mask = np.arange(6) < 4
    push = boundary.ParticleForce(mask, force, start=0.0123, end=0.0777)
    for dt in (0.01, 0.0007):
        p = start = some()
        for k in range(int(0.1 / dt) + 1):
            p = push(p, jnp.asarray(k * dt), jnp.asarray(dt))
        change = p.v - start.v
        total = jnp.sum(p.mass[:, None] * change, axis=0)
        np.testing.assert_allclose(total, (0.0777 - 0.0123) * force, rtol=1e-12)
        np.testing.assert_allclose(change[0], change[3], rtol=1e-12)
        assert (change[4:] == 0).all()


@double
@pytest.mark.parametrize(("rate", "quadratic"), [(2.0, 0.0), (0.0, 1.5), (2.0, 1.5), (0.0, 0.0)])
def test_wind_is_integrated_exactly(rate, quadratic):
    """One long step equals many short ones, and an ODE solver."""
    from scipy.integrate import solve_ivp

    u = np.array([1.0, 0.5, -0.2])
    wind = boundary.Wind(u, rate, quadratic)
    p, duration = some(), 0.7
    once = wind(p, T0, jnp.asarray(duration)).v
    often = p
    for k in range(10):
        often = wind(often, jnp.asarray(0.07 * k), jnp.asarray(0.07))
    np.testing.assert_allclose(once, often.v, rtol=1e-12)

    def rates(_, v):
        w = v - u
        return -(rate + quadratic * np.linalg.norm(w)) * w

    exact = solve_ivp(rates, (0, duration), np.asarray(p.v[0]), rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(once[0], exact, rtol=1e-8)


@double
def test_wind_may_depend_on_place_and_time():
    p = some()
    field = boundary.Wind(lambda x, t: x * t, rate=1e9, mask=np.arange(6) < 3)
    blown = field(p, jnp.asarray(2.0), jnp.asarray(1.0))
    np.testing.assert_allclose(blown.v[:3], 2 * p.x[:3], rtol=1e-12)
    np.testing.assert_array_equal(blown.v[3:], p.v[3:])


def test_bad_conditions_of_particles_are_refused():
    mask, rest = np.ones(3, bool), boundary.Steady((0.0, 0.0))
    for make, words in (
        (
            lambda: boundary.ParticleMotion(mask, rest, end=np.ones(4)),
            "`end` must be one number or",
        ),
        (lambda: boundary.ParticleMotion(mask, rest, start=2.0, end=1.0), "`end` must be after"),
        (
            lambda: boundary.ParticleMotion(mask, rest, start=(0.0, 3.0, 2.0), end=1.0),
            r"`end` must be after `start` = 3.0 s, but is 1.0 s at index \(1,\) \(2 bad entries\)",
        ),
        (
            lambda: boundary.ParticleMotion(mask, rest, start=2.0, end=(3.0, 1.0, np.nan)),
            r"`end` must be after `start` = 2.0 s, but is 1.0 s at index \(1,\) \(2 bad entries\)",
        ),
        (
            lambda: boundary.ParticleMotion(mask, rest, start=np.zeros(4), end=np.ones(5)),
            r"`start` must be one number or one per particle \(3,\), but has shape \(4,\)",
        ),
        (lambda: boundary.ParticleForce(mask, (1.0, 0.0), end=np.ones(3)), "`end` must be one n"),
        (lambda: boundary.Wind((1.0, 0.0), start=np.zeros(3)), "`start` must be one number, but"),
        (lambda: boundary.ParticleImpulse(mask, (1.0, 0.0), np.zeros(3)), "`start` must be one n"),
        (lambda: boundary.ParticleImpulse(mask, 1.0), "`momentum` must be a vector"),
        (lambda: boundary.ParticleImpulse(mask, (1.0, np.nan)), "`momentum` must be finite"),
        (lambda: boundary.ParticleForce(~mask, (1.0, 0.0)), "`mask` must select at least one"),
        (lambda: boundary.ParticleForce(mask, 1.0), "`force` must be a vector"),
        (lambda: boundary.ParticleImpulse(mask, (1.0, 0.0), duration=-1.0), "`duration` must be"),
        (lambda: boundary.Wind((1.0, 0.0), rate=-1.0), "`rate` must be at least 0"),
        (lambda: boundary.Wind((1.0, 0.0), mask=np.ones(3)), "`mask` must be a boolean"),
    ):
        with pytest.raises(ValueError, match=words):
            make()


@pytest.mark.parametrize("start", [0.0, 0.1, 0.25, 0.5, 1.0, 1.5])
def test_a_sudden_push_is_given_once_in_either_precision(start):
    """Steps that fall on its start up to rounding: the momentum is neither lost nor doubled."""
    push = boundary.ParticleImpulse(np.ones(1, bool), (1.0, 0, 0), start)
    push = cast(push, jnp.float32)
    for fps, substeps in ((24, 5), (24, 20), (24, 10), (25, 10), (30, 7)):
        dt = jnp.asarray(1 / fps / substeps, jnp.float32)
        n = int((start + 0.1) * fps * substeps) + 2
        zero = jnp.zeros((1, 3), jnp.float32)
        given = jnp.zeros((), jnp.float32)
        p = Particles(zero, zero, jnp.zeros((1, 3, 3), jnp.float32), zero[:, 0] + 1, zero[:, 0] > 0)
        for k in range(max(n - 40 - int(0.1 * fps * substeps), 0), n):
            given += push(p, jnp.asarray(k, jnp.float32) * dt, dt).v[0, 0]
        np.testing.assert_allclose(given, 1, rtol=1e-3)


def test_forces_keep_their_size_late_in_single_precision():
    force = cast(boundary.ParticleForce(np.ones(1, bool), (1.0, 0, 0)), jnp.float32)
    zero, dt = jnp.zeros((1, 3), jnp.float32), jnp.float32(1e-5)
    p = Particles(zero, zero, jnp.zeros((1, 3, 3), jnp.float32), zero[:, 0] + 1, zero[:, 0] > 0)
    np.testing.assert_allclose(force(p, jnp.float32(20.0), dt).v[0, 0], 1e-5, rtol=1e-6)
