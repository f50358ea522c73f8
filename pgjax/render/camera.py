"""Pinhole cameras with OpenCV axes."""

import math
import reprlib
from collections.abc import Sequence
from typing import Any, SupportsFloat, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from pgjax._types import Array, Float, concrete, numbers, require, require_number
from pgjax.render.gaussians import require_rotation

Triple = Sequence[ArrayLike] | ArrayLike


@final
class Camera(eqx.Module):
    """A pinhole camera without distortion: `(u, v) = (fx X/Z + cx, fy Y/Z + cy)`.

    X points right, Y down and Z forward. The centre of the first pixel is at (0.5, 0.5), so that
    the image spans [0, width] × [0, height].

    Attributes:
        world_to_camera: rigid map of homogeneous world coordinates to camera coordinates.
        fx: focal length along x, in pixels.
        fy: focal length along y, in pixels.
        cx: principal point along x, in pixels.
        cy: principal point along y, in pixels.
        width: number of columns of the image.
        height: number of rows of the image.
        near: what lies at a smaller Z is not drawn, in the units of the scene.
    """

    world_to_camera: Float[Array, "4 4"] = eqx.field(converter=numbers("world_to_camera"))
    fx: Float[Array, ""] = eqx.field(converter=numbers("fx"))
    fy: Float[Array, ""] = eqx.field(converter=numbers("fy"))
    cx: Float[Array, ""] = eqx.field(converter=numbers("cx"))
    cy: Float[Array, ""] = eqx.field(converter=numbers("cy"))
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    near: Float[Array, ""] = eqx.field(default=0.01, converter=numbers("near"))

    def __check_init__(self):
        for name in ("fx", "fy", "near"):
            require(name, getattr(self, name), "be positive", lambda a: (a > 0) & np.isfinite(a))
        for name in ("cx", "cy", "world_to_camera"):
            require(name, getattr(self, name), "be finite", np.isfinite)
        _require_size(self.width, self.height)
        if self.world_to_camera.shape != (4, 4):
            raise ValueError(
                "Argument `world_to_camera` must have shape (4, 4), "
                f"but has {self.world_to_camera.shape}."
            )
        require_rotation("world_to_camera[:3, :3]", self.world_to_camera[:3, :3])
        matrix = concrete(self.world_to_camera)
        if matrix is not None and not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise ValueError(
                f"Argument `world_to_camera` must end with the row [0, 0, 0, 1], but it is "
                f"{matrix[3]}."
            )

    @property
    def position(self) -> Float[Array, "3"]:
        """Where the camera is in the world: `−Wᵀ t`."""
        return -(self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3])

    def project(
        self, points: Float[Array, "n 3"]
    ) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
        """Pixel coordinates (u, v) and depths Z of world points (meaningless where Z ≤ 0)."""
        W = self.world_to_camera.astype(points.dtype)
        X, Y, Z = jnp.einsum("ij,nj->in", W[:3, :3], points) + W[:3, 3:]
        fx, fy, cx, cy = (a.astype(points.dtype) for a in (self.fx, self.fy, self.cx, self.cy))
        return jnp.stack([fx * X / Z + cx, fy * Y / Z + cy], axis=-1), Z

    @classmethod
    def look_at(
        cls,
        eye: Triple,
        target: Triple,
        *,
        up: Triple,
        width: int,
        height: int,
        fov_y: SupportsFloat | None = None,
        focal: SupportsFloat | None = None,
    ) -> "Camera":
        """A camera at `eye` that sees `target` in the centre of the image.

        Args:
            eye: position in the world.
            target: the point looked at.
            up: direction that points up in the image; need not be orthogonal to the view.
            width: number of columns.
            height: number of rows.
            fov_y: vertical opening angle in radians; give it or `focal`.
            focal: focal length in pixels.
        """
        _require_size(width, height)
        position, up = _vector("eye", eye), _vector("up", up)
        forward = _vector("target", target) - position
        distance = math.hypot(*forward)
        if distance == 0:
            raise ValueError(f"Argument `target` must differ from `eye`, but both are {position}.")
        forward = forward / distance
        right = np.cross(forward, up)
        if np.linalg.norm(right) <= 1e-9 * np.linalg.norm(up):
            raise ValueError(
                f"Argument `up` must not be zero or along the view {forward}, but is {up}."
            )
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
        pixels = _focal(fov_y, focal, height)
        return cls(_default_float(matrix), pixels, pixels, width / 2, height / 2, width, height)

    @classmethod
    def orbit(
        cls,
        center: Triple,
        *,
        up: Triple,
        azimuth: SupportsFloat,
        elevation: SupportsFloat,
        radius: SupportsFloat,
        width: int,
        height: int,
        fov_y: SupportsFloat | None = None,
        focal: SupportsFloat | None = None,
    ) -> "Camera":
        """A camera on a sphere around `center`, looking at it.

        At azimuth 0 the eye is in the direction of the x axis (of the y axis where `up` is within
        45° of x), made orthogonal to `up`; the azimuth turns it about `up` by the right-hand rule.

        Args:
            center: the point looked at.
            up: direction that points up in the world.
            azimuth: angle about `up`, in radians.
            elevation: angle above the horizon, in radians, between −π/2 and π/2 (excluded).
            radius: distance from the centre.
            width: number of columns.
            height: number of rows.
            fov_y: vertical opening angle in radians; give it or `focal`.
            focal: focal length in pixels.
        """
        for name, value in (("radius", radius), ("elevation", elevation), ("azimuth", azimuth)):
            require_number(name, value)
            require(name, value, "be finite", np.isfinite)
        require("radius", radius, "be positive", lambda a: a > 0)
        require("elevation", elevation, "be inside (−π/2, π/2)", lambda a: np.abs(a) < math.pi / 2)
        vertical = _vector("up", up)
        require("up", np.linalg.norm(vertical), "not be zero", lambda a: a > 0)
        vertical = vertical / np.linalg.norm(vertical)
        axis = np.eye(3)[0 if abs(vertical[0]) < math.sqrt(0.5) else 1]
        first = axis - (axis @ vertical) * vertical
        first = first / np.linalg.norm(first)
        second = np.cross(vertical, first)
        angle, height_angle = float(azimuth), float(elevation)
        horizontal = math.cos(angle) * first + math.sin(angle) * second
        offset = math.cos(height_angle) * horizontal + math.sin(height_angle) * vertical
        target = _vector("center", center)
        return cls.look_at(
            target + float(radius) * offset,
            target,
            up=vertical,
            width=width,
            height=height,
            fov_y=fov_y,
            focal=focal,
        )


