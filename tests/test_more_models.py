"""Fluids, Kelvin–Voigt damping, snow, softening, active fibres: closed forms and small flows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import laws
import numpy as np
import pytest
from laws import I3, MORE, dev, norm

import pgjax.models as pm
from pgjax.models.material import cast, particle_axes

double = pytest.mark.float64
every_law = pytest.mark.parametrize("name", MORE)
ROUNDING = float(jnp.finfo(jnp.zeros(()).dtype).eps)
COUNT = 48


# --- One particle --------------------------------------------------------------------------------


def answer(material, H, L, history, dt):
    """The trial state mapped back, what is remembered, and the stress, of one particle."""
    H, history = material.plasticity.return_map(H, history, material.elasticity, dt)
    return H, history, material.kirchhoff(H, H, L, history, dt)


def respond(material, H, L, history):
    """`answer` for `(48, 3, 3)`."""
    axes = (particle_axes(material, len(H)), 0, 0, 0, None)
    return jax.vmap(answer, in_axes=axes)(material, H, L, history, jnp.asarray(0.01, H.dtype))


compiled = eqx.filter_jit(respond)


@eqx.filter_jit(compiler_options=laws.UNOPTIMISED)
def linear_response(arguments, directions, cotangent):
    """Forward derivatives along stacked directions, and the reverse one of a cotangent."""
    arrays, static = eqx.partition(arguments, eqx.is_inexact_array)
    _, forward = jax.linearize(lambda a: respond(*eqx.combine(a, static)), arrays)
    (reverse,) = jax.linear_transpose(forward, arrays)(cotangent)
    return jax.vmap(forward)(directions), reverse


def sampled(name, F=None):
    """Material, H, L and history of 48 particles."""
    law, rng = MORE[name], np.random.default_rng(6)
    F = laws.deformations() if F is None else F
    history = None if law.history is None else jnp.full(len(F), law.history)
    return law.material, jnp.asarray(F - I3), jnp.asarray(rng.normal(size=F.shape)), history


def directions(arguments):
    """Random ones of H and of L, one of the history, one per parameter; stacked."""
    rng = np.random.default_rng(3)
    zero = jax.tree.map(jnp.zeros_like, arguments)
    chosen = []
    for k, leaf in enumerate(jax.tree.leaves(arguments)):
        d = jnp.asarray(rng.normal(size=leaf.shape))
        chosen.append(eqx.tree_at(lambda t, k=k: jax.tree.leaves(t)[k], zero, d))
    return jax.tree.map(lambda *a: jnp.stack(a), *chosen)


def along(arguments, stacked, k, s):
    return jax.tree.map(lambda a, d: a + s * d[k], arguments, stacked)


def derivatives(arguments):
    """Directions, derivatives along them, and the mismatch of forward and reverse mode."""
    stacked = directions(arguments)
    ones = jax.tree.map(
        lambda a: jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), compiled(*arguments)
    )
    forward, reverse = linear_response(arguments, stacked, ones)
    per_direction = zip(jax.tree.leaves(ones), jax.tree.leaves(forward), strict=True)
    ahead = sum(np.tensordot(f, c, c.ndim) for c, f in per_direction)
    pairs = zip(jax.tree.leaves(reverse), jax.tree.leaves(stacked), strict=True)
    back = sum(np.tensordot(d, r, r.ndim) for r, d in pairs)
    return stacked, jax.tree.leaves(forward), abs(ahead - back).max() / abs(ahead).max()


@double
@every_law
def test_derivatives_are_those_of_finite_differences(name):
    """Along H, L, the history and every parameter: forward = reverse = differences."""
    arguments = sampled(name)
    stacked, forward, mismatch = derivatives(arguments)
    assert mismatch < 1e-13
    assert all(bool(jnp.isfinite(a).all()) for a in forward)
    step = 1e-5
    for k in range(len(jax.tree.leaves(arguments))):
        ahead, behind = (compiled(*along(arguments, stacked, k, s * step)) for s in (1, -1))
        differences = jax.tree.map(lambda a, b: (a - b) / (2 * step), ahead, behind)
        error = [
            abs(np.asarray(a[k] - b)).reshape(COUNT, -1).max(1)
            for a, b in zip(forward, jax.tree.leaves(differences), strict=True)
        ]
        smooth = np.max(error, axis=0) <= 1e-6 * laws.E
        # The rest stands on a kink (J = 1 of a fluid), where each side has its own derivative.
        assert smooth.sum() >= COUNT - (9 if name == "Fluid" else 0)


@double
@every_law
def test_derivative_at_rest_is_the_elastic_one(name):
    """Snow and plasticine as Hooke's law, with J_p = 1; the fluid as in compression."""
    material, H, L, _ = sampled(name, np.tile(I3, (COUNT, 1, 1)))
    start = material.initial_history()
    history = None if start is None else jnp.full(COUNT, start)
    squeeze = jnp.tile(-jnp.diag(jnp.array([0.3, 0.5, 0.1])), (COUNT, 1, 1))

    def stress(H):
        return respond(material, H, jnp.zeros_like(L), history)[2]

    tau, slope = jax.jit(lambda H, dH: jax.jvp(stress, (H,), (dH,)))(H, squeeze)
    law = material.elasticity
    if name == "Fluid":
        expected = float(law.bulk_modulus) * -0.9 * I3
    else:
        expected = 2 * float(law.mu) * np.asarray(squeeze[0]) - float(law.lam) * 0.9 * I3
    assert norm(tau).max() == 0
    np.testing.assert_allclose(slope[0], expected, rtol=1e-12, atol=1e-12)


