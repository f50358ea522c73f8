"""What a scene does not need, left out: time, memory and result of each saving.

    python -m benchmarks.ablations [--rows NAME …] [--rounds 7]

measures each in turns with the same scene without it, and writes `ablations_cpu.json` and
`ablations_cpu.md`. Rows that were not measured now are kept.
"""

import argparse
import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path

from benchmarks.ablations import presets, report
from benchmarks.ablations.rows import ROWS, Row

TARGET = Path(__file__).parents[1] / "results" / "ablations_cpu.json"

_AUTOMATIC = {"fox": 15, "bread": 5, "ficus": 4}
_COARSE = {"fox": 30, "plane": 20}
_ASLEEP = ("wolf", "ruins", "can", "jam", "cake")

ALL: dict[str, Callable[[int], Row]] = {
    **ROWS,
    **{
        f"automatic_dt_{name}": functools.partial(presets.automatic_dt, name, frames)
        for name, frames in _AUTOMATIC.items()
    },
    **{
        f"coarse_{name}": functools.partial(presets.coarse_particles, name, frames)
        for name, frames in _COARSE.items()
    },
    **{f"asleep_{name}": functools.partial(presets.asleep, name) for name in _ASLEEP},
}


def main() -> int:
    """Measure; 1 if a result changed by more than it may."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rows", nargs="+", default=list(ALL), choices=list(ALL))
    parser.add_argument("--rounds", type=int, default=7, help="that count, after a first one")
    options = parser.parse_args()
    rows = json.loads(TARGET.read_text())["rows"] if TARGET.exists() else {}
    for name in options.rows:
        rows[name] = ALL[name](options.rounds)
        print(report.line(rows[name]), flush=True)
        report.write(TARGET, {key: rows[key] for key in ALL if key in rows})
    return int(not all(report.is_green(rows[name]) for name in options.rows))


if __name__ == "__main__":
    sys.exit(main())
