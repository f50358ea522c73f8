"""The stable time step: its closed form, its use in `simulate`, and what a bad one is told."""

import itertools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax.models as pm
from pgjax.grid import Grid
from pgjax.result import NEVER, Condition, SimulationError, SimulationWarning
from pgjax.scene import Scene, initial_state
from pgjax.simulate import simulate
from pgjax.splines import BSpline
from pgjax.timestep import limits, stable_dt
from pgjax.transfer import MLS, SplineGradient

H, E, NU, RHO = 0.1, 1e4, 0.3, 1000.0
F64 = pytest.mark.float64


def sound_speed(E, nu, rho, d):
    """`√(max(dλ + 2μ, 2μ)/ρ)`."""
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    return (max(d * lam + 2 * mu, 2 * mu) / rho) ** 0.5


def block(E=E, nu=NU, *, d=2, law=pm.FixedCorotated, **kwargs):
    """A block of 36 particles (216 in three dimensions) in the middle of its grid."""
    side = 0.35 + 0.05 * np.arange(6)
    x = np.stack(np.meshgrid(*[side] * d, indexing="ij"), axis=-1).reshape(-1, d)
    material = pm.Material(law(E, nu), density=RHO)
    return Scene(Grid(np.zeros(d), (10,) * d, H), material, np.full(len(x), 0.05**d), **kwargs), x


@pytest.mark.parametrize(
    ("degree", "scheme", "beta"),
    [
        (2, SplineGradient(), 0.7071),
        (2, MLS(), 1.0),
        (3, SplineGradient(), 1.1054),
        (3, MLS(), 1.1547),
    ],
    ids=["quadratic-grad", "quadratic-mls", "cubic-grad", "cubic-mls"],
)
def test_bound_at_rest(measure, degree, scheme, beta):
    worst = 0.0
    for d, nu in itertools.product((2, 3), (-0.5, 0.0, 0.3, 0.45)):
        scene, _ = block(nu=nu, d=d, spline=BSpline(degree), scheme=scheme)
        dt = stable_dt(scene, fraction=1.0)
        worst = max(worst, abs(dt * sound_speed(E, nu, RHO, d) / H - beta))
        assert stable_dt(scene) == pytest.approx(dt / 2, rel=1e-12)
    what = f"|β − {beta}|, {type(scheme).__name__}, degree {degree}, 2-D and 3-D, ν −0.5 to 0.45"
    measure("dt", what, worst, below=1e-4)


def test_damping_of_the_shear_lowers_the_bound():
    scheme, spline = SplineGradient(), BSpline(2)
    for kept, beta in ((1.0, 0.7071), (0.9, 0.698), (0.5, 0.655), (0.0, 0.5774)):
        assert scheme.stable_courant(spline, kept) == pytest.approx(beta, abs=5e-4)
    undamped = stable_dt(block()[0], fraction=1.0)
    rpic = stable_dt(block(shear_damping=float("inf"))[0], fraction=1.0)
    assert rpic == pytest.approx(undamped * (2 / 3) ** 0.5, rel=1e-6)


@pytest.mark.parametrize("steps_to_decay", [0.3, 1.0, 3.0, 30.0])
def test_damping_as_a_rate_stays_below_the_sharp_bound(steps_to_decay):
    """A rate r keeps `s = exp(−r Δt)` in a step; the limit must hold for the s it implies."""
    undamped = stable_dt(block()[0], fraction=1.0)
    rate = 1 / (steps_to_decay * undamped)
    dt = stable_dt(block(shear_damping=rate)[0], fraction=1.0)
    sharp = SplineGradient().stable_courant(BSpline(2), np.exp(-rate * dt))
    sharp *= H / sound_speed(E, NU, RHO, 2)
    assert 0.95 * sharp < dt <= sharp * (1 + 1e-6)


def test_stiffest_and_lightest_particle_decides():
    E_of = np.full(36, E)
    E_of[17] = 100 * E
    scene, x = block(E=E_of)
    assert stable_dt(scene) == pytest.approx(stable_dt(block(E=100 * E)[0]), rel=1e-6)
    soft = pm.Material(pm.NeoHookean(E, NU), density=RHO)
    light = pm.Material(pm.NeoHookean(E, NU), density=RHO / 16)
    two = Scene(scene.grid, (soft, light), np.ones(len(x)), counts=(30, 6))
    assert stable_dt(two) == pytest.approx(stable_dt(block()[0]) / 4, rel=1e-6)


