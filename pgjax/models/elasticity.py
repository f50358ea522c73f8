"""Elastic laws: Kirchhoff stress of one particle from `H = F − I`.

Every law is isotropic, so none needs more than the eigenvectors of `B = F Fᵀ − I`, and neither
neo-Hookean law needs even those. Working from H instead of F keeps the stress accurate to
rounding at every strain: from F, float32 loses digits as 1e-7/strain.

What is turned inside out stays so: a stable step multiplies F by a matrix of positive determinant.
Fixed corotated elasticity draws it towards det F = 0. The other laws know F by `F Fᵀ` alone: there
it is as its mirror image, at rest as that, with the same energy and the same stable time step. It
is counted (INVERTED) as long as it lasts.
"""

from collections.abc import Callable
from typing import final

import jax.numpy as jnp

from pgjax._types import Array, Matrix3, Scalar, Vector3, parameter
from pgjax.linalg import deviator, volume_change
from pgjax.models.law import AbstractElasticity, Response
from pgjax.models.strain import (
    SMALLEST_STRETCH,
    SMALLEST_VOLUME_RATIO,
    hencky_strain,
    identity,
    isochoric_strain,
    left_strain,
    log_volume,
    principal_stretches,
    stretch_minus_identity,
    volume_potentials,
)
from pgjax.native.particles import per_particle


def _fixed_corotated_stress(H: Matrix3, mu: Scalar, lam: Scalar) -> tuple[Matrix3, Scalar]:
    """Stress and J − 1. The native kernels below compute the same as their plain functions."""
    change = volume_change(H)
    shear = left_strain(H) - stretch_minus_identity(H)
    return 2 * mu * shear + lam * (1 + change) * change * identity(H), change


def _stvk_hencky_stress(H: Matrix3, mu: Scalar, lam: Scalar) -> tuple[Matrix3, Scalar, Scalar]:
    """Stress, J − 1 and the smallest stretch."""
    eps, _ = hencky_strain(H)
    smallest = principal_stretches(H)[0][2]
    return 2 * mu * eps + lam * jnp.trace(eps) * identity(H), volume_change(H), smallest


def _neo_hookean_stress(H: Matrix3, mu: Scalar, lam: Scalar) -> tuple[Matrix3, Scalar]:
    """Stress and J − 1."""
    log_J, _ = log_volume(H)
    return mu * left_strain(H) + lam * log_J * identity(H), volume_change(H)


_fixed_corotated = per_particle("fixed_corotated", "laws", _fixed_corotated_stress, 2)
_stvk_hencky = per_particle("stvk_hencky", "laws", _stvk_hencky_stress, 2)
_neo_hookean = per_particle("neo_hookean", "laws", _neo_hookean_stress, 2)


def _fixed_corotated_response(H: Matrix3, mu: Scalar, lam: Scalar) -> Response:
    tau, change = _fixed_corotated(H, mu, lam)
    return Response(tau, change <= -1, jnp.zeros((), bool))


def _stvk_hencky_response(H: Matrix3, mu: Scalar, lam: Scalar) -> Response:
    tau, change, smallest = _stvk_hencky(H, mu, lam)
    return Response(tau, change <= -1, smallest < SMALLEST_STRETCH)


def _neo_hookean_response(H: Matrix3, mu: Scalar, lam: Scalar) -> Response:
    tau, change = _neo_hookean(H, mu, lam)
    return Response(tau, change <= -1, change <= SMALLEST_VOLUME_RATIO - 1)


# Laws of H, μ and λ that a step can run as part of one native kernel (`native/exchange.h`).
RESPONSES: dict[str, Callable[[Matrix3, Scalar, Scalar], Response]] = {
    "fixed_corotated": _fixed_corotated_response,
    "stvk_hencky": _stvk_hencky_response,
    "neo_hookean": _neo_hookean_response,
}


