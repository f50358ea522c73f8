"""Sand on a slope, columns of sand, water, paste and metal that collapse: V30, V35 to V38."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scenes import kinetic_energy, lattice, roll, wide
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Separating, Slip, Sticky
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state

G = 9.8


def wall(axis, d, contact):
    """The half space behind the plane through the origin across one axis."""
    return Collider(HalfSpace(np.zeros(d), np.eye(d)[axis]), contact)


# --- V30: sand on a slope ------------------------------------------------------------------------


def along(scene, state):
    """Velocity along the slope."""
    del scene
    return state.v[:, 0]


def acceleration(theta):
    """`g (sin θ − 3α/√2 cos θ)`, m/s²: of sand of φ = 30° that flows in plane strain."""
    alpha = (2 / 3) ** 0.5 * 2 * 0.5 / (3 - 0.5)
    return G * (np.sin(theta) - 3 * alpha / 2**0.5 * np.cos(theta))


def slope(ny, theta, seconds, *, per_cell=2):
    """Sand of depth 1 m on an infinite rough slope, released at its stress at rest.

    Returns:
        Times, and the mean velocity of the upper quarter along the slope.
    """
    E, nu, density = 1e7, 0.3, 1500.0
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    h, frames = 1 / ny, 60
    X = lattice((0, 0), (1, ny), h, per_cell)
    down, forth = -G * np.cos(theta), G * np.sin(theta)
    strain = density * down * (1 - X[:, 1]) / (lam + 2 * mu)
    F = np.tile(np.eye(3), (len(X), 1, 1))
    F[:, 1, 1] = np.exp(strain)
    scene = Scene(
        Grid(np.zeros(2), (1, ny + 4), h, periodic=(True, False)),
        pm.Material(pm.StVKHencky(E, nu), pm.DruckerPrager(30.0), density),
        (h / per_cell) ** 2 / np.exp(strain),
        gravity=[forth, down],
        boundaries=(wall(1, 2, Sticky()),),
    )
    dt = 0.5 * float(scene.elastic_limit(scene.rest_sound_speed()))
    every = int(seconds / dt / frames)
    state = initial_state(scene, X, F=F)
    _, v = roll(scene, state, dt, every * frames, along, every=every)
    return dt * every * np.arange(1, frames + 1), wide(v)[:, X[:, 1] > 0.75].mean(axis=1)


# --- V35: sand ------------------------------------------------------------------------------------


class Deposit(NamedTuple):
    """Where a column of sand came to rest; lengths over its width at first.

    Attributes:
        runout: how far 99 % of the mass advanced.
        height: of the highest particle, and half its own.
        lowest: the lowest particle, in cells.
        energy: kinetic, over the potential one at first.
        lost: part of the mass that left.
    """

    runout: float
    height: float
    lowest: float
    energy: float
    lost: float


def collapse(aspect, phi, *, n=16, base=None, correct=True, per_cell=2):
    """A column of sand 0.2 m wide and `aspect` times as high, for 5 √(H/g).

    Args:
        aspect: height over width.
        phi: angle of friction, degrees.
        n: cells of its width.
        base: contact with the ground; sticky if None.
        correct: whether the sand remembers the volume it gained (see `DruckerPrager`).
        per_cell: particles in each direction of a cell.
    """
    width = 0.2
    h, height = width / n, aspect * width
    X = lattice((0, 0), (n, round(aspect * n)), h, per_cell)
    sand = pm.DruckerPrager(phi, volume_correction=correct)
    scene = Scene(
        Grid(np.zeros(2), (round((3 + 2 * aspect) * n), round(aspect * n) + 4), h),
        pm.Material(pm.StVKHencky(4e5, 0.3), sand, 1500.0),
        np.full(len(X), (h / per_cell) ** 2),
        gravity=[0.0, -G],
        boundaries=(wall(0, 2, Slip()), wall(1, 2, base or Sticky())),
    )
    dt = 0.5 * float(scene.rest_limit())
    end, _ = roll(scene, initial_state(scene, X), dt, int(5 * (height / G) ** 0.5 / dt))
    mass, x = wide(scene.masses), wide(end.x)
    return Deposit(
        runout=np.quantile(x[:, 0], 0.99) / width - 1,
        height=(x[:, 1].max() + h / (2 * per_cell)) / width,
        lowest=x[:, 1].min() / h,
        energy=float(kinetic_energy(scene, end)) / (mass.sum() * G * height / 2),
        lost=1 - mass[np.asarray(end.alive)].sum() / mass.sum(),
    )


# --- V38: water -----------------------------------------------------------------------------------


def fronts(scene, state):
    """How far all of the water reaches, and 99 % of it."""
    del scene
    return jnp.max(state.x[:, 0]), jnp.quantile(state.x[:, 0], 0.99)


def dam_break(n, width, reach, duration, viscosity=0.0):
    """Water behind a dam that vanishes: depth 1 m, n cells, without friction on the ground.

    The sound is ten times as fast as `√(gH)`.

    Args:
        n: cells of the depth.
        width: of the reservoir, m.
        reach: of the ground before it, m.
        duration: in units of √(H/g).
        viscosity: kinematic, in units of √(g H³).

    Returns:
        Times over √(H/g), the two `fronts`, m, and the positions at the end.
    """
    h, density, frames = 1 / n, 1000.0, 60
    X = lattice((0, 0), (round(width * n), n), h)
    water = pm.Fluid(density * 100 * G, density * viscosity * G**0.5)
    scene = Scene(
        Grid(np.zeros(2), (round((width + reach) * n), round(1.25 * n)), h),
        pm.Material(water, density=density),
        np.full(len(X), (h / 2) ** 2),
        gravity=[0.0, -G],
        boundaries=(wall(0, 2, Slip()), wall(1, 2, Slip())),
    )
    dt = 0.5 * float(scene.rest_limit())
    every = round(duration / G**0.5 / dt / frames)
    end, seen = roll(scene, initial_state(scene, X), dt, every * frames, fronts, every=every)
    assert bool(end.alive.all())
    t = dt * every * np.arange(1, frames + 1) * G**0.5
    return t, *(wide(a) for a in seen), wide(end.x)


def depth(x, place, n):
    """Area of water per length within an eighth of the depth from a place, m."""
    near = np.abs(x[:, 0] - place) < 0.125
    return near.sum() * (0.5 / n) ** 2 / 0.25


# --- V36 and V37: cylinders -----------------------------------------------------------------------


def quarter_cylinder(radius, height, n):
    """A quarter of an upright cylinder, n cells in its radius: cell size, positions, volumes."""
    h = radius / n
    cells = round(height / h)
    X = lattice((0, 0, 0), (n, n, cells), h) * [1, 1, height / (cells * h)]
    X = X[np.hypot(X[:, 0], X[:, 1]) < radius]
    return h, X, np.full(len(X), np.pi * radius**2 / 4 * height / len(X))


def quarter_scene(h, volumes, material, ground, reach, gravity=0.0):
    """Its scene: two planes of symmetry and the ground; `reach` in cells sideways and up."""
    aside, up = reach
    return Scene(
        Grid(np.zeros(3), (aside, aside, up), h),
        material,
        volumes,
        gravity=[0.0, 0.0, -gravity],
        boundaries=(wall(0, 3, Slip()), wall(1, 3, Slip()), wall(2, 3, ground)),
    )


# The copper bar: length and radius, m; speed, m/s; density, kg/m³; uniaxial yield stress, Pa.
LENGTH, RADIUS, SPEED, DENSITY, YIELD = 25.4e-3, 3.8e-3, 190.0, 8940.0, 350e6


def length(scene, state):
    """Extent along the bar."""
    del scene
    return jnp.max(state.x[:, 2]) - jnp.min(state.x[:, 2])


class Slug(NamedTuple):
    """What is left of a bar after the impact.

    Attributes:
        length: over that at first.
        foot: radius of the foot over that at first.
        volume: over that at first, less 1.
        rebound: mean velocity away from the wall over that of the impact.
    """

    length: float
    foot: float
    volume: float
    rebound: float


def taylor_bar(n, yield_stress=YIELD):
    """The bar, n cells in its radius, 80 μs after it meets a smooth wall; elastic without yield."""
    h, X, volumes = quarter_cylinder(RADIUS, LENGTH, n)
    # Von Mises's own convention is `‖dev τ‖`, √(2/3) of the uniaxial yield stress.
    metal = None if yield_stress is None else pm.VonMises((2 / 3) ** 0.5 * yield_stress)
    copper = pm.Material(pm.StVKHencky(117e9, 0.35), metal, DENSITY)
    reach = 4 * n, round(LENGTH / h) + 2 * n
    scene = quarter_scene(h, volumes, copper, Separating(), reach)
    dt, frames = 0.5 * float(scene.rest_limit()), 20
    every = round(80e-6 / dt / frames)
    start = initial_state(scene, X, [0.0, 0.0, -SPEED])
    end, lengths = roll(scene, start, dt, every * frames, length, every=every)
    x, J = wide(end.x), np.linalg.det(wide(end.F))
    return Slug(
        # It vibrates a little: the mean of the last 16 μs.
        length=(wide(lengths)[-4:].mean() + h / 2) / LENGTH,
        foot=(np.hypot(x[:, 0], x[:, 1]).max() + h / 4) / RADIUS,
        volume=np.average(J, weights=volumes) - 1,
        rebound=wide(end.v)[:, 2].mean() / SPEED,
    )


def rigid_plastic(strain):
    """Final length over that at first of a rigid, perfectly plastic bar (G. I. Taylor 1948).

    The rear, of length ℓ and speed u, is braked by Y alone, `ρ ℓ u̇ = −Y`. It loses `ℓ̇ = −u/e`
    to a foot that grows by `ḣ = u (1 − e)/e`, where the foot is compressed by e.

    Args:
        strain: e from `k = ρ u²/Y`.
    """

    def rate(u, state):
        rear, _ = state
        e = strain(DENSITY * u**2 / YIELD)
        brake = DENSITY * rear / YIELD
        return [brake * u / e, -brake * u * (1 - e) / e]

    return solve_ivp(rate, (SPEED, 1e-3 * SPEED), [1, 0], rtol=1e-8, atol=1e-10).y[:, -1].sum()


def momentum_strain(k):
    """Taylor's e from the momentum at the front, `e²/(1 − e) = k`."""
    return (-k + (k * k + 4 * k) ** 0.5) / 2


