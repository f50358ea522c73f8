"""The keys of PhysGaussian's configuration files: names, types, ranges and defaults.

The names are those of the reference, its misspelt ones (`init_azimuthm`, `max_partciels_per_cell`)
included. The reference passes over keys it does not know; here they are errors.
"""

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pgjax._files import is_file, read_text
from pgjax.scenes.physgaussian.boundaries import BoundaryPart, boundary
from pgjax.scenes.physgaussian.common import flag, renamed
from pgjax.scenes.reader import REQUIRED, SceneError, Table, missing_file
from pgjax.scenes.regions import Triple

MATERIALS = ("jelly", "metal", "sand", "foam", "snow", "plasticine")
"""The materials by name."""

# The place the reference centres every object at, which is the middle of this domain only.
DOMAIN = 2.0
_LONGEST_FILE = 1 << 20
_DIRECTIONS = {"at_least": -1, "at_most": 5}


@dataclasses.dataclass(frozen=True)
class Extra:
    """A box of particles with other moduli; `size` is half its extent."""

    point: Triple
    size: Triple
    E: float
    nu: float
    density: float | None


@dataclasses.dataclass(frozen=True)
class Filling:
    """What is carried over of `particle_filling`, and the keys that are not."""

    n_grid: int
    per_cell: int
    max_particles: int
    boundary: tuple[float, ...] | None
    unused: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class View:
    """The camera: one of the capture (`index` ≥ 0), or an orbit that may move."""

    index: int
    center: Triple
    up: Triple
    azimuth: float | None
    elevation: float | None
    radius: float | None
    moves: bool
    delta: Triple
    show_hint: bool


@dataclasses.dataclass(frozen=True)
class Config:
    """A configuration file, read and checked; the names are those of its keys.

    Attributes:
        source: the name of the file, for messages.
        name: of the scene.
        g: a vector, or its size against the upward axis; None if it is not given.
        turns: rotations, degrees and number of the axis, one after the other.
        given: the keys that are in the file.
    """

    source: str
    name: str
    material: str
    grid_lim: float
    n_grid: int
    E: float
    nu: float
    density: float
    g: Triple | float | None
    yield_stress: float
    hardening: bool
    xi: float
    softening: float
    friction_angle: float
    plastic_viscosity: float
    rpic_damping: float
    grid_v_damping_scale: float
    extras: tuple[Extra, ...]
    boundaries: tuple[BoundaryPart, ...]
    substep_dt: float
    frame_dt: float
    frame_num: int
    opacity_threshold: float
    turns: tuple[tuple[float, int], ...]
    sim_area: tuple[float, ...] | None
    scale: float
    filling: Filling | None
    view: View
    given: frozenset[str]


def read_config(path: Path, *, legacy: bool = False) -> Config:
    """Read a configuration file.

    Args:
        path: the `.json` file.
        legacy: whether a domain that is not centred about the object is taken as it is.

    Raises:
        SceneError: the file is missing or no JSON; a key is unknown, missing, of the wrong type or
            out of range.
    """
    data = _content(path)
    conditions = data.get("boundary_conditions")
    if isinstance(conditions, list):
        named = [renamed(c) if isinstance(c, dict) else c for c in conditions]
        data["boundary_conditions"] = named
    return Table(path.name, data, path.parent).read(
        lambda t: _config(t, data, path.stem, legacy=legacy)
    )


def _content(path: Path) -> dict[str, Any]:
    """What is written in the file: whole numbers are integers, however they are written."""
    if not is_file(path):
        raise missing_file("Argument `config`", path)
    try:
        text = read_text(path, _LONGEST_FILE)
        data = json.loads(text, parse_float=_number, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} is not a JSON file: {error}.") from error
    if not isinstance(data, dict):
        raise SceneError(f"{path} must hold an object of keys, but holds a {type(data).__name__}.")
    return data


