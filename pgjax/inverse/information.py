"""What the data say beyond the estimate: profiles, and what another observation would add."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from pgjax.inverse.fitting import Fit, fit
from pgjax.inverse.levenberg import FitError, evaluate
from pgjax.inverse.problem import AbstractProblem
from pgjax.inverse.uncertainty import covariance_of, noise_of


class Profile(NamedTuple):
    """The best cost at fixed values of one parameter.

    Attributes:
        name: of the parameter.
        values: in physical units, `(n,)`.
        costs: the smallest cost with the others fitted, `(n,)`; infinite where a fit failed.
        threshold: cost that the level of confidence allows.
        level: of confidence.
    """

    name: str
    values: np.ndarray
    costs: np.ndarray
    threshold: float
    level: float

    @property
    def inside(self) -> np.ndarray:
        """Which values the data do not exclude."""
        return self.costs <= self.threshold


def profile(
    found: Fit,
    name: str,
    values: Sequence[float],
    *,
    level: float = 0.95,
    noise_known: bool = False,
    trials: int = 10,
) -> Profile:
    """Profile likelihood of a parameter of one number: the others are fitted at each value.

    An interval from `JᵀJ` is right where the model is linear over it; this one needs no such thing.
    Costs are those of the fit's own noise: a prior counts against the data as it does in `fit`.

    Args:
        found: the fit.
        name: of a free parameter.
        values: to fix it at, in physical units and within its bounds.
        level: of the confidence interval the threshold stands for.
        noise_known: as for `fit`.
        trials: of each of the fits.
    """
    problem = found.problem
    parameter = problem.space.free.get(name)
    if parameter is None or parameter.shape:
        single = [n for n, p in problem.space.free.items() if not p.shape]
        raise ValueError(
            f"Argument `name` must be a free parameter of one number ({', '.join(single)}), but is "
            f"{name!r}."
        )
    rest = [n for n in problem.space.free if n != name]
    costs, now = [], dict(found.values)
    for value in values:
        fixed = {**now, name: np.asarray(value, np.float64)}
        try:
            if rest:
                part = problem.freeing(rest, fixed)
                end = fit(part, trials=trials, intervals=False)
                now |= {n: end.values[n] for n in rest}
                costs.append(end.point.cost)
            else:
                point = evaluate(problem, problem.space.vector({name: fixed[name]}))
                costs.append(np.inf if point.failure else point.cost)
        except FitError:
            costs.append(np.inf)
    noise, degrees = noise_of(problem, found.point, known=noise_known)
    rise = noise**2 * stats.t.ppf(0.5 + level / 2, degrees) ** 2 / 2
    return Profile(
        name, np.asarray(values, float), np.asarray(costs), found.point.cost + float(rise), level
    )


def information(problem: AbstractProblem, values: Mapping[str, Any]) -> np.ndarray:
    """Fisher information `JᵀJ` of the data alone about the free coordinates, `(p, p)`.

    Raises:
        FitError: the simulation fails there.
    """
    point = evaluate(problem, problem.space.vector({n: values[n] for n in problem.space.free}))
    if point.failure is not None:
        raise FitError(f"The simulation at these values fails: {point.failure}")
    return point.rows @ point.rows.T


def would_help(found: Fit, candidates: Mapping[str, AbstractProblem]) -> dict[str, np.ndarray]:
    """Standard deviations to expect if one of these were observed as well.

    Args:
        found: the fit.
        candidates: problems of the same parameters, observed from another camera or in another
            motion. Of their data only which are there counts (NaN and, for depth, 0 are not), and
            robust losses and matching: give none of these.

    Returns:
        Per candidate the deviations of the free coordinates (relative, of a logarithm), `(p,)`;
        under "now" those of the fit alone. All for the noise the data were given.
    """
    values = {n: found.values[n] for n in found.problem.space.free}
    known = found.point.curvature
    result = {"now": np.sqrt(np.diag(covariance_of(known)))}
    for name, candidate in candidates.items():
        if candidate.names != found.problem.names:
            raise ValueError(
                f"Argument `candidates` must have the parameters {found.problem.names}, but "
                f"{name!r} has {candidate.names}."
            )
        added = known + information(candidate, values)
        result[name] = np.sqrt(np.diag(covariance_of(added)))
    return result
