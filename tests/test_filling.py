"""Interior particles against analytic volumes and shapes."""

import time

import numpy as np
import pytest
from scipy.spatial import ConvexHull, KDTree

from pgjax.filling import fill
from pgjax.render import load_ply

PI = np.pi


def discs(x, n, size, seed=9):
    """Thin discs of random outline on the points x with normals n, as a capture has them."""
    rng = np.random.default_rng(seed)
    u = np.cross(n, rng.normal(size=n.shape))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    R = np.stack([u, np.cross(n, u), n], axis=-1)
    scale = size * np.exp(0.4 * rng.normal(size=x.shape))
    scale[:, 2] = 0.05 * size
    M = R * scale[:, None, :]
    return x, M @ np.swapaxes(M, 1, 2), rng.uniform(0.3, 1, len(x))


def noisy(x, n, noise, seed=8):
    return x + noise * np.random.default_rng(seed).normal(size=(len(x), 1)) * n


def sphere(count=5000, radius=1.0, center=(0.0, 0.0, 0.0), seed=0):
    n = np.random.default_rng(seed).normal(size=(count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.asarray(center) + radius * n, n


def torus(count=6000, R=1.0, r=0.4):
    rng = np.random.default_rng(1)
    a, b, chance = rng.random((3, 3 * count)) * [[2 * PI], [2 * PI], [R + r]]
    a, b = (angle[chance < R + r * np.cos(b)][:count] for angle in (a, b))
    n = np.stack([np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)], axis=-1)
    return r * n + R * np.stack([np.cos(a), np.sin(a), 0 * a], axis=-1), n


def box(count, lengths):
    rng = np.random.default_rng(2)
    L = np.asarray(lengths)
    axis = rng.choice(3, count, p=(1 / L) / np.sum(1 / L))
    side = rng.choice([-1.0, 1.0], count)
    x, n = rng.uniform(-0.5, 0.5, (count, 3)) * L, np.zeros((count, 3))
    n[np.arange(count), axis] = side
    x[np.arange(count), axis] = side * L[axis] / 2
    return x, n


def cup(density, radius=1.0, height=2.0, wall=0.3, double=True):
    """A cup along z, open at the top: all faces of its wall, or only a single sheet."""
    rng = np.random.default_rng(3)
    inner = radius - wall
    parts = []

    def tube(r, low, high, side):
        count = int(density * 2 * PI * r * (high - low))
        a = rng.uniform(0, 2 * PI, count)
        n = np.stack([np.cos(a), np.sin(a), 0 * a], axis=-1)
        parts.append((r * n + np.outer(rng.uniform(low, high, count), [0, 0, 1]), side * n))

    def ring(r, R, z, side):
        count = int(density * PI * (R * R - r * r))
        a, s = rng.uniform(0, 2 * PI, count), np.sqrt(rng.uniform(r * r, R * R, count))
        x = np.stack([s * np.cos(a), s * np.sin(a), 0 * a + z], axis=-1)
        parts.append((x, np.tile([0.0, 0.0, side], (count, 1))))

    tube(radius, 0, height, 1.0)
    ring(0, radius, 0, -1.0)
    if double:
        tube(inner, wall, height, -1.0)
        ring(0, inner, wall, 1.0)
        ring(inner, radius, height, 1.0)
    x, n = (np.concatenate(part) for part in zip(*parts, strict=True))
    return x, n, PI * radius**2 * height - PI * inner**2 * (height - wall)


def check_volumes(filled, count):
    """All volumes are positive, and those of the bodies add up to what these enclose."""
    assert filled.volumes.shape == (count + len(filled.points),)
    assert np.all(filled.volumes > 0)
    assert np.all(np.isfinite(filled.volumes))
    of_body = filled.volumes[:count][~filled.loose].sum() + filled.volumes[count:].sum()
    np.testing.assert_allclose(of_body, filled.report.volume, rtol=1e-5)


SOLIDS = {
    "sphere": (sphere(), 4 / 3 * PI, lambda x: np.linalg.norm(x, axis=1) < 1.02),
    "sparse sphere": (sphere(900), 4 / 3 * PI, lambda x: np.linalg.norm(x, axis=1) < 1.03),
    "torus": (
        torus(),
        2 * PI**2 * 0.16,
        lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1, x[:, 2]) < 0.42,
    ),
    "plate": (
        box(9000, (2.0, 2.0, 0.3)),
        1.2,
        lambda x: np.all(np.abs(x) < [1.02, 1.02, 0.17], axis=1),
    ),
    "cup": (
        cup(600)[:2],
        cup(600)[2],
        lambda x: (np.hypot(x[:, 0], x[:, 1]) > 0.68) | (x[:, 2] < 0.32),
    ),
}


