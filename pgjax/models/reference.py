"""The laws as they are usually printed: through the singular value decomposition of `F = I + H`.

Interchangeable with those of `pgjax.models`, and their yardstick: where F is neither crushed nor
inverted both give the same, derivative included. Prefer the others: forming F costs float32 its
digits (a relative error of 1e-7/strain in the stress), and the decomposition costs time. The
neo-Hookean laws have no such form, since theirs needs no decomposition.
"""

import abc
import functools
from typing import Any, final

import jax
import jax.numpy as jnp

from pgjax._safe import safe_divide, safe_norm
from pgjax._types import Array, Bool, Matrix3, Scalar, Vector3, parameter
from pgjax.linalg import det, isotropic, polar, svd
from pgjax.models.elasticity import AbstractElasticity, DevVolNeoHookean, FixedCorotated, StVKHencky
from pgjax.models.plasticity import AbstractPlasticity, DruckerPrager, VonMises
from pgjax.models.strain import SMALLEST_STRETCH, SMALLEST_VOLUME_RATIO, identity
from pgjax.models.viscoplasticity import HerschelBulkley

_ROOT_2_3 = (2 / 3) ** 0.5


def _singular_values(F: Matrix3) -> Vector3:
    """Signed singular values; every symmetric function of them has its exact derivative.

    `σ_i = u_i · F v_i` with U and V held fixed: `dσ_i = u_i · dF v_i`.
    """
    U, _, V = svd(F)
    return jnp.diagonal(U.T @ F @ V)


def _hencky(sigma: Vector3) -> Vector3:
    """Principal Hencky strains `log |σ|`; stretches below 1e-4 count as 1e-4."""
    return jnp.log(jnp.maximum(jnp.abs(sigma), SMALLEST_STRETCH))


@final
class FixedCorotatedSVD(AbstractElasticity):
    """Fixed corotated elasticity through the rotation `R = U Vᵀ` (Stomakhin et al. 2012).

    Args:
        E: Young's modulus, Pa. One value or one per particle.
        nu: Poisson's ratio, in (−1, 0.5).
    """

    E: Array = parameter()
    nu: Array = parameter()

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ = 2μ (F − R) Fᵀ + λ J (J − 1) I`, Pa."""
        del L, history
        F = identity(H) + H
        R, _ = polar(F)
        J = det(F)
        return 2 * self.mu * (F - R) @ F.T + self.lam * J * (J - 1) * identity(H)

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`μ Σ (σ − 1)² + λ/2 (J − 1)²`, J/m³ of rest volume."""
        del history
        sigma = _singular_values(identity(H) + H)
        return self.mu * jnp.sum((sigma - 1) ** 2) + self.lam / 2 * (jnp.prod(sigma) - 1) ** 2

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """That of `FixedCorotated`, Pa."""
        del history
        return FixedCorotated(self.E, self.nu).tangent_bound(H, dimension)


@final
class StVKHenckySVD(AbstractElasticity):
    """Saint Venant–Kirchhoff elasticity in the Hencky strain, through U and Σ.

    Principal stretches below 1e-4 count as 1e-4.

    Args:
        E: Young's modulus, Pa. One value or one per particle.
        nu: Poisson's ratio, in (−1, 0.5).
    """

    E: Array = parameter()
    nu: Array = parameter()

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ = U (2μ ε + λ tr(ε) I) Uᵀ`, `ε = log Σ`, Pa."""
        del L, history

        def principal(sigma: Vector3) -> Vector3:
            eps = _hencky(sigma)
            return 2 * self.mu * eps + self.lam * jnp.sum(eps)

        F = identity(H) + H
        R, _ = polar(F)
        # U t Uᵀ = (U t Vᵀ)(U Vᵀ)ᵀ: two isotropic functions, each with its exact derivative.
        return isotropic(principal, F) @ R.T

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`μ Σ ε² + λ/2 (Σ ε)²`, J/m³ of rest volume."""
        del history
        eps = _hencky(_singular_values(identity(H) + H))
        return self.mu * jnp.sum(eps * eps) + self.lam / 2 * jnp.sum(eps) ** 2

    def clamped(self, H: Matrix3, history: Array | None = None) -> Bool[Array, ""]:
        """Whether a principal stretch is below 1e-4."""
        del history
        return StVKHencky(self.E, self.nu).clamped(H)

    def elliptic(self, H: Matrix3) -> Bool[Array, ""]:
        """Whether waves still travel in every direction."""
        return StVKHencky(self.E, self.nu).elliptic(H)

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """That of `StVKHencky`, Pa."""
        del history
        return StVKHencky(self.E, self.nu).tangent_bound(H, dimension)


