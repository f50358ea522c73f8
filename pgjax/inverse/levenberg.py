"""Levenberg–Marquardt on the residual vector, within bounds, in double precision on the host."""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from pgjax.inverse.problem import Problem, linearised
from pgjax.result import ERRORS, Status


class Point(NamedTuple):
    """The residual and its derivative at one point.

    Attributes:
        u: free coordinates, `(p,)`.
        cost: half the squared sum of the residual.
        residual: `(m,)`.
        rows: `∂r/∂u_j`, `(p, m)`.
        failure: why the point cannot be used; None if it can.
        status: of the simulation.
    """

    u: np.ndarray
    cost: float
    residual: np.ndarray
    rows: np.ndarray
    failure: str | None
    status: Status

    @property
    def slope(self) -> np.ndarray:
        """Gradient of the cost, `(p,)`."""
        return self.rows @ self.residual

    @property
    def curvature(self) -> np.ndarray:
        """`JᵀJ`, `(p, p)`."""
        return self.rows @ self.rows.T


class Trial(NamedTuple):
    """One line of the history.

    Attributes:
        u: where.
        cost: half the squared sum of the residual there; infinite where it failed.
        taken: whether it became the current point.
        note: why not, or nothing.
        seconds: since the start.
    """

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


def evaluate(problem: Problem, u: np.ndarray) -> Point:
    """Simulate with tangents; what can go wrong is named, not raised."""
    result, rows = linearised(problem, jnp.asarray(u, jnp.zeros(()).dtype))
    residual = np.asarray(result.residual, np.float64)
    rows = np.asarray(rows, np.float64)
    cost = float(residual @ residual) / 2
    failure = None
    if not bool(result.status.ok):
        failure = " ".join(result.status.messages(ERRORS))
    elif not np.isfinite(cost):
        failure = "the residual is not finite"
    elif not np.isfinite(rows).all():
        failure = "the derivative is not finite"
    return Point(np.array(u), cost, residual, rows, failure, result.status)


def without_influence(problem: Problem, point: Point) -> list[str]:
    """Names of the coordinates on which the residual does not depend, but for rounding."""
    sizes = np.linalg.norm(point.rows, axis=1)
    rounding = 100 * float(jnp.finfo(jnp.zeros(()).dtype).eps)
    silent = sizes <= rounding * sizes.max()
    return [name for name, is_silent in zip(problem.names, silent, strict=True) if is_silent]


def levenberg_marquardt(
    problem: Problem,
    start: np.ndarray,
    *,
    trials: int,
    tolerance: float,
    longest: float = np.log(10.0),
    report: Callable[[Trial], None] | None = None,
) -> Descent:
    """Least squares from one start.

    A trial that fails (a particle lost, NaN, a parameter that loses all influence because nothing
    yields any more) is rejected and the trust region shrinks; the time step is never changed. Steps
    that would leave the bounds end on them.

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
        history.append(Trial(point.u, cost, taken, note, time.perf_counter() - began))
        if report is not None:
            report(history[-1])

    current = evaluate(problem, start)
    silent = without_influence(problem, current)
    if current.failure is not None:
        raise FitError(f"The simulation of the first guess fails: {current.failure}")
    if silent:
        raise FitError(
            f"The first guess cannot be improved: {', '.join(silent)} has no influence on what is "
            "observed (nothing yields, touches, or moves there). Choose another start, or observe "
            "more frames."
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
        note = trial.failure or ""
        if lost:
            note = f"{', '.join(lost)} would lose all influence"
        gained = current.cost - trial.cost if not note else -np.inf
        ratio = gained / _promised(current, step)
        taken = bool(ratio > 1e-4)
        remember(trial, taken, note or ("" if taken else "the cost would not fall"))
        if taken:
            current = trial
            damping *= max(1 / 3, 1 - (2 * float(ratio) - 1) ** 3)
            growth = 4.0
        else:
            damping *= growth
            growth *= 4
    return Descent(current, history, False, f"{trials} points were tried")


def _size(step: np.ndarray, u: np.ndarray) -> float:
    """Longest change of a coordinate; relative where it is larger than 1."""
    return float(np.max(np.abs(step) / np.maximum(1, np.abs(u))))


def _promised(point: Point, step: np.ndarray) -> float:
    """How much the linear model says the cost falls."""
    return float(-(point.slope @ step) - 0.5 * step @ point.curvature @ step)


def _bounded_step(
    point: Point, damping: float, scale: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """The damped Gauss–Newton step of the coordinates that are not pushed against their bound."""
    held = np.zeros(len(point.u), bool)
    step = np.zeros_like(point.u)
    for _ in range(len(held) + 1):
        free = ~held
        step = np.zeros_like(point.u)
        if not free.any():
            return step
        matrix = point.curvature + damping * np.diag(scale)
        step[free] = _solve(matrix[np.ix_(free, free)], -point.slope[free])
        beyond = free & ((point.u + step < lower) | (point.u + step > upper))
        if not beyond.any():
            return step
        towards = np.where(point.u + step < lower, lower, upper)
        at_bound = np.abs(towards - point.u) <= 1e-12 * np.maximum(1, np.abs(towards))
        blocked = beyond & at_bound
        if not blocked.any():
            return np.clip(point.u + step, lower, upper) - point.u
        held |= blocked
    return step


def _solve(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Of a positive semi-definite system, scaled to a unit diagonal first."""
    root = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    scaled = matrix / np.outer(root, root)
    return np.linalg.lstsq(scaled, right / root, rcond=1e-14)[0] / root


def _shortened(step: np.ndarray, logarithmic: np.ndarray, longest: float) -> np.ndarray:
    """The step, or as much of it as changes no logarithm by more than `longest`."""
    largest = np.max(np.abs(step[logarithmic]), initial=0.0)
    return step if largest <= longest else step * (longest / largest)
