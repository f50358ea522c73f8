"""Times of one block over simulated devices, in a process of its own.

    python -m benchmarks.parallel.worker DEVICES SIDE STEPS ROUNDS

JAX fixes the number of devices when it starts. One device has one thread, two have one each: the
affinity is set first.
"""

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

DEVICES, SIDE, STEPS, ROUNDS = map(int, sys.argv[1:5])
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={DEVICES}"
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:DEVICES])

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax.sharding import Mesh, PartitionSpec  # noqa: E402

import pgjax  # noqa: E402
from benchmarks.speed import cases  # noqa: E402
from benchmarks.speed.with_pgjax import nothing, setup  # noqa: E402
from pgjax import parallel  # noqa: E402

# Never within the run.
SELDOM = 10**6


def median(run: Callable[[], Any]) -> float:
    """Seconds, once compiled."""
    jax.block_until_ready(run())
    times = []
    for _ in range(ROUNDS):
        started = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - started)
    return statistics.median(times)


def rollouts() -> dict[str, float]:
    """Seconds of a step of each way to run the block."""
    case = cases.Case("neo-Hookean", SIDE, cases.grid_cells(SIDE))
    scene, state = setup(case, "MLS")
    run = {"dt": cases.DT, "frames": 1, "substeps": STEPS, "save": nothing, "throw": False}
    layouts = {
        "shared grid": parallel.SharedGrid(),
        "slabs": parallel.Slabs(),
        "slabs, nobody changes over": parallel.Slabs(every=SELDOM),
        "slabs, no empty places": parallel.Slabs(every=SELDOM, capacity=_fullest(scene, state)),
    }
    found = {}
    if DEVICES == 1:
        found["simulate"] = median(lambda: pgjax.simulate(scene, state, **run).final) / STEPS
    for name, layout in layouts.items():

        def one(layout: Any = layout) -> Any:
            return parallel.simulate(scene, state, layout=layout, **run).final

        found[name] = median(one) / STEPS
    return found


def _fullest(scene: pgjax.Scene, state: pgjax.State) -> int:
    plan = parallel.Slabs().planned(scene, state, DEVICES)
    owner = np.searchsorted(plan.edges[1:-1], state.position[:, plan.axis] / cases.H, side="right")
    return int(np.bincount(owner).max())


def exchanges() -> dict[str, float]:
    """Seconds of what a step communicates, by itself."""
    cells = cases.grid_cells(SIDE) + 5
    mesh = Mesh(np.asarray(jax.devices()), ("d",))
    pairs = [(i, i + 1) for i in range(DEVICES - 1)]

    def looped(one: Callable[[Any], Any], shape: tuple[int, ...]) -> float:
        def many(a: Any) -> Any:
            return jax.lax.fori_loop(0, STEPS, lambda _, a: one(a), a)

        spec = PartitionSpec("d")
        shared = jax.jit(jax.shard_map(many, mesh=mesh, in_specs=spec, out_specs=spec))
        start = jnp.ones((DEVICES * shape[0], *shape[1:]), jnp.float32)
        return median(lambda: shared(start)) / STEPS

    def summed(a: Any) -> Any:
        return jax.lax.pcast(jax.lax.psum(a, "d"), "d", to="varying") / DEVICES

    def passed(a: Any) -> Any:
        return jax.lax.ppermute(a, "d", pairs)

    return {
        "sum of the grid": looped(summed, (cells, cells, cells, 4)),
        "five layers to one neighbour": looped(passed, (5, cells, cells, 4)),
    }


if __name__ == "__main__":
    measured = rollouts() | (exchanges() if DEVICES > 1 else {})
    print(json.dumps(measured))