def test_speed_and_deformation_of_a_state():
    """`¼ h/(|v| + 1.5 √d h ‖C‖)` and `0.2/‖C‖`, and the elastic limit of a stretched state."""
    scene, x = block()
    v = np.zeros_like(x)
    v[5] = [300.0, 400.0]
    advective = stable_dt(scene, initial_state(scene, x, v))
    assert advective == pytest.approx(0.25 * H / 500.0, rel=1e-6)
    C = np.zeros((36, 2, 2))
    C[3] = [[0.0, 3e3], [4e3, 0.0]]
    spinning = stable_dt(scene, initial_state(scene, x, C=C))
    assert spinning == pytest.approx(0.25 / (1.5 * 2**0.5 * 5e3), rel=1e-6)
    assert float(limits(scene, initial_state(scene, x, C=C)).deformation[3]) == pytest.approx(2e-4)
    stretched = initial_state(scene, x, F=np.tile(np.diag([10.0, 1, 1]), (36, 1, 1)))
    assert stable_dt(scene, stretched) < 0.2 * stable_dt(scene)
    assert stable_dt(scene, initial_state(scene, x)) == pytest.approx(stable_dt(scene), rel=1e-5)


@pytest.mark.parametrize("frame", [1 / 24, 1 / 60, 0.04, 1.0, np.pi, 1e-9, 3e5])
def test_a_frame_is_a_whole_number_of_steps(frame, holds):
    """H54: also where it takes 35 million of them."""
    scene, _ = block()
    dt = stable_dt(scene, frame=frame)
    count = frame / dt
    assert abs(count - round(count)) < 1e-9 * count
    assert dt <= stable_dt(scene) * (1 + 1e-8)
    # Not more steps than needed.
    assert round(count) == 1 or frame / (round(count) - 1) > stable_dt(scene)
    holds("H54")


@F64
def test_time_is_counted_in_steps(measure, holds):
    """H54: a hundred frames later the clock still shows whole frames."""
    scene, x = block()
    frame = 1 / 24
    dt = stable_dt(scene, frame=frame)
    substeps = round(frame / dt)
    trajectory = simulate(
        scene, initial_state(scene, x), dt=dt, frames=100, substeps=substeps, save=nothing
    )
    error = np.max(np.abs(np.asarray(trajectory.t) - frame * np.arange(101)))
    measure("H54", "time of frame 100, relative", error / (100 * frame), below=1e-12)
    holds("H54")


def nothing(state):
    """Save nothing."""
    del state


@pytest.mark.parametrize("value", [0.0, -0.1, 1.5, float("nan")])
def test_fraction_out_of_range(value):
    with pytest.raises(ValueError, match="`fraction` must be in"):
        stable_dt(block()[0], fraction=value)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_frame_out_of_range(value):
    with pytest.raises(ValueError, match="`frame` must be positive"):
        stable_dt(block()[0], frame=value)


def test_traced_parameter_has_no_time_step():
    with pytest.raises(ValueError, match="being traced"):
        jax.jit(lambda E: stable_dt(block(E=E)[0]))(1e4)


@pytest.mark.parametrize("dt", [0.0, -1e-3, float("nan"), float("inf"), jnp.full(1, 1e-3)])
def test_bad_dt_is_refused(dt, holds):
    """H14: zero, negative, not a number; longer than a frame cannot be said, a frame is steps."""
    scene, x = block()
    with pytest.raises(ValueError, match="`dt` must be positive and finite"):
        simulate(scene, initial_state(scene, x), dt=dt, frames=1, substeps=1)
    holds("H14", outcome="refused")


