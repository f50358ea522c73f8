"""Small flows of fluids, damped solids, snow and muscle; the stable time step with viscosity."""

import equinox as eqx
import jax
import jax.numpy as jnp
import laws
import numpy as np
import pytest

import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Slip
from pgjax.grid import Grid
from pgjax.result import Condition
from pgjax.scene import Scene, initial_state
from pgjax.simulate import simulate
from pgjax.splines import BSpline
from pgjax.step import step
from pgjax.timestep import limits, stable_dt
from pgjax.transfer import MLS, SplineGradient

double = pytest.mark.float64

# --- Fluids and damped solids --------------------------------------------------------------------


def column(h=0.05):
    """Fluid of depth 0.4 m in a channel that is periodic along x, two particles per cell."""
    side = h / 4 + h / 2 * np.arange(16)
    x = np.stack(np.meshgrid(side[:8], side, indexing="ij"), axis=-1).reshape(-1, 2)
    x[:, 1] += 2 * h
    floor = Collider(HalfSpace([0.0, 2 * h], [0.0, 1.0]), Slip())
    grid = Grid((0, 0), (4, 14), h, periodic=(True, False))
    material = pm.Material(pm.Fluid(4e5), density=1000.0)
    options = {"gravity": (0, -10.0), "boundaries": [floor], "grid_damping": 60.0}
    return Scene(grid, material, np.full(len(x), h * h / 4), **options), x


def test_pressure_in_a_fluid_at_rest(measure):
    """`p = ρ g` times the depth, to a few per cent, and the depth kept."""
    scene, x = column()
    end = simulate(scene, initial_state(scene, x), dt=stable_dt(scene), frames=1, substeps=600)
    law = scene.materials[0].elasticity
    tau = jax.vmap(lambda H: law.kirchhoff(H, jnp.zeros_like(H)))(end.final.He)
    J = laws.volume(end.final.He)
    p = -np.asarray(tau)[:, 1, 1] / J
    depth = 0.5 - x[:, 1]  # as much fluid lies above a particle as at the start
    inner = depth < 0.3  # the nodes held by the floor disturb the two cells above them
    error = abs(p - 1e4 * depth)[inner].max() / 4e3
    measure("fluid", "pressure under ρ g depth, of that at the floor", error, below=0.04)
    slope = np.polyfit(depth[inner], p[inner], 1)[0] / 1e4
    measure("fluid", "slope of the pressure over ρ g", slope, within=(0.97, 1.03))
    assert abs(np.asarray(end.final.x) - x).max() < 0.003


def periodic(material, cells=16, h=1 / 16, **options):
    """A box of side 1 along x, four cells along y, periodic, 2 x 2 particles per cell."""
    side = (np.arange(2 * cells) + 0.5) / 2 * h
    x = np.stack(np.meshgrid(side, side[:8], indexing="ij"), axis=-1).reshape(-1, 2)
    grid = Grid((0, 0), (cells, 4), h, periodic=(True, True))
    return Scene(grid, material, np.full(len(x), h * h / 4), **options), x


def wave(scene, x, axis, steps, dt):
    """Amplitude of the mode sin(2π x) of one component of velocity over time."""
    mode = np.sin(2 * np.pi * x[:, 0])
    v, C = np.zeros_like(x), np.zeros((len(x), 2, 2))
    v[:, axis] = 1e-4 * mode
    C[:, axis, 0] = 2e-4 * np.pi * np.cos(2 * np.pi * x[:, 0])
    save = lambda s: s.v[:, axis] @ jnp.asarray(mode, s.dtype)  # noqa: E731
    run = simulate(
        scene, initial_state(scene, x, v, C=C), dt=dt, frames=steps, substeps=1, save=save
    )
    return np.asarray(run.t), np.asarray(run.saved) / np.sum(1e-4 * mode * mode)


@double
def test_shear_wave_of_a_viscous_fluid_decays(measure):
    """`exp(−ν k² t)` down to a quarter."""
    fluid = pm.Fluid(1e4, 400.0)
    scene, x = periodic(pm.Material(fluid, density=1000.0), scheme=MLS())
    dt = stable_dt(scene)
    nu, k = 400.0 / 1000, 2 * np.pi
    steps = round(1.4 / (nu * k * k * dt))
    t, a = wave(scene, x, 1, steps, dt)
    rate = -np.polyfit(t, np.log(a), 1)[0] / (nu * k * k)
    measure("fluid", "decay of a shear wave over ν k²", rate, within=(0.98, 1.02))


