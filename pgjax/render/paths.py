"""Cameras that move: smooth paths through key frames, as functions of time."""

import itertools
from collections.abc import Callable, Sequence
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from pgjax._types import (
    Array,
    Float,
    Scalar,
    Vector3,
    as_float_array,
    as_tuple,
    concrete,
    require,
    require_kind,
    require_shape,
)
from pgjax.render.camera import Camera, Triple
from pgjax.render.gaussians import rotation_of

Quaternion = Float[Array, "4"]
Numbers = Sequence[ArrayLike] | ArrayLike

# How far, as a sine, a key frame of a level path may be rolled.
_LEVEL = 1e-4


@final
class CameraPath(eqx.Module):
    """A camera that moves smoothly through key frames: `path.at(t)` is the camera at time t.

    At the times of the keys it is the key, before the first and after the last it stands still,
    and velocity and angular velocity are continuous. Eyes, rotations and logarithms of the focal
    lengths each follow a cubic spline, the rotations one on SO(3), the shorter way around.

    `at` is a pure function of JAX: `jax.vmap(path.at)(times)` are the cameras of a batch.

    Attributes:
        times: of the key frames, s, increasing.
        cameras: the key frames, of one size; stacked, with a leading axis.
        up: if given, the camera never rolls: its x axis stays at right angles to this direction.
            The keys must be so, as those of `Camera.look_at` and `Camera.orbit` are.

    Fails when: a path with `up` looks along it between two keys; the camera is then NaN.

    Reference: K. Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.
    """

    times: Float[Array, " k"]
    cameras: Camera
    up: Vector3 | None

    def __init__(
        self, times: Numbers, cameras: Sequence[Camera] | Camera, *, up: Triple | None = None
    ):
        self.times = as_float_array(times, "times")
        self.cameras = _stacked(cameras)
        self.up = None if up is None else as_float_array(up, "up")

    def __check_init__(self):
        keys = self.cameras.world_to_camera
        _require_times(self.times, keys.shape[0] if keys.ndim == 3 else 1)
        if self.up is None:
            return
        require_shape("up", self.up, (3,))
        require("up", jnp.linalg.norm(self.up), "not be zero", lambda a: a > 0)
        tilts = jnp.abs(keys[:, 0, :3] @ (self.up / jnp.linalg.norm(self.up)).astype(keys.dtype))
        require("cameras", tilts, "not be rolled about `up`", lambda a: a < _LEVEL)

    def at(self, t: ArrayLike) -> Camera:
        """The camera at time t, s."""
        return _camera_at(self, jnp.asarray(t, self.cameras.world_to_camera.dtype))


@jax.jit
def _camera_at(path: CameraPath, t: Scalar) -> Camera:
    keys, dtype = path.cameras, t.dtype
    times = path.times.astype(dtype)
    turns, shifts = keys.world_to_camera[:, :3, :3], keys.world_to_camera[:, :3, 3]
    R = rotation_of(_spline(times, jax.vmap(quaternion_of)(turns), t, _turned, _turn_to))
    if path.up is not None:
        R = _levelled(R, path.up.astype(dtype))
    eye = _curve(times, -jnp.einsum("kji,kj->ki", turns, shifts), t)
    pose = jnp.eye(4, dtype=dtype).at[:3, :3].set(R).at[:3, 3].set(-R @ eye)
    sizes = jnp.stack([keys.fx, keys.fy, keys.near], axis=-1).astype(dtype)
    fx, fy, near = jnp.exp(_curve(times, jnp.log(sizes), t))
    cx, cy = _curve(times, jnp.stack([keys.cx, keys.cy], axis=-1).astype(dtype), t)
    return Camera(pose, fx, fy, cx, cy, keys.width, keys.height, near)


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """Cameras of one size as one record whose arrays have a leading axis, for `jax.vmap`.

    `jax.vmap(lambda camera: render(gaussians, camera))(stack_cameras(cameras))` draws from all of
    them at once.
    """
    cameras = list(as_tuple("cameras", cameras))
    for camera in cameras:
        require_kind("cameras", camera, Camera)
    if not cameras:
        raise ValueError("Argument `cameras` must hold at least one camera, but is empty.")
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        raise ValueError(
            "Argument `cameras` must hold cameras of one size (width, height), but has "
            f"{', '.join(map(str, sizes))}."
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)


def interpolate(
    times: Numbers, values: Float[ArrayLike, "k m"], t: ArrayLike
) -> Float[Array, " m"]:
    """The smooth curve through `values` at `times`, at time t; constant outside of the times.

    A cubic Hermite spline whose slope at a key is that of the parabola through it and its two
    neighbours, and 0 at both ends. It is once continuously differentiable, of t and of values.

    Args:
        times: of the keys, s, increasing; at least two.
        values: at the keys; between them the curve may overshoot a little.
        t: when, s.
    """
    times, values = as_float_array(times), as_float_array(values)
    _require_times(times, values.shape[0])
    return _curve(times.astype(values.dtype), values, jnp.asarray(t, values.dtype))


