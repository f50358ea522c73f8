"""Identification: unknowns, derivatives, solvers, and how sure they are."""

import identification
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identification import TRUTH, block, elastic_problem, motion, parameters

import pgjax
from pgjax import models
from pgjax.inverse import (
    Cauchy,
    FitError,
    Huber,
    Parameter,
    Positions,
    Problem,
    Stage,
    descend_problem,
    fit,
    gradient_check,
    moduli,
    profile,
    would_help,
)
from pgjax.inverse.levenberg import Point, _bounded_step, _promised, evaluate
from pgjax.inverse.parameters import Space

float64 = pytest.mark.float64


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"start": np.nan}, "`start` must be finite"),
        ({"start": 3.0, "upper": 2.0}, r"`start` must be in \[-inf, 2.0\]"),
        ({"start": 0.0, "log": True}, "`start` must be positive"),
        ({"start": 1.0, "lower": 2.0, "upper": 1.0}, "`lower` must be below `upper`"),
        ({"start": 1.0, "lower": -1.0, "log": True}, "`lower` must be at least 0"),
        ({"start": (1.0, 2.0), "upper": (3.0, 3.0, 3.0)}, "`upper` must be one number"),
        ({"start": 1.0, "prior": (1.0, 0.0)}, "`prior` must hold a finite positive deviation"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(ValueError, match=message):
        Parameter(**arguments)


def test_coordinates_and_values():
    space = Space(
        {
            "E": Parameter(1e4, upper=1e5, log=True),
            "nu": Parameter(0.3, fixed=True),
            "v": Parameter((1.0, -2.0), lower=(-3.0, -4.0)),
        }
    )
    assert space.names == ["E", "v[0]", "v[1]"]
    np.testing.assert_allclose(space.start, [np.log(1e4), 1, -2])
    lower, upper = space.bounds()
    np.testing.assert_allclose(lower, [-np.inf, -3, -4])
    np.testing.assert_allclose(upper, [np.log(1e5), np.inf, np.inf])
    values = space.values(np.array([np.log(2e4), 0.5, 0.25]))
    np.testing.assert_allclose(values["E"], 2e4, rtol=1e-6)
    np.testing.assert_allclose(values["nu"], 0.3, rtol=1e-6)
    np.testing.assert_allclose(space.vector(values), [np.log(2e4), 0.5, 0.25], rtol=1e-6)
    with pytest.raises(ValueError, match="names friction"):
        space.vector({**values, "friction": 1.0})
    with pytest.raises(ValueError, match="must hold 'v'"):
        space.vector({"E": 1.0})


def test_moduli():
    made = moduli(mu=1e4, kappa=1e6)
    law = models.FixedCorotated(**made)
    np.testing.assert_allclose([law.mu, law.kappa], [1e4, 1e6], rtol=1e-5)
    law = models.FixedCorotated(**moduli(mu=2e4, lam=3e4))
    np.testing.assert_allclose([law.mu, law.lam], [2e4, 3e4], rtol=1e-5)
    with pytest.raises(ValueError, match="one of `lam` and `kappa`"):
        moduli(mu=1.0)


@pytest.mark.parametrize("loss", [Huber(1.2), Cauchy(2.0)])
def test_robust_losses(loss):
    """Half the square is the loss, and its slope is the loss's, at 0 and at the kink too."""
    r = jnp.asarray([-30.0, -2.0, -1.2, -1e-3, 0.0, 1e-5, 0.5, 1.2, 4.0])
    k = loss.k
    if isinstance(loss, Huber):
        rho = jnp.where(jnp.abs(r) <= k, r**2 / 2, k * jnp.abs(r) - k**2 / 2)
        slope = jnp.clip(r, -k, k)
    else:
        rho = k**2 / 2 * jnp.log1p((r / k) ** 2)
        slope = r / (1 + (r / k) ** 2)
    np.testing.assert_allclose(loss(r) ** 2 / 2, rho, rtol=2e-5, atol=1e-12)
    found = jax.vmap(jax.grad(lambda a: loss(a) ** 2 / 2))(r)
    np.testing.assert_allclose(found, slope, rtol=2e-5, atol=1e-7)


def test_time_step_is_that_of_the_stiffest():
    build, x = block()
    data = Positions(np.zeros((2, *x.shape)))
    problem = Problem(parameters(), build, data, frame_dt=identification.FRAME)
    stiff, state = build({"E": 5e4, "nu": 0.42, "v0": jnp.array([0.0, 0, -1])})
    longest = pgjax.stable_dt(stiff, state)
    assert problem.dt <= longest
    assert identification.FRAME / (problem.substeps - 1) > longest
    unbounded = parameters(E=Parameter(8e3, log=True))
    with pytest.raises(ValueError, match="`upper` of parameter 'E' must be given"):
        Problem(unbounded, build, data, frame_dt=identification.FRAME)
    with pytest.raises(ValueError, match="`substeps` must be at least"):
        Problem(parameters(), build, data, frame_dt=identification.FRAME, substeps=2)
    with pytest.raises(ValueError, match=r"`nu` must be below 0\.5"):
        Problem(parameters(nu=Parameter(0.2, lower=0.0, upper=0.5)), build, data, frame_dt=0.02)
    with pytest.raises(ValueError, match="`upper` of parameter 'nu' must be given"):
        Problem(parameters(nu=Parameter(0.2, lower=0.0)), build, data, frame_dt=0.02)


@float64
def test_derivatives():
    """Forward mode, reverse mode and differences agree."""
    check = gradient_check(elastic_problem(frames=4))
    assert check.modes < 1e-10
    assert check.best.max() < 1e-6
    assert "E" in str(check)


@float64
def test_recovers_an_elastic_body(measure):
    problem = elastic_problem()
    found = fit(problem)
    assert found.converged
    assert found.iterations <= 15
    for name, truth in TRUTH.items():
        error = np.max(np.abs(found.values[name] - truth)) / np.max(np.abs(truth))
        measure("ID1", f"relative error of {name}", error, below=1e-6)
    costs = [trial.cost for trial in found.trials if trial.taken]
    assert costs == sorted(costs, reverse=True)
    assert "E" in found.summary()


@float64
def test_noise_gives_intervals():
    found = fit(elastic_problem(noise=2e-3), tolerance=1e-4)
    assert found.uncertainty is not None
    # The noise was given, and there is no other error.
    np.testing.assert_allclose(found.uncertainty.noise, 1, rtol=0.05)
    for name, truth in (("E", 2e4), ("nu", 0.3), ("v0[2]", -1.5)):
        interval = found.uncertainty.interval(name, 0.999)
        assert interval.low < truth < interval.high
        assert interval.verdict == "ok"
    np.testing.assert_allclose(np.diag(found.uncertainty.correlation), 1)
    deviations = [d.deviation for d in found.uncertainty.directions()]
    assert deviations == sorted(deviations)
    with pytest.raises(ValueError, match="`name` must be one of E, nu"):
        found.uncertainty.interval("rho")


@float64
@pytest.mark.slow
def test_coverage(measure):
    """Over 400 replicates the 90 % interval holds the truth in 85 to 95 %."""
    problem = elastic_problem(frames=6, unknowns=parameters(nu=Parameter(0.3, fixed=True)))
    noise, clean = 2e-3, problem.observations[0].data
    start = problem.space.vector({"E": TRUTH["E"], "v0": TRUTH["v0"]})
    held = np.zeros(4)
    for seed in range(400):
        rng = np.random.default_rng(seed)
        data = np.asarray(clean) + noise * rng.standard_normal(clean.shape)
        noisy = problem.observing(Positions(data, sigma=noise))
        end = fit(_starting(noisy, start), tolerance=1e-3, trials=6)
        for k, name in enumerate(problem.names):
            interval = end.uncertainty.interval(name, 0.9)
            truth = (TRUTH["E"], *TRUTH["v0"])[k]
            held[k] += interval.low <= truth <= interval.high
    for k, name in enumerate(problem.names):
        measure(
            "ID2", f"coverage of the 90 % interval of {name}", held[k] / 400, within=(0.85, 0.95)
        )


def _starting(problem, u):
    """The problem with another first guess."""
    values = {n: np.asarray(v) for n, v in problem.space.values(u).items()}
    return problem.freeing(tuple(problem.space.free), values)


@float64
def test_bound_is_kept_and_told():
    """The truth lies beyond a bound: no iterate does."""
    unknowns = parameters(E=Parameter(8e3, lower=2e3, upper=1.5e4, log=True))
    found = fit(elastic_problem(unknowns=unknowns), tolerance=1e-4)
    assert all(np.exp(trial.u[0]) <= 1.5e4 * (1 + 1e-6) for trial in found.trials)
    np.testing.assert_allclose(found.values["E"], 1.5e4, rtol=1e-5)
    assert any("E ended on its upper bound" in text for text in found.messages)
    assert found.uncertainty.interval("E").verdict == "not identifiable"


def _plastic(values):
    return models.Material(
        models.StVKHencky(values["E"], 0.3), models.VonMises(values["yield_stress"])
    )


def _plastic_problem(start):
    build, x = block(_plastic)
    unknowns = {
        "E": Parameter(3e4, lower=1e4, upper=5e4, log=True),
        "yield_stress": Parameter(start, lower=10.0, upper=1e6, log=True),
        "v0": Parameter(TRUTH["v0"], fixed=True),
    }
    blank = Positions(np.zeros((6, *x.shape)))
    problem = Problem(unknowns, build, blank, frame_dt=identification.FRAME)
    truth = {"E": 4e4, "yield_stress": 600.0, "v0": TRUTH["v0"]}
    data = motion(build, truth, frames=6, substeps=problem.substeps).x[1:]
    return problem.observing(Positions(data))


@float64
def test_no_yielding_is_named():
    with pytest.raises(FitError, match="yield_stress has no influence"):
        fit(_plastic_problem(5e5))


@float64
def test_recovers_a_yield_stress():
    found = fit(_plastic_problem(200.0))
    np.testing.assert_allclose(found.values["yield_stress"], 600, rtol=1e-5)
    np.testing.assert_allclose(found.values["E"], 4e4, rtol=1e-5)
    # Whatever was rejected was named.
    assert all(trial.taken or trial.note for trial in found.trials)


@pytest.mark.slow
@float64
def test_lost_particles_are_rejected():
    """A first guess that throws the body out of the grid fails by name; a later trial is undone."""
    build, x = block(closed=False)

    def problem(start):
        unknowns = {
            "v0": Parameter((0.0, 0.0, start), lower=-50.0, upper=50.0),
            "E": Parameter(1e4, fixed=True),
            "nu": Parameter(0.3, fixed=True),
        }
        # So far away that the first step leads out of the grid.
        far = Positions(np.broadcast_to(x + np.array([0, 0, 2.0]), (4, *x.shape)))
        return Problem(unknowns, build, far, frame_dt=identification.FRAME)

    with pytest.raises(FitError, match="left the grid"):
        fit(problem(40.0))
    found = fit(problem(1.0), trials=12, tolerance=1e-2, intervals=False)
    rejected = [trial for trial in found.trials if not trial.taken]
    assert any("left the grid" in trial.note for trial in rejected)
    assert bool(found.point.status.ok)
    assert found.point.cost < found.trials[0].cost


@float64
def test_missing_data_do_not_count():
    problem = elastic_problem(frames=3)
    data = np.array(problem.observations[0].data)
    data[1, :7] = np.nan
    found = problem.observing(Positions(data))
    r = evaluate(found, problem.space.start).residual.reshape(data.shape)
    assert not r[1, :7].any()
    assert r[0].any()
    assert np.isfinite(evaluate(found, problem.space.start).rows).all()


@float64
def test_stages_and_starts():
    problem = elastic_problem()
    lines = []
    staged = fit(
        problem,
        stages=[Stage(frames=2, free=("v0",)), Stage(frames=4)],
        tolerance=1e-5,
        report=lines.append,
    )
    np.testing.assert_allclose(staged.values["E"], TRUTH["E"], rtol=2e-3)
    assert len(lines) == staged.iterations
    many = fit(problem, starts=8, tolerance=1e-5, intervals=False)
    np.testing.assert_allclose(many.values["E"], TRUTH["E"], rtol=2e-3)
    assert len(many.others) == 3
    free = parameters(v0=Parameter((0.0, 0.0, -1.0)))
    with pytest.raises(ValueError, match=r"'v0\[0\]' has none"):
        fit(elastic_problem(unknowns=free), starts=4)


@float64
def test_priors():
    """A strong one decides; its deviation is not scaled by the noise of the data."""
    told = parameters(E=Parameter(8e3, lower=2e3, upper=5e4, log=True, prior=(1e4, 1e-4)))
    found = fit(elastic_problem(unknowns=told, noise=5e-3), tolerance=1e-4)
    np.testing.assert_allclose(found.values["E"], 1e4, rtol=1e-2)
    np.testing.assert_allclose(found.uncertainty.deviations[0], 1e-4, rtol=0.02)
    # Without data about it, the prior is all there is.
    early = parameters(nu=Parameter(0.2, lower=0.0, upper=0.42, prior=(0.25, 0.03)))
    early["E"] = Parameter(8e3, fixed=True)
    known = fit(elastic_problem(frames=2, unknowns=early, noise=1e-3), tolerance=1e-6)
    np.testing.assert_allclose(known.values["nu"], 0.25, rtol=1e-6)
    np.testing.assert_allclose(known.uncertainty.deviations[0], 0.03, rtol=1e-6)


@float64
def test_bounded_steps_lower_the_model():
    """A step that a bound cuts off is the best within it, not a cut one."""
    curvature = np.array([[1.0, 0.99], [0.99, 1.0]])
    rows = np.linalg.cholesky(curvature)
    wanted = np.linalg.solve(rows, np.array([-0.1, 0.1]))
    nothing = np.zeros((2, 0))
    point = Point(np.zeros(2), 0.0, wanted, rows, np.zeros(0), nothing, None, None)
    np.testing.assert_allclose(point.slope, [-0.1, 0.1])
    step = _bounded_step(point, 0.0, np.ones(2), np.full(2, -np.inf), np.array([0.1, np.inf]))
    # At u0 = 0.1 the other one minimises the rest: 0.1 + 0.99 · 0.1 + u1 = 0.
    np.testing.assert_allclose(step, [0.1, -0.199], rtol=1e-6)
    assert _promised(point, step) > 0


@pytest.mark.slow
@float64
def test_profile_agrees_with_the_interval():
    unknowns = parameters(nu=Parameter(0.3, fixed=True))
    found = fit(elastic_problem(noise=2e-3, frames=4, unknowns=unknowns))
    interval = found.uncertainty.interval("E")
    half = (interval.high - interval.low) / 2
    ends = [interval.low, interval.low + 0.5 * half, interval.high - 0.5 * half, interval.high]
    curve = profile(found, "E", [interval.low - 0.3 * half, *ends, interval.high + 0.3 * half])
    assert list(curve.inside[[2, 3, 5]]) == [True, True, False]
    rise = curve.threshold - found.point.cost
    # The cost of a body in contact is not quite a parabola: 1.34 and 2.79 against 1.91.
    ends = curve.costs[[1, 4]] - found.point.cost
    np.testing.assert_allclose(ends.mean(), rise, rtol=0.15)
    assert (ends > 0.6 * rise).all()


@pytest.mark.slow
@float64
def test_more_views_help():
    problem = elastic_problem(frames=6, noise=2e-3)
    found = fit(problem, tolerance=1e-3)
    one = problem.observing(Positions(np.zeros((6, 1, 3)), particles=[0], sigma=2e-3))
    longer = elastic_problem(frames=9, noise=2e-3)
    expected = would_help(found, {"one more particle": one, "a longer film": longer})
    now = expected["now"]
    assert (expected["one more particle"] <= now * (1 + 1e-6)).all()
    assert (expected["a longer film"] < expected["one more particle"]).all()


@pytest.mark.slow
@float64
def test_first_order_descent_reaches_it_too():
    unknowns = parameters(nu=Parameter(0.3, fixed=True), v0=Parameter(TRUTH["v0"], fixed=True))
    values, end = descend_problem(elastic_problem(unknowns=unknowns), steps=40, rate=0.1)
    np.testing.assert_allclose(values["E"], TRUTH["E"], rtol=0.03)
    assert end.cost < 1e-2 * end.history[0].cost