@every_law
def test_hard_states_have_finite_responses_and_derivatives(name):
    """Inverted, singular, crushed and stretched a thousandfold."""
    hard = [[1, 1, -0.5], [1, 0, 0], [0, 0, 0], [1e3, 1, 1e-3], [1, 1, 1e-6], [1e3] * 3]
    F = laws.with_stretches(np.random.default_rng(7), np.array(hard * 8, float))
    F[:6] = [np.diag(s) for s in hard]
    arguments = sampled(name, F)
    for dtype in {jnp.zeros(()).dtype, jnp.dtype(jnp.float32)}:
        response = compiled(*cast(arguments, dtype))
        assert {leaf.dtype for leaf in jax.tree.leaves(response)} == {dtype}
        assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(response))
    _, forward, _ = derivatives(arguments)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in forward)
    inverted = np.asarray([0, 6, 12])
    assert bool((response[0][inverted] == cast(arguments[1], dtype)[inverted]).all())


@every_law
def test_response_is_objective_and_symmetric_and_keeps_what_it_claims(name):
    """Z(Q F P) = Q Z(F) P (a fluid forgets both), τ(Q F P, Q L Qᵀ) = Q τ Qᵀ."""
    material, H, L, history = sampled(name)
    F, rng = np.asarray(H) + I3, np.random.default_rng(1)
    Q, P = (laws.rotations(rng, COUNT) for _ in range(2))
    QT = Q.swapaxes(1, 2)
    He, new, tau = compiled(material, H, L, history)
    turned, new_turned, tau_turned = compiled(
        material, jnp.asarray(Q @ F @ P - I3), jnp.asarray(Q @ np.asarray(L) @ QT), history
    )
    Fe = np.asarray(He) + I3
    expected = Fe if name == "Fluid" else Q @ Fe @ P
    scale = norm(tau).max()
    assert norm(np.asarray(turned) + I3 - expected).max() <= 1000 * ROUNDING
    assert norm(np.asarray(tau) - np.asarray(tau).swapaxes(1, 2)).max() <= 20 * ROUNDING * scale
    assert norm(tau_turned - Q @ np.asarray(tau) @ QT).max() <= 1000 * ROUNDING * scale
    J, J_new = np.linalg.det(F), np.linalg.det(Fe)
    if name == "Snow":
        J_new = J_new * np.asarray(new) / MORE[name].history
    if history is not None:
        assert abs(new - new_turned).max() <= 1000 * ROUNDING
    np.testing.assert_allclose(J_new, J, rtol=1000 * ROUNDING)


@every_law
def test_parameters_may_be_given_per_particle(name):
    """Each of them: a particle answers as the material that has its value alone."""
    arguments = sampled(name)
    factor = jnp.linspace(0.8, 1.0, COUNT)
    many = jax.tree.map(lambda a: a * factor, arguments[0])
    assert set(jax.tree.leaves(particle_axes(many, COUNT))) == {0}
    one = jax.tree.map(lambda a: a * factor[7], arguments[0])
    together, alone = (compiled(m, *arguments[1:])[2][7] for m in (many, one))
    np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match="one per particle of the material"):
        particle_axes(many, COUNT - 1)


