"""The transfers as primitives: native and reference agree under every transformation of JAX."""

import functools
import itertools
import os
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pgjax import native
from pgjax.transfer import primitive, reference

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="no C++ compiler")

FLOAT32 = not jax.config.jax_enable_x64
DTYPE = jnp.float32 if FLOAT32 else jnp.float64
# Relative to the sum of the magnitudes of what is added.
TOLERANCE = 1e-6 if FLOAT32 else 1e-13

KINDS = pytest.mark.parametrize(
    ("d", "degree", "slope"),
    list(itertools.product((2, 3), (2, 3), (True, False))),
    ids=lambda v: {True: "flux", False: "mls"}[v] if isinstance(v, bool) else str(v),
)


@pytest.fixture(scope="module", autouse=True)
def native_kernels():
    """Also where the rest of the suite runs without them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PGJAX_NATIVE", "1")
        jax.clear_caches()
        for d in (2, 3):
            assert native.library("transfer", jnp.dtype(DTYPE).name, d) is not None
        yield


class Case:
    """Random particles, payload and nodes, and the functions of one implementation."""

    def __init__(self, d, degree, slope, particles=60, batch=()):
        self.rng = np.random.default_rng([d, degree, slope])
        self.d, self.degree, self.slope, self.nodes = d, degree, slope, (11, 10, 12)[:d]
        c = d + 1
        xi = self.rng.uniform(0, 5, (*batch, particles, d))
        # On nodes and on faces of cells too.
        xi[..., :10, :] = np.round(2 * xi[..., :10, :]) / 2
        self.xi = jnp.asarray(xi, DTYPE)
        self.payload = (
            self.normal(*batch, particles, c),
            self.normal(*batch, particles, d, d),
            self.normal(*batch, particles, d, d if slope else 0),
        )
        self.g = self.normal(*batch, *self.nodes, c)

    def normal(self, *shape):
        return jnp.asarray(self.rng.normal(size=shape), DTYPE)

    def like(self, tree):
        return jax.tree.map(lambda a: self.normal(*a.shape), tree)

    def scatter(self, of):
        return functools.partial(of.scatter, degree=self.degree, nodes=self.nodes)

    def gather(self, of):
        return functools.partial(of.gather, degree=self.degree, graded=self.d, slope=self.slope)


def compare(function, *arguments):
    """`function(implementation)` of both: equal, relative to the largest entry."""
    got = jax.jit(function(primitive))(*arguments)
    expected = jax.jit(function(reference))(*arguments)
    for a, b in zip(*map(jax.tree.leaves, (got, expected)), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        if a.size:
            assert jnp.max(jnp.abs(a - b)) <= TOLERANCE * jnp.max(jnp.abs(b))


def parts_of(payload):
    """The payload as a list of payloads with one column each, stacked."""
    a, B, S = payload
    zero = tuple(map(jnp.zeros_like, payload))
    parts = [(a, *zero[1:])]
    for k, m in ((1, B), (2, S)):
        for j in range(m.shape[-1]):
            column = jnp.zeros_like(m).at[..., j].set(m[..., j])
            parts.append(tuple(column if i == k else z for i, z in enumerate(zero)))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)


@KINDS
def test_error_of_every_node(d, degree, slope):
    """At most TOLERANCE of the sum of the magnitudes of the terms of the node."""
    case = Case(d, degree, slope)

    def one(xi, *payload):
        return case.scatter(reference)(xi[None], *(m[None] for m in payload))

    @jax.jit
    def both(xi, payload):
        terms = jax.vmap(jax.vmap(one), in_axes=(None, 0, 0, 0))(xi, *parts_of(payload))
        nodes = [case.scatter(of)(xi, *payload) for of in (primitive, reference)]
        return *nodes, jnp.sum(jnp.abs(terms), axis=(0, 1))

    got, expected, magnitude = both(case.xi, case.payload)
    assert jnp.all(jnp.abs(got - expected) <= TOLERANCE * magnitude)
    assert jnp.any(magnitude == 0)  # nodes that no particle reaches


@pytest.mark.parametrize(
    ("d", "degree", "slope"),
    [
        (2, 3, False),
        (3, 2, True),
        pytest.param(2, 2, True, marks=pytest.mark.slow),
        pytest.param(3, 3, False, marks=pytest.mark.slow),
    ],
)
def test_forward_and_reverse_mode(d, degree, slope):
    case = Case(d, degree, slope)
    sent, received = (case.xi, *case.payload), (case.xi, case.g)
    tangents = case.like((sent, received))
    weights = case.like((case.g, case.payload))

    def everything(of):
        def both(sent, received, tangents, weights):
            return [
                (
                    jax.jvp(function(of), primals, moved),
                    jax.vjp(function(of), *primals)[1](out),
                )
                for function, primals, moved, out in (
                    (case.scatter, sent, tangents[0], weights[0]),
                    (case.gather, received, tangents[1], weights[1]),
                )
            ]

        return both

    compare(everything, sent, received, tangents, weights)


@KINDS
def test_derivatives_with_respect_to_one_argument(d, degree, slope):
    """What stands still has no derivative: those along one argument at a time add up."""
    case = Case(d, degree, slope)
    for function, primals, weights in (
        (case.scatter(primitive), (case.xi, *case.payload), case.g),
        (case.gather(primitive), (case.xi, case.g), case.payload),
    ):
        weights, tangents = case.like(weights), case.like(primals)

        def each(primals, tangents, weights, function=function):
            """Forward and reverse along one argument, and along all."""
            forward, reverse = [], []
            for i, a in enumerate(primals):

                def moved(a, i=i):
                    return function(*primals[:i], a, *primals[i + 1 :])

                forward.append(jax.jvp(moved, (a,), (tangents[i],))[1])
                reverse.append(jax.vjp(moved, a)[1](weights)[0])
            together = jax.jvp(function, primals, tangents)[1]
            return forward, together, tuple(reverse), jax.vjp(function, *primals)[1](weights)

        forward, together, reverse, all_at_once = jax.jit(each)(primals, tangents, weights)
        added = jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), *forward)
        for one, other in ((added, together), (reverse, all_at_once)):
            for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
                assert np.allclose(a, b, rtol=0, atol=4 * TOLERANCE * np.max(np.abs(b), initial=0))


def energy(case, of):
    """A scalar of both transfers in a row, whose derivative is not linear in anything."""

    def one(xi, a, B, S, g):
        nodes = case.scatter(of)(xi, a, B, S)
        back = case.gather(of)(xi, jnp.sin(nodes) * g)
        return sum(jnp.sum(b * b) for b in back)

    return one


@pytest.mark.slow
def test_batches():
    """vmap of each operand alone or all together, nested, of gradients, under gradients."""
    case, n = Case(3, 2, True), 3
    many = Case(3, 2, True, batch=(n,))
    single = (case.xi, *case.payload, case.g)
    batched = (many.xi, *many.payload, many.g)
    for mask in ((1, 0, 0, 0, 0), (0, 1, 0, 0, 1), (1, 1, 1, 1, 1)):
        axes = tuple(0 if m else None for m in mask)
        arguments = tuple(b if m else a for a, b, m in zip(single, batched, mask, strict=True))

        def run(of, axes=axes):
            return jax.vmap(jax.grad(energy(case, of), argnums=(0, 1, 2, 3, 4)), in_axes=axes)

        compare(run, *arguments)

    def total(of):
        one = energy(case, of)
        return jax.grad(lambda *a: jnp.sum(jax.vmap(one)(*a)), argnums=(0, 2))

    compare(total, *batched)

    def nested(of):
        inner = jax.vmap(case.scatter(of), in_axes=(None, 0, None, None))
        return jax.vmap(inner, in_axes=(0, None, 0, None))

    compare(nested, many.xi, many.payload[0], many.payload[1], case.payload[2])


def test_empty_batch():
    case = Case(2, 2, True)

    def run(of):
        return jax.vmap(jax.grad(energy(case, of)), in_axes=(0, None, None, None, None))

    compare(run, case.xi[None][:0], *case.payload, case.g)


def test_tangents_share_their_primal():
    """vmap of forward mode over a few tangents, the primal not copied."""
    case = Case(3, 2, True)
    primals = (case.xi, *case.payload)
    tangents = case.like(jax.tree.map(lambda a: jnp.stack([a] * 4), primals))

    def push(of):
        return lambda tangents: jax.vmap(lambda t: jax.jvp(case.scatter(of), primals, t)[1])(
            tangents
        )

    compare(push, tangents)
    text = jax.jit(push(primitive)).lower(tangents).as_text()
    assert f"tensor<1x{case.xi.shape[0]}x3x" in text  # positions, once


@pytest.mark.slow
@pytest.mark.float64
def test_second_order_and_rematerialisation():
    case = Case(2, 3, True, particles=8)
    arguments = (case.xi, *case.payload, case.g)
    for mode in (
        lambda f: jax.jacfwd(jax.grad(f)),
        lambda f: jax.jacrev(jax.grad(f)),
        lambda f: jax.grad(lambda *a: jax.jvp(lambda x: f(x, *a[1:]), (a[0],), (a[0] * 2,))[1]),
        lambda f: jax.grad(jax.checkpoint(f)),
        jax.jacfwd,
    ):
        compare(lambda of, mode=mode: mode(energy(case, of)), *arguments)

    def rolled(of):
        def step(xi, _):
            moved = case.gather(of)(xi, case.scatter(of)(xi, *case.payload))[0]
            return jnp.clip(xi + 0.01 * moved[:, :2], 0, 6), None

        return jax.grad(
            lambda xi: jnp.sum(jax.lax.scan(jax.checkpoint(step), xi, length=5)[0] ** 2)
        )

    compare(rolled, case.xi)


def test_outside_of_jit():
    case = Case(2, 2, True)
    got = case.scatter(primitive)(case.xi, *case.payload)
    expected = jax.jit(case.scatter(reference))(case.xi, *case.payload)
    assert jnp.max(jnp.abs(got - expected)) <= 10 * TOLERANCE * jnp.max(jnp.abs(expected))


SHARDED = """
    import functools
    import jax, jax.numpy as jnp, numpy as np
    from jax.sharding import AxisType, PartitionSpec as P
    from pgjax.transfer import primitive, reference

    rng = np.random.default_rng(0)
    xi = jnp.asarray(rng.uniform(0, 5, (4, 50, 3)), jnp.float32)
    a, B = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in ((50, 4), (4, 50, 3, 3)))
    mesh = jax.make_mesh((2,), ("b",), axis_types=(AxisType.Auto,))

    def loss(of, xi, a, B):
        one = lambda xi, B: of.scatter(xi, a, B, B, degree=2, nodes=(10, 11, 12))
        return jnp.sum(jax.vmap(one)(xi, B) ** 2, axis=(1, 2, 3, 4))

    specs = (P("b"), P(), P("b"))
    sharded = jax.shard_map(
        functools.partial(loss, primitive), mesh=mesh, in_specs=specs, out_specs=P("b")
    )
    got = jax.jit(jax.grad(lambda *x: sharded(*x).sum(), (0, 1, 2)))(xi, a, B)
    expected = jax.jit(jax.grad(lambda *x: loss(reference, *x).sum(), (0, 1, 2)))(xi, a, B)
    for one, other in zip(got, expected):
        assert jnp.max(jnp.abs(one - other)) < 2e-6 * jnp.max(jnp.abs(other))

    def shared_grid(xi, B):
        nodes = primitive.scatter(xi, a[:25], B, B, degree=2, nodes=(10, 11, 12))
        return jax.lax.psum(nodes, "b")

    both = jax.shard_map(shared_grid, mesh=mesh, in_specs=(P("b"), P("b")), out_specs=P())
    got = jax.jit(both)(xi[0], B[0])
    twice = jnp.concatenate([a[:25], a[:25]])
    alone = functools.partial(reference.scatter, degree=2, nodes=(10, 11, 12))
    expected = jax.jit(alone)(xi[0], twice, B[0], B[0])
    assert jnp.max(jnp.abs(got - expected)) < 2e-6 * jnp.max(jnp.abs(expected))
    print("equal")
"""


def test_sharded_over_devices(tmp_path):
    """Batches and particles over two devices, also the gradient of what both share."""
    script = tmp_path / "sharded.py"
    script.write_text(textwrap.dedent(SHARDED))
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    run = in_process(script, **flags)
    assert run.stdout.strip().endswith("equal"), run.stderr[-2000:]


def in_process(script, **variables):
    """Run a script in a Python of its own."""
    return subprocess.run(
        [sys.executable, str(script)],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
    )
