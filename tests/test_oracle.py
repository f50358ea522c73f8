"""The yardstick itself: splines, return mappings and whole steps against closed forms."""

import itertools
import math
from functools import partial

import numpy as np
import oracle
import pytest
from oracle import I3, Material, Params, dev, hencky, lame, neo_hookean, random_F, rest_state
from scipy.interpolate import BSpline

MU, LAM, KAPPA = lame(1.0, 0.3)
SCHEMES = list(itertools.product((2, 3), (2, 3), (False, True)))  # d, degree, mls
YIELD, DT, ETA = 0.1, 1e-2, 0.05


def log_J(F):
    return np.log(np.linalg.det(F))


def shear(tau):
    return np.linalg.norm(dev(tau))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def deformations(rng):
    return [random_F(rng) for _ in range(200)]


@pytest.mark.parametrize("degree", [2, 3])
def test_splines_are_those_of_scipy(degree):
    N = BSpline.basis_element(np.arange(degree + 2) - (degree + 1) / 2, extrapolate=False)
    for u in np.linspace(-2.5, 2.5, 301):
        exact = np.nan_to_num([N(u), N.derivative()(u)])
        np.testing.assert_allclose(oracle.spline(u, degree), exact, atol=1e-14)


def test_misprinted_stresses_are_told_from_the_right_ones(deformations):
    for right, wrong in (
        (hencky, oracle.misprint_hencky),
        (neo_hookean, oracle.misprint_neo_hookean),
    ):
        gap = [abs(right(F, mu=MU, lam=LAM) - wrong(F, mu=MU, lam=LAM)).max() for F in deformations]
        assert max(gap) > 1e-2


def test_sand_ends_on_or_inside_the_cone(deformations):
    alpha = oracle.friction_alpha(math.radians(30))
    for F in deformations:
        Fe, _ = oracle.drucker_prager(F, 0.0, DT, mu=MU, lam=LAM, alpha=alpha)
        tau = hencky(Fe, mu=MU, lam=LAM)
        assert shear(tau) + alpha * np.trace(tau) < 1e-13


def test_volume_given_away_by_sand_is_remembered(deformations):
    for F in deformations:
        Fe, v_c = oracle.drucker_prager(
            F, 0.1, DT, mu=MU, lam=LAM, alpha=0.3, cohesion=0.02, volume_correction=True
        )
        assert abs(log_J(Fe) + v_c - log_J(F) - 0.1) < 1e-13


def test_metal_ends_on_the_yield_surface_and_the_misprint_misses_it(deformations):
    missed = []
    for F in deformations:
        Fe, _ = oracle.von_mises(F, YIELD, DT, mu=MU)
        assert shear(hencky(Fe, mu=MU, lam=LAM)) < YIELD + 1e-13
        assert abs(log_J(Fe) - log_J(F)) < 1e-13
        Fe, _ = oracle.misprint_von_mises(F, YIELD, DT, mu=MU)
        missed.append(shear(hencky(Fe, mu=MU, lam=LAM)) - YIELD)
    assert max(missed) > 1e-2


@pytest.mark.parametrize("h", [0.5, 1.0, 2.0])
def test_paste_obeys_its_flow_rule_and_keeps_its_volume(h, deformations):
    """Shear strain flows at the rate ((s - s_y) / eta)^(1/h)."""
    stress = partial(oracle.dev_vol_neo_hookean, mu=MU, kappa=KAPPA)
    flowing = 0
    for F in deformations:
        Fe, _ = oracle.herschel_bulkley(
            F, None, DT, mu=MU, sigma_y=math.sqrt(3 / 2) * YIELD, eta=ETA, h=h
        )
        s, s_trial = shear(stress(Fe)), shear(stress(F))
        assert abs(log_J(Fe) - log_J(F)) < 1e-13
        if s_trial > YIELD:
            flowing += 1
            assert abs(s - YIELD - ETA * ((s_trial - s) / (2 * MU * DT)) ** h) < 1e-12
    assert flowing > 100


@pytest.mark.parametrize(("d", "degree", "mls"), SCHEMES)
def test_step_of_an_isolated_particle_has_a_closed_form(d, degree, mls, rng):
    dt, t, rho, keep = 1e-3, 0.5, 1e-3, math.exp(-0.07)
    g, b, v, x = rng.normal(size=(4, d))
    body = Material(slice(0, 1), rho, partial(neo_hookean, mu=MU, lam=LAM))
    params = Params([body], np.full(d, 0.03), 0.1, g, degree, mls, damping=70.0, rpic=90.0)
    params.body_force = lambda X0, t: b * t * X0
    state = rest_state(x[None], v[None], np.array([2e-3]))
    state.t, state.C, state.Fe = t, rng.normal(size=(1, d, d)), random_F(rng, 0.1)[None]

    a = -neo_hookean(state.Fe[0], mu=MU, lam=LAM)[:d, :d] / rho
    C = keep * (state.C[0] + dt * a / params.D)
    G = sum(np.outer(grad_w, grad_w) / w for _, _, w, grad_w in oracle.stencil(x, params))
    L = np.zeros((3, 3))
    L[:d, :d] = C if mls else keep * (state.C[0] + dt * a @ G)
    v = keep * (v + dt * (g + b * t * x))
    C = (C - C.T) / 2 + math.exp(-0.09) * (C + C.T) / 2
    exact = (x + dt * v, v, C, state.Fe[0] + dt * L @ state.Fe[0], I3 + dt * L)
    end = oracle.oracle_step(state, params, dt)
    for actual, expected in zip((end.x, end.v, end.C, end.Fe, end.F), exact, strict=True):
        np.testing.assert_allclose(actual[0], expected, rtol=0, atol=1e-13 * abs(expected).max())


