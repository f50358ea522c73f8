"""From a scene file to what the simulator and the renderer take."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pgjax.boundary import AbstractParticleCondition
from pgjax.grid import Grid
from pgjax.render import Camera, Gaussians, Similarity, concatenate
from pgjax.result import NEVER
from pgjax.scene import Scene, initial_state
from pgjax.scenes.camera import CameraPart
from pgjax.scenes.capture import body
from pgjax.scenes.carriage import Carriage
from pgjax.scenes.conditions import ParticlesPart
from pgjax.scenes.crowd import Crowd, by_material
from pgjax.scenes.floor import on_floor
from pgjax.scenes.merging import merged
from pgjax.scenes.model import ModelPart
from pgjax.scenes.reader import SceneError, naming
from pgjax.scenes.replaced import fitted, with_capture
from pgjax.scenes.schema import GridPart, SceneFile
from pgjax.scenes.walls import BoundaryPart, Site
from pgjax.state import State
from pgjax.timestep import stable_dt, substeps_for

PRESETS = Path(__file__).parent / "presets"


@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything a run needs, decided before anything is compiled.

    Attributes:
        name: of the scene.
        scene: what the simulator takes.
        state: where it starts.
        moving: the simulated Gaussians in simulation coordinates: one for each particle, in their
            order, or carried by them.
        still: the others; they are drawn, not simulated.
        to_simulation: from the coordinates of the (first) model to the simulation's.
        dt: time step, s.
        substeps: per frame.
        frames: to run.
        fps: frames per second.
        view: the camera's part of the scene file.
        allow_unstable: whether the time step may be above the stable one.
        notes: what was found in the models and done to them, a line each.
        models: of the scene file.
        body: of which model each particle is, `(n,)`.
        carriage: how the particles carry the Gaussians; None where each Gaussian is a particle.
    """

    name: str
    scene: Scene
    state: State
    moving: Gaussians
    still: Gaussians
    to_simulation: Similarity
    dt: float
    substeps: int
    frames: int
    fps: float
    view: CameraPart
    allow_unstable: bool = False
    notes: tuple[str, ...] = ()
    models: tuple[ModelPart, ...] = ()
    body: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    carriage: Carriage | None = None

    def camera(self, frame: int) -> Camera:
        """The camera of a frame."""
        return self.view.view.at(frame / self.fps, self.to_simulation)


def presets() -> list[str]:
    """Names of the scenes that come with the package."""
    return sorted(path.stem for path in PRESETS.glob("*.toml"))


def plan(file: SceneFile, *, ply: Path | None = None, frames: int | None = None) -> Plan:
    """Load the models, place them, and decide volumes, materials and time step.

    Args:
        file: the scene file.
        ply: a captured model in place of the file's own. What takes nothing of it is left out, and
            the grid is widened where it does not hold it; notes say so.
        frames: number of frames in place of the file's own.

    Raises:
        SceneError: a model is missing or unusable, the parts of the file do not fit together, or
            its time step is too long.
    """
    if ply is not None:
        file = with_capture(file, ply)
    bodies = [body(part, file.grid.spacing) for part in file.models]
    everybody, changes = Crowd.of(file.models, bodies), ()
    if ply is not None:
        file, changes = fitted(file, everybody)
    crowd, counts = by_material(everybody, [part.takes for part in file.materials])
    still = concatenate([b.still for b in bodies])
    carriage = None
    with naming(f"{file.source} [grid]"):
        if file.grid.particle_spacing is not None:
            crowd, counts, carriage, note = merged(crowd, counts, file.grid)
            changes = (*changes, note)
    with naming(file.source):
        scene, note = _scene(file, crowd, counts, still)
        changes = changes if note is None else (*changes, note)
        v, C = crowd.velocities()
        state = initial_state(scene, crowd.x, v, C=C)
        longest = _longest_step(file, scene, state)
        substeps = substeps_for(1 / file.time.fps, longest)
    made = Plan(
        name=file.name,
        scene=scene,
        state=state,
        moving=crowd.gaussians,
        still=still,
        to_simulation=bodies[0].to_simulation,
        dt=1 / file.time.fps / substeps,
        substeps=substeps,
        frames=file.time.frames if frames is None else frames,
        fps=file.time.fps,
        view=file.camera,
        allow_unstable=file.time.allow_unstable,
        notes=(*(note for b in bodies for note in b.notes), *changes),
        models=file.models,
        body=crowd.body,
        carriage=carriage,
    )
    _require_countable(made, file.source)
    # What is too far or too near for the numbers of the simulation is said now.
    with naming(f"{file.source} [camera]"):
        for frame in (0, made.frames):
            made.camera(frame)
    return made


def _require_countable(made: Plan, source: str) -> None:
    if made.frames * made.substeps >= NEVER:
        raise SceneError(
            f"{source} [time]: `frames` must be at most {(NEVER - 1) // made.substeps} of "
            f"{made.substeps} steps each, fewer than 2^31 in all, but is {made.frames}."
        )


def _longest_step(file: SceneFile, scene: Scene, state: State) -> float:
    """The time step of the file, or a stable one, s; a frame is a whole number of those below."""
    if file.time.dt is None:
        return stable_dt(scene, state, fraction=file.time.fraction)
    limit = float(scene.rest_limit())
    # The limit may be known to single precision only.
    if file.time.dt > limit * (1 + 1e-6) and not file.time.allow_unstable:
        raise SceneError(
            f"{file.source} [time]: `dt` must be at most {limit:.4g} s, the largest stable time "
            f"step at rest, but is {file.time.dt:g}."
        )
    return file.time.dt


def _scene(
    file: SceneFile, crowd: Crowd, counts: tuple[int, ...], still: Gaussians
) -> tuple[Scene, str | None]:
    """The scene of particles in the order of their materials, and what was done to its grid."""
    ends = np.cumsum(counts)
    rows = np.split(crowd.rows, ends[:-1])
    grid = _grid(file.grid)
    site = _site(grid, still)
    walls = [_wall(part, site) for part in file.boundaries]
    grid, note = on_floor(grid, walls, file.gravity)
    scene = Scene(
        grid,
        [part.of(own) for part, own in zip(file.materials, rows, strict=True)],
        crowd.volumes,
        counts=counts,
        gravity=file.gravity,
        boundaries=walls,
        particle_conditions=[_condition(part, crowd) for part in file.particle_conditions],
        spline=file.grid.spline,
        scheme=file.grid.scheme,
        grid_damping=file.grid_damping,
        shear_damping=file.shear_damping,
    )
    return scene, note


def _site(grid: Grid, still: Gaussians) -> Site:
    lower, h = np.asarray(grid.origin), float(grid.h)
    return Site(h, lower, lower + np.asarray(grid.shape) * h, np.asarray(still.means, np.float64))


def _wall(part: BoundaryPart, site: Site) -> Callable:
    with naming(part.name):
        return part.make(site)


def _condition(part: ParticlesPart, crowd: Crowd) -> AbstractParticleCondition:
    mask = crowd.taken(part.takes)
    if not mask.any():
        raise SceneError(f"{part.takes.name}: no particle is in the region: move it.")
    with naming(part.takes.name):
        return part.make(mask, crowd.x)


def _grid(part: GridPart) -> Grid:
    """The grid, its upper corner moved outwards to a whole number of cells."""
    lower, upper = np.asarray(part.lower), np.asarray(part.upper)
    shape = np.ceil((upper - lower) / part.spacing - 1e-9).astype(int)
    return Grid(part.lower, shape.tolist(), part.spacing, periodic=part.periodic)
