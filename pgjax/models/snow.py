"""Snow: stretches that cannot leave a narrow range, and stiffness that grows with packing."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._types import Array, Matrix3, Scalar, Vector3, nonnegative, parameter, require
from pgjax.linalg import spectral_map, volume_change
from pgjax.models.elasticity import FixedCorotated
from pgjax.models.law import AbstractElasticity, AbstractLaw
from pgjax.models.plasticity import AbstractPlasticity
from pgjax.models.strain import SMALLEST_STRETCH, left_strain, principal_stretches

# e⁴ = 55 times the stiffness at rest, reached at J_p = 0.6 for ξ = 10; the time step has to bear
# it, and without an end a crushed particle would be up to e^ξ times as stiff.
LARGEST_HARDENING = 4.0


@final
class Snow(AbstractElasticity):
    """Snow: fixed corotated, stiffer where it was packed (Stomakhin et al. 2013).

    `τ = e^(ξ (1 − J_p)) τ_fixed corotated(Fe)`, `J_p = det F_p`: packing (J_p < 1) hardens,
    tearing (J_p > 1) weakens. The exponent is at most 4 (55 times as stiff; status CLAMPED), where
    the paper sets no limit. `E` and `nu`, and `mu` and `lam` with them, are those at J_p = 1.

    It flows by `CriticalStretches`, which carries J_p; a `Material` given none takes it with the
    values of the paper. Snow of the paper: E = 1.4e5 Pa, ν = 0.2, ξ = 10, 400 kg/m³.

    Args:
        E: Young's modulus at J_p = 1, Pa. One value or one per particle, as the others.
        nu: Poisson's ratio, in (−1, 0.5).
        hardening: ξ ≥ 0, dimensionless.
    """

    E: Array = parameter()
    nu: Array = parameter()
    hardening: Array = parameter(default=10.0)

    def __check_init__(self):
        require("hardening", self.hardening, "be at least 0 and finite", nonnegative)

    def _exponent(self, history: Array | None) -> Array:
        """`ξ (1 − J_p)`, without its limit."""
        return self.hardening * (1 - (1.0 if history is None else history))

    def stiffening(self, history: Array | None) -> Array:
        """`e^(ξ (1 − J_p))`, at most e⁴."""
        exponent = self._exponent(history)
        return jnp.exp(jnp.where(exponent < LARGEST_HARDENING, exponent, LARGEST_HARDENING))

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`e^(ξ (1 − J_p)) (2μ (b − V) + λ J (J − 1) I)`, Pa."""
        return self.stiffening(history) * FixedCorotated(self.E, self.nu).kirchhoff(H, L)

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`e^(ξ (1 − J_p)) (μ Σ (σ − 1)² + λ/2 (J − 1)²)`, J/m³ of rest volume."""
        return self.stiffening(history) * FixedCorotated(self.E, self.nu).energy(H)

    def companion(self) -> eqx.Module:
        """`CriticalStretches` with the values of the paper."""
        return CriticalStretches()

    def clamped(self, H: Matrix3, history: Array | None = None) -> Array:
        """Whether the hardening is at its limit."""
        del H
        return self._exponent(history) > LARGEST_HARDENING

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """That of fixed corotated elasticity, as much larger as the snow is harder, Pa."""
        bound = FixedCorotated(self.E, self.nu).tangent_bound(H, dimension)
        return self.stiffening(history) * bound


@final
class CriticalStretches(AbstractPlasticity):
    """Elastic stretches kept in `[1 − θ_c, 1 + θ_s]` (Stomakhin et al. 2013); goes with `Snow`.

    `Fe = U clamp(Σ) Vᵀ`, `J_p ← J_p det(Fe_trial)/det(Fe)`, so that `F = Fe F_p`. An inverted
    particle (det F ≤ 0) does not flow. A stretch below 1e-4 counts as 1e-4. Hardening makes this
    flow store energy where snow is packed; it dissipates at ξ = 0.

    Args:
        critical_compression: θ_c in [0, 1), dimensionless; small values crumble.
        critical_stretch: θ_s ≥ 0, dimensionless; small values break apart.
    """

    critical_compression: Array = parameter(default=2.5e-2)
    critical_stretch: Array = parameter(default=7.5e-3)

    def __check_init__(self):
        below_one = lambda a: (a >= 0) & (a < 1)  # noqa: E731
        require("critical_compression", self.critical_compression, "be in [0, 1)", below_one)
        require("critical_stretch", self.critical_stretch, "be at least 0 and finite", nonnegative)

    def initial_history(self) -> float:
        """`J_p`, the plastic change of volume."""
        return 1.0

    def goes_with(self, elasticity: AbstractLaw) -> bool:
        """With the law that hardens by J_p."""
        return isinstance(elasticity, Snow)

    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """`H ← H + M + M H`, `M = Q diag(clamp(σ)/σ − 1) Qᵀ`."""
        del elasticity, dt
        B = left_strain(H)
        sigma, _, Q = principal_stretches(H)
        sigma = jnp.maximum(sigma, SMALLEST_STRETCH)
        low, high = 1 - self.critical_compression, 1 + self.critical_stretch
        below, above = sigma < low, sigma > high
        yields = jnp.any(below | above) & (volume_change(H) > -1)
        n = jnp.where(below, low, jnp.where(above, high, sigma))
        divided = _divided(sigma, n, ~(below | above))
        M = spectral_map(B, Q, jnp.where(below | above, (n - sigma) / sigma, 0), divided)
        if history is not None:
            # det(Fe_trial)/det(Fe) = Π σ/n; a symmetric function may use dσ = q·dB q/(2σ).
            w = jnp.diagonal(Q.T @ B @ Q)
            moving = sigma + (w - jax.lax.stop_gradient(w)) / (2 * sigma)
            ratio = jnp.prod(jnp.where(below | above, moving / n, 1))
            history = jnp.where(yields, history * ratio, history)
        return jnp.where(yields, H + M + M @ H, H), history


def _divided(sigma: Vector3, n: Vector3, inside: Array) -> Matrix3:
    """Divided differences of `n(σ)/σ − 1` over `σ²`, n the clamped stretch.

    `(s σ_j − n_j)/(σ_i σ_j (σ_i + σ_j))` with `s = (n_i − n_j)/(σ_i − σ_j)`, which is in [0, 1];
    on the diagonal it is 1 inside the range and 0 outside.
    """
    sigma, n = jax.lax.stop_gradient((sigma, n))
    gap = sigma[:, None] - sigma[None, :]
    slope = (n[:, None] - n[None, :]) / jnp.where(gap == 0, 1, gap)
    slope = jnp.where(gap == 0, jnp.where(inside, 1, 0)[:, None], jnp.clip(slope, 0, 1))
    total = sigma[:, None] + sigma[None, :]
    product = sigma[:, None] * sigma[None, :]
    return (slope * sigma[None, :] - n[None, :]) / (product * total)
