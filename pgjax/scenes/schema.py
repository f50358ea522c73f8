"""The scene file: which tables and keys there are, and what they become.

All lengths are in metres of the simulation: z points up, the simulated part of the model is
scaled to `model.size`, stands on z = 0 and is centred on x = y = 0. Angles are in degrees.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pgjax import models
from pgjax.boundary import (
    AbstractContact,
    Box,
    GridVelocity,
    HalfSpace,
    ParticleImpulse,
    ParticleVelocity,
    Separating,
    Slip,
    Sticky,
)
from pgjax.models import Material
from pgjax.scenes.reader import Table, parse
from pgjax.splines import BSpline
from pgjax.transfer import MLS, AbstractScheme, SplineGradient

Triple = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Region:
    """An axis-aligned box."""

    lower: Triple
    upper: Triple

    def contains(self, x: np.ndarray) -> np.ndarray:
        """Which points are in the box, faces included."""
        return np.all((x >= np.asarray(self.lower)) & (x <= np.asarray(self.upper)), axis=-1)


@dataclasses.dataclass(frozen=True)
class ModelPart:
    """Where the Gaussians come from and which of them move."""

    ply: Path | None
    procedural: str | None
    up: Triple | None
    opacity_above: float
    region: Region | None
    size: float
    velocity: Triple


@dataclasses.dataclass(frozen=True)
class GridPart:
    """The box of the grid and the discretisation on it."""

    lower: Triple
    upper: Triple
    spacing: float
    spline: BSpline
    scheme: AbstractScheme


@dataclasses.dataclass(frozen=True)
class TimePart:
    """Frames and time step."""

    frames: int
    fps: float
    dt: float | None
    fraction: float


@dataclasses.dataclass(frozen=True)
class CameraPart:
    """A camera on an orbit, and how the Gaussians are drawn."""

    target: Triple
    azimuth: float
    elevation: float
    radius: float
    turn: float
    fov: float
    width: int
    height: int
    background: Triple
    max_stretch: float


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """A scene file, read and checked."""

    name: str
    model: ModelPart
    grid: GridPart
    time: TimePart
    camera: CameraPart
    gravity: Triple
    grid_damping: float
    shear_damping: float
    materials: tuple[tuple[Material, Region | None], ...]
    boundaries: tuple[Callable, ...]
    # Each makes a condition from the positions of the particles.
    particle_conditions: tuple[Callable[[np.ndarray], Any], ...]


def read_scene(path: Path) -> SceneFile:
    """Read a scene file.

    Raises:
        SceneError: a key is unknown, missing, of the wrong type or out of range.
    """
    root = parse(path)
    return root.read(lambda table: _scene(table, path))


def _scene(root: Table, path: Path) -> SceneFile:
    name = root.text("name", path.stem)
    model = root.table("model").read(lambda t: _model(t, path.parent))
    forces = root.table("forces", {})
    gravity = forces.vector("gravity", (0.0, 0.0, 0.0))
    grid_damping = forces.number("grid_damping", 0.0, at_least=0)
    shear_damping = forces.number("shear_damping", 0.0, at_least=0)
    forces.close()
    materials = tuple(t.read(_material) for t in root.tables("material", required=True))
    if not materials:
        raise root.error("material", "hold at least one [[material]]")
    return SceneFile(
        name=name,
        model=model,
        grid=root.table("grid").read(_grid),
        time=root.table("time", {}).read(_time),
        camera=root.table("camera", {}).read(lambda t: _camera(t, model.size)),
        gravity=gravity,
        grid_damping=grid_damping,
        shear_damping=shear_damping,
        materials=materials,
        boundaries=tuple(t.read(_boundary) for t in root.tables("boundary")),
        particle_conditions=tuple(t.read(_particles) for t in root.tables("particles")),
    )


def _model(t: Table, folder: Path) -> ModelPart:
    ply, procedural = t.text("ply", None), t.text("procedural", None)
    if (ply is None) == (procedural is None):
        raise t.error("ply", "be given, or `procedural`, but not both")
    up = t.vector("up", None)
    if up is not None and not any(up):
        raise t.error("up", "not be zero")
    return ModelPart(
        ply=None if ply is None else folder / Path(ply).expanduser(),
        procedural=procedural,
        up=up,
        opacity_above=t.number("opacity_above", 0.02, at_least=0, below=1),
        region=_region(t, "region"),
        size=t.number("size", 1.0, above=0),
        velocity=t.vector("velocity", (0.0, 0.0, 0.0)),
    )


def _region(t: Table, key: str) -> Region | None:
    if not t.has(key):
        t.table(key, {})
        return None

    def box(table: Table) -> Region:
        region = Region(table.vector("lower"), table.vector("upper"))
        if not all(a < b for a, b in zip(region.lower, region.upper, strict=True)):
            raise table.error("upper", f"be above `lower` = {list(region.lower)}")
        return region

    return t.table(key).read(box)


def _grid(t: Table) -> GridPart:
    grid = GridPart(
        lower=t.vector("lower"),
        upper=t.vector("upper"),
        spacing=t.number("spacing", above=0),
        spline=t.choice("spline", {"quadratic": BSpline(2), "cubic": BSpline(3)}, "quadratic"),
        scheme=t.choice(
            "scheme", {"spline-gradient": SplineGradient(), "mls": MLS()}, "spline-gradient"
        ),
    )
    if not all(a + 4 * grid.spacing <= b for a, b in zip(grid.lower, grid.upper, strict=True)):
        raise t.error("upper", f"be at least 4 spacings above `lower` = {list(grid.lower)}")
    return grid


def _time(t: Table) -> TimePart:
    return TimePart(
        frames=t.integer("frames", 50),
        fps=t.number("fps", 25.0, above=0),
        dt=t.number("dt", None, above=0),
        fraction=t.number("fraction", 0.5, above=0, below=1),
    )


def _camera(t: Table, size: float) -> CameraPart:
    return CameraPart(
        target=t.vector("target", (0.0, 0.0, 0.4 * size)),
        azimuth=t.number("azimuth", -60.0),
        elevation=t.number("elevation", 12.0, above=-90, below=90),
        radius=t.number("radius", 2.4 * size, above=0),
        turn=t.number("turn", 0.0),
        fov=t.number("fov", 40.0, above=0, below=170),
        width=t.integer("width", 480, at_least=16),
        height=t.integer("height", 480, at_least=16),
        background=t.vector("background", (1.0, 1.0, 1.0)),
        max_stretch=t.number("max_stretch", 4.0, at_least=1),
    )


_LAWS = {
    "fixed-corotated": models.FixedCorotated,
    "stvk-hencky": models.StVKHencky,
    "neo-hookean": models.NeoHookean,
    "dev-vol-neo-hookean": models.DevVolNeoHookean,
}


def _material(t: Table) -> tuple[Material, Region | None]:
    law = t.choice("law", _LAWS)(E=t.number("E", above=0), nu=t.number("nu", above=-1, below=0.5))
    plasticity = None
    if t.has("plasticity"):
        plasticity = t.table("plasticity").read(_plasticity)
    else:
        t.table("plasticity", {})
    density = t.number("density", above=0)
    return Material(law, plasticity, density), _region(t, "region")


def _plasticity(t: Table) -> models.AbstractPlasticity:
    return t.choice(
        "type",
        {
            "drucker-prager": _drucker_prager,
            "von-mises": _von_mises,
            "herschel-bulkley": _herschel_bulkley,
        },
    )(t)


def _drucker_prager(t: Table) -> models.AbstractPlasticity:
    return models.DruckerPrager(
        t.number("friction_angle", at_least=0, below=90),
        t.number("cohesion", None, at_least=0),
        volume_correction=t.boolean("volume_correction", False),
    )


def _von_mises(t: Table) -> models.AbstractPlasticity:
    return models.VonMises(
        t.number("yield_stress", at_least=0), t.number("hardening", None, at_least=0)
    )


def _herschel_bulkley(t: Table) -> models.AbstractPlasticity:
    return models.HerschelBulkley(
        t.number("yield_stress", at_least=0),
        t.number("viscosity", at_least=0),
        h=t.number("h", 1, above=0),
    )


def _contact(t: Table) -> AbstractContact:
    kind = t.choice(
        "contact", {"sticky": Sticky, "slip": Slip, "separating": Separating}, "separating"
    )
    friction = t.number("friction", None, at_least=0)
    if kind is Separating:
        return Separating() if friction is None else Separating(friction)
    if friction is not None:
        raise t.error("friction", "be left out unless `contact` is separating")
    return kind()


def _window(t: Table) -> dict[str, Any]:
    return {"start": t.number("start", 0.0), "end": t.number("end", math.inf)}


def _boundary(t: Table) -> Callable:
    def half_space() -> Callable:
        return HalfSpace(t.vector("point"), t.vector("normal"), _contact(t))

    def box() -> Callable:
        return Box(t.vector("lower"), t.vector("upper"), _contact(t))

    def velocity() -> Callable:
        return GridVelocity(
            t.vector("center"), t.vector("half_size"), t.vector("velocity"), **_window(t)
        )

    return t.choice("type", {"half-space": half_space, "box": box, "velocity": velocity})()


def _particles(t: Table) -> Callable[[np.ndarray], Any]:
    def velocity() -> Callable[[np.ndarray], Any]:
        value, window = t.vector("velocity"), _window(t)
        return lambda mask: ParticleVelocity(mask, value, **window)

    def impulse() -> Callable[[np.ndarray], Any]:
        momentum = t.vector("momentum")
        start, duration = t.number("start", 0.0), t.number("duration", 0.0, at_least=0)
        return lambda mask: ParticleImpulse(mask, momentum, start, duration)

    make = t.choice("type", {"velocity": velocity, "impulse": impulse})()
    region = _region(t, "region")

    def condition(x: np.ndarray) -> Any:
        mask = np.ones(len(x), bool) if region is None else region.contains(x)
        if not mask.any():
            raise t.error("region", "hold at least one particle")
        return make(mask)

    return condition
