"""Compositing as primitives of JAX: native kernels on a CPU, plain JAX elsewhere.

Three kernels give forward and reverse mode: `composite`, its tangent, linear in the tangents of
shape and values, and the adjoint, which transposes the tangent and is transposed by it. None of
them stores anything per pixel and splat. Derivatives of the last two with respect to the splats,
which second order needs, go through the plain functions.

Every operand has a leading batch axis of length 1 or that of the call, so that a batch is one
call, what its members share is never copied, and the tangents of one scene share its alphas.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from pgjax import native
from pgjax._types import Array, Float, Int
from pgjax.render import compositing

Arrays = tuple[Array, ...]
Shape = tuple[int, ...]

# Operands of all three that say what is drawn: limits, shape, values, key.
_SCENE = 4


def _composite(*scene: Array, **static: Any) -> Arrays:
    return compositing.composite(*scene, **static)


def _images(limits: Array, key: Array, **static: Any) -> Callable[[Array, Array], Arrays]:
    """The two images as a function of shape and values."""
    return lambda shape, values: _composite(limits, shape, values, key, **static)[:2]


def _tangent(limits, shape, values, key, dshape, dvalues, **static):
    images = _images(limits, key, **static)
    return jax.jvp(images, (shape, values), (dshape, dvalues))[1]


def _adjoint(limits, shape, values, key, gsums, gcover, **static):
    return jax.vjp(_images(limits, key, **static), shape, values)[1]((gsums, gcover))


def _batch_size(*shapes: Shape) -> int:
    sizes = {shape[0] for shape in shapes} - {1}
    return sizes.pop() if sizes else 1


def _one_by_one(one: Callable[..., Arrays]) -> Callable[..., Arrays]:
    """A plain function for operands with a batch axis of length 1 or n: a loop over the batch."""

    def many(*operands: Array, **static: Any) -> Arrays:
        """The results of each member, stacked."""
        if _batch_size(*(a.shape for a in operands)) == 1:
            return tuple(r[None] for r in one(*(a[0] for a in operands), **static))
        own = [a for a in operands if a.shape[0] != 1]

        def member(parts: list[Array]) -> Arrays:
            rest = iter(parts)
            return one(*(next(rest) if a.shape[0] != 1 else a[0] for a in operands), **static)

        return jax.lax.map(member, own)

    return many


def _image_shapes(*operands: Shape, width: int, height: int, **_: Any) -> list[Shape]:
    n, k = _batch_size(*operands), operands[2][-1]
    return [(n, height, width, k), (n, height, width)]


def _composite_shapes(*operands: Shape, **static: Any) -> list[Shape]:
    return [*_image_shapes(*operands, **static), (_batch_size(*operands),)]


def _splat_shapes(*operands: Shape, **_: Any) -> list[Shape]:
    n = _batch_size(*operands)
    return [(n, *operands[1][1:]), (n, *operands[2][1:])]


def _define(
    name: str, one: Callable[..., Arrays], results: Callable[..., list[Shape]]
) -> Primitive:
    """A primitive with its types, batching and lowering; a third result is a count."""
    primitive = Primitive(f"pgjax_{name}")
    primitive.multiple_results = True
    plain = _one_by_one(one)

    def types(*operands: ShapedArray, **static: Any) -> list[ShapedArray]:
        shapes = results(*(a.shape for a in operands), **static)
        found = [native.result_type(operands[0], shape) for shape in shapes]
        return found[:2] + [a.update(dtype=jnp.dtype(jnp.int32)) for a in found[2:]]

    def on_cpu(*operands: Array, **static: Any) -> Arrays:
        """The native kernel, or the plain function where there is none."""
        library = native.library("raster", jnp.dtype(operands[0].dtype).name)
        shapes = results(*(a.shape for a in operands), **static)
        # The kernels count splats in 32 bits.
        if library is None or operands[1].shape[1] >= 2**31:
            return plain(*operands, **static)
        dtypes = [operands[0].dtype, operands[0].dtype, jnp.dtype(jnp.int32)]
        returned = [
            jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in zip(shapes, dtypes, strict=False)
        ]
        return tuple(jax.ffi.ffi_call(library.targets[name], returned)(*operands))

    primitive.def_abstract_eval(types)
    primitive.def_impl(functools.partial(native.run, primitive))
    batching.primitive_batchers[primitive] = functools.partial(_batch, primitive)
    mlir.register_lowering(primitive, mlir.lower_fun(plain, multiple_results=True))
    mlir.register_lowering(primitive, mlir.lower_fun(on_cpu, multiple_results=True), platform="cpu")
    return primitive


def _batch(primitive: Primitive, operands: Arrays, axes: Any, **static: Any) -> Any:
    """A further batch axis, merged into the one there is."""
    moved = [
        a[None] if axis is None else jnp.moveaxis(a, axis, 0)
        for a, axis in zip(operands, axes, strict=True)
    ]
    n, inner = (_batch_size(*(a.shape[i:] for a in moved)) for i in (0, 1))

    def merged(a: Array) -> Array:
        if a.shape[:2] == (1, 1):
            return a[0]
        a = jnp.broadcast_to(a, (n, inner, *a.shape[2:]))
        return a.reshape(n * inner, *a.shape[2:])

    out = primitive.bind(*map(merged, moved), **static)
    return [o.reshape(n, inner, *o.shape[1:]) for o in out], [0] * len(out)


def _bind(primitive: Primitive, *operands: Array, **static: Any) -> list[Array]:
    return primitive.bind(*native.varying(*operands), **static)


composite_p = _define("composite", _composite, _composite_shapes)
tangent_p = _define("composite_tangent", _tangent, _image_shapes)
adjoint_p = _define("composite_adjoint", _adjoint, _splat_shapes)


def _instantiated(tangents: Any) -> list[Array]:
    return [ad.instantiate_zeros(t) for t in tangents]


def _composite_jvp(primals: Arrays, tangents: Any, **static: Any) -> Any:
    """Order, cutoff and the end of the rays are held fixed: key and limits have no tangents."""
    sums, cover, pairs = _bind(composite_p, *primals, **static)
    images = _bind(tangent_p, *primals, *_instantiated(tangents[1:3]), **static)
    return (sums, cover, pairs), (*images, ad.Zero(jax.typeof(pairs).to_tangent_aval()))


def _linear_jvp(primitive: Primitive, one: Callable[..., Arrays]) -> Callable[..., Any]:
    """Linear in the operands after the scene: if only they move, it is its own derivative."""

    def jvp(primals: Arrays, tangents: Any, **static: Any) -> Any:
        if all(isinstance(t, ad.Zero) for t in tangents[1:3]):
            out = _bind(primitive, *primals, **static)
            moved = (*primals[:_SCENE], *_instantiated(tangents[_SCENE:]))
            return out, _bind(primitive, *moved, **static)
        function = functools.partial(_one_by_one(one), **static)
        return jax.jvp(function, tuple(primals), tuple(_instantiated(tangents)))

    return jvp


def _transpose_to(primitive: Primitive) -> Callable[..., Any]:
    """Transposes a primitive, linear in the two operands after the scene, to the other one."""

    def transpose(cotangents: Any, *operands: Any, **static: Any) -> Any:
        scene, linear = operands[:_SCENE], operands[_SCENE:]
        bars = _bind(primitive, *scene, *_instantiated(cotangents), **static)
        return [None] * _SCENE + [_like(bar, to) for bar, to in zip(bars, linear, strict=True)]

    return transpose


def _like(cotangent: Array, operand: Any) -> Array | None:
    """The cotangent of a linear operand: summed over the batch where that shares the operand."""
    if not ad.is_undefined_primal(operand):
        return None
    if operand.aval.shape[0] < cotangent.shape[0]:
        return jnp.sum(cotangent, axis=0, keepdims=True)
    return cotangent


ad.primitive_jvps[composite_p] = _composite_jvp
ad.primitive_jvps[tangent_p] = _linear_jvp(tangent_p, _tangent)
ad.primitive_jvps[adjoint_p] = _linear_jvp(adjoint_p, _adjoint)
ad.primitive_transposes[tangent_p] = _transpose_to(adjoint_p)
ad.primitive_transposes[adjoint_p] = _transpose_to(tangent_p)


def composite(
    limits: Float[Array, "4"],
    shape: Float[Array, "n 6"],
    values: Float[Array, "n k"],
    key: Float[Array, " n"],
    *,
    width: int,
    height: int,
    capacity: int,
) -> tuple[Float[Array, "h w k"], Float[Array, "h w"], Int[Array, ""]]:
    """`compositing.composite`, as a primitive."""
    operands = (a[None] for a in (limits, shape, values, jax.lax.stop_gradient(key)))
    static = {"width": width, "height": height, "capacity": capacity}
    sums, cover, pairs = _bind(composite_p, *operands, **static)
    return sums[0], cover[0], pairs[0]
