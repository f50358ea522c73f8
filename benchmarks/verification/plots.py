"""The curves of the verification as one picture: errors over the spacing of the grid."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

_COLUMNS = 3


def draw(curves: list[dict], path: Path) -> None:
    """One panel for each title, log-log, with a line of the order that theory gives."""
    curves = sorted(curves, key=lambda c: (c["case"], c["panel"], c["series"]))
    panels = {
        title: list(members)
        for title, members in itertools.groupby(curves, key=lambda c: (c["case"], c["panel"]))
    }
    rows = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(4.2 * _COLUMNS, 3.2 * rows), layout="constrained")
    axes = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for axis, ((case, panel), members) in zip(axes, panels.items(), strict=False):
        _panel(axis, f"{case} {panel}", members)
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    figure.savefig(path, dpi=110)


def _panel(axis: Any, title: str, curves: list[dict]) -> None:
    for curve in curves:
        axis.loglog(curve["x"], curve["y"], "o-", ms=3.5, lw=1.2, label=curve["series"])
    expected = [curve for curve in curves if curve["order"] is not None]
    for order in {curve["order"] for curve in expected}:
        x = np.array([min(min(c["x"]) for c in expected), max(max(c["x"]) for c in expected)])
        top = max(max(c["y"]) for c in expected)
        axis.loglog(x, top * (x / x[1]) ** order, "k:", lw=1, label=f"order {order:g}")
    axis.set_title(title, fontsize=10)
    axis.set_xlabel(curves[0]["over"])
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=7)
