"""The inside of a captured surface: particles that fill it, and Gaussians to draw them with.

They are hidden while the body is whole and show a solid where it is torn.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from pgjax.filling import FillReport, fill
from pgjax.render import Gaussians, concatenate
from pgjax.scenes.model import FillPart

# Particles at half the spacing of the nodes: eight in a cell.
PER_NODE = 0.5
_OPACITY = 0.99
# Colours of so many Gaussians are mixed: single ones, hidden under the surface, can have any.
_NEIGHBOURS = 16
# Standard deviations: half a spacing closes the inside, a third of the depth keeps it inside.
_OF_SPACING, _OF_DEPTH = 1 / 2, 1 / 3


class Interior(NamedTuple):
    """A body with its inside.

    Attributes:
        gaussians: those of the surface, then those of the inside.
        volumes: rest volumes of all, m³.
        nearest: index of the Gaussian of the surface nearest to each of the inside.
        report: what the filling found.
    """

    gaussians: Gaussians
    volumes: np.ndarray
    nearest: np.ndarray
    report: FillReport


def filled(part: FillPart, surface: Gaussians, grid_spacing: float) -> Interior:
    """Fill the closed bodies among the Gaussians of a surface, in simulation coordinates."""
    found = fill(
        surface.means,
        surface.covariances,
        surface.opacities,
        spacing=PER_NODE * grid_spacing if part.spacing is None else part.spacing,
        seal=part.seal,
        seed=part.seed,
        max_particles=part.max_particles,
    )
    if len(found.points) == 0:
        return Interior(surface, found.volumes, np.zeros(0, int), found.report)
    count = min(_NEIGHBOURS, len(surface))
    tree: Any = KDTree(np.asarray(surface.means))
    distance, near = tree.query(found.points, k=np.arange(1, count + 1))
    sigma = np.minimum(_OF_SPACING * found.report.spacing, _OF_DEPTH * distance[:, 0])
    inside = _balls(surface, found.points, sigma, _mixed_colour(surface, near))
    return Interior(concatenate([surface, inside]), found.volumes, near[:, 0], found.report)


def _mixed_colour(surface: Gaussians, near: np.ndarray) -> np.ndarray:
    """Coefficients of degree 0, `(m, 3)`: those of neighbours by opacity times visible area."""
    sigma = np.linalg.svd(np.asarray(surface.factors, np.float64), compute_uv=False)
    weight = np.asarray(surface.opacities, np.float64) * sigma[:, 0] * sigma[:, 1]
    weight = np.where(np.isfinite(weight), np.maximum(weight, 1e-300), 1e-300)[near]
    colours = np.asarray(surface.sh[:, 0], np.float64)[near]
    return np.sum(weight[..., None] * colours, axis=1) / np.sum(weight, axis=1)[:, None]


def _balls(like: Gaussians, x: np.ndarray, sigma: np.ndarray, colour: np.ndarray) -> Gaussians:
    """Round Gaussians of one colour from all sides, nearly opaque."""
    dtype, n = like.means.dtype, len(x)
    sh = np.zeros((n, *like.sh.shape[1:]))
    sh[:, 0] = colour
    frames = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (n, 3, 3))
    return Gaussians(
        jnp.asarray(x, dtype),
        jnp.asarray(sigma, dtype)[:, None, None] * frames,
        jnp.full((n,), _OPACITY, dtype),
        jnp.asarray(sh, dtype),
        frames,
    )
