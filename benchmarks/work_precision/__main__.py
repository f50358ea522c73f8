"""How long an error takes: work-precision diagrams of the simulator.

    python -m benchmarks.work_precision [--only WP1 WP3] [--quick] [--report] [--out DIR]

runs scenes with a known solution (those of `tests/verification`) at several resolutions and writes
error against wall time to `benchmarks/results/work_precision_cpu.json`, `.md` and one picture per
case. A case that is run again replaces its part of the file. Everything is on one thread.
`pip install -e ".[benchmarks]"` installs the other codes of WP9; one that is missing is left out.
"""

import argparse
import contextlib
import dataclasses
import datetime
import os
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.speed.processes import Process
from benchmarks.speed.table import note
from benchmarks.work_precision import report
from benchmarks.work_precision.cases import CASES


class Workers:
    """Processes on one thread, one per precision, started when they are first asked.

    "fresh" is one in single precision that ends after its answer.
    """

    def __init__(self) -> None:
        self.stack = contextlib.ExitStack()
        self.running: dict[str, Process] = {}

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()

    def ask(self, call: str, dtype: str, **arguments: Any) -> Any:
        """The answer of the worker in this precision."""
        if dtype == "fresh":
            with self._process("float32") as process:
                return process.ask(call, **arguments)
        if dtype not in self.running:
            self.running[dtype] = self.stack.enter_context(self._process(dtype))
        return self.running[dtype].ask(call, **arguments)

    def _process(self, dtype: str) -> Process:
        # Without a cache of compiled programs: compilation is measured.
        wanted = {
            "JAX_ENABLE_X64": str(int(dtype == "float64")),
            "JAX_COMPILATION_CACHE_DIR": None,
        }
        return Process(1, wanted, "benchmarks.work_precision.worker")


def measure(name: str, quick: bool) -> dict[str, Any]:
    """One case, as it is stored."""
    note(f"{name}: {CASES[name].title}")
    started = time.perf_counter()
    with Workers() as workers:
        panels = CASES[name].measure(workers.ask, quick)
    return {
        "title": CASES[name].title,
        "date": datetime.date.today().isoformat(),
        "minutes": (time.perf_counter() - started) / 60,
        "panels": [dataclasses.asdict(panel) for panel in panels],
    }


def options(arguments: list[str]) -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser("python -m benchmarks.work_precision", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--only", nargs="+", choices=tuple(CASES), default=[*CASES])
    parser.add_argument("--quick", action="store_true", help="one size each, nothing stored")
    parser.add_argument("--report", action="store_true", help="measure nothing, redraw")
    parser.add_argument("--out", type=Path, default=report.RESULTS, help="folder of the results")
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> None:
    """Measure, store each case as soon as it is there, draw."""
    chosen = options(arguments)
    if not hasattr(os, "sched_setaffinity"):
        sys.exit("The threads of a process can be limited on Linux only; this is another system.")
    for name in () if chosen.report else chosen.only:
        case = measure(name, chosen.quick)
        if chosen.quick:
            print(report.section(name, case))
        else:
            report.keep(name, case, chosen.out)
    if not chosen.quick:
        report.draw_up(chosen.out)


if __name__ == "__main__":
    main(sys.argv[1:])
