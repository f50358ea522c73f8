"""Laws as a program that does not know better would have them."""

from typing import final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Matrix3, Scalar, parameter
from pgjax.linalg import isotropic, polar
from pgjax.models import FixedCorotated, NeoHookean, StVKHencky
from pgjax.models.law import AbstractElasticity


@final
class NeoHookeanSVD(AbstractElasticity):
    """Neo-Hookean elasticity through singular values, as a code with one path for all laws has it.

    Args:
        E: Young's modulus, Pa.
        nu: Poisson's ratio.
    """

    E: Array = parameter()
    nu: Array = parameter()

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """`τ = U (μ (σ² − 1) + λ log J) Uᵀ`, Pa."""
        del L, history

        def principal(sigma: Array) -> Array:
            return self.mu * (sigma**2 - 1) + self.lam * jnp.sum(jnp.log(sigma))

        F = jnp.eye(3, dtype=H.dtype) + H
        return isotropic(principal, F) @ polar(F)[0].T

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """That of `NeoHookean`, J/m³."""
        return NeoHookean(self.E, self.nu).energy(H, history)


@final
class OneOfThree(AbstractElasticity):
    """All three laws for every particle, of which `which` chooses one.

    Args:
        E: Young's modulus, Pa.
        nu: Poisson's ratio.
        which: 0, 1 or 2 for each particle.
    """

    E: Array = parameter()
    nu: Array = parameter()
    which: Array = parameter()

    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """The stress of the chosen law, Pa."""
        laws = [law(self.E, self.nu) for law in (NeoHookean, FixedCorotated, StVKHencky)]
        all_of_them = jnp.stack([law.kirchhoff(H, L, history) for law in laws])
        return jnp.sum(jnp.where(self._chosen()[:, None, None], all_of_them, 0), 0)

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """That of the chosen law, J/m³."""
        laws = [law(self.E, self.nu) for law in (NeoHookean, FixedCorotated, StVKHencky)]
        energies = jnp.stack([law.energy(H, history) for law in laws])
        return jnp.sum(jnp.where(self._chosen(), energies, 0))

    def _chosen(self) -> Array:
        return jnp.arange(3, dtype=self.which.dtype) == self.which


def with_layers(scene: eqx.Module, count: int) -> Array:
    """Which of `count` equal layers each particle is in."""
    n = scene.particle_count  # pyright: ignore[reportAttributeAccessIssue]
    return jnp.floor(jnp.arange(n, dtype=jnp.float32) * count / n)
