"""Error against cost, one line per series."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.work_precision.table import COSTS, Panel, front

COLORS = ("#1b6ca8", "#d1495b", "#6a994e", "#e09f3e", "#7b5ea7", "#3a3a3a", "#4cb5ae", "#c77dba")
MARKERS = "osD^vP*X"
FRONT, GREY = "#f3d34a", "#b8b8b8"


def draw(panels: list[Panel], file: Path) -> None:
    """The panels beside each other, each as often as it has costs."""
    shown = [(panel, over) for panel in panels for over in panel.over]
    figure = Figure(figsize=(0.4 + 5.0 * len(shown), 4.4), layout="constrained")
    for axes, (panel, over) in zip(
        figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True
    ):
        fill(axes, panel, over)
    figure.savefig(file, dpi=120)


def fill(axes: Any, panel: Panel, over: str) -> None:
    """One panel. The front of all series together is underlaid; grey is what is not resolved."""
    best = [p for p in front(panel.points, over) if panel.resolved(p)]
    x, y = [getattr(p, over) for p in best], [p.error for p in best]
    axes.plot(x, y, color=FRONT, lw=9, alpha=0.5, solid_capstyle="round", zorder=0, label="front")
    for i, series in enumerate(panel.series):
        style = {"color": COLORS[i % len(COLORS)], "marker": MARKERS[i % len(MARKERS)], "ms": 5}
        points = [p for p in panel.of(series) if getattr(p, over) is not None]
        x, y = [getattr(p, over) for p in points], [p.error for p in points]
        axes.plot(x, y, "-", lw=1.4, label=series, **style)
        doubtful = [p for p in points if not panel.resolved(p)]
        x, y = [getattr(p, over) for p in doubtful], [p.error for p in doubtful]
        axes.plot(x, y, "", lw=0, **style | {"color": GREY})
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(COSTS[over][0])
    axes.set_ylabel(f"error: {panel.error}")
    axes.set_title(panel.title, fontsize=10)
    axes.grid(alpha=0.3, which="both", lw=0.5)
    axes.legend(fontsize=7.5)
