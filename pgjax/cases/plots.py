"""The course of a fit as a picture."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pgjax._files import replacing
from pgjax.inverse import Fit

# Panels side by side, and parameters that are drawn at most: a field has too many.
_COLUMNS, _DRAWN = 3, 11


def plot_convergence(found: Fit, path: Path) -> list[str]:
    """Draw the cost and each parameter over the points that were tried, as a PNG.

    Args:
        found: the fit.
        path: of the picture.

    Returns:
        Names of the parameters that are drawn.
    """
    names = found.problem.names[:_DRAWN]
    rows = -(-(1 + len(names)) // _COLUMNS)
    figure = Figure(figsize=(3.2 * _COLUMNS, 2.3 * rows), layout="constrained")
    axes = figure.subplots(rows, _COLUMNS, sharex=True, squeeze=False).ravel()
    taken = np.array([trial.taken for trial in found.trials])
    _course(axes[0], "cost", np.array([trial.cost for trial in found.trials]), taken)
    axes[0].set_yscale("log")
    units = {name: unit for name, _, unit in found.rows()}
    logarithmic = found.problem.space.logarithmic
    for axis, name, log in zip(axes[1:], names, logarithmic, strict=False):
        known = [dict(zip(trial.names, trial.u, strict=True)) for trial in found.trials]
        course = np.array([u.get(name, np.nan) for u in known])
        unit = f" ({units[name]})" if units[name] else ""
        _course(axis, name + unit, np.exp(course) if log else course, taken)
        if log:
            axis.set_yscale("log")
        if found.uncertainty is not None:
            interval = found.uncertainty.interval(name)
            if np.isfinite(interval.low + interval.high):
                axis.axhspan(interval.low, interval.high, color="tab:green", alpha=0.25, lw=0)
    for axis in axes[1 + len(names) :]:
        axis.set_visible(False)
    for axis in axes[max(len(names) + 1 - _COLUMNS, 0) : len(names) + 1]:
        axis.set_xlabel("point")
        axis.tick_params(labelbottom=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    return names


def _course(axis: Axes, label: str, values: np.ndarray, taken: np.ndarray) -> None:
    """Points that were taken, joined, and those that were rejected."""
    numbers = np.arange(1, len(values) + 1)
    shown = np.isfinite(values)
    kept, lost = taken & shown, ~taken & shown
    axis.plot(numbers[kept], values[kept], "o-", color="tab:blue", ms=3.5, lw=1)
    axis.plot(numbers[lost], values[lost], "x", color="tab:red", ms=5)
    axis.set_title(label, fontsize=9)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.3)
