"""Level 5: the same on any grid, in any order, by any kernel (V40, V42).

There is one grid, a box in space. What may vary is how large it is, on which of its nodes walls are
evaluated, in which order particles come, and whether kernels are native or plain JAX.
"""

import equinox as eqx
import jax
import manufactured
import numpy as np
import pytest
import test_solutions
import variants
from bars import free_bar
from flows import acceleration, slope
from scenes import lattice

import pgjax
import pgjax.models as pm
from pgjax import native
from pgjax.boundary import Box, Collider, HalfSpace, Separating, Sticky, nodes

pytestmark = pytest.mark.float64


# --- V40: convergence on a grid that is no larger than the body ----------------------------------


def column_errors():
    Y, F, load = test_solutions.column(16, "quadratic-grad")
    P = test_solutions.nominal_stress(pm.NeoHookean, F)
    return test_solutions.column_error(Y, P, load, 3 / 16), test_solutions.column_error(Y, P, load)


def slope_error():
    """Of the acceleration at 40°, 16 cells deep."""
    theta = np.deg2rad(40.0)
    t, v = slope(16, theta, 1.0)
    exact = acceleration(theta)
    flowing = t > 0.4
    return (np.polyfit(t[flowing], v[flowing], 1)[0] / exact - 1,)


# Errors of each case on its own grid, which ends a few cells beside the body. Those of V24 and V25
# fill a periodic box: it is one cell wide, and eight are compared with that below.
CASES = {
    "V26, vortex, h = 1/16": lambda: (test_solutions.vortex_error(16, "quadratic-grad", 0.1),),
    "V27, free bar, n = 16": lambda: free_bar(16, "quadratic-grad"),
    "V28, column, n = 16": column_errors,
    "V29, film, 8 cells": lambda: test_solutions.film(8, "quadratic-grad")[:1],
    "V30, slope of sand, 16 cells": slope_error,
}


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=pytest.mark.slow) if "film" in c else c for c in CASES]
)
def test_v40_a_tight_grid_costs_no_accuracy(measure, monkeypatch, case):
    """Errors on the tight grid over those with 13 more cells on each side."""
    tight = np.asarray(CASES[case]())
    variants.instead(monkeypatch, variants.with_room(13))
    roomy = np.asarray(CASES[case]())
    worst = np.max(np.abs(tight) / np.abs(roomy))
    measure("V40", f"{case}: error, tight over large grid", worst, below=1.1)
    measure("V40", f"{case}: its change", np.max(np.abs(tight / roomy - 1)), below=1e-7)


def test_v40_one_cell_is_as_wide_as_eight(measure):
    """V24, whose box is periodic: of one cell, and of eight with eight times the particles."""
    tight, wide = (manufactured.error(16, 1, "quadratic-grad", across=across) for across in (1, 8))
    measure("V40", "V24, wave, n = 16: error, 1 over 8 cells wide", tight / wide, below=1.1)
    measure("V40", "V24, wave, n = 16: its change", abs(tight / wide - 1), below=1e-9)


# --- V42: grids, orders, kernels -----------------------------------------------------------------

LAWS = {
    "rubber": pm.Material(pm.NeoHookean(1e4, 0.3), density=1000.0),
    "sand": pm.Material(pm.StVKHencky(1e4, 0.3), pm.DruckerPrager(30.0), 1000.0),
    "metal": pm.Material(pm.StVKHencky(1e4, 0.3), pm.VonMises(200.0, hardening=0.1), 1000.0),
    "paste": pm.Material(pm.DevVolNeoHookean(1e4, 0.3), pm.HerschelBulkley(200.0, 50.0), 1000.0),
}
STEPS = 40


def thrown(what, d=2, room=0, order=None, walls=None):
    """A block thrown on a rough floor, deformed from the first step on; scene and state.

    Args:
        what: of `LAWS`.
        d: dimension.
        room: more cells on each side of the grid.
        order: of the particles.
        walls: the floor, if it is not the bottom of a box.
    """
    h, rng = 0.1, np.random.default_rng(4)
    x = lattice((0.4, 0.3, 0.4)[:d], (4, 3, 3)[:d], h)
    x = x + 0.02 * rng.standard_normal(x.shape)
    v = 0.3 * rng.standard_normal(x.shape) + np.array([1.0, -1.0, 0.5])[:d]
    volumes = (h / 2) ** d * rng.uniform(0.8, 1.2, len(x))
    order = np.arange(len(x)) if order is None else order(x, h)
    box = Box([0.25] * d, [1.2] * d, Separating(0.3))
    scene = pgjax.Scene(
        pgjax.Grid([0.0] * d, (14,) * d, h),
        LAWS[what],
        volumes[order],
        gravity=-9.8 * np.eye(d)[1],
        boundaries=(box,) if walls is None else walls,
    )
    state = pgjax.initial_state(scene, x[order], v[order])
    return (*variants.roomier(scene, state, room), np.argsort(order))


