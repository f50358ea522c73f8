"""From a model of a scene file to particles: load, select, place, split, fill."""

import dataclasses

import numpy as np

from pgjax.render import Capture, Gaussians, Similarity, load_capture, measure_axes, split_long
from pgjax.sampling import neighbour_volumes
from pgjax.scenes.arrays import require_lengths
from pgjax.scenes.interior import filled
from pgjax.scenes.model import ModelPart, require_files
from pgjax.scenes.procedural import MODELS
from pgjax.scenes.reader import SceneError, naming
from pgjax.scenes.regions import Points, unit


@dataclasses.dataclass(frozen=True)
class Body:
    """The particles of one model, in simulation coordinates.

    Attributes:
        moving: what is simulated, n Gaussians.
        rows: which Gaussian of the model's file each of them is or comes from, `(n,)`.
        volumes: their rest volumes, m³, `(n,)`.
        still: the Gaussians that are only drawn.
        file_count: number of Gaussians in the file.
        to_simulation: from the model's coordinates to the simulation's.
        notes: what was found and done, a line each.
    """

    moving: Gaussians
    rows: np.ndarray
    volumes: np.ndarray
    still: Gaussians
    file_count: int
    to_simulation: Similarity
    notes: tuple[str, ...]


def body(part: ModelPart, grid_spacing: float) -> Body:
    """Load a model and make particles of it.

    Raises:
        SceneError: the file is missing or unusable, or nothing of it is left to simulate.
    """
    require_files(part)
    with naming(part.label):
        return _body(part, grid_spacing)


def _body(part: ModelPart, grid_spacing: float) -> Body:
    loaded = _load(part)
    require_lengths(part.lengths, loaded.total, part.source)
    gaussians, rows, moves = _select(part, loaded)
    similarity = _placing(part, np.asarray(gaussians.means, np.float64)[moves])
    placed = gaussians.transformed(similarity)
    moving, still, rows = placed[moves], placed[~moves & part.surroundings], rows[moves]
    notes = [_needles(moving, grid_spacing)]
    if part.split_longer_than is not None:
        count = len(moving)
        moving, parents = split_long(moving, part.split_longer_than * grid_spacing)
        rows = rows[parents]
        notes.append(f"splitting: {count} Gaussians became {len(moving)}")
    if part.fill is None:
        volumes = neighbour_volumes(np.asarray(moving.means))
    else:
        inside = filled(part.fill, moving, grid_spacing)
        moving, volumes = inside.gaussians, inside.volumes
        rows = np.concatenate([rows, rows[inside.nearest]])
        notes.append(f"filling: {inside.report}")
    return Body(moving, rows, volumes, still, loaded.total, similarity, tuple(notes))


def _load(part: ModelPart) -> Capture:
    if part.ply is not None:
        return load_capture(part.ply)
    assert part.procedural is not None
    made = MODELS[part.procedural](part.seed, part.detail)
    return Capture(made, np.arange(len(made)), len(made))


def _select(part: ModelPart, loaded: Capture) -> tuple[Gaussians, np.ndarray, np.ndarray]:
    """The Gaussians that are opaque enough to be there, their rows, and which are simulated."""
    opaque = np.asarray(loaded.gaussians.opacities) > part.opacity_above
    gaussians, rows = loaded.gaussians[opaque], loaded.rows[opaque]
    moves = np.ones(len(rows), bool)
    if part.region is not None:
        moves = part.region.contains(Points(np.asarray(gaussians.means, np.float64), rows))
    if not moves.any():
        raise SceneError(
            f"{part.label}: no Gaussian of {loaded.total} is left to simulate: {len(rows)} are "
            f"above the opacity {part.opacity_above:g}, none of them in the region."
        )
    return gaussians, rows, moves


def _placing(part: ModelPart, x: np.ndarray) -> Similarity:
    """Upright, turned, of the given size, its foot on the given place."""
    rotation = part.turn @ upright(np.asarray(part.upward))
    turned = x @ rotation.T
    lower, upper = turned.min(axis=0), turned.max(axis=0)
    extent = float((upper - lower).max())
    if extent == 0:
        raise SceneError(
            f"{part.label}: the simulated Gaussians must not all be at the same place."
        )
    scale = part.size / extent
    foot = np.array([(lower[0] + upper[0]) / 2, (lower[1] + upper[1]) / 2, lower[2]])
    return Similarity(scale, rotation, np.asarray(part.position) - scale * foot)


def upright(up: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes the direction `up` to +z, `(3, 3)`."""
    u = unit(up)
    axis, cosine = np.cross(u, [0.0, 0.0, 1.0]), u[2]
    if cosine < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + K + K @ K / (1 + cosine)


def _needles(moving: Gaussians, grid_spacing: float) -> str:
    """How long the Gaussians are against the distance of the particles and of the nodes."""
    spacing = float(np.median(neighbour_volumes(np.asarray(moving.means)))) ** (1 / 3)
    fine, coarse = measure_axes(moving, spacing), measure_axes(moving, grid_spacing)
    return f"needles: {fine} m (particles), {coarse.long} longer than {grid_spacing:.3g} m (grid)"
