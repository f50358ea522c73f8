"""Level 1 of the verification: one constitutive point against closed forms.

V06 to V13 (V14 is in `test_linalg`), with the misprints of the source as negative controls: each
must fail the check that the right formula passes.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import laws
import numpy as np
import oracle
import pytest
from laws import I3, LAWS, dev, norm, run

pytestmark = pytest.mark.float64

MU, LAM, KAPPA = oracle.lame(laws.E, laws.NU)
PAIR, BULK = {"mu": MU, "lam": LAM}, {"mu": MU, "kappa": KAPPA}
STRESS = {
    "FixedCorotated": functools.partial(oracle.fixed_corotated, **PAIR),
    "StVKHencky": functools.partial(oracle.hencky, **PAIR),
    "NeoHookean": functools.partial(oracle.neo_hookean, **PAIR),
    "DevVolNeoHookean": functools.partial(oracle.dev_vol_neo_hookean, **BULK),
}
ENERGY = {
    "FixedCorotated": functools.partial(oracle.fixed_corotated_energy, **PAIR),
    "StVKHencky": functools.partial(oracle.hencky_energy, **PAIR),
    "NeoHookean": functools.partial(oracle.neo_hookean_energy, **PAIR),
    "DevVolNeoHookean": functools.partial(oracle.dev_vol_neo_hookean_energy, **BULK),
}
every_elastic_law = pytest.mark.parametrize("name", laws.ELASTIC)
BATCH = 48  # of the other tests, so that nothing is compiled twice


def random_states(count=21):
    """Deformation gradients `(48 count, 3, 3)`: F = I, diag(1, 1, 2), I + 1e-7, then random."""
    rng = np.random.default_rng(12)
    stretch = np.exp(rng.uniform(np.log(0.3), np.log(3), (BATCH * count, 3)))
    F = laws.with_stretches(rng, stretch)
    F[:3] = I3, np.diag([1.0, 1, 2]), I3 + 1e-7 * rng.normal(size=(3, 3))
    return F


def batches(F):
    """Batches of 48, the last one filled up with copies."""
    F = np.asarray(F, float)
    count = -(-len(F) // BATCH)
    return np.resize(F, (count * BATCH, 3, 3)).reshape(count, BATCH, 3, 3)


def mapped(name, F, initial=True):
    """New F and stress of a law at any number of deformation gradients."""
    history = laws.start(LAWS[name], BATCH) if initial else laws.later(LAWS[name], BATCH)
    results = [run(name, part, history) for part in batches(F)]
    Fe, tau = (np.concatenate([r[k] for r in results])[: len(F)] for k in (0, 2))
    return Fe, tau


def elastic(name):
    """The fast law of which this is a form."""
    return LAWS[name].fast or name


def relative(error, tau):
    return (norm(error) / np.maximum(norm(tau), 1e-2 * laws.E)).max()


@every_elastic_law
def test_v06_stress_is_the_derivative_of_the_energy(name, measure):
    F = random_states()
    law = LAWS[name].material.elasticity
    results = [laws.energies(law, jnp.asarray(part - I3)) for part in batches(F)]
    W, expected = (np.concatenate([np.asarray(r[k]) for r in results]) for k in (0, 1))
    _, tau = mapped(name, F)
    measure("V06", f"{name}: τ − ∂W/∂F Fᵀ, relative", relative(tau - expected, tau), below=1e-10)
    exact = np.array([ENERGY[elastic(name)](f) for f in F])
    gap = (abs(W - exact) / np.maximum(exact, 1e-3 * laws.E)).max()
    measure("V06", f"{name}: energy against the oracle, relative", gap, below=1e-10)
    exact = np.array([STRESS[elastic(name)](f) for f in F])
    measure(
        "V06", f"{name}: τ against the oracle, relative", relative(tau - exact, tau), below=1e-10
    )
    if name == "NeoHookean":
        wrong = np.array([oracle.misprint_neo_hookean(f, **PAIR) for f in F])
        what = "control: misprint E3 (log J without λ) − ∂W/∂F Fᵀ"
        measure("V06", what, relative(wrong - expected, tau), above=1e-2)


@every_elastic_law
def test_v07_stress_is_objective_isotropic_and_symmetric(name, measure):
    F = random_states()
    rng = np.random.default_rng(13)
    Q, P = laws.rotations(rng, len(F)), laws.rotations(rng, len(F))
    QT = Q.swapaxes(1, 2)
    _, tau = mapped(name, F)
    _, turned = mapped(name, Q @ F)
    _, same = mapped(name, F @ P)
    measure("V07", f"{name}: τ(QF) − Q τ Qᵀ", relative(turned - Q @ tau @ QT, tau), below=1e-12)
    measure("V07", f"{name}: τ(FQ) − τ", relative(same - tau, tau), below=1e-12)
    measure("V07", f"{name}: τ − τᵀ", relative(tau - tau.swapaxes(1, 2), tau), below=1e-12)
    if name == "StVKHencky":
        wrong = np.array([oracle.misprint_hencky(f, **PAIR) for f in F])
        skew = relative(wrong - wrong.swapaxes(1, 2), wrong)
        measure("V07", "control: misprint E2 (Vᵀ in place of Uᵀ), τ − τᵀ", skew, above=1e-2)


@every_elastic_law
def test_v08_small_strains_follow_hooke(name, measure):
    rng = np.random.default_rng(14)
    size = 10.0 ** -rng.uniform(2, 6, (BATCH, 1, 1))
    H = size * rng.normal(size=(BATCH, 3, 3))
    H = (H + H.swapaxes(1, 2)) / 2
    hooke = LAM * np.trace(H, axis1=1, axis2=2)[:, None, None] * I3 + 2 * MU * H
    _, _, tau = run(name, I3 + H)
    excess = norm(tau - hooke) / (norm(H) * norm(tau))
    measure("V08", f"{name}: |τ − Hooke|/(|ε| |τ|)", excess.max(), below=3)
    law = LAWS[name].material.elasticity
    tangent = jax.jit(jax.jacfwd(lambda H: law.kirchhoff(H, jnp.zeros_like(H))))
    moduli = np.asarray(tangent(jnp.zeros((3, 3))))
    delta = np.einsum("ij,kl->ijkl", I3, I3)
    exact = LAM * delta + MU * (delta.transpose(0, 2, 1, 3) + delta.transpose(0, 2, 3, 1))
    error = abs(moduli - exact).max() / MU
    measure("V08", f"{name}: ∂τ/∂ε at rest against λ and μ", error, below=1e-9)


SHEAR = np.array([0.05, 0.1, 0.5, 1.0, 2.0])
STRETCH = np.array([0.5, 0.8, 0.99, 1.3, 2.0])
SHEAR_STRESS = {
    "FixedCorotated": lambda g: 2 * MU * (g - g / np.sqrt(4 + g**2)),
    "StVKHencky": lambda g: 4 * MU * np.arcsinh(g / 2) / np.sqrt(4 + g**2),
    "NeoHookean": lambda g: MU * g,
    "DevVolNeoHookean": lambda g: MU * g,
}
PRESSURE = {
    "FixedCorotated": lambda s: 2 * MU * (s - 1) * s + LAM * s**3 * (s**3 - 1),
    "StVKHencky": lambda s: (2 * MU + 3 * LAM) * np.log(s),
    "NeoHookean": lambda s: MU * (s**2 - 1) + 3 * LAM * np.log(s),
    "DevVolNeoHookean": lambda s: KAPPA / 2 * (s**6 - 1),
}


@every_elastic_law
def test_v09_closed_forms(name, measure):
    """Simple shear and equal stretch; neo-Hookean also τ11 of shear."""
    F = np.tile(I3, (len(SHEAR), 1, 1))
    F[:, 0, 1] = SHEAR
    _, tau = mapped(name, F)
    error = abs(tau[:, 0, 1] / SHEAR_STRESS[elastic(name)](SHEAR) - 1).max()
    measure("V09", f"{name}: shear stress in simple shear", error, below=1e-12)
    if name == "NeoHookean":
        error = abs(tau[:, 0, 0] / (MU * SHEAR**2) - 1).max()
        measure("V09", f"{name}: normal stress in simple shear", error, below=1e-12)
    _, tau = mapped(name, STRETCH[:, None, None] * I3)
    expected = PRESSURE[elastic(name)](STRETCH)[:, None, None] * I3
    measure("V09", f"{name}: equal stretch", relative(tau - expected, expected), below=1e-12)


@pytest.mark.parametrize("name", laws.PLASTIC)
def test_v10_return_maps(name, measure):
    law, F = LAWS[name], random_states(4)
    H = [jnp.asarray(part - I3) for part in batches(F)]
    history = laws.start(law, BATCH)
    results = [laws.respond(law.material, h, history) for h in H]
    after, tau = (np.concatenate([np.asarray(r[k]) for r in results]) for k in (0, 2))
    trial, Fe = np.concatenate([np.asarray(h) for h in H]), after + I3
    moved = np.any(after != trial, axis=(1, 2))
    measure("V10", f"{name}: states that flowed", moved.sum(), above=BATCH)
    b, b_new = F @ F.swapaxes(1, 2), Fe @ Fe.swapaxes(1, 2)
    twist = (norm(b @ b_new - b_new @ b) / norm(b) / norm(b_new)).max()
    measure("V10", f"{name}: directions kept, |b b′ − b′ b|", twist, below=1e-12)
    if law.isochoric:
        change = abs(np.linalg.det(Fe) / np.linalg.det(F) - 1).max()
        measure("V10", f"{name}: change of det F", change, below=1e-12)
    if not law.rate_independent:
        return
    later = None if history is None else np.concatenate([np.asarray(r[1]) for r in results])
    elasticity = law.material.elasticity
    excess = laws.overshoot(law.material.plasticity, elasticity, tau, later).max() / laws.E
    measure("V10", f"{name}: yield function after, over E", excess, below=1e-10)
    if not law.corrected:
        again = [laws.respond(law.material, r[0], r[1])[0] - r[0] for r in results]
        error = max(norm(a).max() for a in again)
        measure("V10", f"{name}: change by a second mapping", error, below=1e-12)


def test_v10_elastic_states_are_returned_bit_by_bit(measure):
    rng = np.random.default_rng(15)
    F = laws.with_stretches(rng, rng.uniform(0.94, 0.96, (BATCH, 3)))
    for name in laws.PLASTIC:
        H = jnp.asarray(F - I3)
        after, _, _ = laws.respond(LAWS[name].material, H, laws.start(LAWS[name], BATCH))
        measure("V10", f"{name}: elastic states changed", (after != H).sum(), below=0)


@pytest.mark.parametrize("name", ["DruckerPrager", "DruckerPrager-cohesive"])
def test_v10_sand_keeps_its_volume_on_the_cone_and_loses_it_at_the_tip(name, measure):
    F = random_states(4)
    F[1::2] *= 0.8
    Fe, _ = mapped(name, F)
    cohesion = LAWS[name].material.plasticity.cohesion
    tip = np.log(np.linalg.det(F)) > (0 if cohesion is None else 3 * float(cohesion))
    change = abs(np.linalg.det(Fe) / np.linalg.det(F) - 1)[~tip].max()
    measure("V10", f"{name}: change of det F on the cone", change, below=1e-12)
    size = 1 if cohesion is None else np.exp(float(cohesion))
    rest = norm(Fe @ Fe.swapaxes(1, 2) - size**2 * I3)[tip].max()
    measure("V10", f"{name}: tip, distance from an equal stretch", rest, below=1e-12)


def test_v10_misprinted_metal_misses_its_yield_surface(measure):
    tau_Y = float(LAWS["VonMises"].material.plasticity.yield_stress)
    F = [oracle.misprint_von_mises(f, tau_Y, laws.DT, mu=MU)[0] for f in random_states(1)]
    excess = max(norm(dev(oracle.hencky(f, **PAIR))) - tau_Y for f in F) / laws.E
    measure("V10", "control: misprint E4 (over |ε|), yield function over E", excess, above=1e-2)


def principal(name, strains):
    """Principal stresses `(n, 3)` after the mapping of states with principal Hencky strains."""
    _, tau = mapped(name, np.exp(np.array(strains))[:, :, None] * I3)
    return np.diagonal(tau, axis1=1, axis2=2)


@pytest.mark.parametrize("name", ["VonMises", "VonMisesSVD"])
def test_v11_yield_of_metal_in_shear_and_tension(name, measure):
    """C1: τ_Y is ‖dev τ‖."""
    plasticity = LAWS[name].material.plasticity
    tau_Y = float(getattr(plasticity, "law", plasticity).yield_stress)
    shear, tension = principal(name, [[0.3, -0.3, 0], [0.4, -0.2, -0.2]])
    error = abs(shear[0] / (tau_Y / 2**0.5) - 1)
    measure("V11", f"{name}: shear yield against τ_Y/√2", error, below=1e-8)
    error = abs((tension[0] - tension[1]) / (1.5**0.5 * tau_Y) - 1)
    measure("V11", f"{name}: tensile yield against √(3/2) τ_Y", error, below=1e-8)


def test_v12_friction_of_sand_in_triaxial_compression_and_in_shear(measure):
    """C3: exact Mohr–Coulomb in the one, 34.7° in the other (φ = 30°)."""
    sine = 0.5
    triaxial, shear = principal("DruckerPrager", [[0.1, 0.1, -0.6], [0.2, -0.4, -0.1]])
    error = abs(triaxial[2] / triaxial[0] * (1 - sine) / (1 + sine) - 1)
    measure("V12", "triaxial compression: σ₁/σ₃ of Mohr–Coulomb", error, below=1e-8)
    alpha = float(LAWS["DruckerPrager"].material.plasticity.alpha)
    tangent = (shear[0] - shear[1]) / -(shear[0] + shear[1])
    error = abs(tangent / (3 * alpha / 2**0.5) - 1)
    measure("V12", "constant-volume shear: τ/σ_n against 3α/√2", error, below=1e-6)
    angle = np.degrees(np.arctan(tangent))
    measure("V12", "constant-volume shear: angle of friction, degrees", angle, within=(34.6, 34.8))


@pytest.mark.parametrize(("name", "h"), [("HerschelBulkley", 1.0), ("HerschelBulkley-h", 0.6)])
def test_v13_flow_rule_of_paste_under_a_constant_rate(name, h, measure):
    """Steady excess stress η dʰ at any Δt; at h = 1 the discrete relaxation is exact."""
    plasticity = LAWS[name].material.plasticity
    s_Y, eta, rate = (
        (2 / 3) ** 0.5 * float(plasticity.yield_stress),
        float(plasticity.viscosity),
        0.3,
    )
    mu = jnp.asarray(MU)
    for dt in (1e-4, 1e-2, 1.0):

        @jax.jit
        def load(s, dt=dt):
            return plasticity.flow_stress(s + 2 * mu * rate * dt, mu, jnp.asarray(dt))

        s, excess = jnp.asarray(s_Y + 0.01), 0.01
        errors = []
        for _ in range(5):
            s = load(s)
            excess = (excess + 2 * MU * rate * dt) * eta / (eta + 2 * MU * dt)
            errors.append(abs(float(s) - s_Y - excess) / s_Y)
        if h == 1:
            measure("V13", f"relaxation in steps of {dt:g} s", max(errors), below=1e-12)
        steady = s_Y + eta * rate**h
        error = abs(float(load(jnp.asarray(steady))) - steady) / s_Y
        measure("V13", f"h = {h}: steady state in steps of {dt:g} s", error, below=1e-12)


@eqx.filter_jit
def sheared(material, rate, dt):
    """‖s‖ of paste in simple shear at a constant rate, after 400 steps."""
    L = jnp.zeros((3, 3)).at[0, 1].set(rate)

    def advance(H, _):
        trial = H + dt * L + dt * L @ H
        return material.plasticity.return_map(trial, None, material.elasticity, dt)[0], None

    H, _ = jax.lax.scan(advance, jnp.zeros((3, 3)), length=400)
    return material.elasticity.kirchhoff(H, L)


def test_v13_paste_in_driven_shear_flows_as_a_bingham_body(measure):
    """C2: ‖s‖ = √(2/3) σ_Y + η |d|, |d| = γ̇/√2, to second order in the elastic strain."""
    material = LAWS["HerschelBulkley"].material
    errors = []
    for ratio in (1e-1, 1e-2, 1e-3):
        sigma_Y, rate = ratio * MU, 1.0
        eta = 0.5 * sigma_Y / rate
        law = eqx.tree_at(
            lambda m: (m.plasticity.yield_stress, m.plasticity.viscosity),
            material,
            (jnp.asarray(sigma_Y), jnp.asarray(eta)),
        )
        tau = np.asarray(sheared(law, jnp.asarray(rate), jnp.asarray(0.05 * ratio)))
        expected = (2 / 3) ** 0.5 * sigma_Y + eta * rate / 2**0.5
        errors.append(abs(norm(dev(tau)) / expected - 1) / (expected / MU) ** 2)
        measure("V13", f"driven shear, σ_Y/μ = {ratio:g}: error/(s/μ)²", errors[-1], below=1)
        shear_stress = abs(tau[0, 1] / (sigma_Y / 3**0.5 + eta / 2 * rate) - 1)
        measure("V13", f"τ12 against σ_Y/√3 + η γ̇/2, σ_Y/μ = {ratio:g}", shear_stress, below=ratio)