def _require_size(width: Any, height: Any) -> None:
    for name, value in (("width", width), ("height", height)):
        require_number(name, value)
        require(name, value, "be at least 1", lambda a: a >= 1)
        require(name, value, "be a whole number", lambda a: a % 1 == 0)


def _vector(name: str, value: Any) -> np.ndarray:
    """Three finite numbers in double precision."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"Argument `{name}` must be three numbers, but is {reprlib.repr(value)}."
        ) from None
    if array.shape != (3,):
        raise ValueError(f"Argument `{name}` must be three numbers, but has shape {array.shape}.")
    require(name, array, "be finite", np.isfinite)
    return array


def _default_float(value: np.ndarray) -> Array:
    """The array in the default precision."""
    return jnp.asarray(value, dtype=jnp.zeros(()).dtype)


def _focal(fov_y: SupportsFloat | None, focal: SupportsFloat | None, height: int) -> float:
    """Focal length in pixels, from itself or from the opening angle: `(h/2) / tan(fov_y/2)`."""
    if (fov_y is None) == (focal is None):
        raise ValueError(
            "Exactly one of the arguments `fov_y` and `focal` must be given, but "
            f"fov_y={fov_y} and focal={focal}."
        )
    for name, value in (("focal", focal), ("fov_y", fov_y)):
        require_number(name, value)
    if focal is not None:
        require("focal", focal, "be finite (pixels)", np.isfinite)
        return float(focal)
    assert fov_y is not None
    require("fov_y", fov_y, "be between 0 and π radians", lambda a: (a > 0) & (a < math.pi))
    return height / 2 / math.tan(float(fov_y) / 2)
