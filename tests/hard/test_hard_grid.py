"""Hard places on the grid: nodes without mass, faces and edges, far from the origin, odd shapes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
from hard.bodies import (
    MATERIALS,
    H,
    N,
    block,
    every_material,
    is_finite,
    largest,
    momentum,
    motion,
    run,
    slopes,
    tolerance,
    world,
)
from pgjax import boundary
from pgjax.result import Condition
from pgjax.step import followed_step

GRAVITY = (0.0, -9.8)
SCHEMES = {
    "quadratic-grad": (2, pgjax.SplineGradient()),
    "quadratic-mls": (2, pgjax.MLS()),
    "cubic-grad": (3, pgjax.SplineGradient()),
    "cubic-mls": (3, pgjax.MLS()),
}

followed = eqx.filter_jit(followed_step)


def scattered(name, **kwargs):
    """36 particles in 16 places of their own, three cells apart, with a velocity; in a scene."""
    place = np.stack(np.meshgrid(*[np.arange(1, 12, 3)] * 2, indexing="ij"), -1).reshape(-1, 2)
    x = (place[np.arange(36) % 16] + 0.5) * kwargs.pop("h", H)
    scene = world(name, x, **kwargs)
    return scene, pgjax.initial_state(scene, x, (0.3, -0.2))


# --- Mass of nodes --------------------------------------------------------------------------------


@every_material
def test_h15_nodes_without_mass(name, holds):
    """They rest under gravity too, and no derivative is NaN."""
    scene, state = scattered(name, gravity=GRAVITY)
    dt = pgjax.stable_dt(scene)
    moved = np.asarray(followed(scene, state, dt).moved)
    empty = moved[..., -1] == 0
    assert 50 < empty.sum() < empty.size - 50
    assert (moved[empty] == 0).all()
    assert (moved[~empty, 0] != 0).all()
    value, derivatives = slopes(scene, state, dt)
    assert is_finite(value, derivatives)
    holds("H15", material=name)


@every_material
def test_h16_nodes_with_a_tiny_mass(name, holds):
    """Particles some last bits beside a face, h = 1 mm: nodes down to 1e-30 of the mass move too.

    No threshold: where the mass is not zero the velocity is that of the particles, and an
    internal force, however large against that mass, changes no momentum.
    """
    h = 1e-3
    material = eqx.tree_at(lambda m: m.density, MATERIALS[name], jnp.asarray(70.0))
    grid = pgjax.Grid((0.0, 0.0), (N, N), h)
    scene, state = scattered(material, h=h, grid=grid, volumes=np.full(36, 0.25 * h**2))
    ulp = jnp.finfo(state.dtype).eps
    beside = 1 + ulp * (np.arange(72).reshape(36, 2) % 9 - 4)
    state = eqx.tree_at(lambda s: s.position, state, state.position * beside.astype(state.dtype))
    dt = pgjax.stable_dt(scene)
    moved = np.asarray(followed(scene, state, dt).moved)
    mass, v = moved[..., -1], moved[..., :2]
    full = mass > 0
    assert mass[full].min() < tolerance(1e-28, 1e-12) * mass.max()
    assert largest(v) <= 0.3 * (1 + 8 * float(ulp))
    normal = mass > jnp.finfo(state.dtype).tiny / ulp
    assert largest(v[normal] - [0.3, -0.2]) < tolerance(1e-14, 1e-6)
    strained = eqx.tree_at(lambda s: s.He, state, state.He.at[:, 0, 1].set(0.01))
    end = run(scene, strained, dt, 20)
    before = momentum(scene, state)
    assert largest(momentum(scene, end) - before) < tolerance(1e-12, 1e-5) * largest(before)
    for start in (state, strained):
        assert is_finite(slopes(scene, start, dt))
    holds("H16", material=name)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 3])
def test_h16_in_space(degree, holds):
    """A corner node has the cube of the smallest weight: below what the precision holds."""
    h = 1e-3
    scene = pgjax.Scene(
        pgjax.Grid((0.0, 0.0, 0.0), (8, 8, 8), h),
        eqx.tree_at(lambda m: m.density, MATERIALS["NeoHookean"], jnp.asarray(70.0)),
        np.full(9, (h / 2) ** 3),
        spline=pgjax.BSpline(degree),
    )
    v = (0.3, -0.2, 0.1)
    state = pgjax.initial_state(scene, np.full((9, 3), (3.5 if degree == 2 else 4) * h), v)
    ulp = jnp.finfo(state.dtype).eps
    beside = (1 + ulp * (np.arange(9) - 4))[:, None].astype(state.dtype)
    state = eqx.tree_at(lambda s: s.position, state, state.position * beside)
    moved = np.asarray(followed(scene, state, 1e-4).moved)
    assert largest(moved[..., :3]) <= 0.3 * (1 + 8 * float(ulp))
    assert is_finite(slopes(scene, state, 1e-4))
    holds("H16", material="NeoHookean")


# --- Places ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_h17_on_nodes_and_faces(d, scheme, holds):
    """A step from a node, a face or beside them: equal up to the difference of the places.

    The weights and their slopes are continuous, so three steps are as well.
    """
    degree, gradient = SCHEMES[scheme]
    rng = np.random.default_rng(d)
    x = rng.uniform(0.4, 0.7, (8, d))
    scene = pgjax.Scene(
        pgjax.Grid(np.zeros(d), (10,) * d, H),
        MATERIALS["NeoHookean"],
        np.full(8, 0.5 * H**d),
        spline=pgjax.BSpline(degree),
        scheme=gradient,
    )
    F = np.eye(3) + 0.05 * rng.normal(size=(8, 3, 3))
    C = rng.normal(size=(8, d, d))
    state = pgjax.initial_state(scene, x, rng.normal(size=(8, d)), C=C, F=F)
    # In the precision of the state: xi = x/h is then a node or a face, or beside it.
    at = np.array([0.5, 0.55, 0.6], state.dtype)
    beside = np.stack([np.nextafter(at, at.dtype.type(0)), at, np.nextafter(at, at.dtype.type(1))])

    def after(position):
        moved = eqx.tree_at(lambda s: s.position, state, state.position.at[0].set(position))
        end = jax.lax.fori_loop(0, 3, lambda _, s: pgjax.step(scene, s, 1e-3), moved)
        return motion(end)

    places = jnp.broadcast_to(beside.reshape(9, 1), (9, d))
    for values in jax.jit(jax.vmap(after))(places):
        below, here, above = np.asarray(values).reshape(3, 3, -1)
        gap = max(largest(below - here), largest(above - here))
        assert gap < tolerance(1e-12, 1e-4) * max(1.0, largest(here))
    holds("H17", material="NeoHookean")


@pytest.mark.parametrize("degree", [2, 3])
def test_h18_on_the_edge_of_the_grid(degree, holds):
    """At the edge, in a corner and up to a cell beyond: as in the middle; then it is said."""
    x = block()
    scene = world("NeoHookean", x, walls=None, spline=pgjax.BSpline(degree))
    F = np.tile(np.diag([1.02, 0.99, 1]), (36, 1, 1))
    dt = pgjax.stable_dt(scene)
    half = 0.5 * 5 * 0.5 * H
    inside = [0.55, half, N * H - half, half - 0.5 * H, N * H - half + 0.5 * H]

    def moved(center):
        at = pgjax.initial_state(scene, x, F=F)
        shift = (jnp.asarray(center, at.dtype) - 0.55)[None, :]
        return run(scene, eqx.tree_at(lambda s: s.position, at, at.position + shift), dt, 5)

    middle = moved((0.55, 0.55))
    for center in [(a, b) for a in inside for b in inside]:
        end = moved(center)
        assert bool(end.status.ok)
        assert largest(end.v) < 10 * largest(middle.v)
    # Whole cells away the motion is the same to rounding.
    for center in ((0.55 - 4 * H, 0.55), (0.55 + 5 * H, 0.55 - 4 * H)):
        end = moved(center)
        assert bool(end.status.ok)
        for a, b in zip(motion(middle)[1:], motion(end)[1:], strict=True):
            assert largest(b - a) < tolerance(1e-12, 1e-4) * max(1, largest(a))
    beyond = moved((half - 1.6 * H, 0.55))
    assert int(beyond.status.first[Condition.OUT_OF_DOMAIN]) == 0
    assert 0 < int(beyond.status.count[Condition.OUT_OF_DOMAIN]) < 36
    assert is_finite(beyond)
    holds("H18", outcome="status: OUT_OF_DOMAIN", material="NeoHookean")


# --- Far from the origin --------------------------------------------------------------------------


def landing(name, origin, dtype=None, h=H):
    """A block thrown on a floor that passes through nodes, on a grid with this origin."""
    origin = np.asarray(origin, np.float64)
    x = block(center=(0.55, 0.43)) * (h / H) + origin
    low, high = origin + np.array([-9.0, 2 * h]), origin + 9.0
    walls = boundary.Box(low, high, boundary.Separating(0.3))
    scene = world(
        name,
        x,
        walls=walls,
        grid=pgjax.Grid(origin, (N, N), h),
        volumes=np.full(36, 0.25 * h**2),
        gravity=GRAVITY,
    )
    return scene, pgjax.initial_state(scene, x, (0.5, -1.0), dtype=dtype)


@every_material
@pytest.mark.parametrize("origin", [(-0.7, -3.1), (-12.8, 5.3)], ids=str)
def test_h20_negative_coordinates(name, origin, holds):
    """The grid's origin is anywhere: the same motion, relative to it."""
    (scene, here), (shifted, there) = landing(name, (0.0, 0.0)), landing(name, origin)
    dt = pgjax.stable_dt(scene)
    here, there = run(scene, here, dt, 40), run(shifted, there, dt, 40)
    assert largest(here.He) > 1e-3
    for a, b in zip(motion(here), motion(there), strict=True):
        assert largest(b - a) < tolerance(1e-12, 1e-4) * max(1, largest(a))
    holds("H20", material=name)


