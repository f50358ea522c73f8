"""Two elastic discs that collide: the scene of V21."""

import energies
import numpy as np
from scenes import SCHEMES, kinetic_energy, momenta, roll, wide

import pgjax.models as pm
from pgjax.grid import Grid
from pgjax.sampling import ball
from pgjax.scene import Scene, initial_state

NU, RHO, RADIUS = 0.3, 1000.0, 0.2


def two_discs(n, name, *, law=pm.FixedCorotated, damping=0.0):
    """Two discs on the diagonal of the unit square that approach each other; E = 1000 Pa.

    Args:
        n: cells along the square.
        name: spline and scheme.
        law: elasticity of (E, nu).
        damping: the scene's `shear_damping`, 1/s.

    Returns:
        Scene, state, and a time step of 0.2 h/c with the speed of waves of compression.
    """
    E, speed, h = 1000.0, 0.1, 1 / n
    spline, scheme, _ = SCHEMES[name]
    parts = [ball((c, c), RADIUS, h / 2) for c in (0.2, 0.8)]
    x, volumes = (np.concatenate(a) for a in zip(*parts, strict=True))
    scene = Scene(
        Grid([-4 * h, -4 * h], (n + 8, n + 8), h),
        pm.Material(law(E, NU), density=RHO),
        volumes,
        spline=spline,
        scheme=scheme,
        shear_damping=damping,
    )
    towards = np.where(np.arange(len(x)) < len(x) // 2, speed, -speed)
    mu, lam = energies.lame(E, NU)
    state = initial_state(scene, x, towards[:, None] * np.ones(2))
    return scene, state, 0.2 * h / ((lam + 2 * mu) / RHO) ** 0.5


def energy_and_momentum(scene, state):
    """Total and kinetic energy, J, and momentum."""
    total = energies.total(scene, state, energies.fixed_corotated)
    return total, kinetic_energy(scene, state), momenta(scene, state)[0]


def collide(n, name, *, courant=1.0, seconds=3.5, **kwargs):
    """What `follow` sees of two discs; `courant` in units of 0.2 h/c."""
    scene, state, dt = two_discs(n, name)
    return follow(scene, state, courant * dt, seconds, **kwargs)


def follow(scene, state, dt, seconds=3.5, *, every=1, **kwargs):
    """Times, total and kinetic energy over the exact one at the start, and `P/Σ m|v|`."""
    steps = round(seconds / dt)
    _, seen = roll(scene, state, dt, steps, energy_and_momentum, every=every, **kwargs)
    total, kinetic, P = map(wide, seen)
    # ½ m v² of two discs, v = 0.1 (1, 1) m/s: 2.5133 J.
    mass = 2 * np.pi * RADIUS**2 * RHO
    start, size = mass * 0.01, mass * 0.02**0.5
    return dt * every * np.arange(1, len(total) + 1), total / start, kinetic / start, P / size