class AbstractPrincipalPlasticity(AbstractPlasticity):
    """A return mapping `U Z(Σ) Vᵀ`: a new one implements `principal` only.

    An inverted particle (det F ≤ 0) does not flow.
    """

    @abc.abstractmethod
    def principal(
        self, sigma: Vector3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Vector3, Bool[Array, ""], Array | None]:
        """From the trial stretches: the new ones, whether they changed, and the new history."""

    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """`Fe ← U Z(Σ) Vᵀ`."""

        def Z(sigma: Vector3) -> Vector3:
            return self.principal(sigma, history, elasticity, dt)[0]

        F = identity(H) + H
        _, yields, new = self.principal(_singular_values(F), history, elasticity, dt)
        upright = det(F) > 0
        new = jax.tree.map(functools.partial(jnp.where, upright), new, history)
        flowed = isotropic(Z, F) - identity(H)
        same = H
        if history is not None:
            # An elastic state stays bit-identical, and still depends on what is remembered.
            same = jax.lax.stop_gradient(H) + (flowed - jax.lax.stop_gradient(flowed))
        return jnp.where(upright, jnp.where(yields, flowed, same), H), new

    def goes_with(self, elasticity: AbstractElasticity) -> bool:
        """With the Hencky law in either form."""
        return isinstance(elasticity, StVKHencky | StVKHenckySVD)


def _shear(eps: Vector3) -> tuple[Scalar, Vector3]:
    """`‖ε̂‖` and `ε̂/‖ε̂‖` of principal strains, `ε̂ = dev ε`; direction 0 where there is no shear."""
    eps_hat = eps - jnp.mean(eps)
    norm = safe_norm(eps_hat)
    return norm, safe_divide(eps_hat, norm * jnp.ones_like(eps_hat))


@final
class VonMisesSVD(AbstractPrincipalPlasticity):
    """Von Mises plasticity in principal stretches; goes with the Hencky law.

    `δγ = ‖ε̂‖ − τ_Y/(2μ)`; if positive, `Σ = exp(ε − δγ ε̂/‖ε̂‖)`.

    Args:
        yield_stress: τ_Y, Pa, as in `pgjax.models.VonMises` (`‖dev τ‖ = τ_Y`).
        hardening: ξ ≥ 0, as there.
    """

    law: VonMises

    def __init__(self, yield_stress: Any, hardening: Any = None):
        self.law = VonMises(yield_stress, hardening)

    def initial_history(self) -> float | None:
        """The accumulated δγ, if the material hardens."""
        return self.law.initial_history()

    def principal(
        self, sigma: Vector3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Vector3, Bool[Array, ""], Array | None]:
        """Radial return of the deviator."""
        del dt
        eps = _hencky(sigma)
        norm, direction = _shear(eps)
        tau_Y = self.law.yield_stress
        if self.law.hardening is not None and history is not None:
            tau_Y = tau_Y + 2 * elasticity.mu * self.law.hardening * history
        yields = norm > tau_Y / (2 * elasticity.mu)
        # The argument is guarded, not the result: an infinite τ_Y must not reach a derivative.
        dgamma = norm - jnp.where(yields, tau_Y, 0) / (2 * elasticity.mu)
        dgamma = jnp.where(yields, dgamma, 0)
        new = None if history is None else history + dgamma
        return jnp.exp(eps - dgamma * direction), yields, new


