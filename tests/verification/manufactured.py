"""V24's manufactured solution: a standing wave in a periodic box, its force by differentiation."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scenes import SCHEMES, largest, lattice, positions, roll, wide

import pgjax.models as pm
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state
from pgjax.state import State

E, NU, RHO, AMPLITUDE = 1e4, 0.3, 1000.0, 0.01
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
SPEED = ((LAM + 2 * MU) / RHO) ** 0.5


class StandingWave(eqx.Module):
    """The body force per mass that `x = place(X, t)` needs, by differentiation alone.

    Args:
        moves: 1 for each direction with a wave, 0 for the others.
        amplitude: A, m.
    """

    moves: jax.Array
    amplitude: float = eqx.field(static=True, default=AMPLITUDE)

    def place(self, X, t):
        """Exact position of one particle."""
        return X + self.moves * wave(jnp, X, t, amplitude=self.amplitude)

    def velocity(self, X, t):
        """Its rate."""
        return jax.jvp(lambda t: self.place(X, t), (t,), (jnp.ones_like(t),))[1]

    def nominal_stress(self, X, t):
        """`P = ∂ψ/∂F` of the neo-Hookean energy; plane strain in two dimensions."""

        def energy(F):
            log_J = jnp.log(jnp.linalg.det(F))
            return MU / 2 * (jnp.sum(F * F) - 3) - MU * log_J + LAM / 2 * log_J**2

        d = len(X)
        F = jnp.eye(3, dtype=X.dtype).at[:d, :d].set(jax.jacfwd(self.place)(X, t))
        return jax.grad(energy)(F)[:d, :d]

    def __call__(self, X, t):
        """`∂²x/∂t² − Div P/ρ`."""
        acceleration = jax.jvp(lambda t: self.velocity(X, t), (t,), (jnp.ones_like(t),))[1]
        divergence = jnp.einsum("ijj->i", jax.jacfwd(self.nominal_stress)(X, t))
        return acceleration - divergence / RHO


def wave(lib, X, t, space=0, time=0, amplitude=AMPLITUDE):
    """`A sin(2π X_i) sin(2π c t + φ_i)`, φ = 0, π/2, π; differentiated so often, along X_i and t.

    Each derivative of a sine is the sine a quarter of a period later.
    """
    phase = lib.arange(X.shape[-1], dtype=X.dtype) * np.pi / 2
    factor = amplitude * (2 * np.pi) ** (space + time) * SPEED**time
    along = lib.sin(2 * np.pi * X + space * np.pi / 2)
    return factor * along * lib.sin(2 * np.pi * SPEED * t + phase + time * np.pi / 2)


class Wave(NamedTuple):
    """A standing wave at its start, and its exact motion.

    Attributes:
        scene: the periodic box and its force.
        state: the start.
        X: places at rest.
        moves: 1 for each direction with a wave, 0 for the others.
        amplitude: A, m.
    """

    scene: Scene
    state: State
    X: np.ndarray
    moves: np.ndarray
    amplitude: float

    def displacement(self, t):
        """`x − X` at the times t, `(times, p, d)`."""
        at = np.asarray(t)[:, None, None]
        return self.moves * wave(np, self.X, at, amplitude=self.amplitude)


def standing_wave(
    n, d, name, *, scheme=None, across=1, per_cell=2, amplitude=AMPLITUDE, damping=0.0
):
    """n cells per wave length, `per_cell` particles in each direction of a cell.

    One dimension is two, `across` cells wide; `scheme` replaces that of `name`; `damping` is the
    scene's `shear_damping`.
    """
    spline, standard, _ = SCHEMES[name]
    shape = (n, across) if d == 1 else (n,) * d
    D = len(shape)
    X = lattice((0,) * D, shape, 1 / n, per_cell)
    moves = np.where(np.arange(D) < d, 1.0, 0.0)
    scene = Scene(
        Grid(np.zeros(D), shape, 1 / n, periodic=(True,) * D),
        pm.Material(pm.NeoHookean(E, NU), density=RHO),
        np.full(len(X), (1 / (per_cell * n)) ** D),
        body_force=StandingWave(jnp.asarray(moves), amplitude),
        X0=X,
        spline=spline,
        scheme=standard if scheme is None else scheme,
        shear_damping=damping,
    )

    def u(**derivative):
        return moves * wave(np, X, 0.0, amplitude=amplitude, **derivative)

    F = np.tile(np.eye(3), (len(X), 1, 1))
    stretch = 1 + u(space=1)
    F[:, :D, :D] = np.eye(D) * stretch[:, None]
    C = np.eye(D) * (u(space=1, time=1) / stretch)[:, None]
    state = initial_state(scene, X + u(), u(time=1), C=C, F=F)
    return Wave(scene, state, X, moves, amplitude)


def wave_error(wave, dt, *, every=1, **kwargs):
    """`max_t RMS |u − u_exact| / A` over one crossing, looked at after each `every` steps."""
    steps = int(1 / SPEED / dt)
    _, x = roll(wave.scene, wave.state, dt, steps, positions, every=every, **kwargs)
    t = dt * every * np.arange(1, steps // every + 1)
    difference = wide(x) - wave.X - wave.displacement(t)
    # Scaled, so that the square of a run that blew up does not overflow.
    scale = largest(difference)
    square = np.sum((difference / scale) ** 2, axis=-1)
    return np.sqrt(np.mean(square, axis=-1)).max() * scale / wave.amplitude


def error(n, d, name, *, scheme=None, across=1, **kwargs):
    """`wave_error` of `standing_wave` with `time_step`."""
    wave = standing_wave(n, d, name, scheme=scheme, across=across)
    return wave_error(wave, time_step(n), **kwargs)


def time_step(n):
    """0.2 h/c."""
    return 0.2 / n / SPEED
