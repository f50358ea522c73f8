"""Array types shared by the package (jaxtyping), and the field that holds a physical parameter."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

Scalar = Float[Array, ""]
Matrix3 = Float[Array, "3 3"]
Vector3 = Float[Array, "3"]

__all__ = [
    "Array",
    "Bool",
    "Float",
    "Int",
    "Matrix3",
    "Scalar",
    "Vector3",
    "as_float_array",
    "concrete",
    "is_parameter",
    "nonnegative",
    "parameter",
    "positive",
    "require",
    "require_like",
    "require_number",
    "require_vector",
]


def as_float_array(value: Any) -> Array:
    """Turn a number or an array of numbers into a strongly typed floating array.

    A Python number becomes an array of the default precision, so that a new value neither
    recompiles a jitted function nor loses its derivative. Floating arrays keep their dtype,
    except float64 where double precision is switched off.
    """
    if isinstance(value, jax.Array | np.ndarray | np.generic) and jnp.issubdtype(
        value.dtype, jnp.floating
    ):
        return jnp.asarray(value, dtype=jax.dtypes.canonicalize_dtype(value.dtype))
    return jnp.asarray(value, dtype=jnp.zeros(()).dtype)


def parameter(**kwargs: Any) -> Any:
    """A field of an `eqx.Module` that holds a physical parameter.

    The value is one number, or one number per particle of the material's slice.
    """
    return eqx.field(converter=as_float_array, metadata={"parameter": True}, **kwargs)


def is_parameter(field: Any) -> bool:
    """Whether a dataclass field was declared with `parameter()`."""
    return bool(field.metadata.get("parameter", False))


def concrete(value: Any) -> np.ndarray | None:
    """The value as a numpy array, or None while it is being traced (jit, grad, vmap)."""
    if isinstance(value, Tracer):
        return None
    return np.asarray(value)


def require(name: str, value: Any, rule: str, holds: Any) -> None:
    """Raise a `ValueError` that names argument, rule and value unless `holds(value)` everywhere.

    Of an array the message gives the first bad entry, its index and how many there are. Values
    being traced are not checked: their errors appear in `Trajectory.status`.
    """
    array = concrete(value)
    if array is None:
        return
    bad = np.argwhere(~np.broadcast_to(holds(array), array.shape))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        where = f" at index {index} ({len(bad)} bad entries)" if index else ""
        raise ValueError(f"Argument `{name}` must {rule}, but is {array[index]!s}{where}.")


def positive(a: Any) -> Any:
    """Whether a number is positive and finite."""
    return (a > 0) & (a < float("inf"))


def nonnegative(a: Any) -> Any:
    """Whether a number is at least 0 and finite."""
    return (a >= 0) & (a < float("inf"))


def require_number(name: str, value: Array) -> None:
    """Refuse what is not one number."""
    if value.shape != ():
        raise ValueError(f"Argument `{name}` must be one number, but has shape {value.shape}.")


def require_vector(name: str, value: Array) -> None:
    """Refuse what is not a finite vector in two or three dimensions."""
    if value.shape not in ((2,), (3,)):
        raise ValueError(
            f"Argument `{name}` must be a vector of 2 or 3 numbers, but has shape {value.shape}."
        )
    require(name, value, "be finite", np.isfinite)


def require_like(name: str, value: Array, other: str, reference: Array) -> None:
    """Refuse what is not a finite vector as long as another argument."""
    if value.shape != reference.shape:
        raise ValueError(
            f"Argument `{name}` must be a vector like `{other}` (shape {reference.shape}), "
            f"but has shape {value.shape}."
        )
    require(name, value, "be finite", np.isfinite)
