"""Child processes that run one code each, and what they are asked."""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.cases import Case

ROOT = Path(__file__).parents[2]


class Refused(RuntimeError):
    """A worker could not do what it was asked; the message says why."""


class Process:
    """A worker on a number of threads; a context manager that ends it.

    Args:
        threads: CPUs it may use; all of them if None, where no time is measured.
        environment: variables on top of those of this process; None removes one.
        module: what it runs.
    """

    def __init__(
        self,
        threads: int | None,
        environment: dict[str, str | None] | None = None,
        module: str = "benchmarks.speed.worker",
    ):
        variables = {**os.environ, "JAX_PLATFORMS": "cpu", "ENABLE_TAICHI_HEADER_PRINT": "False"}
        for name, value in (environment or {}).items():
            if value is None:
                variables.pop(name, None)
            else:
                variables[name] = value
        self.log = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115
        chosen = [] if threads is None else [str(threads)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, *chosen],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.log,
            cwd=ROOT,
            env=variables,
            text=True,
        )

    def __enter__(self) -> "Process":
        return self

    def __exit__(self, *_: object) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()
        self.log.close()

    def ask(self, call: str, case: Case | None = None, **arguments: Any) -> Any:
        """The answer to one request.

        Raises:
            Refused: the worker raised an error, or is gone.
        """
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        request = {"call": call, **arguments}
        if case is not None:
            request["case"] = dataclasses.asdict(case)
        try:
            print(json.dumps(request), file=self.process.stdin, flush=True)
        except BrokenPipeError as error:
            raise Refused(self._last_words()) from error
        line = self.process.stdout.readline()
        if not line:
            raise Refused(self._last_words())
        answer = json.loads(line)
        if "error" in answer:
            raise Refused(answer["error"])
        return answer["value"]

    def positions(self, steps: int) -> np.ndarray:
        """Positions after some steps from the start of the prepared block, m, `(p, 3)`."""
        with tempfile.TemporaryDirectory() as folder:
            file = str(Path(folder) / "x.npy")
            self.ask("positions", steps=steps, file=file)
            return np.load(file).astype(np.float64)

    def _last_words(self) -> str:
        """The end of what the worker wrote to its standard error."""
        code = self.process.wait()
        self.log.seek(0)
        lines = self.log.read().strip().splitlines()
        return f"the process ended with status {code}: {' '.join(lines[-3:])}"