@every_law
def test_bounds_of_the_tangent(name):
    """Above every eigenvalue of `L ↦ dτ − τ Lᵀ`, with the hardening it has; exact at rest."""
    material, history = MORE[name].material, MORE[name].history
    law = material.elasticity
    history = None if history is None else jnp.asarray(history)
    F = np.concatenate(
        [
            I3[None],
            laws.with_stretches(
                np.random.default_rng(8), np.random.default_rng(8).uniform(0.4, 1.3, (15, 3))
            ),
        ]
    )
    basis = jnp.eye(9).reshape(9, 3, 3)

    def tangent(H):
        stress = lambda H: law.kirchhoff(H, jnp.zeros_like(H), history)  # noqa: E731
        tau, linear = jax.linearize(stress, H)
        turn = lambda L: linear(L @ (jnp.eye(3) + H)) - tau @ L.T  # noqa: E731
        return jax.vmap(turn)(basis).reshape(9, 9), law.tangent_bound(H, 3, history)

    M, bound = jax.jit(jax.vmap(tangent))(jnp.asarray(F - I3))
    ratio = np.linalg.eigvalsh((M + M.swapaxes(1, 2)) / 2)[:, -1] / np.asarray(bound)
    assert ratio.max() <= 1 + 100 * ROUNDING
    assert ratio[0] == pytest.approx(1, abs=100 * ROUNDING)
    rest = float(law.rest_modulus(3)) * (np.exp(3 * 0.1) if name == "Snow" else 1)
    assert float(bound[0]) == pytest.approx(rest, rel=100 * ROUNDING)


# --- Fluid ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("J", [0.99, 0.5, 1.0, 1.3])
def test_fluid_is_a_pressure_and_a_shear_stress(J):
    """`σ = −p I + 2 η dev D`: pressure in compression, none in expansion."""
    water = pm.Fluid(3e4, 0.7, 7.0)
    L = np.array([[1.0, 4.0, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, 0.0]])
    H = jnp.asarray(np.diag([J * 1.25, 0.8, 1.0]) - I3)  # as sheared as it likes
    tau = np.asarray(water.kirchhoff(H, jnp.asarray(L)))
    p = max(3e4 / 7 * (J**-7.0 - 1), 0)
    expected = J * (-p * I3 + 0.7 * dev(L + L.T))
    np.testing.assert_allclose(tau, expected, rtol=1e5 * ROUNDING, atol=3e4 * 1e2 * ROUNDING)
    # W = ∫ p dJ by the trapezium rule.
    V = np.linspace(J, 1, 2001)
    work = np.trapezoid(np.maximum(3e4 / 7 * (V**-7.0 - 1), 0), V) if J < 1 else 0
    assert float(water.energy(H)) == pytest.approx(work, rel=1e-4, abs=1e-6)


def test_a_fluid_keeps_its_volume_only():
    """A thousand small shears in float32: J is what `det(I + Δt L)` makes it, Fe isotropic."""
    material = cast(pm.Material(pm.Fluid(1e4)), jnp.float32)
    assert isinstance(material.plasticity, pm.VolumeOnly)
    rng = np.random.default_rng(2)
    G = (1e-3 * rng.normal(size=(1000, 3, 3))).astype(np.float32)

    def advance(H, G):
        trial = H + G + G @ H
        return material.plasticity.return_map(trial, None, material.elasticity, G[0, 0])[0], None

    H, _ = jax.lax.scan(advance, jnp.zeros((3, 3), jnp.float32), jnp.asarray(G))
    J = np.prod(np.linalg.det(I3 + G.astype(float)))
    assert norm(dev(H)) == 0
    assert (1 + float(H[0, 0])) ** 3 == pytest.approx(J, rel=2e-6)


# --- Kelvin–Voigt --------------------------------------------------------------------------------


