"""Conditions in slabs, where there is mass: the same as everywhere on the grid."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

import pgjax
from pgjax import boundary, models, sampling
from pgjax.boundary import nodes

pytestmark = pytest.mark.float64


def scene_and_state(d, periodic=False):
    """A block that lies on the floor of a box, against a turning body, near a user's condition."""
    h = 1 / 40
    x, volumes = sampling.block((0.15,) * d, (0.3,) * d, h / 2)
    body = (boundary.Sphere((0.3,) * d, 0.06), boundary.Separating(0.4))
    motion = boundary.Steady(pivot=(0.3,) * d, velocity=(-0.5,) * d)
    walls = (
        boundary.Box((0.15,) * d, (0.8,) * d, boundary.Separating(0.3)),
        boundary.Collider(*body, motion),
        lambda x, v, t: jnp.where(x[0] > 0.28, v * (1 - t), v),
    )
    scene = pgjax.Scene(
        pgjax.Grid((0,) * d, (40,) * d, h, periodic=(False,) * (d - 1) + (periodic,)),
        models.Material(models.NeoHookean(1e5, 0.3)),
        volumes,
        gravity=(0,) * (d - 1) + (-9.81,),
        boundaries=walls,
    )
    v = np.random.default_rng(0).normal(size=x.shape)
    return scene, pgjax.initial_state(scene, x, v)


def after(scene, state, v):
    """Velocities after a step from velocities v."""
    return pgjax.step(scene, pgjax.initial_state(scene, state.x, v), 2e-4).v


@pytest.mark.parametrize(
    ("d", "periodic"), [pytest.param(3, True, marks=pytest.mark.slow), (2, False)]
)
def test_slabs_change_nothing(monkeypatch, d, periodic):
    """Velocities and derivatives are those of one sweep over all nodes."""
    scene, state = scene_and_state(d, periodic)
    weight = jnp.asarray(np.random.default_rng(1).normal(size=state.v.shape))

    def loss(v):
        v = after(scene, state, v)
        return jnp.vdot(v, weight), v

    def both():
        jax.clear_caches()
        (_, v), bar = jax.jit(jax.value_and_grad(loss, has_aux=True))(state.v)
        return v, bar

    v, bar = both()
    assert float(jnp.abs(v - state.v).max()) > 0.1  # The walls act.
    monkeypatch.setattr(nodes, "branches", lambda: False)
    everywhere, bar_everywhere = both()
    np.testing.assert_allclose(v, everywhere, rtol=0, atol=1e-13)
    np.testing.assert_allclose(bar, bar_everywhere, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_batch_of_worlds_in_different_places():
    """Under `vmap` a branch becomes a selection: each member as alone."""
    scene, state = scene_and_state(3)
    moved = jnp.stack([state.x, state.x + 0.3])

    def one(x):
        start = pgjax.initial_state(scene, x, state.v)
        return pgjax.step(scene, start, 2e-4).v

    together = jax.jit(jax.vmap(one))(moved)
    alone = jnp.stack([jax.jit(one)(x) for x in moved])
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_inside_shard_map():
    """A step of each member of a sharded batch, and the derivative through it."""
    scene, state = scene_and_state(3)
    mesh = Mesh(np.array(jax.devices()[:1]), ("b",))
    one = jax.vmap(lambda v: after(scene, state, v))
    sharded = jax.shard_map(one, mesh=mesh, in_specs=P("b"), out_specs=P("b"))

    def loss(run, v):
        return jnp.sum(run(v[None]) ** 2)

    value, bar = jax.jit(jax.value_and_grad(functools.partial(loss, sharded)))(state.v)
    expected, bar_expected = jax.jit(jax.value_and_grad(functools.partial(loss, one)))(state.v)
    np.testing.assert_allclose(value, expected, rtol=1e-13)
    np.testing.assert_allclose(bar, bar_expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("shape", [(69, 69, 69), (69, 30), (2053, 3), (64, 5, 5)])
def test_slabs_divide_the_grid(shape):
    layers = nodes._layers(shape)
    assert shape[0] % layers == 0
    assert layers == shape[0] or layers * np.prod(shape[1:]) >= nodes._SMALLEST_SLAB
