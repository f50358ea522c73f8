"""What is swept: a block thrown on the floor, of materials that differ from member to member."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

import pgjax
from pgjax import boundary, models, sampling

MATERIALS = ("fixed corotated", "von Mises", "Drucker-Prager")
H = 1 / 32
# Half of the stable step of the stiffest member, of both schemes.
E_LARGEST, NU_LARGEST = 2e5, 0.4


@dataclasses.dataclass(frozen=True)
class Case:
    """One sweep.

    Attributes:
        material: a name of `MATERIALS`.
        side: particles along an edge of the block, two per cell.
        members: how many.
        frames: to run.
        substeps: per frame.
    """

    material: str
    side: int
    members: int
    frames: int
    substeps: int

    @property
    def particles(self) -> int:
        """Of a member."""
        return self.side**3

    @property
    def vary(self) -> list[dict[str, float]]:
        """Values of the members: stiffnesses and Poisson's ratios, a scrambled lattice of them."""
        u = np.arange(self.members) / self.members
        golden = (np.arange(self.members) * 0.618034) % 1
        stiffness = 2e4 * (E_LARGEST / 2e4) ** u
        return [
            {"E": float(e), "nu": float(n)}
            for e, n in zip(stiffness, 0.1 + (NU_LARGEST - 0.1) * golden, strict=True)
        ]

    def build(self) -> Any:
        """`build` of the sweep, and the time step, s."""
        size = self.side * H / 2
        cells = max(24, round(2 * size / H) + 8)
        grid = pgjax.Grid((0, 0, 0), (cells,) * 3, H)
        low, high = 3 * H, (cells - 3) * H
        corner = np.asarray([(cells * H - size) / 2] * 2 + [low + H / 2])
        x, volumes = sampling.block(corner, corner + size, spacing=H / 2)
        floor = boundary.Box((low,) * 3, (high,) * 3, boundary.Separating(friction=0.3))

        def build(values: dict[str, Any]) -> tuple[pgjax.Scene, pgjax.State]:
            material = models.Material(*_law(self.material, values["E"], values["nu"]))
            scene = pgjax.Scene(
                grid,
                material,
                volumes,
                gravity=(0, 0, -9.81),
                boundaries=[floor],
                scheme=pgjax.MLS(),
            )
            return scene, pgjax.initial_state(scene, x, jnp.asarray([0.3, 0.0, -1.0]))

        stiffest, _ = build({"E": E_LARGEST, "nu": NU_LARGEST})
        return build, 0.5 * float(stiffest.rest_limit())


def _law(material: str, E: Any, nu: Any) -> tuple[Any, ...]:
    if material == "von Mises":
        return models.StVKHencky(E, nu), models.VonMises(1e3)
    if material == "Drucker-Prager":
        return models.StVKHencky(E, nu), models.DruckerPrager(30.0)
    return (models.FixedCorotated(E, nu),)
