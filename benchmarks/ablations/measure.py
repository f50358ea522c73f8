"""Two programs that should give the same, in turns: time, memory, and how far apart they are."""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import pgjax
from pgjax import Scene, State


@dataclasses.dataclass(frozen=True)
class Program:
    """A compiled rollout.

    Attributes:
        final: does it once and returns the final state.
        memory: bytes of what it takes, makes and needs between, as XLA says.
        compiling: seconds.
        places: what is compared of the final state, m; the positions `(p, d)` if None.
    """

    final: Callable[[], State]
    memory: int
    compiling: float
    places: Callable[[State], np.ndarray] | None = None

    def run(self) -> np.ndarray:
        """Do it once."""
        state = self.final()
        return np.asarray(state.x if self.places is None else self.places(state))


def rollout(scene: Scene, state: State, *, seconds: float, dt: float, **options: Any) -> Program:
    """A simulation of so many seconds in steps of at most dt, s, compiled."""
    steps = max(1, round(seconds / dt))

    def final(scene: Scene, state: State) -> tuple[State, Any]:
        run = pgjax.simulate(
            scene,
            state,
            dt=seconds / steps,
            frames=1,
            substeps=steps,
            save=_nothing,
            throw=False,
            allow_unstable=True,
            **options,
        )
        # Without its accounts among the results a program would not compute them.
        return run.final, run.ledger

    started = time.perf_counter()
    compiled = jax.jit(final).lower(scene, state).compile()
    compiling = time.perf_counter() - started
    sizes: Any = compiled.memory_analysis()
    memory = sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    return Program(lambda: compiled(scene, state)[0], memory, compiling)


def _nothing(state: State) -> None:
    """Save nothing of a frame."""
    del state


def compare(without: Program, saving: Program, rounds: int) -> dict[str, float]:
    """Both in turns after a first call of each; medians, and the median of the rounds' ratios."""
    times: dict[str, list[float]] = {"without": [], "saving": []}
    last: dict[str, np.ndarray] = {}
    for _ in range(rounds + 1):
        for name, program in (("without", without), ("saving", saving)):
            started = time.perf_counter()
            last[name] = program.run()
            times[name].append(time.perf_counter() - started)
    pairs = zip(times["without"][1:], times["saving"][1:], strict=True)
    return {
        "seconds without": statistics.median(times["without"][1:]),
        "seconds": statistics.median(times["saving"][1:]),
        "times faster": statistics.median(a / b for a, b in pairs),
        "memory without": without.memory,
        "memory": saving.memory,
        "compiling without": without.compiling,
        "compiling": saving.compiling,
    }


def change(start: np.ndarray, one: np.ndarray, other: np.ndarray) -> float:
    """Root mean square distance of two final places over that of the way from the start."""
    way = np.asarray(one, np.float64) - start
    return float(np.sqrt(np.sum((one - other) ** 2) / np.sum(way**2)))
