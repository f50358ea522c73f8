"""Where a configuration file puts its object: the capture, the part that moves, and its place."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from pgjax._files import is_file, is_folder
from pgjax.render import load_capture
from pgjax.scenes.capture import body
from pgjax.scenes.model import model
from pgjax.scenes.physgaussian.keys import Config
from pgjax.scenes.reader import SceneError, Table, missing_file, naming, shown
from pgjax.scenes.regions import LabelRegion
from pgjax.scenes.turns import rotation

# The middle of the object in the domain.
_CENTER = np.array([1.0, 1.0, 1.0])
_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
# A finer filling than this part of the grid's spacing adds particles and no detail.
_FINEST_FILL = 0.5
# So many times a filling that takes too many cells or particles is made coarser by a fifth.
_COARSER = 10


@dataclasses.dataclass(frozen=True)
class Files:
    """A captured model, and the cameras it was made with, if they are there.

    Attributes:
        ply: the Gaussians.
        cameras: `cameras.json` of the folder of the training.
        alone: whether there is no such folder.
    """

    ply: Path
    cameras: Path | None
    alone: bool


@dataclasses.dataclass(frozen=True)
class Placed:
    """The simulated part of a capture in the coordinates of the domain.

    Attributes:
        table: the `[model]` table that puts it there; without a `region` where labels say it.
        labels: 1 for each Gaussian of the file that is simulated, else 0; None if it needs none.
        x: positions of the particles, m, `(n, 3)`.
        per_unit: of the capture's lengths, m.
        notes: a line each.
    """

    table: dict[str, Any]
    labels: np.ndarray | None
    x: np.ndarray
    per_unit: float
    notes: list[str]


def find_files(model: Path) -> Files:
    """The files of a trained model: the folder of its training, or a `.ply` alone.

    Raises:
        SceneError: they are not there.
    """
    if is_file(model):
        return Files(model.absolute(), None, True)
    if not is_folder(model):
        raise missing_file("Argument `--model`", model)
    folder = model / "point_cloud"
    tried = folder.glob("iteration_*/point_cloud.ply") if is_folder(folder) else ()
    numbered = [(_iteration(path), path) for path in tried]
    if not any(number >= 0 for number, _ in numbered):
        raise SceneError(
            f"Argument `--model` must hold point_cloud/iteration_N/point_cloud.ply, as training "
            f"leaves it, or be a .ply file, but is {shown(model)}."
        )
    cameras = model / "cameras.json"
    found = cameras.absolute() if is_file(cameras) else None
    return Files(max(numbered)[1].absolute(), found, False)


def _iteration(path: Path) -> int:
    number = path.parent.name.removeprefix("iteration_")
    return int(number) if number.isdecimal() else -1


def place(config: Config, ply: Path) -> Placed:
    """Load the capture and put its simulated part where the file has it.

    Raises:
        SceneError: the capture is unusable, or none of it is simulated.
    """
    with naming("Argument `--model`"):
        capture = load_capture(ply)
    turns = [{"axis": list(_AXES[axis]), "angle": angle} for angle, axis in config.turns]
    turn = rotation(Table(config.source, {"rotation": turns}))
    opaque = np.asarray(capture.gaussians.opacities) > config.opacity_threshold
    x = np.asarray(capture.gaussians.means, np.float64)[opaque] @ turn.T
    moves = _in_area(config, x)
    if not moves.any():
        key = "opacity_threshold" if config.sim_area is None else "sim_area"
        value = config.opacity_threshold if config.sim_area is None else list(config.sim_area)
        raise SceneError(
            f"{config.source}: `{key}` must leave at least one Gaussian of {capture.total} to "
            f"simulate ({len(x)} are above the opacity), but is {value}."
        )
    lower, upper = x[moves].min(axis=0), x[moves].max(axis=0)
    side = float((upper - lower).max())
    if side == 0:
        raise SceneError("Argument `--model` must not hold all its Gaussians at the same place.")
    per_unit = config.scale / side
    foot = _CENTER - [0.0, 0.0, per_unit * (upper - lower)[2] / 2]
    table: dict[str, Any] = {
        "ply": str(ply),
        "up": [0.0, 0.0, 1.0],
        "opacity_above": config.opacity_threshold,
        "size": config.scale,
        "position": foot.tolist(),
    }
    if turns:
        table["rotation"] = turns
    labels = None
    if config.sim_area is not None and turns:
        labels = np.zeros(capture.total, np.uint8)
        labels[capture.rows[opaque][moves]] = 1
    elif config.sim_area is not None:
        area = list(config.sim_area)
        table["region"] = {"lower": area[::2], "upper": area[1::2]}
    placed = per_unit * (x[moves] - (lower + upper) / 2) + _CENTER
    return _filled(config, Placed(table, labels, placed, per_unit, []))


def _in_area(config: Config, x: np.ndarray) -> np.ndarray:
    if config.sim_area is None:
        return np.ones(len(x), bool)
    lower, upper = np.asarray(config.sim_area[::2]), np.asarray(config.sim_area[1::2])
    return np.all((x > lower) & (x < upper), axis=1)


def _filled(config: Config, placed: Placed) -> Placed:
    """The same with its inside, if the file wants it filled."""
    filling = config.filling
    if filling is None:
        return placed
    grid = config.grid_lim / config.n_grid
    side = config.grid_lim
    if filling.boundary is not None:
        side = float(np.max(np.subtract(filling.boundary[1::2], filling.boundary[::2])))
    wanted = side / filling.n_grid / filling.per_cell ** (1 / 3)
    table = dict(placed.table)
    x, spacing = _fitting(config, placed, table, max(wanted, _FINEST_FILL * grid))
    notes = [
        f"particle_filling: particles {spacing:.4g} m apart in every closed body, from seed 0; "
        f"at most {filling.max_particles}; broken covariances count as points"
    ]
    if spacing > wanted:
        notes.append(
            f"particle_filling: {wanted:.4g} m apart was finer than half a cell, or than what "
            f"can be had"
        )
    if filling.unused:
        notes.append(
            f"particle_filling: {', '.join(filling.unused)} not used: what a ball rolled over the "
            f"surface does not reach is inside"
        )
    return Placed(table, placed.labels, x, placed.per_unit, notes)


def _fitting(
    config: Config, placed: Placed, table: dict[str, Any], spacing: float
) -> tuple[np.ndarray, float]:
    """The particles with a filling of this distance, or the next that can be had; adds it."""
    assert config.filling is not None
    tries = 0
    while True:
        fill = {"spacing": spacing, "max_particles": config.filling.max_particles, "seed": 0}
        table["fill"] = fill
        part = Table(f"{config.source} [particle_filling]", table).read(model)
        if placed.labels is not None:
            part = dataclasses.replace(part, region=LabelRegion(placed.labels, (1,)))
        try:
            filled = body(part, config.grid_lim / config.n_grid)
            return np.asarray(filled.moving.means, np.float64), spacing
        except SceneError as error:
            tries += 1
            if "`spacing`" not in str(error) or tries > _COARSER:
                raise
            spacing *= 1.2
