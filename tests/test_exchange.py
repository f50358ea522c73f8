"""The two halves of a step as native kernels against the same in JAX, and their derivatives."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
from pgjax import boundary, fused, models, native
from pgjax.exchange import Receiver, Sender

pytestmark = pytest.mark.skipif(not native.available(), reason="there are no native kernels")

N = 41
DOUBLE = jax.config.jax_enable_x64
NODES = {2: (11, 12), 3: (11, 12, 13)}
EPS = float(jnp.finfo(jnp.zeros(()).dtype).eps)


def floats(a):
    return jnp.asarray(a, jnp.zeros(()).dtype)


def sender(d, *, seed=0, plastic=False):
    """Particles of every kind: masked, outside, not finite, inverted, crushed, at rest."""
    rng = np.random.default_rng(seed)
    He = 0.3 * rng.normal(size=(N, 3, 3))
    He[:6] = 0
    He[6] = np.diag([-1.5, 0, 0])
    He[7] = np.diag([-0.97, -0.9, 0.1])
    xi = rng.uniform(1, 6, (N, d))
    v, C = rng.normal(size=(N, d)), rng.normal(size=(N, d, d))
    v[9, 0], C[10, 1, 0], He[11, 2, 1] = np.nan, np.inf, np.nan
    H = 0.2 * rng.normal(size=(N, 3, 3))[:, : 3 if plastic else 0]
    alive, inside = np.ones(N, bool), np.ones(N, bool)
    alive[12:14], inside[14] = False, False
    mass, volume = rng.uniform(1, 2, N), rng.uniform(0.5, 1, N)
    operands = (xi, xi / 8, mass, volume, v, C, He, H)
    return Sender(jnp.asarray(alive), jnp.asarray(inside), *map(floats, operands))


def receiver(d, *, seed=0, plastic=False):
    s = sender(d, seed=seed, plastic=plastic)
    rng = np.random.default_rng(seed + 1)
    nodes = rng.normal(size=(*NODES[d], d + 1))
    finite = np.ones(N, bool)
    finite[9:12] = False
    held = rng.uniform(size=N) < 0.2
    return Receiver(
        alive=s.alive & finite & s.inside,
        finite=jnp.asarray(finite),
        held=jnp.asarray(held),
        xi=s.xi,
        nodes=floats(nodes),
        position=s.position,
        v=s.v,
        C=s.C,
        He=s.He,
        H=s.H,
    )


def parameters(count, *, each, seed=3):
    rng = np.random.default_rng(seed)
    return [floats(rng.uniform(1, 2, N if each else 1)) for _ in range(count)]


def close(actual, expected, tolerance):
    """All arrays, each relative to its largest entry."""
    for a, b in zip(actual, expected, strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        a, b = np.asarray(a), np.asarray(b)
        if a.dtype.kind in "bi":
            np.testing.assert_array_equal(a, b)
        elif a.size:
            np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(np.abs(b).max(), 1e-30))


def floating(out):
    return [o for o in out if jnp.issubdtype(o.dtype, jnp.floating)]


def pulled(function, masks, operands, seed=5):
    """Cotangents of the floating operands for random ones of the results."""
    fixed, floats_ = operands[:masks], operands[masks:]
    out, pull = jax.vjp(lambda *a: floating(function(*fixed, *a)), *floats_)
    rng = np.random.default_rng(seed)
    return pull([floats(rng.normal(size=o.shape)) for o in out])


def moved(function, masks, operands, seed=9):
    """Tangents of the floating results along random ones of the operands."""
    rng = np.random.default_rng(seed)
    along = tuple(floats(rng.normal(size=a.shape)) for a in operands[masks:])
    fixed = operands[:masks]
    return jax.jvp(lambda *a: floating(function(*fixed, *a)), operands[masks:], along)[1]


SENDERS = [
    (law, d, degree, mls)
    for law in ("neo_hookean", "fixed_corotated", "stvk_hencky")
    for d in (2, 3)
    for degree, mls in (
        ((2, True), (3, False)) if law != "stvk_hencky" else ((2, False), (3, True))
    )
]
MAPS = ("elastic", "von_mises", "drucker_prager", "drucker_prager_corrected")
# Degree and scheme: each pair with each law and dimension, but not all of all.
RECEIVERS = [
    (m, d, degree, mls)
    for i, m in enumerate(MAPS)
    for d in (2, 3)
    for degree, mls in (((2, True), (3, False)) if i % 2 else ((2, False), (3, True)))
]


def some(cases):
    """The plane with one scheme, space with the other; the rest is slow."""
    return [c if (c[1] == 3) == c[3] else pytest.param(*c, marks=pytest.mark.slow) for c in cases]


def send_case(law, d, degree, mls, each):
    operands = (*sender(d, plastic=each), *parameters(2, each=each), floats([0.1, 0.5, 0.3]))
    static = {"law": law, "degree": degree, "nodes": NODES[d], "mls": mls, "whole": True}
    return operands, static


def receive_case(mapping, d, degree, mls, each):
    given = {"elastic": 0, "von_mises": 2}.get(mapping, 3)
    scale = [0.2, 1.0] if given == 2 else [0.3, 0.05, 0.2]
    values = [s * p for s, p in zip(scale, parameters(given, each=each), strict=False)]
    values += [floats([])] * (3 - given)
    p = receiver(d, plastic=given > 0)
    operands = (*p, *values, floats([0.1, 0.5, (degree + 1) / 12, 0.7]))
    return operands, {"mapping": mapping, "degree": degree, "mls": mls}


@pytest.mark.parametrize(("law", "d", "degree", "mls"), some(SENDERS))
def test_send_is_what_it_says(law, d, degree, mls):
    # Parameters of each particle, or of all, with every law in two and three dimensions.
    operands, static = send_case(law, d, degree, mls, each=(d == 2) == mls)
    native_one = functools.partial(fused._send, **static)
    plain = functools.partial(fused._send_plain, **static)
    close(native_one(*operands), jax.jit(plain)(*operands), 100 * EPS)
    if DOUBLE:
        close(pulled(native_one, 2, operands), pulled(plain, 2, operands), 1e-9)
        close(moved(native_one, 2, operands), moved(plain, 2, operands), 1e-9)


@pytest.mark.parametrize(("mapping", "d", "degree", "mls"), some(RECEIVERS))
def test_receive_is_what_it_says(mapping, d, degree, mls):
    # Parameters of each particle, or of all, with every map in two and three dimensions.
    operands, static = receive_case(mapping, d, degree, mls, each=(d == 2) == mls)
    native_one = functools.partial(fused._receive, **static)
    plain = functools.partial(fused._receive_plain, **static)
    close(native_one(*operands), jax.jit(plain)(*operands), 300 * EPS)
    if DOUBLE:
        close(pulled(native_one, 3, operands), pulled(plain, 3, operands), 1e-9)
        close(moved(native_one, 3, operands), moved(plain, 3, operands), 1e-9)


CONTACTS = ("none", "sticky", "slip", "separating")


def grid_case(contact, d, seed=7):
    """Nodes of a box with empty ones, at rest ones and a friction that stops some of them."""
    rng = np.random.default_rng(seed)
    nodes = rng.normal(size=(*NODES[d], d + 1))
    nodes[..., -1] = np.abs(nodes[..., -1]) * (rng.uniform(size=NODES[d]) < 0.8)
    nodes[1, 1, ..., :-1] = 0
    behind = [np.zeros(n, np.int8) for n in NODES[d]]
    if contact != "none":
        for side in behind:
            side[:3], side[-2:] = -1, 1
    sides = [jnp.asarray(b) for b in behind] + [jnp.zeros(0, jnp.int8)] * (3 - d)
    numbers = [0.9, *rng.normal(size=d)]
    everywhere = jnp.zeros(0, jnp.int32)
    operands = (*sides, everywhere, floats(nodes), floats(numbers), floats([0.4]))
    return operands, {"contact": contact}


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("contact", CONTACTS)
def test_velocities_are_what_they_say(contact, d):
    operands, static = grid_case(contact, d)
    native_one = functools.partial(fused._velocities, **static)
    plain = functools.partial(fused._velocities_plain, **static)
    close(native_one(*operands), jax.jit(plain)(*operands), 100 * EPS)
    close(pulled(native_one, 4, operands), pulled(plain, 4, operands), 1000 * EPS)
    close(moved(native_one, 4, operands), moved(plain, 4, operands), 1000 * EPS)


def scene_of(d, mapping=None):
    """A scene whose steps are native, and a moving state that meets two walls."""
    h, n = 0.1, 4**d
    x = np.stack(np.meshgrid(*[np.arange(4) * h / 2 + 0.22] * d, indexing="ij"), -1).reshape(-1, d)
    law = models.StVKHencky(1e4, 0.3) if mapping else models.NeoHookean(1e4, 0.3)
    box = boundary.Box((0.2,) * d, (0.8,) * d, boundary.Separating(0.3))
    grid = pgjax.Grid((0.0,) * d, (10,) * d, h)
    scene = pgjax.Scene(
        grid, models.Material(law, mapping), np.full(n, (h / 2) ** d), boundaries=[box]
    )
    rng = np.random.default_rng(0)
    return scene, pgjax.initial_state(scene, x, 0.3 * rng.normal(size=(n, d)) - 0.5)


@pytest.mark.slow
@pytest.mark.float64
@pytest.mark.parametrize(
    "mapping", [pytest.param(None, marks=pytest.mark.slow), models.DruckerPrager(30.0)]
)
def test_every_transformation_of_a_rollout(mapping):
    """Nested batches, both modes and both of one another, checkpoints: as one by one."""
    scene, state = scene_of(3, mapping)

    def final(v0, E):
        own = eqx.tree_at(lambda s: s.materials[0].elasticity.E, scene, E)
        moving = eqx.tree_at(lambda s: s.v, state, state.v + v0[None])
        return pgjax.simulate(own, moving, dt=1e-3, frames=1, substeps=3, throw=False).final.x[
            :5, 0
        ]

    def energy(v0, E):
        return jnp.sum(jax.checkpoint(final)(v0, E) ** 2)

    v0s = floats([[0.0, 0, 0], [0.1, -0.2, 0.3]])
    Es = floats([1e4, 2e4])
    both = jax.jit(jax.vmap(jax.vmap(final, (None, 0)), (0, None)))(v0s, Es)
    slopes = jax.vmap(jax.vmap(jax.grad(energy, argnums=(0, 1)), (None, 0)), (0, None))(v0s, Es)
    total = jax.grad(lambda v, e: jnp.sum(jax.vmap(energy, (None, 0))(v, e)), argnums=(0, 1))
    for i, v0 in enumerate(v0s):
        for k, E in enumerate(Es):
            close([both[i, k]], [final(v0, E)], 1e-12)
            one = jax.grad(energy, argnums=(0, 1))(v0, E)
            close([slopes[0][i, k], slopes[1][i, k]], one, 1e-10)
        by_v, by_E = total(v0, Es)
        close([by_v, by_E], [slopes[0][i].sum(0), slopes[1][i]], 1e-10)
    forward, reverse = (j(final, argnums=(0, 1))(v0s[1], Es[0]) for j in (jax.jacfwd, jax.jacrev))
    close(forward, reverse, 1e-10)
    if mapping is not None:
        return  # Spectral functions have first derivatives only.
    # A derivative of a derivative goes through the same functions in JAX.
    hessian = jax.jacfwd(jax.grad(energy))(v0s[1], Es[0])
    h = 1e-5
    for axis in range(3):
        step = h * jnp.eye(3)[axis]
        ahead, behind = (jax.grad(energy)(v0s[1] + s * step, Es[0]) for s in (1, -1))
        close([hessian[axis]], [(ahead - behind) / (2 * h)], 1e-5)


def test_inside_shard_map():
    """Particles in a shard: the grid of a shard, and its derivative."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("b",))
    P = jax.sharding.PartitionSpec
    operands, static = send_case("neo_hookean", 2, 2, True, False)
    *own, mu, lam, numbers = operands

    def total(mu, *own):
        grid = fused._send(*own, mu, lam, numbers, **static)[0]
        return jax.lax.psum(jnp.sum(grid**2), "b")

    sharded = jax.shard_map(total, mesh=mesh, in_specs=(P(), *[P("b")] * len(own)), out_specs=P())
    plain = jnp.sum(fused._send(*operands, **static)[0] ** 2)
    np.testing.assert_allclose(sharded(mu, *own), plain, rtol=1e-5)
    slope = jax.grad(lambda mu: jnp.sum(fused._send(*own, mu, lam, numbers, **static)[0] ** 2))(mu)
    np.testing.assert_allclose(jax.grad(sharded)(mu, *own), slope, rtol=1e-4)
