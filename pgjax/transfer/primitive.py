"""The transfers as primitives of JAX: native kernels on a CPU, the reference elsewhere.

Five kernels give forward and reverse mode. `scatter` and `gather` are the derivatives of the form
Φ of `reference.py` with respect to the nodes and to the payload; `scatter_tangent` and
`gather_tangent` are their derivatives in forward mode, and `pull`, the derivative of Φ with
respect to positions and payload, is what transposes them. Derivatives of the last three, which
second order needs, go through the reference.

Every operand has a leading batch axis of length 1 or that of the call, so that a batch is one
call and what all its members share is never copied.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from pgjax import native
from pgjax._types import Array
from pgjax.transfer import reference

# Values of a node in the native kernels (`kChannels` in native/transfer.h).
CHANNELS = 4

Arrays = tuple[Array, ...]
Shape = tuple[int, ...]


def _scatter(xi, a, B, S, **static):
    return (reference.scatter(xi, a, B, S, **static),)


def _scatter_tangent(xi, a, B, S, dxi, da, dB, dS, **static):
    function = functools.partial(_scatter, **static)
    return jax.jvp(function, (xi, a, B, S), (dxi, da, dB, dS))[1]


def _gather(xi, g, **static):
    return reference.gather(xi, g, **static)


def _gather_tangent(xi, g, dxi, dg, **static):
    return jax.jvp(functools.partial(_gather, **static), (xi, g), (dxi, dg))[1]


def _pull(xi, a, B, S, g, *, degree):
    function = functools.partial(reference.scatter, degree=degree, nodes=g.shape[:-1])
    return jax.vjp(function, xi, a, B, S)[1](g)


def _batch_size(*shapes: Shape) -> int:
    return max(shape[0] for shape in shapes)


def _over_batch(one: Callable[..., Arrays]) -> Callable[..., Arrays]:
    """The reference for operands with a batch axis of length 1 or n."""

    def many(*operands: Array, **static: Any) -> Arrays:
        n = _batch_size(*(a.shape for a in operands))
        if n == 1:
            return tuple(r[None] for r in one(*(a[0] for a in operands), **static))
        axes = tuple(None if a.shape[0] == 1 else 0 for a in operands)
        operands = tuple(a[0] if a.shape[0] == 1 else a for a in operands)
        return jax.vmap(functools.partial(one, **static), in_axes=axes)(*operands)

    return many


def _nodes_shape(xi: Shape, a: Shape, *others: Shape, nodes: Shape, **_: Any) -> list[Shape]:
    return [(_batch_size(xi, a, *others), *nodes, a[-1])]


def _moment_shapes(
    xi: Shape, g: Shape, *others: Shape, graded: int, slope: bool, **_: Any
) -> list[Shape]:
    n, (p, d) = _batch_size(xi, g, *others), xi[1:]
    return [(n, p, g[-1]), (n, p, graded, d), (n, p, graded, d if slope else 0)]


def _pull_shapes(*operands: Shape, **_: Any) -> list[Shape]:
    n = _batch_size(*operands)
    return [(n, *shape[1:]) for shape in operands[:-1]]


def _define(
    name: str, one: Callable[..., Arrays], results: Callable[..., list[Shape]], kinds: str
) -> Primitive:
    """A primitive with its shapes, batching and lowering.

    `kinds`: of the operands, then of the results; x: positions, a: values per particle or node,
    B: gradients per particle.
    """
    primitive = Primitive(f"pgjax_{name}")
    primitive.multiple_results = True
    plain = _over_batch(one)
    kinds_in, kinds_out = kinds.split(" ")

    def on_cpu(*operands: Array, **static: Any) -> Arrays:
        """The native kernel, or the reference where there is none or it does not fit."""
        dtype, d = operands[0].dtype, operands[0].shape[-1]
        library = native.library("transfer", jnp.dtype(dtype).name, d)
        wanted = results(*(a.shape for a in operands), **static)
        channels = [a.shape[-1] for a, kind in zip(operands, kinds_in, strict=True) if kind == "a"]
        # The kernels count particles in 32 bits.
        unfit = max(channels) > CHANNELS or operands[0].shape[1] >= 2**31
        if library is None or unfit:
            return plain(*operands, **static)
        packed = map(_pack, operands, kinds_in)
        returned = [
            jax.ShapeDtypeStruct(_packed_shape(shape, kind), dtype)
            for shape, kind in zip(wanted, kinds_out, strict=True)
        ]
        out = jax.ffi.ffi_call(library.targets[name], returned)(
            *packed, degree=np.int64(static["degree"])
        )
        return tuple(map(_unpack, out, wanted, kinds_out))

    def shapes(*operands: ShapedArray, **static: Any) -> list[ShapedArray]:
        """Types of the results."""
        shapes = results(*(a.shape for a in operands), **static)
        return [native.result_type(operands[0], shape) for shape in shapes]

    primitive.def_abstract_eval(shapes)
    primitive.def_impl(functools.partial(native.run, primitive))
    batching.primitive_batchers[primitive] = functools.partial(_batch, primitive)
    mlir.register_lowering(primitive, mlir.lower_fun(plain, multiple_results=True))
    mlir.register_lowering(primitive, mlir.lower_fun(on_cpu, multiple_results=True), platform="cpu")
    return primitive


# In the kernels the channels are last and filled up to four: one vector register.


def _packed_shape(shape: Shape, kind: str) -> Shape:
    if kind == "x":
        return shape
    if kind == "a":
        return (*shape[:-1], CHANNELS)
    # An absent flux keeps a direction of length 0.
    return (*shape[:-2], shape[-1], CHANNELS if shape[-1] else 0)


def _pack(a: Array, kind: str) -> Array:
    if kind == "x":
        return a
    a = jnp.swapaxes(a, -1, -2) if kind == "B" else a
    return with_channels(a) if a.shape[-2] or kind == "a" else a[..., :0]


def with_channels(a: Array) -> Array:
    """Filled up to four channels."""
    return jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, CHANNELS - a.shape[-1])])


def _unpack(a: Array, shape: Shape, kind: str) -> Array:
    if kind == "B":
        return jnp.swapaxes(a[..., : shape[-2]], -1, -2) if shape[-1] else a.reshape(shape)
    return a[..., : shape[-1]]


def _batch(primitive: Primitive, operands: Arrays, axes: Any, **static: Any) -> Any:
    """A further batch axis, merged into the one there is."""
    pairs = zip(operands, axes, strict=True)
    moved = [a if axis is None else jnp.moveaxis(a, axis, 0) for a, axis in pairs]
    n = next(a.shape[0] for a, axis in zip(moved, axes, strict=True) if axis is not None)
    inner = max(a.shape[0 if axis is None else 1] for a, axis in zip(moved, axes, strict=True))

    def merged(a: Array, axis: int | None) -> Array:
        if axis is None:
            if a.shape[0] == 1:
                return a
            a = a[None]
        a = jnp.broadcast_to(a, (n, inner, *a.shape[2:]))
        # Not by -1, which a last axis of length 0 leaves open.
        return a.reshape(a.shape[0] * a.shape[1], *a.shape[2:])

    if n * inner == 0:
        one = functools.partial(primitive.bind, **static)
        single = (
            a[:1] if axis is None else jnp.zeros_like(a, shape=(1, *a.shape[2:]))
            for a, axis in zip(moved, axes, strict=True)
        )
        shapes = jax.eval_shape(one, *single)
        return [jnp.zeros((n, inner, *s.shape[1:]), s.dtype) for s in shapes], [0] * len(shapes)
    out = primitive.bind(*map(merged, moved, axes), **static)
    return [o.reshape(n, o.shape[0] // n, *o.shape[1:]) for o in out], [0] * len(out)


def _bind(primitive: Primitive, *operands: Array, **static: Any) -> list[Array]:
    return primitive.bind(*native.varying(*operands), **static)


scatter_p = _define("scatter", _scatter, _nodes_shape, "xaBB a")
scatter_tangent_p = _define("scatter_tangent", _scatter_tangent, _nodes_shape, "xaBBxaBB a")
gather_p = _define("gather", _gather, _moment_shapes, "xa aBB")
gather_tangent_p = _define("gather_tangent", _gather_tangent, _moment_shapes, "xaxa aBB")
pull_p = _define("pull", _pull, _pull_shapes, "xaBBa xaBB")


def _instantiated(tangents: Any) -> list[Array]:
    return [ad.instantiate_zeros(t) for t in tangents]


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, ad.Zero)


def _scatter_jvp(primals: Arrays, tangents: Any, **static: Any) -> Any:
    out = _bind(scatter_p, *primals, **static)
    dxi, *payload = tangents
    if _is_zero(dxi):
        return out, _bind(scatter_p, primals[0], *_instantiated(payload), **static)
    return out, _bind(scatter_tangent_p, *primals, *_instantiated(tangents), **static)


def _gather_jvp(primals: Arrays, tangents: Any, **static: Any) -> Any:
    out = _bind(gather_p, *primals, **static)
    dxi, dg = tangents
    if _is_zero(dxi):
        return out, _bind(gather_p, primals[0], ad.instantiate_zeros(dg), **static)
    return out, _bind(gather_tangent_p, *primals, *_instantiated(tangents), **static)


def _reference_jvp(one: Callable[..., Arrays]) -> Callable[..., Any]:
    def jvp(primals: Arrays, tangents: Any, **static: Any) -> Any:
        function = functools.partial(_over_batch(one), **static)
        return jax.jvp(function, tuple(primals), tuple(_instantiated(tangents)))

    return jvp


ad.primitive_jvps[scatter_p] = _scatter_jvp
ad.primitive_jvps[gather_p] = _gather_jvp
ad.primitive_jvps[pull_p] = _reference_jvp(_pull)


def _tangent_jvp(
    primitive: Primitive, linear: int, one: Callable[..., Arrays]
) -> Callable[..., Any]:
    """Linear in its last operands: if only they move, the primitive itself is its derivative."""

    def jvp(primals: Arrays, tangents: Any, **static: Any) -> Any:
        fixed = len(primals) - linear
        if all(_is_zero(t) for t in tangents[:fixed]):
            out = _bind(primitive, *primals, **static)
            moved = (*primals[:fixed], *_instantiated(tangents[fixed:]))
            return out, _bind(primitive, *moved, **static)
        return _reference_jvp(one)(primals, tangents, **static)

    return jvp


ad.primitive_jvps[scatter_tangent_p] = _tangent_jvp(scatter_tangent_p, 4, _scatter_tangent)
ad.primitive_jvps[gather_tangent_p] = _tangent_jvp(gather_tangent_p, 2, _gather_tangent)


def _like(cotangents: Arrays, operands: Any) -> list[Array | None]:
    """Cotangents of the linear operands: summed over the batch where it shares the operand."""
    return [
        (jnp.sum(ct, axis=0, keepdims=True) if _shape(o)[0] < ct.shape[0] else ct)
        if ad.is_undefined_primal(o)
        else None
        for ct, o in zip(cotangents, operands, strict=True)
    ]


def _shape(operand: Any) -> tuple[int, ...]:
    return operand.aval.shape if ad.is_undefined_primal(operand) else operand.shape


def _scatter_transpose(cts: Any, xi: Array, a: Any, B: Any, S: Any, **static: Any) -> Any:
    slope, graded = _shape(S)[-1] > 0, _shape(B)[-2]
    g = ad.instantiate_zeros(cts[0])
    bars = _bind(gather_p, xi, g, degree=static["degree"], graded=graded, slope=slope)
    return [None, *_like(tuple(bars), (a, B, S))]


def _gather_transpose(cts: Any, xi: Array, g: Any, *, degree: int, **_: Any) -> Any:
    payload = [ad.instantiate_zeros(ct) for ct in cts]
    bar = _bind(scatter_p, xi, *payload, degree=degree, nodes=g.aval.shape[1:-1])
    return [None, *_like(tuple(bar), (g,))]


def _scatter_tangent_transpose(
    cts: Any, xi: Array, a: Array, B: Array, S: Array, *tangents: Any, degree: int, **_: Any
) -> Any:
    bars = _bind(pull_p, xi, a, B, S, ad.instantiate_zeros(cts[0]), degree=degree)
    return [None] * 4 + _like(tuple(bars), tangents)


def _gather_tangent_transpose(
    cts: Any, xi: Array, g: Array, *tangents: Any, degree: int, **_: Any
) -> Any:
    payload = [ad.instantiate_zeros(ct) for ct in cts]
    dxi = _bind(pull_p, xi, *payload, g, degree=degree)[0]
    dg = _bind(scatter_p, xi, *payload, degree=degree, nodes=g.shape[1:-1])[0]
    return [None, None, *_like((dxi, dg), tangents)]


ad.primitive_transposes[scatter_p] = _scatter_transpose
ad.primitive_transposes[gather_p] = _gather_transpose
ad.primitive_transposes[scatter_tangent_p] = _scatter_tangent_transpose
ad.primitive_transposes[gather_tangent_p] = _gather_tangent_transpose


def _promoted(*operands: Array) -> list[Array]:
    """All in the highest precision of any."""
    dtype = functools.reduce(jnp.promote_types, (a.dtype for a in operands))
    return [a.astype(dtype) for a in operands]


def scatter(
    xi: Array, a: Array, B: Array, S: Array, *, degree: int, nodes: tuple[int, ...]
) -> Array:
    """`reference.scatter`, as a primitive."""
    operands = (m[None] for m in (xi, a, B, S))
    return _bind(scatter_p, *operands, degree=degree, nodes=nodes)[0][0]


def gather(xi: Array, g: Array, *, degree: int, graded: int, slope: bool) -> Arrays:
    """`reference.gather`, as a primitive."""
    out = _bind(gather_p, xi[None], g[None], degree=degree, graded=graded, slope=slope)
    return tuple(o[0] for o in out)
