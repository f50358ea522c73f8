"""A scene file for a capture that nobody has described yet: numbers chosen from what it is like."""

import dataclasses
import math
import os
import tomllib
import warnings
from pathlib import Path

from pgjax.render import Gaussians, load_capture
from pgjax.scenes.build import Plan, plan
from pgjax.scenes.choices import Choices, chosen, with_spacing
from pgjax.scenes.draft_text import written
from pgjax.scenes.inspect import Findings, inspect
from pgjax.scenes.reader import SceneError, Table, naming
from pgjax.scenes.schema import scene_from

# An inside is worth filling if it has this part of the particles.
_HOLLOW = 0.1
# The spacing of a body with an inside, in its size, at most.
_SOLID = 1 / 25
# Seconds on two cores: at most, and what they go with (measured): to compile, for a million
# particles or cells and a step, for a picture and a million Gaussians in it.
_LONGEST, _COARSER, _COARSEST, _TRIES = 120.0, 1.5, 1 / 12, 2
_COMPILING, _PARTICLES, _CELLS, _PICTURE, _GAUSSIANS = 15.0, 0.10, 0.01, 0.05, 0.6


@dataclasses.dataclass(frozen=True)
class Draft:
    """A scene file that runs.

    Attributes:
        text: of the file.
        findings: what the capture looks like.
        choices: what was chosen.
        plan: what the scene comes to.
        seconds: that a run takes on two cores, estimated.
    """

    text: str
    findings: Findings
    choices: Choices
    plan: Plan
    seconds: float


def draft(ply: Path, out: Path) -> Draft:
    """Look at a capture and describe a scene of it, as a file at `out`; nothing is written.

    Raises:
        ValueError: the capture cannot be read, or there is too little in it.
    """
    capture = load_capture(ply)
    with naming(str(ply)):
        findings = inspect(capture.gaussians)
    with naming(str(ply)):
        choices, moving = chosen(findings, capture.gaussians)
    path = os.path.relpath(ply, out.parent)
    made, choices = _planned(path, out, findings, choices, moving)
    for _ in range(_TRIES):
        if estimate(made) <= _LONGEST or choices.spacing >= _COARSEST * choices.size:
            break
        choices = with_spacing(choices, moving, _COARSER * choices.spacing)
        made, choices = _planned(path, out, findings, choices, moving)
    seconds = estimate(made)
    text = written(path, out.stem, findings, choices, made, seconds)
    return Draft(text, findings, choices, made, seconds)


def estimate(made: Plan) -> float:
    """Seconds that a run takes on two cores, roughly."""
    scene = made.scene
    cells = math.prod(scene.grid.shape)
    step = (_PARTICLES * scene.particle_count + _CELLS * cells) / 1e6
    picture = _PICTURE + _GAUSSIANS * (len(made.moving) + 0.2 * len(made.still)) / 1e6
    return _COMPILING + made.frames * (made.substeps * step + picture)


def _planned(
    path: str, out: Path, findings: Findings, choices: Choices, moving: Gaussians
) -> tuple[Plan, Choices]:
    """What the scene comes to, without the inside if there is hardly one."""
    if not choices.fill:
        return _plan(path, out, findings, choices), choices
    try:
        # An inside holds together what would be too few Gaussians for so fine a grid.
        fine = with_spacing(choices, moving, min(choices.spacing, _SOLID * choices.size))
        made = _plan(path, out, findings, fine)
        inside = made.scene.particle_count - _surface(made, len(moving))
        if inside >= _HOLLOW * made.scene.particle_count:
            return made, fine
    except SceneError:
        # A body too fine or too large to be filled.
        pass
    empty = choices._replace(fill=False)
    return _plan(path, out, findings, empty), empty


def _surface(made: Plan, count: int) -> int:
    """How many particles are not from the inside."""
    for note in made.notes:
        if note.startswith("splitting: "):
            count = int(note.rsplit(" ", 1)[1])
    return count


def _plan(path: str, out: Path, findings: Findings, choices: Choices) -> Plan:
    text = written(path, out.stem, findings, choices, None, 0.0)
    table = Table(out.name, tomllib.loads(text), out.parent)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return plan(scene_from(table, out.stem))
