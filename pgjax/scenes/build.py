"""From a scene file to what the simulator and the renderer take."""

import dataclasses
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from pgjax.grid import Grid
from pgjax.render import Camera, Gaussians, Similarity, load_ply
from pgjax.sampling import neighbour_volumes
from pgjax.scene import Scene, initial_state
from pgjax.scenes.procedural import MODELS
from pgjax.scenes.reader import SceneError
from pgjax.scenes.schema import CameraPart, GridPart, ModelPart, SceneFile
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
        moving: the simulated Gaussians in simulation coordinates, in the order of the particles.
        still: the others; they are drawn, not simulated.
        to_simulation: from the model's coordinates to the simulation's.
        dt: time step, s.
        substeps: per frame.
        frames: to run.
        fps: frames per second.
        view: the camera's part of the scene file.
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

    def camera(self, frame: int) -> Camera:
        """The camera of a frame."""
        view = self.view
        return Camera.orbit(
            view.target,
            up=(0.0, 0.0, 1.0),
            azimuth=math.radians(view.azimuth + view.turn * frame / self.fps),
            elevation=math.radians(view.elevation),
            radius=view.radius,
            fov_y=math.radians(view.fov),
            width=view.width,
            height=view.height,
        )


def presets() -> list[str]:
    """Names of the scenes that come with the package."""
    return sorted(path.stem for path in PRESETS.glob("*.toml"))


def plan(file: SceneFile, *, ply: Path | None = None, frames: int | None = None) -> Plan:
    """Load the model, place it, and decide volumes, materials and time step.

    Args:
        file: the scene file.
        ply: a captured model in place of the file's own.
        frames: number of frames in place of the file's own.
    """
    model = file.model
    if ply is not None:
        model = dataclasses.replace(model, ply=ply, procedural=None)
    gaussians = _load(model)
    moving, still, similarity = _place(model, gaussians)
    moving, counts = _by_material(file, moving)
    x = np.asarray(moving.means)
    scene = Scene(
        _grid(file.grid),
        [material for material, _ in file.materials],
        neighbour_volumes(x),
        counts=counts,
        gravity=file.gravity,
        boundaries=file.boundaries,
        particle_conditions=[make(x) for make in file.particle_conditions],
        spline=file.grid.spline,
        scheme=file.grid.scheme,
        grid_damping=file.grid_damping,
        shear_damping=file.shear_damping,
    )
    state = initial_state(scene, x, model.velocity)
    limit = file.time.dt or stable_dt(scene, state, fraction=file.time.fraction)
    substeps = substeps_for(1 / file.time.fps, limit)
    return Plan(
        name=file.name,
        scene=scene,
        state=state,
        moving=moving,
        still=still,
        to_simulation=similarity,
        dt=1 / file.time.fps / substeps,
        substeps=substeps,
        frames=file.time.frames if frames is None else frames,
        fps=file.time.fps,
        view=file.camera,
    )


def _load(model: ModelPart) -> Gaussians:
    if model.ply is not None:
        return load_ply(model.ply)
    if model.procedural not in MODELS:
        raise SceneError(
            f"[model]: `procedural` must be one of {', '.join(MODELS)}, but is "
            f"{model.procedural!r}."
        )
    return MODELS[model.procedural]()


def _place(model: ModelPart, gaussians: Gaussians) -> tuple[Gaussians, Gaussians, Similarity]:
    """Filter, split and scale: z up, simulated part of the given size standing on z = 0."""
    keep = np.asarray(gaussians.opacities) > model.opacity_above
    gaussians = gaussians[keep]
    means = np.asarray(gaussians.means, np.float64)
    inside = np.ones(len(means), bool)
    if model.region is not None:
        inside = model.region.contains(means)
    if not inside.any():
        raise SceneError(
            f"[model]: no Gaussian of {len(keep)} is left to simulate: {int(keep.sum())} are "
            f"above the opacity {model.opacity_above:g}, none of them in the region."
        )
    # Captures have y down as a rule; procedural models are made with z up.
    default = (0.0, 0.0, 1.0) if model.ply is None else (0.0, -1.0, 0.0)
    rotation = upright(np.asarray(model.up or default))
    turned = means[inside] @ rotation.T
    lower, upper = turned.min(axis=0), turned.max(axis=0)
    extent = float((upper - lower).max())
    if extent == 0:
        raise SceneError("[model]: the simulated Gaussians must not all be at the same place.")
    scale = model.size / extent
    foot = np.array([(lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2, lower[2]])
    similarity = Similarity(scale, rotation, -scale * foot)
    moved = gaussians.transformed(similarity)
    return moved[inside], moved[~inside], similarity


def upright(up: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes the direction `up` to +z, `(3, 3)`."""
    u = up / np.linalg.norm(up)
    axis, cosine = np.cross(u, [0.0, 0.0, 1.0]), u[2]
    if cosine < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + K + K @ K / (1 + cosine)


def _by_material(file: SceneFile, moving: Gaussians) -> tuple[Gaussians, tuple[int, ...]]:
    """Order the particles so that each material owns a slice; the first region that fits wins."""
    x = np.asarray(moving.means)
    owner = np.full(len(x), -1)
    for index, (_, region) in enumerate(file.materials):
        free = owner < 0
        owner[free & (True if region is None else region.contains(x))] = index
    if (owner < 0).any():
        raise SceneError(
            f"{file.name}: {int((owner < 0).sum())} particles are in the region of no "
            f"[[material]]; leave out `region` in the last one."
        )
    counts = np.bincount(owner, minlength=len(file.materials))
    if (counts == 0).any():
        number = int(np.argmax(counts == 0)) + 1
        raise SceneError(f"{file.name}: [[material]] {number} owns no particle: move its region.")
    order = np.argsort(owner, kind="stable")
    return moving[jnp.asarray(order)], tuple(int(c) for c in counts)


def _grid(part: GridPart) -> Grid:
    """The grid, its upper corner moved outwards to a whole number of cells."""
    lower, upper = np.asarray(part.lower), np.asarray(part.upper)
    shape = np.ceil((upper - lower) / part.spacing - 1e-9).astype(int)
    return Grid(part.lower, shape.tolist(), part.spacing)
