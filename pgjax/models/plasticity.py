"""Return mappings: the plastic flow of one particle, `(H_trial, history) -> (H, history)`.

A plastic strain increment is a symmetric tensor with the directions of the trial state, so the
new elastic deformation is `Fe ← exp(Δε) Fe`, written on `H = Fe − I` as `H ← H + M + M H` with
`M = exp(Δε) − I`: no singular vectors, no cancellation, and an elastic state stays bit-identical.
"""

import abc
import functools
from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._safe import frobenius, safe_divide
from pgjax._types import (
    Array,
    Matrix3,
    Scalar,
    as_float_array,
    nonnegative,
    parameter,
    require,
)
from pgjax.linalg import deviator, spectral_map, volume_change
from pgjax.models.elasticity import AbstractElasticity, StVKHencky
from pgjax.models.strain import (
    hencky_strain,
    identity,
)
from pgjax.native.particles import per_particle

_ROOT_2_3 = (2 / 3) ** 0.5


class AbstractPlasticity(eqx.Module):
    """A return mapping. It says which elastic law it goes with and what it remembers."""

    @abc.abstractmethod
    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """Map the trial state of one particle to an admissible one."""

    def goes_with(self, elasticity: AbstractElasticity) -> bool:
        """Whether the mapping is consistent with this elastic law."""
        return isinstance(elasticity, StVKHencky)

    def initial_history(self) -> float | None:
        """What one particle remembers at the start; None if nothing."""
        return None

    def kernel(self) -> str | None:
        """The name in `MAPPINGS` of a mapping that has a native kernel."""
        return None

    def parameters(
        self, history: Array | None, elasticity: AbstractElasticity
    ) -> tuple[Array, ...]:
        """What a mapping of `MAPPINGS` takes beside H, of one particle."""
        del history, elasticity
        return ()

    def remember(self, history: Array | None, mapped: Array) -> Array | None:
        """The new history, from what a mapping of `MAPPINGS` returns beside H."""
        del mapped
        return history


def _expm1_map(delta: Matrix3, Q: Matrix3) -> Matrix3:
    """`exp(Δ) − I` of a symmetric Δ whose eigenvectors are the columns of Q."""
    d = jax.lax.stop_gradient(jnp.diagonal(Q.T @ delta @ Q))
    gap = d[:, None] - d[None, :]
    quotient = jnp.where(gap == 0, 1, jnp.expm1(gap) / jnp.where(gap == 0, 1, gap))
    return spectral_map(delta, Q, jnp.expm1(d), jnp.exp(d)[None, :] * quotient)


class AbstractHenckyPlasticity(AbstractPlasticity):
    """A return mapping in Hencky strain: a new one implements `flow` only.

    An inverted particle (det F ≤ 0) does not flow: its stress has to push it back first.
    """

    @abc.abstractmethod
    def flow(
        self, eps: Matrix3, history: Array | None, elasticity: AbstractElasticity
    ) -> tuple[Matrix3, Array, Array | None]:
        """From the trial Hencky strain: the new one, whether it changed, and the new history."""

    @final
    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """`Fe ← exp(ε − ε_trial) Fe_trial`."""
        del dt
        return _along(lambda eps: self.flow(eps, history, elasticity), H, history)


def _along(
    flow: Callable[[Matrix3], tuple[Matrix3, Array, Any]], H: Matrix3, history: Any
) -> tuple[Matrix3, Any]:
    """The flow of a Hencky strain, carried over to H. An inverted particle does not flow."""
    trial, Q = hencky_strain(H)
    eps, yields, new = flow(trial)
    upright = volume_change(H) > -1
    yields = yields & upright
    history = jax.tree.map(functools.partial(jnp.where, upright), new, history)
    M = _expm1_map(jnp.where(yields, eps - trial, 0), Q)
    return jnp.where(yields, H + M + M @ H, H), history


def _radial_return(eps: Matrix3, tau_Y: Scalar, mu: Scalar) -> tuple[Matrix3, Array, Scalar]:
    """The strain returned to the von Mises surface, whether it was outside, and δγ."""
    shear = deviator(eps)
    norm = frobenius(shear)
    yields = norm > tau_Y / (2 * mu)
    # The argument is guarded, not the result: an infinite τ_Y must not reach a derivative.
    dgamma = norm - jnp.where(yields, tau_Y, 0) / (2 * mu)
    dgamma = jnp.where(yields, dgamma, 0)
    return eps - dgamma * safe_divide(shear, norm * jnp.ones_like(shear)), yields, dgamma


