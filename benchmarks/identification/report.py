"""The stored results: JSON, and the same as Markdown."""

import datetime
import json
from pathlib import Path

import jax

from benchmarks.speed.report import cpu

COMMAND = "python -m benchmarks.identification"


def line(row: dict) -> str:
    """A row, for the terminal."""
    head = f"{row['case']} ({row['tier']})"
    if "error" in row:
        return f"{head}: {row['error']}"
    parts = [
        f"{e['name']} {e['estimate']:.5g} (error {e['error']:.2g} {e['scale']}"
        + ("" if e["met"] is None else ", met" if e["met"] else f", demanded {e['demand']:g}")
        + f"; {e['verdict']})"
        for e in row["estimates"]
    ]
    return f"{head}: {', '.join(parts)}; {row['iterations']} iterations, {row['seconds']:.0f} s"


def write(folder: Path, rows: list[dict], remark: str = "") -> None:
    """Both files; the remark is what a reader of these numbers has to know."""
    folder.mkdir(parents=True, exist_ok=True)
    machine = {
        "cpu": cpu(),
        "date": datetime.date.today().isoformat(),
        "jax": jax.__version__,
        "command": COMMAND,
        "remark": remark,
    }
    (folder / "identification_cpu.json").write_text(
        json.dumps({**machine, "rows": rows}, indent=1) + "\n"
    )
    (folder / "identification_cpu.md").write_text(_markdown(machine, rows))


def _outside(row: dict, estimate: dict) -> str:
    """Whether the truth is not in the interval; without any noise that says nothing."""
    return "" if estimate["covers"] or row["tier"] == "self" else " (truth outside)"


def _markdown(machine: dict, rows: list[dict]) -> str:
    lines = [
        "# Identification",
        "",
        f"`{COMMAND}`; {machine['cpu']}, JAX {machine['jax']}, {machine['date']}. "
        "Tier *self*: data made with the estimator's own discretisation. Tier *cross*: other "
        "particles, spacing / 1.5, half the time step. Errors in decades (log10), as a part of the "
        "truth (relative), or absolute. Intervals are 95 %; *mismatch* is the derivative against "
        "the secant over the interval. The data have no noise: intervals of the tier *self* are "
        "those of rounding, of *cross* of the scatter between frames where that is wider. "
        "Iterations are counted over all stages; a tangent counts as a simulation.",
        "",
        *([machine["remark"], ""] if machine["remark"] else []),
        "| case | tier | unknown | truth | estimate | error | demanded | met | 95 % interval | "
        "mismatch | verdict |",
        "|---|---|---|---:|---:|---:|---:|---|---|---:|---|",
    ]
    for row in rows:
        if "error" in row:
            lines.append(f"| {row['case']} | {row['tier']} | {row['error']} |" + " |" * 8)
            continue
        for e in row["estimates"]:
            demand = "" if e["demand"] is None else f"{e['demand']:g} {e['scale']}"
            met = {None: "", True: "yes", False: "**no**"}[e["met"]]
            lines.append(
                f"| {row['case']} | {row['tier']} | {e['name']} | {e['truth']:.5g} | "
                f"{e['estimate']:.6g} | {e['error']:.2g} | {demand} | {met} | "
                f"{e['low']:.5g} … {e['high']:.5g}{_outside(row, e)} | "
                f"{e['mismatch']:.1%} | {e['verdict']} |"
            )
    lines += [
        "",
        "| case | tier | cameras | particles | steps | iterations | demanded | simulations | "
        "seconds | cores | ended |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    lines += [
        f"| {r['case']} | {r['tier']} | {r['views'] or 'positions'} | {r['particles']} | "
        f"{r['steps']} | {r['iterations']} | {r['limit'] or ''} | {r['simulations']} | "
        f"{r['seconds']:.0f} | {r['cores']} | {r['reason']} |"
        for r in rows
        if "error" not in r
    ]
    return "\n".join(lines) + "\n"
