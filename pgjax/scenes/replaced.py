"""A capture in place of the model that a scene was made for: what of the scene still applies."""

import dataclasses
from pathlib import Path

import numpy as np

from pgjax.scenes.crowd import Crowd
from pgjax.scenes.reader import SceneError
from pgjax.scenes.schema import SceneFile

# Cells between the particles and the end of a grid that had to be widened.
_ROOM = 6


def with_capture(file: SceneFile, ply: Path) -> SceneFile:
    """The scene with a capture as its model.

    Raises:
        SceneError: it has more than one model.
    """
    part, *others = file.models
    if others:
        raise SceneError(
            f"{file.source}: another model can replace the one of a scene with one [model] only, "
            f"but there are {len(file.models)}."
        )
    # A region of a model that a program made is in coordinates that the capture does not have.
    region = None if part.ply is None else part.region
    other = dataclasses.replace(part, ply=ply, procedural=None, region=region)
    return dataclasses.replace(file, models=(other,))


def fitted(file: SceneFile, crowd: Crowd) -> tuple[SceneFile, tuple[str, ...]]:
    """The scene without what takes no particle of the capture, in a grid that holds it; notes."""
    taken, materials, conditions, notes = np.zeros(len(crowd.rows), bool), [], [], []
    for part in file.materials:
        mine = crowd.taken(part.takes) & ~taken
        taken |= mine
        if mine.any():
            materials.append(part)
        else:
            notes.append(_left_out(part.takes.name))
    if not taken.all() and materials:
        last = materials[-1]
        materials[-1] = _of_the_rest(last)
        notes.append(f"capture: {int((~taken).sum())} particles are of the last material")
    for part in file.particle_conditions:
        if crowd.taken(part.takes).any():
            conditions.append(part)
        else:
            notes.append(_left_out(part.takes.name))
    widened = _widened(file, crowd.x)
    if widened.grid != file.grid:
        notes.append(
            f"capture: the grid reaches from {_short(widened.grid.lower)} to "
            f"{_short(widened.grid.upper)}, so that it holds the capture"
        )
    fit = dataclasses.replace(
        widened,
        materials=tuple(materials) or file.materials,
        particle_conditions=tuple(conditions),
    )
    return fit, tuple(notes)


def _left_out(name: str) -> str:
    """The note of a table whose region is empty; `name` is the file's and the table's."""
    return f"capture: nothing is in the region of {name.partition(' ')[2]}, which is left out"


def _of_the_rest(part):
    """A material that takes all that no other one has."""
    return dataclasses.replace(part, takes=dataclasses.replace(part.takes, region=None))


def _widened(file: SceneFile, x: np.ndarray) -> SceneFile:
    """The scene in a grid that holds the particles; as it is where it does."""
    grid, h = file.grid, file.grid.spacing
    lower, upper = np.asarray(grid.lower), np.asarray(grid.upper)
    below = np.ceil(np.maximum(lower - (x.min(axis=0) - _ROOM * h), 0) / h)
    above = np.ceil(np.maximum(x.max(axis=0) + _ROOM * h - upper, 0) / h)
    inside = (x.min(axis=0) > lower + h) & (x.max(axis=0) < upper - h)
    below, above = np.where(inside, 0, below), np.where(inside, 0, above)
    if not below.any() and not above.any():
        return file
    made = dataclasses.replace(
        grid,
        lower=tuple(float(a) for a in lower - below * h),
        upper=tuple(float(a) for a in upper + above * h),
    )
    return dataclasses.replace(file, grid=made)


def _short(corner: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{a:.3g}" for a in corner) + "]"