def _cone_return(
    eps: Matrix3, slope: Scalar, apex: Scalar, gained: Scalar, *, correct: bool
) -> tuple[Matrix3, Array, Scalar]:
    """The strain returned to the cone or its tip, whether it changes, and the volume gained."""
    I = identity(eps)
    moved = eps + (gained / 3 - apex) * I
    shear, trace = deviator(moved), jnp.trace(moved)
    norm = frobenius(shear)
    dgamma = norm + slope * trace
    tip, cone = trace > 0, (trace <= 0) & (dgamma > 0)
    returned = moved - dgamma * safe_divide(shear, norm * jnp.ones_like(shear))
    flowed = jnp.where(tip, 0, returned) + apex * I
    yields = tip | cone
    if not correct:
        return flowed, yields, gained
    # Inside the cone the volume gained before is given back in full.
    new = jnp.where(yields, flowed, eps + gained / 3 * I)
    gained = jnp.where(yields, gained + jnp.trace(eps) - jnp.trace(new), 0)
    return new, jnp.ones_like(yields), gained


def _map_von_mises(H: Matrix3, tau_Y: Scalar, mu: Scalar) -> tuple[Matrix3, Scalar]:
    """H and δγ. The native kernels below compute the same as their plain functions."""
    return _along(lambda eps: _radial_return(eps, tau_Y, mu), H, jnp.zeros_like(mu))


def _map_drucker_prager(
    H: Matrix3, slope: Scalar, apex: Scalar, gained: Scalar, *, correct: bool
) -> tuple[Matrix3, Scalar]:
    """H and the volume gained."""
    return _along(lambda eps: _cone_return(eps, slope, apex, gained, correct=correct), H, gained)


# Mappings `(H, *parameters) -> (H, what is remembered)` that a step can run as part of one native
# kernel (`native/exchange.h`).
MAPPINGS: dict[str, Callable[..., tuple[Array, ...]]] = {
    "von_mises": per_particle("von_mises", "laws", _map_von_mises, 2),
    **{
        name: per_particle(
            "drucker_prager", "laws", functools.partial(_map_drucker_prager, correct=correct), 2
        )
        for name, correct in (("drucker_prager", False), ("drucker_prager_corrected", True))
    },
}


@final
class VonMises(AbstractPlasticity):
    """Von Mises plasticity, linear isotropic hardening or softening; goes with `StVKHencky`.

    `δγ = ‖ε̂‖ − τ_Y/(2μ)`; if positive, `ε ← ε − δγ ε̂/‖ε̂‖`, and then `τ_Y ← τ_Y + 2μ ξ δγ`
    (hardening) or `τ_Y ← max(τ_Y − 2μ ξ δγ, 0)` (softening: metal, or plasticine). A step
    flows at the τ_Y it started with. Softening depends on the mesh: flow gathers in bands as
    narrow as a cell.

    Args:
        yield_stress: τ_Y, Pa, in the convention `‖dev τ‖ = τ_Y` (Frobenius norm): uniaxial yield
            at `√(3/2) τ_Y`, shear at `τ_Y/√2`. Not comparable with Herschel–Bulkley's σ_Y.
        hardening: ξ ≥ 0. With None the material does not harden.
        softening: ξ ≥ 0. With None the material does not soften. Only one of the two.
    """

    yield_stress: Array = parameter()
    hardening: Array | None = eqx.field(
        default=None,
        converter=lambda a: None if a is None else as_float_array(a),
        metadata={"parameter": True},
    )
    softening: Array | None = eqx.field(
        default=None,
        converter=lambda a: None if a is None else as_float_array(a),
        metadata={"parameter": True},
    )

    def __check_init__(self):
        require("yield_stress", self.yield_stress, "be at least 0 Pa", lambda a: a >= 0)
        if self.hardening is not None:
            require("hardening", self.hardening, "be at least 0 and finite", nonnegative)
        if self.softening is not None:
            require("softening", self.softening, "be at least 0 and finite", nonnegative)
            if self.hardening is not None:
                raise ValueError(
                    "Argument `softening` must be None where `hardening` is given, but is "
                    f"{self.softening}: a material does one of the two."
                )

    def initial_history(self) -> float | None:
        """The accumulated δγ, from which the current yield stress follows."""
        return None if self.hardening is None and self.softening is None else 0.0

    def current_yield_stress(self, history: Array | None, mu: Scalar) -> Array:
        """`τ_Y + 2μ ξ Σδγ` or `max(τ_Y − 2μ ξ Σδγ, 0)`, Pa."""
        tau_Y = self.yield_stress
        if history is None:
            return tau_Y
        if self.hardening is not None:
            return tau_Y + 2 * mu * self.hardening * history
        if self.softening is not None:
            left = tau_Y - 2 * mu * self.softening * history
            return jnp.where(left > 0, left, 0)
        return tau_Y

    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """Radial return of the deviator of the Hencky strain."""
        del dt
        H, dgamma = MAPPINGS[self.kernel()](H, *self.parameters(history, elasticity))
        return H, self.remember(history, dgamma)

    def kernel(self) -> str:
        """`von_mises`."""
        return "von_mises"

    def parameters(
        self, history: Array | None, elasticity: AbstractElasticity
    ) -> tuple[Array, ...]:
        """τ_Y and μ."""
        return self.current_yield_stress(history, elasticity.mu), elasticity.mu

    def remember(self, history: Array | None, mapped: Array) -> Array | None:
        """The sum of δγ."""
        return None if history is None else history + mapped