@double
@pytest.mark.parametrize(("axis", "modulus"), [(1, "shear"), (0, "compression")])
def test_standing_wave_of_a_kelvin_voigt_solid(measure, axis, modulus):
    """`v = e^(−δt) (cos ωt − (δ/ω) sin ωt)`, `δ = η k²/(2ρ)` (twice for compression)."""
    eta = 300.0
    inner = pm.NeoHookean(1e4, 0.3)
    scene, x = periodic(pm.Material(pm.KelvinVoigt(inner, eta), density=1000.0))
    k = 2 * np.pi
    shear = modulus == "shear"
    stiffness = float(inner.mu if shear else inner.lam + 2 * inner.mu)
    delta = (1 if shear else 2) * eta * k * k / 2000
    omega = np.sqrt(stiffness * k * k / 1000 - delta**2)
    dt = stable_dt(scene) / 2
    t, a = wave(scene, x, axis, round(2 * np.pi / omega / dt), dt)
    exact = np.exp(-delta * t) * (np.cos(omega * t) - delta / omega * np.sin(omega * t))
    measure("Kelvin–Voigt", f"{modulus} wave over one period", abs(a - exact).max(), below=0.03)


# --- The stable time step with viscosity ---------------------------------------------------------


@eqx.filter_jit(compiler_options=laws.UNOPTIMISED)
def linear_step(scene, x, dt):
    """The matrix of one step of the perturbations of v, C and Fe about rest."""
    start, n = initial_state(scene, x), len(x)

    def advance(z):
        v, C, H = z[: 2 * n], z[2 * n : 6 * n], z[6 * n :]
        fields = (v.reshape(n, 2), C.reshape(n, 2, 2), H.reshape(n, 3, 3))
        end = step(scene, eqx.tree_at(lambda s: (s.v, s.C, s.He), start, fields), dt)
        return jnp.concatenate([end.v.ravel(), end.C.ravel(), end.He.ravel()])

    return jax.jacfwd(advance)(jnp.zeros(15 * n))


@double
@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("scheme", [SplineGradient(), MLS()], ids=["grad", "mls"])
def test_viscous_bound_is_sharp_and_safe(measure, degree, scheme):
    """No growth at 0.99 of it for clusters of any viscosity; an isolated particle grows at 1.02."""
    law, rng = pm.NeoHookean(1e4, 0.3), np.random.default_rng(degree)
    n = 4
    grid, options = Grid((0, 0), (8, 8), 0.1), {"spline": BSpline(degree), "scheme": scheme}
    material = pm.Material(pm.KelvinVoigt(law, 0.0))
    plain = Scene(grid, material, np.ones(n), **options)
    unit = 1000 * float(plain.D) / float(plain.rest_limit())  # viscous limit = elastic limit
    inside, alone = [], []
    for ratio in (0.03, 0.3, 1.0, 3.0, 30.0):
        damped = eqx.tree_at(
            lambda s: s.materials[0].elasticity.viscosity, plain, jnp.asarray(ratio * unit)
        )
        limit = damped.rest_limit()
        for spread in (0.02, 0.3, 3.0):
            x = 0.35 + np.minimum(spread * 0.1, 0.3) * rng.uniform(size=(n, 2))
            volumes = jnp.asarray(10 ** rng.uniform(-2, 0, n))
            scene = eqx.tree_at(lambda s: s.volumes, damped, volumes)
            A = linear_step(scene, jnp.asarray(x), 0.99 * limit)
            inside.append(abs(np.linalg.eigvals(A)).max())
        # Far from each other, each where the shape functions are steepest.
        corner = 0.15 if degree == 2 else 0.12755
        x = corner + 0.4 * np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        A = linear_step(damped, jnp.asarray(x), 1.05 * limit)
        alone.append(abs(np.linalg.eigvals(A)).max())
    what = f"{type(scheme).__name__}, degree {degree}"
    measure("viscous dt", f"largest growth a step at 0.99, {what}", max(inside) - 1, below=1e-6)
    measure("viscous dt", f"least growth a step at 1.05, {what}", min(alone) - 1, above=1e-3)


