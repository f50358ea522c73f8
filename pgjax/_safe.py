"""Operations whose derivative is finite where the textbook formula divides by zero."""

import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp

from pgjax._types import Array, Float


def safe_divide(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """`a / b`, and 0 with zero derivative where `b == 0`: the argument is guarded."""
    nonzero = b != 0
    return jnp.where(nonzero, _quotient(a, jnp.where(nonzero, b, 1)), 0)


@jax.custom_jvp
def _quotient(a: Array, b: Array) -> Array:
    return a / b


@_quotient.defjvp
def _quotient_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Any, Any]:
    """JAX's own rule forms `b⁻²`, which is infinite in float32 from b = 1e-19 down.

    The mass of a node that a particle barely touches is that small.
    """
    (a, b), (da, db) = primals, tangents
    q = _quotient(a, b)
    return q, (da - q * db) / b


def dot(a: Float[Array, "*batch n"], b: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Dot product over a short last axis, written out: `vmap` makes vector code of it.

    XLA turns a reduction over three components into a loop for each result.
    """
    products = a * b
    return functools.reduce(operator.add, (products[..., i] for i in range(products.shape[-1])))


def safe_norm(a: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Euclidean norm over the last axis, with derivative 0 at 0."""
    square = dot(a, a) if a.shape[-1] <= 3 else jnp.sum(a * a, axis=-1)
    nonzero = square > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, square, 1)), 0)


def frobenius(a: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch"]:
    """Frobenius norm of a matrix, with derivative 0 at 0."""
    return safe_norm(a.reshape(*a.shape[:-2], -1))