def momenta(state, params):
    """Linear (d,) and angular (d, d) momentum, the latter with the affine part m D C."""
    rho = params.materials[0].density
    moment = sum(
        rho * V * (np.outer(v, x) + params.D * C)
        for V, x, v, C in zip(state.volume, state.x, state.v, state.C, strict=True)
    )
    return rho * state.volume @ state.v, moment - moment.T


def spinning_cloud(d, rng):
    state = rest_state(rng.uniform(0, 0.2, (6, d)), rng.normal(size=(6, d)), np.full(6, 1e-3))
    state.C = rng.normal(size=(6, d, d))
    state.Fe = np.array([random_F(rng, 0.2) for _ in range(6)])
    return state


@pytest.mark.parametrize(("d", "degree", "mls"), SCHEMES)
@pytest.mark.parametrize("law", [hencky, oracle.misprint_hencky])
def test_a_free_cloud_keeps_its_momenta_only_if_the_stress_is_symmetric(d, degree, mls, law, rng):
    mu, lam, _ = lame(1e5, 0.3)
    cloud = Material(slice(0, 6), 1000.0, partial(law, mu=mu, lam=lam))
    params = Params([cloud], np.full(d, -0.03), 0.1, np.zeros(d), degree, mls)
    start = end = spinning_cloud(d, rng)
    for _ in range(5):
        end = oracle.oracle_step(end, params, 1e-3)
    (P0, L0), (P, L) = momenta(start, params), momenta(end, params)
    np.testing.assert_allclose(P, P0, rtol=0, atol=1e-13 * abs(P0).max())
    drift = abs(L - L0).max() / abs(L0).max()
    assert drift < 1e-13 if law is hencky else drift > 1e-3


@pytest.mark.parametrize("n", [1, 3, 8])
def test_periodic_images_are_one(n, rng):
    """Moving some particles by whole periods changes nothing."""
    cloud = Material(slice(0, 6), 1000.0, partial(hencky, mu=1e5, lam=1e5))
    params = Params([cloud], np.zeros(2), 0.1, np.ones(2), periodic=(n, None))
    start = spinning_cloud(2, rng)
    moved = spinning_cloud(2, np.random.default_rng(0))
    periods = np.outer([0, 1, -2, 0, 3, 1], [0.1 * n, 0.0])
    moved.x = start.x + periods
    a, b = (oracle.oracle_step(state, params, 1e-3) for state in (start, moved))
    np.testing.assert_allclose(b.x, a.x + periods, rtol=0, atol=1e-12)
    np.testing.assert_allclose(b.Fe, a.Fe, rtol=0, atol=1e-11)
    np.testing.assert_allclose(b.C, a.C, rtol=0, atol=1e-12 * abs(a.C).max())


def test_a_boundary_gets_the_place_and_the_time_of_the_start_of_the_step(rng):
    cloud = Material(slice(0, 6), 1000.0, partial(hencky, mu=1e5, lam=1e5))
    params = Params([cloud], np.zeros(3), 0.1, np.ones(3))
    params.boundary = lambda x, v, t: 0 * v + np.array([t, x[2], -x[1]])
    start = spinning_cloud(3, rng)
    start.t = 0.25
    end = oracle.oracle_step(start, params, 1e-3)
    x = start.x
    expected = np.stack([np.full(6, 0.25), x[:, 2], -x[:, 1]], axis=1)
    np.testing.assert_allclose(end.v, expected, atol=1e-14)
    rotation = np.tile([[0.0, 0, 0], [0, 0, 1], [0, -1, 0]], (6, 1, 1))
    np.testing.assert_allclose(end.C, rotation, atol=1e-12)
    assert end.t == 0.251


def test_materials_own_their_slices(rng):
    """A cloud of two equal halves is one cloud; only the plastic half yields and gets dt."""
    law = partial(hencky, mu=1e5, lam=1e5)
    plastic = partial(oracle.von_mises, mu=1e5, hardening=0.1)
    seen = []

    def recorded(Fe, history, dt):
        seen.append(dt)
        return plastic(Fe, history, dt)

    halves = [Material(slice(0, 2), 1e3, law), Material(slice(2, 6), 1e3, law, recorded)]
    start = spinning_cloud(3, rng)
    start.history = [10.0] * 6
    common = {"origin": np.zeros(3), "h": 0.1, "gravity": np.ones(3)}
    whole = oracle.oracle_step(start, Params([Material(slice(0, 6), 1e3, law)], **common), 1e-3)
    split = oracle.oracle_step(start, Params(halves, **common), 1e-3)
    np.testing.assert_array_equal(split.x, whole.x)
    np.testing.assert_array_equal(split.Fe[:2], whole.Fe[:2])
    assert seen == [1e-3] * 4
    assert split.history[:2] == [10.0] * 2
    assert min(split.history[2:]) > 10
