"""The stored results: JSON, Markdown and a picture."""

import dataclasses
import datetime
import importlib.metadata
import json
import os
import platform
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.speed import cases
from benchmarks.speed.table import COLUMNS, Row, markdown

PACKAGES = ("pgjax", "jax", "jaxlib", "numpy", "taichi", "warp-lang")
COLORS = ("#1b6ca8", "#7fb2d9", "#d1495b", "#e8a0a8", "#6a994e")


def about(command: str, kernels: str) -> dict[str, Any]:
    """What is needed to repeat the measurement and to judge it."""
    return {
        "command": command,
        "date": datetime.date.today().isoformat(),
        "cpu": cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version()} | versions(PACKAGES),
        "kernels": kernels,
        "precision": "float32",
        "spline": "quadratic",
        "particles per cell": 8,
        "grid": {f"{side**3}": [cases.grid_cells(side)] * 3 for side in cases.SIZES.values()},
        "dt": cases.DT,
        "h": cases.H,
    }


def versions(packages: tuple[str, ...]) -> dict[str, str]:
    """Of those that are installed."""
    found = {}
    for name in packages:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def cpu() -> str:
    """Model of the CPU, with family and model number where the name alone says little."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    facts = {k.strip(): v.strip() for k, _, v in (line.partition(":") for line in lines)}
    name = facts.get("model name", platform.processor())
    wide = ", AVX-512" if "avx512f" in facts.get("flags", "") else ""
    return f"{name} (family {facts.get('cpu family')}, model {facts.get('model')}{wide})"


def page(rows: list[Row], facts: dict[str, Any]) -> str:
    """The Markdown page."""
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    grids = ", ".join(
        f"{int(n):,} particles: {shape[0]}³".replace(",", " ") for n, shape in facts["grid"].items()
    )
    return (
        "# Speed on a CPU\n\n"
        f"Written by `{facts['command']}` on {facts['date']}: {facts['cores']} cores of "
        f"{facts['cpu']}, {facts['system']}; {versions}; {facts['kernels']} kernels.\n\n"
        "A block of eight particles per cell, strained, turning and sliding in the corner of a "
        f"box, float32, quadratic splines, particles in the order of a lattice; grids: {grids}. "
        "All codes run the same trajectory. Times are medians of rounds in which the codes take "
        "turns; a ratio is the median of the rounds' ratios. *MLS over this code*: time of pgjax "
        "MLS over that of the column. *Position off*: root mean square difference of the "
        f"positions after at most 50 steps over that of the distances travelled. *Taichi "
        "serialised* runs P2G on one thread (`serialize=True`), *Taichi atomics* with its "
        "default. Warp's CPU kernels use one thread. Stages are compiled each for itself. "
        "*Compilation*: first call of `simulate` less the second, in a new process, the native "
        "kernels built before. *Gradient*: of a weighted mean of the final positions with respect "
        "to all initial velocities and Young's modulus, forward pass included; its memory is "
        "XLA's temporary memory over the bytes of one state. *Off differences*: from the best of "
        "four central differences along one direction.\n\n"
        "![Time per particle and step by material, and by size](speed_cpu.png)\n\n" + markdown(rows)
    )


def store(rows: list[Row], command: str, kernels: str, folder: Path) -> None:
    """Write `speed_cpu.json`, `.md` and `.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    facts = about(command, kernels)
    content = facts | {"rows": [dataclasses.asdict(row) for row in rows]}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    (folder / "speed_cpu.json").write_text(text + "\n", encoding="utf-8")
    (folder / "speed_cpu.md").write_text(page(rows, facts), encoding="utf-8")
    draw(rows, folder / "speed_cpu.png")


def draw(rows: list[Row], file: Path) -> None:
    """Bars by material and code at one size, and the cost against the number of particles."""
    costs = [row for row in rows if row.quantity == "forward" and row.threads == 1]
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _bars(left, costs)
    _curves(right, costs)
    figure.savefig(file, dpi=150)


def _bars(axes: Any, costs: list[Row]) -> None:
    """One group per material, at 64 000 particles or the size nearest to them."""
    shown = min({row.particles for row in costs}, key=lambda n: abs(n - 64000))
    costs = [row for row in costs if row.particles == shown]
    used = [name for name in COLUMNS if any(name in row.values for row in costs)]
    width = 0.8 / len(used)
    for i, name in enumerate(used):
        places = [j + (i - (len(used) - 1) / 2) * width for j in range(len(costs))]
        heights = [row.values.get(name, 0) for row in costs]
        bars = axes.bar(places, heights, width, label=name, color=_color(name))
        axes.bar_label(bars, [f"{h:.0f}" if h else "" for h in heights], fontsize=6)
    axes.set_xticks(range(len(costs)), [row.material for row in costs])
    axes.set_ylabel("ns per particle and step, one thread")
    axes.set_title(f"{shown:,} particles".replace(",", " "))
    axes.legend(fontsize=8)


def _curves(axes: Any, costs: list[Row]) -> None:
    """One curve per code of the first material."""
    material = costs[0].material
    costs = [row for row in costs if row.material == material]
    for name in COLUMNS:
        points = [(row.particles, row.values[name]) for row in costs if name in row.values]
        if points:
            axes.plot(*zip(*points, strict=True), "o-", label=name, color=_color(name))
    axes.set_xscale("log")
    axes.set_ylim(0, 1.1 * max(cost for row in costs for cost in row.values.values()))
    axes.set_xlabel("particles")
    axes.set_title(material)


def _color(name: str) -> str:
    return COLORS[COLUMNS.index(name)]
