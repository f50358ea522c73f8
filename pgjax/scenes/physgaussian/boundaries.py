"""The conditions of a configuration file, `boundary_conditions`, as walls and led particles.

Every condition is read strictly first; what it becomes depends on where the particles are.
"""

import dataclasses
from collections.abc import Callable

from pgjax.scenes.physgaussian.common import Make
from pgjax.scenes.physgaussian.leading import impulse, release, rotation, translation
from pgjax.scenes.physgaussian.walls import bounding_box, cuboid, surface_collider
from pgjax.scenes.reader import Table


@dataclasses.dataclass(frozen=True)
class BoundaryPart:
    """A condition, and how notes call it."""

    name: str
    make: Make


def boundary(t: Table) -> BoundaryPart:
    """A condition from its table."""
    return BoundaryPart(t.text("type"), t.kind("type", TYPES))


TYPES: dict[str, Callable[[Table], Make]] = {
    "bounding_box": bounding_box,
    "cuboid": cuboid,
    "surface_collider": surface_collider,
    "particle_impulse": impulse,
    "enforce_particle_translation": translation,
    "enforce_particle_velocity_rotation": rotation,
    "release_particles_sequentially": release,
}
"""The conditions by name."""
