"""The scenes: a block of jelly, sand or metal that is thrown at the floor of a box."""

from typing import Any

import numpy as np

import pgjax
from pgjax import boundary, models, sampling

E, NU, DENSITY, H = 1e5, 0.3, 1000.0, 0.05
GRAVITY = (0.0, 0.0, -9.81)


def thrown(
    *materials: models.Material,
    side: int = 12,
    cells: int = 24,
    walls: Any = None,
    scheme: Any = None,
    dtype: Any = np.float32,
) -> tuple[pgjax.Scene, pgjax.State]:
    """A cube of `side` cells with eight particles each, 0.5 cells above the floor of a box.

    Args:
        materials: of its layers, lowest first.
        side: of the cube, in cells.
        cells: of the grid along each direction.
        walls: conditions of the grid; a box with friction if None.
        scheme: MLS if None.
        dtype: precision.
    """
    low, room = 4 * H, (3 * H, (cells - 3) * H)
    x, volumes = sampling.block((low,) * 3, (low + side * H,) * 3, spacing=H / 2)
    x[:, 2] += H / 2 - H
    order = np.argsort(x[:, 2], kind="stable")
    counts = [len(part) for part in np.array_split(order, len(materials))]
    box = boundary.Box((room[0],) * 3, (room[1],) * 3, boundary.Separating(0.4))
    scene = pgjax.Scene(
        pgjax.Grid((0, 0, 0), (cells,) * 3, H),
        materials,
        volumes[order],
        counts=counts,
        gravity=GRAVITY,
        boundaries=[box] if walls is None else walls,
        scheme=pgjax.MLS() if scheme is None else scheme,
    )
    return scene, pgjax.initial_state(scene, x[order], (1.0, 0.0, -2.0), dtype=dtype)


def jelly(law: Any = models.FixedCorotated) -> models.Material:
    """Elastic."""
    return models.Material(law(E, NU), density=DENSITY)


def sand() -> models.Material:
    """Drucker–Prager, 30°."""
    return models.Material(models.StVKHencky(E, NU), models.DruckerPrager(30.0), DENSITY)


def metal(limit: float = 5e3) -> models.Material:
    """Von Mises."""
    return models.Material(models.StVKHencky(E, NU), models.VonMises(limit), DENSITY)
