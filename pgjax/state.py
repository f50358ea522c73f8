"""What changes in time: the carry of the rollout."""

from typing import final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Bool, Float, Int
from pgjax.result import Status


@final
class State(eqx.Module):
    """Particles at one instant, p of them in d dimensions.

    Positions are kept relative to the grid's origin, so that float32 resolves them wherever the
    scene stands; `x` gives them in the world. Deformations are kept as `H = F − I`.

    Attributes:
        position: `x − origin`, m, `(p, d)`.
        v: velocity, m/s, `(p, d)`.
        C: affine velocity, 1/s, `(p, d, d)`.
        He: elastic `Fe − I`, `(p, 3, 3)`; plane strain in two dimensions.
        H: total `F − I`, `(p, 3, 3)`, or None where no plastic law makes it differ from `He`.
        history: what the return maps carry, per material `(p_material,)` or None.
        alive: False once a particle was masked (left the grid, NaN), `(p,)`.
        step: steps taken, int32.
        status: what happened so far.
        origin: the grid's origin, m, `(d,)`.
    """

    position: Float[Array, "*batch p d"]
    v: Float[Array, "*batch p d"]
    C: Float[Array, "*batch p d d"]
    He: Float[Array, "*batch p 3 3"]
    H: Float[Array, "*batch p 3 3"] | None
    history: tuple[Float[Array, "*batch _"] | None, ...]
    alive: Bool[Array, "*batch p"]
    step: Int[Array, "*batch"]
    status: Status
    origin: Float[Array, "*batch d"]

    @property
    def x(self) -> Float[Array, "*batch p d"]:
        """Positions in the world, m."""
        return self.position + self.origin[..., None, :]

    @property
    def Fe(self) -> Float[Array, "*batch p 3 3"]:
        """Elastic deformation gradient."""
        return self.He + _identity(self.He)

    @property
    def F(self) -> Float[Array, "*batch p 3 3"]:
        """Total deformation gradient: what Gaussians are deformed with."""
        total = self.He if self.H is None else self.H
        return total + _identity(total)

    @property
    def dtype(self) -> jnp.dtype:
        """The precision of the simulation."""
        return self.v.dtype


def _identity(like: Array) -> Array:
    return jnp.broadcast_to(jnp.eye(3, dtype=like.dtype), like.shape)
