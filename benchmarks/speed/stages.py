"""The cost of each stage of a step of pgjax, each stage compiled for itself.

In a rollout XLA fuses across stages, so their sum is not the cost of a step.
"""

import importlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.speed import cases
from benchmarks.speed.cases import Case
from benchmarks.speed.with_pgjax import rollout, setup

# `pgjax.step` is the function; this is the module it comes from.
step = importlib.import_module("pgjax.step")

# Runs a stage of that name and returns its result.
Run = Callable[..., Any]


def one_step(run: Run, scene: Any, state: Any, dt: Any) -> None:
    """The stages of `pgjax.step.step`, in its order; adapt it with that function."""
    t = jnp.zeros_like(dt)
    held, state = run("impose", step.impose, scene, state, t, dt)
    at, inside = run("stencil", step.stencil, scene.grid, scene.spline, state.position)
    state, finite, sums = run(
        "stress and P2G", step.particles_to_grid, scene, state, at, inside, t, dt
    )
    grid_v = run("grid and walls", _on_grid, scene, at, sums, t, dt)
    run("G2P and update", step.grid_to_particles, scene, state, at, finite, held, grid_v, dt)


def _on_grid(scene: Any, at: Any, sums: Any, t: Any, dt: Any) -> Any:
    region = step.region_of(scene.grid, at)
    return step.forces_and_boundaries(scene, region, sums, t, dt)


def measure(case: Case, variant: str, repeats: int) -> dict[str, float]:
    """Nanoseconds per particle of each stage, from the state after a few steps."""
    scene, state = setup(case, variant)
    state = rollout(scene, state, substeps=10).final
    costs = {}

    def run(name: str, stage: Callable, *operands: Any) -> Any:
        compiled = jax.jit(stage)
        result = jax.block_until_ready(compiled(*operands))
        times = []
        for _ in range(repeats):
            started = time.perf_counter()
            jax.block_until_ready(compiled(*operands))
            times.append(time.perf_counter() - started)
        costs[name] = statistics.median(times) / case.particles * 1e9
        return result

    one_step(run, scene, state, jnp.asarray(cases.DT, state.dtype))
    return costs
