"""Level 2: solutions the discrete equations have exactly (V15–V19)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes import SCHEMES, MissingTimeStep, elastic_strain, largest, roll, wide

import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Separating
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state
from pgjax.transfer import SplineGradient

H = 0.1
E, NU, RHO = 1e4, 0.3, 1000.0
DTYPES = pytest.mark.parametrize(
    "dtype",
    [
        pytest.param(jnp.float64, id="f64", marks=pytest.mark.float64),
        pytest.param(jnp.float32, id="f32"),
    ],
)


def blob(d, name, gravity, scheme=None):
    """An irregular soft body in a periodic box: scene and positions."""
    rng = np.random.default_rng(5)
    spline, standard, _ = SCHEMES[name]
    scheme = standard if scheme is None else scheme
    x = 0.25 + 0.35 * rng.random((40, d))
    grid = Grid(np.zeros(d), (9, 8, 7)[:d], H, periodic=(True,) * d)
    volumes = H**d * rng.uniform(0.05, 0.3, 40)
    material = pm.Material(pm.FixedCorotated(E, NU), density=RHO)
    return Scene(grid, material, volumes, gravity=gravity, spline=spline, scheme=scheme), x


def fall(scene, x, dt, steps, dtype):
    """Errors of velocity, displacement (both relative) and F after falling freely."""
    start = initial_state(scene, x, dtype=dtype)
    end, _ = roll(scene, start, dt, steps)
    v = wide(scene.gravity) * dt * steps
    travelled = v * dt * (steps + 1) / 2
    moved = wide(end.position) - wide(start.position)
    return {
        "v = g n Δt": largest(wide(end.v) - v) / largest(v),
        "x = x₀ + g Δt² n(n+1)/2": largest(moved - travelled) / largest(travelled),
        "F = I": largest(end.He),
    }


@pytest.mark.parametrize(
    ("d", "name", "dtype"),
    [
        pytest.param(2, "quadratic-mls", jnp.float64, marks=pytest.mark.float64),
        pytest.param(2, "cubic-grad", jnp.float64, marks=pytest.mark.float64),
        pytest.param(3, "quadratic-grad", jnp.float64, marks=pytest.mark.float64),
        pytest.param(3, "cubic-mls", jnp.float64, marks=pytest.mark.float64),
        (2, "cubic-grad", jnp.float32),
        (3, "quadratic-grad", jnp.float32),
    ],
)
def test_v15_free_fall_and_v16_translation(measure, d, name, dtype):
    case = f"{name}, {d}-D, {dtype.__name__}"
    tolerance = 1e-12 if dtype == jnp.float64 else 1e-5
    rng = np.random.default_rng(6)
    scene, x = blob(d, name, rng.normal(size=d))
    dt, steps = 5e-3, 200
    for what, error in fall(scene, x, dt, steps, dtype).items():
        measure("V15", f"{what}, {case}", error, below=tolerance)

    direction = rng.normal(size=d)
    velocity = 12 * H / (dt * steps) * direction / np.linalg.norm(direction)
    weightless = eqx.tree_at(lambda s: s.gravity, scene, jnp.zeros(d))
    start = initial_state(weightless, x, velocity, dtype=dtype)
    end, _ = roll(weightless, start, dt, steps)
    assert np.linalg.norm(wide(end.position - start.position), axis=1).min() > 10 * H
    error = largest(wide(end.v) - velocity) / largest(velocity)
    measure("V16", f"v constant over 12 cells, {case}", error, below=tolerance)
    measure("V16", f"F = I, {case}", largest(end.He), below=tolerance)


@pytest.mark.float64
def test_v15_fails_without_the_time_step_of_the_trial_state(measure):
    """Negative control E1: with `F ← (I + ∇v) F` rounding errors grow without bound."""
    dt = 5e-3
    scene, x = blob(2, "quadratic-grad", [0.3, -1.0], MissingTimeStep(dt))
    errors = fall(scene, x, dt, 200, jnp.float64)
    measure("V15", "negative control: F with Δt missing (E1)", max(errors.values()), above=1e-12)


# Where Σ w′²/w is largest: next to the middle of a cell, where one node has almost no mass.
WORST = {2: 0.499, 3: 0.2755}


def isolated_particle(name, d):
    """One particle, at the place within its cell that needs the smallest time step."""
    spline, scheme, _ = SCHEMES[name]
    grid = Grid(np.zeros(d), (9,) * d, H)
    material = pm.Material(pm.NeoHookean(E, NU), density=RHO)
    scene = Scene(grid, material, [0.01**d], spline=spline, scheme=scheme)
    return scene, np.full((1, d), (4 + WORST[spline.degree]) * H)


def stable_limit(d, beta):
    """`β h/c` with `ρ c² = dλ + 2μ`."""
    mu, lam, _ = oracle.lame(E, NU)
    return beta * H / ((d * lam + 2 * mu) / RHO) ** 0.5


@pytest.mark.float64
@pytest.mark.parametrize(
    ("d", "name"), [*((2, name) for name in SCHEMES), (3, "quadratic-grad"), (3, "cubic-mls")]
)
def test_v17_isolated_particle(measure, d, name):
    """A particle alone follows `C′ = C − Δt V/(mD) τ`, `F′ = (I + Δt (C − Δt V/m τ G)) F`."""
    scene, x = isolated_particle(name, d)
    rng = np.random.default_rng(7)
    beta = SCHEMES[name][2]
    dt = 0.5 * stable_limit(d, beta)
    F, C = np.eye(3), rng.normal(size=(d, d))
    F[:d, :d] += 0.1 * rng.normal(size=(d, d))
    state = initial_state(scene, x, C=C[None], F=F[None])
    end, history = roll(scene, state, dt, 300, elastic_strain)
    mu, lam, _ = oracle.lame(E, NU)
    D = float(scene.D)
    degree, at = scene.spline.degree, WORST[scene.spline.degree]
    nodes = [oracle.spline(at - i, degree) for i in range(-3, 5)]
    G = sum(slope**2 / w for w, slope in nodes if w > 0) / H**2
    G = 1 / D if name.endswith("mls") else G
    worst = 0.0
    for He in wide(history)[:, 0]:
        flux = oracle.neo_hookean(F, mu=mu, lam=lam)[:d, :d] / RHO
        L = np.zeros((3, 3))
        L[:d, :d] = C - dt * G * flux
        C, F = C - dt / D * flux, (np.eye(3) + dt * L) @ F
        worst = max(worst, largest(He - (F - np.eye(3))))
    error = max(worst, largest(wide(end.C)[0] - C) / largest(C))
    measure("V17", f"recursion of F and C, {name}, {d}-D", error, below=1e-10)
    for fraction in (0.95, 1.05):
        growth = perturbed(scene, x, fraction * stable_limit(d, beta))
        demand = {"below": 10.0} if fraction < 1 else {"above": 1e3}
        measure("V17", f"growth at {fraction} of the bound, {name}, {d}-D", growth, **demand)


def perturbed(scene, x, dt, kept=1.0):
    """The largest strain over 300 steps, relative to the volumetric one at the start."""
    d, start = x.shape[1], 1e-8
    rate = np.inf if kept == 0 else -np.log(kept) / dt
    scene = eqx.tree_at(lambda s: s.shear_damping, scene, jnp.asarray(rate))
    F = np.eye(3)
    F[:d, :d] *= 1 + start
    state = initial_state(scene, x, F=F[None])
    _, history = roll(scene, state, dt, 300, elastic_strain)
    return largest(history) / start


@pytest.mark.float64
@pytest.mark.parametrize("name", SCHEMES)
def test_v17_damping_lowers_the_bound(measure, name):
    """`β(s) = √(D/h²) √(2(1 + s)/(g(1 + s) − s))` when a factor s of the sym. C is kept."""
    scene, x = isolated_particle(name, 2)
    spline, scheme, _ = SCHEMES[name]
    g = 1.0 if name.endswith("mls") else {2: 1.5, 3: 1.0456}[spline.degree]
    for s in (0.9, 0.5, 0.0):
        beta = ((spline.degree + 1) / 12 * 2 * (1 + s) / (g * (1 + s) - s)) ** 0.5
        assert scheme.stable_courant(spline, s) == pytest.approx(beta, rel=1e-12)
        for fraction in (0.95, 1.05):
            growth = perturbed(scene, x, fraction * stable_limit(2, beta), s)
            demand = {"below": 10.0} if fraction < 1 else {"above": 1e3}
            measure("V17", f"growth at {fraction} β({s}), {name}", growth, **demand)


@pytest.mark.float64
def test_v17_fails_with_the_bound_of_another_scheme(measure):
    """Negative control: the spline gradient is unstable just below the bound of MLS."""
    scene, x = isolated_particle("quadratic-grad", 2)
    assert isinstance(scene.scheme, SplineGradient)
    growth = perturbed(scene, x, 0.95 * stable_limit(2, SCHEMES["quadratic-mls"][2]))
    measure("V17", "negative control: ∇w at 0.95 of the bound of MLS", growth, above=1e3)


def thrown(d, name, x=None, *, turn=None, shift=0, order=None, dtype):
    """A soft body thrown onto a floor with friction, turned, shifted by cells or reordered."""
    rng = np.random.default_rng(8)
    n = 48
    Q = np.eye(d) if turn is None else turn
    order = np.arange(n) if order is None else order
    spline, scheme, _ = SCHEMES[name]
    centre = np.full(d, 0.7)
    up = np.eye(d)[1]

    def place(points):
        return (points - centre) @ Q.T + centre + shift * H

    x = 0.5 + 0.35 * rng.random((n, d))
    v = rng.normal(size=(n, d)) - 2 * up
    C = rng.normal(size=(n, d, d))
    F = np.tile(np.eye(3), (n, 1, 1))
    F[:, :d, :d] += 0.05 * rng.normal(size=(n, d, d))
    R = np.eye(3)
    R[:d, :d] = Q
    volumes = H**d * rng.uniform(0.05, 0.2, n)
    floor = Collider(HalfSpace(place(0.4 * up + 0.2), Q @ up), Separating(0.3))
    scene = Scene(
        Grid(np.zeros(d), (14,) * d, H),
        pm.Material(pm.FixedCorotated(E, NU), density=RHO),
        volumes[order],
        gravity=Q @ (-9.8 * up),
        boundaries=(floor,),
        spline=spline,
        scheme=scheme,
    )
    state = initial_state(
        scene,
        place(x)[order],
        (v @ Q.T)[order],
        C=(Q @ C @ Q.T)[order],
        F=(R @ F @ R.T)[order],
        dtype=dtype,
    )
    end, _ = roll(scene, state, 5e-4, 200)
    assert bool(jnp.all(end.alive))
    back = np.argsort(order)
    moved = wide(end.position) - centre - shift * H
    return [(a @ Q)[back] for a in (moved, wide(end.v))] + [
        (Q.T @ wide(end.C) @ Q)[back],
        (R.T @ wide(end.He) @ R)[back],
    ]


@DTYPES
@pytest.mark.parametrize(("d", "name"), [(2, "cubic-mls"), (3, "quadratic-grad")])
def test_v18_symmetries(measure, d, name, dtype):
    quarter = np.eye(d)[[1, 0, 2][:d]] * np.array([-1, 1, 1])[:d, None]
    mirror = np.diag([-1.0, 1, 1][:d])
    whole = np.roll(np.eye(3), 1, axis=0) if d == 3 else quarter @ quarter
    cases = {
        "shift by two cells": {"shift": np.array([2, 1, -2])[:d]},
        "quarter turn": {"turn": quarter},
        "mirror": {"turn": mirror},
        "turn about the diagonal" if d == 3 else "half turn": {"turn": whole},
        "permutation": {"order": np.random.default_rng(9).permutation(48)},
    }
    expected = thrown(d, name, dtype=dtype)
    tolerance = 1e-12 if dtype == jnp.float64 else 1e-4
    for what, options in cases.items():
        result = thrown(d, name, dtype=dtype, **options)
        pairs = zip(result, expected, strict=True)
        error = max(largest(a - b) / largest(b) for a, b in pairs)
        measure("V18", f"{what}, {name}, {d}-D, {dtype.__name__}", error, below=tolerance)


def in_units(length, time, mass, dtype):
    """One block of each material on a rough floor, in other units; made dimensionless again."""
    rng = np.random.default_rng(10)
    n, d = 12, 2
    stress = mass / (length * time**2)
    # In two dimensions the volume of a particle is an area: mass per depth of one metre.
    density = RHO * mass / length**3
    laws = [
        pm.Material(pm.FixedCorotated(E * stress, NU), density=density),
        pm.Material(pm.NeoHookean(E * stress, NU), density=density),
        pm.Material(
            pm.StVKHencky(E * stress, NU),
            pm.DruckerPrager(30.0, 0.01, volume_correction=True),
            density,
        ),
        pm.Material(
            pm.StVKHencky(E * stress, NU), pm.VonMises(100.0 * stress, hardening=0.1), density
        ),
        pm.Material(
            pm.DevVolNeoHookean(E * stress, NU),
            pm.HerschelBulkley(100.0 * stress, 5.0 * stress * time**0.7, h=0.7),
            density,
        ),
    ]
    scene = Scene(
        Grid(np.zeros(d), (32, 10), H * length),
        laws,
        0.1 * (H * length) ** d * np.ones(n * len(laws)),
        counts=(n,) * len(laws),
        gravity=np.array([1.0, -9.8]) * length / time**2,
        boundaries=(Collider(HalfSpace([0.0, 0.3 * length], [0.0, 1.0]), Separating(0.3)),),
        grid_damping=0.5 / time,
        shear_damping=2.0 / time,
    )
    x = np.concatenate(
        [rng.uniform([0.2 + 0.6 * k, 0.32], [0.4 + 0.6 * k, 0.52], (n, d)) for k in range(5)]
    )
    v = rng.normal(size=x.shape) - [0.0, 1.0]
    state = initial_state(scene, x * length, v * length / time, dtype=dtype)
    end, _ = roll(scene, state, 1e-3 * time, 100)
    assert bool(jnp.all(end.alive))
    history = jnp.concatenate([h for h in end.history if h is not None])
    units = (length, length / time, 1 / time, 1.0, 1.0)
    values = (end.position, end.v, end.C, end.F, history)
    return [wide(a) / u for a, u in zip(values, units, strict=True)]


@DTYPES
def test_v19_unit_invariance(measure, dtype):
    """Every absolute epsilon, and every sum of unlike quantities, shows here."""
    expected = in_units(1.0, 1.0, 1.0, dtype)
    _, v, _, F, history = expected
    # The blocks yield and still move: there is something to compare.
    assert min(largest(v), largest(F - np.eye(3)), largest(history)) > 1e-2
    tolerance = 1e-9 if dtype == jnp.float64 else 1e-4
    systems = {
        "mm": (1e3, 1.0, 1.0),
        "km": (1e-3, 1.0, 1.0),
        "ms": (1.0, 1e3, 1.0),
        "ks": (1.0, 1e-3, 1.0),
        "g": (1.0, 1.0, 1e3),
        "t": (1.0, 1.0, 1e-3),
        "mm g ms": (1e3, 1e3, 1e3),
    }
    for what, units in systems.items():
        result = in_units(*units, dtype)
        pairs = zip(result, expected, strict=True)
        error = max(largest(a - b) / largest(b) for a, b in pairs)
        measure("V19", f"units of {what}, five materials, {dtype.__name__}", error, below=tolerance)
