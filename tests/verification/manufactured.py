"""V24's manufactured solution: a standing wave in a periodic box, its force by differentiation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scenes import SCHEMES, lattice, positions, roll, wide

import pgjax.models as pm
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state

E, NU, RHO, AMPLITUDE = 1e4, 0.3, 1000.0, 0.01
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
SPEED = ((LAM + 2 * MU) / RHO) ** 0.5


class StandingWave(eqx.Module):
    """`x_i = X_i + A sin(2π X_i) sin(2π c t + φ_i)`, φ = 0, π/2, π, and the force it needs.

    Args:
        moves: 1 for each direction with a wave, 0 for the others.
    """

    moves: jax.Array = eqx.field(converter=lambda a: jnp.asarray(a, float))

    def place(self, X, t):
        """Exact position."""
        phase = jnp.pi / 2 * jnp.arange(len(X), dtype=X.dtype)
        wave = jnp.sin(2 * jnp.pi * X) * jnp.sin(2 * jnp.pi * SPEED * t + phase)
        return X + AMPLITUDE * self.moves * wave

    def velocity(self, X, t):
        """Exact velocity."""
        return jax.jvp(lambda t: self.place(X, t), (t,), (jnp.ones_like(t),))[1]

    def F(self, X, t):
        """Exact deformation gradient, plane strain in two dimensions."""
        d = len(X)
        return jnp.eye(3).at[:d, :d].set(jax.jacfwd(self.place)(X, t))

    def nominal_stress(self, X, t):
        """`P = ∂ψ/∂F` of the neo-Hookean energy."""

        def energy(F):
            log_J = jnp.log(jnp.linalg.det(F))
            return MU / 2 * (jnp.sum(F * F) - 3) - MU * log_J + LAM / 2 * log_J**2

        d = len(X)
        return jax.grad(energy)(self.F(X, t))[:d, :d]

    def __call__(self, X, t):
        """Body force per mass: `∂²x/∂t² − Div P/ρ`."""
        one = jnp.ones_like(t)
        acceleration = jax.jvp(lambda t: self.velocity(X, t), (t,), (one,))[1]
        divergence = jnp.einsum("ijj->i", jax.jacfwd(self.nominal_stress)(X, t))
        return acceleration - divergence / RHO


@eqx.filter_jit
def at_start(wave, X):
    """Position, velocity, `C = Ḟ F⁻¹` and F of every particle."""

    def of_one(X):
        t, d = jnp.zeros(()), len(X)
        F = wave.F(X, t)
        rate = jax.jacfwd(wave.velocity)(X, t)
        return wave.place(X, t), wave.velocity(X, t), rate @ jnp.linalg.inv(F[:d, :d]), F

    return jax.vmap(of_one)(jnp.asarray(X))


def error(n, d, name, *, scheme=None, **kwargs):
    """`max_t RMS |u − u_exact| / A` over one crossing, n cells per wave length, 2 per direction.

    One dimension is two, one cell wide; `scheme` replaces that of `name`.
    """
    spline, standard, _ = SCHEMES[name]
    shape = (n, 1) if d == 1 else (n,) * d
    X = lattice((0,) * len(shape), shape, 1 / n)
    wave = StandingWave(np.arange(len(shape)) < d)
    scene = Scene(
        Grid(np.zeros(len(shape)), shape, 1 / n, periodic=(True,) * len(shape)),
        pm.Material(pm.NeoHookean(E, NU), density=RHO),
        np.full(len(X), (0.5 / n) ** len(shape)),
        body_force=wave,
        X0=X,
        spline=spline,
        scheme=standard if scheme is None else scheme,
    )
    x, v, C, F = at_start(wave, X)
    state = initial_state(scene, x, v, C=C, F=F)
    dt = time_step(n)
    steps = int(1 / SPEED / dt)
    _, x = roll(scene, state, dt, steps, positions, **kwargs)
    t = jnp.asarray(dt * np.arange(1, steps + 1))
    exact = jax.jit(jax.vmap(jax.vmap(wave.place, (0, None)), (None, 0)))(X, t)
    square = np.sum((wide(x) - wide(exact)) ** 2, axis=-1)
    return np.sqrt(np.mean(square, axis=-1)).max() / AMPLITUDE


def time_step(n):
    """0.2 h/c."""
    return 0.2 / n / SPEED
