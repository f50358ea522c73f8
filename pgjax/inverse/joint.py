"""Several motions of what they have in common."""

from collections.abc import Sequence
from typing import final

import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Float
from pgjax.inverse.observations import AbstractObservation
from pgjax.inverse.parameters import Parameter, Space
from pgjax.inverse.problem import AbstractProblem, Outcome, Problem


@final
class Joint(AbstractProblem):
    """Several problems that share unknowns: throws of one body, segments of one film.

    Parameters of one name are one unknown; what belongs to one problem alone, as the velocity a
    throw or a segment begins with, has a name of its own. A prior counts once.

    Args:
        problems: each with a time step of its own. Residuals are put one after the other.

    Raises:
        ValueError: there is no problem, or parameters of one name differ.
    """

    space: Space
    problems: tuple[Problem, ...]

    def __init__(self, problems: Sequence[Problem]):
        if not problems:
            raise ValueError("Argument `problems` must hold at least one, but is empty.")
        parameters: dict[str, Parameter] = {}
        for number, problem in enumerate(problems):
            for name, parameter in problem.space.parameters.items():
                if not _same(parameters.setdefault(name, parameter), parameter):
                    raise ValueError(
                        f"Argument `problems` must give parameters of one name once, but {name!r} "
                        f"of problem {number} is {parameter} and was {parameters[name]} before."
                    )
        self.space, self.problems = Space(parameters), tuple(problems)

    @property
    def last(self) -> int:
        """Number of the last frame of the longest motion."""
        return max(problem.last for problem in self.problems)

    @property
    def watched(self) -> tuple[AbstractObservation, ...]:
        """Everything that is compared."""
        return tuple(o for problem in self.problems for o in problem.watched)

    def until(self, frame: int) -> "Joint":
        """What each of the motions shows up to a frame, with the same time steps.

        Raises:
            ValueError: nothing was recorded by then in one of them.
        """
        return self._with(self.space, tuple(p.until(min(frame, p.last)) for p in self.problems))

    def coarser(self, pixels: int) -> "Joint":
        """The problem in which pictures are seen through squares of so many pixels."""
        return self._with(self.space, tuple(p.coarser(pixels) for p in self.problems))

    def moments(self) -> np.ndarray:
        """Which frame of which motion each entry of the residual is of, `(m,)`."""
        own = [problem.moments() for problem in self.problems]
        firsts = np.cumsum([0] + [numbers.max() + 1 for numbers in own[:-1]])
        return np.concatenate([first + n for first, n in zip(firsts, own, strict=True)])

    def with_space(self, space: Space) -> "Joint":
        """The same motions and data with other starts, or others of the parameters fixed."""
        return self._with(space, self.problems)

    def outcome(self, u: Float[Array, " size"]) -> Outcome:
        """Simulate all motions at free coordinates u and compare. Pure; differentiable in u."""
        values = self.space.values(u)
        residuals, statuses = [], []
        for problem in self.problems:
            own = {name: values[name] for name in problem.space.labels}
            residual, status = problem.compared(own)
            residuals.append(residual)
            statuses.append(status)
        dtype = jnp.result_type(*residuals)
        residual: Array = jnp.concatenate([part.astype(dtype) for part in residuals])
        first, *rest = statuses
        for status in rest:
            first = first.merged(status)
        return Outcome(residual, self.space.prior_residual(u).astype(dtype), first)

    def _with(self, space: Space, problems: tuple[Problem, ...]) -> "Joint":
        new = object.__new__(Joint)
        object.__setattr__(new, "space", space)
        object.__setattr__(new, "problems", problems)
        return new


def _same(a: Parameter, b: Parameter) -> bool:
    """Whether two parameters are one."""
    leaves = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=False)
    return jax.tree.structure(a) == jax.tree.structure(b) and all(
        np.array_equal(p, q) for p, q in leaves
    )
