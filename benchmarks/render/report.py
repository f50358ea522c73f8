"""The stored results: JSON, Markdown and a picture."""

import dataclasses
import datetime
import json
import os
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.render.cases import QUANTITIES
from benchmarks.render.measure import BOUND, LONG, OWN, PEER, TOO_LONG, Record
from benchmarks.speed.report import cpu, versions
from benchmarks.speed.table import number

PACKAGES = ("pgjax", "jax", "jaxlib", "numpy", "torch", "gsplat")
CLOCKS = {
    "wall": "Times",
    "cpu": "Times, those of the processor as other programs ran beside,",
}
COLORS = {OWN: "#1b6ca8", PEER: "#d1495b"}
MIB = 2**20
Cells = Callable[[Record], list[Any]]


def shown(arguments: list[str]) -> list[str]:
    """The arguments without the names of folders, which are those of one machine."""
    result = list(arguments)
    for name in ("--data", "--out", "--pictures"):
        if name in result[:-1]:
            result[result.index(name) + 1] = "DIR"
    return result


def tables(records: list[Record]) -> str:
    """All numbers: times, then memory and compilation, then how far the codes are apart."""
    parts = [
        _table("time, ms", records, _time_heads(), _times),
        _table("memory of a call, MiB; compilation, s", records, _memory_heads(), _memory),
    ]
    compared = [record for record in records if record.off]
    if compared:
        heads = list(dict.fromkeys(name for record in compared for name in record.off))
        cells: Cells = lambda record: [record.off.get(name) for name in heads]  # noqa: E731
        parts.append(_table("PyTorch off pgjax", compared, heads, cells))
    return "\n".join(parts)


def _table(title: str, records: list[Record], heads: list[str], cells: Cells) -> str:
    columns = [title, "Gaussians", "image", "pairs per pixel", "threads", *heads]
    lines = ["| " + " | ".join(columns) + " |", "|---|" + "--:|" * (len(columns) - 1)]
    for record in records:
        case = [
            record.scene,
            f"{record.gaussians:,}".replace(",", " "),
            f"{record.size}²",
            f"{record.pairs_per_pixel:.0f}",
            str(record.threads),
        ]
        lines.append("| " + " | ".join([*case, *map(number, cells(record))]) + " |")
    return "\n".join(lines) + "\n"


def _time_heads() -> list[str]:
    heads = [f"{code} {quantity}" for code in (OWN, PEER) for quantity in QUANTITIES]
    return heads + [f"ratio {quantity}" for quantity in QUANTITIES]


def _times(record: Record) -> list[float | None]:
    times = [record.milliseconds.get(code, {}).get(q) for code in (OWN, PEER) for q in QUANTITIES]
    return times + [record.ratio(quantity) for quantity in QUANTITIES]


def _memory_heads() -> list[str]:
    heads = [f"{code} {quantity}" for code in (OWN, PEER) for quantity in QUANTITIES]
    heads += [f"XLA's part {quantity}" for quantity in QUANTITIES]
    return heads + [f"compile {quantity}" for quantity in QUANTITIES]


def _memory(record: Record) -> list[float | None]:
    found = [record.peak.get(code, {}).get(q) for code in (OWN, PEER) for q in QUANTITIES]
    found += [record.temporary[q] for q in QUANTITIES]
    mebibytes = [None if value is None else value / MIB for value in found]
    return [*mebibytes, *(record.compilation[q] for q in QUANTITIES)]