@pytest.mark.parametrize("spacing", [0.1, 0.055])
@pytest.mark.parametrize("name", SOLIDS)
def test_enclosed_volume_and_place(name, spacing):
    (x, n), volume, inside = SOLIDS[name]
    filled = fill(*discs(noisy(x, n, 0.006), n, 0.04), spacing=spacing)
    assert abs(filled.report.volume / volume - 1) < 0.015
    assert filled.report.bodies == 1
    check_volumes(filled, len(x))
    assert np.all(inside(filled.points))
    assert not filled.loose.any()
    # The interior is covered: no place in it is farther than a cell's diagonal from a particle.
    everything = KDTree(np.concatenate([x, filled.points]))
    assert everything.query(filled.points, k=[2])[0].max() < 2 * spacing


def test_union_of_balls_against_monte_carlo():
    centers = np.array([[0, 0, 0], [0.8, 0.3, 0], [0.2, -0.7, 0.6], [-0.6, 0.5, 0.5]])
    radii = np.array([0.7, 0.5, 0.6, 0.45])
    balls = enumerate(zip(centers, radii, strict=True))
    parts = [sphere(int(8000 * r * r), r, c, seed=i) for i, (c, r) in balls]
    x, n = (np.concatenate(part) for part in zip(*parts, strict=True))

    def covered(points, shrink):
        away = np.linalg.norm(points[:, None] - centers, axis=-1)
        return np.any(away < radii - shrink, axis=1)

    outer = ~covered(x, 1e-9)
    x, n = x[outer], n[outer]
    trial = np.random.default_rng(4).uniform(-2, 2, (200_000, 3))
    volume = 64 * np.mean(covered(trial, 0.0))  # ± 0.7 %
    filled = fill(*discs(noisy(x, n, 0.004), n, 0.03), spacing=0.06)
    assert abs(filled.report.volume / volume - 1) < 0.03
    assert np.all(covered(filled.points, -0.03))


def test_filled_particles_carry_the_moments_of_a_ball():
    x, n = sphere()
    filled = fill(*discs(x, n, 0.04), spacing=0.07)
    everything = np.concatenate([x, filled.points])
    V = filled.volumes
    np.testing.assert_allclose(V @ everything / V.sum(), 0, atol=0.01)
    moments = (V[:, None] * everything).T @ everything / V.sum()
    np.testing.assert_allclose(moments, np.eye(3) / 5, atol=0.01)  # ∫ x²/V = R²/5


@pytest.mark.parametrize("spacing", [0.1, 0.05])
@pytest.mark.parametrize("name", ["open hemisphere", "open single-walled cup", "cloth"])
def test_open_surfaces_stay_sheets(name, spacing):
    if name == "cloth":
        x = np.random.default_rng(5).uniform(-1, 1, (4000, 3)) * [1, 1, 0]
        n = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    elif name == "open hemisphere":
        x, n = sphere(8000)
        x, n = x[x[:, 2] < 0], n[x[:, 2] < 0]
    else:
        x, n, _ = cup(600, double=False)
    filled = fill(*discs(noisy(x, n, 0.005), n, 0.04), spacing=spacing)
    assert (len(filled.points), filled.report.volume, filled.report.bodies) == (0, 0.0, 0)
    assert filled.loose.all()
    check_volumes(filled, len(x))
    assert "0 particles inside" in str(filled.report)


def test_a_missing_underside_is_closed_where_the_seal_is_wide_enough():
    x, n = sphere(8000)
    seen = x[:, 2] > -0.85  # the hole is 1.05 wide, the missing cap 0.15 high
    args = discs(noisy(x, n, 0.005)[seen], n[seen], 0.04)
    volume = 4 / 3 * PI - PI * 0.15**2 * (3 - 0.15) / 3
    assert fill(*args, spacing=0.08).report.volume == 0
    closed = fill(*args, spacing=0.08, seal=1.6)
    assert abs(closed.report.volume / volume - 1) < 0.02
    assert closed.report.caps == 1
    assert np.linalg.norm(closed.points, axis=1).max() < 1.02
    check_volumes(closed, seen.sum())


def test_two_bodies_and_a_floater():
    parts = [sphere(2000, 0.5), sphere(2000, 0.5, (2.0, 0, 0), seed=1)]
    x, n = (np.concatenate(part) for part in zip(*parts, strict=True))
    x, n = np.append(x, [[1.0, 1.0, 0]], axis=0), np.append(n, [[0, 0, 1.0]], axis=0)
    filled = fill(*discs(x, n, 0.03), spacing=0.06)
    assert filled.report.bodies == 2
    np.testing.assert_array_equal(np.flatnonzero(filled.loose), [4000])
    assert abs(filled.report.volume / (2 * PI / 6) - 1) < 0.015
    assert np.all(filled.nearest[filled.points[:, 0] > 1] >= 2000)


