"""What is seen of a motion, and how far that is from what was recorded.

Residuals are vectors without unit: differences over the standard deviation of the noise.
"""

import abc
import copy
import itertools
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Float, as_float_array, nonnegative, positive, require
from pgjax.inverse.matching import Chamfer, Sinkhorn
from pgjax.state import State

Robust = Callable[[Array], Array]


class AbstractObservation(eqx.Module):
    """Something measured in some of the frames.

    Attributes:
        frames: numbers of the frames it was measured in, ascending; 0 is the initial state.
        data: what was measured, `(frames, …)`.
        sigma: standard deviation of the noise of the data.
        weights: factor of each of these frames in the loss.
        robust: what is done to the residual, e.g. `Huber()`; nothing if None.
    """

    frames: eqx.AbstractVar[tuple[int, ...]]
    data: eqx.AbstractVar[Array]
    sigma: eqx.AbstractVar[Array]
    weights: eqx.AbstractVar[Array]
    robust: eqx.AbstractVar[Robust | None]

    @abc.abstractmethod
    def see(self, state: State) -> Any:
        """What is kept of a state: an array, or a tree of them."""

    @abc.abstractmethod
    def compare(self, seen: Any) -> Float[Array, "frames *rest"]:
        """Differences to the data over their noise, of the observed frames."""

    def part(self, chosen: np.ndarray) -> "AbstractObservation":
        """The observation of some of the frames, by their places in `frames`."""
        sigma_varies = self.sigma.ndim == self.data.ndim and self.sigma.shape[0] > 1
        new = copy.copy(self)
        for name, value in (
            ("frames", tuple(self.frames[i] for i in chosen)),
            ("data", self.data[chosen]),
            ("sigma", self.sigma[chosen] if sigma_varies else self.sigma),
            ("weights", self.weights[chosen]),
        ):
            object.__setattr__(new, name, value)
        return new

    def residual(self, seen: Any) -> Float[Array, " k"]:
        """Residual vector from what was seen of all frames, `(frames + 1, …)`."""
        index = np.asarray(self.frames)
        r = self.compare(jax.tree.map(lambda a: a[index], seen))
        r = r.reshape(r.shape[0], -1)
        if self.robust is not None:
            r = self.robust(r)
        return (r * jnp.sqrt(self.weights.astype(r.dtype))[:, None]).ravel()

    def until(self, frame: int) -> "AbstractObservation | None":
        """What was measured up to a frame; None if nothing was."""
        chosen = np.flatnonzero(np.asarray(self.frames) <= frame)
        return self.part(chosen) if len(chosen) else None

    def coarser(self, pixels: int) -> "AbstractObservation":
        """Seen through squares of so many pixels; the same where there are no pixels."""
        del pixels
        return self


@final
class Positions(AbstractObservation):
    """Positions of particles, each known by its number.

    Args:
        data: m, `(frames, k, d)`. NaN marks what was not seen.
        frames: numbers of the frames; `1, 2, …` if None.
        particles: which k particles of the simulation; all if None.
        sigma: standard deviation of the noise, m: one number, or anything that broadcasts with
            `data`.
        weights: factor of each frame in the loss; 1 if None.
        robust: e.g. `Huber()`, for outliers.
    """

    frames: tuple[int, ...] = eqx.field(static=True)
    data: Array
    particles: Array | None
    sigma: Array
    weights: Array
    robust: Robust | None

    def __init__(
        self,
        data: Any,
        *,
        frames: Sequence[int] | None = None,
        particles: Any = None,
        sigma: Any = 1e-3,
        weights: Any = None,
        robust: Robust | None = None,
    ):
        self.data = as_float_array(data)
        _check_rank("data", self.data, 3, "(frames, particles, d)")
        self.frames = observed_frames(frames, self.data.shape[0])
        self.particles = (
            None if particles is None else particle_numbers(particles, self.data.shape[1])
        )
        self.sigma = deviation_of(sigma, self.data.shape, "m")
        self.weights = frame_weights(weights, self.frames)
        self.robust = robust

    def see(self, state: State) -> Array:
        """Positions of the observed particles."""
        return _places(state, self.particles)

    def compare(self, seen: Any) -> Array:
        """`(x − data)/sigma`; 0 where nothing was seen."""
        if seen.shape != self.data.shape:
            raise ValueError(
                f"Argument `data` must have the shape {seen.shape} of what is observed, but has "
                f"{self.data.shape}."
            )
        return differences(seen, self.data, self.sigma)


