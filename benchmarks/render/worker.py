"""One renderer on a fixed number of threads, in a process of its own.

    python -m benchmarks.render.worker [THREADS]

The affinity is set before JAX or PyTorch is imported; requests and answers are lines of JSON.
"""

import ctypes
import importlib
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.speed.worker import serve

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


def first_run(
    renderer: Any, quantity: str, clock: str, file: str, repeat: float
) -> dict[str, float]:
    """Run and save the result: seconds, and bytes the process grew by at its peak.

    Where the first call takes at most `repeat` seconds, the time is that of a second one, in which
    no libraries are loaded any more. The peak is the larger one: a second call may find memory that
    the first has not given back. It has in it what the kernels allocate for themselves, and the
    result; it is left out on systems that do not tell it.
    """
    peaks, found = [], {}
    for _ in range(2):
        before = _forget_peak()
        started = CLOCKS[clock]()
        result = renderer.run(quantity)
        found = {"seconds": CLOCKS[clock]() - started}
        if before is not None:
            peaks.append(_status("VmHWM") - before)
            found["peak"] = max(peaks)
        renderer.save(result, file)
        # Its memory is free before the next call.
        del result
        if found["seconds"] > repeat:
            break
    return found


def _forget_peak() -> int | None:
    """Give unused memory back and start a new peak; returns the bytes in use, None if unknown."""
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
        return _status("VmRSS")
    except (OSError, AttributeError):
        return None


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name + ":"))


class Worker:
    """Holds one renderer."""

    def __init__(self) -> None:
        self.renderer: Any = None

    def answer(self, call: str, **arguments: Any) -> Any:
        """The result of one request."""
        if call == "prepare":
            code = arguments.pop("code")
            module = importlib.import_module(f"benchmarks.render.with_{code}")
            self.renderer = module.Renderer(**arguments)
            return None
        if call == "first_run":
            return first_run(self.renderer, **arguments)
        if call == "seconds":
            clock = CLOCKS[arguments.pop("clock")]
            started = clock()
            self.renderer.run(**arguments)
            return clock() - started
        if call == "kernels":
            return importlib.import_module("benchmarks.render.with_pgjax").kernels()
        return getattr(self.renderer, call)(**arguments)


if __name__ == "__main__":
    serve(int(sys.argv[1]) if len(sys.argv) > 1 else None, Worker().answer)