def test_nearest_gaussian():
    x, n = sphere(1500)
    filled = fill(*discs(x, n, 0.06), spacing=0.1)
    chosen = np.linalg.norm(filled.points - x[filled.nearest], axis=1)
    closest = np.linalg.norm(filled.points[:, None] - x, axis=-1).min(axis=1)
    assert np.all(chosen < closest + 2 * 0.1)


def test_the_seed_decides_the_points():
    args = discs(*sphere(1500), 0.06)
    first, again, other = (fill(*args, spacing=0.1, seed=s) for s in (3, 3, 4))
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.volumes, again.volumes)
    assert first.points.shape == other.points.shape
    assert np.abs(first.points - other.points).max() > 0.01


def test_degenerate_gaussians_do_no_harm():
    """Floaters, flat, coincident and broken ones among others change the volume little."""
    x, A, opacities = discs(*sphere(), 0.04)
    A[:50] = np.diag([4e-16, 1e-4, 1e-4])
    A[50] = 1e12 * np.eye(3)
    A[51] = np.diag([1e12, 1e-8, 1e-8])
    A[52:60] = np.nan
    A[60] = np.inf
    x[70:90] = x[70]
    with pytest.warns(UserWarning, match="9 of 5000 covariances are not finite"):
        filled = fill(x, A, opacities, spacing=0.08)
    assert filled.report.broken == 9
    assert abs(filled.report.volume / (4 / 3 * PI) - 1) < 0.02
    check_volumes(filled, len(x))


@pytest.mark.parametrize("points", ["one", "two", "coincident", "line"])
@pytest.mark.parametrize("sigma", [0.0, 2e-8, 1e6])
def test_few_points_enclose_nothing(points, sigma):
    x = {
        "one": np.zeros((1, 3)),
        "two": np.array([[0.0, 0, 0], [1, 0, 0]]),
        "coincident": np.ones((30, 3)),
        "line": np.outer(np.linspace(0, 1, 40), [1.0, 0, 0]),
    }[points]
    covariances = np.tile(sigma**2 * np.eye(3), (len(x), 1, 1))
    filled = fill(x, covariances, np.ones(len(x)), spacing=0.1)
    assert len(filled.points) == 0
    assert filled.loose.all()
    check_volumes(filled, len(x))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"spacing": 0.0}, "`spacing` must be positive"),
        ({"spacing": 1e-4}, "`spacing` must be about .* but is 0.0001"),
        ({"spacing": 1e-300}, "`spacing` must be about"),
        (
            {"spacing": 0.1, "max_particles": 100},
            "`spacing` must give at most `max_particles` = 100",
        ),
        ({"spacing": 0.1, "seal": np.nan}, "`seal` must be positive"),
        ({"spacing": 0.1, "seal": 1e9}, "m around them that `seal` needs"),
        ({"spacing": 0.1, "means": np.full((500, 3), np.nan)}, "`means` must be finite"),
        ({"spacing": 0.1, "means": np.zeros((0, 3))}, "`means` must have shape"),
        ({"spacing": 0.1, "covariances": np.zeros((3, 3))}, "`covariances` must have shape"),
        ({"spacing": 0.1, "opacities": np.full(500, 2.0)}, r"`opacities` must be in \[0, 1\]"),
    ],
)
def test_bad_input(change, words):
    x, A, opacities = discs(*sphere(500), 0.1)
    arguments = {"means": x, "covariances": A, "opacities": opacities} | change
    with pytest.raises(ValueError, match=words):
        fill(**arguments)


def test_a_stray_far_away_is_refused_rather_than_gridded():
    x, A, opacities = discs(*sphere(500), 0.1)
    x[0] = 1e9
    with pytest.raises(ValueError, match="Remove floaters far away, or raise `spacing`"):
        fill(x, A, opacities, spacing=0.1)


@pytest.mark.parametrize(
    ("name", "spacing", "volumes"),
    [("playbot_8406", 0.03, (0.08, 0.13)), ("angel_71359", 0.05, (0.6, 1.1))],
)
def test_captured_scenes(reference_data, name, spacing, volumes):
    g = load_ply(reference_data / "splats" / f"{name}.ply")
    g = g[np.asarray(g.opacities) > 0.1]
    x = np.asarray(g.means, np.float64)
    begin = time.perf_counter()
    filled = fill(x, g.covariances, g.opacities, spacing=spacing)
    assert time.perf_counter() - begin < 10
    check_volumes(filled, len(x))
    assert volumes[0] < filled.report.volume < volumes[1]
    # Discs reach beyond their centres, and so may the body by about their size.
    planes = ConvexHull(x).equations
    beyond = (filled.points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    assert np.mean(beyond > 0) < 0.01
    assert beyond.max() < 3 * spacing
