"""Gaussians as the browser draws them: centre, covariance, one colour, opacity."""

from typing import NamedTuple

import jax
import numpy as np

from pgjax._types import Array, Float
from pgjax.render import Gaussians
from pgjax.render.projection import view_color


class Splats(NamedTuple):
    """n Gaussians without view dependence.

    Attributes:
        centers: in the units of the scene, float32 `(n, 3)`.
        covariances: float32 `(n, 3, 3)`.
        rgbs: colours from 0 to 255, uint8 `(n, 3)`.
        opacities: in [0, 1], float32 `(n, 1)`.
    """

    centers: np.ndarray
    covariances: np.ndarray
    rgbs: np.ndarray
    opacities: np.ndarray


def splats(gaussians: Gaussians, eye: Float[Array, "3"]) -> Splats:
    """The Gaussians with the colours that they have when seen from `eye`.

    A Gaussian that is not finite gets the opacity 0, and is not seen.
    """
    colors = np.asarray(_colors(gaussians, eye.astype(gaussians.means.dtype)))
    centers, covariances, opacities = (
        np.asarray(a, np.float32)
        for a in (gaussians.means, gaussians.covariances, gaussians.opacities[:, None])
    )
    finite = np.isfinite(centers).all(1) & np.isfinite(covariances).all((1, 2))
    finite &= np.isfinite(colors).all(1) & np.isfinite(opacities[:, 0])
    if not finite.all():
        centers, covariances, colors, opacities = (
            np.where(finite.reshape(-1, *[1] * (a.ndim - 1)), a, 0)
            for a in (centers, covariances, colors, opacities)
        )
    rgbs = np.rint(255 * np.clip(colors, 0, 1)).astype(np.uint8)
    return Splats(centers, covariances, rgbs, opacities)


@jax.jit
def _colors(gaussians: Gaussians, eye: Array) -> Array:
    color = jax.vmap(lambda sh, frame, mean: view_color(sh, frame, mean - eye))
    return color(gaussians.sh, gaussians.frames, gaussians.means)


def together(first: Splats, second: Splats | None) -> Splats:
    """The splats of both."""
    if second is None:
        return first
    return Splats(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


def unit_of(shown: Splats) -> float:
    """A length for which covariances are of the order of one: a typical standard deviation.

    The browser gets covariances in half precision, which has few digits below 6e-5 and none below
    6e-8: in metres, the Gaussians of a small object would vanish.
    """
    variances = np.trace(shown.covariances, axis1=1, axis2=2) / 3
    positive = variances[variances > 0]
    return float(np.sqrt(np.median(positive))) if len(positive) else 1.0


def middle(shown: Splats) -> np.ndarray:
    """The point in the middle of what is shown, `(3,)`."""
    return np.median(shown.centers, axis=0).astype(np.float64)