@final
class Cloud(AbstractObservation):
    """Points that lie in the body, without knowing which particle each of them is.

    Args:
        data: m, `(frames, k, d)`.
        matching: `Chamfer()`, or `Sinkhorn(blur)` for up to some thousand points.
        frames, particles, sigma, weights, robust: as for `Positions`; sigma is one number.
    """

    frames: tuple[int, ...] = eqx.field(static=True)
    data: Array
    matching: Chamfer | Sinkhorn
    particles: Array | None
    sigma: Array
    weights: Array
    robust: Robust | None

    def __init__(
        self,
        data: Any,
        *,
        matching: Chamfer | Sinkhorn | None = None,
        frames: Sequence[int] | None = None,
        particles: Any = None,
        sigma: Any = 1e-3,
        weights: Any = None,
        robust: Robust | None = None,
    ):
        self.data = as_float_array(data)
        _check_rank("data", self.data, 3, "(frames, points, d)")
        require("data", self.data, "be finite", np.isfinite)
        self.matching = Chamfer() if matching is None else matching
        self.frames = observed_frames(frames, self.data.shape[0])
        self.particles = None if particles is None else particle_numbers(particles, None)
        self.sigma = deviation_of(sigma, (), "m")
        self.weights = frame_weights(weights, self.frames)
        self.robust = robust

    def see(self, state: State) -> Array:
        """Positions of the particles."""
        return _places(state, self.particles)

    def compare(self, seen: Any) -> Array:
        """Differences of matched points over sigma."""
        pairs = (seen, self.data.astype(seen.dtype))
        off = jax.lax.map(lambda pair: self.matching(*pair), pairs)
        return off / self.sigma.astype(off.dtype)


def _places(state: State, particles: Array | None) -> Array:
    """Positions of these particles, or of all."""
    return state.x if particles is None else state.x[particles]


def observed_frames(frames: Sequence[int] | None, count: int) -> tuple[int, ...]:
    """Numbers of the frames of `count` data, checked."""
    numbers = tuple(range(1, count + 1)) if frames is None else tuple(int(f) for f in frames)
    if len(numbers) != count or not count:
        raise ValueError(
            f"Argument `frames` must give one number for each of the {count} observed frames, but "
            f"gives {len(numbers)}."
        )
    if numbers[0] < 0 or any(b <= a for a, b in itertools.pairwise(numbers)):
        raise ValueError(f"Argument `frames` must ascend from at least 0, but is {numbers}.")
    return numbers


def frame_weights(weights: Any, frames: tuple[int, ...]) -> Array:
    """One factor per observed frame, checked."""
    if weights is None:
        return jnp.ones((len(frames),))
    weights = as_float_array(weights)
    if weights.shape != (len(frames),):
        raise ValueError(
            f"Argument `weights` must have shape ({len(frames)},), but has shape {weights.shape}."
        )
    require("weights", weights, "be at least 0 and finite", nonnegative)
    return weights


def differences(seen: Array, data: Array, sigma: Array) -> Array:
    """Over the noise; 0 where the data are NaN, with no derivative there."""
    data = data.astype(seen.dtype)
    known = jnp.isfinite(data)
    return jnp.where(known, seen - jnp.where(known, data, 0), 0) / sigma.astype(seen.dtype)


def _check_rank(name: str, value: Array, rank: int, axes: str) -> None:
    if value.ndim != rank:
        raise ValueError(f"Argument `{name}` must have axes {axes}, but has shape {value.shape}.")


def particle_numbers(particles: Any, count: int | None) -> Array:
    """Numbers of particles, as many as there are data for."""
    index = np.asarray(particles)
    if index.ndim != 1 or not np.issubdtype(index.dtype, np.integer) or (index < 0).any():
        raise ValueError(
            "Argument `particles` must be a list of whole numbers ≥ 0, but is "
            f"{index.dtype} of shape {index.shape}."
        )
    if count is not None and len(index) != count:
        raise ValueError(
            f"Argument `particles` must name {count} particles, as many as the data have, but names"
            f" {len(index)}."
        )
    return jnp.asarray(index)


def deviation_of(sigma: Any, shape: tuple[int, ...], unit: str) -> Array:
    """Standard deviation of the noise, checked."""
    value = as_float_array(sigma)
    require("sigma", value, f"be positive and finite ({unit})", positive)
    try:
        fits = np.broadcast_shapes(value.shape, shape) == shape
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(
            f"Argument `sigma` must broadcast with the data, of shape {shape}, but has shape "
            f"{value.shape}."
        )
    return value