@final
class DruckerPragerSVD(AbstractPrincipalPlasticity):
    """Drucker–Prager sand in principal stretches (Klár et al. 2016); goes with the Hencky law.

    `δγ = ‖ε̂‖ + α (3λ + 2μ)/(2μ) tr ε`. `tr ε > 0`: `Σ = 1` (tip); `δγ ≤ 0`: unchanged; else
    `Σ = exp(ε − δγ ε̂/‖ε̂‖)`. Cohesion c and volume correction v act as
    `ε′ = ε − c + v/3`, `ε = Z(ε′) + c`, `v ← v + tr ε_trial − tr ε` (Tampubolon et al. 2017).

    Args:
        friction_angle: φ in degrees, in [0, 90), as in `pgjax.models.DruckerPrager`.
        cohesion: c ≥ 0, a Hencky strain.
        volume_correction: whether the volume gained at the tip is returned in compression.
    """

    law: DruckerPrager

    def __init__(self, friction_angle: Any, cohesion: Any = None, volume_correction: bool = False):
        self.law = DruckerPrager(friction_angle, cohesion, volume_correction)

    def initial_history(self) -> float | None:
        """The volume gained at the tip (log strain), if it is corrected."""
        return self.law.initial_history()

    def principal(
        self, sigma: Vector3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Vector3, Bool[Array, ""], Array | None]:
        """Return to the cone along the deviator, or to its tip."""
        del dt
        c = 0 if self.law.cohesion is None else self.law.cohesion
        v = 0 if history is None else history
        mu, lam = elasticity.mu, elasticity.lam
        trial = _hencky(sigma)
        eps = trial - c + v / 3
        trace = jnp.sum(eps)
        norm, direction = _shear(eps)
        dgamma = norm + self.law.alpha * (3 * lam + 2 * mu) / (2 * mu) * trace
        tip, cone = trace > 0, (trace <= 0) & (dgamma > 0)
        new = jnp.where(tip, 0, eps - jnp.where(cone, dgamma, 0) * direction) + c
        yields = tip | cone
        if history is None:
            return jnp.exp(new), yields, None
        # Inside the cone the volume gained before is given back in full.
        left = jnp.where(yields, history + jnp.sum(trial) - jnp.sum(new), 0)
        return jnp.exp(new), yields | (history != 0), left


@final
class HerschelBulkleySVD(AbstractPrincipalPlasticity):
    """Herschel–Bulkley viscoplasticity in principal stretches (Yue et al. 2015).

    Goes with `DevVolNeoHookean`. `s_tr = μ dev b̄`, `b̄ = J^(−2/3) Σ²`; above `√(2/3) σ_Y` its norm
    relaxes, and `Σ = J^(1/3) √b̄` with `b̄ = s/μ + c`, c the largest root of
    `c³ − ½‖s/μ‖² c + det(s/μ) − 1 = 0`. J below 1e-2 counts as 1e-2.

    Args:
        yield_stress: σ_Y, Pa, as in `pgjax.models.HerschelBulkley` (uniaxial).
        viscosity: η ≥ 0, Pa·s^h.
        h: exponent of the flow, > 0.
    """

    law: HerschelBulkley

    def __init__(self, yield_stress: Any, viscosity: Any, h: Any = 1):
        self.law = HerschelBulkley(yield_stress, viscosity, h)

    def goes_with(self, elasticity: AbstractElasticity) -> bool:
        """Only with the law it is written for."""
        return isinstance(elasticity, DevVolNeoHookean)

    def principal(
        self, sigma: Vector3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Vector3, Bool[Array, ""], Array | None]:
        """Relax the norm of the deviator, keep its direction and the volume."""
        mu = elasticity.mu
        J = jnp.maximum(jnp.prod(sigma), SMALLEST_VOLUME_RATIO)
        norm, direction = _shear(J ** (-2 / 3) * sigma * sigma)
        s_trial = mu * norm
        yields = s_trial > _ROOT_2_3 * self.law.yield_stress
        s = jnp.where(yields, self.law.flow_stress(s_trial, mu, dt), s_trial)
        S = s / mu * direction
        b = jnp.maximum(S + _isochoric_mean(S), SMALLEST_STRETCH**2)
        return jnp.cbrt(J) * jnp.sqrt(b), yields, history


def _isochoric_mean(S: Vector3) -> Scalar:
    """The largest root of `c³ − ½‖S‖² c + det S − 1 = 0` for principal values of a deviator.

    Cardano and Viète: with `r² = ‖S‖²/6`, `k = (1 − det S)/2`, it is `a + r²/a`,
    `a³ = k + √(k² − r⁶)`, or, where `k < r³`, `2r cos(⅓ arccos(k/r³))`. The derivative is that
    of a Newton step from there (implicit function theorem), finite where the two forms meet.
    """
    half, k = jnp.sum(S * S) / 2, (1 - jnp.prod(S)) / 2
    r2, fixed_k = jax.lax.stop_gradient((half / 3, k))
    r = jnp.sqrt(r2)
    single = fixed_k >= r**3
    a = jnp.cbrt(fixed_k + jnp.sqrt(jnp.maximum(fixed_k**2 - r**6, 0)))
    cosine = jnp.clip(fixed_k / jnp.where(single, 1, r**3), -1, 1)
    c = jnp.where(single, a + r2 / jnp.where(single, a, 1), 2 * r * jnp.cos(jnp.arccos(cosine) / 3))
    residual = c**3 - half * c - 2 * k
    return c - residual / (3 * c**2 - 3 * r2)