@final
class FixedCorotated(AbstractElasticity):
    """Fixed corotated elasticity (Stomakhin et al. 2012).

    `τ = 2μ (F − R) Fᵀ + λ J (J − 1) I = 2μ (B − (V − I)) + λ J (J − 1) I`, finite for every F.

    Args:
        E: Young's modulus, Pa. One value or one per particle.
        nu: Poisson's ratio, in (−1, 0.5).
    """

    E: Array = parameter()
    nu: Array = parameter()

    def kernel(self) -> str | None:
        """`fixed_corotated` of `RESPONSES`."""
        return "fixed_corotated"

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ = 2μ (b − V) + λ J (J − 1) I`, Pa."""
        return self.response(H, L, history).tau

    def response(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Response:
        """The stress and what the status counts; the law is never clamped."""
        del L, history
        return _fixed_corotated_response(H, self.mu, self.lam)

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`μ Σ (σ − 1)² + λ/2 (J − 1)²`, J/m³ of rest volume."""
        del history
        V = stretch_minus_identity(H)
        change = volume_change(H)
        return self.mu * jnp.sum(V * V) + self.lam / 2 * change * change

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """`2μ s² + max(λ (J² + (d − 1) J (2J − 1)), |λ J (J − 1)|)`, s the largest stretch, Pa.

        The second term is exact: its eigenvalues for expansion, for shear and for spin.
        """
        del history
        sigma, _, _ = principal_stretches(H)
        J = 1 + volume_change(H)
        expansion = self.lam * (J * J + (dimension - 1) * J * (2 * J - 1))
        shear = jnp.abs(self.lam * J * (J - 1))
        return 2 * self.mu * sigma[0] ** 2 + jnp.maximum(expansion, shear)


@final
class StVKHencky(AbstractElasticity):
    """Saint Venant–Kirchhoff elasticity in the Hencky strain: `τ = 2μ ε + λ tr(ε) I`.

    Principal stretches below 1e-4 count as 1e-4 (status CLAMPED): that stress has no energy. The
    acoustic modulus `2μ + λ − τ_i` vanishes at a stretch of e = 2.718 (status ELLIPTICITY_LOST).

    Args:
        E: Young's modulus, Pa. One value or one per particle.
        nu: Poisson's ratio, in (−1, 0.5).
    """

    E: Array = parameter()
    nu: Array = parameter()

    def kernel(self) -> str | None:
        """`stvk_hencky` of `RESPONSES`."""
        return "stvk_hencky"

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ = 2μ ε + λ tr(ε) I`, Pa."""
        return self.response(H, L, history).tau

    def response(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Response:
        """The stress and what the status counts."""
        del L, history
        return _stvk_hencky_response(H, self.mu, self.lam)

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`μ ‖ε‖² + λ/2 tr²(ε)`, J/m³ of rest volume (stretches above 1e-4)."""
        del history
        eps, _ = hencky_strain(H)
        return self.mu * jnp.sum(eps * eps) + self.lam / 2 * jnp.trace(eps) ** 2

    def _principal(self, H: Matrix3) -> tuple[Vector3, Vector3]:
        """Principal Hencky strains and Kirchhoff stresses; no derivative."""
        sigma, _, _ = principal_stretches(H)
        e = jnp.log(jnp.maximum(jnp.abs(sigma), SMALLEST_STRETCH))
        return e, 2 * self.mu * e + self.lam * jnp.sum(e)

    def clamped(self, H: Matrix3, history: Array | None = None) -> Array:
        """Whether a principal stretch is below 1e-4, as that of what is inverted."""
        del history
        sigma, _, _ = principal_stretches(H)
        return sigma[2] < SMALLEST_STRETCH

    def elliptic(self, H: Matrix3) -> Array:
        """Whether waves still travel in every direction: `2μ + λ > max τ_i`."""
        _, tau = self._principal(H)
        return jnp.max(tau) < 2 * self.mu + self.lam

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """`μ ℓ coth(ℓ/2) + dλ + max |τ_i|`, ℓ = 2 log(σ₁/σ₃), Pa."""
        del history
        e, tau = self._principal(H)
        half = e[0] - e[2]
        # x coth x = 1 + x²/3 − …, exactly 1 at rest.
        near = half < 1e-3
        coth = jnp.where(near, 1 + half * half / 3, half / jnp.tanh(jnp.where(near, 1, half)))
        return 2 * self.mu * coth + dimension * jnp.maximum(self.lam, 0) + jnp.max(jnp.abs(tau))


