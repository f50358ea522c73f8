"""Level 6: the step of further laws, of one law alone, and exactly at its kinks (G1, G3)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_step_gradients import (
    deformations,
    of_block,
    product,
    random_like,
    step_derivatives,
)

import pgjax
import pgjax.models as pm
from pgjax.boundary import Box, Collider, HalfSpace, Separating
from pgjax.models import reference

pytestmark = pytest.mark.float64

E, NU, H = 4e4, 0.3, 0.1
HENCKY = pm.StVKHencky(E, NU)

# --- G1: laws beyond those of the impact ---------------------------------------------------------

MORE = {
    # At J = 1 water has a kink: its particles start compressed and expanded.
    "water": pm.Material(pm.Fluid(E, 20.0), density=1000.0),
    "plasticine": pm.Material(
        pm.KelvinVoigt(HENCKY, 20.0), pm.VonMises(1000.0, softening=0.1), 1000.0
    ),
    "snow": pm.Material(pm.Snow(E, NU, 3.0), pm.CriticalStretches(0.02, 0.01), 400.0),
    "muscle": pm.Material(
        pm.NeoHookean(E, NU), None, 1000.0, active=pm.ActiveStress([1.0, 2.0, 0.5], 5e3)
    ),
}
PRINTED = {
    "fixed corotated, SVD": pm.Material(reference.FixedCorotatedSVD(E, NU), None, 1000.0),
    "metal, SVD": pm.Material(
        reference.StVKHenckySVD(E, NU), reference.VonMisesSVD(1000.0, 0.1), 1000.0
    ),
    "sand, SVD": pm.Material(reference.StVKHenckySVD(E, NU), reference.DruckerPragerSVD(30.0)),
    "paste, SVD": pm.Material(
        pm.DevVolNeoHookean(E, NU), reference.HerschelBulkleySVD(800.0, 50.0), 1000.0
    ),
}
ALONE = {
    "neo-Hookean": pm.Material(pm.NeoHookean(E, NU), density=1000.0),
    "fixed corotated": pm.Material(pm.FixedCorotated(E, NU), density=1000.0),
    "Hencky": pm.Material(HENCKY, density=1000.0),
    "sand": pm.Material(HENCKY, pm.DruckerPrager(30.0), 1000.0),
    "metal": pm.Material(HENCKY, pm.VonMises(1000.0, hardening=0.1), 1000.0),
}


def moving(materials, d, degree, scheme, walls):
    """Six particles of each material, from rest to flow, that move at random; scene and state."""
    rng = np.random.default_rng(5)
    H0 = np.tile(deformations(), (len(materials), 1, 1))
    if "water" in materials:
        first = 6 * list(materials).index("water")
        H0[first : first + 6] += np.array([-5, 4, -5, 4, -2, 4])[:, None, None] / 100 * np.eye(3)
    count = len(H0)
    scene = pgjax.Scene(
        pgjax.Grid(np.zeros(d), (12,) * d, H),
        list(materials.values()),
        H**d * rng.uniform(0.05, 0.2, count),
        counts=(6,) * len(materials),
        gravity=rng.normal(size=d),
        boundaries=(walls(d),),
        spline=pgjax.BSpline(degree),
        scheme=scheme,
    )
    x, v, C = (rng.normal(size=(count, *shape)) for shape in ((d,), (d,), (d, d)))
    state = pgjax.initial_state(
        scene, 0.5 + 0.05 * x, v, C=C, F=np.tile(np.eye(3), (count, 1, 1)) + H0
    )
    history = tuple(None if h is None else jnp.full_like(h, 0.01) + h for h in state.history)
    return scene, eqx.tree_at(lambda s: s.history, state, history)


def slanted(d):
    return Collider(HalfSpace(np.full(d, 0.413), np.eye(d)[0] + 0.3), Separating(0.2))


def boxed(d):
    return Box(np.full(d, 0.42), np.full(d, 0.9), Separating(0.3))


def check(measure, what, materials, problem):
    """JVP = VJP, JVP = difference of one step, along all that belongs to each material in turn."""
    dt = pgjax.stable_dt(problem[0], fraction=0.4)
    everything = random_like(problem, 0, scaled=True)
    weights = random_like(problem[1], 1, scaled=False)
    for b, name in enumerate(materials):
        tangent = of_block(everything, b)
        forward, difference, reverse, after = step_derivatives(problem, tangent, weights, dt)
        assert np.asarray(after.alive).all()
        u_J_t, t_J_u = product(weights, forward), product(tangent, reverse)
        gap = abs(u_J_t.sum() - t_J_u.sum()) / np.abs(u_J_t).sum()
        measure("G1", f"step {what}, {name}: JVP = VJP", gap, below=1e-11)
        gaps = jax.tree.map(
            lambda a, b: np.linalg.norm(a - b) / max(np.linalg.norm(a), 1e-300), forward, difference
        )
        worst = max(jax.tree.leaves(gaps))
        measure("G1", f"step {what}, {name}: JVP = difference", worst, below=1e-6)


SCHEMES = {"mls": pgjax.MLS(), "grad": pgjax.SplineGradient()}
slow = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize(
    ("d", "degree", "scheme"),
    [
        (2, 2, "mls"),
        (2, 3, "grad"),
        (3, 2, "grad"),
        (3, 3, "mls"),
    ],
)
def test_g1_more_laws(measure, d, degree, scheme):
    """Water, plasticine, snow and muscle, side by side."""
    what = f"d = {d}, degree {degree}, {scheme}"
    check(measure, what, MORE, moving(MORE, d, degree, SCHEMES[scheme], slanted))


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 3])
def test_g1_laws_as_printed(measure, degree):
    """Those with an SVD."""
    problem = moving(PRINTED, 3, degree, SCHEMES["grad"], slanted)
    check(measure, f"d = 3, degree {degree}", PRINTED, problem)


@pytest.mark.parametrize(
    ("name", "d", "degree", "scheme"),
    [
        ("neo-Hookean", 3, 3, "mls"),
        ("sand", 2, 2, "grad"),
        *(pytest.param(n, 3, k, "grad", marks=slow) for n in ALONE for k in (2, 3)),
        *(pytest.param(n, 2, k, "mls", marks=slow) for n in ALONE for k in (2, 3)),
    ],
)
def test_g1_one_law_alone(measure, name, d, degree, scheme):
    """In a box, where one native kernel, if there are any, does each half of the step."""
    own = {name: ALONE[name]}
    problem = moving(own, d, degree, SCHEMES[scheme], boxed)
    check(measure, f"alone, d = {d}, degree {degree}, {scheme}", own, problem)


# --- G3: exactly at a kink -----------------------------------------------------------------------


def alone(material, strain, walls=()):
    """One particle at rest in the middle of a cell, deformed; scene and state."""
    scene = pgjax.Scene(
        pgjax.Grid([0.0] * 3, (8,) * 3, H), material, np.full(1, H**3), boundaries=walls
    )
    return scene, pgjax.initial_state(scene, [[0.43, 0.41, 0.38]], F=np.eye(3) + strain[None])


def at_yield():
    """A metal that is sheared up to its yield stress, so heavy that it does not spring back."""
    strain = np.zeros((3, 3))
    strain[0, 0], strain[1, 1] = 0.02, 1 / 1.02 - 1
    eps = np.log1p(np.diag(strain))
    limit = 2 * float(HENCKY.mu) * np.linalg.norm(eps - eps.mean())
    return alone(pm.Material(HENCKY, pm.VonMises(limit), 1e20), strain), np.diag([1.0, -1.0, 0.0])


def at_the_tip():
    """Sand without strain: expansion leads to the tip, compression into the cone."""
    return alone(ALONE["sand"], np.zeros((3, 3))), np.eye(3)


def at_rest_on_a_wall():
    """A wall that pushes but never pulls: what moves away from it, and what moves into it."""
    wall = Collider(HalfSpace([0.0, 0.0, 0.36], [0.0, 0.0, 1.0]), Separating())
    return alone(ALONE["neo-Hookean"], np.zeros((3, 3)), (wall,)), np.diag([0.0, 0.0, 1.0])


def water_at_rest():
    """Water without pressure: compression is resisted, expansion is not."""
    return alone(MORE["water"], np.zeros((3, 3))), np.eye(3)


KINKS = {
    "yield of metal": (at_yield, 1),
    "tip of sand": (at_the_tip, 1),
    "touching a wall": (at_rest_on_a_wall, 1),
    # The second step feels the pressure of what the first one did.
    "water without pressure": (water_at_rest, 2),
}
DT, PROBE = 1e-3, 1e-6


@eqx.filter_jit
def led(problem, direction, sizes, steps):
    """Derivative at 0 in both modes, and the ends for affine velocities `size · direction`."""
    scene, state = problem

    def end(size):
        C = size * direction[None]
        start = eqx.tree_at(lambda s: (s.v, s.C), state, (size * direction[None, :, 2], C))
        after, _ = jax.lax.scan(lambda s, _: (pgjax.step(scene, s, DT), None), start, length=steps)
        return after.He, after.v, after.C

    zero = jnp.zeros(())
    forward = jax.jvp(end, (zero,), (jnp.ones(()),))[1]
    return forward, jax.jacrev(end)(zero), jax.lax.map(end, sizes)


@pytest.mark.parametrize(
    "kink", [pytest.param(k, marks=slow) if "water" in k else k for k in KINKS]
)
def test_g3_at_a_kink_it_is_one_of_two_slopes(measure, kink):
    """Exactly there AD gives one of the one-sided derivatives, never something in between.

    Of one step: in a second one, rounding may put the same particle on the other side, and the
    product is then that of two different slopes (measured: half of the elastic one at yield).
    """
    make, steps = KINKS[kink]
    problem, direction = make()
    sizes = jnp.asarray([-PROBE, 0.0, PROBE])
    forward, reverse, ends = led(problem, jnp.asarray(direction), sizes, steps)

    below, above = (jax.tree.map(lambda a, k=k: (a[k + 1] - a[k]) / PROBE, ends) for k in (0, 1))
    # Strains are Δt times as large as gradients of the velocity; less than 1e-6 is rounding.
    sizes = [max(np.abs(a).max(), np.abs(b).max(), 1e-6) for a, b in zip(below, above, strict=True)]

    def apart(a, b):
        return max(np.abs(x - y).max() / size for x, y, size in zip(a, b, sizes, strict=True))

    measure("G3", f"{kink}: the two slopes differ by", apart(below, above), above=1e-2)
    nearer = min(apart(forward, below), apart(forward, above))
    measure("G3", f"{kink}: AD = one of the two slopes", nearer, below=1e-4)
    measure("G3", f"{kink}: JVP = VJP", apart(forward, reverse), below=1e-11)
