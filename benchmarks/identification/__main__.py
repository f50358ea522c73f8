"""How well, how surely and how fast parameters are found: the cases of the literature.

    python -m benchmarks.identification [--cases NAME …] [--tiers self cross] [--views N] [--jobs N]

prints one table and writes it to `benchmarks/results/identification_cpu.json` and `.md`; rows of
cases that were not run now are kept, and the remark that stands in the file. In the tier "self"
the data are made with the estimator's own discretisation, in the tier "cross" with other particles,
spacing / 1.5 and half the time step. Each case runs in a process of its own, with `--jobs N` on one
core each and N at once.
"""

import argparse
import json
import os
import queue
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from benchmarks.identification import report
from benchmarks.identification.cases import all_cases

RESULTS = Path(__file__).parents[1] / "results"


def main() -> int:
    """Run the cases and store what came out."""
    cases = all_cases()
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", nargs="+", default=list(cases), choices=list(cases))
    parser.add_argument("--tiers", nargs="+", default=["self", "cross"], choices=["self", "cross"])
    parser.add_argument("--views", type=int, default=1, help="cameras of the picture cases")
    parser.add_argument("--jobs", type=int, default=1, help="cases at once, on one core each")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    target = options.out / "identification_cpu.json"
    known = json.loads(target.read_text()) if target.exists() else {"rows": []}
    remark = known.get("remark", "")
    rows = {(row["case"], row["tier"], row["views"]): row for row in known["rows"]}
    wanted = [
        (name, tier, options.views if cases[name].views else 0)
        for name in options.cases
        for tier in options.tiers
    ]
    cores: queue.Queue[set[int] | None] = queue.Queue()
    for core in sorted(os.sched_getaffinity(0))[: options.jobs]:
        cores.put({core} if options.jobs > 1 else None)
    with ThreadPoolExecutor(cores.qsize()) as pool:
        runs = [pool.submit(_run, *one, cases[one[0]].double, cores) for one in wanted]
        for done in as_completed(runs):
            row = done.result()
            rows[row["case"], row["tier"], row["views"]] = row
            print(report.line(row), flush=True)
            ordered = sorted(rows.values(), key=lambda row: _place(cases, row))
            report.write(options.out, ordered, remark)
    return 0


def _place(cases: dict, row: dict) -> tuple[int, bool, int]:
    """Where a row stands in the table."""
    return list(cases).index(row["case"]), row["tier"] == "cross", row["views"]


def _run(name: str, tier: str, views: int, double: bool, cores: queue.Queue) -> dict:
    """One row, from a process that is bound to one of the free cores, if to any."""
    command = [sys.executable, "-m", "benchmarks.identification.worker", name, tier, str(views)]
    env = {**os.environ, "JAX_ENABLE_X64": str(int(double)), "JAX_PLATFORMS": "cpu"}
    core = cores.get()
    try:
        bound = ["taskset", "-c", ",".join(map(str, core))] if core else []
        done = subprocess.run(bound + command, env=env, stdout=subprocess.PIPE, text=True)
    finally:
        cores.put(core)
    if done.returncode:
        failed = f"exit status {done.returncode}"
        return {"case": name, "tier": tier, "views": views, "error": failed}
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    sys.exit(main())
