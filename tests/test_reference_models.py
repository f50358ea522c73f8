"""The laws through the singular value decomposition are the fast ones, derivative included."""

import jax
import jax.numpy as jnp
import laws
import numpy as np
import pytest
from laws import LAWS, respond
from test_models import derivatives, directions

import pgjax.models as pm
import pgjax.models.reference as svd
from pgjax.models.material import particle_axes

PAIRS = [name for name, law in LAWS.items() if law.fast]


def gap(ours, theirs):
    """Largest difference relative to the largest value, over all leaves."""
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)
    return max(float(jnp.abs(a - b).max() / jnp.maximum(jnp.abs(b).max(), 1)) for a, b in pairs)


@pytest.mark.float64
@pytest.mark.parametrize(
    "name",
    [n if n == "DruckerPragerSVD" else pytest.param(n, marks=pytest.mark.slow) for n in PAIRS],
)
def test_response_and_derivative_are_those_of_the_fast_law(name):
    law, H = LAWS[name], laws.strains()
    for history in (laws.start(law, len(H)), laws.later(law, len(H))):
        answers = []
        for other in (law, LAWS[law.fast]):
            arguments = other.material, H, history
            forward, _ = derivatives(arguments, directions(other, H, history))
            answers.append((respond(*arguments), forward))
        assert gap(*answers) < 1e-10


def test_energy_is_that_of_the_fast_law():
    H = laws.strains()
    for ours, theirs in (
        (svd.FixedCorotatedSVD, pm.FixedCorotated),
        (svd.StVKHenckySVD, pm.StVKHencky),
    ):
        a, b = (laws.energies(law(laws.E, laws.NU), H) for law in (ours, theirs))
        assert gap(a, b) < 1e4 * float(jnp.finfo(H.dtype).eps)


@pytest.mark.parametrize("name", PAIRS)
def test_reference_remembers_and_reports_what_the_fast_law_does(name):
    ours, theirs = LAWS[name].material, LAWS[LAWS[name].fast].material
    assert ours.initial_history() == theirs.initial_history()
    H = laws.strains()
    for what in ("clamped", "elliptic"):
        a, b = (jax.vmap(getattr(m.elasticity, what))(H) for m in (ours, theirs))
        assert bool((a == b).all())


def test_parameters_may_be_given_per_particle():
    H = laws.strains()
    answers = []
    for elasticity, plasticity in (
        (pm.StVKHencky, pm.VonMises),
        (svd.StVKHenckySVD, svd.VonMisesSVD),
    ):
        strength = np.linspace(0.1, 0.6, len(H))
        material = pm.Material(elasticity(laws.E, laws.NU), plasticity(strength))
        axes = particle_axes(material, len(H)), 0, None, None
        respond_to = jax.jit(jax.vmap(laws.answer, in_axes=axes))
        answers.append(respond_to(material, H, None, jnp.asarray(laws.DT)))
    assert gap(*answers) < 1e4 * float(jnp.finfo(H.dtype).eps)
