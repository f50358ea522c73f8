"""Intervals where differences are not independent, and of what is kept from stage to stage."""

import identification
import numpy as np
import pytest
from identification import TRUTH, block, elastic_problem, motion, parameters

from pgjax.inverse import Joint, Parameter, Positions, Problem, Stage, fit, uncertainty
from pgjax.inverse.levenberg import evaluate

float64 = pytest.mark.float64
NOISE = 2e-3
# Up, and back: it touches nothing.
UP = np.array([0.4, -0.2, 1.0])


def _flight(frames=12):
    """A block that flies without touching anything: x = x₀ + v₀ t + ½ g t²."""
    build, x = block(lambda _: identification.elastic({"E": 2e3, "nu": 0.3}), closed=False)
    unknowns = {"v0": Parameter((0.0, 0.0, 1.0), lower=-3.0, upper=3.0)}
    problem = Problem(
        unknowns, build, Positions(np.zeros((frames, *x.shape))), frame_dt=identification.FRAME
    )
    data = motion(build, {"v0": UP}, frames=frames, substeps=problem.substeps).x[1:]
    return problem, np.asarray(data)


@pytest.mark.slow
@float64
def test_errors_shared_by_a_frame_widen(measure):
    """Each frame is shifted as a whole: by least squares v is off by σ/√Σt², whatever is seen."""
    problem, data = _flight()
    frames, count, _ = data.shape
    held, clusterings, width = 0, [], []
    for seed in range(60):
        shift = NOISE * np.random.default_rng(seed).standard_normal((frames, 1, 3))
        found = fit(problem.observing(Positions(data + shift, sigma=NOISE)), tolerance=1e-3)
        interval = found.uncertainty.interval("v0[0]", 0.9)
        held += interval.low <= UP[0] <= interval.high
        clusterings.append(found.uncertainty.clustering[0])
        width.append(found.uncertainty.deviations[0])
        assert interval.verdict == "widened"
        assert "differences within a frame are alike" in interval.why
    times = identification.FRAME * np.arange(1, frames + 1)
    exact = NOISE / np.sqrt(np.sum(times**2))
    measure("ID3", "coverage of the 90 % interval", held / 60, within=(0.8, 0.98))
    ratio = float(np.median(width)) / exact
    measure("ID3", "deviation over that of whole frames", ratio, within=(0.8, 1.5))
    # Independent noise of all particles would be averaged.
    measure(
        "ID3",
        "clustering over √(number of particles)",
        float(np.median(clusterings)) / np.sqrt(count),
        within=(0.7, 1.5),
    )


@pytest.mark.slow
@float64
def test_independent_noise_is_left_as_it_is():
    problem, data = _flight()
    for seed in range(20):
        noise = NOISE * np.random.default_rng(seed).standard_normal(data.shape)
        found = fit(problem.observing(Positions(data + noise, sigma=NOISE)), tolerance=1e-3)
        assert found.uncertainty.clustering.max() < 2.5
        assert found.uncertainty.interval("v0[1]").verdict == "ok"


@float64
def test_too_few_frames_say_nothing_of_clustering():
    problem, data = _flight(frames=6)
    found = fit(problem.observing(Positions(data, sigma=NOISE)))
    assert np.isnan(found.uncertainty.clustering).all()


@float64
def test_moments_of_several_observations():
    """Each entry of the residual belongs to a frame; motions share none."""
    build, x = block()
    both = [
        Positions(np.zeros((2, 5, 3)), particles=np.arange(5), frames=(1, 3)),
        Positions(np.zeros((3, *x.shape))),
    ]
    problem = Problem(parameters(), build, both, frame_dt=identification.FRAME)
    expected = np.concatenate([np.repeat([1, 3], 15), np.repeat([1, 2, 3], x.size)])
    np.testing.assert_array_equal(problem.moments(), expected)
    point = evaluate(problem, problem.space.start)
    assert point.residual.shape == expected.shape
    twice = Joint([problem, problem]).moments()
    np.testing.assert_array_equal(twice, np.concatenate([expected, expected + 4]))


@pytest.mark.slow
@float64
def test_what_is_kept_is_not_bent(measure):
    """A model that is wrong after the contact moves v₀ of a joint fit, and not of a kept one."""
    right = elastic_problem()
    build, _ = block(lambda v: identification.elastic({**v, "nu": 0.05}))
    unknowns = {name: p for name, p in parameters().items() if name != "nu"}
    wrong = Problem(
        unknowns, build, right.observations, frame_dt=right.frame_dt, substeps=right.substeps
    )
    flight = Stage(frames=2, free=("v0",), keep=True)
    off = {}
    for name, stages in {"joint": [flight._replace(keep=False)], "kept": [flight]}.items():
        found = fit(wrong, stages=stages)
        off[name] = float(np.abs(found.values["v0"] - TRUTH["v0"]).max())
    measure("ID4", "error of a kept v₀ (m/s)", off["kept"], below=1e-6)
    measure("ID4", "error of a joint v₀ (control; m/s)", off["joint"], above=1e-3)


@float64
def test_uncertainty_of_what_is_kept_is_passed_on(measure):
    """First order: E moves by −(J_Eᵀ J_E)⁻¹ J_Eᵀ J_v δv; a refit with another v₀ says the same."""
    free = parameters(nu=Parameter(0.3, fixed=True))
    problem = elastic_problem(noise=NOISE, unknowns=free)
    flight = Stage(frames=2, free=("v0",), keep=True)
    found = fit(problem, stages=[flight])
    sure = found.uncertainty
    early = fit(problem.until(2).freeing(("v0",), found.values)).uncertainty
    places = [sure.names.index(name) for name in early.names]
    np.testing.assert_allclose(sure.deviations[places], early.deviations, rtol=1e-4)
    alone = problem.freeing(("E",), found.values)
    at = fit(alone)
    shift = 0.1 * early.deviations[-1]
    moved = {**found.values, "v0": found.values["v0"] + np.array([0, 0, shift])}
    moved["E"] = at.values["E"]
    refit = fit(problem.freeing(("E",), moved))
    slope = np.log(refit.values["E"] / at.values["E"]) / shift
    own = at.uncertainty.covariance[0, 0]
    E, vz = sure.names.index("E"), sure.names.index("v0[2]")
    measure(
        "ID4",
        "covariance of E with a kept v₀ against a refit (relative)",
        float(abs(sure.covariance[E, vz] / (slope * sure.covariance[vz, vz]) - 1)),
        below=0.05,
    )
    assert sure.covariance[E, E] > own
    assert uncertainty(alone, at.point).covariance[0, 0] == pytest.approx(own)


def test_bad_stages():
    problem = elastic_problem(frames=2)
    kept = Stage(frames=1, free=("v0",), keep=True)
    with pytest.raises(ValueError, match="must not free again what an earlier one keeps"):
        fit(problem, stages=[kept, Stage(free=("v0", "E"))])
    with pytest.raises(ValueError, match="must leave a parameter for the whole problem"):
        fit(problem, stages=[Stage(keep=True)])
