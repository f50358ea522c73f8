"""Guarded operations: values and derivatives where the textbook formula fails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pgjax._safe import safe_divide, safe_norm


@pytest.mark.parametrize("size", [1e-3, 1e-22, 1e-30])
def test_quotients_of_tiny_numbers(size):
    """As of a node that a particle barely touches: numerator and mass are both tiny."""
    a, b = jnp.float32(3 * size), jnp.float32(2 * size)
    da, db = jnp.float32(0.5 * size), jnp.float32(0.25 * size)
    q, dq = jax.jvp(safe_divide, (a, b), (da, db))
    np.testing.assert_allclose([q, dq], [1.5, (0.5 - 1.5 * 0.25) / 2], rtol=1e-5)
    slopes = jax.grad(lambda a, b: safe_divide(a, b) * jnp.float32(size), (0, 1))(a, b)
    np.testing.assert_allclose(slopes, [0.5, -0.75], rtol=1e-5)


def test_nothing_over_nothing():
    zero = jnp.zeros(())
    assert safe_divide(zero, zero) == 0
    assert jax.grad(safe_divide, (0, 1))(zero, zero) == (0, 0)
    np.testing.assert_array_equal(jax.grad(safe_norm)(jnp.zeros(3)), np.zeros(3))


def test_second_derivatives():
    hessian = jax.hessian(safe_divide, (0, 1))(jnp.asarray(3.0), jnp.asarray(2.0))
    np.testing.assert_allclose(np.asarray(hessian), [[0, -0.25], [-0.25, 0.75]], rtol=1e-6)
