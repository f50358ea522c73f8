"""Cantilevers and bars in plane strain, and the theories of them: V32 and V34."""

import jax.numpy as jnp
import numpy as np
from scenes import SCHEMES, lattice, roll, wide
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, ParticleForce, Separating, Sticky
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state

E, NU, RHO = 1e6, 0.3, 1000.0
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
# Length of the cantilever, m; it is 1 m high and, in plane strain, 1 m wide.
L = 8.0
E_PLANE = E / (1 - NU**2)
EI, EA, GA = E_PLANE / 12, E_PLANE, 5 / 6 * MU
# Cells of the cantilever that stick in the wall.
HELD = 3
# Root of `cos k cosh k = −1`, 1.8751.
FIRST = brentq(lambda k: np.cos(k) * np.cosh(k) + 1, 1.5, 2.5)


# --- Theories of beams ----------------------------------------------------------------------------


def euler_bernoulli():
    """`ω₁ = k² √(E′ H²/(12 ρ L⁴))`, 1/s, of a slender cantilever."""
    return (FIRST / L) ** 2 * (EI / RHO) ** 0.5


def timoshenko():
    """ω₁ of a cantilever that also shears and whose sections have inertia, 1/s.

    Deflection, turn, moment and shear force `(w, ψ, M, Q)` are led along it from the clamped root
    `w = ψ = 0`. The tip is free, `M = Q = 0`, where a determinant vanishes.
    """

    def determinant(omega):
        rate = np.zeros((4, 4))
        rate[0] = [0, 1, 0, 1 / GA]
        rate[1] = [0, 0, 1 / EI, 0]
        rate[2] = [0, -RHO / 12 * omega**2, 0, -1]
        rate[3] = [-RHO * omega**2, 0, 0, 0]
        return np.linalg.det(expm(L * rate)[2:, 2:])

    slender = euler_bernoulli()
    return brentq(determinant, 0.8 * slender, slender)


def first_mode(x):
    """Shape of the first mode of a slender cantilever, 1 at the tip, 0 in the wall."""
    s = (np.cos(FIRST) + np.cosh(FIRST)) / (np.sin(FIRST) + np.sinh(FIRST))

    def shape(a):
        return np.cosh(a) - np.cos(a) - s * (np.sinh(a) - np.sin(a))

    return shape(FIRST * np.maximum(x, 0) / L) / shape(FIRST)


def rod(load, shear=0.0, stretch=0.0):
    """Displacement `(u, w)/ℓ` of the tip of a clamped rod under a dead force `load` = F ℓ²/EI.

    In units of ℓ and EI, `θ′ = M`, `M′ = −F x′`, and r′ has the components `1 + F sin θ/EA` along
    the turned axis and `F cos θ/GA` across it. Without both it is the elastica. Shooting for
    `M(1) = 0`.

    Args:
        load: F ℓ²/EI.
        shear: EI/(GA ℓ²).
        stretch: EI/(EA ℓ²).
    """

    def rate(_, state):
        _, _, turn, moment = state
        sine, cosine = np.sin(turn), np.cos(turn)
        along, across = 1 + stretch * load * sine, shear * load * cosine
        x = along * cosine - across * sine
        return [x, along * sine + across * cosine, moment, -load * x]

    def tip(moment):
        return solve_ivp(rate, (0, 1), [0, 0, 0, moment], rtol=1e-10, atol=1e-12).y[:, -1]

    x, y, _, _ = tip(brentq(lambda moment: tip(moment)[3], 0, 1.1 * load))
    return np.array([x - 1, y])


# --- The cantilever of particles ------------------------------------------------------------------


def cantilever(cells, name, *, per_cell=2, room=1, pull=None, damping=0.0):
    """The beam, `cells` thick, from a wall at x = 0 that it sticks in; scene and positions.

    Args:
        cells: across its height.
        name: of `SCHEMES`.
        per_cell: particles along each direction of a cell.
        room: above the beam, m.
        pull: a particle condition, from the positions.
        damping: of the grid, 1/s.
    """
    spline, scheme, _ = SCHEMES[name]
    h, long = 1 / cells, HELD + round(L * cells)
    X = lattice((-HELD * h, 0), (long, cells), h, per_cell)
    scene = Scene(
        Grid(np.array([-(HELD + 2) * h, -1.0]), (long + 5, (2 + room) * cells), h),
        pm.Material(pm.FixedCorotated(E, NU), density=RHO),
        np.full(len(X), (h / per_cell) ** 2),
        boundaries=(Collider(HalfSpace([0.0, 0.0], [1.0, 0.0]), Sticky()),),
        particle_conditions=() if pull is None else (pull(X),),
        grid_damping=damping,
        spline=spline,
        scheme=scheme,
    )
    return scene, X