def energy_strain(k):
    """Hawkyard's (1969) e from its energy, `−log(1 − e) − e = k/2`."""
    return brentq(lambda e: -np.log1p(-e) - e - k / 2, 1e-12, 1 - 1e-12)


def slump(n, yield_stress, ground):
    """A cylinder of paste, as high as wide, slumps under its weight for 4 s: part of its height.

    Height 1 m, n cells in the radius, density 1000 kg/m³. The paste is so stiff that its elastic
    settlement is a hundredth of the height, and so viscous that it hardly overshoots.

    Args:
        n: cells of the radius.
        yield_stress: σ_Y over ρ g H.
        ground: contact with it.
    """
    h, X, volumes = quarter_cylinder(0.5, 1.0, n)
    weight = 1000.0 * G
    paste = pm.HerschelBulkley(yield_stress * weight, 1000.0)
    material = pm.Material(pm.DevVolNeoHookean(1e6, 0.3), paste, 1000.0)
    scene = quarter_scene(h, volumes, material, ground, (3 * n, 2 * n + 4), G)
    dt = 0.5 * float(scene.rest_limit())
    end, _ = roll(scene, initial_state(scene, X), dt, int(4 / dt))
    assert bool(end.alive.all())
    return 1 - (wide(end.x)[:, 2].max() + h / 4)


def column_theory(yield_stress):
    """Slump over height of a column that yields at `σ_Y = yield_stress ρ g H` in each section.

    The part that bears less than σ_Y, `z₀ = yield_stress H`, keeps its height; below, each section
    spreads until it bears σ_Y, and is `z₀/z` as high as it was.
    """
    return 1 - yield_stress * (1 - np.log(yield_stress)) if yield_stress < 1 else 0.0
