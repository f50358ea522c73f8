"""How sure an estimate is: covariance, intervals, and whether the derivative may be trusted.

Everything is of the free coordinates u (`parameters.Space`); intervals are given in physical units.
"""

import dataclasses
from typing import NamedTuple, final

import jax.numpy as jnp
import numpy as np
from scipy import stats

from pgjax.inverse.levenberg import Point
from pgjax.inverse.problem import AbstractProblem, outcome

# A derivative that is off the secant over its own interval by more than this part is not trusted.
LARGEST_MISMATCH = 0.2
# A logarithm whose 95 % interval is wider than a factor of ten says nothing useful.
WIDEST_LOGARITHM = np.log(10.0)
# What is known from frame to frame to vary by more than this times what independent noise says is
# taken from there.
LARGEST_CLUSTERING = 2.5
# Degrees of freedom without which a scatter says nothing.
_LEAST_SCATTER = 5
# Data without any noise must not divide by zero.
_LEAST_NOISE = 1e-100
# Secants over less than this are rounding (single, double precision).
_SHORTEST = {np.dtype(np.float32): 1e-3, np.dtype(np.float64): 1e-6}


class Interval(NamedTuple):
    """Where a parameter is, with the probability it was asked for.

    Attributes:
        low, high: bounds in physical units; infinite or 0 where nothing bounds it.
        mismatch: difference of derivative and secant over the 95 % interval, as a part of the
            secant.
        verdict: "ok", "widened" (by the secant) or "not identifiable".
        why: what is behind the verdict.
    """

    low: float
    high: float
    mismatch: float
    verdict: str
    why: str


class Direction(NamedTuple):
    """A combination of parameters that is known independently of the others.

    Attributes:
        weights: of the free coordinates, a unit vector, `(p,)`.
        deviation: standard deviation along it.
    """

    weights: np.ndarray
    deviation: float


@final
@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Covariance of an estimate, from `JᵀJ` and the noise.

    Attributes:
        names: of the coordinates.
        u: the estimate.
        logarithmic: which coordinates are logarithms.
        covariance: `(JᵀJ/s² + P)⁻¹` with the information P of the priors, `(p, p)`.
        noise: s, the standard deviation of the residuals: 1 if the noise that was given for the
            data is right and the model has no error.
        degrees: of freedom, of Student's distribution; infinite where the noise is taken as given.
        clustering: per coordinate, the half width of a 95 % interval from the scatter between
            frames over that from independent noise; NaN where there are too few frames.
        mismatches: per coordinate, derivative against secant over the 95 % interval; NaN where the
            secant could not be computed.
        widening: factor of each deviation that clustering and secant ask for, at least 1; infinite
            where the interval is refused.
        reasons: why a coordinate is not identifiable; empty where it is.
    """

    names: tuple[str, ...]
    u: np.ndarray
    logarithmic: np.ndarray
    covariance: np.ndarray
    noise: float
    degrees: float
    clustering: np.ndarray
    mismatches: np.ndarray
    widening: np.ndarray
    reasons: tuple[str, ...]

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the coordinates, widened where it is asked for, `(p,)`."""
        return np.sqrt(np.diag(self.covariance)) * self.widening

    @property
    def correlation(self) -> np.ndarray:
        """Correlations of the coordinates, `(p, p)`."""
        deviations = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(deviations, deviations)

    def interval(self, name: str, level: float = 0.95) -> Interval:
        """The interval of a coordinate (`E`, `v0[2]`) at a level of confidence.

        Raises:
            ValueError: there is no such coordinate, or the level is not between 0 and 1.
        """
        if name not in self.names:
            raise ValueError(
                f"Argument `name` must be one of {', '.join(self.names)}, but is {name!r}."
            )
        if not 0 < level < 1:
            raise ValueError(f"Argument `level` must be between 0 and 1, but is {level}.")
        j = self.names.index(name)
        half = self.quantile(level) * self.deviations[j]
        low, high = self.u[j] - half, self.u[j] + half
        if self.reasons[j] and not np.isfinite(self.widening[j]):
            low, high = -np.inf, np.inf
        if self.logarithmic[j]:
            with np.errstate(over="ignore"):
                low, high = np.exp(low), np.exp(high)
        verdict, why = "ok", ""
        if self.reasons[j]:
            verdict, why = "not identifiable", self.reasons[j]
        elif self.widening[j] > 1:
            verdict, why = "widened", self._widened(j)
        return Interval(float(low), float(high), float(self.mismatches[j]), verdict, why)

    def _widened(self, j: int) -> str:
        """What asks for a wider interval."""
        whys = []
        if self.clustering[j] > LARGEST_CLUSTERING:
            whys.append(
                f"differences within a frame are alike: between frames it varies "
                f"{self.clustering[j]:.3g} times as much as by independent noise"
            )
        if self.mismatches[j] > LARGEST_MISMATCH:
            whys.append(
                f"derivative and secant differ by {self.mismatches[j]:.0%} over the interval"
            )
        return "; ".join(whys)

    def quantile(self, level: float) -> float:
        """Half the width of an interval in standard deviations."""
        return float(stats.t.ppf(0.5 + level / 2, self.degrees))

    def directions(self) -> list[Direction]:
        """Independent combinations of the coordinates, the best known first."""
        values, vectors = np.linalg.eigh(self.covariance)
        return [
            Direction(vectors[:, k], float(np.sqrt(max(values[k], 0)))) for k in range(len(values))
        ]


