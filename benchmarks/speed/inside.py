"""Rows about pgjax alone: stages, compilation, derivatives."""

import tempfile
from collections.abc import Callable

from benchmarks.speed.cases import Case
from benchmarks.speed.forward import PGJAX
from benchmarks.speed.processes import Process, Refused
from benchmarks.speed.table import Row, note


def _by_scheme(case: Case, columns: list[str], measure: Callable) -> dict[str, dict[str, float]]:
    """`measure(variant)` of each column, turned over: name of a number, column, number."""
    result: dict[str, dict[str, float]] = {}
    for column in columns:
        try:
            numbers = measure(PGJAX[column][1])
        except Refused as error:
            note(f"{column}, {case.material}: not measured, {error}")
            continue
        for name, number in numbers.items():
            result.setdefault(name, {})[column] = number
    return result


def _rows(
    case: Case, threads: int | None, numbers: dict, names: dict[str, tuple[str, str]]
) -> list[Row]:
    """A row for each of the numbers; `names` gives quantity and unit."""
    return [
        Row(*names[name], case.material, case.particles, threads, values)
        for name, values in numbers.items()
    ]


def stages(case: Case, threads: int, columns: list[str], repeats: int) -> list[Row]:
    """Cost of each stage."""

    def measure(variant: str) -> dict[str, float]:
        with Process(threads) as process:
            return process.ask("stages.measure", case, variant=variant, repeats=repeats)

    numbers = _by_scheme(case, columns, measure)
    names = {name: (f"stage: {name}", "ns per particle") for name in numbers}
    return _rows(case, threads, numbers, names)


def compilation(case: Case, threads: int, columns: list[str]) -> list[Row]:
    """First call of `simulate` with an empty cache of compiled programs, and with a filled one."""
    always = {
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    }

    def measure(variant: str) -> dict[str, float]:
        seconds = {}
        with tempfile.TemporaryDirectory() as folder:
            for name in ("cold", "cached"):
                with Process(threads, {**always, "JAX_COMPILATION_CACHE_DIR": folder}) as process:
                    seconds[name] = process.ask("compilation.first_call", case, variant=variant)
        return seconds

    names = {"cold": ("compilation, cold", "s"), "cached": ("compilation, from cache", "s")}
    return _rows(case, threads, _by_scheme(case, columns, measure), names)


def gradient_cost(
    case: Case, threads: int, columns: list[str], steps: int, rounds: int
) -> list[Row]:
    """Cost of both modes, alone and over that of the value; memory of reverse mode."""

    def measure(variant: str) -> dict[str, float]:
        with Process(threads) as process:
            ns = process.ask("gradients.cost", case, variant=variant, steps=steps, rounds=rounds)
        return {
            "reverse": ns["reverse"],
            "reverse ratio": ns["reverse"] / ns["value"],
            "kept": ns["kept"],
            "forward ratio": ns["forward"] / ns["value"],
            "memory": ns["memory"],
            "kept memory": ns["kept memory"],
        }

    names = {
        "reverse": (f"gradient, {steps} steps", "ns per particle-step"),
        "reverse ratio": (f"gradient over value, {steps} steps", "ratio"),
        "forward ratio": (f"one tangent over value, {steps} steps", "ratio"),
        "memory": _memory_of(steps),
        "kept": (f"gradient with all states kept, {steps} steps", "ns per particle-step"),
        "kept memory": (f"memory of gradient with all states kept, {steps} steps", "states"),
    }
    return _rows(case, threads, _by_scheme(case, columns, measure), names)


def _memory_of(steps: int) -> tuple[str, str]:
    return f"memory of gradient, {steps} steps", "states"


def gradient_memory(case: Case, columns: list[str], lengths: list[int]) -> list[Row]:
    """Temporary memory of reverse mode for longer rollouts."""

    def measure(variant: str) -> dict[str, float]:
        with Process(None) as process:
            return {
                str(steps): process.ask("gradients.memory", case, variant=variant, steps=steps)
                for steps in lengths
            }

    names = {str(steps): _memory_of(steps) for steps in lengths}
    return _rows(case, None, _by_scheme(case, columns, measure), names)


def gradient_errors(case: Case, columns: list[str], steps: int) -> list[Row]:
    """Both modes against central differences in double precision."""

    def measure(variant: str) -> dict[str, float]:
        with Process(None, {"JAX_ENABLE_X64": "1"}) as process:
            return process.ask("gradients.errors", case, variant=variant, steps=steps)

    names = {
        mode: (f"{mode} mode off differences, {steps} steps, float64", "relative")
        for mode in ("reverse", "forward")
    }
    return _rows(case, None, _by_scheme(case, columns, measure), names)