def _number(text: str) -> float:
    value = float(text)
    return int(value) if value.is_integer() and abs(value) < 2**53 else value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The keys of an object, those that are null left out; each may be there once."""
    doubled = [name for name, count in Counter(name for name, _ in pairs).items() if count > 1]
    if doubled:
        raise ValueError(f"it has the key `{doubled[0]}` twice")
    return {name: value for name, value in pairs if value is not None}


def _config(t: Table, data: Mapping[str, Any], name: str, *, legacy: bool) -> Config:
    grid_lim = t.number("grid_lim", DOMAIN, above=0)
    if grid_lim != DOMAIN and not legacy:
        raise t.error(
            "grid_lim", f"be {DOMAIN:g}, of which (1, 1, 1) is the middle (`--legacy` takes others)"
        )
    t.number("pic_damping", 0.0)
    return Config(
        source=t.name,
        name=name,
        material=t.choice("material", {m: m for m in MATERIALS}, "jelly"),
        grid_lim=grid_lim,
        n_grid=t.integer("n_grid", 50, at_least=8),
        E=t.number("E", 1e5, above=0),
        nu=_nu(t, 0.4),
        density=t.number("density", 200.0, above=0),
        g=_gravity(t),
        yield_stress=t.number("yield_stress", 0.0, at_least=0),
        hardening=flag(t, "hardening"),
        xi=t.number("xi", 0.0, at_least=0),
        softening=t.number("softening", 0.1, at_least=0),
        friction_angle=t.number("friction_angle", 25.0, at_least=0, below=90),
        plastic_viscosity=t.number("plastic_viscosity", 0.0, at_least=0),
        rpic_damping=_rpic(t),
        grid_v_damping_scale=t.number("grid_v_damping_scale", 1.1, above=0),
        extras=tuple(x.read(_extra) for x in t.tables("additional_material_params")),
        boundaries=_boundaries(t),
        substep_dt=t.number("substep_dt", 1e-4, above=0),
        frame_dt=t.number("frame_dt", 1e-2, above=0),
        frame_num=t.integer("frame_num", 100),
        opacity_threshold=t.number("opacity_threshold", 0.02, at_least=0, below=1),
        turns=_turns(t, data),
        sim_area=_area(t, "sim_area"),
        scale=t.number("scale", 1.0, above=0),
        filling=t.optional("particle_filling", lambda f: _filling(f, 4 * data.get("n_grid", 50))),
        view=_view(t),
        given=frozenset(data),
    )


def _nu(t: Table, default: Any) -> float:
    return t.number("nu", default, at_least=0, below=0.5)


def _gravity(t: Table) -> Any:
    return t.vector("g") if t.is_a("g", list) else t.number("g", None)


def _rpic(t: Table) -> float:
    value = t.number("rpic_damping", 0.0)
    if value > 1:
        raise t.error("rpic_damping", "be at most 1")
    return value


def _boundaries(t: Table) -> tuple[BoundaryPart, ...]:
    # Without any the files write an empty object.
    if t.is_a("boundary_conditions", dict):
        t.table("boundary_conditions").close()
        return ()
    return tuple(b.read(boundary) for b in t.tables("boundary_conditions"))


def _extra(t: Table) -> Extra:
    return Extra(
        point=t.vector("point"),
        size=t.vector("size", above=0),
        E=t.number("E", above=0),
        nu=_nu(t, REQUIRED),
        density=t.number("density", None, above=0),
    )


def _turns(t: Table, data: Mapping[str, Any]) -> tuple[tuple[float, int], ...]:
    """Degrees and axes, of which there must be as many."""
    axes: list[Any] = data.get("rotation_axis", [])
    count = len(axes) if isinstance(axes, list) else 0
    degrees = t.vector("rotation_degree", (), size=count)
    axes = list(t.vector("rotation_axis", (), size=count))
    if not t.has("rotation_degree") and axes:
        raise t.error("rotation_degree", f"hold {count} numbers, one for each `rotation_axis`")
    if any(axis not in (0, 1, 2) for axis in axes):
        raise t.error("rotation_axis", "hold axes, each 0, 1 or 2")
    return tuple((angle, int(axis)) for angle, axis in zip(degrees, axes, strict=True))


def _area(t: Table, key: str) -> tuple[float, ...] | None:
    """Bounds in each direction, the lower before the upper."""
    area = t.vector(key, None, size=6)
    if area is not None and not all(a < b for a, b in zip(area[::2], area[1::2], strict=True)):
        raise t.error(
            key, "be [xmin, xmax, ymin, ymax, zmin, zmax], each minimum below its maximum"
        )
    return area


def _filling(t: Table, n_grid: Any) -> Filling:
    method = {
        "density_threshold": t.number("density_threshold", 5.0, at_least=0),
        "search_threshold": t.number("search_threshold", 3.0, at_least=0),
        "search_exclude_direction": t.integer("search_exclude_direction", 5, **_DIRECTIONS),
        "ray_cast_direction": t.integer("ray_cast_direction", 4, **_DIRECTIONS),
        "boundary": _area(t, "boundary"),
        "smooth": flag(t, "smooth"),
        "visualize": flag(t, "visualize"),
    }
    return Filling(
        n_grid=t.integer("n_grid", n_grid),
        per_cell=t.integer("max_partciels_per_cell", 1),
        max_particles=t.integer("max_particles_num", 2_000_000),
        boundary=method["boundary"],
        unused=tuple(key for key in method if t.has(key)),
    )


def _view(t: Table) -> View:
    return View(
        index=t.integer("default_camera_index", 0, at_least=-1),
        center=t.vector("mpm_space_viewpoint_center", (1.0, 1.0, 1.0)),
        up=_direction(t, "mpm_space_vertical_upward_axis", (0.0, 0.0, 1.0)),
        azimuth=t.number("init_azimuthm", None),
        elevation=t.number("init_elevation", None, above=-90, below=90),
        radius=t.number("init_radius", None, above=0),
        moves=flag(t, "move_camera"),
        delta=(t.number("delta_a", 0.0), t.number("delta_e", 0.0), t.number("delta_r", 0.0)),
        show_hint=flag(t, "show_hint"),
    )


def _direction(t: Table, key: str, default: Triple) -> Triple:
    value = t.vector(key, default)
    if not any(value):
        raise t.error(key, "not be zero")
    return value
