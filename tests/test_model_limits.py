"""Hard states, limits of the parameters, single precision, bad input, bounds of the tangent."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import laws
import numpy as np
import oracle
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laws import I3, LAWS, dev, norm, respond, run

import pgjax.models as pm
import pgjax.models.reference as svd
from pgjax.models.elasticity import principal_stretches
from pgjax.models.material import particle_axes

double = pytest.mark.float64
MU, LAM, KAPPA = oracle.lame(laws.E, laws.NU)

# --- H01-H03, H07-H09: any F at all --------------------------------------------------------------

HARD = [
    [1, 1, -0.5],
    [1.2, 0.9, -0.5],
    [1, 1, -1],
    [1, 0.8, 0],
    [1, 0, 0],
    [0, 0, 0],
    [1e3, 1, 1],
    [1e3, 1e3, 1e3],
    [1, 1, 1e-3],
    [1, 1, 1e-6],
    [1e3, 1, 1e-3],
    [1e-3, 1e-3, 1e-3],
]


def hard_states(seed=7):
    """48 deformation gradients: each of `HARD` as it is, and three times rotated."""
    straight = np.array([np.diag(np.array(s, float)) for s in HARD])
    turned = laws.with_stretches(np.random.default_rng(seed), np.array(HARD * 3, float))
    return np.concatenate([straight, turned])


@pytest.mark.parametrize("name", LAWS)
def test_any_state_has_a_finite_response_and_derivative(name):
    """Inverted, singular, of rank 1 or 0, stretched and crushed a thousandfold."""
    law, H = LAWS[name], jnp.asarray(hard_states() - I3)
    arguments = law.material, H, laws.later(law, len(H))
    response = respond(*arguments)
    ones = jax.tree.map(jnp.ones_like, response)
    count = 2 + len(jax.tree.leaves(arguments)) - 1  # as many as in `test_models`: one compilation
    directions = jax.tree.map(lambda a: jnp.ones((count, *a.shape)), arguments)
    for leaf in jax.tree.leaves((response, laws.linear_response(*arguments, directions, ones))):
        assert bool(jnp.isfinite(leaf).all())
