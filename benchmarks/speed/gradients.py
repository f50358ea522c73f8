"""Derivatives of a number at the end of a rollout: cost, memory, and whether they are right.

The number is a weighted mean of the final positions, differentiated with respect to all initial
velocities and to Young's modulus.
"""

import statistics
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.speed import cases
from benchmarks.speed.cases import Case
from benchmarks.speed.with_pgjax import rollout, setup

# Steps of the central differences, relative to the tangent; the best of them counts.
DIFFERENCES = (1e-3, 1e-4, 1e-5, 1e-6)


def _program(
    case: Case, variant: str, steps: int, *, keep_states: bool = False
) -> tuple[Any, tuple, tuple]:
    """The function of `(v, E, scene, state)`, its arguments, and a tangent of the first two."""
    scene, state = setup(case, variant)
    random = np.random.default_rng(0)
    weights = jnp.asarray(random.normal(size=state.v.shape) / case.particles, state.dtype)

    def value(v: Any, E: Any, scene: Any, state: Any, weights: Any) -> Any:
        scene = eqx.tree_at(lambda s: s.materials[0].elasticity.E, scene, E)
        state = eqx.tree_at(lambda s: s.v, state, v)
        final = rollout(scene, state, substeps=steps, keep_states=keep_states).final
        return jnp.sum(weights * final.position)

    E = jnp.asarray(cases.E, state.dtype)
    tangent = (
        jnp.asarray(random.normal(size=state.v.shape), state.dtype),
        jnp.asarray(0.1 * cases.E, state.dtype),
    )
    return value, (state.v, E, scene, state, weights), tangent


def _compiled(function: Any, *arguments: Any) -> Any:
    return jax.jit(function).lower(*arguments).compile()


def _forward_mode(value: Any) -> Any:
    """`(tangent, *arguments) -> (value, derivative along the tangent)`."""

    def along(tangent: tuple, v: Any, E: Any, *rest: Any) -> Any:
        return jax.jvp(lambda v, E: value(v, E, *rest), (v, E), tangent)

    return along


def cost(case: Case, variant: str, steps: int, rounds: int) -> dict[str, float]:
    """Nanoseconds per particle and step of the value, its gradient and one tangent; memory.

    The programs take turns; medians. A first round does not count.
    """
    value, arguments, tangent = _program(case, variant, steps)
    keeping = _program(case, variant, steps, keep_states=True)[0]
    programs = {
        "value": (_compiled(value, *arguments), arguments),
        "reverse": (_compiled(jax.grad(value, argnums=(0, 1)), *arguments), arguments),
        "kept": (_compiled(jax.grad(keeping, argnums=(0, 1)), *arguments), arguments),
        "forward": (
            _compiled(_forward_mode(value), tangent, *arguments),
            (tangent, *arguments),
        ),
    }
    times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds + 1):
        for name, (program, operands) in programs.items():
            started = time.perf_counter()
            jax.block_until_ready(program(*operands))
            times[name].append(time.perf_counter() - started)
    ns = {
        name: statistics.median(measured[1:]) / steps / case.particles * 1e9
        for name, measured in times.items()
    }
    memory = {
        name: _states(programs[program][0], arguments)
        for name, program in (("memory", "reverse"), ("kept memory", "kept"))
    }
    return ns | memory


def _states(program: Any, arguments: tuple) -> float:
    """Temporary memory of a compiled program over that of the state among its arguments."""
    one = sum(leaf.nbytes for leaf in jax.tree.leaves(arguments[3]))
    return program.memory_analysis().temp_size_in_bytes / one


def memory(case: Case, variant: str, steps: int) -> float:
    """Temporary memory of the gradient's program, in states of the simulation."""
    value, arguments, _ = _program(case, variant, steps)
    return _states(_compiled(jax.grad(value, argnums=(0, 1)), *arguments), arguments)


def errors(case: Case, variant: str, steps: int) -> dict[str, float]:
    """Relative difference of both modes from central differences along the tangent."""
    value, arguments, tangent = _program(case, variant, steps)
    (v, E, *rest), (dv, dE) = arguments, tangent
    run = jax.jit(value)
    gradient = jax.jit(jax.grad(value, argnums=(0, 1)))(*arguments)
    found = {
        "reverse": float(jnp.sum(gradient[0] * dv) + gradient[1] * dE),
        "forward": float(jax.jit(_forward_mode(value))(tangent, *arguments)[1]),
    }
    slopes = [
        float(run(v + s * dv, E + s * dE, *rest) - run(v - s * dv, E - s * dE, *rest)) / (2 * s)
        for s in DIFFERENCES
    ]
    return {
        mode: min(abs(slope / derivative - 1) for slope in slopes)
        for mode, derivative in found.items()
    }
