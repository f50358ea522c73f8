"""An independent Material Point Method in plain numpy: the yardstick of the tests.

It shares no code with the package and none of its devices: deformation gradients are stored as
they are, every law goes through an SVD, the grid is a dictionary of nodes (so it has no border),
and particles and nodes are visited one at a time in float64. Slow and easy to check by eye.

Tensors are 3x3 also in two dimensions (plane strain: velocity gradients are embedded, Fe_33 may
evolve). F is the total deformation gradient, Fe its elastic part; both need a positive
determinant, except for the fixed corotated law. `python tests/oracle.py` checks every stress
against its energy.
"""

import dataclasses
import itertools
import math
from collections import defaultdict
from collections.abc import Callable
from functools import partial

import numpy as np

I3 = np.eye(3)

# --- B-splines: the piecewise polynomials of the cardinal spline N(u), u in cells ----------------


def spline(u: float, degree: int) -> tuple[float, float]:
    """N(u) and dN/du, with support |u| < (degree + 1) / 2."""
    a, sign = abs(u), math.copysign(1.0, u)
    rest = max((degree + 1) / 2 - a, 0.0)  # to the end of the support
    if degree == 2:
        return (3 / 4 - u**2, -2 * u) if a < 1 / 2 else (rest**2 / 2, -sign * rest)
    if a < 1:
        return a**3 / 2 - a**2 + 2 / 3, sign * (3 / 2 * a**2 - 2 * a)
    return rest**3 / 6, -sign * rest**2 / 2


def stencil(x, params):
    """Yield (node, x_i - x, w, grad w) for each node whose spline covers x; it may be wrapped."""
    u = (x - params.origin) / params.h
    half = (params.degree + 1) / 2
    reach = [range(math.floor(a - half) + 1, math.ceil(a + half)) for a in u]
    for index in itertools.product(*reach):
        w, dw = zip(*[spline(a, params.degree) for a in u - index], strict=True)
        gradient = [math.prod([*w[:k], dw[k], *w[k + 1 :]]) / params.h for k in range(len(u))]
        node = index
        if params.periodic:
            node = tuple(i % n if n else i for i, n in zip(index, params.periodic, strict=True))
        yield node, params.h * (index - u), math.prod(w), np.array(gradient)


# --- Elasticity: Kirchhoff stress tau(Fe) and energy psi(Fe) per rest volume ----------------------


