"""How long the first call of `simulate` takes beyond the later ones."""

import time

import jax

from benchmarks.speed.cases import Case
from benchmarks.speed.with_pgjax import kernels, rollout, setup

STEPS = 20


def first_call(case: Case, variant: str) -> float:
    """Seconds to trace and compile, or to take from the cache, in a process just started.

    The native kernels are built and loaded already.
    """
    kernels()
    scene, state = setup(case, variant)
    times = []
    for _ in range(2):
        started = time.perf_counter()
        jax.block_until_ready(rollout(scene, state, substeps=STEPS).final)
        times.append(time.perf_counter() - started)
    return times[0] - times[1]
