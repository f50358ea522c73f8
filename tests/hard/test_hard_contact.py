"""Hard contacts: bodies side by side, and particles inside of one that moves."""

import numpy as np
import pytest

import pgjax
from hard.bodies import MATERIALS, H, N, block, is_finite, largest, run, slopes, world
from pgjax import boundary


def gap_velocity(gap, degree):
    """What a block at rest gets of the velocity 1 of another, `gap` away, in one step."""
    left, right = block(side=3, center=(0.35, 0.55)), block(side=3)
    right[:, 0] += left[:, 0].max() + gap - right[:, 0].min()
    x = np.concatenate([left, right])
    spline = pgjax.BSpline(degree)
    scene = world(MATERIALS["NeoHookean"], x, spline=spline, walls=None)
    v = np.concatenate([np.tile([1.0, 0.0], (9, 1)), np.zeros((9, 2))])
    end = run(scene, pgjax.initial_state(scene, x, v), 1e-4, 1)
    return np.asarray(end.v)[9:, 0]


@pytest.mark.parametrize("degree", [2, 3])
def test_h44_bodies_meet_where_their_nodes_do(degree, holds):
    """Two particles share nodes up to the width of the stencil, degree + 1 cells, and never beyond.

    Below degree + 1 less one cell they always do. What passes at a distance of one cell, and of
    two, is below a third and below a tenth of the velocity.
    """
    shared = [np.abs(gap_velocity(k * H, degree)).max() for k in (0.5, 1, 2)]
    assert shared[0] > shared[1] > shared[2] > 0
    assert shared[1] < 0.35
    assert shared[2] < 0.1
    assert (gap_velocity((degree + 1) * H, degree) == 0).all()
    assert (gap_velocity((degree + 1.7) * H, degree) == 0).all()
    holds("H44", material="NeoHookean")


def meeting(degree, place, speed=0.02):
    """Distances of two blocks, in cells, where they lose 1 % of their speed, and at the nearest."""
    left = block(center=(0.35 + place * H, 0.55))
    right = left + np.array([2.5 * H + 3.7 * H, 0.0])
    x, body = np.concatenate([left, right]), np.arange(72) // 36
    grid = pgjax.Grid((0.0, 0.0), (15, N), H)
    scene = world("NeoHookean", x, grid=grid, spline=pgjax.BSpline(degree), walls=None)
    speed = speed * float(scene.rest_sound_speed())
    state = pgjax.initial_state(scene, x, np.outer(0.5 - body, [speed, 0.0]))
    dt = pgjax.stable_dt(scene)
    gaps, closing = [], []
    for _ in range(100):
        line, v = (np.asarray(a, np.float64)[:, 0] for a in (state.x, state.v))
        gaps.append((line[body == 1].min() - line[body == 0].max()) / H)
        closing.append((v[body == 0].mean() - v[body == 1].mean()) / speed)
        if closing[-1] < 0:
            break
        state = run(scene, state, dt, round(0.05 * H / speed / dt))
    return gaps[np.argmax(np.array(closing) < 0.99)], min(gaps)


@pytest.mark.parametrize(("degree", "first", "nearest"), [(2, 2.32, 2.03), (3, 2.99, 2.34)])
def test_h44_distance_of_contact(degree, first, nearest, holds):
    """Slow blocks: where they begin to brake and how near they come, on average over the places.

    Their outermost particles, in cells; their surfaces are half a cell nearer. By the place in the
    grid both differ by half a cell up or down.
    """
    touches = np.array([meeting(degree, place) for place in (0.0, 0.25, 0.5, 0.75)])
    assert touches.mean(axis=0) == pytest.approx([first, nearest], abs=0.06)
    assert np.abs(touches - [first, nearest]).max() < 0.55
    holds("H44", material="NeoHookean")


CONTACTS = {
    "separating": boundary.Separating(0.3),
    "slip": boundary.Slip(),
    "sticky": boundary.Sticky(),
}


def struck(name, contact):
    """A block with a ball inside that sets off at the speed of sound, and its time step."""
    x = block()
    x[14] = 0.5
    c = float(world(name, x).rest_sound_speed())
    motion = boundary.Steady((c, 0.0), end=20.0 * H / c)
    body = boundary.Collider(boundary.Sphere((0.5, 0.5), 0.12), contact, motion)
    scene = world(name, x, walls=body)
    return scene, pgjax.initial_state(scene, x), pgjax.stable_dt(scene) / 4, c


@pytest.mark.parametrize(
    ("name", "contact"),
    [
        ("NeoHookean", "slip"),
        ("sand", "separating"),
        ("sand", "sticky"),
        *(pytest.param(n, "separating", marks=pytest.mark.slow) for n in MATERIALS if n != "sand"),
    ],
)
def test_h45_particles_inside_a_moving_body(name, contact, holds):
    """One of them in its very centre, where there is no normal: taken along, and nothing is NaN."""
    scene, state, dt, c = struck(name, CONTACTS[contact])
    end = run(scene, state, dt, 20)
    assert is_finite(end)
    assert bool(end.status.ok)
    assert float(end.v[14, 0]) > 0.3 * c
    assert largest(end.v) < 3 * c
    holds("H45", material=name)


@pytest.mark.slow
def test_h45_derivatives_inside_a_moving_body(holds):
    scene, state, dt, _ = struck("NeoHookean", CONTACTS["separating"])
    assert is_finite(slopes(scene, state, dt))
    holds("H45", material="NeoHookean")