def heights(scene, state):
    """Vertical positions."""
    del scene
    return state.x[:, 1]


def vibration(cells, name, **kwargs):
    """A small first mode for 1.15 periods: times of its zeros, and the amplitude left.

    Returns:
        Times of the zeros over the period of a slender beam, and how far the beam swings back
        over how far it swung at first.
    """
    scene, X = cantilever(cells, name)
    shape, omega = first_mode(X[:, 0]), euler_bernoulli()
    period, v = 2 * np.pi / omega, np.stack([0 * shape, 1e-3 * omega * shape], axis=1)
    dt = 0.5 * float(scene.rest_limit())
    steps = int(1.15 * period / (dt * cells)) * cells
    _, y = roll(scene, initial_state(scene, X, v), dt, steps, heights, every=cells, **kwargs)
    q = (wide(y) - X[:, 1]) @ shape
    before = np.flatnonzero(q[:-1] * q[1:] < 0)
    zeros = dt * cells * (before + 1 + q[before] / (q[before] - q[before + 1]))
    return zeros / period, -q.min() / q.max()


def deflected(cells, name, per_cell):
    """Displacement `(u, w)/ℓ` of the tip at rest under a force F = EI/ℓ², and what still moves.

    The force is dead and acts on the last column of particles, at ℓ from the wall. With the
    damping 2ω the beam is at rest soonest: after 1.5 periods to 1e-3.

    Returns:
        `(2,)`, and the largest speed over that of sound.
    """
    margin, omega = 0.5 / (cells * per_cell), euler_bernoulli()
    reach = L - margin

    def pull(X):
        return ParticleForce(X[:, 0] > L - 2 * margin, [0.0, EI / reach**2])

    options = {"per_cell": per_cell, "room": 4, "pull": pull, "damping": 2 * omega}
    scene, X = cantilever(cells, name, **options)
    dt = 0.5 * float(scene.rest_limit())
    end, _ = roll(scene, initial_state(scene, X), dt, int(3 * np.pi / omega / dt))
    tip = X[:, 0] > L - 2 * margin
    speed = np.abs(wide(end.v)).max() / float(scene.rest_sound_speed())
    return (wide(end.x) - X)[tip].mean(axis=0) / reach, speed


# --- The bar that hits a wall ---------------------------------------------------------------------


def momentum_and_strain(scene, state):
    """`Σ m v` along the bar, and the strain of each particle."""
    return jnp.sum(scene.masses * state.v[:, 1]), state.He[:, 1, 1]


def impact(n, name, contact=None, **kwargs):
    """A bar of length 1, laterally confined, meets a wall at y = 0 with `v = 1e-3 c`.

    Returns:
        Times t c/L, momentum over M v, and the stress in the middle over `ρ c v`; `c² = M/ρ`,
        `M = λ + 2μ`.
    """
    spline, scheme, _ = SCHEMES[name]
    h, modulus = 1 / n, LAM + 2 * MU
    c = (modulus / RHO) ** 0.5
    v = 1e-3 * c
    X = lattice((0, 0), (1, n), h)
    scene = Scene(
        Grid(np.zeros(2), (1, n + n // 4), h, periodic=(True, False)),
        pm.Material(pm.NeoHookean(E, NU), density=RHO),
        np.full(len(X), (h / 2) ** 2),
        boundaries=(Collider(HalfSpace([0.0, 0.0], [0.0, 1.0]), contact or Separating()),),
        spline=spline,
        scheme=scheme,
    )
    dt = 0.2 * h / c
    steps = int(2.5 / (c * dt))
    start = initial_state(scene, X, [0.0, -v])
    _, (P, strain) = roll(scene, start, dt, steps, momentum_and_strain, **kwargs)
    t = c * dt * np.arange(1, steps + 1)
    middle = np.abs(X[:, 1] - 0.5) < 0.05
    stress = -modulus * wide(strain)[:, middle].mean(axis=1) / (RHO * c * v)
    return t, wide(P) / (float(jnp.sum(scene.masses)) * v), stress
