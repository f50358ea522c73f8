"""Functions of one particle as primitives: a native kernel over many, plain JAX elsewhere.

The plain function is the reference: it also has the derivatives.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from pgjax import native
from pgjax._types import Array
from pgjax.native.stages import stage

Arrays = tuple[Array, ...]


def per_particle(
    name: str, source: str, plain: Callable[..., Arrays], rank: int
) -> Callable[..., Arrays]:
    """A function of one particle that `vmap` turns into one call of a native kernel.

    Args:
        name: of the kernel, `pgjax_<name>` in the C++ source.
        source: of the kernel (a key of `native.HANDLERS`).
        plain: the same in JAX, `(*operands) -> tuple` of floating arrays.
        rank: of its first operand.
    """

    def kernel(operands: list[Array], types: list[Any]) -> Arrays | None:
        library = native.library(source, jnp.dtype(operands[0].dtype).name)
        if library is None:
            return None
        return tuple(jax.ffi.ffi_call(library.targets[name], types)(*operands))

    return stage(name, plain, rank, kernel, batched=True)