def test_viscosity_counts_in_every_check_of_the_time_step():
    """The closed form at rest; the check in `simulate`; DT_ABOVE_BOUND of a compressed state."""
    eta = 500.0
    scene, x = periodic(pm.Material(pm.KelvinVoigt(pm.NeoHookean(1e4, 0.3), eta)), cells=4, h=0.25)
    dry, _ = periodic(pm.Material(pm.NeoHookean(1e4, 0.3)), cells=4, h=0.25)
    limit, elastic = stable_dt(scene, fraction=1.0), stable_dt(dry, fraction=1.0)
    viscous = 1000 * 0.25**2 / 4 / eta
    assert (limit / elastic) ** 2 + limit / viscous == pytest.approx(1, rel=1e-5)
    with pytest.raises(ValueError, match=r"`dt` must be below.*\(1\.10 of it\)"):
        simulate(scene, initial_state(scene, x), dt=1.1 * limit, frames=1, substeps=1)
    now = eqx.filter_jit(limits)(scene, initial_state(scene, x)).elastic
    assert float(jnp.min(now)) == pytest.approx(limit, rel=1e-5)
    fluid, _ = periodic(pm.Material(pm.Fluid(1e4, eta)), cells=4, h=0.25)
    c = (2 * 1e4 / 1000) ** 0.5
    limit, elastic = stable_dt(fluid, fraction=1.0), 0.25 / 2**0.5 / c
    assert (limit / elastic) ** 2 + limit / viscous == pytest.approx(1, rel=1e-5)


def test_hardened_snow_counts_in_the_time_step_and_is_reported():
    """e^(ξ (1 − J_p)) times as stiff: as many times a smaller squared limit."""
    scene, x = periodic(pm.Material(pm.Snow(1e4, 0.2)), cells=4, h=0.25)
    state = initial_state(scene, x)
    packed = eqx.tree_at(lambda s: s.history[0], state, jnp.full(len(x), 0.9))
    crushed = eqx.tree_at(lambda s: s.history[0], state, jnp.full(len(x), 0.5))
    bound = eqx.filter_jit(lambda s: limits(scene, s).elastic[0])
    rest, hard, most = (float(bound(s)) for s in (state, packed, crushed))
    assert (rest / hard) ** 2 == pytest.approx(np.exp(1.0), rel=1e-5)
    assert (rest / most) ** 2 == pytest.approx(np.exp(4.0), rel=1e-5)
    dt = stable_dt(scene)
    end = [
        simulate(scene, s, dt=dt, frames=1, substeps=1, throw=False).status
        for s in (state, packed, crushed)
    ]
    assert [bool(s.happened(Condition.CLAMPED)) for s in end] == [False, False, True]
    assert [bool(s.happened(Condition.DT_ABOVE_BOUND)) for s in end] == [False, False, True]


# --- Active fibres -------------------------------------------------------------------------------


class Knots(eqx.Module):
    """A signal that is linear between values at 0, 0.1, … s."""

    values: jax.Array

    def __call__(self, t):
        return jnp.interp(t, 0.1 * jnp.arange(len(self.values), dtype=t.dtype), self.values)


def strip(activation, values):
    """Mean stretch along x of a damped block whose lower and upper half pull differently."""
    side = 0.3 + 0.05 * (np.arange(8) + 0.5)
    x = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    fibres = pm.ActiveStress(np.tile([1.0, 0, 0], (64, 1)), activation, Knots(values))
    material = pm.Material(pm.KelvinVoigt(pm.NeoHookean(1e4, 0.0), 200.0), active=fibres)
    scene = Scene(Grid((0, 0), (10, 10), 0.1), material, np.full(64, 0.05**2))
    end = simulate(scene, initial_state(scene, x), dt=2e-3, frames=1, substeps=200)
    return jnp.mean(end.final.F[:, 0, 0]), end.final.F


@double
def test_muscle_contracts_and_its_signal_has_a_gradient(measure):
    """It rests at the closed form; the derivative by knots is that of differences."""
    a, values = jnp.full(64, 2e3), jnp.array([0.0, 0.5, 1.0, 1.0, 1.0])
    mean, F = strip(a, values)
    closed = (5e3 / (5e3 + 2e3)) ** 0.5
    measure(
        "muscle", "stretch along the fibre over closed form", mean / closed, within=(0.97, 1.03)
    )
    assert abs(np.asarray(F[:, 1, 1]) - 1).max() < 0.05
    slope = jax.jit(jax.grad(lambda v: strip(a, v)[0]))(values)
    direction, h = jnp.array([1.0, -2.0, 0.5, 1.0, -1.0]), 1e-5
    ahead, behind = (strip(a, values + s * h * direction)[0] for s in (1, -1))
    assert float(slope @ direction) == pytest.approx(float(ahead - behind) / (2 * h), rel=1e-6)
    assert bool((slope[1:] != 0).all())
