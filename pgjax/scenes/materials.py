"""The materials of a scene file: `[[material]]`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from pgjax.models import Material
from pgjax.models.material import particle_axes
from pgjax.scenes.arrays import field
from pgjax.scenes.fibres import active
from pgjax.scenes.laws import LAWS
from pgjax.scenes.reader import Table
from pgjax.scenes.regions import Selection, selection


@dataclasses.dataclass(frozen=True)
class MaterialPart:
    """A material and the particles it takes.

    Attributes:
        material: its parameters are single, or one per Gaussian of the model's file.
        takes: which particles, if no material before it does.
    """

    material: Material
    takes: Selection

    def of(self, rows: np.ndarray) -> Material:
        """The material of the particles that come from these Gaussians of the file."""
        if not self.takes.lengths:
            return self.material
        # All the files of a material are of one length by now.
        count = next(iter(self.takes.lengths.values()))
        axes = particle_axes(self.material, count)
        index = jnp.asarray(rows)
        return jax.tree.map(
            lambda axis, leaf: leaf if axis is None else leaf[index],
            axes,
            self.material,
            is_leaf=lambda leaf: leaf is None,
        )


def material(t: Table) -> MaterialPart:
    """A material from its table."""
    law, plasticity = t.kind("law", LAWS)
    density = field(t, "density", above=0)
    made = Material(law, plasticity, density, active=t.optional("active", active))
    return MaterialPart(made, selection(t))
