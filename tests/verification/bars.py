"""A bar on a roller, free at the other end, in its first mode: the scene of V27."""

from typing import NamedTuple

import manufactured
import numpy as np
from scenes import SCHEMES, lattice, roll, wide

import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Slip
from pgjax.grid import Grid
from pgjax.scene import Scene, initial_state
from pgjax.state import State


class Bar(NamedTuple):
    """The bar at its start.

    Attributes:
        scene: the roller, and a periodic direction across.
        state: the start.
        Y: heights at rest.
        mode: the first mode at these, `sin(π Y/2)`.
        speed: of its free end at the start, m/s.
    """

    scene: Scene
    state: State
    Y: np.ndarray
    mode: np.ndarray
    speed: float


def bar(n, name, *, across=1, strain=1e-4):
    """n cells long, which is 1 m, and `across` wide; it starts at rest length, `v = strain c`.

    Laterally confined, so the wave speed is `c = √((λ + 2μ)/ρ)` and the period `4 L/c`.
    """
    spline, scheme, _ = SCHEMES[name]
    h, speed = 1 / n, strain * manufactured.SPEED
    X = lattice((0, 0), (across, n), h)
    scene = Scene(
        Grid(np.zeros(2), (across, n + 4), h, periodic=(True, False)),
        pm.Material(pm.NeoHookean(manufactured.E, manufactured.NU), density=manufactured.RHO),
        np.full(len(X), (h / 2) ** 2),
        boundaries=(Collider(HalfSpace([0.0, 0.0], [0.0, 1.0]), Slip()),),
        spline=spline,
        scheme=scheme,
    )
    mode = np.sin(np.pi * X[:, 1] / 2)
    v = np.stack([0 * mode, speed * mode], axis=1)
    return Bar(scene, initial_state(scene, X, v), X[:, 1], mode, speed)


def heights(scene, state):
    """Vertical positions."""
    del scene
    return state.position[:, 1]


def free_bar(n, name, **kwargs):
    """Period error and part of the amplitude that is lost per period, with `Δt = 0.2 h/c`."""
    scene, state, Y, mode, _ = bar(n, name)
    c = manufactured.SPEED
    dt, period = 0.2 / n / c, 4 / c
    steps = int(2.2 * period / dt)
    _, y = roll(scene, state, dt, steps, heights, **kwargs)
    q = (wide(y) - Y) @ mode
    before = np.flatnonzero(q[:-1] * q[1:] < 0)[:4]
    crossings = dt * (before + 1 + q[before] / (q[before] - q[before + 1]))
    first, third = np.abs(q[: before[0]]).max(), np.abs(q[before[1] : before[2]]).max()
    return crossings[3] / (2 * period) - 1, 1 - third / first
