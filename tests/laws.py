"""Every constitutive law of the package, the states to try it in, and how it answers.

A new law is tested by adding one line to `LAWS`; `test_models` fails if one is missing.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import pgjax.models as pm
import pgjax.models.reference as svd
from pgjax.linalg import volume_change
from pgjax.models.material import cast

E, NU, DT = 7.0, 0.3, 0.01
# Derivatives run for milliseconds and compile for seconds: without optimisation in half of them.
UNOPTIMISED = {"xla_backend_optimization_level": 0}
I3 = np.eye(3)


@dataclasses.dataclass(frozen=True)
class Law:
    """A material and what it claims of itself.

    `history` is a value that has an effect (None: no memory), `kink` whether the derivative jumps
    where flow begins, `fast` the name of the law of which this is the form with an SVD.
    """

    material: pm.Material
    history: float | None = None
    rate_independent: bool = True
    isochoric: bool = False
    corrected: bool = False
    kink: bool = True
    fast: str | None = None

    @property
    def plastic(self) -> bool:
        return self.material.plasticity is not None


def _laws() -> dict[str, Law]:
    material, hencky, devvol = pm.Material, pm.StVKHencky(E, NU), pm.DevVolNeoHookean(E, NU)
    reference = svd.StVKHenckySVD(E, NU)
    metal = {"isochoric": True}
    hard, wet = {"history": 0.02, **metal}, {"history": 0.02, "corrected": True}
    paste = {"rate_independent": False, "isochoric": True}
    return {
        "FixedCorotated": Law(material(pm.FixedCorotated(E, NU))),
        "StVKHencky": Law(material(hencky)),
        "NeoHookean": Law(material(pm.NeoHookean(E, NU))),
        "DevVolNeoHookean": Law(material(devvol)),
        "VonMises": Law(material(hencky, pm.VonMises(0.6)), **metal),
        "VonMises-hardening": Law(material(hencky, pm.VonMises(0.6, 0.1)), **hard),
        "DruckerPrager": Law(material(hencky, pm.DruckerPrager(30.0))),
        "DruckerPrager-cohesive": Law(material(hencky, pm.DruckerPrager(30.0, 0.02))),
        "DruckerPrager-corrected": Law(material(hencky, pm.DruckerPrager(30.0, 0.02, True)), **wet),
        "HerschelBulkley": Law(material(devvol, pm.HerschelBulkley(0.7, 0.1)), **paste),
        "HerschelBulkley-h": Law(
            material(devvol, pm.HerschelBulkley(0.7, 0.1, 0.6)), **paste, kink=False
        ),
        "HerschelBulkley-plastic": Law(
            material(devvol, pm.HerschelBulkley(0.7, 0.0)), isochoric=True
        ),
        "FixedCorotatedSVD": Law(material(svd.FixedCorotatedSVD(E, NU)), fast="FixedCorotated"),
        "StVKHenckySVD": Law(material(reference), fast="StVKHencky"),
        "VonMisesSVD": Law(
            material(reference, svd.VonMisesSVD(0.6, 0.1)), **hard, fast="VonMises-hardening"
        ),
        "DruckerPragerSVD": Law(
            material(reference, svd.DruckerPragerSVD(30.0, 0.02, True)),
            **wet,
            fast="DruckerPrager-corrected",
        ),
        "HerschelBulkleySVD": Law(
            material(devvol, svd.HerschelBulkleySVD(0.7, 0.1)), **paste, fast="HerschelBulkley"
        ),
    }


def _more() -> dict[str, Law]:
    damped = pm.KelvinVoigt(pm.StVKHencky(E, NU), 0.4)
    clay, snow = pm.VonMises(0.6, softening=0.1), pm.CriticalStretches(0.2, 0.1)
    return {
        "Fluid": Law(pm.Material(pm.Fluid(E, 0.4, 7.0)), rate_independent=False),
        "Plasticine": Law(pm.Material(damped, clay), history=0.02, isochoric=True),
        "Snow": Law(pm.Material(pm.Snow(E, NU, 3.0), snow), history=0.9),
    }


LAWS = _laws()
# Beyond the laws of the source: viscous, or their flow changes more than Fe (`test_more_models`).
MORE = _more()
ELASTIC = [name for name, law in LAWS.items() if not law.plastic]
PLASTIC = [name for name, law in LAWS.items() if law.plastic]


# --- States --------------------------------------------------------------------------------------


def rotations(rng, n):
    """Random proper rotations `(n, 3, 3)`."""
    Q, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    return Q * np.linalg.det(Q)[:, None, None]


def with_stretches(rng, stretches):
    """Deformation gradients `U diag(s) Vᵀ` with random rotations, from `(n, 3)` stretches."""
    U, V = (rotations(rng, len(stretches)) for _ in range(2))
    return np.einsum("pij,pj,pkj->pik", U, stretches, V)


def deformations(seed=0, n=48):
    """Deformation gradients `(n, 3, 3)`: rest, a rotation, equal stretches, then generic ones."""
    rng = np.random.default_rng(seed)
    special = [[1, 1, 1], [1, 1, 2], [2, 1, 1], [0.7] * 3, [1.3] * 3, [1, 1 + 1e-7, 1 - 2e-7]]
    generic = np.exp(rng.uniform(-0.5, 0.5, (n - len(special) - 4, 3)))
    F = with_stretches(rng, np.concatenate([np.array(special), generic]))
    exact = [I3, np.diag([1.0, 1, 2]), I3 + 1e-7 * rng.normal(size=(3, 3))]
    return np.concatenate([exact, rotations(rng, 1), F])


def strains(seed=0, n=48):
    """`H = F − I` of `deformations`."""
    return jnp.asarray(deformations(seed, n) - I3)


# --- Answers -------------------------------------------------------------------------------------


def answer(material, H, history, dt):
    """One particle: the trial state is mapped back, then its stress is taken."""
    if material.plasticity is not None:
        H, history = material.plasticity.return_map(H, history, material.elasticity, dt)
    return H, history, material.elasticity.kirchhoff(H, jnp.zeros_like(H), history)


@eqx.filter_jit
def respond(material, H, history, dt=None):
    """`answer` for many particles `(p, 3, 3)`; the history is one number for all, or None."""
    dt = jnp.asarray(DT if dt is None else dt, H.dtype)
    history = None if history is None else history * jnp.ones(len(H), H.dtype)
    return jax.vmap(answer, in_axes=(None, 0, 0, None))(material, H, history, dt)


@eqx.filter_jit(compiler_options=UNOPTIMISED)
def energies(elasticity, H):
    """Energy and `(∂W/∂F) Fᵀ` for many particles."""

    def one(H):
        W, P = jax.value_and_grad(elasticity.energy)(H)
        return W, P @ (jnp.eye(3, dtype=H.dtype) + H).T

    return jax.vmap(one)(H)


def start(law, n):
    """History of n particles at the start, or None."""
    return _history(law.material.initial_history(), n)


def later(law, n):
    """A history of n particles that has an effect, or None."""
    return _history(law.history, n)


def _history(value, n):
    return None if value is None else jnp.full(n, value, jnp.zeros(()).dtype)


def run(name, F, history=None, dtype=None):
    """New F, history and stress of a law for trial deformation gradients `(n, 3, 3)`, in numpy."""
    law = LAWS[name]
    dtype = jnp.zeros(()).dtype if dtype is None else dtype
    H, history, tau = respond(cast(law.material, dtype), jnp.asarray(F - I3, dtype), history)
    return np.asarray(H) + I3, history, np.asarray(tau)


def norm(A):
    """Frobenius norms `(n,)`."""
    return np.sqrt(np.sum(np.asarray(A, np.float64) ** 2, axis=(-2, -1)))


def dev(A):
    """Deviators of `(n, 3, 3)`."""
    A = np.asarray(A)
    return A - np.trace(A, axis1=-2, axis2=-1)[..., None, None] / 3 * I3


def volume(H):
    """`J` of many particles."""
    return 1 + np.asarray(jax.vmap(volume_change)(H))


def overshoot(plasticity, elasticity, tau, history):
    """Yield function of a rate-independent law at the stresses `(n, 3, 3)`, Pa: ≤ 0 is allowed."""
    law = getattr(plasticity, "law", plasticity)
    s, mu = norm(dev(tau)), float(elasticity.mu)
    if isinstance(law, pm.VonMises):
        harder = 0 if law.hardening is None else 2 * mu * law.hardening * np.asarray(history)
        return s - float(law.yield_stress) - harder
    if isinstance(law, pm.HerschelBulkley):
        return s - (2 / 3) ** 0.5 * float(law.yield_stress)
    tip = 0 if law.cohesion is None else 9 * float(elasticity.kappa * law.cohesion)
    return s + float(law.alpha) * (np.trace(np.asarray(tau), axis1=1, axis2=2) - tip)


@eqx.filter_jit(compiler_options=UNOPTIMISED)
def linear_response(material, H, history, directions, cotangent):
    """Forward derivatives along each of the directions, and the reverse one of a cotangent.

    A direction is a tree like `(material, H, history)` with a leading axis.
    """
    arrays, static = eqx.partition((material, H, history), eqx.is_inexact_array)

    def respond_to(arrays):
        return respond(*eqx.combine(arrays, static))

    _, forward = jax.linearize(respond_to, arrays)
    (reverse,) = jax.linear_transpose(forward, arrays)(cotangent)
    return jax.vmap(forward)(directions), reverse


def all_finite(*arguments):
    """Whether response and derivatives are finite; `arguments` as of `respond`."""
    response = respond(*arguments)
    ones = jax.tree.map(jnp.ones_like, response)
    # As many directions as in `test_models`, so that nothing is compiled again.
    count = 1 + len(jax.tree.leaves(arguments))
    directions = jax.tree.map(lambda a: jnp.ones((count, *a.shape)), arguments)
    answers = response, linear_response(*arguments, directions, ones)
    return all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(answers))
