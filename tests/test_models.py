"""What every constitutive law must obey, whatever it is; new ones are added in `laws.py`."""

import functools
import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import laws
import numpy as np
import pytest
from laws import I3, LAWS, PLASTIC, dev, norm, respond, run, strains, volume

import pgjax.models as pm

every_law = pytest.mark.parametrize("name", LAWS)
every_plastic_law = pytest.mark.parametrize("name", PLASTIC)
double = pytest.mark.float64

# In float32 (PGJAX_TEST_FLOAT32=1) every tolerance scales with the precision.
ROUNDING = float(jnp.finfo(jnp.zeros(()).dtype).eps)


def concrete_subclasses(base):
    for cls in base.__subclasses__():
        yield from concrete_subclasses(cls)
        if not inspect.isabstract(cls) and cls.__module__.startswith("pgjax."):
            yield cls


@pytest.mark.parametrize("base", [pm.AbstractElasticity, pm.AbstractPlasticity])
def test_every_law_of_the_package_is_tested(base):
    every = (LAWS | laws.MORE).values()
    tested = {type(part) for law in every for part in vars(law.material).values()}
    assert set(concrete_subclasses(base)) <= tested


# --- Symmetries ----------------------------------------------------------------------------------


@every_law
def test_response_is_objective_isotropic_and_symmetric(name):
    """Z(Q F P) = Q Z(F) P and τ(Q F P) = Q τ(F) Qᵀ = its transpose, for rotations Q and P."""
    law, rng = LAWS[name], np.random.default_rng(1)
    F = laws.deformations()
    Q, P = (laws.rotations(rng, len(F)) for _ in range(2))
    Fe, _, tau = run(name, F, laws.later(law, len(F)))
    turned, _, tau_turned = run(name, Q @ F @ P, laws.later(law, len(F)))
    QT = Q.swapaxes(1, 2)
    scale = norm(tau).max()
    assert norm(tau - tau.swapaxes(1, 2)).max() <= 20 * ROUNDING * scale
    assert norm(turned - Q @ Fe @ P).max() <= 1000 * ROUNDING
    assert norm(tau_turned - Q @ tau @ QT).max() <= 1000 * ROUNDING * scale


@every_law
def test_a_rotation_makes_no_stress(name):
    R = laws.rotations(np.random.default_rng(2), 48)
    Fe, _, tau = run(name, R, laws.start(LAWS[name], 48))
    assert norm(tau).max() <= 100 * ROUNDING * laws.E
    assert norm(Fe - R).max() <= 100 * ROUNDING


# --- Plastic flow --------------------------------------------------------------------------------


@every_plastic_law
def test_return_map_ends_on_the_yield_surface_and_stays(name):
    """Rate-independent: f ≤ 0 after it. A second mapping changes nothing."""
    law, F = LAWS[name], laws.deformations()
    elasticity = law.material.elasticity
    Fe, history, tau = run(name, F, laws.start(law, len(F)))
    moved = norm(Fe - F) > 1e-6
    assert moved.sum() > 20
    if not law.rate_independent:
        return
    excess = laws.overshoot(law.material.plasticity, elasticity, tau, history)
    assert excess.max() <= 1000 * ROUNDING * laws.E
    if law.corrected:
        return  # what it remembers acts again
    again, _, _ = run(name, Fe, history)
    assert norm(again - Fe).max() <= 1000 * ROUNDING


@every_plastic_law
def test_plastic_flow_dissipates_and_keeps_the_volume_if_claimed(name):
    law = LAWS[name]
    H = strains()
    after, _, _ = respond(law.material, H, laws.start(law, len(H)))
    if not law.corrected:
        before, _ = laws.energies(law.material.elasticity, H)
        stored, _ = laws.energies(law.material.elasticity, after)
        released = np.asarray(before - stored)
        assert released.min() >= -100 * ROUNDING * laws.E
        assert released.max() > 0.01
    if law.isochoric:
        assert abs(volume(after) / volume(H) - 1).max() <= 100 * ROUNDING


def test_volume_correction_remembers_what_the_tip_gave_away():
    """log J + v is kept."""
    H = strains()
    for name in ("DruckerPrager-corrected", "DruckerPragerSVD"):
        after, v, _ = respond(LAWS[name].material, H, jnp.full(len(H), 0.02))
        change = np.log(volume(after)) + v - np.log(volume(H)) - 0.02
        assert abs(change).max() <= 1000 * ROUNDING
        assert abs(v - 0.02).max() > 0.1


@double
def test_volume_correction_has_a_derivative_where_nothing_was_gained_yet():
    """ε + v/3 I inside the cone: dF/dv = F/3 at v = 0 exactly."""
    material = LAWS["DruckerPrager-corrected"].material
    H = -1e-3 * jnp.eye(3)[None]

    def after(v):
        return respond(material, H, v)[0]

    at, slope = jax.jvp(after, (jnp.zeros(1),), (jnp.ones(1),))
    assert bool(jnp.all(at == H))
    np.testing.assert_allclose(slope, np.asarray(H + jnp.eye(3)[None]) / 3, rtol=1e-12, atol=1e-15)


# --- Derivatives ---------------------------------------------------------------------------------