@final
class NeoHookean(AbstractElasticity):
    """Neo-Hookean elasticity: `τ = μ (F Fᵀ − I) + λ log J I`; no decomposition.

    Below |J| = 1e-2 the logarithm continues as its tangent (status CLAMPED).

    Args:
        E: Young's modulus, Pa. One value or one per particle.
        nu: Poisson's ratio, in (−1, 0.5).
    """

    E: Array = parameter()
    nu: Array = parameter()

    def kernel(self) -> str | None:
        """`neo_hookean` of `RESPONSES`."""
        return "neo_hookean"

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ = μ B + λ log J I`, Pa."""
        return self.response(H, L, history).tau

    def response(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Response:
        """The stress and what the status counts."""
        del L, history
        return _neo_hookean_response(H, self.mu, self.lam)

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`μ/2 (tr B − 2 log J) + λ/2 log²J`, J/m³; that of the stress unless J is rounding."""
        del history
        logarithm, square = volume_potentials(H)
        return self.mu * (jnp.trace(left_strain(H)) / 2 - logarithm) + self.lam * square

    def clamped(self, H: Matrix3, history: Array | None = None) -> Array:
        """Whether the volume ratio is below 1e-2."""
        del history
        return volume_change(H) <= SMALLEST_VOLUME_RATIO - 1

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """`μ s² + max(c + dλ, |c|)`, `c = μ − λ log J`, with the largest stretch s, Pa.

        The second term is exact: `c + dλ`, `c` and `−c` belong to expansion, shear and spin.
        """
        del history
        log_J, J = log_volume(H)
        sigma, _, _ = principal_stretches(H)
        # d(log J)/d(log J) is 1; the continuation below |J| = 1e-2 has slope |J|/0.01.
        slope = jnp.where(J > SMALLEST_VOLUME_RATIO, 1, J / SMALLEST_VOLUME_RATIO)
        c = self.mu - self.lam * log_J
        spread = jnp.maximum(c + dimension * self.lam * slope, jnp.abs(c))
        return self.mu * sigma[0] ** 2 + spread


@final
class DevVolNeoHookean(AbstractElasticity):
    """Neo-Hookean elasticity split in deviatoric and volumetric parts (Yue et al. 2015).

    `τ = κ/2 (J² − 1) I + μ dev(J^(−2/3) F Fᵀ)`; no decomposition. Below |J| = 1e-2 the factor
    `|J|^(−2/3)` keeps its value at 1e-2, so the law is finite for every F; that stress has no
    energy.

    Args:
        E: Young's modulus, Pa. One value or one per particle.
        nu: Poisson's ratio, in (−1, 0.5).
    """

    E: Array = parameter()
    nu: Array = parameter()

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ = κ/2 (J² − 1) I + μ dev b̄`, Pa."""
        del L, history
        change = volume_change(H)
        pressure = self.kappa / 2 * change * (2 + change)
        return pressure * identity(H) + self.mu * deviator(isochoric_strain(H))

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`κ/2 ((J² − 1)/2 − log J) + μ/2 (tr b̄ − 3)`, J/m³ of rest volume (|J| > 0.01)."""
        del history
        logarithm, _ = volume_potentials(H)
        change = volume_change(H)
        bulk = self.kappa / 2 * (change * (2 + change) / 2 - logarithm)
        return bulk + self.mu / 2 * jnp.trace(isochoric_strain(H))

    def clamped(self, H: Matrix3, history: Array | None = None) -> Array:
        """Whether the volume ratio is below 1e-2."""
        del history
        return volume_change(H) <= SMALLEST_VOLUME_RATIO - 1

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """`μ (t + (√(2/3) + 2/√3) ‖dev b̄‖) + max(c + d k, |c|)`, Pa.

        With `t = tr(b̄)/3` the tangent is `L ↦ μ L b̄ − ⅔ μ (tr L dev b̄ + (dev b̄ : L) I)` plus
        `c Lᵀ + k tr L I`, `c = μ t − κ/2 (J² − 1)`, `k = κ J² − ⅔ μ t`; the last two are exact,
        the largest eigenvalue of b̄ is at most `t + √(2/3) ‖dev b̄‖`.
        """
        del history
        J = 1 + volume_change(H)
        strain = isochoric_strain(H)
        t = 1 + jnp.trace(strain) / 3
        shear = jnp.sqrt(jnp.sum(deviator(strain) ** 2))
        c = self.mu * t - self.kappa / 2 * (J * J - 1)
        k = self.kappa * J * J - 2 / 3 * self.mu * t
        spread = jnp.maximum(c + dimension * k, jnp.abs(c))
        return self.mu * (t + ((2 / 3) ** 0.5 + 2 / 3**0.5) * shear) + spread
