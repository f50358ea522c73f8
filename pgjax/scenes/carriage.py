"""How particles carry Gaussians that are not particles themselves."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from pgjax._types import Array, Float, Int

# The particles around a point of a lattice.
_PARENTS = 8
# Nearer than this part of the reach of its parents, a Gaussian is at the place of the first.
_SAME = 1e-6


@final
class Carriage(eqx.Module):
    """The motion of n Gaussians, interpolated from that of the k particles nearest to each at rest.

    With `q_i = x_i + F_i (X_g − X_i)`, where particle i would take the Gaussian,

        `x_g = Σ w_i q_i`,  `F_g = Σ w_i F_i`,  `w_i ∝ W_i (1 − |q_i − q_0|²/s²)²`

    where 0 is the nearest at rest; a particle that would take it further than s from there has no
    weight. So a Gaussian at a tear goes with one side, and is not stretched across. The weights at
    rest are those of R. Franke and G. Nielson, "Smooth interpolation of large sets of scattered
    data", 1980: `W_i ∝ ((R − r_i)/(R r_i))²` with distances r_i and R that of the next particle.
    An affine motion is exact, and a Gaussian at the place of a particle moves as that does.

    Attributes:
        parents: numbers of the particles, the nearest first, `(n, k)`.
        weights: W, `(n, k)`; they add up to 1.
        offsets: `X_g − X_i`, m, `(n, k, 3)`.
        reach: s, m.
    """

    parents: Int[Array, "n k"]
    weights: Float[Array, "n k"]
    offsets: Float[Array, "n k 3"]
    reach: Float[Array, ""]

    @classmethod
    def between(
        cls,
        gaussians: np.ndarray,
        particles: np.ndarray,
        kinds: tuple[np.ndarray, np.ndarray],
        reach: float,
        dtype: Any = None,
    ) -> "Carriage":
        """Find the parents among the particles of a Gaussian's own kind.

        Args:
            gaussians: centres at rest, m, `(n, 3)`.
            particles: positions at rest, m, `(p, 3)`.
            kinds: a number for each Gaussian `(n,)` and each particle `(p,)`; every kind of a
                Gaussian has a particle.
            reach: s, m.
            dtype: of weights and offsets; JAX's default float if None.
        """
        of_gaussians, of_particles = kinds
        parents = np.zeros((len(gaussians), _PARENTS), np.int32)
        weights = np.zeros((len(gaussians), _PARENTS))
        for kind in np.unique(of_gaussians):
            mine, theirs = (
                np.flatnonzero(of_gaussians == kind),
                np.flatnonzero(of_particles == kind),
            )
            near, weights[mine] = _nearest(gaussians[mine], particles[theirs])
            parents[mine] = theirs[near]
        offsets = gaussians[:, None] - particles[parents]
        dtype = jnp.zeros((), dtype).dtype
        return cls(
            jnp.asarray(parents),
            jnp.asarray(weights, dtype),
            jnp.asarray(offsets, dtype),
            jnp.asarray(reach, dtype),
        )

    def __call__(
        self, x: Float[Array, "p 3"], F: Float[Array, "p 3 3"]
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
        """Positions (m) and deformation gradients of the Gaussians, from those of the particles."""
        return _carried(self, x, F)


@jax.jit
def _carried(carriage: Carriage, x: Array, F: Array) -> tuple[Array, Array]:
    dtype = x.dtype

    def one(parents: Array, weights: Array, offsets: Array) -> tuple[Array, Array]:
        own = F[parents]
        q = x[parents] + jnp.einsum("kij,kj->ki", own, offsets)
        apart = jnp.sum((q - q[:1]) ** 2, axis=1) / carriage.reach.astype(dtype) ** 2
        # A particle that became NaN takes no Gaussian with it but those nearest to it.
        agree = jnp.where(apart < 1, (1 - apart) ** 2, 0)
        agree = agree.at[0].set(1)
        w = jnp.where(weights > 0, agree * weights, 0)
        w = (w / jnp.sum(w))[:, None]
        x_g = jnp.sum(jnp.where(w > 0, w * q, 0), axis=0)
        F_g = jnp.sum(jnp.where(w[..., None] > 0, w[..., None] * own, 0), axis=0)
        return x_g, F_g

    weights, offsets = carriage.weights.astype(dtype), carriage.offsets.astype(dtype)
    return jax.vmap(one)(carriage.parents, weights, offsets)


def _nearest(points: np.ndarray, particles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers and weights of the nearest particles, `(n, k)`; a number may be there for nothing."""
    count = min(_PARENTS + 1, len(particles))
    tree: Any = KDTree(particles)
    r, near = tree.query(points, k=np.arange(1, count + 1))
    if count <= _PARENTS:
        # All there are: the radius ends beyond the last, and what is missing has no weight.
        missing = _PARENTS + 1 - count
        r = np.pad(r, ((0, 0), (0, missing)), constant_values=np.inf)
        near = np.pad(near, ((0, 0), (0, missing)), mode="edge")
        end = 2 * r[:, count - 1 : count]
    else:
        end = r[:, _PARENTS:]
    r, near = r[:, :_PARENTS], near[:, :_PARENTS]
    end = np.maximum(end, np.finfo(float).tiny)
    closest = np.maximum(r, _SAME * end)
    w = (np.maximum(end - r, 0) / closest) ** 2
    # The nearest has some weight, also where all are equally far.
    w[:, 0] = np.where(np.sum(w, axis=1) > 0, w[:, 0], 1)
    there = r[:, :1] <= _SAME * end
    w = np.where(there, np.arange(_PARENTS) == 0, w)
    return near, w / np.sum(w, axis=1, keepdims=True)
