"""The stored results of tuning: JSON and Markdown."""

import datetime
import json
from pathlib import Path

import jax

from benchmarks.speed.report import cpu

COMMAND = "python -m benchmarks.tune"


def stored(path: Path) -> list[dict]:
    """The rows of before."""
    return json.loads(path.read_text())["rows"] if path.exists() else []


def line(row: dict) -> str:
    """A row, for the terminal."""
    head = f"{row['scene']} {_percent(row['asked'])}: "
    if row["setting"] is None:
        return head + "; ".join(row["notes"])
    return (
        f"{head}{row['setting']}; predicted {_percent(row['predicted'])} ± "
        f"{_percent(row['doubt'])}, true {_percent(row['true'])}; {1e3 * row['seconds']:.1f} ms a "
        f"frame, its own {1e3 * row['own_seconds']:.1f}"
    )


def write(path: Path, rows: list[dict]) -> None:
    """The table, as JSON and as Markdown."""
    machine = {
        "cpu": cpu(),
        "date": datetime.date.today().isoformat(),
        "jax": jax.__version__,
        "command": COMMAND,
    }
    path.write_text(json.dumps({**machine, "rows": rows}, indent=1) + "\n")
    lines = [
        "# Tuning",
        "",
        f"`{COMMAND}`; {machine['cpu']}, JAX {machine['jax']}, {machine['date']}. Each scene is "
        f"tuned twice; the setting that was chosen is then compared with a run on a grid that is "
        f"finer than all that were looked at for it. Errors are the largest over the frames of the "
        f"root mean square over the Gaussians, in the scale of the scene "
        f"([what that is](../../docs/choosing-step-and-spacing.md)); times are of the simulation "
        f"alone, without pictures, those of a row measured side by side; scenes may have been run "
        f"one by one, on machines of different speed. The demand: the true error is at most twice "
        f"what was asked.",
        "",
        "| scene | frames | asked | chosen | predicted | in doubt by | true | against | met | "
        "ms a frame | its own | true error of its own | times as fast |",
        "|---|---:|---:|---|---:|---:|---:|---|---|---:|---:|---:|---:|",
    ]
    lines += [_summary(row) for row in rows]
    said = [
        f"- {row['scene']}, {_percent(row['asked'])}: {t}" for row in rows for t in row["notes"]
    ]
    if said:
        lines += ["", "What was said of it:", "", *said]
    for row in rows:
        if row["table"]:
            lines += ["", f"Everything that was run for {row['scene']}:", ""]
            lines += ["| for | setting | particles | steps a frame | ms a frame | error |"]
            lines += ["|---|---|---:|---:|---:|---:|"]
            lines += [_cells(run) for run in row["table"]]
    path.with_suffix(".md").write_text("\n".join(lines) + "\n")


def _summary(row: dict) -> str:
    cells = [row["scene"], str(row["frames"]), _percent(row["asked"])]
    own = [f"{1e3 * row['own_seconds']:.1f}", _percent(row["own_true"])]
    if row["setting"] is None:
        cells += ["nothing: see below", "", _percent(row["doubt"]), "", row["reference"], "", ""]
        return "| " + " | ".join([*cells, *own, ""]) + " |"
    cells += [
        row["setting"],
        *map(_percent, (row["predicted"], row["doubt"], row["true"])),
        row["reference"],
        "yes" if row["true"] <= 2 * row["asked"] else "**no**",
        f"{1e3 * row['seconds']:.1f}",
        *own,
        f"{row['own_seconds'] / row['seconds']:.3g}",
    ]
    return "| " + " | ".join(cells) + " |"


def _cells(run: dict) -> str:
    error = "failed" if run["error"] is None else _percent(run["error"])
    cells = [run["what"], run["setting"], f"{run['particles']}", f"{run['substeps']}"]
    return "| " + " | ".join([*cells, f"{1e3 * run['seconds']:.1f}", error]) + " |"


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %"
