"""Shapes, motions, colliders and windows of time, each against an independent result."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pgjax import boundary
from pgjax.boundary.motion import step_of
from pgjax.boundary.particles import Particles
from pgjax.boundary.shapes import normal
from pgjax.boundary.window import within
from pgjax.linalg import rotation_change

double = pytest.mark.float64
T0 = jnp.asarray(0.0)

SHAPES_3D = {
    "sphere": boundary.Sphere((0.1, -0.2, 0.05), 0.7),
    "cuboid": boundary.Cuboid((0.1, 0.0, -0.1), (0.6, 0.4, 0.3)),
    "turned cuboid": boundary.Cuboid((0.1, 0.0, -0.1), (0.6, 0.4, 0.3), (0.4, -0.9, 0.7)),
    "cylinder": boundary.Cylinder((-0.3, 0.0, -0.4), (0.2, 0.3, 0.5), 0.45),
    "capsule": boundary.Capsule((-0.3, 0.0, -0.2), (0.2, 0.3, 0.3), 0.4),
    "capsule, put back": boundary.Offset(
        boundary.Capsule((-0.3, 0.0, -0.2), (0.2, 0.3, 0.3), 0.5), -0.1
    ),
}
SHAPES_2D = {
    "disc": boundary.Sphere((0.1, -0.2), 0.7),
    "rectangle": boundary.Cuboid((0.1, 0.0), (0.6, 0.4)),
    "turned rectangle": boundary.Cuboid((0.1, 0.0), (0.6, 0.4), 0.6),
    "2-D capsule": boundary.Capsule((-0.3, 0.0), (0.2, 0.3), 0.4),
}
SHAPES = SHAPES_3D | SHAPES_2D


def inside(name, x):
    """Whether points are in a shape of the registry, from its definition."""
    d = x.shape[1]
    if name in ("sphere", "disc"):
        return np.sum((x - np.array([0.1, -0.2, 0.05])[:d]) ** 2, axis=1) <= 0.49
    if name.endswith(("cuboid", "rectangle")):
        turn = {"turned cuboid": [0.4, -0.9, 0.7], "turned rectangle": [0, 0, 0.6]}.get(name)
        R = np.eye(3) if turn is None else Rotation.from_rotvec(turn).as_matrix()
        r = (x - np.array([0.1, 0.0, -0.1])[:d]) @ R[:d, :d]
        return np.all(np.abs(r) <= np.array([0.6, 0.4, 0.3])[:d], axis=1)
    a, b, radius = {
        "capsule, put back": ([-0.3, 0.0, -0.2], [0.2, 0.3, 0.3], 0.4),
        "cylinder": ([-0.3, 0.0, -0.4], [0.2, 0.3, 0.5], 0.45),
        "capsule": ([-0.3, 0.0, -0.2], [0.2, 0.3, 0.3], 0.4),
        "2-D capsule": ([-0.3, 0.0], [0.2, 0.3], 0.4),
    }[name]
    a, b = np.array(a), np.array(b)
    s = (x - a) @ (b - a) / np.sum((b - a) ** 2)
    if name == "cylinder":
        across = np.linalg.norm(x - a - s[:, None] * (b - a), axis=1)
        return (across <= radius) & (s >= 0) & (s <= 1)
    nearest = a + np.clip(s, 0, 1)[:, None] * (b - a)
    return np.linalg.norm(x - nearest, axis=1) <= radius


def surface_points(name, d, pitch):
    """Points of the surface to within `pitch`/64: sign changes on a lattice, bisected."""
    axes = [np.arange(-1.3, 1.3, pitch)] * d
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, d)
    within = inside(name, lattice)
    found = []
    for axis in range(d):
        other = lattice + pitch * np.eye(d)[axis]
        cut = within != inside(name, other)
        a, b, first = lattice[cut], other[cut], within[cut]
        for _ in range(6):
            middle = (a + b) / 2
            same = (inside(name, middle) == first)[:, None]
            a, b = np.where(same, middle, a), np.where(same, b, middle)
        found.append((a + b) / 2)
    return np.concatenate(found)


@double
@pytest.mark.parametrize("name", SHAPES)
def test_distance_is_that_to_the_surface(name):
    """Signed distances against a dense cloud of surface points; the normal is their gradient."""
    shape, rng = SHAPES[name], np.random.default_rng(0)
    d = 3 if name in SHAPES_3D else 2
    pitch = 0.02
    tree = KDTree(surface_points(name, d, pitch))
    x = rng.uniform(-1.2, 1.2, (400, d))
    signed = jax.vmap(shape.signed_distance)(jnp.asarray(x))
    np.testing.assert_array_equal(signed < 0, inside(name, x))
    distance = tree.query(x)[0]
    # The nearest point of the cloud is at most a pitch away along the surface.
    far = distance > 3 * pitch
    error = np.abs(np.abs(signed) - distance)[far]
    # Edges and corners hold no point of the cloud.
    assert error.max() < 1.5 * pitch
    assert np.median(error) < pitch / 20
    n = jax.vmap(lambda x: normal(shape, x))(jnp.asarray(x))
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, rtol=1e-12)
    # One step of length φ against the normal ends on the surface.
    outside = np.asarray(signed) > 0
    foot = jnp.asarray(x) - signed[:, None] * n
    back = jax.vmap(shape.signed_distance)(foot)
    assert np.abs(back[outside]).max() < 1e-12
    hollow = boundary.Complement(shape)
    np.testing.assert_array_equal(jax.vmap(hollow.signed_distance)(jnp.asarray(x)), -signed)


def test_normal_vanishes_where_there_is_none():
    """In the centre of a sphere: no NaN, and its derivative has none either."""
    shape = boundary.Sphere((0.0, 0.0), 1.0)
    assert (normal(shape, jnp.zeros(2)) == 0).all()
    assert jnp.isfinite(jax.jacfwd(lambda x: normal(shape, x))(jnp.zeros(2))).all()
    body = boundary.Collider(shape, boundary.Slip(), boundary.Steady((1.0, 0.0)))
    moved = body(jnp.zeros(2), jnp.asarray([0.3, 0.4]), T0)
    np.testing.assert_allclose(moved, [1.0, 0.0])


# --- Rotations and motions -----------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.2, 0.23, 1.0, 3.0, 6.0])
def test_rotation_change_is_that_of_rodrigues(angle):
    axis = np.array([0.48, -0.6, 0.64])
    K = np.cross(np.eye(3), axis)
    c, s = -2 * np.sin(angle / 2) ** 2, np.sin(angle)
    expected = s * K - c * K @ K
    got = rotation_change(jnp.asarray(angle * axis, jnp.zeros(()).dtype))
    eps = float(jnp.finfo(got.dtype).eps)
    np.testing.assert_allclose(got, expected, rtol=32 * eps, atol=8 * eps * angle**2)
    reference = Rotation.from_rotvec(angle * axis).as_matrix() - np.eye(3)
    np.testing.assert_allclose(got, reference, rtol=0, atol=8 * eps)
    flat = rotation_change(jnp.asarray([angle], got.dtype))
    np.testing.assert_allclose(flat, [[c, -s], [s, c]], rtol=32 * eps)


@double
def test_rotation_change_has_the_exact_derivative_at_rest():
    jacobian = jax.jacfwd(rotation_change)(jnp.zeros(3))
    expected = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        expected[j, k, i], expected[k, j, i] = -1, 1
    np.testing.assert_allclose(jacobian, expected)


MOTIONS = {
    "steady": boundary.Steady((0.2, -0.1, 0.3), (0.5, 1.0, -0.7), (0.1, 0.2, 0.3), 0.1, 0.9),
    "key frames": boundary.KeyFrames(
        (0.0, 0.4, 1.0),
        [(0, 0, 0), (0.1, 0, 0.2), (0.1, 0.5, 0)],
        [(0, 0, 0), (0.3, 0, 0), (0.3, 0.8, -0.2)],
        (0.1, 0.0, 0.2),
    ),
    "steady 2-D": boundary.Steady((0.2, -0.1), 0.8, (0.1, 0.2)),
    "key frames 2-D": boundary.KeyFrames((0.0, 1.0), [(0, 0), (0.1, 0.2)], [0.0, 1.5]),
}


@double
@pytest.mark.parametrize("name", MOTIONS)
def test_velocity_is_the_rate_of_the_place(name):
    motion = MOTIONS[name]
    d = motion.pivot.shape[0]
    X = jnp.asarray(np.random.default_rng(1).normal(size=d))

    def place(t):
        return motion.rotation(t) @ (X - motion.pivot) + motion.pivot + motion.shift(t)

    for t in (0.15, 0.31, 0.55, 0.85):
        t = jnp.asarray(t)
        x = place(t)
        np.testing.assert_allclose(motion.at(t).to_rest(x), X, atol=1e-14)
        rate = (place(t + 1e-6) - place(t - 1e-6)) / 2e-6
        np.testing.assert_allclose(motion.at(t).velocity_at(x), rate, atol=1e-8)


@double
def test_motions_rest_outside_their_window():
    steady, frames = MOTIONS["steady"], MOTIONS["key frames"]
    x = jnp.asarray([1.0, 2.0, 3.0])
    for motion, before, after in ((steady, 0.05, 0.95), (frames, -0.1, 1.2)):
        for t in (before, after):
            np.testing.assert_allclose(motion.at(jnp.asarray(t)).velocity_at(x), 0, atol=1e-15)
        np.testing.assert_allclose(motion.at(jnp.asarray(before)).to_rest(x), x)
    np.testing.assert_allclose(steady.shift(jnp.asarray(2.0)), 0.8 * steady.linear)
    np.testing.assert_allclose(frames.shift(jnp.asarray(2.0)), frames.shifts[-1])
    # At the start itself it moves already: the first step belongs to the window.
    assert float(jnp.abs(steady.at(jnp.asarray(0.1)).velocity_at(x)).max()) > 0.1


@double
@pytest.mark.parametrize("name", [pytest.param("steady", marks=pytest.mark.slow), "steady 2-D"])
def test_steps_follow_a_steady_motion_to_rounding(name):
    """200 steps of 4 ms along a circle: no drift, where v = ω × r would spiral out by 0.1 %."""
    motion, dt = MOTIONS[name], jnp.asarray(0.004)
    x = jnp.asarray([0.7, -0.3, 0.5][: motion.pivot.shape[0]])
    start = 0.1
    X = motion.at(jnp.asarray(start)).to_rest(x)
    for k in range(200):
        v, _ = step_of(motion, x, jnp.asarray(start + 0.004 * k), dt)
        x = x + dt * v
    np.testing.assert_allclose(motion.at(jnp.asarray(0.9)).to_rest(x), X, atol=1e-13)


def test_bad_motions_are_refused():
    for make, words in (
        (lambda: boundary.Steady((1.0, 0.0, 0.0), 2.0), "`angular_velocity` must be a vector of 3"),
        (lambda: boundary.Steady((1.0,)), "`velocity` must be a vector of 2 or 3"),
        (lambda: boundary.Steady((1.0, np.nan)), "`velocity` must be finite"),
        (lambda: boundary.Steady((1.0, 0.0), start=1.0, end=0.5), "`end` must be after `start`"),
        (lambda: boundary.Steady((1.0, 0.0), start=-np.inf), "`start` must be finite"),
        (lambda: boundary.Steady((1.0, 0.0), end=np.ones(2)), "`end` must be one number, but has"),
        (lambda: boundary.KeyFrames((0.0,), [(0, 0)]), "`times` must be at least two increasing"),
        (lambda: boundary.KeyFrames((0, 0), [(0, 0), (1, 0)]), "`times` must be at least two"),
        (lambda: boundary.KeyFrames((0, 1), [(0, 0)]), "`shifts` must have shape"),
        (lambda: boundary.KeyFrames((0, 1), np.zeros((2, 3)), np.zeros(2)), "`turns` must give"),
        (lambda: boundary.Sphere((0, 0), 0.0), "`radius` must be positive"),
        (lambda: boundary.Cuboid((0, 0), (1, -1)), "`half_size` must be positive"),
        (lambda: boundary.Cylinder((0, 0), (1, 1), 1.0), "`start` must have shape"),
        (lambda: boundary.Capsule((0, 0), (0, 0), 1.0), "`end` must differ from `start`"),
        (lambda: boundary.SampledSDF((0, 0), 0.1, np.zeros((3, 2))), "`values` must have 2 axes"),
        (lambda: boundary.SampledSDF((0, 0), 0.1, np.full((3, 3), np.nan)), "must be finite"),
        (
            lambda: boundary.Collider(boundary.Sphere((0, 0), 1.0), surface_velocity=1.0),
            "`surface_velocity` must be a vector",
        ),
        (
            lambda: boundary.Collider(boundary.Sphere((0, 0), 1.0), start=np.zeros(3)),
            r"`start` must be one number, but has shape \(3,\)",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            make()


# --- Colliders -----------------------------------------------------------------------------------


@pytest.mark.slow
@double
def test_contact_is_relative_to_the_moving_body():
    """A node seen from a turning, moving body: the same contact as on the body at rest."""
    shape = SHAPES_3D["cuboid"]
    motion, t = MOTIONS["steady"], jnp.asarray(0.6)
    contact = boundary.Separating(0.3)
    rng = np.random.default_rng(3)
    X = jnp.asarray(rng.uniform([-0.2, -0.3, -0.4], [0.4, 0.3, 0.2], (50, 3)))
    V = jnp.asarray(rng.normal(size=(50, 3)))
    R = motion.rotation(t)
    for place, v in zip(X, V, strict=True):
        x = R @ (place - motion.pivot) + motion.pivot + motion.shift(t)
        wall = motion.at(t).velocity_at(x)
        at_rest = boundary.Collider(shape, contact)(place, v, t)
        moving = boundary.Collider(shape, contact, motion)(x, wall + R @ v, t)
        np.testing.assert_allclose(moving, wall + R @ at_rest, atol=1e-13)


def test_a_collider_exists_in_its_window_only():
    body = boundary.Collider(boundary.Sphere((0, 0), 1.0), boundary.Sticky(), start=1.0, end=2.0)
    v = jnp.asarray([0.5, 0.5])
    for t, held in ((0.0, False), (1.0, True), (1.9, True), (2.0, False)):
        got = body(jnp.asarray([0.1, 0.2]), v, jnp.asarray(t))
        np.testing.assert_array_equal(got, 0 * v if held else v)


@double
def test_sampled_distances_reproduce_quadratic_functions():
    """Spline coefficients are exact to second order, in value and normal; continued outside."""
    rng = np.random.default_rng(4)
    Q, b = rng.normal(size=(2, 2)), rng.normal(size=2)
    Q = Q + Q.T

    def f(x):
        return x @ Q @ x / 2 + b @ x

    nodes = np.stack(np.meshgrid(np.arange(9), np.arange(7), indexing="ij"), -1) * 0.25
    values = jax.vmap(jax.vmap(f))(jnp.asarray(nodes))
    shape = boundary.SampledSDF((0.0, 0.0), 0.25, values)
    x = jnp.asarray(rng.uniform([0.7, 0.7], [1.3, 0.8], (20, 2)))
    for point in x:
        np.testing.assert_allclose(shape.signed_distance(point), f(point), atol=1e-13)
        got = jax.grad(shape.signed_distance)(point)
        np.testing.assert_allclose(got, Q @ point + b, atol=1e-12)
    # All that is linear in the lattice was done when the shape was made.
    steps = jax.make_jaxpr(shape.signed_distance)(x[0]).eqns
    assert all(out.aval.size < values.size for step in steps for out in step.outvars)

    def distance(values):
        return boundary.SampledSDF((0.0, 0.0), 0.25, values).signed_distance(x[0])

    slope = jax.grad(distance)(values)
    np.testing.assert_allclose(jnp.sum(slope * values), f(x[0]), atol=1e-13)
    np.testing.assert_allclose(jnp.sum(slope), 1, rtol=1e-13)
    assert not hasattr(shape, "values")
    edge, out = jnp.asarray([1.875, 0.8]), jnp.asarray([2.875, 0.8])
    gap = shape.signed_distance(out) - shape.signed_distance(edge)
    np.testing.assert_allclose(gap, 1.0, rtol=1e-12)


# --- Windows of time -----------------------------------------------------------------------------


def some_held(window, t):
    """Whether a particle is led at time t."""
    start, end = window
    hold = boundary.ParticleMotion(jnp.ones(1, bool), resting(t.dtype), start, end)
    zero = jnp.zeros((1, 2), t.dtype)
    p = Particles(zero, zero, jnp.zeros((1, 2, 2), t.dtype), zero[:, 0] + 1, zero[:, 0] > 0)
    return hold(p, t, t).held[0]


def wall_acts(window, t):
    start, end = window
    body = boundary.Sphere(jnp.zeros(2, t.dtype), jnp.ones((), t.dtype))
    wall = boundary.Collider(body, boundary.Sticky(), start=start, end=end)
    return wall(jnp.full(2, 0.1, t.dtype), jnp.ones(2, t.dtype), t)[0] == 0


def steady_moves(window, t):
    start, end = window
    moving = boundary.Steady(jnp.ones(2, t.dtype), start=start, end=end)
    return moving.at(t).velocity[0] > 0


def key_frames_move(window, t):
    """Between the second and the third of four."""
    start, end = window
    one = jnp.ones((), t.dtype)
    shifts = jnp.zeros((4, 2), t.dtype).at[2:].set(1)
    path = boundary.KeyFrames(jnp.stack([start - one, start, end, end + one]), shifts)
    return path.at(t).velocity[0] > 0


def resting(dtype):
    zero = jnp.zeros((), dtype)
    return boundary.Steady(jnp.zeros(2, dtype), start=zero, end=zero + 1)


@pytest.mark.parametrize("precision", [jnp.float32, pytest.param(jnp.float64, marks=double)])
@pytest.mark.parametrize("acts", [some_held, wall_acts, steady_moves, key_frames_move])
def test_as_many_steps_act_as_fit_into_the_window(acts, precision):
    """Windows that end on frames, for many frame rates and time steps: not one step too long."""
    frames = np.array([1, 2, 3, 5, 7, 12, 24, 97])
    step = jnp.arange(98 * 33, dtype=jnp.int32).astype(precision)

    @jax.jit
    def counted(window, t):
        steps = jax.vmap(acts, in_axes=(None, 0))
        return jax.vmap(lambda *ends: jnp.sum(steps(ends, t)))(*window)

    for fps in (24, 25, 30, 60):
        for substeps in (1, 3, 5, 7, 10, 20, 33):
            window = [jnp.asarray(f / fps, precision) for f in (frames, frames + 1)]
            # As the step has it.
            t = step * jnp.asarray(1 / fps / substeps, precision)
            np.testing.assert_array_equal(counted(window, t), substeps)


@pytest.mark.parametrize("t", [0.0, 1e-30, 3.0])
def test_open_windows_have_no_edges(t):
    t, infinite = jnp.asarray(t), jnp.asarray(jnp.inf)
    assert bool(within(t, -infinite, infinite))
    assert not bool(within(t, infinite, infinite))
    assert bool(within(t, -infinite, t + 1))
    assert not bool(within(t, -infinite, t))
    assert bool(within(t, t, infinite))

    def moved(start, t):
        return boundary.Steady((1.0, 0.0), start=start).shift(t)[0]

    value, slopes = jax.value_and_grad(moved, argnums=(0, 1))(jnp.asarray(-1.0), t)
    np.testing.assert_allclose((value, *slopes), (t + 1, -1, 1), rtol=1e-6)
