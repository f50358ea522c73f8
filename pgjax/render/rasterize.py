"""Drawing Gaussians: project, sort, composite front to back. Pure functions of JAX."""

import functools
import warnings
from collections.abc import Callable
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from pgjax import native
from pgjax._types import Array, Float, Int, concrete, require
from pgjax.render import compositing
from pgjax.render.camera import Camera, Triple
from pgjax.render.gaussians import Gaussians
from pgjax.render.primitive import composite
from pgjax.render.projection import Splat, project
from pgjax.render.rules import RULE_3DGS, Rule


@final
class Image(eqx.Module):
    """A rendered image.

    Attributes:
        rgb: colour over the background; not bounded by 1.
        alpha: opacity, `Σ w` with the weights w of the Gaussians along each ray.
        depth: expected camera depth Z, `Σ w Z / Σ w` (0 where alpha is 0).
        depth_acc: accumulated depth `Σ w Z`.
        features: accumulated features `Σ w f`.
        not_finite: how many Gaussians were left out because they are not finite.
        pairs: how many pairs (Gaussian, tile) there are. In plain JAX inside of `jit` the lists
            have a fixed capacity; where it is exceeded, the image is NaN.
    """

    rgb: Float[Array, "h w 3"]
    alpha: Float[Array, "h w"]
    depth: Float[Array, "h w"]
    depth_acc: Float[Array, "h w"]
    features: Float[Array, "h w k"]
    not_finite: Int[Array, ""]
    pairs: Int[Array, ""]


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Triple | Float[ArrayLike, "h w 3"] = (0.0, 0.0, 0.0),
    features: Float[Array, "n k"] | None = None,
    rule: Rule = RULE_3DGS,
    antialiased: bool = False,
    capacity: int | None = None,
) -> Image:
    """Draw Gaussians: `rgb = Σ w_i c_i + (1 − Σ w_i) background`, `w_i = α_i Π_{j<i} (1 − α_j)`.

    The image has the precision of the Gaussians. Gaussians that are not finite are left out, with a
    warning outside of `jit`. The number of splats per tile is not limited. Derivatives with respect
    to every array are exact where the image is continuous: the order of the Gaussians, the cutoff
    at `alpha_min` and the end of the rays are held fixed, and a clamped alpha has none.

    Args:
        gaussians: what to draw.
        camera: from where.
        background: behind everything: red, green, blue, or an image of them.
        features: further numbers per Gaussian, accumulated like its colour.
        rule: constants of the compositing.
        antialiased: dim small Gaussians by what the low-pass filter adds to their area.
        capacity: for plain JAX inside of `jit` (a GPU, or no compiler) only: how many pairs
            (Gaussian, tile) the lists can hold. By default as many as there can be, but not more
            than a million or 16 per Gaussian; see `Image.pairs`.

    Fails when: in plain JAX inside of `jit` the capacity is too small (the image is NaN).

    Reference: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
    ACM Transactions on Graphics 42(4), 2023; M. Zwicker et al., "EWA volume splatting", 2001.
    """
    dtype = gaussians.means.dtype
    behind = image_behind(background, camera).astype(dtype)
    features = rows_of(features, gaussians)
    constants = constants_of(rule, dtype)
    if capacity is None:
        needed = functools.partial(_needed, gaussians, camera, constants, antialiased=antialiased)
        capacity = capacity_for(len(gaussians), camera, dtype, needed)
    image = _render(
        gaussians,
        camera,
        behind,
        features,
        constants,
        antialiased=antialiased,
        capacity=capacity,
    )
    warn_of_broken(image, len(gaussians), stacklevel=3)
    return image


def rows_of(features: Float[Array, "n k"] | None, gaussians: Gaussians) -> Float[Array, "n k"]:
    """The features in the precision of the Gaussians; none are rows of length 0."""
    n, dtype = len(gaussians), gaussians.means.dtype
    if features is None:
        return jnp.zeros((n, 0), dtype)
    if features.shape[0] != n:
        raise ValueError(
            f"Argument `features` must have one row for each of {n} Gaussians, but has shape "
            f"{features.shape}."
        )
    return features.astype(dtype)


def warn_of_broken(image: Image, n: int, *, stacklevel: int) -> None:
    """Say how many of n Gaussians are not drawn, outside of `jit`."""
    broken = concrete(image.not_finite)
    if broken is not None and broken > 0:
        warnings.warn(
            f"{broken} of {n} Gaussians are not finite, or overflow in {image.rgb.dtype}, and are "
            "not drawn.",
            stacklevel=stacklevel,
        )


