"""Level 6: a parameter found again (G6), and how much a motion magnifies a change (G7)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from scenes import lattice

import pgjax
import pgjax.models as pm
from pgjax.boundary import Box, Separating
from pgjax.inverse import Parameter, Positions, Problem, fit, growth
from pgjax.inverse.growth import LARGEST_GROWTH

pytestmark = pytest.mark.float64

E, NU, RHO, H = 1e4, 0.3, 1000.0, 0.1


# --- G6: Young's modulus from a trajectory -------------------------------------------------------


def bar(values):
    """A bar of 4 × 1 cells that is pulled apart by its own velocity and swings; scene and state."""
    X = lattice((0.4, 0.5), (4, 1), H)
    scene = pgjax.Scene(
        pgjax.Grid([0.0, 0.0], (12, 11), H),
        pm.Material(pm.FixedCorotated(values["E"], values["nu"]), density=RHO),
        np.full(len(X), (H / 2) ** 2),
    )
    return scene, pgjax.initial_state(scene, X, 2.0 * (X - np.mean(X, axis=0)) * [1.0, 0.0])


def recorded(dt, frames, substeps):
    """What the oracle sees of it at the true E: a step of plain loops that shares no code."""
    scene, start = bar({"E": E, "nu": NU})
    mu, lam, _ = oracle.lame(E, NU)
    everything = slice(0, scene.particle_count)
    law = oracle.Material(
        everything, RHO, lambda Fe: oracle.fixed_corotated(Fe, mu=mu, lam=lam), oracle.elastic
    )
    params = oracle.Params([law], np.zeros(2), H, np.zeros(2))
    state = oracle.rest_state(*map(np.asarray, (start.x, start.v, scene.volumes)))
    seen = []
    for _ in range(frames):
        for _ in range(substeps):
            state = oracle.oracle_step(state, params, dt)
        seen.append(state.x)
    return np.array(seen)


FRAME, FRAMES = 0.02, 8


def modulus_problem(start):
    """E is unknown; the record is the oracle's, made with the time step of the problem."""
    unknowns = {
        "E": Parameter(start, lower=1e3, upper=4e4, log=True, unit="Pa"),
        "nu": Parameter(NU, fixed=True),
    }
    blank = Positions(np.zeros((FRAMES, 16, 2)))
    problem = Problem(unknowns, bar, blank, frame_dt=FRAME)
    return problem.observing(Positions(recorded(problem.dt, FRAMES, problem.substeps)))


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_g6_modulus_from_a_trajectory(measure, factor):
    """From a quarter and from four times the truth, in two thirds of a period of the bar.

    Over a whole one any stiffness far above looks as wrong, and the fit needs a `Stage`.
    """
    found = fit(modulus_problem(factor * E), trials=30, intervals=False)
    off = abs(float(found.values["E"]) / E - 1)
    measure("G6", f"error of E, from {factor} of it", off, below=1e-3)
    measure("G6", f"Gauss–Newton steps, from {factor} of E", found.iterations, below=30)
    assert found.converged
    assert not found.messages


# --- G7: growth ----------------------------------------------------------------------------------


class Repelled(eqx.Module):
    """A body whose centre is pushed away from a point, `a = k² (x̄ − c)`: an unstable balance.

    Args:
        centre: c, m, `(d,)`.
        rate: k, 1/s.
    """

    centre: jnp.ndarray
    rate: jnp.ndarray

    def __call__(self, particles, t, dt):
        del t
        mass = particles.mass[:, None]
        off = jnp.sum(mass * particles.x, axis=0) / jnp.sum(mass) - self.centre
        return particles._replace(v=particles.v + dt * self.rate**2 * off[None, :])


def flight(frames=10, rate=None, fraction=0.5):
    """An elastic block at rest in space, balanced on a repelling point if `rate` is given.

    The body itself stays; only the change of its velocity grows. Seen is noise of 1 mm.
    """
    X = lattice((0.5, 0.5), (2, 2), H)
    centre = jnp.full(2, 0.6)
    conditions = () if rate is None else (Repelled(centre, jnp.asarray(rate)),)

    def build(values):
        scene = pgjax.Scene(
            pgjax.Grid([0.0, 0.0], (12, 12), H),
            pm.Material(pm.NeoHookean(values["E"], NU), density=RHO),
            np.full(len(X), (H / 2) ** 2),
            particle_conditions=conditions,
        )
        v = jnp.broadcast_to(values["v0"], X.shape)
        return scene, pgjax.initial_state(scene, X, v)

    unknowns = {
        "v0": Parameter((0.0, 0.0), lower=-1.0, upper=1.0, unit="m/s"),
        "E": Parameter(E, upper=E, log=True, fixed=fraction < 1),
    }
    seen = X + 1e-3 * np.random.default_rng(0).standard_normal((frames, *X.shape))
    return Problem(unknowns, build, Positions(seen), frame_dt=0.05, fraction=fraction)


