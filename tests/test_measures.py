"""Slopes, bends and volumes of bodies whose own are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.measures import heap_angle, turn_between, volume_change


def heap(angle, n=20_000, base=0.5):
    """A cone of particles, filled evenly, with a slope in degrees."""
    rng = np.random.default_rng(0)
    x = rng.uniform([-base, -base, 0], [base, base, base * np.tan(np.radians(angle))], (9 * n, 3))
    top = (base - np.hypot(x[:, 0], x[:, 1])) * np.tan(np.radians(angle))
    return x[x[:, 2] < top][:n]


@pytest.mark.parametrize("angle", [15, 25, 33, 45])
def test_the_slope_of_a_cone(angle):
    assert heap_angle(heap(angle), cell=0.04) == pytest.approx(angle, abs=1.5)


def test_a_wall_left_standing_counts_little():
    x = heap(30)
    wall = np.random.default_rng(1).uniform([0.3, -0.05, 0], [0.34, 0.05, 0.28], (400, 3))
    assert heap_angle(np.concatenate([x, wall]), cell=0.04) == pytest.approx(30, abs=3)


def rod(n=4000):
    return np.random.default_rng(2).uniform([0, -0.1, -0.1], [1, 0.1, 0.1], (n, 3))


@pytest.mark.parametrize("angle", [0.0, 12.0, 75.0, 170.0])
def test_the_twist_of_a_rod_that_was_carried_away(angle):
    X = rod()
    turns = Rotation.from_rotvec(np.radians(angle) * X[:, :1] * [1, 0, 0])
    carried = Rotation.from_rotvec([0.3, -1.2, 0.4])
    x = np.array([1, 2, 3]) + carried.apply(turns.apply(X))
    ends = X[:, 0] < 0.05, X[:, 0] > 0.95
    # The middles of the ends are 0.95 apart.
    assert turn_between(X, x, *ends) == pytest.approx(0.95 * angle, abs=0.05 * angle + 1e-6)


def test_volume_is_weighted():
    F = np.stack([np.eye(3), 2 * np.eye(3)])
    assert volume_change(F, [3.0, 1.0]) == pytest.approx(7 / 4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: heap_angle(np.zeros((4, 2)), cell=1), r"`x` must have shape \(p, 3\)"),
        (lambda: heap_angle(np.zeros((4, 3)), cell=0), "`cell` must be positive"),
        (lambda: heap_angle(np.zeros((4, 3)), cell=1), "at least 8 columns of flank"),
        (lambda: heap_angle(np.full((4, 3), np.nan), cell=1), "`x` must be finite"),
        (lambda: turn_between(rod(9), rod(8), [], []), "must have the same shape"),
        (lambda: turn_between(rod(9), rod(9), np.ones(9), np.ones(9) > 0), "`first` must be bool"),
        (lambda: turn_between(rod(9), rod(9), rod(9)[:, 0] > 2, []), "at least three"),
        (lambda: volume_change(np.eye(3)[None], [-1.0]), "`volumes` must be positive"),
        (lambda: volume_change(np.eye(3), [1.0]), r"must have shapes \(p, d, d\)"),
    ],
)
def test_what_cannot_be_measured_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