@eqx.filter_jit
def _stepped(scene, state, how):
    """The state after the steps; another `how` is another program."""
    del how
    dt = 0.4 * scene.rest_limit()
    return jax.lax.fori_loop(0, STEPS, lambda _, s: pgjax.step(scene, s, dt), state)


def end_of(scene, state, back, how="usual"):
    """What the particles are after the steps, in the first order, positions in the world."""
    end = _stepped(scene, state, how)
    assert end.alive.all()
    return [np.asarray(a)[back] for a in (end.x, end.v, end.C, end.Fe, end.F)]


def gap(some, others):
    """Largest difference of each array over its largest entry."""
    return max(
        float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(some, others, strict=True)
    )


def by_cell(x, h):
    """Sorted by the cell, as a list of particles per cell would be."""
    return np.lexsort(np.floor(x / h).T)


def shuffled(x, h):
    del h
    return np.random.default_rng(6).permutation(len(x))


OTHERWISE = {
    "17 more cells on each side": {"room": 17},
    "particles sorted by cell": {"order": by_cell},
    "particles shuffled": {"order": shuffled},
}


@pytest.mark.parametrize("what", LAWS)
def test_v42_grid_and_order(measure, what):
    usual = end_of(*thrown(what))
    for other, change in OTHERWISE.items():
        error = gap(end_of(*thrown(what, **change)), usual)
        measure("V42", f"{what}, 2-D, {STEPS} steps: {other}", error, below=1e-13)


def test_v42_grid_and_order_in_three_dimensions(measure):
    usual = end_of(*thrown("rubber", 3))
    for other, change in OTHERWISE.items():
        error = gap(end_of(*thrown("rubber", 3, **change)), usual)
        measure("V42", f"rubber, 3-D, {STEPS} steps: {other}", error, below=1e-13)


@pytest.mark.skipif(not native.available(), reason="there are no native kernels")
@pytest.mark.parametrize("what", LAWS)
def test_v42_native_and_plain_kernels(measure, monkeypatch, what):
    """They sum in another order and take other roots, which rounding tells apart."""
    usual = end_of(*thrown(what))
    monkeypatch.setenv("PGJAX_NATIVE", "0")
    assert not native.available()
    plain = end_of(*thrown(what), how="plain")
    measure("V42", f"{what}, 2-D, {STEPS} steps: plain JAX", gap(plain, usual), below=1e-13)


def test_v42_walls_where_there_is_mass(measure, monkeypatch):
    """Walls on the slabs of nodes that have mass, and on all nodes: equal to rounding."""
    floor = Collider(HalfSpace([0.0, 0.25], [0.1, 1.0]), Separating(0.3))
    left = Collider(HalfSpace([0.3, 0.0], [1.0, 0.0]), Sticky())
    problem = thrown("sand", room=57, walls=(floor, left))
    rows = problem[0].grid.node_shape[0]
    assert nodes._layers(problem[0].grid.node_shape) < rows / 2
    active = end_of(*problem)
    # Without branches nothing is skipped.
    monkeypatch.setattr(nodes, "branches", lambda: False)
    everywhere = end_of(*problem, how="everywhere")
    measure("V42", "walls where there is mass = on all nodes", gap(active, everywhere), below=1e-13)
    monkeypatch.undo()
    tight = end_of(*thrown("sand", walls=(floor, left)))
    measure("V42", "the same on a tight grid", gap(active, tight), below=1e-13)


def test_v42_fails_between_grids_that_differ(measure):
    """Negative control: a grid that is shifted by a hundredth of a cell is another one."""
    scene, state, back = thrown("rubber")
    shift = 1e-3
    moved = pgjax.Grid(scene.grid.origin + shift, scene.grid.shape, scene.grid.h)
    other = eqx.tree_at(
        lambda s: (s.position, s.origin), state, (state.position - shift, moved.origin)
    )
    shifted = end_of(eqx.tree_at(lambda s: s.grid, scene, moved), other, back)
    error = gap(shifted, end_of(scene, state, back))
    measure("V42", "negative control: a grid shifted by 0.01 cells", error, above=1e-6)