@every_material
@pytest.mark.parametrize("cells", [1e2, 1e3, 1e4])
def test_h30_far_from_the_origin_in_single_precision(name, cells, holds):
    """1 m to 100 m away at h = 1 cm: positions are relative to the grid, so nothing is lost."""
    h, dtype = 0.01, np.float32
    scene, here = landing(name, (0.0, 0.0), dtype, h)
    dt = pgjax.stable_dt(scene)
    here = run(scene, here, dt, 40)
    shifted, there = landing(name, (cells * h, -cells * h), dtype, h)
    there = run(shifted, there, dt, 40)
    assert here.dtype == there.dtype == dtype
    assert largest(here.He) > 1e-3
    assert largest(there.position - here.position) < 1e-5
    assert largest(there.v - here.v) < 1e-3
    holds("H30", material=name, precision="float32")


# --- Shapes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "shape", [(8, 64), (64, 8), (8, 64, 16), (9, 8, 31)], ids=lambda s: "x".join(map(str, s))
)
def test_h33_boxes_that_are_no_cubes(shape, holds):
    """A body moves as on the smallest cube, whatever lies around it."""
    d = len(shape)
    x = np.random.default_rng(3).uniform(0.3, 0.5, (20, d))
    v = np.random.default_rng(4).normal(size=(20, d))
    ends = []
    for cells in (shape, (8,) * d):
        grid = pgjax.Grid(np.zeros(d), cells, H)
        scene = pgjax.Scene(grid, MATERIALS["NeoHookean"], np.full(20, 0.1 * H**d))
        ends.append(run(scene, pgjax.initial_state(scene, x, v), 1e-3, 20))
    for a, b in zip(*map(motion, ends), strict=True):
        assert largest(b - a) < tolerance(1e-12, 1e-5) * max(1, largest(a))
    holds("H33", material="NeoHookean")


