"""Measures of the strain of one particle, from `H = F − I`: accurate at every strain.

None has the sign of det F but `principal_stretches`: the others are those of `F Fᵀ`.
"""

import jax
import jax.numpy as jnp

from pgjax._types import Matrix3, Scalar, Vector3
from pgjax.linalg import eigenbasis, spectral_map, volume_change

# Below these, logarithms are continued (the docstring of each law says how), so that a crushed
# particle is pushed back instead of turning into NaN.
SMALLEST_STRETCH = 1e-4
SMALLEST_VOLUME_RATIO = 1e-2


def identity(like: Matrix3) -> Matrix3:
    """The 3×3 identity in the dtype of `like`."""
    return jnp.eye(3, dtype=like.dtype)


def left_strain(H: Matrix3) -> Matrix3:
    """`B = F Fᵀ − I = H + Hᵀ + H Hᵀ`, without the cancellation of forming F."""
    return H + H.T + H @ H.T


def mirrored_change(H: Matrix3) -> Scalar:
    """`|J| − 1`: the change of volume as `F Fᵀ` shows it."""
    change = volume_change(H)
    return jnp.where(change < -1, -2 - change, change)


def log_volume(H: Matrix3) -> tuple[Scalar, Scalar]:
    """`log |J|` and `|J|`, continued by its tangent below `|J| = 1e-2`.

    As a stress the continuation resists being crushed to the last: its energy is infinite at J = 0.
    """
    change = mirrored_change(H)
    J = 1 + change
    regular = J > SMALLEST_VOLUME_RATIO
    logarithm = jnp.log1p(jnp.where(regular, change, 0))
    at = jnp.asarray(SMALLEST_VOLUME_RATIO, H.dtype)
    return jnp.where(regular, logarithm, jnp.log(at) + (J - at) / at), J


def volume_potentials(H: Matrix3) -> tuple[Scalar, Scalar]:
    """What `1` and `log |J|`, as `log_volume` continues it, are the slopes of over `log |J|`.

    Above `|J| = 1e-2` these are `log |J|` and `½ log² |J|`. Below rounding J is not resolved.
    """
    change = mirrored_change(H)
    J = 1 + change
    regular = J > SMALLEST_VOLUME_RATIO
    crushed = jnp.log(jnp.maximum(jnp.where(regular, 1, J), jnp.finfo(H.dtype).eps))
    logarithm = jnp.where(regular, jnp.log1p(jnp.where(regular, change, 0)), crushed)
    at = jnp.asarray(SMALLEST_VOLUME_RATIO, H.dtype)
    least = jnp.log(at)
    continued = least**2 / 2 + (least - 1) * (crushed - least) + (J - at) / at
    return logarithm, jnp.where(regular, logarithm**2 / 2, continued)


def principal_stretches(H: Matrix3) -> tuple[Vector3, Vector3, Matrix3]:
    """Signed principal stretches, eigenvalues of `B = F Fᵀ − I` and their basis; no derivative.

    Squaring loses the smallest stretch in float32, so below about 0.3 it is taken from
    `J/(σ₁σ₂)`, which also gives it the sign of det F.

    Returns:
        `σ (3,)` largest first, `w = σ² − 1`, `Q (3, 3)` whose columns are the directions.
    """
    H = jax.lax.stop_gradient(H)
    w, Q = eigenbasis(left_strain(H))
    sigma = jnp.sqrt(jnp.maximum(1 + w, 0))
    product = sigma[0] * sigma[1]
    J = 1 + volume_change(H)
    from_J = J / jnp.where(product > 0, product, 1)
    small = (sigma[2] < 0.3) | (J < 0)
    last = jnp.where(small, from_J, sigma[2])
    sigma = sigma.at[2].set(last)
    w = w.at[2].set(jnp.where(small, last * last - 1, w[2]))
    return sigma, w, Q


def _log_divided(sigma: Vector3, w: Vector3) -> Matrix3:
    """Divided differences of `log σ²` over `w = σ² − 1`, with σ continued as in `hencky_strain`."""
    sigma = jnp.abs(sigma)
    square = jnp.maximum(sigma, SMALLEST_STRETCH) ** 2
    inside = sigma > SMALLEST_STRETCH
    # w is accurate near 0, σ² far below: their differences are taken from the better one.
    both_small = (w[:, None] < -0.5) & (w[None, :] < -0.5)
    kept = jnp.where(inside, w, square - 1)
    change = jnp.where(both_small, _difference(square), _difference(kept))
    gap = jnp.where(both_small, _difference(jnp.where(inside, square, 0)), _difference(w))
    tangent = jnp.where(inside, 1 / square, 0)[:, None] * jnp.ones_like(gap)
    ratio = change / square[None, :]
    near = jnp.abs(ratio) < 0.5
    logarithm = jnp.log1p(jnp.where(near, ratio, 0))
    logarithm = jnp.where(near, logarithm, _difference(jnp.log(square)))
    return jnp.where(gap == 0, tangent, logarithm / jnp.where(gap == 0, 1, gap))


def _difference(a: Vector3) -> Matrix3:
    return a[:, None] - a[None, :]


def hencky_strain(H: Matrix3) -> tuple[Matrix3, Matrix3]:
    """Hencky strain `ε = ½ log(F Fᵀ)` as a tensor with its exact derivative, and its basis.

    Stretches below 1e-4 count as 1e-4; the status reports CLAMPED, also of inverted ones.

    Returns:
        `eps (3, 3)` and `Q (3, 3)`, the directions both `eps` and `F Fᵀ` share.
    """
    sigma, w, Q = principal_stretches(H)
    sigma = jnp.abs(sigma)
    # Near 1 from w, which is exact there; far below from σ: 1e-8 − 1 is −1 in float32.
    near = jnp.log1p(jnp.maximum(w, -0.5)) / 2
    values = jnp.where(w > -0.5, near, jnp.log(jnp.maximum(sigma, SMALLEST_STRETCH)))
    return spectral_map(left_strain(H), Q, values, _log_divided(sigma, w) / 2), Q


def stretch_minus_identity(H: Matrix3) -> Matrix3:
    """`V − I` of the left polar decomposition `F = V R`, R a rotation also where det F ≤ 0.

    `V − I = Q diag(w/(1 + σ)) Qᵀ`; divided differences of the square root: `1/(σ_i + σ_j)`.
    """
    sigma, w, Q = principal_stretches(H)
    total = sigma[:, None] + sigma[None, :]
    # σ_i + σ_j vanishes where R itself has no derivative: bounded there, finite everywhere.
    least = jnp.asarray(jnp.finfo(H.dtype).eps, H.dtype) * jnp.maximum(sigma[0], 1e-6)
    divided = jnp.where(total < 0, -1, 1) / jnp.maximum(jnp.abs(total), least)
    values = jnp.where(sigma > 0, w / (1 + jnp.maximum(sigma, 0)), sigma - 1)
    return spectral_map(left_strain(H), Q, values, divided)


def isochoric_strain(H: Matrix3) -> Matrix3:
    """`b̄ − I` with `b̄ = |J|^(−2/3) F Fᵀ`, without cancellation at small strain."""
    change = jnp.maximum(mirrored_change(H), SMALLEST_VOLUME_RATIO - 1)
    factor = jnp.expm1(-2 / 3 * jnp.log1p(change))
    B = left_strain(H)
    return B + factor * (B + identity(H))