def image_behind(background: Triple | ArrayLike, camera: Camera) -> Array:
    """Three numbers, or one image of them."""
    behind = jnp.asarray(background)
    if behind.shape not in ((3,), (camera.height, camera.width, 3)):
        raise ValueError(
            f"Argument `background` must be three numbers or an image of shape ({camera.height}, "
            f"{camera.width}, 3), but has shape {behind.shape}."
        )
    require("background", behind, "be finite", np.isfinite)
    return behind


def constants_of(rule: Rule, dtype: np.dtype) -> Float[Array, "5"]:
    """Those of the rule as an array, so that another rule does not recompile."""
    numbers = (rule.alpha_max, rule.alpha_min, rule.stop, float(rule.smooth), rule.low_pass)
    return jnp.asarray(numbers, dtype=dtype)


@functools.partial(jax.jit, static_argnames=("antialiased", "capacity"))
def _render(
    gaussians: Gaussians,
    camera: Camera,
    background: Array,
    features: Float[Array, "n k"],
    constants: Float[Array, "5"],
    *,
    antialiased: bool,
    capacity: int,
) -> Image:
    splats = project(gaussians, camera, constants[4], antialiased=antialiased)
    return draw(splats, splats.depth, camera, background, features, constants[:4], capacity)


def draw(
    splats: Splat,
    key: Float[Array, " n"],
    camera: Camera,
    background: Array,
    features: Float[Array, "n k"],
    limits: Float[Array, "4"],
    capacity: int,
) -> Image:
    """The image of splats that are sorted by `key`."""
    values = jnp.concatenate([splats.color, splats.depth[:, None], features], axis=1)
    sums, alpha, pairs = composite(
        limits,
        shape_of(splats),
        values,
        key,
        width=camera.width,
        height=camera.height,
        capacity=capacity,
    )
    depth_acc = sums[..., 3]
    seen = alpha > 0
    behind = jnp.broadcast_to(background, (camera.height, camera.width, 3))
    return Image(
        rgb=sums[..., :3] + (1 - alpha[..., None]) * behind,
        alpha=alpha,
        depth=jnp.where(seen, depth_acc / jnp.where(seen, alpha, 1), 0),
        depth_acc=depth_acc,
        features=sums[..., 4:],
        not_finite=jnp.sum(~splats.finite, dtype=jnp.int32),
        pairs=pairs,
    )


def shape_of(splats: Splat) -> Float[Array, "n 6"]:
    """u, v, m, p, q, opacity of each splat.

    `σ = p (dx − m dy)² + q dy²` with m = xy/yy, p = yy/(2 det), q = 1/(2 yy) is a sum of squares:
    even for a needle that crosses the whole image rounding leaves it positive and accurate.
    """
    yy = splats.variances[:, 1]
    columns = [
        *splats.center.T,
        splats.covariance / yy,
        yy / (2 * splats.det),
        1 / (2 * yy),
        splats.opacity,
    ]
    return jnp.stack(columns, axis=-1)


def capacity_for(
    n: int, camera: Camera, dtype: np.dtype, needed: Callable[[], Int[Array, ""]]
) -> int:
    """Length of the lists of plain JAX: what is needed, or inside of `jit` what may be needed."""
    default = compositing.default_capacity(n, camera.width, camera.height)
    if native.available() and native.library("raster", jnp.dtype(dtype).name) is not None:
        return default
    number = concrete(needed())
    if number is None:
        return default
    # Of a few lengths only: each is compiled once.
    return 1 << max(10, int(number - 1).bit_length())


@functools.partial(jax.jit, static_argnames="antialiased")
def _needed(
    gaussians: Gaussians, camera: Camera, constants: Float[Array, "5"], *, antialiased: bool
) -> Int[Array, ""]:
    splats = project(gaussians, camera, constants[4], antialiased=antialiased)
    return pairs_of(splats, camera, constants[:4])


def pairs_of(splats: Splat, camera: Camera, limits: Float[Array, "4"]) -> Int[Array, ""]:
    """How many pairs (splat, tile) there are."""
    return compositing.needed_capacity(
        limits, shape_of(splats), splats.depth, width=camera.width, height=camera.height
    )
