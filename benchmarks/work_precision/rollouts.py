"""What a rollout of the verification scenes costs: each goes through `scenes._roll`."""

import contextlib
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scenes

from pgjax.scene import Scene
from pgjax.simulate import repeated
from pgjax.state import State
from pgjax.step import step

RUNS = 5
# Runs so long are repeated less often.
LONG = 5.0
# Seconds in which no rollout is compiled.
FOUND = 0.1


@dataclasses.dataclass
class Costs:
    """What was measured of the one rollout inside `watched`; the names are those of `Point`."""

    seconds: float = math.nan
    compile: float | None = None
    memory: float = math.nan
    backward: float | None = None
    particles: int = 0
    steps: int = 0
    remark: str = ""


def timed(program: Callable, *arguments: Any) -> tuple[float, Any]:
    """Median seconds of five runs, of three if they are long, and the result.

    A first run does not count.
    """
    times, runs, result = [], RUNS, None
    while len(times) < runs + 1:
        started = time.perf_counter()
        result = jax.block_until_ready(program(*arguments))
        times.append(time.perf_counter() - started)
        runs = 3 if times[0] > LONG else RUNS
    return statistics.median(times[1:]), result


def temporary(program: Any) -> float:
    """Temporary memory of a compiled program as XLA plans it, bytes."""
    analysis = getattr(program, "compiled", program).memory_analysis()
    return float(analysis.temp_size_in_bytes)


@contextlib.contextmanager
def watched(*, backward: bool = False) -> Iterator[Costs]:
    """Measure the rollout that runs inside, beside doing it.

    The timed program takes the same steps, observes nothing, and has no manufactured body force,
    which no simulation has.

    Args:
        backward: also time value and gradient of a number at the end with respect to all initial
            velocities and Young's modulus, checkpointed in blocks of √T steps.
    """
    costs, usual = Costs(), scenes._roll

    def roll(scene, state, dt, steps, observe, after, every):
        plain = without_force(scene)
        arguments = plain, state, dt, steps, scenes.nothing, after, steps
        started = time.perf_counter()
        program = usual.lower(*arguments).compile()
        compilation = time.perf_counter() - started
        # The same program as before, which is found again?
        costs.compile = compilation if compilation > FOUND else None
        costs.seconds, _ = timed(program, *arguments)
        costs.memory = temporary(program)
        costs.particles, costs.steps = len(state.v), steps
        if backward:
            block = math.ceil(math.sqrt(steps))
            costs.backward, finite = backward_seconds(plain, state, dt, steps, after, block)
            costs.remark = "" if finite else "gradient not finite"
        return usual(scene, state, dt, steps, observe, after, every)

    with mock.patch.object(scenes, "_roll", roll):
        yield costs


def without_force(scene: Scene) -> Scene:
    """The scene without its body force."""
    return eqx.tree_at(
        lambda s: (s.body_force, s.X0), scene, (None, None), is_leaf=lambda leaf: leaf is None
    )


def backward_seconds(
    scene: Scene, state: State, dt: Any, steps: int, after: Callable, block: int
) -> tuple[float, bool]:
    """Seconds of value and gradient, and whether the gradient is finite."""
    weights = jnp.asarray(np.random.default_rng(0).normal(size=state.v.shape), state.dtype)

    def value(E: Any, v: Any, scene: Scene, state: State, dt: Any) -> Any:
        scene = with_modulus(scene, E)
        state = eqx.tree_at(lambda s: s.v, state, v)
        advance = jax.checkpoint(lambda s: after(step(scene, s, dt)))
        return jnp.sum(weights * repeated(advance, state, steps, block=block).position)

    E = jnp.asarray(scene.materials[0].elasticity.E, state.dtype)
    arguments = E, state.v, scene, state, dt
    program = eqx.filter_jit(jax.value_and_grad(value, argnums=(0, 1))).lower(*arguments).compile()
    seconds, (_, slopes) = timed(program, *arguments)
    return seconds, all(bool(jnp.all(jnp.isfinite(a))) for a in slopes)


def with_modulus(scene: Scene, E: Any) -> Scene:
    """The scene with another Young's modulus of its first material."""
    return eqx.tree_at(lambda s: s.materials[0].elasticity.E, scene, E)
