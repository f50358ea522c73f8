"""A sweep against its members run one by one, on a CPU.

    python -m benchmarks.sweep [--quick] [--out FOLDER]

Three processes take turns: one runs the members one after the other on all threads, one sweeps
them on one device with all threads, one on a device for each core. The runs alone are of the same
compiled program, called again and again. What separate processes would take is measured on a few.
"""

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.processes import ROOT, Process
from benchmarks.speed.report import cpu, versions
from benchmarks.speed.table import note
from benchmarks.sweep.case import MATERIALS, Case

MODULE = "benchmarks.sweep.worker"
RESULTS = ROOT / "benchmarks" / "results"
FULL = [Case(m, 20, n, 10, 50) for m, n in zip(MATERIALS, (64, 16, 16), strict=True)]
SIZES = [Case(MATERIALS[0], side, n, 2, 50) for side, n in ((8, 64), (12, 64), (40, 8))]
QUICK = [Case(MATERIALS[0], 8, 8, 1, 10)]


@dataclasses.dataclass(frozen=True)
class Row:
    """One case: seconds per member, medians over rounds.

    Attributes:
        case: what was swept.
        alone: one after the other in one process.
        shared: in a sweep on one device.
        devices: in a sweep on a device for each core.
        whole: the same with laying out and compiling from the cache.
        processes: in a process of its own each; None if not measured.
        ratio: the median of the rounds' ratios, alone over devices.
        shared_ratio: alone over shared.
        apart: largest distance of a particle between sweep and run alone, m.
        size: edge of the block, m.
    """

    case: Case
    alone: float
    shared: float
    devices: float
    whole: float
    processes: float | None
    ratio: float
    shared_ratio: float
    apart: float
    size: float


def measured(case: Case, rounds: int, cores: int) -> Row:
    """All that is measured of one case."""
    split = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={cores}"}
    with (
        Process(cores, {"XLA_FLAGS": None}, MODULE) as one,
        Process(cores, split, MODULE) as many,
        tempfile.TemporaryDirectory() as folder,
    ):
        found = [p.ask("prepare", **dataclasses.asdict(case)) for p in (one, many)]
        assert found == [1, cores], found
        files = [str(Path(folder) / f"{name}.npy") for name in ("alone", "shared", "devices")]
        seconds: dict[str, list[float]] = {"alone": [], "shared": [], "devices": [], "whole": []}
        for _ in range(rounds):
            seconds["alone"].append(one.ask("one_by_one", file=files[0]))
            seconds["shared"].append(one.ask("sweep", file=files[1])["seconds"])
            answer = many.ask("sweep", file=files[2])
            seconds["devices"].append(answer["seconds"])
            seconds["whole"].append(answer["whole"])
            note(f"{case}: { {name: round(a[-1], 2) for name, a in seconds.items()} }")
        alone, *others = (np.load(file) for file in files)
        apart = max(float(np.max(np.abs(x - alone))) for x in others)
    ratios = [
        [a / b for a, b in zip(seconds["alone"], seconds[name], strict=True)]
        for name in ("devices", "shared")
    ]
    each = {name: statistics.median(a) / case.members for name, a in seconds.items()}
    size = float(np.ptp(alone[..., 0], axis=1).max())
    return Row(
        case,
        **each,
        processes=None,
        ratio=statistics.median(ratios[0]),
        shared_ratio=statistics.median(ratios[1]),
        apart=apart,
        size=size,
    )


def in_processes(case: Case, count: int) -> float:
    """Seconds of a process that runs one member and ends; the program is in JAX's cache."""
    command = [sys.executable, "-m", MODULE, json.dumps(dataclasses.asdict(case))]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    environment.pop("XLA_FLAGS", None)
    seconds = []
    for _ in range(count + 1):
        began = time.perf_counter()
        subprocess.run(command, check=True, cwd=ROOT, env=environment, capture_output=True)
        seconds.append(time.perf_counter() - began)
    # The first one compiles.
    return statistics.median(seconds[1:])


def page(rows: list[Row], facts: dict[str, Any]) -> str:
    """The Markdown page."""
    lines = [
        "# A sweep against its members run one by one",
        "",
        f"Written by `{facts['command']}` on {facts['date']}: {facts['cores']} cores of "
        f"{facts['cpu']}; "
        + ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
        + ". Processes that ran or waited to run meanwhile, these among them: "
        f"{min(facts['load']):.0f} to {max(facts['load']):.0f} (load average).",
        "",
        "A block of eight particles per cell is thrown on the floor, with as many stiffnesses and "
        "Poisson's ratios as members; float32, quadratic splines, MLS, the same time step for all. "
        "Seconds per member, medians of rounds in which the ways take turns: *alone*, the compiled "
        "program of one member called for one after the other, on all threads; *one device*, "
        "`pgjax.sweep` in the same process; *a device per core*, `pgjax.sweep` with as many CPU "
        "devices as cores (what `pgjax sweep` does); *with all*, the same with laying out and "
        "compiling from the cache; *processes*, a process for each member that starts, compiles "
        "from the cache and runs. The ratios are medians of the rounds' ratios. *Apart*: the "
        "largest distance of a particle from where it is alone, in sizes of the body.",
        "",
        "| material | particles | members | steps | alone | one device | a device per core "
        "| with all | processes | alone / one device | alone / a device per core | apart |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        case = row.case
        steps = case.frames * case.substeps
        cells = [case.material, f"{case.particles:,}".replace(",", " "), str(case.members)]
        cells += [
            str(steps),
            *(f"{a:.3f}" for a in (row.alone, row.shared, row.devices, row.whole)),
        ]
        cells += ["–" if row.processes is None else f"{row.processes:.1f}"]
        cells += [f"{row.shared_ratio:.2f}", f"{row.ratio:.2f}", f"{row.apart / row.size:.1e}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sweep", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, to see that it runs")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    options = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    rows, load = [], [os.getloadavg()[0]]
    for place, case in enumerate(QUICK if options.quick else FULL + SIZES):
        row = measured(case, 2 if case in FULL else 3, cores)
        if place == 0:
            row = dataclasses.replace(row, processes=in_processes(case, 1 if options.quick else 3))
        rows.append(row)
        load.append(os.getloadavg()[0])
    facts = {
        "command": "python -m benchmarks.sweep" + (" --quick" if options.quick else ""),
        "date": time.strftime("%Y-%m-%d"),
        "cpu": cpu(),
        "cores": cores,
        "load": load,
        "versions": versions(("pgjax", "jax", "jaxlib", "numpy")),
    }
    content = {"about": facts, "rows": [dataclasses.asdict(row) for row in rows]}
    (options.out / "sweep_cpu.json").write_text(json.dumps(content, indent=1) + "\n")
    (options.out / "sweep_cpu.md").write_text(page(rows, facts))
    print(page(rows, facts))


if __name__ == "__main__":
    main()
