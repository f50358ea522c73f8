"""What it costs to share one scene: one device against two simulated ones, one thread each.

    python -m benchmarks.parallel [--sides 40] [--steps 20] [--rounds 7] [--out DIR]

writes `parallel_cpu.json` and `.md`. Simulated devices share caches and memory of one processor:
this says what the exchange and the bookkeeping cost, not how well many devices do.
"""

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

from benchmarks.speed.report import cpu, versions

ROOT = Path(__file__).parents[2]
PACKAGES = ("pgjax", "jax", "jaxlib", "numpy")
NOTE = (
    "A block of neo-Hookean material in the corner of a box (that of `benchmarks.speed`), float32, "
    "quadratic MLS, eight particles per cell in a grid of 64³ cells or more. Each device has one "
    "thread. *simulate*: `pgjax.simulate` on one device. *Slabs*: "
    "particles may change over after every step, and half as many places again as the fullest "
    "slab has particles; *nobody changes over*: the same without looking; *no empty places*: "
    "moreover as many places as particles. *Sum of the grid* and *five layers*: the exchange of a "
    "step by itself. The material fills a corner, so that one of two slabs is wide and mostly "
    "empty. *simulate* leaves out nodes without mass, which a shared scene does not. Two simulated "
    "devices share the memory of one processor: the numbers say what "
    "exchange and bookkeeping cost, not how many devices scale."
)


def measured(devices: int, side: int, steps: int, rounds: int) -> dict[str, float]:
    """Seconds of a step by name."""
    numbers = [str(n) for n in (devices, side, steps, rounds)]
    command = [sys.executable, "-m", "benchmarks.parallel.worker", *numbers]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode:
        raise RuntimeError(run.stderr[-2000:])
    return json.loads(run.stdout.strip().splitlines()[-1])


def table(rows: dict[str, dict[str, dict[str, float]]]) -> str:
    """Milliseconds of a step, and nanoseconds per particle of a rollout."""
    lines = ["| particles | what | 1 device, ms | 2 devices, ms |", "|--:|---|--:|--:|"]
    for particles, by_devices in rows.items():
        one, two = by_devices["1"], by_devices["2"]
        for name in dict.fromkeys([*one, *two]):
            cells = [f"{1e3 * d[name]:.3g}" if name in d else "–" for d in (one, two)]
            count = f"{int(particles):,}".replace(",", " ")
            lines.append(f"| {count} | {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def write(rows: dict[str, dict[str, dict[str, float]]], steps: int, rounds: int, out: Path) -> None:
    """The page and the numbers."""
    facts = {
        "command": "python -m benchmarks.parallel",
        "date": datetime.date.today().isoformat(),
        "cpu": cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version()} | versions(PACKAGES),
        "steps": steps,
        "rounds": rounds,
    }
    named = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    page = (
        "# One scene over several devices, on a CPU\n\n"
        f"Written by `{facts['command']}` on {facts['date']}: {facts['cores']} cores of "
        f"{facts['cpu']}, {facts['system']}; {named}. Medians of {rounds} rounds of "
        f"{steps} steps.\n\n{NOTE}\n\n{table(rows)}\n"
    )
    print(page)
    out.mkdir(parents=True, exist_ok=True)
    numbers = {"about": facts, "seconds of a step": rows}
    (out / "parallel_cpu.json").write_text(json.dumps(numbers, indent=1) + "\n")
    (out / "parallel_cpu.md").write_text(page)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sides", type=int, nargs="+", default=[40])
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results")
    options = parser.parse_args()
    steps, rounds = options.steps, options.rounds
    rows = {
        str(side**3): {str(n): measured(n, side, steps, rounds) for n in (1, 2)}
        for side in options.sides
    }
    write(rows, steps, rounds, options.out)


if __name__ == "__main__":
    main()
