"""Viscous stress beside an elastic one: Kelvin–Voigt damping, and what fluids share with it."""

from typing import final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Matrix3, Scalar, nonnegative, parameter, require
from pgjax.linalg import volume_change
from pgjax.models.law import AbstractElasticity, AbstractLaw
from pgjax.models.strain import SMALLEST_VOLUME_RATIO


def positive_volume(H: Matrix3) -> Scalar:
    """J, but at least 1e-2: an inverted particle is damped too, never driven."""
    J = 1 + volume_change(H)
    return jnp.where(J > SMALLEST_VOLUME_RATIO, J, SMALLEST_VOLUME_RATIO)


def strain_rate(L: Matrix3) -> Matrix3:
    """`D = sym L`, 1/s."""
    return (L + L.T) / 2


def require_viscosity(value: Array) -> None:
    """Refuse a viscosity that is negative or not finite."""
    require("viscosity", value, "be at least 0 and finite (Pa s)", nonnegative)


@final
class KelvinVoigt(AbstractElasticity):
    """An elastic law with a viscous stress beside it: `τ = τ_e(Fe) + 2 η J D`, `D = sym L`.

    Kelvin–Voigt solid (a spring and a dashpot side by side): a small standing shear wave of wave
    number k decays as `exp(−η k² t/(2ρ))`, one of compression twice as fast. The Cauchy stress
    gains `2 η D`, also against a change of volume. Below J = 1e-2 J counts as 1e-2. A return
    mapping that goes with the elastic law goes with this one too, and does not see η. η lowers
    the stable time step (`stable_dt`).

    Args:
        elasticity: any elastic law, e.g. `NeoHookean(1e5, 0.3)`.
        viscosity: η ≥ 0, Pa·s. One value or one per particle.
    """

    elasticity: AbstractElasticity
    viscosity: Array = parameter()

    def __check_init__(self):
        if not isinstance(self.elasticity, AbstractElasticity):
            raise ValueError(
                f"Argument `elasticity` must be an elastic law, but is a "
                f"{type(self.elasticity).__name__}."
            )
        require_viscosity(self.viscosity)

    @property
    def E(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Young's modulus of the elastic law, Pa."""
        return self.elasticity.E

    @property
    def nu(self) -> Array:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Poisson's ratio of the elastic law."""
        return self.elasticity.nu

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ_e + 2 η J D`, Pa."""
        viscous = 2 * self.viscosity * positive_volume(H) * strain_rate(L)
        return self.elasticity.kirchhoff(H, L, history) + viscous

    def shear_viscosity(self) -> Array:
        """η, and what the wrapped law has of its own, Pa·s."""
        return self.viscosity + self.elasticity.shear_viscosity().astype(self.viscosity.dtype)

    def rest_modulus(self, dimension: int) -> Array:
        """That of the elastic law, Pa."""
        return self.elasticity.rest_modulus(dimension)

    def companion(self) -> eqx.Module | None:
        """That of the elastic law."""
        return self.elasticity.companion()

    def elastic(self) -> AbstractLaw:
        """The elastic law itself."""
        return self.elasticity.elastic()

    def clamped(self, H: Matrix3, history: Array | None = None) -> Array:
        """Whether the elastic law had to continue itself."""
        return self.elasticity.clamped(H, history)

    def elliptic(self, H: Matrix3) -> Array:
        """Whether waves of the elastic law travel in every direction."""
        return self.elasticity.elliptic(H)

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """That of the elastic law, Pa."""
        return self.elasticity.tangent_bound(H, dimension, history)
