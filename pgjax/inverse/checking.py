"""Whether the derivatives of a problem can be trusted."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from pgjax.inverse.levenberg import FitError, evaluate
from pgjax.inverse.problem import AbstractProblem, cost_and_slope, outcome


class GradientCheck(NamedTuple):
    """Derivatives of one problem against each other and against differences.

    Attributes:
        names: of the free coordinates.
        modes: largest relative difference of the cost's gradient in forward and reverse mode.
        steps: steps of the differences, in free coordinates, `(k,)`.
        errors: relative difference of derivative and central difference of the residual vector,
            `(p, k)`. Exact derivatives of a smooth motion fall with the square of the step until
            rounding takes over; a kink (yield, contact, a particle that changes its cell) keeps
            them from falling.
    """

    names: tuple[str, ...]
    modes: float
    steps: np.ndarray
    errors: np.ndarray

    @property
    def best(self) -> np.ndarray:
        """Smallest error of each coordinate, `(p,)`."""
        return self.errors.min(axis=1)

    def __str__(self) -> str:
        head = f"{'':14}" + "".join(f"{step:11.1e}" for step in self.steps)
        lines = [
            f"{name:14}" + "".join(f"{error:11.2e}" for error in row)
            for name, row in zip(self.names, self.errors, strict=True)
        ]
        modes = f"forward and reverse mode differ by {self.modes:.2e}"
        return "\n".join([head, *lines, modes])


def gradient_check(
    problem: AbstractProblem,
    values: dict[str, Any] | None = None,
    *,
    steps: tuple[float, ...] = (1e-2, 1e-3, 1e-4, 1e-5),
) -> GradientCheck:
    """Compare forward mode, reverse mode and central differences at one point.

    Args:
        problem: whose derivatives.
        values: where, in physical units; at the first guess if None.
        steps: of the differences, in free coordinates; relative where those are larger than 1.

    Raises:
        FitError: the simulation fails at that point.
    """
    space = problem.space
    u = space.start if values is None else space.vector({n: values[n] for n in space.free})
    dtype = jnp.zeros(()).dtype
    point = evaluate(problem, u)
    if point.failure is not None:
        raise FitError(f"The simulation at these values fails: {point.failure}")
    _, reverse = cost_and_slope(problem, jnp.asarray(u, dtype))
    scale = np.abs(point.rows) @ np.abs(point.residual)
    scale = scale + np.abs(point.prior_rows) @ np.abs(point.prior)
    modes = np.max(np.abs(np.asarray(reverse) - point.slope) / np.maximum(scale, 1e-300))
    errors = np.zeros((space.size, len(steps)))
    for j in range(space.size):
        for k, step in enumerate(steps):
            ends = []
            for sign in (1, -1):
                at = u.copy()
                at[j] += sign * step * max(1.0, abs(u[j]))
                ends.append(np.asarray(outcome(problem, jnp.asarray(at, dtype)).residual, float))
            difference = (ends[0] - ends[1]) / (2 * step * max(1.0, abs(u[j])))
            size = max(np.linalg.norm(difference), np.linalg.norm(point.rows[j]), 1e-300)
            errors[j, k] = np.linalg.norm(difference - point.rows[j]) / size
    return GradientCheck(tuple(problem.names), float(modes), np.asarray(steps), errors)
