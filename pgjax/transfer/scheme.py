"""How the velocity gradient and the force are discretised: spline gradient or MLS."""

import abc
import math
from typing import final

import equinox as eqx

from pgjax._types import Array, Float
from pgjax.splines import BSpline

# Rows of a payload: the stress times −Δt V⁰ joins either B or S.
Flux = Float[Array, "p d d"]


class AbstractScheme(eqx.Module):
    """An APIC scheme."""

    @property
    def needs_slope(self) -> bool:
        """Whether `velocity_gradient` looks at `slope`; if not, it is not computed."""
        return True

    @abc.abstractmethod
    def velocity_gradient(self, C: Flux, slope: Flux | None) -> Flux:
        """The L that deforms a particle, from `C` and from `Σ v_i ∇wᵀ`."""

    @abc.abstractmethod
    def split(self, flux: Flux, D: Float[Array, ""]) -> tuple[Flux | None, Flux | None]:
        """Where `−Δt V⁰ τ` goes: added to B, or to S (each may be None)."""

    @abc.abstractmethod
    def roughness(self, spline: BSpline) -> float:
        """The constant g of the stable time step."""

    def stable_courant(self, spline: BSpline, kept: float = 1.0) -> float:
        """`β(s)`: the stable time step is `β h/c` (1/√2 quadratic ∇w, 1 quadratic MLS, …).

        `β(s) = √(D/h²) √(2(1 + s)/(g(1 + s) − s))`, s the part of the symmetric C that RPIC
        damping keeps in a step. Sharp: an isolated particle attains it.
        """
        g = self.roughness(spline)
        return math.sqrt(spline.moment * 2 * (1 + kept) / (g * (1 + kept) - kept))


@final
class SplineGradient(AbstractScheme):
    """The original MPM: `L = Σ v_i ∇wᵀ`, force `−Σ V⁰ τ ∇w` (Sulsky 1994; Jiang et al. 2016)."""

    def velocity_gradient(self, C: Flux, slope: Flux | None) -> Flux:
        """`Σ v_i ∇wᵀ`."""
        del C
        assert slope is not None
        return slope

    def split(self, flux: Flux, D: Float[Array, ""]) -> tuple[Flux | None, Flux | None]:
        """Through ∇w."""
        del D
        return None, flux

    def roughness(self, spline: BSpline) -> float:
        """That of the spline."""
        return spline.roughness


@final
class MLS(AbstractScheme):
    """MLS-MPM (Hu et al. 2018): `L = C`, force through the affine term. One gather less.

    Its stable time step is 1.41 (quadratic) times the one of `SplineGradient`.
    """

    @property
    def needs_slope(self) -> bool:
        """No: L is C."""
        return False

    def velocity_gradient(self, C: Flux, slope: Flux | None) -> Flux:
        """The affine velocity C itself."""
        del slope
        return C

    def split(self, flux: Flux, D: Float[Array, ""]) -> tuple[Flux | None, Flux | None]:
        """`−V⁰ τ w (x_i − x_p)/D`."""
        return flux / D, None

    def roughness(self, spline: BSpline) -> float:
        """1: C is the least-squares gradient."""
        del spline
        return 1.0
