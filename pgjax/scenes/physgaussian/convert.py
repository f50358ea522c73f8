"""From a configuration file of PhysGaussian to a scene file, and what changes on the way.

The scene keeps the coordinates of the configuration: its domain is [0, 2]³, with the object scaled
to `scale` and its middle at (1, 1, 1).
"""

import dataclasses
import math
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from pgjax._files import replacing
from pgjax.grid import Grid
from pgjax.scene import Scene
from pgjax.scenes.materials import material
from pgjax.scenes.physgaussian.common import Pieces, Setting
from pgjax.scenes.physgaussian.keys import Config, read_config
from pgjax.scenes.physgaussian.materials import materials
from pgjax.scenes.physgaussian.placing import find_files, place
from pgjax.scenes.physgaussian.viewing import camera
from pgjax.scenes.reader import Table, naming
from pgjax.scenes.schema import SceneFile, read_scene
from pgjax.timestep import ELASTIC_FRACTION, substeps_for

# So many times the rate at which one step would leave 1/e: nothing is left after a step.
_AT_ONCE = 100.0
# An array of numbers on several lines.
_SPREAD = re.compile(r"\[\n(?: +[^\[\]{}\n]+,\n)+\]")


@dataclasses.dataclass(frozen=True)
class Converted:
    """A scene file made of a configuration file.

    Attributes:
        name: of the scene.
        table: what the scene file holds.
        labels: the file of labels beside it: 1 for what is simulated; None if it has none.
        notes: what was mapped, fixed or not honoured, a line each, that begin with the key.
    """

    name: str
    table: dict[str, Any]
    labels: np.ndarray | None
    notes: tuple[str, ...]

    @property
    def labels_name(self) -> str:
        """The name of the file of labels."""
        return f"{self.name}-labels.npy"

    def text(self) -> str:
        """The scene file, its notes in front."""
        head = "".join(f"# {note}\n" for note in self.notes)
        table = _SPREAD.sub(_on_one_line, tomli_w.dumps(self.table))
        return f"{head}\n{table}"

    def write(self, path: Path) -> None:
        """Write the scene file, and the labels beside it."""
        if self.labels is not None:
            with replacing(path.with_name(self.labels_name)) as temporary:
                np.save(temporary, self.labels)
        with replacing(path) as temporary:
            temporary.write_text(self.text(), encoding="utf-8")

    def scene(self) -> SceneFile:
        """The scene that the written file holds."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{self.name}.toml"
            self.write(path)
            return read_scene(path)


def convert(config: Path, model: Path, *, legacy: bool = False) -> Converted:
    """Convert a configuration file of PhysGaussian and the model it goes with.

    Args:
        config: the `.json` file.
        model: the folder of a trained model, or a file of Gaussians.
        legacy: keep what published results owe to defects of the reference, as far as that can be
            expressed.

    Raises:
        SceneError: a key is unknown, missing, of the wrong type or out of range, or a file is
            missing or unusable.
    """
    read, files = read_config(config, legacy=legacy), find_files(model)
    with naming(read.source):
        placed = place(read, files.ply)
        made = materials(read, placed.x)
        seen = camera(read, files, placed.per_unit, legacy=legacy)
        conditions = _conditions(read, placed.x, legacy)
        forces, damping = _forces(read)
        time, timing = _time(read, made.tables, forces, legacy)
    model_table = dict(placed.table)
    if placed.labels is not None:
        file = f"{read.name}-labels.npy"
        model_table["region"] = {"shape": "labels", "file": file, "values": [1]}
    table = {
        "name": read.name,
        "model": model_table,
        "grid": _grid(read),
        "time": time,
        "forces": forces,
        "camera": seen.table,
        "material": made.tables,
        "boundary": conditions.walls,
        "particles": [*conditions.leads, *conditions.pushes],
    }
    notes = [
        *_model_notes(read, conditions.walls),
        *placed.notes,
        *made.notes,
        *timing,
        *damping,
        *conditions.notes,
        *seen.notes,
    ]
    plain = {key: _rounded(value) for key, value in table.items() if value}
    return Converted(read.name, plain, placed.labels, tuple(notes))


def _rounded(value: Any) -> Any:
    """The same without the last digits of numbers, which are rounding."""
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return float(f"{value:.12g}") if isinstance(value, float) else value


def _on_one_line(array: re.Match[str]) -> str:
    return f"[{', '.join(line.strip(' ,') for line in array[0].splitlines()[1:-1])}]"


def _model_notes(config: Config, walls: list[dict[str, Any]]) -> list[str]:
    """What holds of all files, and of keys that are about the whole."""
    notes = [
        f"scale: coordinates are those of the file, [0, {config.grid_lim:g}]^3 with the object's "
        f"middle at (1, 1, 1), in metres",
        "density: masses have volumes by the distance of neighbours, or of what was filled, not "
        "shares of cells of the grid",
    ]
    if config.grid_lim != 2:
        notes.append(f"grid_lim: {config.grid_lim:g} has its middle elsewhere, kept as it is")
    if not any(wall["type"] == "box" for wall in walls):
        notes.append("n_grid: a particle that leaves the grid is lost, and the run stops")
    if "pic_damping" in config.given:
        notes.append("pic_damping: not used, in the reference neither")
    return notes


def _grid(config: Config) -> dict[str, Any]:
    return {
        "lower": [0.0, 0.0, 0.0],
        "upper": 3 * [config.grid_lim],
        "spacing": config.grid_lim / config.n_grid,
    }


def _conditions(config: Config, x: np.ndarray, legacy: bool) -> Pieces:
    """The conditions in the order of a scene file, in which the first one that leads goes."""
    here = Setting(
        x=x,
        domain=config.grid_lim,
        n_grid=config.n_grid,
        substep_dt=config.substep_dt,
        duration=config.frame_num * config.frame_dt,
        legacy=legacy,
    )
    made = Pieces([], [], [], [])
    for part in config.boundaries:
        for all_of, some in zip(made[:3], (piece := part.make(here))[:3], strict=True):
            all_of.extend(some)
        made.notes.extend(f"{part.name}: {note}" for note in piece.notes)
    made.leads.reverse()
    return made


def _forces(config: Config) -> tuple[dict[str, Any], list[str]]:
    notes, forces = [], {}
    g = 9.8 if config.g is None else config.g
    if isinstance(g, tuple):
        gravity = list(g)
    else:
        up = np.asarray(config.view.up) / np.linalg.norm(config.view.up)
        gravity = (-g * up + 0.0).tolist()
        notes.append(
            f"g: {'not given, ' if config.g is None else ''}{g:g} is {gravity} m/s², against the "
            f"upward axis (the reference stops)"
        )
    if any(gravity):
        forces["gravity"] = gravity
    s, r = config.grid_v_damping_scale, config.rpic_damping
    if s < 1:
        forces["grid_damping"] = -math.log(s) / config.substep_dt
        notes.append(
            f"grid_v_damping_scale: {s:g} a step is the rate {forces['grid_damping']:.4g} 1/s, "
            f"whatever the time step"
        )
    if r < -0.001:
        notes.append("rpic_damping: PIC is not there, RPIC (1) is the nearest")
        r = 1.0
    if r > 0:
        rate = -math.log(1 - r) if r < 1 else _AT_ONCE
        forces["shear_damping"] = rate / config.substep_dt
        notes.append(
            f"rpic_damping: {r:g} a step is the rate {forces['shear_damping']:.4g} 1/s, whatever "
            f"the time step"
        )
    return forces, notes


def _time(
    config: Config, tables: list[dict[str, Any]], forces: dict[str, Any], legacy: bool
) -> tuple[dict[str, Any], list[str]]:
    """Frames and time step; one above the stability bound becomes a part of a frame."""
    dt, frame = config.substep_dt, config.frame_dt
    limit = _largest_step(config, tables, forces)
    truncated = max(int(frame / dt), 1)
    steps, notes, override = substeps_for(frame, dt), [], {}
    if dt > limit * (1 + 1e-6) and legacy:
        steps, frame = truncated, truncated * dt
        override = {"allow_unstable": True}
        notes.append(
            f"substep_dt: {dt:g} s is kept, above the largest stable one, {limit:.4g} s: "
            f"`allow_unstable`; {steps} steps a frame of {frame:g} s"
        )
    elif dt > limit * (1 + 1e-6):
        steps = substeps_for(frame, ELASTIC_FRACTION * limit)
        notes.append(
            f"substep_dt: {dt:g} s is above the largest stable one, {limit:.4g} s: {steps} steps "
            f"of {frame / steps:.4g} s a frame"
        )
        dt = frame / steps
    elif legacy and truncated != steps:
        steps, frame = truncated, truncated * dt
        notes.append(f"frame_dt: {steps} steps of {dt:g} s a frame, so that it is {frame:g} s long")
    else:
        was = f" (the reference: {truncated})" if truncated != steps else ""
        part = frame / steps / limit
        notes.append(
            f"frame_dt: {steps} steps of {frame / steps:.4g} s a frame{was}, {part:.2f} of the "
            f"largest stable ones at rest"
        )
    notes.append(f"frame_num: {config.frame_num} frames after a first one of the state of rest")
    return {"frames": config.frame_num, "fps": 1 / frame, "dt": dt, **override}, notes


def _largest_step(config: Config, tables: list[dict[str, Any]], forces: dict[str, Any]) -> float:
    """The largest stable time step at rest, s, of a scene with one particle of each material."""
    parts = [Table(f"{config.source} material", table).read(material) for table in tables]
    grid = Grid([0.0, 0.0, 0.0], [8, 8, 8], config.grid_lim / config.n_grid)
    damping = {key: forces.get(key, 0.0) for key in ("grid_damping", "shear_damping")}
    count = len(parts)
    scene = Scene(grid, [p.material for p in parts], np.ones(count), counts=(1,) * count, **damping)
    return float(scene.rest_limit())
