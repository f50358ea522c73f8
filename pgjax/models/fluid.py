"""Weakly compressible fluids: a pressure from the volume alone, and Newtonian viscosity."""

from typing import final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Matrix3, Scalar, parameter, require
from pgjax.linalg import deviator, volume_change
from pgjax.models.law import AbstractLaw
from pgjax.models.plasticity import AbstractPlasticity
from pgjax.models.strain import SMALLEST_VOLUME_RATIO, identity
from pgjax.models.viscous import positive_volume, require_viscosity, strain_rate


@final
class Fluid(AbstractLaw):
    """Weakly compressible Newtonian fluid: `σ = −p I + 2 η dev D`, `D = sym L`, `τ = J σ`.

    `p = (κ/γ)(J^(−γ) − 1)` where J < 1, the Tait–Murnaghan equation of state with
    `ρ/ρ₀ = 1/J` (Monaghan 1994; Becker and Teschner 2007, who write B = κ/γ), and p = 0 where
    J ≥ 1: a fluid under no confinement bears no tension, so drops part and a free surface does
    not cohere. The derivative at J = 1 is that of compression. The sound speed at rest is
    `√(κ/ρ)`: choose κ so that it is about ten times the largest speed, and the density varies by
    1 %. Below J = 1e-2 `J p` keeps its value there (status CLAMPED).

    The only state is J: after each step `Fe ← J^(1/3) I` (`VolumeOnly`, which a `Material` takes
    by itself), J following `det(I + Δt L)` exactly.

    Fails when a body has been torn apart (J > 1) and meets itself again: it bears no pressure
    before it is as dense as it was. Viscosity lowers the stable time step (`stable_dt`).

    Args:
        bulk_modulus: κ > 0, Pa. One value or one per particle, as the others.
        viscosity: η ≥ 0, Pa·s.
        gamma: γ > 1, dimensionless; 7 for water.
    """

    bulk_modulus: Array = parameter()
    viscosity: Array = parameter(default=0.0)
    gamma: Array = parameter(default=7.0)

    def __check_init__(self):
        positive = "be positive and finite (Pa)"
        require("bulk_modulus", self.bulk_modulus, positive, lambda a: (a > 0) & (a < float("inf")))
        require_viscosity(self.viscosity)
        above_one = lambda a: (a > 1) & (a < float("inf"))  # noqa: E731
        require("gamma", self.gamma, "be above 1 and finite", above_one)

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`−J p I + 2 η J dev D`, Pa."""
        del history
        change = _compression(H)
        p = self.bulk_modulus / self.gamma * jnp.expm1(-self.gamma * jnp.log1p(change))
        shear = 2 * self.viscosity * positive_volume(H) * deviator(strain_rate(L))
        return shear - (1 + change) * p * identity(H)

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """`∫_J^1 p dJ = (κ/γ) ((J^(1−γ) − 1)/(γ − 1) + J − 1)`, J/m³ of rest volume."""
        del history
        change, less = _compression(H), self.gamma - 1
        squeezed = jnp.expm1(-less * jnp.log1p(change)) / less
        return self.bulk_modulus / self.gamma * (squeezed + change)

    def shear_viscosity(self) -> Array:
        """η, Pa·s."""
        return self.viscosity

    def rest_modulus(self, dimension: int) -> Array:
        """`dκ`, Pa."""
        return dimension * self.bulk_modulus

    def companion(self) -> eqx.Module:
        """`VolumeOnly`: a fluid forgets every deformation but that of volume."""
        return VolumeOnly()

    def clamped(self, H: Matrix3, history: Array | None = None) -> Array:
        """Whether the volume ratio is below 1e-2."""
        del history
        return volume_change(H) <= SMALLEST_VOLUME_RATIO - 1

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """`c + dk`, `c = J p`, `k = κ J + (γ − 1) c`, Pa: exact, for an expansion."""
        del history
        change = _compression(H)
        J = 1 + change
        c = self.bulk_modulus / self.gamma * J * jnp.expm1(-self.gamma * jnp.log1p(change))
        return c + dimension * (self.bulk_modulus * J + (self.gamma - 1) * c)


def _compression(H: Matrix3) -> Scalar:
    """`J − 1` in compression, 0 in expansion, and no less than −0.99."""
    change = volume_change(H)
    # At 0 the branch, and so the derivative, of compression.
    change = jnp.where(change > 0, 0, change)
    least = SMALLEST_VOLUME_RATIO - 1
    return jnp.where(change > least, change, least)


@final
class VolumeOnly(AbstractPlasticity):
    """What a fluid remembers of its deformation: `Fe ← J^(1/3) I`; goes with `Fluid`.

    A particle with J < 1e-2 keeps its trial state: its pressure has to push it back first.
    """

    def return_map(
        self, H: Matrix3, history: Array | None, elasticity: AbstractLaw, dt: Scalar
    ) -> tuple[Matrix3, Array | None]:
        """`H ← (J^(1/3) − 1) I`, without cancellation."""
        del elasticity, dt
        change = volume_change(H)
        regular = change > SMALLEST_VOLUME_RATIO - 1
        stretch = jnp.expm1(jnp.log1p(jnp.where(regular, change, 0)) / 3)
        return jnp.where(regular, stretch * identity(H), H), history

    def goes_with(self, elasticity: AbstractLaw) -> bool:
        """With fluids only: a solid would lose its shape."""
        return isinstance(elasticity, Fluid)
