"""Operations whose derivative is finite where the textbook formula divides by zero."""

import jax.numpy as jnp

from pgjax._types import Array, Float


def safe_divide(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """`a / b`, and 0 with zero derivative where `b == 0`: the argument is guarded."""
    nonzero = b != 0
    return jnp.where(nonzero, a / jnp.where(nonzero, b, 1), 0)


def safe_norm(a: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Euclidean norm over the last axis, with derivative 0 at 0."""
    square = jnp.sum(a * a, axis=-1)
    nonzero = square > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1)), 0)


def frobenius(a: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """Frobenius norm of a matrix, with derivative 0 at 0."""
    return safe_norm(a.reshape(*a.shape[:-2], -1))