def test_kelvin_voigt_adds_a_viscous_stress_and_passes_the_rest_through():
    inner = pm.StVKHencky(laws.E, laws.NU)
    law = pm.KelvinVoigt(inner, 0.4)
    H = jnp.asarray(laws.deformations()[9] - I3)
    L = jnp.asarray(np.random.default_rng(1).normal(size=(3, 3)))
    J = 1 + float(pm.elasticity.volume_change(H))
    extra = law.kirchhoff(H, L) - inner.kirchhoff(H, L)
    np.testing.assert_allclose(extra, 0.4 * J * (L + L.T), rtol=1e4 * ROUNDING)
    for name in ("E", "nu", "mu", "lam", "kappa"):
        assert getattr(law, name) == getattr(inner, name)
    assert pm.Material(law, pm.VonMises(1.0)).plasticity is not None
    damped_snow = pm.Material(pm.KelvinVoigt(pm.Snow(1.0, 0.2), 1.0))
    assert isinstance(damped_snow.plasticity, pm.CriticalStretches)
    with pytest.raises(ValueError, match="VonMises is not written for"):
        pm.Material(pm.KelvinVoigt(pm.NeoHookean(1.0, 0.3), 1.0), pm.VonMises(1.0))


# --- Snow and plasticine -------------------------------------------------------------------------


def test_snow_clamps_each_stretch_and_hardens():
    """`Σ ← clamp(Σ)`, `J_p = J/J_e`, `τ = e^(ξ (1 − J_p)) τ_fixed corotated`."""
    material = pm.Material(pm.Snow(1.4e5, 0.2))  # with the θ and ξ of the paper
    stretch = np.array([[1.0, 1.005, 0.98], [1.02, 1.0, 0.9], [0.95, 0.9, 0.97], [1.1, 1.2, 1.3]])
    F = jnp.asarray([np.diag(s) - I3 for s in stretch])
    flow = jax.jit(jax.vmap(material.plasticity.return_map, in_axes=(0, None, None, None)))
    H, Jp = flow(F, jnp.ones(()), material.elasticity, jnp.asarray(0.1))
    clamped = np.clip(stretch, 1 - 2.5e-2, 1 + 7.5e-3)
    np.testing.assert_allclose(
        np.asarray(H) + I3, [np.diag(s) for s in clamped], rtol=20 * ROUNDING
    )
    assert bool((H[0] == F[0]).all())
    expected = (stretch / clamped).prod(1)
    np.testing.assert_allclose(Jp, expected, rtol=50 * ROUNDING)
    stress = jax.vmap(lambda law, H, Jp: law.kirchhoff(H, H, Jp), in_axes=(None, 0, 0))
    plain = pm.FixedCorotated(1.4e5, 0.2)
    ratio = stress(material.elasticity, H, Jp)[1:, 2, 2] / stress(plain, H, Jp)[1:, 2, 2]
    factor = np.minimum(np.exp(10 * (1 - expected[1:])), np.exp(4.0))
    np.testing.assert_allclose(ratio, factor, rtol=1e4 * ROUNDING)
    assert float(plain.energy(H[3])) < float(plain.energy(F[3]))


def uniaxial(softening, steps=40):
    """Shear pulled in steps of a Hencky strain: the yield stress after each."""
    law = pm.StVKHencky(laws.E, laws.NU)
    material = pm.Material(law, pm.VonMises(0.6, softening=softening))
    d = np.array([1.0, -0.5, -0.5])

    def pull(carry, _):
        H, history = carry
        grow = jnp.diag(jnp.asarray(np.exp(0.01 * d), H.dtype))
        trial = grow @ (H + jnp.eye(3)) - jnp.eye(3)
        H, history = material.plasticity.return_map(trial, history, law, H[0, 0])
        return (H, history), (jnp.diagonal(law.kirchhoff(H, H)), history)

    _, (tau, history) = jax.lax.scan(pull, (jnp.zeros((3, 3)), jnp.zeros(())), None, length=steps)
    return np.asarray(tau), np.asarray(history), float(law.mu)


@double
def test_plasticine_softens_to_nothing():
    """Rate of uniaxial Hencky strain ε̇: `d(δγ) = √1.5 dε/(1 − ξ)`, `‖dev τ‖ = τ_Y − 2μ ξ Σδγ`."""
    xi, step = 0.1, 0.01
    tau, history, mu = uniaxial(xi)
    yielding = history > 0
    first = int(np.argmax(yielding))
    assert first == int(0.6 / (2 * mu) / (1.5**0.5 * step))
    s = np.sqrt(np.sum((tau - tau.mean(1, keepdims=True)) ** 2, axis=1))
    # A step flows at the yield stress the step before left behind.
    before = np.concatenate([[0.0], history[:-1]])
    np.testing.assert_allclose(s[yielding], (0.6 - 2 * mu * xi * before)[yielding], rtol=1e-10)
    rate = np.diff(history)[first + 5 : first + 15]
    np.testing.assert_allclose(rate, 1.5**0.5 * step * (1 + xi), rtol=0.02)
    tau, history, _ = uniaxial(1.0, steps=60)
    s = np.sqrt(np.sum((tau - tau.mean(1, keepdims=True)) ** 2, axis=1))
    assert s[-1] == pytest.approx(0, abs=1e-12)
    assert np.all(np.diff(history) >= 0)