def lame(E: float, nu: float) -> tuple[float, float, float]:
    """(mu, lam, kappa) of Young's modulus E [Pa] and Poisson's ratio nu."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)), E / (3 * (1 - 2 * nu))


def svd(F):
    """U, s, Vt with U and V rotations: a reflection in F makes the smallest s negative."""
    U, s, Vt = np.linalg.svd(F)
    if np.linalg.det(U) < 0:
        U[:, -1], s[-1] = -U[:, -1], -s[-1]
    if np.linalg.det(Vt) < 0:
        Vt[-1], s[-1] = -Vt[-1], -s[-1]
    return U, s, Vt


def log_svd(F):
    """U, eps, Vt, with eps = log s the principal Hencky strains."""
    U, s, Vt = svd(F)
    return U, np.log(s), Vt


def dev(A):
    """The deviatoric part of a 3x3 tensor."""
    return A - np.trace(A) / 3 * I3


def fixed_corotated(Fe, *, mu, lam):
    U, _, Vt = svd(Fe)
    J = np.linalg.det(Fe)
    return 2 * mu * (Fe - U @ Vt) @ Fe.T + lam * J * (J - 1) * I3


def fixed_corotated_energy(Fe, *, mu, lam):
    return mu * np.sum((svd(Fe)[1] - 1) ** 2) + lam / 2 * (np.linalg.det(Fe) - 1) ** 2


def hencky(Fe, *, mu, lam):
    U, eps, _ = log_svd(Fe)
    return U @ np.diag(2 * mu * eps + lam * eps.sum()) @ U.T


def hencky_energy(Fe, *, mu, lam):
    _, eps, _ = log_svd(Fe)
    return mu * np.sum(eps**2) + lam / 2 * eps.sum() ** 2


def neo_hookean(Fe, *, mu, lam):
    return mu * (Fe @ Fe.T - I3) + lam * np.log(np.linalg.det(Fe)) * I3


def neo_hookean_energy(Fe, *, mu, lam):
    log_J = np.log(np.linalg.det(Fe))
    return mu / 2 * (np.sum(Fe**2) - 3) - mu * log_J + lam / 2 * log_J**2


def dev_vol_neo_hookean(Fe, *, mu, kappa):
    J = np.linalg.det(Fe)
    return kappa / 2 * (J**2 - 1) * I3 + mu * dev(J ** (-2 / 3) * Fe @ Fe.T)


def dev_vol_neo_hookean_energy(Fe, *, mu, kappa):
    J = np.linalg.det(Fe)
    volumetric = kappa / 2 * ((J**2 - 1) / 2 - np.log(J))
    return volumetric + mu / 2 * (J ** (-2 / 3) * np.sum(Fe**2) - 3)


# --- Return mappings: (Fe_trial, history, dt) -> (Fe, history) ------------------------------------


def elastic(Fe, history, dt):  # noqa: ARG001
    """No plasticity."""
    return Fe, history


def friction_alpha(angle: float) -> float:
    """alpha of Drucker-Prager; the angle in radians."""
    return math.sqrt(2 / 3) * 2 * math.sin(angle) / (3 - math.sin(angle))


def drucker_prager(Fe, v_c, dt, *, mu, lam, alpha, cohesion=0.0, volume_correction=False):  # noqa: ARG001
    """Sand; the history is the volume correction v_c. The cohesion is a strain, per axis."""
    U, eps_trial, Vt = log_svd(Fe)
    shift = (v_c / 3 if volume_correction else 0.0) - cohesion
    eps = eps_trial + shift
    eps_hat = eps - eps.mean()
    dgamma = np.linalg.norm(eps_hat) + alpha * (3 * lam + 2 * mu) / (2 * mu) * eps.sum()
    if eps.sum() > 0:
        eps = np.zeros(3)
    elif dgamma > 0:
        eps = eps - dgamma * eps_hat / np.linalg.norm(eps_hat)
    elif not volume_correction:
        return Fe, v_c
    eps = eps + cohesion
    if volume_correction:
        v_c = v_c + eps_trial.sum() - eps.sum()
    return U @ np.diag(np.exp(eps)) @ Vt, v_c


def von_mises(Fe, tau_y, dt, *, mu, hardening=0.0):  # noqa: ARG001
    """Metal, |dev tau| <= tau_y (Frobenius); the history is tau_y, `hardening` is xi."""
    U, eps, Vt = log_svd(Fe)
    eps_hat = eps - eps.mean()
    dgamma = np.linalg.norm(eps_hat) - tau_y / (2 * mu)
    if dgamma <= 0:
        return Fe, tau_y
    eps = eps - dgamma * eps_hat / np.linalg.norm(eps_hat)
    return U @ np.diag(np.exp(eps)) @ Vt, tau_y + 2 * mu * hardening * dgamma


def flow_stress(s_trial, s_y, dt, *, mu, eta, h):
    """The root |s| of eta^(1/h) (s_trial - s) = 2 mu dt (s - s_y)^(1/h), by bisection."""
    excess = s_trial - s_y
    low, high = 0.0, 1.0
    for _ in range(200):
        r = (low + high) / 2  # s = s_y + r excess
        residual = eta ** (1 / h) * (1 - r) * excess - 2 * mu * dt * (r * excess) ** (1 / h)
        low, high = (r, high) if residual > 0 else (low, r)
    return s_y + (low + high) / 2 * excess


def isochoric(S):
    """b_bar = S + c I with det b_bar = 1: c is the largest root of its cubic."""
    roots = np.roots([1, 0, -np.sum(S**2) / 2, np.linalg.det(S) - 1])
    return S + roots[np.isreal(roots)].real.max() * I3


def herschel_bulkley(Fe, history, dt, *, mu, sigma_y, eta, h=1.0, mu_hat=False):
    """Paste, uniaxial yield stress sigma_y: |s| <= sqrt(2/3) sigma_y at rest.

    `mu_hat` puts mu tr(b_bar) / 3 of the trial state in place of mu in the flow rule.
    """
    U, sigma, Vt = svd(Fe)
    J = np.prod(sigma)
    b_bar = J ** (-2 / 3) * np.diag(sigma**2)  # in the principal axes U
    s = mu * dev(b_bar)
    s_trial, s_y = np.linalg.norm(s), math.sqrt(2 / 3) * sigma_y
    if s_trial <= s_y:
        return Fe, history
    mu_flow = mu * np.trace(b_bar) / 3 if mu_hat else mu
    if h == 1:
        s_new = s_trial - (s_trial - s_y) / (1 + eta / (2 * mu_flow * dt))
    else:
        s_new = flow_stress(s_trial, s_y, dt, mu=mu_flow, eta=eta, h=h)
    b_bar = isochoric(s_new * (s / s_trial) / mu)
    return U @ (J ** (1 / 3) * np.sqrt(b_bar)) @ Vt, history


# --- The step ------------------------------------------------------------------------------------


def trial_state(Fe, L, dt):
    return (I3 + dt * L) @ Fe


@dataclasses.dataclass
class Material:
    """One material and the particles that are made of it."""

    particles: slice
    density: float
    stress: Callable  # Fe -> tau
    return_map: Callable = elastic  # (Fe_trial, history, dt) -> (Fe, history)


@dataclasses.dataclass
class Params:
    """What does not change from step to step; nodes sit at origin + h * index."""

    materials: list[Material]
    origin: np.ndarray
    h: float
    gravity: np.ndarray
    degree: int = 2
    mls: bool = False  # C in place of grad v, and the force through the affine term
    boundary: Callable = lambda x, v, t: v  # noqa: ARG005  (of one node: v to be)
    body_force: Callable = lambda X0, t: np.zeros(len(X0))  # noqa: ARG005  (acceleration)
    damping: float = 0.0  # gamma: grid velocities times exp(-gamma dt)
    rpic: float = 0.0  # r: the symmetric part of the stored C times exp(-r dt)
    periodic: tuple[int | None, ...] | None = None  # number of nodes of each periodic direction
    trial: Callable = trial_state  # (Fe, L, dt) -> Fe_trial

    @property
    def D(self) -> float:
        """The second moment of the spline, h^2 / 4 or h^2 / 3."""
        return self.h**2 * (self.degree + 1) / 12


@dataclasses.dataclass
class State:
    """Particles: x v X0 (N, d), C (N, d, d), Fe F (N, 3, 3), volume (N,), history a list of N."""

    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    Fe: np.ndarray
    F: np.ndarray
    volume: np.ndarray  # at rest
    X0: np.ndarray
    history: list
    t: float = 0.0


def rest_state(x, v, volume, history=0.0) -> State:
    """Undeformed particles at x with velocities v; `history` is the same for all."""
    (n, d), eye = x.shape, np.tile(I3, (len(x), 1, 1))
    return State(x, v, np.zeros((n, d, d)), eye, eye.copy(), volume, x.copy(), [history] * n)


def owned(params: Params):
    """Pairs (particle number, its material)."""
    return [(p, m) for m in params.materials for p in range(m.particles.start, m.particles.stop)]


def grid_velocities(state: State, params: Params, dt: float) -> dict:
    """P2G and the grid update: node -> velocity (d,)."""
    d = state.x.shape[1]
    mass, momentum, impulse = defaultdict(float), defaultdict(float), defaultdict(float)
    for p, material in owned(params):
        m = material.density * state.volume[p]
        tau = material.stress(state.Fe[p])[:d, :d]
        b = params.body_force(state.X0[p], state.t)
        for node, arm, w, grad_w in stencil(state.x[p], params):
            shape = w * arm / params.D if params.mls else grad_w
            mass[node] += w * m
            momentum[node] += w * m * (state.v[p] + state.C[p] @ arm)
            impulse[node] += dt * (w * m * b - state.volume[p] * tau @ shape)
    velocity = {}
    for node, m in mass.items():
        v = np.zeros(d)
        if m > 0:  # zero only on the very edge of a spline, by rounding
            v = (momentum[node] + impulse[node]) / m + dt * params.gravity
        v = v * math.exp(-params.damping * dt)
        velocity[node] = params.boundary(params.origin + params.h * np.array(node), v, state.t)
    return velocity


def oracle_step(state: State, params: Params, dt: float) -> State:
    """One explicit step; forces, boundary and body force are those of its beginning, state.t."""
    d = state.x.shape[1]
    velocity = grid_velocities(state, params, dt)
    x, v, C = state.x.copy(), np.zeros_like(state.v), np.zeros_like(state.C)
    Fe, F, history = state.Fe.copy(), state.F.copy(), list(state.history)
    for p, material in owned(params):
        grad_v = np.zeros((d, d))
        for node, arm, w, grad_w in stencil(state.x[p], params):
            v[p] += w * velocity[node]
            C[p] += w * np.outer(velocity[node], arm) / params.D
            grad_v += np.outer(velocity[node], grad_w)
        L = np.zeros((3, 3))
        L[:d, :d] = C[p] if params.mls else grad_v  # before the damping of C
        C[p] = (C[p] - C[p].T) / 2 + math.exp(-params.rpic * dt) * (C[p] + C[p].T) / 2
        x[p] += dt * v[p]
        Fe_trial = params.trial(Fe[p], L, dt)
        Fe[p], history[p] = material.return_map(Fe_trial, history[p], dt)
        F[p] += dt * L @ F[p]
    return State(x, v, C, Fe, F, state.volume, state.X0, history, state.t + dt)


# --- Misprints of the source, for negative controls ----------------------------------------------


def misprint_hencky(Fe, *, mu, lam):
    """U (2 mu eps + lam tr eps) Vt: not symmetric, so it makes torque from nothing."""
    U, eps, Vt = log_svd(Fe)
    return U @ np.diag(2 * mu * eps + lam * eps.sum()) @ Vt


def misprint_neo_hookean(Fe, *, mu, lam):  # noqa: ARG001
    """Log J without its factor lam."""
    return mu * (Fe @ Fe.T - I3) + np.log(np.linalg.det(Fe)) * I3


def misprint_von_mises(Fe, tau_y, dt, *, mu):  # noqa: ARG001
    """Divides by |eps| in place of |dev eps|: the result misses the yield surface."""
    U, eps, Vt = log_svd(Fe)
    eps_hat = eps - eps.mean()
    dgamma = np.linalg.norm(eps_hat) - tau_y / (2 * mu)
    if dgamma <= 0:
        return Fe, tau_y
    return U @ np.diag(np.exp(eps - dgamma * eps_hat / np.linalg.norm(eps))) @ Vt, tau_y


def misprint_trial(Fe, L, dt):  # noqa: ARG001
    """F_trial = (I + grad v) F, without dt."""
    return (I3 + L) @ Fe


# --- Self-test -----------------------------------------------------------------------------------


def random_F(rng, spread=0.5):
    """A deformation with log-stretches in [-spread, spread] and random rotations."""
    U, _, Vt = svd(rng.normal(size=(3, 3)))
    return U @ np.diag(np.exp(rng.uniform(-spread, spread, 3))) @ Vt


def difference_stress(energy, F, step=1e-4):
    """Tau = dpsi/dF F^T by central differences of fourth order."""
    P = np.zeros((3, 3))
    for entry in itertools.product(range(3), range(3)):
        E = np.zeros((3, 3))
        E[entry] = step
        near, far = energy(F + E) - energy(F - E), energy(F + 2 * E) - energy(F - 2 * E)
        P[entry] = (8 * near - far) / (12 * step)
    return P @ F.T


def check_laws(rng, mu, lam, kappa) -> None:
    pair, bulk = {"mu": mu, "lam": lam}, {"mu": mu, "kappa": kappa}
    samples = [I3, np.diag([1.0, 1.0, 2.0])] + [random_F(rng) for _ in range(100)]
    for law, energy, constants in (
        (fixed_corotated, fixed_corotated_energy, pair),
        (hencky, hencky_energy, pair),
        (neo_hookean, neo_hookean_energy, pair),
        (dev_vol_neo_hookean, dev_vol_neo_hookean_energy, bulk),
        (misprint_hencky, hencky_energy, pair),
        (misprint_neo_hookean, neo_hookean_energy, pair),
    ):
        psi = partial(energy, **constants)
        error = max(abs(law(F, **constants) - difference_stress(psi, F)).max() for F in samples)
        print(f"{law.__name__}: tau against dpsi/dF F^T {error:.1e}")
        assert error > 1e-2 if law.__name__.startswith("misprint") else error < 1e-9


if __name__ == "__main__":
    check_laws(np.random.default_rng(0), *lame(1.0, 0.3))