@pytest.mark.parametrize("cells", [1, 2, 3])
def test_h33_few_cells_in_a_periodic_direction(cells, holds):
    """As many copies of them side by side move alike: 1, 2 or 3 cells, against 6."""
    rng = np.random.default_rng(5)
    one = np.stack([rng.uniform(0, cells * H, 12), rng.uniform(0.4, 0.6, 12)], 1)
    v, C = rng.normal(size=(12, 2)), rng.normal(size=(12, 2, 2))
    ends = []
    for copies in (1, 6 // cells):
        x = np.concatenate([one + np.array([k * cells * H, 0]) for k in range(copies)])
        grid = pgjax.Grid((0.0, 0.0), (copies * cells, 10), H, periodic=(True, False))
        scene = pgjax.Scene(grid, MATERIALS["NeoHookean"], np.full(len(x), 0.2 * H**2))
        moving = {"v": np.tile(v, (copies, 1)), "C": np.tile(C, (copies, 1, 1))}
        ends.append(run(scene, pgjax.initial_state(scene, x, **moving), 1e-3, 20))
    few, many = ends
    assert bool(many.alive.all())
    for a, b in zip(motion(few), motion(many), strict=True):
        assert largest(b[:12] - a) < tolerance(1e-12, 1e-4) * max(1, largest(a))
    holds("H33", material="NeoHookean")


def test_h33_spacing_that_does_not_divide_the_box(holds):
    """A floor between nodes acts at the first node below it, wherever that is."""
    x = block()
    for floor in (0.2, 0.2 + 0.3 * H, 0.2 + 0.999 * H):
        walls = boundary.Box((-9.0, floor), (9.0, 9.0), boundary.Separating())
        scene = world("NeoHookean", x, walls=walls, gravity=GRAVITY, grid_damping=20.0)
        state = pgjax.initial_state(scene, x)
        end = run(scene, state, pgjax.stable_dt(scene), 600)
        assert bool(end.status.ok)
        bottom = float(end.x[:, 1].min())
        node = np.floor(floor / H + 1e-6) * H
        assert node - 0.1 * H < bottom < node + H
    holds("H33", material="NeoHookean")


@pytest.mark.parametrize("shape", [(1291,) * 3, (2**21,) * 3, (2**31, 8), (2**40, 2**40)], ids=str)
def test_h34_more_nodes_than_an_index_counts(shape, holds):
    with pytest.raises(ValueError, match=r"`shape` must give fewer than 2\^29 nodes"):
        pgjax.Grid(np.zeros(len(shape)), shape, 0.1)
    holds("H34", outcome="refused")
