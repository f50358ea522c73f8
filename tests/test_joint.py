"""Several motions of one material, and trials that a time step is not made for."""

import jax.numpy as jnp
import numpy as np
import pytest
from identification import FRAME, TRUTH, block, elastic_problem, motion, parameters

from pgjax.inverse import FitError, Joint, Parameter, Positions, Problem, Stage, fit
from pgjax.inverse.levenberg import _unstable, evaluate

THROWS = {"v_one": (0.4, -0.2, -1.5), "v_two": (-0.3, 0.5, -1.0)}


def throw(name, *, frames=6, noise=0.0, seed=0, E=None):
    """One throw of the block, whose velocity is an unknown of its own."""
    build, x = block()
    unknowns = parameters()
    velocity = unknowns.pop("v0")
    unknowns = unknowns | ({} if E is None else {"E": E}) | {name: velocity}

    def named(values):
        return build({"E": values["E"], "nu": values["nu"], "v0": values[name]})

    blank = Positions(np.zeros((frames, *x.shape)))
    problem = Problem(unknowns, named, blank, frame_dt=FRAME)
    known = {"E": TRUTH["E"], "nu": TRUTH["nu"], name: np.array(THROWS[name])}
    seen = motion(named, known, frames=frames, substeps=problem.substeps)
    data = np.asarray(seen.x)[1:]
    data = data + noise * np.random.default_rng(seed).standard_normal(data.shape)
    return problem.observing(Positions(data, sigma=max(noise, 1e-3)))


@pytest.mark.float64
def test_is_its_parts():
    parts = [throw("v_one"), throw("v_two", frames=4)]
    joint = Joint(parts)
    assert joint.names == ["E", "nu", *(f"{name}[{k}]" for name in THROWS for k in range(3))]
    assert joint.last == 6
    u = jnp.asarray(joint.space.start, jnp.zeros(()).dtype)
    whole = joint.outcome(u)
    alone = [part.outcome(jnp.asarray(part.space.start, u.dtype)) for part in parts]
    np.testing.assert_array_equal(whole.residual, jnp.concatenate([a.residual for a in alone]))
    np.testing.assert_array_equal(whole.status.count, sum(a.status.count for a in alone))
    short = joint.until(5)
    assert [part.frames for part in short.problems] == [5, 4]
    assert short.problems[0].substeps == parts[0].substeps


@pytest.mark.float64
def test_recovers_what_is_common_and_what_is_not(measure):
    joint = Joint([throw("v_one"), throw("v_two")])
    found = fit(joint, stages=[Stage(frames=2, free=("v_one", "v_two"))])
    assert found.converged, found.reason
    truth = {"E": TRUTH["E"], "nu": TRUTH["nu"], **THROWS}
    for name, value in truth.items():
        error = np.max(np.abs(found.values[name] - np.asarray(value)) / np.max(np.abs(value)))
        measure("identification", f"{name}, two throws, relative error", error, below=1e-5)


@pytest.mark.slow
@pytest.mark.float64
def test_two_throws_say_more_than_one():
    parts = [throw("v_one", noise=2e-3, seed=1), throw("v_two", noise=2e-3, seed=2)]
    joint = fit(Joint(parts))
    alone = fit(parts[0])
    assert joint.uncertainty is not None
    assert alone.uncertainty is not None
    for name in ("E", "nu"):
        place = joint.problem.names.index(name)
        assert joint.uncertainty.deviations[place] < alone.uncertainty.deviations[place]
        interval = joint.uncertainty.interval(name, 0.99)
        assert interval.low <= TRUTH[name] <= interval.high


def test_parts_have_to_agree():
    with pytest.raises(ValueError, match="must hold at least one"):
        Joint([])
    other = Parameter(9e3, lower=2e3, upper=5e4, log=True, unit="Pa")
    with pytest.raises(ValueError, match="'E' of problem 1 is"):
        Joint([throw("v_one"), throw("v_two", E=other)])
    with pytest.raises(ValueError, match="must be at least 1 and not before"):
        Joint([throw("v_one")]).until(0)


@pytest.mark.float64
def test_a_motion_the_time_step_is_not_made_for_is_no_gain():
    # At the upper bound the step is 0.997 of the sharp limit at rest: any deformation is too much.
    E = Parameter(8e3, lower=2e3, upper=6.9e4, log=True)
    problem = elastic_problem(frames=6, substeps=5, unknowns=parameters(E=E))
    soft = evaluate(problem, problem.space.start)
    hard = evaluate(
        problem, problem.space.vector({"E": 6.9e4, "nu": 0.42, "v0": np.array([0, 0, -3.0])})
    )
    assert _unstable(soft, soft) == ""
    assert "DT_ABOVE_BOUND" in _unstable(soft, hard)
    # Where it was so from the start, nothing else could be compared.
    assert _unstable(hard, hard) == ""


def test_a_start_that_fails_names_its_throw():
    build, x = block(closed=False)
    velocity = Parameter((0.0, 0.0, -3.0), lower=-30.0, upper=30.0)
    fast = Problem(
        parameters(v0=velocity), build, Positions(np.zeros((40, *x.shape))), frame_dt=FRAME
    )
    with pytest.raises(FitError, match="left the grid"):
        fit(Joint([fast]))
