"""One code on a fixed number of threads, in a process of its own.

XLA's pool of threads is as large as the CPUs it may use when it starts, so the affinity is set
first and everything else imported afterwards. Requests and answers are lines of JSON.

    python -m benchmarks.speed.worker [THREADS]
"""

import importlib
import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.speed.cases import Case


class Block:
    """A solver of one case and what can be asked of it."""

    def __init__(self, code: str, variant: str, case: Case):
        module = importlib.import_module(f"benchmarks.speed.with_{code}")
        self.solver = module.Solver(case, variant)

    def positions(self, steps: int, file: str) -> None:
        """Run from the start and save the positions."""
        self.solver.reset()
        self.solver.run(steps)
        np.save(file, self.solver.positions())

    def seconds(self, steps: int) -> float:
        """Wall time of the steps from the start; the programs are compiled already."""
        self.solver.reset()
        started = time.perf_counter()
        self.solver.run(steps)
        return time.perf_counter() - started


class Worker:
    """Holds at most one block at a time."""

    def __init__(self) -> None:
        self.block: Block | None = None

    def answer(self, call: str, case: dict[str, Any] | None = None, **arguments: Any) -> Any:
        """The result of one request."""
        if call == "prepare":
            self.block = None
            self.block = Block(**arguments, case=Case(**case or {}))
            return None
        if call in ("positions", "seconds"):
            return getattr(self.block, call)(**arguments)
        module, _, name = call.partition(".")
        function = getattr(importlib.import_module(f"benchmarks.speed.{module}"), name)
        if case is not None:
            arguments["case"] = Case(**case)
        return function(**arguments)


def serve(threads: int | None, answer: Callable[..., Any]) -> None:
    """Answer until the input ends. What libraries print goes to the standard error."""
    if threads is not None:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    for line in sys.stdin:
        try:
            reply = {"value": answer(**json.loads(line))}
        except Exception as error:
            traceback.print_exc()
            reply = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(reply), file=answers, flush=True)


if __name__ == "__main__":
    serve(int(sys.argv[1]) if len(sys.argv) > 1 else None, Worker().answer)