@final
class DruckerPrager(AbstractPlasticity):
    """Drucker–Prager sand (Klár et al. 2016); goes with `StVKHencky`.

    `δγ = ‖ε̂‖ + α (3λ + 2μ)/(2μ) tr ε`, `α = √(2/3) 2 sin φ/(3 − sin φ)`. `tr ε > 0`: `ε ← 0`
    (tip); `δγ ≤ 0`: unchanged; else `ε ← ε − δγ ε̂/‖ε̂‖`.

    With cohesion c and volume correction v (Tampubolon et al. 2017) the mapping acts on
    `ε′ = ε − c I + v/3 I`, `ε ← Z(ε′) + c I`, and v remembers the volume gained at the tip.

    Args:
        friction_angle: φ in degrees, in [0, 90). α matches Mohr–Coulomb in triaxial compression;
            in plane-strain shear φ = 30° acts as 34.7°.
        cohesion: c ≥ 0, a Hencky strain: the tip of the cone moves to `tr ε = 3c`.
        volume_correction: whether v is remembered and returned in compression.
    """

    friction_angle: Array = parameter()
    cohesion: Array | None = eqx.field(
        default=None,
        converter=lambda a: None if a is None else as_float_array(a),
        metadata={"parameter": True},
    )
    volume_correction: bool = eqx.field(default=False, static=True)

    def __check_init__(self):
        require("friction_angle", self.friction_angle, "be at least 0 degrees", lambda a: a >= 0)
        require("friction_angle", self.friction_angle, "be below 90 degrees", lambda a: a < 90)
        if self.cohesion is not None:
            require("cohesion", self.cohesion, "be at least 0 and finite", nonnegative)

    @property
    def alpha(self) -> Array:
        """Slope of the cone, `√(2/3) 2 sin φ/(3 − sin φ)`."""
        sine = jnp.sin(jnp.deg2rad(self.friction_angle))
        return _ROOT_2_3 * 2 * sine / (3 - sine)

    def initial_history(self) -> float | None:
        """The volume gained at the tip (log strain), if it is corrected."""
        return 0.0 if self.volume_correction else None

    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractElasticity, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """Return of the Hencky strain to the cone along its deviator, or to the tip."""
        del dt
        H, gained = MAPPINGS[self.kernel()](H, *self.parameters(history, elasticity))
        return H, self.remember(history, gained)

    def kernel(self) -> str:
        """`drucker_prager`, with or without the correction of the volume."""
        return "drucker_prager_corrected" if self.volume_correction else "drucker_prager"

    def parameters(
        self, history: Array | None, elasticity: AbstractElasticity
    ) -> tuple[Array, ...]:
        """`α (3λ + 2μ)/(2μ)`, cohesion and the volume gained."""
        mu, lam = elasticity.mu, elasticity.lam
        zero = jnp.zeros((), mu.dtype)
        slope = self.alpha * (3 * lam + 2 * mu) / (2 * mu)
        apex = zero if self.cohesion is None else self.cohesion
        return slope, apex, zero if history is None else history

    def remember(self, history: Array | None, mapped: Array) -> Array | None:
        """The volume gained."""
        return None if history is None else mapped
