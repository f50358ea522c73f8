"""From a Gaussian in space to a splat in the image: the projection linearised at its centre."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._types import Array, Float, Matrix3, Scalar, Vector3
from pgjax.render.camera import Camera
from pgjax.render.gaussians import Gaussians
from pgjax.render.harmonics import harmonics

# Antialiasing never dims a Gaussian below this share of its opacity.
_MIN_COMPENSATION = 0.005
# Beyond this share of the half image outside the frame, J is evaluated at the bound.
_FRAME_MARGIN = 0.3


@final
class Splat(eqx.Module):
    """A Gaussian in the image (with a leading axis: many of them).

    Attributes:
        center: (u, v) in pixels.
        variances: variances along x and y, with the low-pass filter, in squared pixels.
        covariance: covariance of x and y, in squared pixels.
        det: determinant of the 2×2 covariance.
        opacity: opacity at the centre (0 where it is not drawn).
        color: red, green, blue.
        depth: Z of the centre in camera axes.
        finite: whether all inputs were finite numbers.
    """

    center: Float[Array, "*n 2"]
    variances: Float[Array, "*n 2"]
    covariance: Float[Array, "*n"]
    det: Float[Array, "*n"]
    opacity: Float[Array, "*n"]
    color: Float[Array, "*n 3"]
    depth: Float[Array, "*n"]
    finite: jax.Array


def project(gaussians: Gaussians, camera: Camera, low_pass: Scalar, *, antialiased: bool) -> Splat:
    """Project all Gaussians. What lies nearer than the near plane gets opacity 0."""
    dtype = gaussians.means.dtype
    camera = jax.tree.map(lambda leaf: leaf.astype(dtype), camera)

    def one(gaussian: Gaussians) -> Splat:
        return _project_one(gaussian, camera, low_pass.astype(dtype), antialiased)

    return jax.vmap(one)(gaussians)


def _project_one(g: Gaussians, camera: Camera, low_pass: Scalar, antialiased: bool) -> Splat:
    """One Gaussian: the record's fields come without their leading axis.

    The 2×2 covariance is `T Tᵀ + low_pass I` with `T = J W M`. With the rows t₀, t₁ of T its
    determinant is `|t₀ × t₁|² + low_pass (|t₀|² + |t₁|²) + low_pass²`, free of cancellation.

    What is not drawn is replaced before it is used, so that its derivatives are 0 rather than NaN.
    """
    W = camera.world_to_camera[:3, :3]
    finite = _all_finite(g.means, g.factors, g.opacities, g.sh, g.frames)
    means, factors, sh = (jnp.where(finite, a, 0) for a in (g.means, g.factors, g.sh))
    frames = jnp.where(finite, g.frames, jnp.eye(3, dtype=g.frames.dtype))
    mean = W @ means + camera.world_to_camera[:3, 3]
    in_front = mean[2] > camera.near
    mean = jnp.where(in_front, mean, jnp.ones_like(mean))
    X, Y, Z = mean
    T = jacobian(mean, camera) @ (W @ factors)
    center = jnp.stack([camera.fx * X / Z + camera.cx, camera.fy * Y / Z + camera.cy])
    color = view_color(sh, frames, means - camera.position)
    # The determinant is of the fourth order in T.
    fits = jnp.all(jnp.abs(T) < jnp.finfo(T.dtype).max ** 0.2)
    finite = finite & fits & _all_finite(center, color)
    t0, t1 = jnp.where(finite, T, 0)
    area = jnp.cross(t0, t1)
    det_sharp = area @ area
    xx, yy, xy = t0 @ t0, t1 @ t1, t0 @ t1
    det = det_sharp + low_pass * (xx + yy) + low_pass * low_pass
    opacity = jnp.where(in_front & finite, g.opacities, 0)
    if antialiased:
        floor = _MIN_COMPENSATION**2
        opacity = opacity * jnp.sqrt(jnp.maximum(det_sharp / det, floor))
    return Splat(
        center=jnp.where(finite, center, 0),
        variances=jnp.stack([xx, yy]) + low_pass,
        covariance=xy,
        det=det,
        opacity=opacity,
        color=jnp.where(finite, color, 0),
        depth=Z,
        finite=finite,
    )


def _all_finite(*parts: Array) -> Array:
    return jnp.stack([jnp.all(jnp.isfinite(part)) for part in parts]).all()


def jacobian(mean: Vector3, camera: Camera) -> Float[Array, "2 3"]:
    """Derivative J of (u, v) with respect to camera coordinates (X, Y, Z).

    The direction (X/Z, Y/Z) is clamped to 0.3 tan(fov/2) beyond the frame, in J alone: far outside
    the linearisation would smear a Gaussian over the whole image.
    """
    X, Y, Z = mean
    x = _clamped(X / Z, camera.cx, camera.fx, camera.width)
    y = _clamped(Y / Z, camera.cy, camera.fy, camera.height)
    zero = jnp.zeros_like(Z)
    return jnp.stack(
        [
            jnp.stack([camera.fx / Z, zero, -camera.fx * x / Z]),
            jnp.stack([zero, camera.fy / Z, -camera.fy * y / Z]),
        ]
    )


def _clamped(ratio: Scalar, center: Scalar, focal: Scalar, size: int) -> Scalar:
    margin = _FRAME_MARGIN * size / (2 * focal)
    return jnp.clip(ratio, -center / focal - margin, (size - center) / focal + margin)


def view_color(sh: Float[Array, "k 3"], frame: Matrix3, offset: Vector3) -> Vector3:
    """`max(Y(Bᵀ d) · c + 1/2, 0)` with d along `offset`, from the camera to the mean."""
    degree = int(sh.shape[0] ** 0.5) - 1
    square = offset @ offset
    # No direction, and no derivative of it, where the camera is in the centre.
    direction = offset / jnp.sqrt(jnp.where(square > 0, square, 1))
    return jnp.maximum(harmonics(frame.T @ direction, degree) @ sh + 0.5, 0)
