"""Long Gaussians: counting them, and splitting them into rows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.render import (
    Camera,
    Gaussians,
    Rule,
    deform,
    measure_axes,
    render,
    split_long,
)

EPS = float(jnp.finfo(jnp.zeros(()).dtype).eps)
FINE = Rule(alpha_max=0.9999, alpha_min=1e-5, stop=0.0)
CAMERA = Camera.look_at([0, 0, -5], [0, 0, 0], up=[0, -1, 0], focal=110, width=96, height=96)


def floats(array):
    return jnp.asarray(array, dtype=jnp.zeros(()).dtype)


def needles(scales, opacities, seed=0, k=4):
    rng = np.random.default_rng(seed)
    n = len(scales)
    return Gaussians.from_scales(
        floats(rng.uniform(-0.8, 0.8, (n, 3))),
        floats(rng.normal(size=(n, 4))),
        floats(scales),
        floats(opacities),
        floats(0.5 * rng.normal(size=(n, k, 3))),
    )


def random_scene(n=80, seed=1):
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.uniform(-4, -3, (n, 3)))
    scales[:, rng.integers(3)] = rng.uniform(0.05, 0.5, n)
    return needles(scales, rng.uniform(0.05, 1, n), seed)


def mixture_moments(parts, parent, n):
    """Mean and covariance of the children of each parent, weighted with their opacities."""
    w, x = np.asarray(parts.opacities, np.float64), np.asarray(parts.means, np.float64)
    total = np.bincount(parent, w, n)
    mean = np.stack([np.bincount(parent, w * x[:, i], n) for i in range(3)], -1) / total[:, None]
    apart = x - mean[parent]
    A = np.asarray(parts.covariances, np.float64) + apart[:, :, None] * apart[:, None, :]
    second = np.zeros((n, 3, 3))
    np.add.at(second, parent, w[:, None, None] * A)
    return mean, second / total[:, None, None]


@pytest.mark.parametrize("longest", [0.2, 0.06])
def test_split_keeps_mean_and_covariance(longest):
    g = random_scene()
    parts, parent = split_long(g, longest)
    mean, covariance = mixture_moments(parts, parent, len(g))
    np.testing.assert_allclose(mean, g.means, atol=200 * EPS)
    np.testing.assert_allclose(covariance, g.covariances, atol=200 * EPS)
    sigma = np.linalg.svd(np.asarray(parts.factors), compute_uv=False)
    assert sigma.max() <= longest * (1 + 1e-5)
    counts = np.bincount(parent)
    before = np.linalg.svd(np.asarray(g.factors), compute_uv=False)[:, 0]
    np.testing.assert_array_equal(counts > 1, before > longest)
    assert counts.max() < 4 * before.max() / longest


@pytest.mark.parametrize("opacity", [1e-3, 0.3, 0.95, 1.0])
def test_children_are_short_enough_whatever_the_opacity(opacity):
    lengths = np.geomspace(1.001, 200, 60)
    g = needles(np.stack([lengths, 0 * lengths + 0.1, 0 * lengths], -1), np.full(60, opacity))
    parts, parent = split_long(g, 1.0)
    assert np.linalg.svd(np.asarray(parts.factors), compute_uv=False).max() <= 1 + 1e-5
    assert np.asarray(parts.opacities).max() <= opacity + 1e-6
    np.testing.assert_array_equal(np.unique(parent), np.arange(60))
    assert np.all(np.bincount(parent) <= np.maximum(4 * lengths, 3))


def test_untouched_gaussians_are_bit_identical():
    g = random_scene()
    parts, parent = split_long(g, 0.2)
    long = np.linalg.svd(np.asarray(g.factors), compute_uv=False)[:, 0] > 0.2
    assert 10 < long.sum() < 70
    kept = ~long[parent]
    for ours, theirs in zip(jax.tree.leaves(parts[kept]), jax.tree.leaves(g[~long]), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(parent[kept], np.flatnonzero(~long))
    assert np.all(np.diff(parent) >= 0)
    np.testing.assert_array_equal(parts.sh, g.sh[parent])
    np.testing.assert_array_equal(parts.frames, g.frames[parent])


@pytest.mark.parametrize(("tilt", "more"), [(0, 0.02), (40, 0.11)])
@pytest.mark.parametrize(("opacity", "bound"), [(0.1, 0.04), (0.6, 0.07), (0.99, 0.1)])
def test_one_needle_looks_the_same(opacity, bound, tilt, more):
    """Across its axis the pictures differ by little of what is drawn; tilted, more is covered."""
    R = Rotation.from_euler("yz", [tilt, 30], degrees=True).as_quat(scalar_first=True)
    g = Gaussians.from_scales(
        floats(np.zeros((1, 3))),
        floats(R[None]),
        floats([[0.8, 0.08, 0.05]]),
        floats([opacity]),
        floats(np.ones((1, 1, 3))),
    )
    parts, parent = split_long(g, 0.2)
    assert len(parent) == 12
    before, after = (np.asarray(render(s, CAMERA, rule=FINE).alpha) for s in (g, parts))
    assert abs(after.sum() / before.sum() - 1) < more
    assert np.abs(after - before).mean() < 0.006
    if tilt == 0:
        assert np.abs(after - before).sum() / before.sum() < bound


def test_a_scene_of_needles_looks_the_same():
    g = random_scene(150)
    parts, _ = split_long(g, 0.1)
    assert len(parts) > 300
    before, after = (np.asarray(render(s, CAMERA).rgb) for s in (g, parts))
    assert before.mean() > 0.05
    assert np.abs(after - before).mean() < 0.01


def bend(x, radius=0.6):
    """The x axis is wound around a circle; the deformation gradient is a rotation there."""
    angle, r = x[:, 0] / radius, radius - x[:, 1]
    moved = np.stack([r * np.sin(angle), radius - r * np.cos(angle), x[:, 2]], axis=-1)
    c, s, zero = np.cos(angle), np.sin(angle), 0 * angle
    e = np.stack([np.stack([c, s, zero], -1), np.stack([-s, c, zero], -1)], axis=-1)
    F = np.zeros((len(x), 3, 3))
    F[:, :, 0] = e[:, :, 0] * (r / radius)[:, None]
    F[:, :, 1] = e[:, :, 1]
    F[:, 2, 2] = 1
    return moved, F


def test_children_follow_a_bend():
    g = Gaussians.from_scales(
        floats(np.zeros((1, 3))),
        floats([[1.0, 0, 0, 0]]),
        floats([[0.5, 0.02, 0.02]]),
        floats([0.8]),
        floats(np.ones((1, 1, 3))),
    )

    def distance_from_arc(gaussians):
        """Root mean square distance of the drawn mass from the bent axis."""
        x, F = bend(np.asarray(gaussians.means))
        bent = deform(gaussians, floats(x), floats(F))
        rng = np.random.default_rng(0)
        w = np.asarray(gaussians.opacities, np.float64)
        who = rng.choice(len(w), 4000, p=w / w.sum())
        z = rng.normal(size=(4000, 3))
        points = np.asarray(bent.means)[who] + np.einsum(
            "nij,nj->ni", np.asarray(bent.factors)[who], z
        )
        return np.sqrt(np.mean((np.hypot(points[:, 0], points[:, 1] - 0.6) - 0.6) ** 2))

    parts, _ = split_long(g, 0.1)
    whole, split = distance_from_arc(g), distance_from_arc(parts)
    assert whole > 0.15
    assert split < 0.03  # of which 0.02 is the needle's own thickness


def test_axes_are_counted():
    scales = [[1.0, 0.05, 0.01], [0.1, 0.1, 0.1], [0.2, 0.1, 0.0], [3.0, 0.0, 0.0], [0.0, 0, 0]]
    g = needles(scales, np.full(5, 0.5))
    broken = Gaussians(g.means, g.factors.at[1].set(jnp.nan), g.opacities, g.sh, g.frames)
    report = measure_axes(g, 0.15)
    assert (report.count, report.broken, report.long) == (5, 0, 3)
    np.testing.assert_allclose(report.ratios[0], 2, rtol=100 * EPS)  # of 1, 1, 2, 20, ∞
    assert report.needles == 2
    assert measure_axes(broken, 0.15).broken == 1
    text = str(report)
    assert "5 Gaussians" in text
    assert "3 longer than 0.15" in text
    assert "\n" not in text


def test_gaussians_that_are_not_finite_are_left_alone():
    g = needles([[1.0, 0.05, 0.01]] * 3, [0.5, 0.5, 0.0])
    g = Gaussians(g.means, g.factors.at[1, 0, 0].set(jnp.inf), g.opacities, g.sh, g.frames)
    parts, parent = split_long(g, 0.3)
    assert np.sum(parent == 1) == 1
    np.testing.assert_array_equal(parts.factors[parent == 1], g.factors[1:2])
    assert np.all(np.asarray(parts.opacities)[parent == 2] == 0)
    assert np.isfinite(np.asarray(parts.means)).all()


def test_bad_input():
    g = needles([[1.0, 0.05, 0.01]], [0.5])
    with pytest.raises(ValueError, match="`longest` must be positive"):
        split_long(g, 0.0)
    with pytest.raises(ValueError, match="`longest` must give at most `max_gaussians` = 4000000"):
        split_long(g, 1e-9)
    with pytest.raises(ValueError, match="`longest` must give at most `max_gaussians` = 5 "):
        split_long(g, 0.1, max_gaussians=5)
    with pytest.raises(ValueError, match="`spacing` must be positive"):
        measure_axes(g, -1.0)
