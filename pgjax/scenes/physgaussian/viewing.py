"""The camera of a configuration file."""

import math
from typing import Any, NamedTuple

from pgjax.render import load_cameras
from pgjax.scenes.physgaussian.keys import Config, View
from pgjax.scenes.physgaussian.placing import Files
from pgjax.scenes.reader import SceneError

# What is drawn of materials that flow: sand stays grains.
_SAND_STRETCH = 1.25
_FLOWING = ("metal", "sand", "foam", "plasticine")


class Camera(NamedTuple):
    """The `[camera]` table of a scene file, and notes, a line each."""

    table: dict[str, Any]
    notes: list[str]


def camera(config: Config, files: Files, per_unit: float, *, legacy: bool) -> Camera:
    """The camera of the capture that the file names, or its orbit.

    Args:
        config: the file.
        files: where the cameras of the capture are.
        per_unit: of the capture's lengths, m.
        legacy: whether flow is not drawn, as in the reference.

    Raises:
        SceneError: the camera cannot be had.
    """
    view = config.view
    made = _shot(config, files) if view.index >= 0 else _orbit(config, files, per_unit)
    table, notes = made
    if config.material in _FLOWING:
        if legacy:
            table["max_stretch"] = 1.0
            notes.append("material: Gaussians turn but do not stretch, nearly as in the reference")
        else:
            if config.material == "sand":
                table["max_stretch"] = _SAND_STRETCH
            notes.append("material: Gaussians are drawn as they flowed (reference: elastic part)")
    if config.turns:
        notes.append("rotation_degree: colours of turning Gaussians are looked up in world axes")
    if view.show_hint:
        notes.append("show_hint: not used; `--dry-run` says what would be done")
    return made


def _shot(config: Config, files: Files) -> Camera:
    view, key = config.view, "default_camera_index"
    notes = [f"move_camera: not used, since `{key}` is {view.index}"] if view.moves else []
    if files.cameras is not None:
        return Camera({"file": str(files.cameras), "index": view.index}, notes)
    if files.alone:
        note = f"{key}: a .ply alone has no cameras, an orbit instead"
        return Camera({"target": list(view.center)}, [*notes, note])
    raise SceneError(
        f"{config.source}: `{key}` must be -1 (an orbit), since there is no cameras.json beside "
        f"the model, but is {view.index}."
    )


def _orbit(config: Config, files: Files, per_unit: float) -> Camera:
    """An orbit with the lens of the capture's first camera; radii are lengths of the capture."""
    view = config.view
    table: dict[str, Any] = {"target": list(view.center), **_lens(files)}
    notes = ["init_azimuthm: counts from +x about +z; where the reference starts is not documented"]
    if view.up[:2] != (0.0, 0.0) or view.up[2] < 0:
        notes.append(f"mpm_space_vertical_upward_axis: {list(view.up)} not honoured: +z is up")
    if view.azimuth is not None:
        table["azimuth"] = view.azimuth
    if view.elevation is not None:
        table["elevation"] = view.elevation
    if view.radius is not None:
        table["radius"] = view.radius * per_unit
        notes.append(f"init_radius: {view.radius:g} of the capture's units is {table['radius']:g}")
    if view.moves:
        _move(table, config, per_unit)
    return Camera(table, notes)


def _lens(files: Files) -> dict[str, Any]:
    if files.cameras is None:
        return {}
    first = next(iter(load_cameras(files.cameras).values()))
    opening = 2 * math.atan(first.height / (2 * float(first.fy)))
    return {"fov": math.degrees(opening), "width": first.width, "height": first.height}


def _move(table: dict[str, Any], config: Config, per_unit: float) -> None:
    """A steady turn; a key at each frame where elevation or radius change too."""
    view = config.view
    by_azimuth, by_elevation, by_radius = view.delta
    if not by_elevation and not by_radius:
        table["turn"] = by_azimuth / config.frame_dt
        return
    azimuth, elevation, radius = _start(view)
    for frame in (0, config.frame_num):
        _require_reached(config, "delta_e", elevation + frame * by_elevation, -90, 90)
        _require_reached(config, "delta_r", radius + frame * by_radius, 0, math.inf)
    table["keyframes"] = [
        {
            "time": frame * config.frame_dt,
            "azimuth": azimuth + frame * by_azimuth,
            "elevation": elevation + frame * by_elevation,
            "radius": (radius + frame * by_radius) * per_unit,
        }
        for frame in range(config.frame_num + 1)
    ]


def _start(view: View) -> tuple[float, float, float]:
    azimuth, elevation, radius = view.azimuth, view.elevation, view.radius
    if azimuth is None or elevation is None or radius is None:
        raise SceneError(
            "`init_azimuthm`, `init_elevation` and `init_radius` must be given where `delta_e` or "
            f"`delta_r` move the camera, but are {azimuth}, {elevation} and {radius}."
        )
    return azimuth, elevation, radius


def _require_reached(config: Config, key: str, value: float, above: float, below: float) -> None:
    if not above < value < below:
        raise SceneError(
            f"{config.source}: `{key}` must keep the camera between {above:g} and {below:g} in "
            f"all {config.frame_num} frames, but it reaches {value:g}."
        )
