"""First-order descent with optax: for fields, networks and appearance."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from pgjax._types import Array
from pgjax.inverse.levenberg import FitError
from pgjax.inverse.problem import AbstractProblem


class Step(NamedTuple):
    """One line of the history.

    Attributes:
        cost: before the step; infinite or NaN where the simulation failed.
        slope: norm of the gradient.
        note: why the step was not made, or nothing.
        seconds: since the start.
    """

    cost: float
    slope: float
    note: str
    seconds: float


class Descended(NamedTuple):
    """The result of `descend`.

    Attributes:
        best: the tree with the lowest cost that was seen.
        cost: its cost.
        history: of every step.
    """

    best: Any
    cost: float
    history: list[Step]


def descend(
    cost: Callable[[Any], Array],
    start: Any,
    *,
    steps: int,
    where: Callable[[Any], Any] | None = None,
    optimizer: optax.GradientTransformation | None = None,
    rate: float | optax.Schedule = 1e-2,
    report: Callable[[int, Step], None] | None = None,
) -> Descended:
    """Minimise a cost over the floating arrays of any tree: a field, an `eqx.Module`, Gaussians.

    A step that leads to a cost or gradient that is not finite is taken back, and the rate is
    halved for what follows; the best tree is returned, not the last.

    Args:
        cost: from a tree like `start` to one number. A rollout inside is differentiated in reverse
            mode through checkpointed steps (`pgjax.simulate` with `throw=False`).
        start: where to begin; what is not a floating array in it stays.
        steps: how many gradients are computed.
        where: the part of the tree that is free, e.g. `lambda law: law.network`; all if None.
        optimizer: of optax; Adam with `rate` if None.
        rate: of Adam: a number or a schedule of optax.
        report: called after each step with its number.

    Raises:
        FitError: the cost or its gradient is not finite at the start.
    """
    if steps < 1:
        raise ValueError(f"Argument `steps` must be at least 1, but is {steps}.")
    optimizer = optax.adam(rate) if optimizer is None else optimizer
    chosen: Any = eqx.is_inexact_array
    if where is not None:
        nothing = jax.tree.map(lambda _: False, start)
        part = jax.tree.map(eqx.is_inexact_array, where(start))
        chosen = eqx.tree_at(where, nothing, part)
    free, rest = eqx.partition(start, chosen)

    @eqx.filter_jit
    def slope_of(free: Any) -> tuple[Array, Any, Array]:
        value, slope = jax.value_and_grad(lambda f: cost(eqx.combine(f, rest)))(free)
        return value, slope, _norm(slope)

    @eqx.filter_jit
    def updated(free: Any, slope: Any, memory: Any, scale: Array) -> tuple[Any, Any]:
        # Optax relies on it, whatever the user has chosen.
        with jax.numpy_dtype_promotion("standard"):
            change, memory = optimizer.update(slope, memory, free)
        change = jax.tree.map(lambda a: scale.astype(a.dtype) * a, change)
        return optax.apply_updates(free, change), memory

    began = time.perf_counter()
    memory, scale, history = optimizer.init(free), 1.0, []
    best, lowest, before = free, np.inf, None
    for number in range(steps):
        value, slope, norm = slope_of(free)
        usable = bool(jnp.isfinite(value)) and bool(jnp.isfinite(norm))
        note = "" if usable else "cost or gradient is not finite"
        step = Step(float(value), float(norm), note, time.perf_counter() - began)
        history.append(step)
        if report is not None:
            report(number, step)
        if not usable:
            if before is None:
                raise FitError(f"The first guess cannot be used: {note} ({step.cost}).")
            scale /= 2
            free, slope, memory = before
        else:
            if step.cost < lowest:
                best, lowest = free, step.cost
            before = (free, slope, memory)
        free, memory = updated(free, slope, memory, jnp.asarray(scale))
    return Descended(eqx.combine(best, rest), lowest, history)


def _norm(tree: Any) -> Array:
    squares = [jnp.sum(jnp.abs(leaf) ** 2) for leaf in jax.tree.leaves(tree)]
    return jnp.sqrt(jnp.sum(jnp.stack(squares)))


def descend_problem(
    problem: AbstractProblem,
    *,
    steps: int,
    optimizer: optax.GradientTransformation | None = None,
    rate: float | optax.Schedule = 1e-2,
    report: Callable[[int, Step], None] | None = None,
) -> tuple[dict[str, np.ndarray], Descended]:
    """The same for a `Problem`, whose bounds hold: for parameters that are fields.

    Returns:
        The best values by name, in physical units, and the course of the descent.
    """
    lower, upper = (jnp.asarray(b, jnp.zeros(()).dtype) for b in problem.space.bounds())

    def within(change: Any, u: Any) -> Any:
        return jnp.clip(u + change, lower, upper) - u

    def cost(u: Array) -> Array:
        result = problem.outcome(u)
        return jnp.where(result.ok, result.cost, jnp.nan)

    own = optax.adam(rate) if optimizer is None else optimizer
    end = descend(
        cost,
        jnp.asarray(problem.space.start, lower.dtype),
        steps=steps,
        optimizer=optax.chain(own, optax.stateless(within)),
        report=report,
    )
    return problem.space.known(np.asarray(end.best, np.float64)), end
