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
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state
from pgjax.step import step

PAIRS = [name for name, law in LAWS.items() if law.fast]


def gap(ours, theirs):
    """Largest difference relative to the largest value, over all leaves."""
    pairs = zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True)
    return max(float(jnp.abs(a - b).max() / jnp.maximum(jnp.abs(b).max(), 1)) for a, b in pairs)


@pytest.mark.float64
@pytest.mark.parametrize("name", PAIRS)
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


@pytest.mark.float64
def test_reference_laws_are_selectable_in_a_scene():
    """A step of metal with either form; the yield stress given per particle."""
    n = 6
    rng = np.random.default_rng(0)
    x, F = 0.3 + 0.4 * rng.random((n, 3)), laws.deformations(n=30)[-n:]
    strength = np.linspace(0.1, 0.6, n)
    ends = []
    for elasticity, plasticity in (
        (pm.StVKHencky(laws.E, 0.3), pm.VonMises(strength)),
        (svd.StVKHenckySVD(laws.E, 0.3), svd.VonMisesSVD(strength)),
    ):
        material = pm.Material(elasticity, plasticity)
        scene = Scene(Grid(np.zeros(3), (10, 10, 10), 0.1), material, np.full(n, 1e-3))
        state = initial_state(scene, x, np.zeros((n, 3)), F=F)
        ends.append(jax.jit(lambda s, scene=scene: step(scene, s, 1e-3))(state))
    np.testing.assert_allclose(ends[0].He, ends[1].He, atol=1e-12)
    np.testing.assert_allclose(ends[0].C, ends[1].C, atol=1e-12)