@jax.jit
def _curve(times: Float[Array, " k"], values: Float[Array, "k m"], t: Scalar) -> Float[Array, " m"]:
    return _spline(times, values, t, lambda a, step: a + step, lambda a, b: b - a)


def _stacked(cameras: Sequence[Camera] | Camera) -> Camera:
    return cameras if isinstance(cameras, Camera) else stack_cameras(cameras)


def _require_times(times: Array, keys: int) -> None:
    if times.ndim != 1 or times.shape[0] != keys or keys < 2:
        raise ValueError(
            f"Argument `times` must be one number for each of at least two key frames, but has "
            f"shape {times.shape} for {keys}."
        )
    require("times", times, "be finite", np.isfinite)
    known = concrete(times)
    if known is not None:
        gaps = np.diff(known)
        if not np.all(gaps > 0):
            first = int(np.argmax(~(gaps > 0)))
            raise ValueError(
                f"Argument `times` must increase, but {known[first]:g} is followed by "
                f"{known[first + 1]:g}."
            )


def _spline(
    times: Float[Array, " k"],
    keys: Float[Array, "k m"],
    t: Scalar,
    moved: Callable[[Array, Array], Array],
    step_to: Callable[[Array, Array], Array],
) -> Float[Array, " m"]:
    """A cubic Hermite spline of points or rotations, by de Casteljau's construction.

    Args:
        times: of the keys.
        keys: points, or unit quaternions.
        t: when.
        moved: a key moved by a step.
        step_to: the step from one key to another.
    """
    gaps = jnp.diff(times)
    steps = jax.vmap(step_to)(keys[:-1], keys[1:])
    rates = steps / gaps[:, None]
    shares = (gaps[:-1] / (gaps[:-1] + gaps[1:]))[:, None]
    slopes = jnp.pad((1 - shares) * rates[:-1] + shares * rates[1:], ((1, 1), (0, 0)))
    i = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, 0, times.shape[0] - 2)
    gap = gaps[i]
    s = jnp.clip((t - times[i]) / gap, 0, 1)

    def between(a: Array, b: Array) -> Array:
        return moved(a, s * step_to(a, b))

    first, last = keys[i], moved(keys[i], steps[i])
    row = [first, moved(first, slopes[i] * gap / 3), moved(last, -slopes[i + 1] * gap / 3), last]
    while len(row) > 1:
        row = [between(a, b) for a, b in itertools.pairwise(row)]
    return row[0]


def _turned(q: Quaternion, step: Vector3) -> Quaternion:
    """A rotation turned by a rotation vector in its own axes: `q exp(step/2)`."""
    half = step / 2
    square = half @ half
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1, square))
    sinc = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    cosine = jnp.where(small, 1 - square / 2, jnp.cos(angle))
    return _product(q, jnp.concatenate([cosine[None], sinc * half]))


def _turn_to(a: Quaternion, b: Quaternion) -> Vector3:
    """The rotation vector that turns a to b the shorter way: `2 log(a⁻¹ b)`."""
    relative = _product(a * jnp.asarray([1, -1, -1, -1], a.dtype), b)
    relative = jnp.where(relative[0] < 0, -relative, relative)
    w, axis = relative[0], relative[1:]
    square = axis @ axis
    small = square < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1, square))
    # For small ones atan2(sine, w)/sine = 1/w up to a third of the square.
    ratio = jnp.where(small, (1 - square / 3) / jnp.where(small, w, 1), jnp.arctan2(sine, w) / sine)
    return 2 * ratio * axis


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([(a[0] * b[0] - a[1:] @ b[1:])[None], vector])


def quaternion_of(R: Float[Array, "3 3"]) -> Quaternion:
    """The quaternion wxyz of a rotation matrix; the inverse of `rotation_of` up to its sign.

    Of the four rows of `4 q qᵀ`, which are linear in R, the one with the largest diagonal.
    """
    (a, b, c), (d, e, f), (g, h, k) = R
    rows = jnp.stack(
        [
            jnp.stack([1 + a + e + k, h - f, c - g, d - b]),
            jnp.stack([h - f, 1 + a - e - k, b + d, c + g]),
            jnp.stack([c - g, b + d, 1 - a + e - k, f + h]),
            jnp.stack([d - b, c + g, f + h, 1 - a - e + k]),
        ]
    )
    row = rows[jnp.argmax(jnp.diagonal(rows))]
    return row / jnp.sqrt(row @ row)


def _levelled(R: Float[Array, "3 3"], up: Vector3) -> Float[Array, "3 3"]:
    """The rotation with the same view (row z) whose row x is at right angles to `up`."""
    forward = R[2]
    right = jnp.cross(forward, up)
    right = right / jnp.sqrt(right @ right)
    # An upside-down camera stays upside down.
    right = jnp.where(right @ R[0] < 0, -right, right)
    return jnp.stack([right, jnp.cross(forward, right), forward])
