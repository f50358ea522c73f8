"""Where a wall acts: so many cells before its nodes, whatever the material and the contact."""

import numpy as np
import pytest

import pgjax
from pgjax import boundary, models, sampling

TURN = np.array([[0.8, 0.6], [-0.6, 0.8]])
HEIGHT, FRAMES, FRAME = 0.35, 60, 0.01


def turning_time(cells, E, contact, *, tilted, behind=0.0):
    """When the straight paths before and after a rebound at 1 m/s meet.

    The wall's nodes lie `behind` cells below 0.
    """
    h = 1 / cells
    x, volumes = sampling.block((-0.15, -0.125), (0.15, 0.125), h / 2)
    x = (x @ TURN.T if tilted else x) + np.array([0.5, HEIGHT])
    floor = -behind * h
    grid = pgjax.Grid((-2 * h, floor - 4 * h), (cells + 4, int(np.ceil(0.9 * cells)) + 6), h)
    scene = pgjax.Scene(
        grid,
        models.Material(models.FixedCorotated(E, 0.3)),
        volumes,
        boundaries=[boundary.Box((-9.0, floor), (9.0, 9.0), contact)],
        scheme=pgjax.MLS(),
    )
    state = pgjax.initial_state(scene, x, (0.0, -1.0))
    substeps = 2 * int(np.ceil(FRAME / pgjax.stable_dt(scene, state)))
    moved = pgjax.simulate(scene, state, dt=FRAME / substeps, frames=FRAMES, substeps=substeps)
    height = np.asarray(moved.saved.x[..., 1]).mean(axis=1)
    t = FRAME * np.arange(FRAMES + 1)
    speed, start = np.polyfit(t[-12:], height[-12:], 1)
    return (HEIGHT - start) / (speed + 1.0)


@pytest.mark.float64
@pytest.mark.parametrize("contact", [boundary.Sticky(), boundary.Separating(0.0)], ids=repr)
@pytest.mark.parametrize(("tilted", "expected"), [(True, (0.45, 0.65)), (False, (0.65, 0.9))])
def test_a_wall_acts_before_its_nodes(measure, contact, tilted, expected):
    """An edge is stopped half a cell before the nodes, a face 0.7 to 0.8: linear in h."""
    for E in (3e5, 1e6):
        times = [turning_time(n, E, contact, tilted=tilted) for n in (24, 48)]
        cells = (times[1] - times[0]) / (1 / 24 - 1 / 48)
        shape = "an edge" if tilted else "a face"
        measure("H44", f"cells before a wall that stop {shape}, E = {E:g}", cells, within=expected)


@pytest.mark.float64
def test_a_wall_that_is_put_back_acts_at_its_place(measure):
    """Nodes 0.6 cells behind the surface: what is left of the error is below a fifth of a cell."""
    contact = boundary.Sticky()
    for tilted in (True, False):
        coarse, fine = (turning_time(n, 1e6, contact, tilted=tilted, behind=0.6) for n in (24, 48))
        shape = "an edge" if tilted else "a face"
        left = abs(fine - coarse) / (1 / 24 - 1 / 48)
        measure("H44", f"cells that are left for {shape} of 0.6 cells put back", left, below=0.3)
