"""The scene file: which tables and keys there are, and what they become.

All lengths are in metres of the simulation: z points up, the simulated part of the model is
scaled to `model.size` and stands on `model.position`. Angles are in degrees. The keys of one table
are read in one module of this package; the reference for users is `docs/scene-files.md`.
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from pgjax.scenes.camera import CameraPart, camera
from pgjax.scenes.conditions import ParticlesPart, particles
from pgjax.scenes.materials import MaterialPart, material
from pgjax.scenes.model import ModelPart, model
from pgjax.scenes.reader import SceneError, Table, nearest, parse
from pgjax.scenes.regions import Triple
from pgjax.scenes.walls import BoundaryPart, boundary
from pgjax.splines import BSpline
from pgjax.transfer import MLS, AbstractScheme, SplineGradient


@dataclasses.dataclass(frozen=True)
class GridPart:
    """The box of the grid and the discretisation on it.

    `particle_spacing` is in spacings of the grid; each Gaussian is a particle where it is None.
    """

    lower: Triple
    upper: Triple
    spacing: float
    particle_spacing: float | None
    periodic: tuple[bool, bool, bool]
    spline: BSpline
    scheme: AbstractScheme


@dataclasses.dataclass(frozen=True)
class TimePart:
    """Frames and time step."""

    frames: int
    fps: float
    dt: float | None
    fraction: float
    allow_unstable: bool


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """A scene file, read and checked.

    Attributes:
        name: of the scene.
        source: the name of the file, for messages.
        models: where the Gaussians come from.
        grid: the grid.
        time: frames and time step.
        camera: from where it is seen.
        gravity: m/s².
        grid_damping: 1/s.
        shear_damping: 1/s.
        materials: in order; the first that takes a particle owns it.
        boundaries: conditions of the grid.
        particle_conditions: conditions of particles.
    """

    name: str
    source: str
    models: tuple[ModelPart, ...]
    grid: GridPart
    time: TimePart
    camera: CameraPart
    gravity: Triple
    grid_damping: float
    shear_damping: float
    materials: tuple[MaterialPart, ...]
    boundaries: tuple[BoundaryPart, ...]
    particle_conditions: tuple[ParticlesPart, ...]


SPLINES = {"quadratic": BSpline(2), "cubic": BSpline(3)}
SCHEMES: dict[str, AbstractScheme] = {"spline-gradient": SplineGradient(), "mls": MLS()}
# What a quality may change.
_VARIED = ("model", "grid", "time", "camera")


def read_scene(path: Path, quality: str | None = None) -> SceneFile:
    """Read a scene file, in one of the qualities it has tables of, or as it is.

    Raises:
        SceneError: a key is unknown, missing, of the wrong type or out of range, a file is
            missing or unusable, or there is no such quality. (Models are loaded by `plan`.)
    """
    return scene_from(parse(path), path.stem, quality)


def scene_from(root: Table, name: str, quality: str | None = None) -> SceneFile:
    """The scene of a parsed file; `name` is its name if it has none of its own.

    All its qualities are checked, whichever is wanted.
    """
    plain, variants = root.variants("quality", _VARIED)
    scenes: dict[str | None, SceneFile] = {None: plain.read(lambda table: _scene(table, name))}
    for key, variant in variants.items():
        scenes[key] = variant.read(lambda table: _scene(table, name))
    if quality not in scenes:
        offered = ", ".join(variants) if variants else "none"
        raise SceneError(
            f"{root.name}: `quality` must be one of the scene file's, which has {offered}"
            f"{nearest(str(quality), variants)}, but is {quality!r}."
        )
    return scenes[quality]


def _scene(root: Table, name: str) -> SceneFile:
    name = root.file_name("name", name)
    models = _models(root)
    forces = root.table("forces", {})
    gravity = forces.vector("gravity", (0.0, 0.0, 0.0))
    grid_damping = forces.number("grid_damping", 0.0, at_least=0)
    shear_damping = forces.number("shear_damping", 0.0, at_least=0)
    forces.close()
    materials = tuple(t.read(material) for t in root.tables("material", required=True))
    if not materials:
        raise root.error("material", "hold at least one [[material]]")
    conditions = tuple(t.read(particles) for t in root.tables("particles"))
    _require_models(models, (*materials, *conditions))
    return SceneFile(
        name=name,
        source=root.name,
        models=models,
        grid=root.table("grid").read(_grid),
        time=root.table("time", {}).read(_time),
        camera=root.table("camera", {}).read(lambda t: camera(t, models[0])),
        gravity=gravity,
        grid_damping=grid_damping,
        shear_damping=shear_damping,
        materials=materials,
        boundaries=tuple(t.read(boundary) for t in root.tables("boundary")),
        particle_conditions=conditions,
    )


def _models(root: Table) -> tuple[ModelPart, ...]:
    """One `[model]`, or several `[[model]]` with different names."""
    if not root.is_a("model", list):
        return (root.table("model").read(model),)
    models = tuple(t.read(model) for t in root.tables("model"))
    if not models:
        raise root.error("model", "hold at least one [[model]]")
    names = [m.name for m in models if m.name is not None]
    for m in models:
        if names.count(m.name or "") > 1:
            raise SceneError(
                f"{m.label}: `name` must differ from model to model, but is {m.name!r}."
            )
    return models


def _require_models(
    models: tuple[ModelPart, ...], parts: Iterable[MaterialPart | ParticlesPart]
) -> None:
    """Models that are referred to exist; values per Gaussian say of which model they are."""
    names = [m.name for m in models if m.name is not None]
    for takes in (part.takes for part in parts):
        if takes.model is not None and takes.model not in names:
            raise SceneError(
                f"{takes.name}: `model` must be the `name` of a model, "
                f"{'one of ' + ', '.join(names) if names else 'but none has one'}"
                f"{nearest(takes.model, names)}, but is {takes.model!r}."
            )
        if takes.model is None and takes.lengths and len(models) > 1:
            raise SceneError(
                f"{takes.name}: `model` must say which of the {len(models)} models the values in "
                f"the file belong to, but is missing."
            )


def _grid(t: Table) -> GridPart:
    grid = GridPart(
        lower=t.vector("lower"),
        upper=t.vector("upper"),
        spacing=t.number("spacing", above=0),
        particle_spacing=t.number("particle_spacing", None, above=0),
        periodic=t.booleans("periodic", (False, False, False)),
        spline=t.choice("spline", SPLINES, "quadratic"),
        scheme=t.choice("scheme", SCHEMES, "spline-gradient"),
    )
    if not all(a + 4 * grid.spacing <= b for a, b in zip(grid.lower, grid.upper, strict=True)):
        raise t.error("upper", f"be at least 4 spacings above `lower` = {list(grid.lower)}")
    if grid.particle_spacing is not None and grid.particle_spacing > 1:
        raise t.error("particle_spacing", "be at most 1 spacing of the grid")
    return grid


def _time(t: Table) -> TimePart:
    return TimePart(
        frames=t.integer("frames", 50),
        fps=t.number("fps", 25.0, above=0),
        dt=t.number("dt", None, above=0),
        fraction=t.number("fraction", 0.5, above=0, below=1),
        allow_unstable=t.boolean("allow_unstable", False),
    )