def uncertainty(
    problem: AbstractProblem,
    point: Point,
    *,
    noise_known: bool = False,
    kept: Uncertainty | None = None,
) -> Uncertainty:
    """The uncertainty of an estimate; two more simulations per coordinate check the derivative.

    Errors of a model are no independent noise: differences within a frame are alike. Where
    estimates scatter between frames by more than 2.5 times what independent noise says, the
    interval is the one of that scatter (the sandwich covariance with one cluster per frame). Along
    the direction in which a coordinate reaches the end of its 95 % interval, the derivative is then
    compared with the secant over that interval. Where they differ by more than 20 % the interval is
    widened by what the secant asks for.

    Args:
        problem: what was solved.
        point: where.
        noise_known: take the noise of the data as given (s = 1) instead of estimating it from the
            residual. Clustering then is not looked for.
        kept: of coordinates that were found before and then kept. What is not known of them is
            passed on to the others.

    Reference: K.-Y. Liang, S. Zeger, "Longitudinal data analysis using generalized linear models",
    1986 (clusters); K. Murphy, R. Topel, "Estimation and inference in two-step econometric models",
    1985 (what is kept).
    """
    noise, degrees = noise_of(problem, point, known=noise_known)
    p, names = len(point.u), problem.names
    # What was known before is not scaled by what the data say of their noise.
    information = point.rows @ point.rows.T / noise**2 + point.prior_rows @ point.prior_rows.T
    places = [] if kept is None else [names.index(name) for name in kept.names]
    free = [j for j in range(p) if j not in places]
    covariance = _covariance(information, free, places, kept)
    quantile = float(stats.t.ppf(0.975, degrees))
    clustering = np.full(p, np.nan)
    if not noise_known:
        frames = problem.moments()
        clustering[free] = _clustering(point, information, free, noise, quantile, frames)
    wider = np.where(clustering > LARGEST_CLUSTERING, clustering, 1.0)
    half = quantile * np.sqrt(np.diag(covariance)) * wider
    mismatches, widening, reasons = np.full(p, np.nan), np.ones(p), [""] * p
    for j in free:
        check = _against_secant(problem, point, covariance[:, j], half[j], noise, j)
        mismatches[j], widening[j], reasons[j] = check
        reasons[j] = reasons[j] or _too_wide(problem, point.u, half * widening, j)
    widening *= wider
    for j, place in enumerate(places):
        assert kept is not None
        clustering[place], mismatches[place] = kept.clustering[j], kept.mismatches[j]
        widening[place], reasons[place] = kept.widening[j], kept.reasons[j]
    return Uncertainty(
        names=tuple(names),
        u=point.u,
        logarithmic=problem.space.logarithmic,
        covariance=covariance,
        noise=noise,
        degrees=degrees,
        clustering=clustering,
        mismatches=mismatches,
        widening=widening,
        reasons=tuple(reasons),
    )


def noise_of(problem: AbstractProblem, point: Point, *, known: bool) -> tuple[float, float]:
    """Standard deviation of the residual at an estimate, and its degrees of freedom.

    Data that no parameter changes (background, what is missing) say nothing about it. With a robust
    loss it is the median absolute deviation, which outliers do not move. Where there are no more
    data than parameters, the noise that was given is taken as it is.
    """
    counts = np.any(point.rows != 0, axis=0)
    degrees = int(np.count_nonzero(counts)) - len(point.u)
    if known or degrees < 1:
        return 1.0, float("inf")
    residual = point.residual[counts]
    if any(o.robust is not None for o in problem.watched):
        spread = float(np.median(np.abs(residual)) / stats.norm.ppf(0.75))
        return max(spread, _LEAST_NOISE), float(degrees)
    return max(float(np.sqrt(residual @ residual / degrees)), _LEAST_NOISE), float(degrees)