# --- Active fibres -------------------------------------------------------------------------------


def test_a_free_fibre_shortens_to_its_closed_form():
    """ν = 0, along an oblique fibre: `μ (s² − 1) + a s² = 0`, `s = √(μ/(μ + a))`."""
    law = pm.NeoHookean(1e4, 0.0)
    f0 = np.array([1.0, 2.0, 2.0]) / 3
    s = (5e3 / (5e3 + 2e3)) ** 0.5
    H = jnp.asarray((s - 1) * np.outer(f0, f0))
    muscle = pm.Material(law, active=pm.ActiveStress(6 * f0, 2e3))
    zero = jnp.zeros(())
    tau = muscle.kirchhoff(H, H, jnp.zeros_like(H), None, zero)
    np.testing.assert_allclose(tau, 0, atol=1e4 * 10 * ROUNDING)
    beating = pm.ActiveStress(f0, 2e3, signal=jnp.cos)
    ratio = beating.kirchhoff(H, zero + 1.0)[0, 0] / beating.kirchhoff(H, zero)[0, 0]
    assert float(ratio) == pytest.approx(np.cos(1), rel=1e-6)
    # ∂τ/∂(L) of the active part: a (L m) mᵀ, of norm a |m|².
    assert float(beating.tangent_bound(H)) == pytest.approx(2e3 * s * s, rel=1e-6)


# --- Bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: pm.Fluid(0.0), "`bulk_modulus` must be positive"),
        (lambda: pm.Fluid(1.0, -1.0), "`viscosity` must be at least 0"),
        (lambda: pm.Fluid(1.0, [1.0, np.inf]), "`viscosity` must be at least 0 .* at index"),
        (lambda: pm.Fluid(1.0, 0.0, 1.0), "`gamma` must be above 1"),
        (lambda: pm.KelvinVoigt(pm.NeoHookean(1.0, 0.3), np.nan), "`viscosity` must be at least 0"),
        (lambda: pm.Snow(-1.0, 0.3), "`E` must be positive"),
        (lambda: pm.Snow(1.0, 0.3, -1.0), "`hardening` must be at least 0"),
        (lambda: pm.CriticalStretches(1.0), r"`critical_compression` must be in \[0, 1\)"),
        (lambda: pm.CriticalStretches(0.1, -1.0), "`critical_stretch` must be at least 0"),
        (lambda: pm.VonMises(1.0, softening=-1.0), "`softening` must be at least 0"),
        (lambda: pm.VonMises(1.0, 0.1, 0.1), "`softening` must be None where `hardening`"),
        (lambda: pm.ActiveStress([1.0, 0.0], 1.0), r"`direction` must have shape \(3,\)"),
        (lambda: pm.ActiveStress([[1.0, 0, 0], [0, 0, 0]], 1.0), "`direction` must not be zero"),
        (lambda: pm.ActiveStress([1.0, 0, 0], np.inf), "`activation` must be finite"),
        (lambda: pm.Material(pm.Fluid(1.0), pm.VonMises(1.0)), "VonMises is not written for Fluid"),
        (lambda: pm.Material(pm.Snow(1.0, 0.2), pm.VonMises(1.0)), "is not written for Snow"),
        (lambda: pm.Material(pm.NeoHookean(1.0, 0.2), pm.VolumeOnly()), "VolumeOnly is not"),
    ],
)
def test_bad_parameters_are_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()


def test_a_fibre_per_particle_has_to_fit_the_particles():
    active = pm.ActiveStress(np.ones((3, 3)), [1.0, 2.0, 3.0])
    material = pm.Material(pm.NeoHookean(1.0, 0.2), active=active)
    axes = particle_axes(material, 3)
    assert (axes.active.direction, axes.active.activation, axes.density) == (0, 0, None)
    with pytest.raises(ValueError, match=r"`direction` must be one vector .*shape \(4, 3\)"):
        particle_axes(material, 4)
