"""V41: the whole step against an independent oracle written with plain loops."""

import functools

import jax
import numpy as np
import oracle
import pytest

import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Separating
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state
from pgjax.splines import BSpline
from pgjax.step import step
from pgjax.transfer import MLS, SplineGradient

E, NU, RHO, DT, STEPS = 1e4, 0.3, 1000.0, 2e-4, 20
MU, LAM, KAPPA = oracle.lame(E, NU)

hencky = functools.partial(oracle.hencky, mu=MU, lam=LAM)
paste = functools.partial(oracle.dev_vol_neo_hookean, mu=MU, kappa=KAPPA)
alpha = oracle.friction_alpha(np.deg2rad(30.0))

CASES = {
    "fixed corotated": (
        pm.Material(pm.FixedCorotated(E, NU), density=RHO),
        functools.partial(oracle.fixed_corotated, mu=MU, lam=LAM),
        oracle.elastic,
        None,
    ),
    "hencky": (pm.Material(pm.StVKHencky(E, NU), density=RHO), hencky, oracle.elastic, None),
    "neo-hookean": (
        pm.Material(pm.NeoHookean(E, NU), density=RHO),
        functools.partial(oracle.neo_hookean, mu=MU, lam=LAM),
        oracle.elastic,
        None,
    ),
    "dev/vol": (pm.Material(pm.DevVolNeoHookean(E, NU), density=RHO), paste, oracle.elastic, None),
    "sand": (
        pm.Material(pm.StVKHencky(E, NU), pm.DruckerPrager(30.0), RHO),
        hencky,
        functools.partial(oracle.drucker_prager, mu=MU, lam=LAM, alpha=alpha),
        0.0,
    ),
    "cohesive sand": (
        pm.Material(
            pm.StVKHencky(E, NU), pm.DruckerPrager(30.0, 0.01, volume_correction=True), RHO
        ),
        hencky,
        functools.partial(
            oracle.drucker_prager,
            mu=MU,
            lam=LAM,
            alpha=alpha,
            cohesion=0.01,
            volume_correction=True,
        ),
        0.0,
    ),
    "metal": (
        pm.Material(pm.StVKHencky(E, NU), pm.VonMises(100.0, hardening=0.1), RHO),
        hencky,
        functools.partial(oracle.von_mises, mu=MU, hardening=0.1),
        100.0,
    ),
    "paste": (
        pm.Material(pm.DevVolNeoHookean(E, NU), pm.HerschelBulkley(100.0, 5.0), RHO),
        paste,
        functools.partial(oracle.herschel_bulkley, mu=MU, sigma_y=100.0, eta=5.0),
        0.0,
    ),
    "shear-thinning paste": (
        pm.Material(pm.DevVolNeoHookean(E, NU), pm.HerschelBulkley(100.0, 5.0, h=0.6), RHO),
        paste,
        functools.partial(oracle.herschel_bulkley, mu=MU, sigma_y=100.0, eta=5.0, h=0.6),
        0.0,
    ),
}


def rubbed(node, velocity, t):
    """Coulomb friction on the half-space of `run_both`, without JAX."""
    del t
    normal = np.eye(len(node))[0] + 0.3
    normal /= np.linalg.norm(normal)
    pressing = velocity @ normal
    if (node - 0.4) @ normal > 1e-12 or pressing >= 0:
        return velocity
    sliding = velocity - pressing * normal
    return sliding * max(1 + 0.2 * pressing / np.linalg.norm(sliding), 0)


def run_both(name, d, degree, scheme):
    material, stress, return_map, history = CASES[name]
    rng = np.random.default_rng(3)
    n, h = 9, 0.1
    x = 0.35 + 0.3 * rng.random((n, d))
    v = rng.normal(size=(n, d))
    C = 2 * rng.normal(size=(n, d, d))
    F = np.eye(3) + 0.05 * rng.normal(size=(n, 3, 3))
    if d == 2:
        F[:, :2, 2] = F[:, 2, :2] = 0
    volumes = h**d * rng.uniform(0.05, 0.2, n)
    gravity = rng.normal(size=d)
    wall = Collider(HalfSpace(np.full(d, 0.4), np.eye(d)[0] + 0.3), Separating(0.2))
    grid = Grid(np.zeros(d), (12,) * d, h)
    scene = Scene(
        grid,
        material,
        volumes,
        gravity=gravity,
        boundaries=(wall,),
        spline=BSpline(degree),
        scheme=scheme,
        grid_damping=0.7,
        shear_damping=3.0,
    )
    state = initial_state(scene, x, v, C=C, F=F)

    expected = oracle.State(
        x=x,
        v=v,
        C=C,
        Fe=F,
        F=F,
        volume=volumes,
        X0=x,
        history=np.full(n, 0.0 if history is None else history),
        t=0.0,
    )
    params = oracle.Params(
        [oracle.Material(slice(0, n), RHO, stress, return_map)],
        origin=np.zeros(d),
        h=h,
        gravity=gravity,
        degree=degree,
        mls=isinstance(scheme, MLS),
        boundary=rubbed,
        damping=0.7,
        rpic=3.0,
    )
    advance = jax.jit(lambda s: step(scene, s, DT))
    for _ in range(STEPS):
        state = advance(state)
        expected = oracle.oracle_step(expected, params, DT)
    return state, expected


@pytest.mark.float64
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("d", "degree", "scheme"),
    [(3, 2, SplineGradient()), (2, 3, SplineGradient()), (2, 2, MLS()), (3, 3, MLS())],
    ids=["3d-quadratic", "2d-cubic", "2d-quadratic-mls", "3d-cubic-mls"],
)
def test_step_matches_oracle(measure, name, d, degree, scheme):
    if d == 3 and degree == 3 and name not in ("fixed corotated", "metal"):
        pytest.skip("the cubic step in three dimensions is compared for two materials only")
    state, expected = run_both(name, d, degree, scheme)
    pairs = (
        (state.x, expected.x),
        (state.v, expected.v),
        (state.C, expected.C),
        (state.Fe, expected.Fe),
        (state.F, expected.F),
    )
    error = max(np.max(np.abs(np.asarray(a) - b)) / np.max(np.abs(b)) for a, b in pairs)
    label = f"{name}, {d}-D, degree {degree}, {type(scheme).__name__}"
    measure("V41", f"20 steps against the oracle: {label}", error, below=1e-12)