@F64
def test_dt_near_and_above_the_bound(measure, holds):
    """H13: silent up to 0.8 of the bound, a warning up to 1, an error above."""
    scene, x = block()
    limit = stable_dt(scene, fraction=1.0)
    state = initial_state(scene, x, F=np.tile(np.diag([1.01, 1.0, 1.0]), (36, 1, 1)))

    def run(ratio, **kwargs):
        return simulate(scene, state, dt=ratio * limit, frames=4, substeps=50, **kwargs)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(0.79)
    with pytest.warns(SimulationWarning, match=f"0.90 of the stable.*Recommended: {limit / 2:.3g}"):
        run(0.9)
    for ratio in (1.1, 2.0, 25.0):
        with pytest.raises(ValueError, match=rf"`dt` must be below.*\({ratio:.2f} of it\)"):
            run(ratio)
    with pytest.warns(SimulationWarning, match="25.00 of the stable"):
        burst = run(25.0, allow_unstable=True, throw=False)
    lost = int(burst.status.count[Condition.NONFINITE])
    lost += int(burst.status.count[Condition.OUT_OF_DOMAIN])
    first = np.min(burst.status.first[: Condition.OUT_OF_DOMAIN + 1])
    measure("H13", "particles masked at 25 times the bound", lost, within=(1, 36))
    measure("H13", "step of the first", first, within=(1, 199))
    assert not bool(burst.status.ok)
    with pytest.warns(SimulationWarning), pytest.raises(SimulationError, match="from step"):
        run(25.0, allow_unstable=True)
    holds("H13", outcome="refused")


@F64
def test_state_above_the_bound_is_reported():
    """A state that outruns dt, or stiffens, sets DT_ABOVE_BOUND; one that does not, nothing."""
    scene, x = block()
    dt = stable_dt(scene)
    stretched = initial_state(scene, x, F=np.tile(np.diag([4.0, 1.0, 1.0]), (36, 1, 1)))
    end = simulate(scene, stretched, dt=dt, frames=1, substeps=1, throw=False)
    assert bool(end.status.happened(Condition.DT_ABOVE_BOUND))
    for speed, reported in ((0.5, False), (1.1, True)):
        state = initial_state(scene, x, [speed * H / dt, 0.0])
        end = simulate(scene, state, dt=dt, frames=1, substeps=1, throw=False)
        assert bool(end.status.happened(Condition.DT_ABOVE_BOUND)) == reported
        assert int(end.status.first[Condition.DT_ABOVE_BOUND]) == (0 if reported else NEVER)


def dimensionless(scene, x, dtype, steps=100):
    """Displacement and velocity over the speed of sound after as many steps at auto-dt."""
    c = float(scene.rest_sound_speed())
    v = 0.05 * c * np.random.default_rng(1).normal(size=x.shape)
    state = initial_state(scene, x, v, dtype=dtype)
    dt = stable_dt(scene)
    end = simulate(scene, state, dt=dt, frames=1, substeps=steps)
    return np.concatenate([np.asarray(end.final.x, float) - x, np.asarray(end.final.v, float) / c])


@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [
        pytest.param(jnp.float64, 1e-9, marks=F64, id="f64"),
        pytest.param(jnp.float32, 1e-3, id="f32"),
    ],
)
def test_stiffness_changes_the_unit_of_time_alone(measure, dtype, tolerance, holds):
    """H10: from jelly to steel the same number of steps gives the same motion."""
    expected = dimensionless(*block(), dtype)
    assert np.max(np.abs(expected)) > 0.01
    for stiffness in (1e2, 1e6, 1e9):
        result = dimensionless(*block(E=stiffness), dtype)
        error = np.max(np.abs(result - expected)) / np.max(np.abs(expected))
        name = f"E = {stiffness:.0e} against {E:.0e}, {dtype.__name__}"
        measure("H10", name, error, below=tolerance)
    holds("H10", material="FixedCorotated", precision=dtype.__name__)


@F64
def test_stable_up_to_incompressible(measure, holds):
    """H12: at auto-dt no Poisson's ratio makes the kinetic energy grow."""
    for nu in (-0.9, -0.3, 0.0, 0.45, 0.49, 0.499, 0.4999):
        scene, x = block(nu=nu)
        v = 1e-3 * np.random.default_rng(2).normal(size=x.shape)
        end = simulate(
            scene, initial_state(scene, x, v), dt=stable_dt(scene), frames=10, substeps=50
        )
        energy = np.sum(np.asarray(end.saved.v) ** 2, axis=(1, 2))
        measure("H12", f"largest kinetic energy, ν = {nu}", max(energy[1:]) / energy[0], below=1.0)
    holds("H12", material="FixedCorotated")
