"""The models of a scene file: where Gaussians come from, which of them move, where they stand."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pgjax._files import is_file
from pgjax.scenes.procedural import MODELS
from pgjax.scenes.reader import Table, missing_file, nearest
from pgjax.scenes.regions import AbstractRegion, Triple, region
from pgjax.scenes.turns import radians, rotation

# Of a procedural model; 1000 times as many Gaussians are more than anybody wants.
_MOST_DETAIL = 10.0


@dataclasses.dataclass(frozen=True)
class FillPart:
    """How the inside of a captured surface is filled; see `pgjax.filling.fill`."""

    spacing: float | None
    seal: float | None
    seed: int
    max_particles: int


@dataclasses.dataclass(frozen=True)
class ModelPart:
    """Where Gaussians come from, which of them move, and where they stand.

    Attributes:
        label: how messages call the table.
        name: by which materials and conditions refer to the model.
        ply: the captured model, of any format that `load_gaussians` reads; or None.
        procedural: the name of a model made by a program; or None.
        seed: of the procedural model.
        detail: of the procedural model: how many times nearer its Gaussians are to each other.
        up: direction in the model that points up; by its kind if None.
        turn: rotation of the upright model, `(3, 3)`.
        opacity_above: Gaussians of no more opacity are left out.
        region: the part that is simulated, in the model's coordinates; all if None.
        surroundings: whether what is outside the region is kept, drawn and as a wall.
        size: longest side of the simulated part, m.
        position: where its foot stands, m.
        velocity: at the start, m/s.
        angular_velocity: at the start, about the centre of its volume, radians/s.
        split_longer_than: bound of the Gaussians' standard deviations, in spacings of the grid.
        fill: how the inside is filled; not at all if None.
        lengths: of the files that were read, by the places that name them.
    """

    label: str
    name: str | None
    ply: Path | None
    procedural: str | None
    seed: int
    detail: float
    up: Triple | None
    turn: np.ndarray
    opacity_above: float
    region: AbstractRegion | None
    surroundings: bool
    size: float
    position: Triple
    velocity: Triple
    angular_velocity: Triple
    split_longer_than: float | None
    fill: FillPart | None
    lengths: Mapping[str, int]

    @property
    def source(self) -> str:
        """What messages call the file, or the program."""
        return self.procedural or str(self.ply)

    @property
    def upward(self) -> Triple:
        """The direction in the model that points up."""
        if self.up is not None:
            return self.up
        # Captures have y down as a rule; procedural models are made with z up.
        return (0.0, 0.0, 1.0) if self.ply is None else (0.0, -1.0, 0.0)


def model(t: Table) -> ModelPart:
    """A model from its table."""
    ply, procedural = t.path("ply", None), t.text("procedural", None)
    if (ply is None) == (procedural is None):
        raise t.error("ply", "be given, or `procedural`, but not both")
    if procedural is not None and procedural not in MODELS:
        raise t.error("procedural", f"be one of {', '.join(MODELS)}{nearest(procedural, MODELS)}")
    up = t.vector("up", None)
    if up is not None and not any(up):
        raise t.error("up", "not be zero")
    return ModelPart(
        label=t.name,
        name=t.text("name", None),
        ply=ply,
        procedural=procedural,
        seed=t.integer("seed", 0, at_least=0) if ply is None else 0,
        detail=t.number("detail", 1.0, above=0, below=_MOST_DETAIL) if ply is None else 1.0,
        up=up,
        turn=rotation(t),
        opacity_above=t.number("opacity_above", 0.02, at_least=0, below=1),
        region=t.optional("region", region),
        surroundings=t.boolean("surroundings", True),
        size=t.number("size", 1.0, above=0),
        position=t.vector("position", (0.0, 0.0, 0.0)),
        velocity=t.vector("velocity", (0.0, 0.0, 0.0)),
        angular_velocity=radians(t.vector("angular_velocity", (0.0, 0.0, 0.0))),
        split_longer_than=t.number("split_longer_than", None, above=0),
        fill=t.optional("fill", _fill),
        lengths=t.lengths,
    )


def require_files(part: ModelPart) -> None:
    """Raise if the file of a captured model is not there."""
    if part.ply is not None and not is_file(part.ply):
        raise missing_file(f"{part.label}: `ply`", part.ply)


def _fill(t: Table) -> FillPart:
    return FillPart(
        spacing=t.number("spacing", None, above=0),
        seal=t.number("seal", None, above=0),
        seed=t.integer("seed", 0, at_least=0),
        max_particles=t.integer("max_particles", 2_000_000),
    )
