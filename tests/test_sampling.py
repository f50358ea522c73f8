"""Particles and their volumes."""

import numpy as np
import pytest

from pgjax import sampling


@pytest.mark.parametrize("upper", [(1.0, 0.5, 0.25), (1.0, 0.5)])
def test_block_fills_the_box(upper):
    x, volumes = sampling.block((0,) * len(upper), upper, 0.1)
    np.testing.assert_allclose(volumes.sum(), np.prod(upper), rtol=1e-12)
    np.testing.assert_allclose((x * volumes[:, None]).sum(0) / volumes.sum(), np.array(upper) / 2)


def test_ball_has_its_volume():
    x, volumes = sampling.ball((1.0, 2.0, 3.0), 0.5, 0.05)
    np.testing.assert_allclose(volumes.sum(), 4 / 3 * np.pi * 0.125, rtol=1e-12)
    assert np.all(np.linalg.norm(x - [1, 2, 3], axis=1) <= 0.5)


def test_pieces_are_what_is_within_reach():
    """The largest first; a chain holds together, and one alone is a piece."""
    x = np.array([[0.0, 0], [9, 9], [1, 0], [5, 0], [2, 0], [5, 0.9], [3, 0]])
    assert sampling.pieces(x, 1.0).tolist() == [0, 2, 0, 1, 0, 1, 0]
    assert sampling.pieces(x, 2.0).tolist() == [0, 1, 0, 0, 0, 0, 0]
    assert sampling.pieces(x[:1], 1.0).tolist() == [0]
    with pytest.raises(ValueError, match="`reach` must be positive"):
        sampling.pieces(x, 0.0)
    with pytest.raises(ValueError, match="`x` must be finite"):
        sampling.pieces(x * np.nan, 1.0)


@pytest.mark.parametrize("spacing", [0.1, 0.05, 0.025])
def test_neighbour_volumes_of_a_lattice(spacing):
    """Inside a lattice the estimate is right within 4 %; at the surface it errs to one layer."""
    x, volumes = sampling.block((0, 0, 0), (1, 1, 1), spacing)
    estimate = sampling.neighbour_volumes(x)
    inside = np.all((x > 3 * spacing) & (x < 1 - 3 * spacing), axis=1)
    np.testing.assert_allclose(estimate[inside], volumes[inside], rtol=0.04)
    assert 1 < estimate.sum() < 1.035 + 3 * spacing


def test_neighbour_volumes_of_random_points():
    x = np.random.default_rng(0).random((20_000, 3))
    inside = np.all((x > 0.15) & (x < 0.85), axis=1)
    assert abs(sampling.neighbour_volumes(x)[inside].sum() / 0.7**3 - 1) < 0.03


def test_neighbour_volumes_scale_with_length():
    x = np.random.default_rng(1).random((300, 3))
    np.testing.assert_allclose(
        sampling.neighbour_volumes(1e-3 * x), 1e-9 * sampling.neighbour_volumes(x), rtol=1e-9
    )


def test_neighbour_volumes_bounds_coincident_and_isolated_points():
    x = np.random.default_rng(2).random((500, 3))
    x[:40] = x[0]
    x[-1] = 1e3
    volumes = sampling.neighbour_volumes(x)
    median = np.median(volumes)
    assert np.all(volumes > 0)
    assert volumes.max() < 10 * median
    assert volumes.min() > median / 100


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sampling.block((0, 0, 0), (1, -1, 1), 0.1), "`upper` must be above"),
        (lambda: sampling.block((0, 0), (1, 1, 1), 0.1), "vectors of 2 or 3"),
        (lambda: sampling.block((0, 0), (1, 1), 0.0), "`spacing` must be positive"),
        (lambda: sampling.ball((0, 0), -1.0, 0.1), "`radius` must be positive"),
        (lambda: sampling.neighbour_volumes(np.zeros((5, 3))), "all of them coincide"),
        (lambda: sampling.neighbour_volumes(np.full((5, 3), np.nan)), "`x` must be finite"),
        (lambda: sampling.neighbour_volumes(np.zeros((1, 3))), "p ≥ 2"),
    ],
)
def test_bad_input(call, words):
    with pytest.raises(ValueError, match=words):
        call()
