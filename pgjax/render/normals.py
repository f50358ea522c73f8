"""A direction for each Gaussian: that of its shortest axis."""

import jax
import jax.numpy as jnp

from pgjax._types import Array, Float, Matrix3, Vector3
from pgjax.linalg import svd
from pgjax.render.camera import Camera
from pgjax.render.gaussians import Gaussians


def normals(gaussians: Gaussians, camera: Camera) -> Float[Array, "n 3"]:
    """The unit vector along the shortest axis of each Gaussian, turned to the camera.

    Captured surfaces are flat Gaussians, whose shortest axis is their normal; deformed Gaussians
    have the one of their deformed shape. In world axes (in those of the camera: `n @ W.T` with
    W the rotation of `world_to_camera`). As `features` of `render` they are accumulated as `Σ w n`,
    to be normalised where something is seen.

    The derivative is that of the eigenvector of the covariance `M Mᵀ`; what would turn it towards
    an axis as short as it is itself has none, and the side it is on is held fixed.

    Fails when: the two shortest axes are equally long (a needle, a ball): the direction is then
    any of those, and not a normal.
    """
    return _normals(gaussians.means, gaussians.factors, camera)


@jax.jit
def _normals(
    means: Float[Array, "n 3"], factors: Float[Array, "n 3 3"], camera: Camera
) -> Float[Array, "n 3"]:
    eye = camera.position.astype(means.dtype)

    def one(mean: Vector3, M: Matrix3) -> Vector3:
        normal = _shortest_axis(M)
        return jnp.where(normal @ (mean - eye) > 0, -normal, normal)

    return jax.vmap(one)(means, factors)


def _shortest_axis(M: Matrix3) -> Vector3:
    """The last column of U of `M = U diag(σ) Vᵀ`.

    `v + Σ_j u_j (u_jᵀ (A − A₀) v) / (λ − λ_j)` with `A = M Mᵀ` has the value v, as A = A₀, and the
    derivative of the eigenvector.
    """
    U, sigma, _ = svd(M)
    A = M @ M.T
    squares = sigma * sigma
    v = U[:, 2]
    change = U[:, :2].T @ ((A - jax.lax.stop_gradient(A)) @ v)
    gaps = squares[2] - squares[:2]
    apart = jnp.abs(gaps) > 4 * jnp.finfo(M.dtype).eps * squares[0]
    turn = jnp.where(apart, change / jnp.where(apart, gaps, 1), 0)
    return v + U[:, :2] @ turn
