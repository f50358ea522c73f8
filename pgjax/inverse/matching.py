"""Which point of one cloud belongs to which of another, where that is not known."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp

from pgjax._types import Array, Float, as_float_array, positive, require

# Distances of this many pairs are held at once.
_PAIRS = 2_000_000


@final
class Chamfer(eqx.Module):
    """Each point and the nearest one of the other cloud, both ways.

    Exact derivatives where the nearest point does not change. The residual of a pair is the vector
    between its points, over √2: a pair that is nearest both ways is there twice, and counts once.
    """

    def __call__(
        self, x: Float[Array, "n d"], data: Float[Array, "m d"]
    ) -> Float[Array, "n_plus_m d"]:
        """Residual vectors of the points x, then of the data."""
        to_data = x - data[_nearest(x, data)]
        to_points = x[_nearest(data, x)] - data
        return jnp.concatenate([to_data, to_points]) / 2**0.5


@final
class Sinkhorn(eqx.Module):
    """Entropic optimal transport: each datum and the mean of what is sent to it.

    Unlike the nearest point the plan uses every point exactly once, so that a cloud is not drawn
    to a corner of the data. Derivatives go through the fixed number of iterations.

    Args:
        blur: length ε below which points are not told apart, m: the cost of a plan is
            `|x − y|²/2`, and its entropy counts ε².
        iterations: of Sinkhorn's algorithm, in logarithms.

    Reference: M. Cuturi, "Sinkhorn distances", NIPS 2013; J. Feydy et al., "Interpolating between
    optimal transport and MMD using Sinkhorn divergences", AISTATS 2019.
    """

    blur: Array = eqx.field(converter=as_float_array)
    iterations: int = eqx.field(default=50, static=True)

    def __check_init__(self):
        require("blur", self.blur, "be positive and finite (m)", positive)
        if self.iterations < 1:
            raise ValueError(f"Argument `iterations` must be at least 1, but is {self.iterations}.")

    def __call__(self, x: Float[Array, "n d"], data: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """Residual vectors of the data."""
        n, m = x.shape[0], data.shape[0]
        if n * m > 4 * _PAIRS:
            raise ValueError(
                f"Argument `matching` must be `Chamfer()` for more than {4 * _PAIRS} pairs of "
                f"points, but there are {n} × {m}: or observe fewer of them."
            )
        cost = jnp.sum((x[:, None] - data[None]) ** 2, axis=-1) / 2
        score = -cost / self.blur.astype(x.dtype) ** 2

        def sweep(g: Array, _: None) -> tuple[Array, None]:
            f = -jax.nn.logsumexp(score + g[None] - jnp.log(float(m)), axis=1)
            return -jax.nn.logsumexp(score + f[:, None] - jnp.log(float(n)), axis=0), None

        g, _ = jax.lax.scan(sweep, jnp.zeros((m,), x.dtype), None, length=self.iterations)
        # The last half sweep makes the marginal of the data exact; given g, f only normalises.
        f = -jax.nn.logsumexp(score + g[None] - jnp.log(float(m)), axis=1)
        weights = jax.nn.softmax(score + f[:, None], axis=0)
        return weights.T @ x - data


def _nearest(points: Float[Array, "n d"], others: Float[Array, "m d"]) -> Array:
    """Index of the nearest other of each point; held fixed in derivatives."""
    points, others = jax.lax.stop_gradient(points), jax.lax.stop_gradient(others)

    def one(point: Array) -> Array:
        return jnp.argmin(jnp.sum((others - point[None]) ** 2, axis=1))

    batch = max(1, min(points.shape[0], _PAIRS // others.shape[0]))
    return jax.lax.map(one, points, batch_size=batch)