def page(records: list[Record], facts: dict[str, Any]) -> str:
    """The Markdown page."""
    packages = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    left_out = [
        f"- {record.scene}, {record.size}², {record.threads} thread(s), {quantity}: {reason}."
        for record in records
        for quantity, reason in record.left_out.items()
    ]
    missing = "Left out of PyTorch:\n\n" + "\n".join(left_out) + "\n\n" if left_out else ""
    return (
        "# Rendering on a CPU\n\n"
        f"Written by `{facts['command']}` on {facts['date']}: {facts['cpu']}, "
        f"{facts['system']}; {packages}; {facts['kernels']} kernels.\n\n"
        "The whole object is in the frame, single precision, rule of 3D Gaussian Splatting. "
        "*Landscape* is procedural, with flat Gaussians on hills. *Pairs per pixel*: pairs "
        "(Gaussian, tile) × pixels of a tile / pixels of the image, what rays that end early do "
        "not look at included. *Forward*: the colours. *Tangent*: colours and their derivative "
        "along one random direction of all means. *Gradient*: of a weighted sum of the colours "
        "with respect to means, factors, opacities and harmonics, forward pass included. "
        f"{CLOCKS[facts['clock']]} are medians of rounds in which the codes take turns after a "
        f"call of each ({facts['rounds']} rounds; where a pass of PyTorch takes more than "
        f"{LONG:.0f} s, its first call is the only one, and above {TOO_LONG:.0f} s it is left "
        "out). *Ratio*: time of PyTorch over that of pgjax.\n\n"
        "*PyTorch*: projection and harmonics are gsplat's own in pure PyTorch, whose compositing "
        "needs CUDA. The compositing is that of `benchmarks/render/with_torch.py`: lists by tiles "
        "of 8² pixels from the exact box of each ellipse, all tiles at once and 16 Gaussians at a "
        "time, tiles whose rays have ended dropped; derivatives by autograd and its forward mode. "
        f"It is timed if 99.9 % of its colours are within {BOUND:.0e} of those of pgjax. The "
        "last table has the largest difference, which is that of single Gaussians on the other "
        "side of the cutoff or the end of a ray, and for the derivatives the norm of the "
        "difference over that of pgjax (of the gradient: the largest of the four parts).\n\n"
        "*Memory*: growth of the process at its peak in one of the first two calls, result "
        "included (of PyTorch, the first loads some 15 MiB of libraries); *XLA's part*: its "
        "temporary arrays as it plans them, without what the kernels allocate. *Compile*: tracing "
        "included, no cache of programs, kernels built before.\n\n"
        f"{missing}![Time against the number of Gaussians](render_cpu.png)\n\n" + tables(records)
    )


def store(records: list[Record], about: dict[str, Any], folder: Path) -> None:
    """Write `render_cpu.json`, `.md` and `.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    facts = about | {
        "date": datetime.date.today().isoformat(),
        "cpu": cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version()} | versions(PACKAGES),
    }
    content = facts | {"rows": [dataclasses.asdict(record) for record in records]}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    (folder / "render_cpu.json").write_text(text + "\n", encoding="utf-8")
    (folder / "render_cpu.md").write_text(page(records, facts), encoding="utf-8")
    draw(records, folder / "render_cpu.png")


def draw(records: list[Record], file: Path) -> None:
    """Time against the number of Gaussians: a panel per image size, on the fewest threads."""
    threads = min(record.threads for record in records)
    records = sorted((r for r in records if r.threads == threads), key=lambda r: r.gaussians)
    sizes = sorted({record.size for record in records})
    figure = Figure(figsize=(5.5 * len(sizes), 4), layout="constrained")
    panels = figure.subplots(1, len(sizes), sharex=True, sharey=True, squeeze=False)
    for axes, size in zip(panels[0], sizes, strict=True):
        _curves(axes, [record for record in records if record.size == size])
        axes.set_title(f"{size}² pixels, {threads} thread" + "s" * (threads > 1))
    panels[0][0].set_ylabel("ms")
    panels[0][0].legend(fontsize=8)
    figure.savefig(file, dpi=150)


def _curves(axes: Any, records: list[Record]) -> None:
    """A colour per code; solid for the image, dashed for the gradient."""
    for code in (PEER, OWN):
        for quantity, line in (("gradient", "s--"), ("forward", "o-")):
            points = [
                (record.gaussians, record.milliseconds[code][quantity])
                for record in records
                if quantity in record.milliseconds.get(code, {})
            ]
            if points:
                label = f"{code} {quantity}"
                axes.plot(*zip(*points, strict=True), line, label=label, color=COLORS[code])
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("Gaussians")
    axes.grid(alpha=0.3)
