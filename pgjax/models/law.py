"""What the simulator asks of a constitutive law, and the base of the elastic ones."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Bool, Matrix3, Scalar, require
from pgjax.linalg import volume_change


class Response(NamedTuple):
    """What a step asks of a law.

    Attributes:
        tau: Kirchhoff stress, Pa, `(3, 3)`.
        inverted: whether det F ≤ 0.
        clamped: whether the law had to continue itself beyond its domain.
    """

    tau: Matrix3
    inverted: Bool[Array, ""]
    clamped: Bool[Array, ""]


class AbstractLaw(eqx.Module):
    """A constitutive law of one particle: the stress, and what decides the stable time step."""

    @abc.abstractmethod
    def kirchhoff(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Matrix3:
        """Kirchhoff stress `τ = J σ`, Pa, from the elastic `H = Fe − I` of one particle.

        `L` is the affine velocity (1/s) for laws with viscosity, `history` what the material's
        return map carries; a purely elastic law uses neither.
        """

    def response(self, H: Matrix3, L: Matrix3, history: Array | None = None) -> Response:
        """The stress and what the status counts, at once: some laws share work between them."""
        tau = self.kirchhoff(H, L, history)
        return Response(tau, volume_change(H) <= -1, self.clamped(H, history))

    @abc.abstractmethod
    def rest_modulus(self, dimension: int) -> Array:
        """`ρ₀ c²` at rest, Pa: one value, or one per particle where the parameters are."""

    def energy(self, H: Matrix3, history: Array | None = None) -> Scalar:
        """Stored energy per rest volume, J/m³, from elastic `H = Fe − I`; a `Ledger` needs it."""
        raise NotImplementedError(
            f"{type(self).__name__} has no `energy(H, history)`, which a ledger needs."
        )

    def kernel(self) -> str | None:
        """The name in `elasticity.RESPONSES` of a law that is a function of H, μ and λ alone."""
        return None

    def shear_viscosity(self) -> Array:
        """η of a viscous stress `2 η J sym L` (or its deviator), Pa·s; 0 where there is none."""
        return jnp.zeros(())

    def companion(self) -> eqx.Module | None:
        """The return mapping this law cannot do without; a `Material` takes it if given none."""
        return None

    def elastic(self) -> "AbstractLaw":
        """The law a return mapping has to fit: without what is wrapped around it."""
        return self

    def clamped(self, H: Matrix3, history: Array | None = None) -> Array:
        """Whether the law had to continue itself beyond its domain at this H."""
        del H, history
        return jnp.zeros((), bool)

    def elliptic(self, H: Matrix3) -> Array:
        """Whether waves travel in every direction, so that the motion is well posed."""
        del H
        return jnp.ones((), bool)

    def tangent_bound(self, H: Matrix3, dimension: int, history: Array | None = None) -> Scalar:
        """Upper bound of `ρ₀ c²`, Pa: the largest eigenvalue of the spatial tangent at H.

        It decides the stable time step. The default is its value at rest.
        """
        del H, history
        return self.rest_modulus(dimension)


class AbstractElasticity(AbstractLaw):
    """An elastic law with Young's modulus and Poisson's ratio; a new one adds `kirchhoff`."""

    E: eqx.AbstractVar[Array]
    nu: eqx.AbstractVar[Array]

    def __check_init__(self):
        require("E", self.E, "be positive and finite (Pa)", lambda a: (a > 0) & (a < float("inf")))
        require("nu", self.nu, "be above -1", lambda a: a > -1)
        require("nu", self.nu, "be below 0.5", lambda a: a < 0.5)

    @property
    def mu(self) -> Array:
        """Shear modulus `E/(2(1 + ν))`, Pa."""
        return self.E / (2 * (1 + self.nu))

    @property
    def lam(self) -> Array:
        """Lamé's first parameter `Eν/((1 + ν)(1 − 2ν))`, Pa."""
        return self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))

    @property
    def kappa(self) -> Array:
        """Bulk modulus `E/(3(1 − 2ν))`, Pa."""
        return self.E / (3 * (1 - 2 * self.nu))

    def rest_modulus(self, dimension: int) -> Array:
        """`max(dλ + 2μ, 2μ)`, Pa."""
        return jnp.maximum(dimension * self.lam + 2 * self.mu, 2 * self.mu)
