"""Runs one case: `python -m benchmarks.identification.worker NAME TIER VIEWS`."""

import json
import os
import sys

import numpy as np

from benchmarks.identification.case import problem
from benchmarks.identification.cases import all_cases
from pgjax.inverse import FitError, fit


def run(name: str, tier: str, views: int) -> dict:
    """One row of the table."""
    case = all_cases()[name]
    made = problem(case, tier, views or None)
    cores = len(os.sched_getaffinity(0))
    row = {
        "case": name,
        "tier": tier,
        "views": views if case.views else 0,
        "particles": int(made.build(_start(made))[0].particle_count),
        "steps": made.frames * made.substeps,
        "degree": case.resolution.spline,
        "double": case.double,
        "cores": cores,
    }
    try:
        found = fit(
            made,
            stages=case.stages,
            trials=case.trials,
            tolerance=1e-6 if case.double else 1e-4,
            report=lambda line: print(line, file=sys.stderr, flush=True),
        )
    except FitError as error:
        return {**row, "error": str(error)}
    # The first point of each descent is no iteration.
    row["iterations"] = found.iterations - len(case.stages) - 1
    row["limit"], row["simulations"] = case.limit, found.simulations
    row["seconds"], row["converged"] = round(found.seconds, 1), found.converged
    row["reason"], row["messages"] = found.reason, found.messages
    row["noise"] = found.uncertainty.noise
    row["estimates"] = [_estimate(case, tier, found, name) for name in found.problem.names]
    return row


def _start(made):
    import jax.numpy as jnp

    return made.space.values(jnp.asarray(made.space.start, jnp.zeros(()).dtype))


def _estimate(case, tier: str, found, name: str) -> dict:
    base = name.partition("[")[0]
    place = found.problem.names.index(name)
    truth = found.problem.space.vector({n: case.truth[n] for n in found.problem.space.free})[place]
    value, target = found.point.u[place], case.targets[base]
    if found.problem.space.logarithmic[place]:
        truth, value = np.exp(truth), np.exp(value)
    interval = found.uncertainty.interval(name)
    demand = target.self_error if tier == "self" else target.cross_error
    error = target.error(value, truth)
    return {
        "name": name,
        "truth": float(truth),
        "estimate": float(value),
        "error": float(error),
        "scale": target.scale,
        "demand": demand,
        "met": None if demand is None else bool(error <= demand),
        "low": interval.low,
        "high": interval.high,
        "covers": bool(interval.low <= truth <= interval.high),
        "mismatch": interval.mismatch,
        "verdict": interval.verdict,
        "why": interval.why,
    }


if __name__ == "__main__":
    print(json.dumps(run(sys.argv[1], sys.argv[2], int(sys.argv[3]))))