def repelled(problem, rate):
    """Exact `|∂x/∂v₀|/t` of each frame: `v ← v + Δt k² x`, `x ← x + Δt v` (→ sinh(kt)/(kt))."""
    x, v, seen = 0.0, 1.0, []
    for step in range(1, problem.frames * problem.substeps + 1):
        v += problem.dt * rate**2 * x
        x += problem.dt * v
        if step % problem.substeps == 0:
            seen.append(x / (step * problem.dt))
    return np.array(seen)


def test_g7_free_flight_is_one(measure):
    """`∂x/∂v₀ = t` of a body in free flight, whatever it is made of; and nothing is said."""
    problem = flight()
    report = growth(problem)
    measure("G7", "growth in free flight, error", np.abs(report.values - 1).max(), below=1e-12)
    np.testing.assert_allclose(report.t, 0.05 * np.arange(1, 11), rtol=1e-14)
    assert not report.messages
    assert not fit(problem, intervals=False).messages


def test_g7_exponential_growth_is_reported(measure):
    """The balance on a point: as the formula, e¹⁵ in 0.5 s, and a warning where it passes 1e6."""
    rate = 40.0
    problem = flight(rate=rate)
    report, exact = growth(problem), repelled(flight(), rate)
    measure(
        "G7",
        "growth of an unstable balance, error",
        np.abs(report.values / exact - 1).max(),
        below=1e-9,
    )
    t = problem.frame_dt * problem.frames
    continuous = np.sinh(rate * t) / (rate * t)
    measure("G7", "the same over sinh(kt)/(kt)", report.largest / continuous, within=(0.5, 1.5))
    measure.curve(
        "G7", "growth of |∂x/∂v₀|", "unstable balance", report.t, report.values, over="t, s"
    )
    first = 1 + int(np.argmax(exact > LARGEST_GROWTH))
    assert [f"at frame {first} " in m for m in report.messages] == [True]
    assert "chaotic" in str(report)


def test_g7_a_fit_warns():
    """What a fit finds under such a growth comes with the warning."""
    found = fit(flight(rate=40.0), intervals=False)
    told = [m for m in found.messages if "unstable or chaotic" in m]
    assert [m[:5] for m in told] == ["v0[0]", "v0[1]"]


def test_g7_too_large_a_time_step_shows(measure):
    """A stiffness far beyond that for which the time step was chosen."""
    problem = flight(fraction=1.0)
    stable = growth(problem).largest
    unstable = growth(problem, {"v0": np.zeros(2), "E": 64 * E})
    scene, _ = problem.build({"v0": jnp.zeros(2), "E": jnp.asarray(64 * E)})
    assert problem.dt > 4 * float(scene.rest_limit())
    measure("G7", "growth below the bound of the time step", stable, below=1 + 1e-9)
    measure("G7", "growth above 4 times the bound", unstable.largest, above=LARGEST_GROWTH)
    assert unstable.messages


LAWS = {
    "rubber": lambda E: pm.Material(pm.NeoHookean(E, NU), density=RHO),
    "sand": lambda E: pm.Material(pm.StVKHencky(E, NU), pm.DruckerPrager(30.0), RHO),
}


@pytest.mark.parametrize("what", ["rubber", pytest.param("sand", marks=pytest.mark.slow)])
def test_g7_growth_of_impacts(measure, what):
    """What is stated of ordinary scenes: a block thrown on a rough floor, over 0.6 s."""

    def build(values):
        X = lattice((0.3, 0.4), (4, 4), H)
        scene = pgjax.Scene(
            pgjax.Grid([0.0, 0.0], (20, 14), H),
            LAWS[what](values["E"]),
            np.full(len(X), (H / 2) ** 2),
            gravity=[0.0, -9.8],
            boundaries=(Box([0.2, 0.2], [1.8, 1.2], Separating(0.3)),),
        )
        return scene, pgjax.initial_state(scene, X, (0.5, -1.0))

    unknowns = {"E": Parameter(4 * E, upper=4 * E, log=True)}
    blank = Positions(np.zeros((12, 64, 2)))
    report = growth(Problem(unknowns, build, blank, frame_dt=0.05))
    measure.curve("G7", "growth of |∂x/∂v₀|", what, report.t, report.values, over="t, s")
    # Free flight first, exactly; the floor takes the motion, or magnifies what differs in it.
    measure("G7", f"growth after 0.05 s, {what}", report.values[0], within=(0.99, 1.01))
    measure("G7", f"growth after 0.6 s, {what}", report.values[-1], within=(0.1, 10.0))
    assert not report.messages
