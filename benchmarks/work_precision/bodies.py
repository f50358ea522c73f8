"""Two discs that collide (V21), with other transfers and other ways to the same stress."""

from typing import Any, final

import discs
import jax.numpy as jnp

import pgjax.models as pm
from benchmarks.work_precision.rollouts import watched
from benchmarks.work_precision.waves import LOOKS, transfers
from pgjax._types import Array, parameter
from pgjax.linalg import det, volume_change
from pgjax.models import reference
from pgjax.models.elasticity import AbstractElasticity
from pgjax.models.strain import identity, left_strain, stretch_minus_identity


class AbstractCorotated(AbstractElasticity):
    """What the forms of fixed corotated elasticity below share."""

    def tangent_bound(self, H: Any, dimension: int, history: Any = None) -> Any:
        """That of `FixedCorotated`, Pa."""
        return pm.FixedCorotated(self.E, self.nu).tangent_bound(H, dimension, history)


@final
class PlainCorotated(AbstractCorotated):
    """From the eigenvectors of `B = F Fᵀ − I` as the library has it, without a native kernel."""

    E: Array = parameter()
    nu: Array = parameter()

    def kirchhoff(self, H: Any, L: Any, history: Any = None) -> Any:
        """`τ = 2μ (b − V) + λ J (J − 1) I`, Pa."""
        del L, history
        change, shear = volume_change(H), left_strain(H) - stretch_minus_identity(H)
        return 2 * self.mu * shear + self.lam * (1 + change) * change * identity(H)


@final
class LapackCorotated(AbstractCorotated):
    """Through LAPACK's singular value decomposition of F, as `jnp.linalg.svd` offers it."""

    E: Array = parameter()
    nu: Array = parameter()

    def kirchhoff(self, H: Any, L: Any, history: Any = None) -> Any:
        """`τ = 2μ (F − U Vᵀ) Fᵀ + λ J (J − 1) I`, Pa; right where det F > 0."""
        del L, history
        F = identity(H) + H
        U, _, Vt = jnp.linalg.svd(F)
        J = det(F)
        return 2 * self.mu * (F - U @ Vt) @ F.T + self.lam * J * (J - 1) * identity(H)


LAWS = {
    "library": pm.FixedCorotated,
    "Jacobi on B, plain JAX": PlainCorotated,
    "polar through Jacobi SVD": reference.FixedCorotatedSVD,
    "LAPACK SVD": LapackCorotated,
}


def point(
    n: int, scheme: str, *, transfer: str = "APIC", law: str = "library", backward: bool = False
) -> dict[str, Any]:
    """Part of the energy that is lost after the collision, and the costs, as JSON.

    The exact motion loses nothing. The time step is half the bound.

    Args:
        n: cells along the square.
        scheme: a name of `scenes.SCHEMES`.
        transfer: a name of `waves.transfers`.
        law: a name of `LAWS`.
        backward: whether the gradient is timed, too.
    """
    scene, _, _ = discs.two_discs(n, scheme)
    dt = 0.5 * float(scene.rest_limit())
    damping, after = transfers(dt)[transfer]
    scene, state, _ = discs.two_discs(n, scheme, law=LAWS[law], damping=damping)
    every = max(1, round(3.5 / dt) // LOOKS)
    with watched(backward=backward) as costs:
        _, total, _, _ = discs.follow(scene, state, dt, every=every, after=after)
    return {"error": float(1 - total[-1])} | vars(costs)
