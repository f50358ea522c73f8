"""Functions of whole arrays as primitives: a native kernel on a CPU, plain JAX elsewhere.

The plain function is the reference, and its derivative in forward mode is the derivative. Reverse
mode may have a kernel of its own (`pull`), which the derivative in forward mode is transposed to.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from pgjax import native
from pgjax._types import Array

Arrays = tuple[Array, ...]
# From the operands and the types of the results; None where there is no kernel.
Kernel = Callable[..., Arrays | None]


def stage(
    name: str,
    plain: Callable[..., Arrays],
    rank: int,
    kernel: Kernel,
    *,
    masks: int = 0,
    batched: bool = False,
    tangent: Kernel | None = None,
    pull: Kernel | None = None,
) -> Callable[..., Arrays]:
    """A function that runs as a native kernel where there is one.

    Args:
        name: of the primitive.
        plain: the same in JAX, `(*operands, **static) -> results`.
        rank: number of axes of the first operand; further leading ones are those of a batch.
        kernel: `(operands, types of the results, **static) -> results`, all with one batch axis
            if any.
        masks: how many of the operands, the first ones, are not floating.
        batched: whether the kernel needs a batch axis, be it of length 1.
        tangent: the same for `(*operands, *tangents of the floating ones) -> tangents`.
        pull: the same for `(*operands, *cotangents) -> cotangents of the floating operands`.
    """
    forward = _primitive(name, plain, rank, kernel, batched)
    if pull is None:
        ad.primitive_jvps[forward] = _plain_jvp(plain, rank)
    else:
        ad.primitive_jvps[forward] = _linear_jvp(name, forward, plain, rank, masks, tangent, pull)

    def call(*operands: Array, **static: Any) -> Arrays:
        floats = operands[masks:]
        dtype = functools.reduce(jnp.promote_types, (a.dtype for a in floats))
        same = (*operands[:masks], *(a.astype(dtype) for a in floats))
        return tuple(forward.bind(*native.varying(*same), **static))

    return call


def _over_batch(plain: Callable[..., Arrays], rank: int) -> Callable[..., Arrays]:
    """The plain function over any leading axes."""

    def over_all(*operands: Array, **static: Any) -> Arrays:
        one = functools.partial(plain, **static)
        for _ in range(operands[0].ndim - rank):
            one = jax.vmap(one)
        return one(*operands)

    return over_all


def _primitive(
    name: str,
    plain: Callable[..., Arrays],
    rank: int,
    kernel: Kernel | None,
    batched: bool = False,
) -> Primitive:
    primitive = Primitive(f"pgjax_{name}")
    primitive.multiple_results = True
    over_all = _over_batch(plain, rank)

    def on_cpu(*operands: Array, **static: Any) -> Arrays:
        """The native kernel, or the plain function where there is none."""
        assert kernel is not None
        lead = operands[0].ndim - rank
        wanted = jax.eval_shape(functools.partial(over_all, **static), *operands)
        if lead == 0 and not batched:
            # Without a reshape, of which XLA would make a copy.
            out = kernel(list(operands), list(wanted), **static)
        else:
            n = math.prod(operands[0].shape[:lead])
            flat = [a.reshape(n, *a.shape[lead:]) for a in operands]
            types = [jax.ShapeDtypeStruct((n, *s.shape[lead:]), s.dtype) for s in wanted]
            out = kernel(flat, types, **static)
        if out is None:
            return over_all(*operands, **static)
        return tuple(o.reshape(s.shape) for o, s in zip(out, wanted, strict=True))

    def types(*operands: ShapedArray, **static: Any) -> list[ShapedArray]:
        one = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in operands]
        results = jax.eval_shape(functools.partial(over_all, **static), *one)
        return [native.result_type(operands[0], s.shape).update(dtype=s.dtype) for s in results]

    def batch(operands: Arrays, axes: Any, **static: Any) -> tuple[list[Array], list[int]]:
        out = primitive.bind(*_spread(operands, axes), **static)
        return out, [0] * len(out)

    primitive.def_impl(functools.partial(native.run, primitive))
    primitive.def_abstract_eval(types)
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(over_all, multiple_results=True))
    if kernel is not None:
        lowering = mlir.lower_fun(on_cpu, multiple_results=True)
        mlir.register_lowering(primitive, lowering, platform="cpu")
    return primitive


def _spread(operands: Arrays, axes: Any) -> list[Array]:
    """All operands with the batch axis in front."""
    pairs = list(zip(operands, axes, strict=True))
    size = next(a.shape[i] for a, i in pairs if i is not None)
    return [
        jnp.broadcast_to(a, (size, *a.shape)) if i is None else jnp.moveaxis(a, i, 0)
        for a, i in pairs
    ]


def _plain_jvp(plain: Callable[..., Arrays], rank: int) -> Callable[..., Any]:
    over_all = _over_batch(plain, rank)

    def jvp(primals: Arrays, tangents: Any, **static: Any) -> tuple[Arrays, Arrays]:
        moved = tuple(map(ad.instantiate_zeros, tangents))
        return jax.jvp(functools.partial(over_all, **static), tuple(primals), moved)

    return jvp


def _floating(arrays: Arrays) -> Arrays:
    return tuple(a for a in arrays if jnp.issubdtype(a.dtype, jnp.floating))


def _linear_jvp(
    name: str,
    forward: Primitive,
    plain: Callable[..., Arrays],
    rank: int,
    masks: int,
    tangent_kernel: Kernel | None,
    pull_kernel: Kernel,
) -> Callable[..., Any]:
    """The derivative as a primitive that is linear in the tangents, and its transpose."""

    def floats_of(fixed: Arrays, **static: Any) -> Callable[..., Arrays]:
        return lambda *floats: _floating(plain(*fixed, *floats, **static))

    def count(operands: Sequence[Any]) -> int:
        """Operands of the function itself: the rest are tangents or cotangents."""
        return masks + (len(operands) - masks) // 2

    def along(*operands: Array, **static: Any) -> Arrays:
        n = count(operands)
        function = floats_of(operands[:masks], **static)
        return jax.jvp(function, operands[masks:n], operands[n:])[1]

    def pulled(*operands: Array, count: int, **static: Any) -> Arrays:
        function = floats_of(operands[:masks], **static)
        return jax.vjp(function, *operands[masks:count])[1](operands[count:])

    tangent = _primitive(f"{name}_tangent", along, rank, tangent_kernel)
    adjoint = _primitive(f"{name}_pull", pulled, rank, pull_kernel)
    ad.primitive_jvps[adjoint] = _plain_jvp(pulled, rank)
    along_all = _over_batch(along, rank)

    def jvp(primals: Arrays, tangents: Any, **static: Any) -> tuple[list[Array], list[Any]]:
        out = forward.bind(*primals, **static)
        moved = map(ad.instantiate_zeros, tangents[masks:])
        dots = iter(tangent.bind(*native.varying(*primals, *moved), **static))
        floating = [jnp.issubdtype(o.dtype, jnp.floating) for o in out]
        zeros = (ad.Zero(jax.typeof(o).to_tangent_aval()) for o in out)
        return out, [next(dots) if f else z for f, z in zip(floating, zeros, strict=True)]

    def tangent_jvp(operands: Arrays, tangents: Any, **static: Any) -> Any:
        n = count(operands)
        if all(isinstance(t, ad.Zero) for t in tangents[:n]):
            moved = map(ad.instantiate_zeros, tangents[n:])
            again = tangent.bind(*native.varying(*operands[:n], *moved), **static)
            return tangent.bind(*operands, **static), again
        return _plain_jvp(along, rank)(operands, tangents, **static)

    def transpose(cts: Any, *operands: Any, **static: Any) -> list[Any]:
        n = count(operands)
        filled = map(ad.instantiate_zeros, cts)
        bars = adjoint.bind(*native.varying(*operands[:n], *filled), count=n, **static)
        wanted = map(ad.is_undefined_primal, operands[n:])
        return [None] * n + [b if w else None for b, w in zip(bars, wanted, strict=True)]

    def batch(operands: Arrays, axes: Any, **static: Any) -> tuple[Arrays, list[int]]:
        """What the tangents share is computed once."""
        out = jax.vmap(functools.partial(along_all, **static), in_axes=tuple(axes))(*operands)
        return out, [0] * len(out)

    ad.primitive_jvps[tangent] = tangent_jvp
    ad.primitive_transposes[tangent] = transpose
    if tangent_kernel is None:
        batching.primitive_batchers[tangent] = batch
    return jvp
