"""What cameras see of a motion."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._types import Array, as_float_array
from pgjax.inverse.observations import (
    AbstractObservation,
    Robust,
    deviation_of,
    differences,
    frame_weights,
    observed_frames,
    particle_numbers,
)
from pgjax.render import (
    Camera,
    Gaussians,
    Rule,
    Similarity,
    concatenate,
    deform,
    render,
    stack_cameras,
)
from pgjax.state import State

# Renderings that are differentiated never end a ray early, and have no jump at their edge.
SMOOTH = Rule(alpha_max=0.999, stop=0.0, smooth=True)


@final
class Pictures(AbstractObservation):
    """Pictures of the Gaussians that move with the particles, from one camera or many.

    Args:
        gaussians: one per observed particle, or as many as `carry` returns, undeformed, in the
            axes of `to_simulation`.
        cameras: one `Camera`, or several of one size.
        data: `(frames, cameras, height, width)` for silhouettes (opacity, 0 to 1) and depth (m),
            with a last axis of 3 for rgb (0 to 1); the axis of cameras is left out with one
            `Camera`. NaN marks pixels that do not count.
        channel: "rgb", "silhouette" or "depth" (0 where nothing is seen). A pixel of depth where
            data and picture do not agree that there is something counts as three deviations.
        background: of rgb: red, green, blue, or an image.
        frames, weights, robust: as for `Positions`.
        sigma: standard deviation of a pixel's noise, in its unit.
        particles: which particles carry the Gaussians; all if None.
        carry: from positions and deformation gradients of these particles to those of the
            Gaussians, differentiable; a Gaussian moves as its particle if None.
        to_simulation: from the coordinates of the Gaussians and cameras to the simulation's.
        still: Gaussians that do not move, in the coordinates of the others.
        rule: of the compositing.
    """

    frames: tuple[int, ...] = eqx.field(static=True)
    channel: str = eqx.field(static=True)
    rule: Rule
    gaussians: Gaussians
    cameras: Camera
    single: bool = eqx.field(static=True)
    data: Array
    background: Array
    particles: Array | None
    carry: Callable[[Array, Array], tuple[Array, Array]] | None
    to_simulation: Similarity | None
    still: Gaussians | None
    sigma: Array
    weights: Array
    robust: Robust | None
    square: int = eqx.field(static=True)

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Camera | Sequence[Camera],
        data: Any,
        *,
        channel: str = "rgb",
        background: Any = (0.0, 0.0, 0.0),
        frames: Sequence[int] | None = None,
        sigma: Any = 0.05,
        particles: Any = None,
        carry: Callable[[Array, Array], tuple[Array, Array]] | None = None,
        to_simulation: Similarity | None = None,
        still: Gaussians | None = None,
        weights: Any = None,
        robust: Robust | None = None,
        rule: Rule = SMOOTH,
    ):
        if channel not in ("rgb", "silhouette", "depth"):
            raise ValueError(
                f'Argument `channel` must be "rgb", "silhouette" or "depth", but is {channel!r}.'
            )
        self.channel, self.rule, self.gaussians = channel, rule, gaussians
        self.single = isinstance(cameras, Camera)
        self.cameras = cameras if isinstance(cameras, Camera) else stack_cameras(cameras)
        self.data = as_float_array(data)
        self._check_data()
        self.background = as_float_array(background)
        self.frames = observed_frames(frames, self.data.shape[0])
        self.particles = None if particles is None else particle_numbers(particles, len(gaussians))
        self.carry = carry
        self.to_simulation, self.still = to_simulation, still
        self.sigma = deviation_of(sigma, self.data.shape, "the unit of a pixel")
        self.weights = frame_weights(weights, self.frames)
        self.robust = robust
        self.square = 1

    def coarser(self, pixels: int) -> "Pictures":
        """Differences are averaged over squares of so many pixels.

        Where a body is off by more than the size of what is drawn on it, pixels say little of
        where it went; squares still do.
        """
        if not isinstance(pixels, int) or pixels < 1:
            raise ValueError(f"Argument `pixels` must be a whole number ≥ 1, but is {pixels!r}.")
        new = copy.copy(self)
        object.__setattr__(new, "square", pixels)
        return new

    def see(self, state: State) -> Array:
        """The pictures of one instant."""
        x, F = state.x, state.F
        if self.particles is not None:
            x, F = x[self.particles], F[self.particles]
        if self.carry is not None:
            x, F = self.carry(x, F)
        if self.to_simulation is not None:
            x, F = self.to_simulation.inverse().apply(x), self.to_simulation.pull_back(F)
        moved = deform(self.gaussians, x, F)
        if self.still is not None:
            moved = concatenate([moved, self.still])

        def one(camera: Camera) -> Array:
            image = render(moved, camera, background=self.background, rule=self.rule)
            if self.channel == "rgb":
                return image.rgb
            return image.alpha if self.channel == "silhouette" else image.depth

        return one(self.cameras) if self.single else jax.lax.map(one, self.cameras)

    def compare(self, seen: Any) -> Array:
        """`(picture − data)/sigma`; 0 where a pixel does not count."""
        data = self.data.astype(seen.dtype)
        off = differences(seen, data, self.sigma)
        if self.channel != "depth":
            return _squares(off, self.square, 3 if self.channel == "rgb" else 2)
        # A difference in metres to nothing says nothing; leaving the silhouette must not pay.
        missed = jnp.where(jnp.isfinite(data) & ((seen > 0) != (data > 0)), 3, 0)
        off = jnp.where((seen > 0) & (data > 0), off, missed.astype(off.dtype))
        return _squares(off, self.square, 2)

    def _check_data(self) -> None:
        size = (self.cameras.height, self.cameras.width)
        count: tuple[int, ...] = self.cameras.world_to_camera.shape[:-2]
        expected = (*count, *size, *((3,) if self.channel == "rgb" else ()))
        if self.data.ndim != len(expected) + 1 or self.data.shape[1:] != expected:
            number = "one camera" if self.single else f"{count[0]} cameras"
            raise ValueError(
                f"Argument `data` must have shape (frames, {', '.join(map(str, expected))}) for "
                f"{self.channel} from {number} of {size[1]} × {size[0]} pixels, but has shape "
                f"{self.data.shape}."
            )


def _squares(off: Array, side: int, last: int) -> Array:
    """Differences averaged over squares of pixels, over the noise of the average.

    The axes of the pixels are the first two of the `last` ones; at the edge squares are not full.
    """
    if side == 1:
        return off
    rows = off.ndim - last
    room = [(0, -n % side if axis in (rows, rows + 1) else 0) for axis, n in enumerate(off.shape)]
    padded = jnp.pad(off, room)
    height, width = padded.shape[rows : rows + 2]
    split = (height // side, side, width // side, side)
    blocks = padded.reshape(*padded.shape[:rows], *split, *padded.shape[rows + 2 :])
    return jnp.sum(blocks, axis=(rows + 1, rows + 3)) / side