def covariance_of(curvature: np.ndarray) -> np.ndarray:
    """The inverse of a positive semi-definite matrix; without curvature the variance is huge."""
    root = np.sqrt(np.maximum(np.diag(curvature), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(curvature / np.outer(root, root))
    values = np.maximum(values, 1e-15 * max(values.max(), 1e-300))
    return (vectors / values) @ vectors.T / np.outer(root, root)


def _covariance(
    information: np.ndarray, free: list[int], places: list[int], kept: Uncertainty | None
) -> np.ndarray:
    """Of all coordinates; an error of what was kept moves the others as their minimum moves."""
    own = covariance_of(information[np.ix_(free, free)])
    if kept is None:
        return own
    covariance = np.zeros_like(information)
    known = np.where(np.isfinite(kept.widening), kept.widening, 1.0)
    inner = kept.covariance * np.outer(known, known)
    passed = -own @ information[np.ix_(free, places)]
    covariance[np.ix_(free, free)] = own + passed @ inner @ passed.T
    covariance[np.ix_(free, places)] = passed @ inner
    covariance[np.ix_(places, free)] = inner @ passed.T
    covariance[np.ix_(places, places)] = kept.covariance
    return covariance


def _clustering(
    point: Point,
    information: np.ndarray,
    free: list[int],
    noise: float,
    quantile: float,
    frames: np.ndarray,
) -> np.ndarray:
    """Half widths of intervals by the scatter between frames over those by independent noise."""
    weighted = point.rows[free] * point.residual / noise**2
    numbers = np.unique(frames[np.any(weighted != 0, axis=0)])
    count = len(numbers)
    degrees = count - 1 - len(free)
    if degrees < _LEAST_SCATTER:
        return np.full(len(free), np.nan)
    slopes = np.stack([weighted[:, frames == number].sum(axis=1) for number in numbers])
    slopes -= slopes.mean(axis=0)
    own = covariance_of(information[np.ix_(free, free)])
    robust = own @ (slopes.T @ slopes * count / degrees) @ own
    factor = float(stats.t.ppf(0.975, degrees)) / quantile
    return factor * np.sqrt(np.diag(robust) / np.diag(own))


class _Check(NamedTuple):
    mismatch: float
    widening: float
    reason: str


def _against_secant(
    problem: AbstractProblem,
    point: Point,
    covariances: np.ndarray,
    half: float,
    noise: float,
    j: int,
) -> _Check:
    """Derivative and secant between the two ends of the interval of coordinate j.

    `covariances` are those with j; `half` is half the width of its interval.
    """
    dtype = np.dtype(jnp.zeros(()).dtype)
    shortest = _SHORTEST[dtype] * max(1.0, abs(point.u[j]) * (not problem.space.logarithmic[j]))
    # An interval below what is resolved is checked over what is.
    length = max(half, shortest)
    if problem.space.logarithmic[j] and length > WIDEST_LOGARITHM:
        return _Check(np.nan, np.inf, "its 95 % interval spans more than a factor of 100")
    direction = covariances / covariances[j] * length
    # Not so far that another logarithm, which the data may leave open, leaves the model.
    largest = np.max(np.abs(direction[problem.space.logarithmic]), initial=0)
    direction = direction * min(1.0, WIDEST_LOGARITHM / max(largest, 1e-300))
    lower, upper = problem.space.bounds()
    ends = []
    for sign in (-1, 1):
        u = np.clip(point.u + sign * direction, lower, upper)
        result = outcome(problem, jnp.asarray(u, dtype))
        if not bool(result.ok):
            return _Check(np.nan, np.inf, "the simulation fails inside of its interval")
        ends.append((u, np.asarray(result.residual, np.float64)))
    (low, r_low), (high, r_high) = ends
    # Priors are linear, and count as they do in the covariance.
    prior = (high - low) @ point.prior_rows
    secant = np.append((r_high - r_low) / noise, prior)
    derivative = np.append((high - low) @ point.rows / noise, prior)
    size = float(np.linalg.norm(secant))
    if size == 0:
        return _Check(np.inf, np.inf, "the observation does not change over its interval")
    mismatch = float(np.linalg.norm(secant - derivative)) / size
    if mismatch <= LARGEST_MISMATCH:
        return _Check(mismatch, 1.0, "")
    # How far the secant says one has to go for the change that the derivative promises.
    along = float(secant @ derivative) / max(float(derivative @ derivative), 1e-300)
    if along <= 0.1:
        return _Check(mismatch, np.inf, "derivative and secant disagree over its interval")
    return _Check(mismatch, max(1.0, 1 / along, np.sqrt(1 + mismatch**2)), "")


def _too_wide(problem: AbstractProblem, u: np.ndarray, half: np.ndarray, j: int) -> str:
    """Why an interval says nothing; empty if it says something."""
    lower, upper = problem.space.bounds()
    if problem.space.logarithmic[j] and 2 * half[j] > WIDEST_LOGARITHM:
        return "its 95 % interval spans more than a factor of ten"
    if np.isfinite(upper[j] - lower[j]) and half[j] > 0.5 * (upper[j] - lower[j]):
        return "its 95 % interval is as wide as its bounds"
    if abs(u[j] - lower[j]) < 1e-9 or abs(u[j] - upper[j]) < 1e-9:
        return f"it ended on its {'lower' if abs(u[j] - lower[j]) < 1e-9 else 'upper'} bound"
    return ""
