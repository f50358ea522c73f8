"""A scene as it is set up, in one picture, before anything of it is simulated."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pgjax._files import replacing
from pgjax.render import prepare_surroundings
from pgjax.scenes.build import Plan
from pgjax.scenes.marks import Mark, domain, marks

# Across and up in each view, and how it is called.
_VIEWS = ((0, 2, "front (from -y)"), (1, 2, "side (from +x)"), (0, 1, "top (from +z)"))
_NAMES = ("x", "y", "z")
_SIZE, _DPI = (15.0, 8.4), 100
# Where the three-dimensional view is seen from, degrees.
_ELEVATION, _AZIMUTH = 22, -60


def preview(plan: Plan, path: Path) -> Path:
    """Write what a plan sets up as a PNG.

    Args:
        plan: the plan.
        path: of the picture; what is there is replaced.
    """
    drawn = figure(plan)
    with replacing(path) as temporary:
        drawn.savefig(temporary, format="png", dpi=_DPI)
    return path


def figure(plan: Plan) -> Figure:
    """The Gaussians from the scene's camera; beside them what acts on them from four sides."""
    made = Figure(figsize=_SIZE, layout="constrained")
    grid = made.add_gridspec(2, 4)
    _photo(plan, made.add_subplot(grid[:, :2]))
    found = marks(plan)
    places = (grid[0, 2], grid[0, 3], grid[1, 2])
    for (across, up, name), place in zip(_VIEWS, places, strict=True):
        axes = made.add_subplot(place)
        _flat(plan, found, axes, across, up)
        axes.set_title(name, fontsize=9)
    space: Any = made.add_subplot(grid[1, 3], projection="3d")
    _space(plan, found, space)
    handles = {mark.label: _handle(mark) for mark in found}
    made.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=8)
    return made


def _photo(plan: Plan, axes: Axes) -> None:
    """The first frame as `pgjax run` draws it."""
    camera = plan.camera(0)
    image = prepare_surroundings(plan.still, camera).render(
        plan.moving, background=plan.view.background
    )
    axes.imshow(np.clip(np.asarray(image.rgb), 0, 1))
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(f"{plan.name}: the first frame", fontsize=10)
    shape = " x ".join(map(str, plan.scene.grid.shape))
    axes.set_xlabel(
        f"{plan.scene.particle_count} particles, {shape} cells, {plan.frames} frames of "
        f"{plan.substeps} steps, {plan.fps:g} frames per second",
        fontsize=9,
    )


def _flat(plan: Plan, found: list[Mark], axes: Axes, across: int, up: int) -> None:
    """An orthographic view; the camera is in the one from the top."""
    pair = [across, up]
    lower, upper = domain(plan)
    points = [lower[pair], upper[pair]]
    for order, mark in enumerate(found):
        if mark.outside and up == 2:
            continue
        data = mark.data[..., pair]
        if mark.outside:
            points += list(data.reshape(-1, 2))
        _draw(axes, mark, data, order)
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    room = 0.04 * float(np.max(high - low))
    axes.set_xlim(low[0] - room, high[0] + room)
    axes.set_ylim(low[1] - room, high[1] + room)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
    axes.set_xlabel(f"{_NAMES[across]} (m)", fontsize=8)
    axes.set_ylabel(f"{_NAMES[up]} (m)", fontsize=8)


def _space(plan: Plan, found: list[Mark], axes: Any) -> None:
    """The view in three dimensions, with the camera."""
    lower, upper = domain(plan)
    points = [lower, upper]
    for order, mark in enumerate(found):
        if mark.outside:
            points += list(mark.data.reshape(-1, 3))
        elif mark.kind == "points":
            inside = np.all((mark.data >= lower) & (mark.data <= upper), axis=1)
            mark = mark._replace(data=mark.data[inside])
        _draw(axes, mark, mark.data, order)
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    for name, a, b in zip(_NAMES, low, high, strict=True):
        getattr(axes, f"set_{name}lim")(a, b)
    axes.set_box_aspect(high - low, zoom=1.15)
    axes.view_init(_ELEVATION, _AZIMUTH)
    axes.tick_params(labelsize=6, pad=-2)
    axes.set_title("with the camera", fontsize=9)


def _draw(axes: Any, mark: Mark, data: np.ndarray, order: int) -> None:
    """Points, lines or arrows, in two dimensions or in three."""
    style: dict[str, Any] = {"label": mark.label, "color": mark.colour, "zorder": 2 + order / 100}
    if mark.kind == "arrows":
        start, change = data[:, 0].T, (data[:, 1] - data[:, 0]).T
        flat = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.008}
        axes.quiver(*start, *change, **style, **(flat if len(start) == 2 else {}))
    elif mark.kind == "points":
        # Points, not squares: the area of a marker is its size squared.
        if mark.marker == ".":
            style |= {"linewidths": 0}
        axes.scatter(*data.T, s=mark.size**2, marker=mark.marker, alpha=mark.alpha, **style)
    else:
        for line in data:
            axes.plot(*line.T, lw=mark.size, alpha=mark.alpha, **style)


def _handle(mark: Mark) -> Any:
    """What stands for a mark in the legend."""
    from matplotlib.lines import Line2D

    if mark.kind == "points":
        return Line2D([], [], ls="", marker=mark.marker.replace(".", "o"), color=mark.colour, ms=5)
    if mark.kind == "arrows":
        return Line2D([], [], color=mark.colour, lw=2, marker=">", ms=5)
    return Line2D([], [], color=mark.colour, lw=mark.size)
