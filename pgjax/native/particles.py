"""Functions of one particle as primitives: a native kernel over many, plain JAX elsewhere.

The plain function is the reference: it also has the derivatives.
"""

import functools
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


def per_particle(
    name: str, source: str, plain: Callable[..., Arrays], ranks: Sequence[int]
) -> Callable[..., Arrays]:
    """A function of one particle that `vmap` turns into one call of a native kernel.

    Args:
        name: of the kernel, `pgjax_<name>` in the C++ source.
        source: of the kernel (a key of `native.HANDLERS`).
        plain: the same in JAX, `(*operands) -> tuple` of floating arrays.
        ranks: of its operands.
    """
    primitive = Primitive(f"pgjax_{name}")
    primitive.multiple_results = True

    def over_all(*operands: Array) -> Arrays:
        """The plain function over any leading axes."""
        one = plain
        for _ in range(operands[0].ndim - ranks[0]):
            one = jax.vmap(one)
        return one(*operands)

    def on_cpu(*operands: Array) -> Arrays:
        """The native kernel, or the plain function where there is none."""
        library = native.library(source, jnp.dtype(operands[0].dtype).name)
        if library is None:
            return over_all(*operands)
        flat = [a.reshape(-1, *a.shape[a.ndim - n :]) for a, n in zip(operands, ranks, strict=True)]
        wanted = jax.eval_shape(over_all, *operands)
        lead = operands[0].ndim - ranks[0]
        returned = [jax.ShapeDtypeStruct((len(flat[0]), *s.shape[lead:]), s.dtype) for s in wanted]
        out = jax.ffi.ffi_call(library.targets[name], returned)(*flat)
        return tuple(o.reshape(s.shape) for o, s in zip(out, wanted, strict=True))

    def shapes(*operands: ShapedArray) -> list[ShapedArray]:
        one = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in operands]
        results = jax.eval_shape(over_all, *one)
        return [native.result_type(operands[0], s.shape) for s in results]

    def batch(operands: Arrays, axes: tuple[int | None, ...]) -> tuple[list[Array], list[int]]:
        size = next(a.shape[i] for a, i in zip(operands, axes, strict=True) if i is not None)
        moved = (
            jnp.broadcast_to(a, (size, *a.shape)) if i is None else jnp.moveaxis(a, i, 0)
            for a, i in zip(operands, axes, strict=True)
        )
        out = primitive.bind(*moved)
        return out, [0] * len(out)

    def jvp(primals: Arrays, tangents: Any) -> tuple[Arrays, Arrays]:
        return jax.jvp(over_all, tuple(primals), tuple(map(ad.instantiate_zeros, tangents)))

    primitive.def_impl(functools.partial(native.run, primitive))
    primitive.def_abstract_eval(shapes)
    batching.primitive_batchers[primitive] = batch
    ad.primitive_jvps[primitive] = jvp
    mlir.register_lowering(primitive, mlir.lower_fun(over_all, multiple_results=True))
    mlir.register_lowering(primitive, mlir.lower_fun(on_cpu, multiple_results=True), platform="cpu")

    def call(*operands: Array) -> Arrays:
        dtype = functools.reduce(jnp.promote_types, (a.dtype for a in operands))
        return tuple(primitive.bind(*native.varying(*(a.astype(dtype) for a in operands))))

    return call
