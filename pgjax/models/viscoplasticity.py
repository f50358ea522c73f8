"""The viscoplastic flow of one particle: Herschel–Bulkley's, as `plasticity` is written."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._safe import frobenius, safe_divide
from pgjax._types import (
    Array,
    Matrix3,
    Scalar,
    Vector3,
    as_float_array,
    parameter,
    require,
)
from pgjax.linalg import cofactor, deviator, spectral_map, volume_change
from pgjax.models.elasticity import AbstractElasticity, DevVolNeoHookean
from pgjax.models.plasticity import AbstractPlasticity
from pgjax.models.strain import (
    SMALLEST_VOLUME_RATIO,
    identity,
    isochoric_strain,
    principal_stretches,
)
from pgjax.native import varying

_ROOT_2_3 = (2 / 3) ** 0.5


def _h_or_one(h: Any) -> Array | None:
    """None for the plain number 1, whose flow has a closed form; an array otherwise."""
    return None if isinstance(h, int | float) and h == 1 else as_float_array(h)


@final
class HerschelBulkley(AbstractPlasticity):
    """Herschel–Bulkley viscoplasticity (Yue et al. 2015); goes with `DevVolNeoHookean`.

    On `s = ‖μ dev b̄‖`, `b̄ = J^(−2/3) Fe Feᵀ`, above `s_Y = √(2/3) σ_Y`: h = 1 gives
    `s = s_tr − (s_tr − s_Y)/(1 + η/(2 μ Δt))`, other h the root of
    `η^(1/h) (s_tr − s) = 2 μ Δt (s − s_Y)^(1/h)`. Volume is kept exactly: det b̄ = 1.
    Steady shear at h = 1: `τ = σ_Y/√3 + (η/2) γ̇`. Where the stretches of a trial state differ by
    a factor of 1e4 (in single precision 100) `det b̄ = 1` holds to 1e-8 (1e-3); far beyond, it and
    the derivatives are lost to rounding.

    Args:
        yield_stress: σ_Y, Pa, uniaxial: yields at `‖dev τ‖ = √(2/3) σ_Y`. Not comparable with
            the yield stress of `VonMises`.
        viscosity: η ≥ 0, Pa·s^h. 0 is rate-independent.
        h: exponent of the flow, > 0; below 1 shear-thinning. The plain number 1 compiles the
            closed form; pass an array to differentiate with respect to h.
    """

    yield_stress: Array = parameter()
    viscosity: Array = parameter()
    h: Array | None = eqx.field(default=1, converter=_h_or_one, metadata={"parameter": True})

    def __check_init__(self):
        require("yield_stress", self.yield_stress, "be at least 0 Pa", lambda a: a >= 0)
        require("viscosity", self.viscosity, "be at least 0 Pa s^h", lambda a: a >= 0)
        if self.h is not None:
            require("h", self.h, "be positive and finite", lambda a: (a > 0) & (a < float("inf")))

    def goes_with(self, elasticity: AbstractElasticity) -> bool:
        """Only with the law it is written for."""
        return isinstance(elasticity, DevVolNeoHookean)

    def flow_stress(self, s_trial: Scalar, mu: Scalar, dt: Scalar) -> Scalar:
        """The norm s after the step from the trial norm, Pa (s_trial above s_Y)."""
        s_Y = _ROOT_2_3 * self.yield_stress
        excess = jnp.maximum(s_trial - s_Y, 0)
        rigid = jnp.isinf(self.viscosity)
        eta = jnp.where(rigid, 1, self.viscosity)
        if self.h is None:
            # The printed form, s_tr − (s_tr − s_Y)/(1 + η/(2 μ Δt)), also for η = 0.
            flowed = excess * eta / (eta + 2 * mu * dt)
        else:
            flowed = _herschel_bulkley_excess(excess, eta, self.h, mu, dt)
        return s_Y + jnp.where(rigid, excess, flowed)

    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """`b̄ ← S + c I` with `S = s n/μ` and det b̄ = 1; J does not change."""
        mu = elasticity.mu
        strain = isochoric_strain(H)
        trial = deviator(strain)
        norm = frobenius(trial)
        s_trial = mu * norm
        # An inverted particle does not flow: its stress means nothing, and it is counted.
        yields = (s_trial > _ROOT_2_3 * self.yield_stress) & (volume_change(H) > -1)
        s = jnp.where(yields, self.flow_stress(s_trial, mu, dt), s_trial)
        S = (s / mu) * safe_divide(trial, norm * jnp.ones_like(trial))
        sigma, _, Q = principal_stretches(H)
        c = _unit_determinant(S, Q)
        # b̄_new b̄_trial⁻¹ − I, with b̄⁻¹ = cof b̄ since det b̄ = 1; coaxial, so symmetric.
        change = (S + c * identity(S)) - strain
        Y = change @ cofactor(strain + identity(S))
        Y = jnp.where(yields, (Y + Y.T) / 2, 0)
        y = jnp.where(yields, _principal_change(S, c, strain, sigma, Q), 0)
        M = _sqrt_map(Y, Q, y)
        return jnp.where(yields, H + M + M @ H, H), history


def _principal_change(
    S: Matrix3, e: Scalar, strain: Matrix3, sigma: Vector3, Q: Matrix3
) -> Vector3:
    """Eigenvalues of `b̄_new b̄⁻¹ − I` for `b̄_new − I = S + e I` and `strain = b̄ − I`; no derivative.

    Where the stretches differ much, the smallest eigenvalue of b̄ is lost in its matrix, but not in
    the stretches; where the law is continued, `strain` is not that of the volume there is.
    """
    S, e, strain = jax.lax.stop_gradient((S, e, strain))
    new, old = (jnp.diagonal(Q.T @ A @ Q) for A in (S, strain))
    new = new + e
    J = jnp.maximum(sigma[0] * sigma[1] * sigma[2], jnp.finfo(S.dtype).tiny)
    wide = (sigma[0] > 2 * sigma[2]) | (J < 2 * SMALLEST_VOLUME_RATIO)
    # At least 1e-12: a stretch of nothing has no direction to be restored to.
    exact = jnp.where(wide, jnp.maximum(sigma**2 * J ** (-2 / 3), 1e-12), 1)
    return jnp.where(wide, (1 + new) / exact - 1, (new - old) / jnp.where(wide, 1, 1 + old))


def _sqrt_map(Y: Matrix3, Q: Matrix3, y: Vector3) -> Matrix3:
    """`√(I + Y) − I` of a symmetric Y > −I with eigenvalues y and eigenvectors Q."""
    root = jnp.sqrt(jnp.maximum(1 + y, 1e-12))
    return spectral_map(Y, Q, y / (1 + root), 1 / (root[:, None] + root[None, :]))


def _unit_determinant(S: Matrix3, Q: Matrix3) -> Scalar:
    """`c − 1` such that `det(S + c I) = 1` for a symmetric deviator S with eigenvectors Q.

    The largest root of `f(c) = c³ − a c + q − 1`, `a = ½‖S‖²`, `q = det S`. It lies above the
    minimum of f at `m = √(a/3)`, by the root of `δ³ + 3 m δ² = −f(m) = 1 + 2 m³ − q`, whose right
    side is at least 1. A last Newton step in e = c − 1 makes it accurate for small S, where c is
    near 1, and carries the derivative, which is the implicit function theorem; for large S its
    value would be rounding.
    """
    a = jnp.sum(S * S) / 2
    q = jnp.sum(S[0] * cofactor(S)[0])
    fa = jax.lax.stop_gradient(a)
    m = jnp.sqrt(fa / 3)
    depth = 1 + jax.lax.stop_gradient(_excess_of_cubes(S, Q, m, q))

    def newton(_: Array, delta: Scalar) -> Scalar:
        value = delta**2 * (delta + 3 * m) - depth
        return delta - value / (3 * delta * (delta + 2 * m))

    # Both are upper bounds, and one of them is near.
    start = jnp.minimum(jnp.cbrt(depth), jnp.sqrt(depth / jnp.maximum(3 * m, 1e-30)))
    delta = jax.lax.fori_loop(0, 8, newton, start)
    e = m + delta - 1
    value = e * (e * (e + 3) + 3 - a) - a + q
    value = jnp.where(m < 1, value, value - jax.lax.stop_gradient(value))
    # f'(c) = 3 c² − a, positive as it is written here.
    return e - value / (3 * delta * (delta + 2 * m))


def _excess_of_cubes(S: Matrix3, Q: Matrix3, m: Scalar, q: Scalar) -> Scalar:
    """`2 m³ − det S ≥ 0` without cancellation where two eigenvalues of S are nearly equal.

    `(2 m³ − q)(2 m³ + q)` is the product of the squared differences of eigenvalues over 27.
    """
    x, y, z = (jnp.dot(Q[:, i], S @ Q[:, i]) for i in range(3))
    product = ((x - y) * (y - z) * (z - x)) ** 2 / 27
    total = 2 * m**3 + q
    return jnp.where(q > 0, product / jnp.where(q > 0, total, 1), 2 * m**3 - q)


def _herschel_bulkley_excess(
    excess: Scalar, eta: Scalar, h: Scalar, mu: Scalar, dt: Scalar
) -> Scalar:
    """The root u = s − s_Y of `η^(1/h) (U − u) = 2 μ Δt u^(1/h)`, 0 ≤ u ≤ U.

    With `u = U z^h` it reads `1 − z^h = k z`, `k = 2 μ Δt U^(1/h − 1) / η^(1/h)`: monotone in z,
    solved by Newton kept inside a bisection bracket. The derivative is the implicit one.
    """
    U = jnp.where(excess > 0, excess, 1)
    fluid = eta > 0
    log_k = jnp.log(2 * mu * dt) + (1 / h - 1) * jnp.log(U) - jnp.log(jnp.where(fluid, eta, 1)) / h

    def residual(z: Scalar, log_k: Scalar, h: Scalar) -> Scalar:
        return 1 - z**h - jnp.exp(log_k) * z

    f_log_k, f_h = jax.lax.stop_gradient((log_k, h))

    def slope(z: Scalar) -> Scalar:
        return -f_h * z ** (f_h - 1) - jnp.exp(f_log_k)

    def body(_: Array, carry: tuple) -> tuple:
        low, high, z = carry
        value = residual(z, f_log_k, f_h)
        low, high = jnp.where(value > 0, z, low), jnp.where(value > 0, high, z)
        trial = z - value / slope(z)
        inside = (trial > low) & (trial < high)
        return low, high, jnp.where(inside, trial, (low + high) / 2)

    zero, one = jnp.zeros_like(U), jnp.ones_like(U)
    # The root is below 1 and below 1/k.
    start = jnp.minimum(one, jnp.exp(-f_log_k)) / 2
    bracket = varying(zero, one, start, f_log_k, f_h)[:3]
    _, _, z = jax.lax.fori_loop(0, 60, body, bracket)
    z = jax.lax.stop_gradient(jnp.maximum(z, jnp.asarray(jnp.finfo(U.dtype).tiny, U.dtype)))
    z = z - residual(z, log_k, h) / jax.lax.stop_gradient(slope(z))
    return jnp.where(fluid & (excess > 0), U * z**h, 0)
