"""Drawing what moves among what stands still: the latter is projected once for each camera."""

import functools
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from pgjax._types import Array, Float, Int
from pgjax.render.camera import Camera, Triple
from pgjax.render.gaussians import Gaussians
from pgjax.render.projection import Splat, project
from pgjax.render.rasterize import (
    Image,
    capacity_for,
    constants_of,
    draw,
    image_behind,
    pairs_of,
    rows_of,
    warn_of_broken,
)
from pgjax.render.rules import RULE_3DGS, Rule


@final
class Surroundings(eqx.Module):
    """Gaussians that stand still, as one camera sees them; `prepare_surroundings` makes them.

    Others are drawn among them with `render`: in front, behind and between, by depth, Gaussian
    by Gaussian. Camera, rule and antialiasing are those of the surroundings.

    Attributes:
        splats: the projected Gaussians.
        features: their further numbers.
        camera: from where they are seen.
        constants: alpha_max, alpha_min, stop, smooth and low_pass of the rule.
        antialiased: whether small Gaussians are dimmed.
    """

    splats: Splat
    features: Float[Array, "n k"]
    camera: Camera
    constants: Float[Array, "5"]
    antialiased: bool = eqx.field(static=True)

    def __len__(self) -> int:
        return self.features.shape[0]

    def render(
        self,
        moving: Gaussians,
        *,
        background: Triple | Float[ArrayLike, "h w 3"] = (0.0, 0.0, 0.0),
        features: Float[Array, "m k"] | None = None,
        capacity: int | None = None,
    ) -> Image:
        """The image that `render` makes of `concatenate([moving, still])`, up to rounding.

        A pure function of all arrays, like that: derivatives with respect to the moving Gaussians
        are the same, and so are those of the still ones if they are prepared inside of the
        differentiated function.

        Args:
            moving: what is drawn among the surroundings, of the same precision.
            background: behind everything: red, green, blue, or an image of them.
            features: further numbers of the moving Gaussians, as many each as the surroundings
                have.
            capacity: see `render`.

        Fails when: in plain JAX inside of `jit` the capacity is too small (the image is NaN).
        """
        dtype = self.constants.dtype
        if moving.means.dtype != dtype:
            raise ValueError(
                f"Argument `moving` must have the precision {dtype} of the surroundings, but has "
                f"{moving.means.dtype}."
            )
        own = rows_of(features, moving)
        if own.shape[1] != self.features.shape[1]:
            raise ValueError(
                f"Argument `features` must have {self.features.shape[1]} columns like the features "
                f"of the surroundings, but has {own.shape[1]}."
            )
        behind = image_behind(background, self.camera).astype(dtype)
        number = len(moving) + len(self)
        if capacity is None:
            needed = functools.partial(_needed_among, moving, self)
            capacity = capacity_for(number, self.camera, dtype, needed)
        image = _render_among(moving, self, behind, own, capacity=capacity)
        warn_of_broken(image, number, stacklevel=3)
        return image


def prepare_surroundings(
    still: Gaussians,
    camera: Camera,
    *,
    features: Float[Array, "n k"] | None = None,
    rule: Rule = RULE_3DGS,
    antialiased: bool = False,
) -> Surroundings:
    """Project Gaussians once, to draw others among them many times.

    It pays where many stand still: their projection and colours are a sixth to a third of the
    time of an image, the more the smaller it is and the higher the degree of the harmonics.

    Args:
        still: what does not move.
        camera: from where it is seen.
        features: further numbers per Gaussian, accumulated like its colour.
        rule: constants of the compositing.
        antialiased: dim small Gaussians by what the low-pass filter adds to their area.
    """
    constants = constants_of(rule, still.means.dtype)
    splats = _projected(still, camera, constants, antialiased=antialiased)
    return Surroundings(splats, rows_of(features, still), camera, constants, antialiased)


@functools.partial(jax.jit, static_argnames="antialiased")
def _projected(
    gaussians: Gaussians, camera: Camera, constants: Float[Array, "5"], *, antialiased: bool
) -> Splat:
    return project(gaussians, camera, constants[4], antialiased=antialiased)


def _together(moving: Gaussians, around: Surroundings) -> Splat:
    """All splats, those that move first: the order of equal depths."""
    splats = project(moving, around.camera, around.constants[4], antialiased=around.antialiased)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), splats, around.splats)


@jax.jit
def _needed_among(moving: Gaussians, around: Surroundings) -> Int[Array, ""]:
    return pairs_of(_together(moving, around), around.camera, around.constants[:4])


@functools.partial(jax.jit, static_argnames="capacity")
def _render_among(
    moving: Gaussians,
    around: Surroundings,
    background: Array,
    features: Float[Array, "m k"],
    *,
    capacity: int,
) -> Image:
    splats = _together(moving, around)
    rows = jnp.concatenate([features, around.features])
    limits = around.constants[:4]
    return draw(splats, splats.depth, around.camera, background, rows, limits, capacity)
