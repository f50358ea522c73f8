"""Fitting: stages, several starts, the estimate and everything that was tried on the way."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, final

import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from pgjax.inverse.growth import magnified
from pgjax.inverse.levenberg import (
    Descent,
    FitError,
    Point,
    Trial,
    evaluate,
    levenberg_marquardt,
)
from pgjax.inverse.parameters import Space
from pgjax.inverse.problem import AbstractProblem, costs
from pgjax.inverse.uncertainty import Uncertainty, uncertainty

# Starts that are simulated at once, and how many of them are followed to their end.
_AT_ONCE, _FOLLOWED = 8, 3
# A stage only has to come near: what follows starts there.
_STAGE_TOLERANCE = 1e-3


class Stage(NamedTuple):
    """Part of a fit: some parameters, from what was recorded up to a frame.

    Attributes:
        frames: last frame; all if None. A short horizon first keeps a fit out of local minima.
        free: names of the parameters; all that are free in the problem if None. Initial
            velocities, say, from the frames before a contact.
        coarser: pictures are seen through squares of so many pixels. While a body is off by more
            than what is drawn on it, single pixels lead nowhere.
        keep: what is found is kept by what follows: what frames before a contact say of a velocity
            must not be bent by errors of the model of the contact. Its uncertainty is passed on.
    """

    frames: int | None = None
    free: tuple[str, ...] | None = None
    coarser: int = 1
    keep: bool = False


@final
@dataclasses.dataclass(frozen=True)
class Fit:
    """The result of `fit`.

    Attributes:
        problem: what was solved.
        values: the estimate by name, in physical units; fixed parameters too.
        point: the estimate in free coordinates, with its residual and derivative.
        start: the first guess, in free coordinates.
        trials: every point that was tried, in order, over all stages and starts.
        others: ends of the other starts that were followed, the best first.
        converged: whether the last stage ended because nothing was left to gain.
        reason: why it ended.
        uncertainty: covariance and intervals; None if it was not asked for.
        messages: what a reader has to know: bounds that were met, what is not identifiable, a
            motion that magnifies changes by more than 1e6.
        simulations: number of forward runs, a tangent counted as one.
        seconds: wall time, compiling included.
    """

    problem: AbstractProblem
    values: dict[str, np.ndarray]
    point: Point
    start: np.ndarray
    trials: list[Trial]
    others: list[Point]
    converged: bool
    reason: str
    uncertainty: Uncertainty | None
    messages: list[str]
    simulations: int
    seconds: float

    @property
    def iterations(self) -> int:
        """Points that were tried, those of stages and other starts included."""
        return len(self.trials)

    def summary(self) -> str:
        """Estimates with intervals, as a table of text."""
        lines = [f"{'parameter':14} {'estimate':>12}  {'95 % interval':28} verdict"]
        for name, value, unit in self.rows():
            text = f"{name:14} {value:12.6g}"
            if self.uncertainty is not None:
                interval = self.uncertainty.interval(name)
                span = f"[{interval.low:.6g}, {interval.high:.6g}] {unit}"
                text += f"  {span:28} {interval.verdict}"
                if interval.why:
                    text += f": {interval.why}"
            lines.append(text)
        return "\n".join([*lines, *self.messages])

    def rows(self) -> list[tuple[str, float, str]]:
        """Name, estimate and unit of each free coordinate."""
        rows = []
        place = 0
        names = self.problem.names
        for name, parameter in self.problem.space.free.items():
            for value in np.ravel(self.values[name]):
                rows.append((names[place], float(value), parameter.unit))
                place += 1
        return rows


def fit(
    problem: AbstractProblem,
    *,
    stages: Sequence[Stage] = (),
    starts: int = 1,
    trials: int = 30,
    tolerance: float | None = None,
    intervals: bool = True,
    noise_known: bool = False,
    seed: int = 0,
    report: Callable[[str], None] | None = None,
) -> Fit:
    """Find the parameters by Levenberg–Marquardt with exact derivatives in forward mode.

    Args:
        problem: what to solve.
        stages: done in this order before the whole problem; each starts where the last one ended.
        starts: with more than one, that many points of a low-discrepancy sequence within the bounds
            (a power of two is best) are simulated at once, and the best three of them and the first
            guess are followed. Every free parameter then needs both bounds.
        trials: how many points each descent tries at most.
        tolerance: of the free coordinates, at which a descent ends; 1e-6 in double precision and
            1e-4 in single by default.
        intervals: compute the uncertainty, two more simulations per coordinate.
        noise_known: take the noise given for the data as it is instead of estimating it.
        seed: of the starts.
        report: called with a line of text after each trial.

    Raises:
        FitError: no start can be used; the message says why.
        ValueError: an argument is out of range.
    """
    began = time.perf_counter()
    if tolerance is None:
        tolerance = 1e-6 if jnp.zeros(()).dtype == jnp.float64 else 1e-4
    if starts < 1 or trials < 1 or not tolerance > 0:
        raise ValueError(
            "Arguments `starts` and `trials` must be at least 1 and `tolerance` positive, but are "
            f"{starts}, {trials}, {tolerance}."
        )
    _check_kept(problem, stages)
    run = _Run(problem, trials, tolerance, report)
    guesses = [problem.space.start]
    if starts > 1:
        guesses = run.screened(starts, seed)
    ends: list[_End] = []
    failures: list[FitError] = []
    for guess in guesses:
        try:
            ends.append(run.follow(guess, stages))
        except FitError as error:
            failures.append(error)
    if not ends:
        raise failures[0]
    ends.sort(key=lambda end: end.last.descent.best.cost)
    best, *others = ends
    point = run.evaluate(problem, best.u) if best.kept else best.last.descent.best
    found = None
    if intervals:
        for part in best.known:
            values = problem.space.known(best.u)
            u = part.space.vector({n: values[n] for n in part.space.free})
            found = uncertainty(part, run.evaluate(part, u), noise_known=noise_known, kept=found)
        found = uncertainty(problem, point, noise_known=noise_known, kept=found)
        run.simulations += 2 * problem.space.size
    messages = _messages(best, others, failures)
    if found is not None and np.isinf(found.degrees) and not noise_known:
        messages.append("There are no more data than unknowns: the noise given for them is taken.")
    return Fit(
        problem=problem,
        values=problem.space.known(best.u),
        point=point,
        start=problem.space.start,
        trials=run.trials,
        others=[end.last.descent.best for end in others],
        converged=best.last.descent.converged,
        reason=best.last.descent.reason,
        uncertainty=found,
        messages=messages,
        simulations=run.simulations,
        seconds=time.perf_counter() - began,
    )


class _Part(NamedTuple):
    """A descent.

    Attributes:
        problem: in what was free in it.
        descent: how it ended.
    """

    problem: AbstractProblem
    descent: Descent


class _End(NamedTuple):
    """Where one start led.

    Attributes:
        u: all free coordinates.
        last: the descent in the whole problem.
        kept: the stages whose parameters were kept.
        known: their problems, with all that was kept by then free.
    """

    u: np.ndarray
    last: _Part
    kept: list[_Part]
    known: list[AbstractProblem]


def _check_kept(problem: AbstractProblem, stages: Sequence[Stage]) -> None:
    """What is kept is not freed again, and something is left for the whole problem."""
    held: set[str] = set()
    for stage in stages:
        names = set(stage.free or problem.space.free)
        if stage.free is not None and names & held:
            raise ValueError(
                "Argument `stages` must not free again what an earlier one keeps, but frees "
                f"{', '.join(sorted(names & held))}."
            )
        held |= names if stage.keep else set()
    if held >= set(problem.space.free):
        raise ValueError(
            "Argument `stages` must leave a parameter for the whole problem, but keeps "
            f"{', '.join(sorted(held))}."
        )


class _Run:
    """Counts what is simulated, and keeps what was tried."""

    def __init__(
        self,
        problem: AbstractProblem,
        most: int,
        tolerance: float,
        report: Callable[[str], None] | None,
    ):
        self.problem, self.most, self.tolerance = problem, most, tolerance
        self.report = report
        self.trials: list[Trial] = []
        self.simulations = 0
        self._began = time.perf_counter()

    def screened(self, starts: int, seed: int) -> list[np.ndarray]:
        """The first guess and the best of several starts."""
        space = self.problem.space
        lower, upper = space.bounds()
        for name, low, high in zip(space.names, lower, upper, strict=True):
            if not np.isfinite(low) or not np.isfinite(high):
                raise ValueError(
                    f"Argument `starts` must be 1 unless every free parameter has both bounds, but "
                    f"{name!r} has none on one side."
                )
        spread = qmc.Sobol(space.size, rng=seed).random_base2(int(np.ceil(np.log2(starts))))
        points = lower + spread[:starts] * (upper - lower)
        points = np.concatenate([space.start[None], points])
        us = jnp.asarray(points, jnp.zeros(()).dtype)
        found, ok = costs(self.problem, us, min(_AT_ONCE, len(points)))
        self.simulations += len(points)
        usable = np.where(np.asarray(ok), np.asarray(found), np.inf)
        order = [0, *(1 + np.argsort(usable[1:])[:_FOLLOWED])]
        return [points[k] for k in order if np.isfinite(usable[k])] or [space.start]

    def follow(self, guess: np.ndarray, stages: Sequence[Stage]) -> _End:
        """Through the stages, then the whole problem."""
        space, u = self.problem.space, guess
        kept: list[_Part] = []
        known: list[AbstractProblem] = []
        held: list[str] = []
        for stage in stages:
            whole = self.problem if stage.frames is None else self.problem.until(stage.frames)
            if stage.coarser != 1:
                whole = whole.coarser(stage.coarser)
            names = [n for n in stage.free or space.free if n not in held]
            tolerance = self.tolerance if stage.keep else max(self.tolerance, _STAGE_TOLERANCE)
            u, part = self._solve(whole, names, u, tolerance)
            if stage.keep:
                held += names
                kept.append(part)
                known.append(whole.freeing(held, space.known(u)))
        names = [n for n in space.free if n not in held]
        u, last = self._solve(self.problem, names, u, self.tolerance)
        return _End(u, last, kept, known)

    def _solve(
        self, whole: AbstractProblem, names: Sequence[str], u: np.ndarray, tolerance: float
    ) -> tuple[np.ndarray, _Part]:
        """Descend in some of the parameters: all coordinates afterwards, and how it ended."""
        space, values = self.problem.space, self.problem.space.known(u)
        part = whole if len(names) == len(space.free) else whole.freeing(names, values)
        own = part.space.vector({n: values[n] for n in part.space.free})
        end = self._descend(part, own, tolerance)
        values = part.space.known(end.best.u)
        return space.vector({n: values[n] for n in space.free}), _Part(part, end)

    def evaluate(self, problem: AbstractProblem, u: np.ndarray) -> Point:
        """A point with all its derivatives."""
        self.simulations += 1 + problem.space.size
        return evaluate(problem, u)

    def _descend(self, problem: AbstractProblem, u: np.ndarray, tolerance: float) -> Descent:
        def told(trial: Trial) -> None:
            self.simulations += 1 + problem.space.size
            seconds = time.perf_counter() - self._began
            self.trials.append(trial._replace(seconds=seconds))
            if self.report is not None:
                self.report(_line(problem, trial, seconds))

        return levenberg_marquardt(problem, u, trials=self.most, tolerance=tolerance, report=told)


def _line(problem: AbstractProblem, trial: Trial, seconds: float) -> str:
    values = problem.space.known(trial.u)
    shown = ", ".join(
        f"{name} {np.array2string(values[name], precision=5)}"
        for name, parameter in problem.space.free.items()
        if parameter.start.size <= 6
    )
    note = "" if trial.taken else f" (rejected: {trial.note})"
    return f"{seconds:7.1f} s  cost {trial.cost:.6g}  {shown}{note}"


def _messages(best: _End, others: list[_End], failures: list[FitError]) -> list[str]:
    """What a reader of the estimate has to know."""
    messages = []
    last = best.last.descent
    if not last.converged:
        messages.append(f"The fit did not converge: {last.reason}.")
    for part in [*best.kept, best.last]:
        messages += _at_bounds(part.problem.space, part.descent.best)
    messages += last.best.status.messages()
    messages += magnified(best.last.problem, last.best)
    rivals = [end for end in others if end.last.descent.best.cost <= 1.05 * last.best.cost]
    far = [end for end in rivals if np.abs(end.u - best.u).max() > 0.05]
    if far:
        messages.append(f"{len(far)} other start(s) ended elsewhere with a cost as low.")
    messages += [f"A start could not be used: {error}" for error in failures]
    return messages


def _at_bounds(space: Space, point: Point) -> list[str]:
    """Which coordinates ended on a bound that the data would cross."""
    messages = []
    lower, upper = space.bounds()
    slopes, curvatures = point.slope, np.diag(point.curvature)
    rows = zip(space.names, point.u, lower, upper, slopes, curvatures, strict=True)
    for name, u, low, high, slope, curvature in rows:
        for bound, side, sign in ((low, "lower", -1), (high, "upper", 1)):
            pushes = -sign * slope > 1e-3 * np.sqrt(2 * point.cost * curvature)
            if abs(u - bound) <= 1e-9 * max(1.0, abs(bound)) and pushes:
                messages.append(
                    f"{name} ended on its {side} bound: the data ask for a value beyond it."
                )
    return messages
