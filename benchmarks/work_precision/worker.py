"""A process that measures what it is asked, on a fixed number of threads.

    python -m benchmarks.work_precision.worker [THREADS]

The scenes are those of `tests/verification`, which is found here and nowhere else.
"""

import importlib
import sys
from pathlib import Path
from typing import Any

from benchmarks.speed.worker import serve

SCENES = Path(__file__).parents[2] / "tests" / "verification"


def answer(call: str, **arguments: Any) -> Any:
    """What the function `call`, "module.name" of this package, returns."""
    module, _, name = call.partition(".")
    return getattr(importlib.import_module(f"benchmarks.work_precision.{module}"), name)(
        **arguments
    )


if __name__ == "__main__":
    sys.path.insert(0, str(SCENES))
    serve(int(sys.argv[1]) if len(sys.argv) > 1 else None, answer)
