"""A mostly empty grid: passes that keep to the nodes with mass change nothing but the time."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
from pgjax import boundary, fused, models, native, sampling

pytestmark = pytest.mark.skipif(not native.available(), reason="needs native kernels")

# `pgjax.step` is the function.
steps = sys.modules["pgjax.step"]

WALLS = {
    "none": None,
    "slip": boundary.Slip(),
    "friction": boundary.Separating(0.4),
}
MATERIALS = {
    "neo-Hookean": models.Material(models.NeoHookean(1e4, 0.3)),
    "sand": models.Material(models.StVKHencky(1e4, 0.3), models.DruckerPrager(30.0)),
    # Not a law of the native passes.
    "dev/vol": models.Material(models.DevVolNeoHookean(1e4, 0.3)),
}


def scene_of(material, walls, d=3):
    """A block that falls on the floor, in the corner of a large grid."""
    h, cells = 0.1, 24 if d == 3 else 40
    x, volumes = sampling.block((0.35,) * d, (0.65,) * d, spacing=h / 2)
    contact = WALLS[walls]
    floor = [] if contact is None else [boundary.Box((0.3,) * d, (2.0,) * d, contact)]
    grid = pgjax.Grid((0.0,) * d, (cells,) * d, h)
    gravity = np.eye(d)[-1] * -9.8
    scene = pgjax.Scene(grid, material, volumes, gravity=gravity, boundaries=floor)
    v = np.broadcast_to(np.linspace(0.5, -0.5, d), (len(x), d))
    return scene, pgjax.initial_state(scene, x, v)


def whole_and_part(monkeypatch, run):
    """The result with all nodes, and that with those that have mass."""
    part = run()
    monkeypatch.setattr(steps, "_EMPTY", 1e9)
    jax.clear_caches()
    whole = run()
    return whole, part


@pytest.mark.parametrize(
    ("name", "walls"),
    [
        ("sand", "friction"),
        pytest.param("neo-Hookean", "none", marks=pytest.mark.slow),
        pytest.param("dev/vol", "slip", marks=pytest.mark.slow),
    ],
)
def test_the_motion_is_the_same(monkeypatch, name, walls):
    scene, state = scene_of(MATERIALS[name], walls)
    dt = pgjax.stable_dt(scene, state)
    assert steps.leaves_nodes_out(scene)

    def run():
        return pgjax.simulate(scene, state, dt=dt, frames=2, substeps=20).saved

    whole, part = whole_and_part(monkeypatch, run)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(part.x[0], part.x[-1])


@pytest.mark.slow
@pytest.mark.float64
def test_derivatives_and_batches_are_the_same(monkeypatch):
    scene, state = scene_of(MATERIALS["sand"], "friction")
    dt = pgjax.stable_dt(scene, state) / 2

    def loss(numbers):
        E, gravity, friction = numbers
        changed = eqx.tree_at(
            lambda s: (s.materials[0].elasticity.E, s.gravity, s.boundaries[0].contact.friction),
            scene,
            (E, gravity, friction),
        )
        run = pgjax.simulate(changed, state, dt=dt, frames=1, substeps=20)
        return jnp.sum(run.saved.x[-1] ** 2)

    start = (jnp.asarray(1e4), scene.gravity, jnp.asarray(0.4))
    along = jax.tree.map(jnp.ones_like, start)

    def run():
        batch = jax.tree.map(lambda a: jnp.stack([a, 1.1 * a]), start)
        return jax.jvp(loss, (start,), (along,))[1], jax.vmap(jax.grad(loss))(batch)

    whole, part = whole_and_part(monkeypatch, run)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10)
    assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(part))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("batch", [(), (3,)])
def test_whatever_is_outside_is_never_read(d, batch):
    """NaN there reaches neither the nodes inside nor the derivatives of the numbers."""
    shape, random = (6, 7, 9)[:d], np.random.default_rng(0)
    nodes = random.normal(size=(*batch, *shape, d + 1))
    nodes[..., -1] = np.maximum(nodes[..., -1], 0)
    box = jnp.asarray([1, 2, 0][:d] + [4, 7, 5][:d], jnp.int32)
    inside = tuple(slice(int(a), int(b)) for a, b in zip(box[:d], box[d:], strict=True))
    mask = np.zeros((*shape, 1), bool)
    mask[inside] = True
    sides = [jnp.asarray([-1] + [0] * (n - 3) + [1, 1], jnp.int8) for n in shape]
    kept, gained = jnp.asarray(0.9), jnp.asarray(random.normal(size=d))

    def inner(nodes, kept, gained, friction):
        walls = boundary.Separating(friction), sides
        moved = fused.velocities(nodes, kept, gained, walls, box)
        return jnp.where(mask, moved, 0)

    def both(nodes):
        nodes = jnp.asarray(nodes)
        one = jax.vmap(inner, in_axes=(0, None, None, None)) if batch else inner
        numbers = kept, gained, jnp.asarray(0.3, nodes.dtype)

        def total(*numbers):
            return jnp.sum(one(nodes, *numbers) ** 2)

        return one(nodes, *numbers), jax.grad(total, argnums=(0, 1, 2))(*numbers)

    clean = both(np.where(mask, nodes, 0))
    spoiled = both(np.where(mask, nodes, np.nan))
    for a, b in zip(jax.tree.leaves(clean), jax.tree.leaves(spoiled), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.any(np.asarray(clean[1][1]))
