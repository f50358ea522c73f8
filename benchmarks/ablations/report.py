"""The stored table: JSON and Markdown."""

import datetime
import importlib.metadata
import json
import os
import platform
from pathlib import Path
from typing import Any

from benchmarks.speed.report import cpu

Row = dict[str, Any]

# Rounding in single precision over a rollout.
_ROUNDING = 1e-6


def is_green(row: Row) -> bool:
    """Whether the result changed by no more than it may."""
    return row["bound"] is None or row["change"] <= max(row["bound"], _ROUNDING)


def line(row: Row) -> str:
    """A row for the terminal."""
    if "at most" in row:
        return f"{row['what']}, {row['scene']}: {row['note']}"
    return (
        f"{row['what']}: {row['times faster']:.2f} times faster, memory "
        f"{row['memory without'] / row['memory']:.2f} times smaller, change {row['change']:.1e}"
        + ("" if is_green(row) else f"  ABOVE {row['bound']:g}")
    )


def write(target: Path, rows: dict[str, Row]) -> None:
    """Write both files."""
    about = {
        "command": "python -m benchmarks.ablations",
        "date": datetime.date.today().isoformat(),
        "cpu": cpu(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "jax": importlib.metadata.version("jax"),
    }
    target.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n")
    target.with_suffix(".md").write_text(_markdown(about, rows))


def _markdown(about: dict[str, Any], rows: dict[str, Row]) -> str:
    timed = [row for row in rows.values() if "at most" not in row]
    asleep = [row for row in rows.values() if "at most" in row]
    return "\n".join(
        [
            "# Only what a scene needs",
            "",
            f"`{about['command']}`; {about['cores']} cores of {about['cpu']}, JAX {about['jax']}, "
            f"{about['date']}, single precision, native kernels. Each saving is measured in turns "
            "with the same scene without it, after a first run of both; medians, and the median of "
            "the rounds' ratios. Memory is what XLA says a program takes, makes and needs between. "
            "*Change*: root mean square distance of the final places over that of the ways; its "
            "bound, where it has one. Tests show that the result is the same.",
            "",
            "| saving | scene | times faster | seconds without, with | memory without, with, MB | "
            "change | bound | test |",
            "|---|---|--:|--:|--:|--:|--:|---|",
            *(_row(row) for row in timed),
            "",
            *(f"- {row['what']}, {row['scene']}: {row['note']}." for row in timed if "note" in row),
            "",
            "## Not done: sleeping particles",
            "",
            "Particles that lie still could be left out until a neighbour moves. What that could "
            "save at most, over whole runs of the scenes that come to rest:",
            "",
            *(f"- {row['scene']}: {row['note']}." for row in asleep),
            "",
        ]
    )


def _row(row: Row) -> str:
    bound = "–" if row["bound"] is None else f"{max(row['bound'], _ROUNDING):.0e}"
    cells = (
        row["what"],
        row["scene"],
        f"{row['times faster']:.2f}",
        f"{row['seconds without']:.3g}, {row['seconds']:.3g}",
        f"{row['memory without'] / 1e6:.3g}, {row['memory'] / 1e6:.3g}",
        f"{row['change']:.1e}",
        bound,
        row["test"],
    )
    return "| " + " | ".join(cells) + " |"