def directions(law, H, history):
    """Two random directions of H, one for the history, one per parameter of the material."""
    rng = np.random.default_rng(3)
    zero = jax.tree.map(jnp.zeros_like, (law.material, H, history))
    random = [jnp.asarray(rng.normal(size=H.shape)) for _ in range(2)]
    chosen = [eqx.tree_at(lambda t: t[1], zero, dH) for dH in random]
    if history is not None:
        chosen.append(eqx.tree_at(lambda t: t[2], zero, jnp.ones_like(history)))
    leaves = jax.tree.leaves(law.material)
    for i, leaf in enumerate(leaves):
        chosen.append(eqx.tree_at(lambda t, i=i: jax.tree.leaves(t[0])[i], zero, leaf))
    return chosen


def along(arguments, direction, s):
    return jax.tree.map(lambda a, da: a + s * da, arguments, direction)


def regime(before, after):
    """Which branch each particle took: unchanged, flowing, or without stress."""
    return np.all(np.asarray(before == after[0]), (1, 2)) + 2 * (norm(after[2]) < 1e-11 * laws.E)


def central_difference(arguments, direction, step=1e-4):
    """Fourth-order difference, and which particles stayed in one regime."""
    points = [along(arguments, direction, s * step) for s in (1, -1, 2, -2)]
    values = [respond(*point) for point in points]
    regimes = [regime(p[1], v) for p, v in zip(points, values, strict=True)]
    a, b, c, d = (jax.tree.leaves(v) for v in values)
    difference = [
        (8 * (x - y) - (z - w)) / (12 * step) for x, y, z, w in zip(a, b, c, d, strict=True)
    ]
    return difference, np.all(np.array(regimes) == regimes[0], axis=0)


def one_sided_difference(arguments, direction, step):
    """Second-order difference towards one side."""
    at, near, far = (respond(*along(arguments, direction, s * step)) for s in (0, 1, 2))
    return [
        (4 * b - 3 * a - c) / (2 * step)
        for a, b, c in zip(*map(jax.tree.leaves, (at, near, far)), strict=True)
    ]


@functools.cache
def sampled(name):
    """Arguments that cover rest, rotation, equal stretches and flow."""
    law, H = LAWS[name], strains()
    return law.material, H, laws.later(law, len(H))


def derivatives(arguments, chosen):
    """Forward derivatives per direction; largest mismatch of forward and reverse, relative."""
    rng = np.random.default_rng(4)
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *chosen)
    shapes = eqx.filter_eval_shape(respond, *arguments)
    cotangent = jax.tree.map(lambda s: jnp.asarray(rng.normal(size=s.shape)), shapes)
    forward, reverse = laws.linear_response(*arguments, stacked, cotangent)
    dot = lambda x, y: sum(jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (x, y))))  # noqa: B905, E731
    mismatch = [
        abs(dot(cotangent, jax.tree.map(lambda a, k=k: a[k], forward)) - dot(reverse, direction))
        for k, direction in enumerate(chosen)
    ]
    size = max(float(jnp.sum(jnp.abs(a))) for a in jax.tree.leaves(forward))
    return jax.tree.leaves(forward), max(float(m) for m in mismatch) / size


@double
@every_law
def test_derivative_is_that_of_finite_differences(name):
    """Along H, the history and every parameter: forward = reverse = differences."""
    arguments = sampled(name)
    chosen = directions(LAWS[name], *arguments[1:])
    forward, mismatch = derivatives(arguments, chosen)
    assert mismatch < 1e-14
    for k, direction in enumerate(chosen):
        expected, smooth = central_difference(arguments, direction)
        assert smooth.sum() >= 30
        for ours, theirs in zip(forward, expected, strict=True):
            assert bool(jnp.isfinite(ours).all())
            error = np.abs(np.asarray(ours[k] - theirs))[smooth]
            assert error.max() <= 1e-8 * laws.E


def states_at_yield(name, n=48):
    """Elastic and flowing states, 1e-12 apart, by bisection; and the way from one to the other."""
    material, history = LAWS[name].material, laws.start(LAWS[name], n)
    shear = dev(np.random.default_rng(5).normal(size=(n, 3, 3)))
    shear = 0.4 * (shear + shear.swapaxes(1, 2)) / norm(shear)[:, None, None]
    elastic = np.tile(-0.05 * I3, (n, 1, 1))
    flowing = elastic + shear
    for _ in range(40):
        middle = (elastic + flowing) / 2
        after, _, _ = respond(material, jnp.asarray(middle), history)
        same = np.all(np.asarray(after) == middle, axis=(1, 2))[:, None, None]
        elastic, flowing = np.where(same, middle, elastic), np.where(same, flowing, middle)
    gap = flowing - elastic  # rounding must not decide to which side a state belongs
    sides = [(material, jnp.asarray(H), history) for H in (elastic - gap, flowing + gap)]
    return sides, jnp.asarray(shear)


@double
@every_plastic_law
def test_derivative_at_yield_is_that_of_its_side(name):
    """Each is that of a difference towards its side; they differ, unless flow begins smoothly."""
    sides, outwards = states_at_yield(name)
    derivative = []
    for arguments, step in zip(sides, (-1e-5, 1e-5), strict=True):
        chosen = directions(LAWS[name], *arguments[1:])
        chosen[0] = eqx.tree_at(lambda t: t[1], chosen[0], outwards)
        forward, mismatch = derivatives(arguments, chosen)
        assert mismatch < 1e-14
        derivative.append(forward[0][0])
        if LAWS[name].kink:
            expected = one_sided_difference(arguments, chosen[0], step)
            for ours, theirs in zip(forward, expected, strict=True):
                assert np.abs(np.asarray(ours[0] - theirs)).max() <= 1e-6 * laws.E
    jump = norm(derivative[0] - derivative[1])
    assert jump.min() > 1e-3 if LAWS[name].kink else jump.max() < 1e-6
