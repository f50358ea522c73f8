"""The stored results: JSON, and made from it Markdown and pictures."""

import dataclasses
import json
import os
import platform
from pathlib import Path
from typing import Any

from benchmarks.speed.report import cpu, versions
from benchmarks.work_precision import plots
from benchmarks.work_precision.table import Panel, details, headline, percent, read_panel

STEM = "work_precision_cpu"
RESULTS = Path(__file__).parents[1] / "results"
# What says most, in one picture for the documentation.
SUMMARY = RESULTS.parents[1] / "docs" / "images" / "work-precision.png"
COMMAND = "python -m benchmarks.work_precision"
PACKAGES = ("pgjax", "jax", "jaxlib", "numpy", "taichi", "warp-lang")


def machine() -> dict[str, Any]:
    """What is needed to judge the times."""
    return {
        "cpu": cpu(),
        "threads": 1,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {"python": platform.python_version()} | versions(PACKAGES),
    }


def load(folder: Path) -> dict[str, Any]:
    """What is stored; nothing yet if there is no file."""
    file = folder / f"{STEM}.json"
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"cases": {}}


def keep(name: str, case: dict[str, Any], folder: Path) -> None:
    """Put one case into the file, in place of what it held of it."""
    folder.mkdir(parents=True, exist_ok=True)
    cases = load(folder)["cases"] | {name: case}
    content = machine() | {"cases": dict(sorted(cases.items()))}
    text = json.dumps(content, indent=1, ensure_ascii=False)
    (folder / f"{STEM}.json").write_text(text + "\n", encoding="utf-8")


def draw_up(folder: Path) -> None:
    """The page and the pictures of what is stored."""
    content = load(folder)
    for name, case in content["cases"].items():
        plots.draw(panels(case), folder / picture(name))
    cases = content["cases"]
    if folder == RESULTS and {"WP1", "WP9"} <= set(cases):
        first = [_shorter(panels(cases["WP1"])[0]), *panels(cases["WP9"])]
        plots.draw(first, SUMMARY)
    (folder / f"{STEM}.md").write_text(page(content), encoding="utf-8")


def panels(case: dict[str, Any]) -> list[Panel]:
    """Those of a stored case."""
    return [read_panel(panel) for panel in case["panels"]]


def _shorter(panel: Panel) -> Panel:
    """The panel over wall time alone."""
    return dataclasses.replace(panel, over=("seconds",))


def picture(name: str) -> str:
    """File of the picture of a case."""
    return f"work_precision_{name.lower()}.png"


def page(content: dict[str, Any]) -> str:
    """The Markdown page."""
    facts = ", ".join(f"{name} {version}" for name, version in content["versions"].items())
    sections = [section(name, case) for name, case in content["cases"].items()]
    return (
        "# Work and precision on a CPU\n\n"
        f"Written by `{COMMAND}`: one thread of {content['cpu']}, {content['system']}; {facts}. "
        "What follows from it: [speed against error](../../docs/speed-against-error.md).\n\n"
        "Single precision, quadratic MLS, 2 particles in each direction of a cell and half the "
        "bound of the time step where nothing else is said. *Time* is the median of five runs of "
        "the compiled rollout (three where one takes more than 5 s), of its steps alone: without "
        "the manufactured force of the standing wave, which no simulation has. *With gradient*: "
        "value and gradient of a number at the end with respect to all initial velocities and "
        "Young's modulus, checkpointed in blocks of √T steps. *Memory* is the temporary memory of "
        "the compiled program as XLA plans it. *Time to an error* is interpolated, "
        "logarithmically, between the points of a series that no other one beats; ≤ where the "
        "coarsest is better already. Errors that are less than three times the uncertainty of the "
        "reference are in brackets, and grey in the pictures.\n\n" + "\n".join(sections)
    )


def section(name: str, case: dict[str, Any]) -> str:
    """One case: its picture, the time to each error, all points."""
    parts = [
        f"## {name}: {case['title']}\n\nMeasured on {case['date']}, "
        f"{case['minutes']:.1f} minutes.\n\n![{case['title']}]({picture(name)})\n"
    ]
    for panel in panels(case):
        known = f" ± {percent(panel.uncertainty)}" if panel.uncertainty else ""
        parts.append(
            f"### {panel.title}\n\nError: {panel.error}. Reference: {panel.reference}{known}.\n\n"
            f"{headline(panel)}\n<details><summary>All points</summary>\n\n{details(panel)}\n"
            "</details>\n"
        )
    return "\n".join(parts)
