"""Levenberg–Marquardt on the residual vector, within bounds, in double precision on the host."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.optimize import lsq_linear

from pgjax.inverse.problem import AbstractProblem, linearised
from pgjax.result import ERRORS, Condition, Status

# A fall of the cost by a tenth of a standard deviation of the noise that was given: rounding may
# hide it, and it says nothing.
_WORTHLESS = 0.1**2 / 2


class Point(NamedTuple):
    """The residual and its derivative at one point.

    Attributes:
        u: free coordinates, `(p,)`.
        cost: half the squared sum of residual and prior.
        residual: of the data, `(m,)`.
        rows: `∂r/∂u_j`, `(p, m)`.
        prior: residual of the priors, `(k,)`.
        prior_rows: its derivative, `(p, k)`.
        failure: why the point cannot be used; None if it can.
        status: of the simulation.
    """

    u: np.ndarray
    cost: float
    residual: np.ndarray
    rows: np.ndarray
    prior: np.ndarray
    prior_rows: np.ndarray
    failure: str | None
    status: Status

    @property
    def slope(self) -> np.ndarray:
        """Gradient of the cost, `(p,)`."""
        return self.rows @ self.residual + self.prior_rows @ self.prior

    @property
    def curvature(self) -> np.ndarray:
        """`JᵀJ` of data and priors, `(p, p)`."""
        return self.rows @ self.rows.T + self.prior_rows @ self.prior_rows.T


class Trial(NamedTuple):
    """One line of the history.

    Attributes:
        names: of the coordinates that were free.
        frames: number of frames that counted.
        u: where.
        cost: half the squared sum of the residual there; infinite where it failed.
        taken: whether it became the current point.
        note: why not, or nothing.
        seconds: since the start.
    """

    names: tuple[str, ...]
    frames: int
    u: np.ndarray
    cost: float
    taken: bool
    note: str
    seconds: float


class Descent(NamedTuple):
    """How a solver ended.

    Attributes:
        best: the best point.
        trials: every point that was tried, in order.
        converged: whether it ended because nothing was left to gain.
        reason: why it ended.
    """

    best: Point
    trials: list[Trial]
    converged: bool
    reason: str


class FitError(RuntimeError):
    """The first guess cannot be used: its simulation fails, or a parameter has no influence."""


def evaluate(problem: AbstractProblem, u: np.ndarray) -> Point:
    """Simulate with tangents; what can go wrong is named, not raised."""
    result, rows = linearised(problem, jnp.asarray(u, jnp.zeros(()).dtype))
    residual = np.asarray(result.residual, np.float64)
    rows = np.asarray(rows, np.float64)
    prior = np.asarray(result.prior, np.float64)
    cost = float(residual @ residual + prior @ prior) / 2
    failure = None
    if not bool(result.status.ok):
        failure = " ".join(result.status.messages(ERRORS))
    elif not np.isfinite(cost):
        failure = "the residual is not finite"
    elif not np.isfinite(rows).all():
        failure = "the derivative is not finite"
    prior_rows = problem.space.prior_rows()
    return Point(np.array(u), cost, residual, rows, prior, prior_rows, failure, result.status)


def without_influence(problem: AbstractProblem, point: Point) -> list[str]:
    """Names of the coordinates on which the residual does not depend, but for rounding."""
    # Of a change by one, or by itself where it is larger: units do not count.
    sizes = np.linalg.norm(point.rows, axis=1) * np.maximum(1, np.abs(point.u))
    rounding = 100 * float(jnp.finfo(jnp.zeros(()).dtype).eps)
    silent = (sizes <= rounding * sizes.max()) & ~np.any(point.prior_rows != 0, axis=1)
    return [name for name, is_silent in zip(problem.names, silent, strict=True) if is_silent]


def levenberg_marquardt(
    problem: AbstractProblem,
    start: np.ndarray,
    *,
    trials: int,
    tolerance: float,
    longest: float = np.log(10.0),
    report: Callable[[Trial], None] | None = None,
) -> Descent:
    """Least squares from one start.

    A trial that fails (a particle lost, NaN, a motion too fast or too much compressed for the time
    step, a parameter that loses all influence because nothing yields any more) is rejected and the
    trust region shrinks; the time step is never changed. Steps that would leave the bounds end on
    them.

    Args:
        problem: what to solve.
        start: free coordinates.
        trials: how many points are tried at most, the start included.
        tolerance: it ends when a step is shorter than this, in free coordinates (relative for what
            is not a logarithm and larger than 1), or promises less than this part of the cost.
        longest: a logarithm changes by at most this in one step.
        report: called after each trial.

    Raises:
        FitError: the start cannot be used.

    Reference: K. Madsen, H. B. Nielsen, O. Tingleff, "Methods for non-linear least squares
    problems", 2004, algorithm 3.16; scaling as in J. Moré, "The Levenberg–Marquardt algorithm",
    1978.
    """
    began = time.perf_counter()
    history: list[Trial] = []

    def remember(point: Point, taken: bool, note: str = "") -> None:
        cost = np.inf if point.failure else point.cost
        seconds = time.perf_counter() - began
        names = tuple(problem.names)
        history.append(Trial(names, problem.last, point.u, cost, taken, note, seconds))
        if report is not None:
            report(history[-1])

    current = evaluate(problem, start)
    silent = without_influence(problem, current)
    if current.failure is not None:
        raise FitError(f"The simulation at {_told(problem, start)} fails: {current.failure}")
    if silent:
        raise FitError(
            f"{', '.join(silent)} has no influence on what is observed of {problem.last} frames "
            f"at {_told(problem, start)} (nothing yields, touches, or moves there). Choose another "
            "start, or observe more frames."
        )
    remember(current, True)
    lower, upper = problem.space.bounds()
    scale = np.zeros_like(start)
    damping, growth = 1e-3, 4.0
    while len(history) < trials:
        scale = np.maximum(scale, np.diag(current.curvature))
        # Whether it has arrived is asked of the undamped step: damping makes any step short.
        undamped = _bounded_step(current, 0.0, scale, lower, upper)
        if _size(undamped, current.u) <= tolerance:
            return Descent(current, history, True, "the step became shorter than the tolerance")
        if _promised(current, undamped) <= tolerance**2 * current.cost:
            return Descent(current, history, True, "nothing is left to gain")
        step = _bounded_step(current, damping, scale, lower, upper)
        step = _shortened(step, problem.space.logarithmic, longest)
        if _size(step, current.u) <= 1e-3 * tolerance:
            return Descent(current, history, False, "no step lowers the cost any more")
        trial = evaluate(problem, current.u + step)
        lost = without_influence(problem, trial) if trial.failure is None else []
        note = trial.failure or _unstable(current, trial)
        if lost:
            note = f"{', '.join(lost)} would lose all influence"
        gained = 0.0 if note else current.cost - trial.cost
        promised = _promised(current, step)
        ratio = gained / promised if promised > 0 else 0.0
        taken = not note and bool(ratio > 1e-4)
        remember(trial, taken, note or ("" if taken else "the cost would not fall"))
        if not taken and not note and _promised(current, undamped) <= _WORTHLESS:
            return Descent(current, history, True, "what is left to gain is below the noise")
        if taken:
            current = trial
            damping *= max(1 / 3, 1 - (2 * ratio - 1) ** 3)
            growth = 4.0
        else:
            damping *= growth
            growth *= 4
    return Descent(current, history, False, f"{trials} points were tried")


def _unstable(current: Point, trial: Point) -> str:
    """Whether the time step, which was small enough so far, is not for a trial."""
    above = (Condition.DT_ABOVE_BOUND,)
    if current.status.messages(above):
        return ""
    return " ".join(trial.status.messages(above))


def _size(step: np.ndarray, u: np.ndarray) -> float:
    """Longest change of a coordinate; relative where it is larger than 1."""
    return float(np.max(np.abs(step) / np.maximum(1, np.abs(u))))


def _promised(point: Point, step: np.ndarray) -> float:
    """How much the linear model says the cost falls."""
    return float(-(point.slope @ step) - 0.5 * step @ point.curvature @ step)


def _bounded_step(
    point: Point, damping: float, scale: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """The damped Gauss–Newton step: the minimum of the damped model within the bounds."""
    matrix = point.curvature + damping * np.diag(scale)
    root = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(matrix / np.outer(root, root))
    kept = values > 1e-14 * values.max()
    sizes, vectors = np.sqrt(values[kept]), vectors[:, kept]
    low, high = np.minimum(lower - point.u, 0) * root, np.maximum(upper - point.u, 0) * root
    target = -(vectors.T @ (point.slope / root)) / sizes
    found = lsq_linear(sizes[:, None] * vectors.T, target, (low, high), method="bvls")
    return np.clip(point.u + found.x / root, lower, upper) - point.u


def _shortened(step: np.ndarray, logarithmic: np.ndarray, longest: float) -> np.ndarray:
    """The step, or as much of it as changes no logarithm by more than `longest`."""
    largest = np.max(np.abs(step[logarithmic]), initial=0.0)
    return step if largest <= longest else step * (longest / largest)


def _told(problem: AbstractProblem, u: np.ndarray) -> str:
    """Values of the free parameters in words, as far as there are few."""
    values = problem.space.known(u)
    return ", ".join(
        f"{name} = {np.array2string(values[name], precision=5)}"
        for name, parameter in problem.space.free.items()
        if parameter.start.size <= 6
    )
