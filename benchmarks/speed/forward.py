"""Forward cost: every code takes its turn in every round."""

import contextlib
import statistics

import numpy as np

from benchmarks.speed import cases
from benchmarks.speed.cases import Case
from benchmarks.speed.processes import Process, Refused
from benchmarks.speed.table import Row, note

# Column: module and variant.
PGJAX = {"pgjax MLS": ("pgjax", "MLS"), "pgjax ∇w": ("pgjax", "∇w")}
TAICHI = {
    "Taichi serialised": ("taichi", "serialised"),
    "Taichi atomics": ("taichi", "atomics"),
}
WARP = {"Warp": ("warp", "")}
REFERENCE = "pgjax MLS"
# Of the root mean square of the distances travelled; single precision gives 1e-6 to 4e-6.
BOUND = 2e-5
COMPARED_STEPS = 50


def steps_of(case: Case, work: float) -> int:
    """Steps of a timed run: about `work` particle-steps, so few that starting it is nothing."""
    return int(np.clip(work / case.particles, 10, 400))


def difference(x: np.ndarray, expected: np.ndarray, case: Case) -> float:
    """Root mean square of the differences over that of the distances travelled."""
    travelled = expected - cases.start(case).x
    return float(np.sqrt(np.sum((x - expected) ** 2) / np.sum(travelled**2)))


def measure(
    case: Case, threads: int, codes: dict[str, tuple[str, str]], rounds: int, work: float
) -> list[Row]:
    """Compare the trajectories, then time those codes that agree."""
    steps = steps_of(case, work)
    about = {"material": case.material, "particles": case.particles, "threads": threads}
    with contextlib.ExitStack() as stack:
        running = _prepared(stack, case, threads, codes)
        agreement = _agreement(running, case, min(steps, COMPARED_STEPS))
        for name, far in agreement.items():
            if not far <= BOUND:
                note(f"{name}, {case.material}: not timed, its trajectory is {far:.1e} off")
                del running[name]
        seconds = _rounds(running, steps, rounds)
    cost = {
        name: statistics.median(times) / steps / case.particles * 1e9
        for name, times in seconds.items()
    }
    rows = [Row("forward", "ns per particle-step", **about, values=cost)]
    if ratios := _ratios(seconds):
        rows.append(Row("MLS over this code", "ratio", **about, values=ratios))
    if agreement:
        rows.append(Row("position off pgjax MLS", "relative", **about, values=agreement))
    return rows


def _prepared(
    stack: contextlib.ExitStack, case: Case, threads: int | None, codes: dict[str, tuple[str, str]]
) -> dict[str, Process]:
    """A process per code that has built the block; those that cannot are named and left out."""
    running = {}
    for name, (code, variant) in codes.items():
        process = stack.enter_context(Process(threads))
        try:
            process.ask("prepare", case, code=code, variant=variant)
        except Refused as error:
            if code == "pgjax":
                raise
            note(f"{name}, {case.material}: left out, {error}")
        else:
            running[name] = process
    return running


def _agreement(running: dict[str, Process], case: Case, steps: int) -> dict[str, float]:
    """How far the MLS codes other than pgjax are from it, in single precision."""
    peers = [name for name in running if name not in PGJAX]
    if not peers:
        return {}
    expected = running[REFERENCE].positions(steps)
    return {name: difference(running[name].positions(steps), expected, case) for name in peers}


def _rounds(running: dict[str, Process], steps: int, rounds: int) -> dict[str, list[float]]:
    """Seconds of every round; a first one, which compiles, is not counted."""
    for process in running.values():
        process.ask("seconds", steps=steps)
    times: dict[str, list[float]] = {name: [] for name in running}
    for _ in range(rounds):
        for name, process in running.items():
            times[name].append(process.ask("seconds", steps=steps))
    return times


def _ratios(seconds: dict[str, list[float]]) -> dict[str, float]:
    """Median over rounds of the time of pgjax MLS over that of each peer in the same round."""
    own = seconds[REFERENCE]
    return {
        name: statistics.median(a / b for a, b in zip(own, times, strict=True))
        for name, times in seconds.items()
        if name not in PGJAX
    }


def accuracy(case: Case, codes: dict[str, tuple[str, str]]) -> list[Row]:
    """How far each MLS code is in single precision from pgjax in double precision."""
    codes = {name: code for name, code in codes.items() if name != "pgjax ∇w"}
    with contextlib.ExitStack() as stack:
        exact = stack.enter_context(Process(None, {"JAX_ENABLE_X64": "1"}))
        exact.ask("prepare", case, code="pgjax", variant="MLS")
        expected = exact.positions(COMPARED_STEPS)
        running = _prepared(stack, case, None, codes)
        values = {
            name: difference(process.positions(COMPARED_STEPS), expected, case)
            for name, process in running.items()
        }
    return [Row("position off float64", "relative", case.material, case.particles, None, values)]
