"""Array types shared by the package (jaxtyping), and the field that holds a physical parameter."""

import functools
import reprlib
from collections.abc import Callable
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
    "as_tuple",
    "concrete",
    "floating",
    "is_parameter",
    "nonnegative",
    "numbers",
    "parameter",
    "positive",
    "require",
    "require_kind",
    "require_like",
    "require_number",
    "require_shape",
    "require_vector",
    "whole_numbers",
]


def as_float_array(value: Any, name: str = "value") -> Array:
    """Turn a number or an array of numbers into a strongly typed floating array.

    A Python number becomes an array of the default precision, so that a new value neither
    recompiles a jitted function nor loses its derivative. Floating arrays keep their dtype,
    except float64 where double precision is switched off.

    Args:
        value: a number, or numbers.
        name: of the argument, for messages.

    Raises:
        ValueError: it is neither.
    """
    if isinstance(value, jax.Array | np.ndarray | np.generic) and jnp.issubdtype(
        value.dtype, jnp.floating
    ):
        return jnp.asarray(value, dtype=jax.dtypes.canonicalize_dtype(value.dtype))
    try:
        return jnp.asarray(value, dtype=jnp.zeros(()).dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise _no_numbers(name, value) from error


def floating(name: str, value: Any) -> Array | np.ndarray:
    """The value as a floating array, on the host and in its own precision where it is known."""
    try:
        value = value if isinstance(value, jax.Array | np.ndarray) else np.asarray(value)
        is_floating = jnp.issubdtype(value.dtype, jnp.floating)
        return value if is_floating else value.astype(jnp.zeros(()).dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise _no_numbers(name, value) from error


def _no_numbers(name: str, value: Any) -> ValueError:
    rule = "be a number or an array of numbers, within the range of the precision"
    return ValueError(f"Argument `{name}` must {rule}, but is {reprlib.repr(value)}.")


def numbers(name: str) -> Callable[[Any], Array]:
    """`as_float_array` as the converter of a field of this name."""
    return functools.partial(as_float_array, name=name)


class _Parameter:
    """The same, which looks up the name of its field: that is known once the class is made."""

    field: Any

    def __call__(self, value: Any) -> Array:
        return as_float_array(value, self.field.name)


def parameter(**kwargs: Any) -> Any:
    """A field of an `eqx.Module` that holds a physical parameter.

    The value is one number, or one number per particle of the material's slice.
    """
    converter = _Parameter()
    metadata = {"parameter": True, **kwargs.pop("metadata", {})}
    converter.field = eqx.field(converter=converter, metadata=metadata, **kwargs)
    return converter.field


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
    try:
        array = concrete(value)
    except ValueError:  # Lists of different lengths.
        array = np.asarray(None)
    if array is None:
        return
    if array.dtype.kind in "OSUmMc":
        raise ValueError(f"Argument `{name}` must {rule}, but is {reprlib.repr(value)}.")
    bad = np.argwhere(~np.broadcast_to(holds(array), array.shape))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        where = f" at index {index} ({len(bad)} bad entries)" if index else ""
        raise ValueError(f"Argument `{name}` must {rule}, but is {array[index]!s}{where}.")


def require_kind(name: str, value: Any, *kinds: type) -> None:
    """Refuse what is not a record of one of these kinds."""
    if not isinstance(value, kinds):
        allowed = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"Argument `{name}` must be a {allowed}, but is {reprlib.repr(value)}.")


def as_tuple(name: str, value: Any) -> tuple[Any, ...]:
    """What a list or another sequence holds."""
    try:
        return tuple(value)
    except TypeError:
        raise ValueError(
            f"Argument `{name}` must be a sequence, but is {reprlib.repr(value)}."
        ) from None


def whole_numbers(name: str, values: Any) -> tuple[int, ...]:
    """Whole numbers of up to 63 bits as such: 8.0 is one, 8.5 and NaN are none."""
    found = as_tuple(name, values)
    for value in found:
        number = isinstance(value, int | float | np.integer | np.floating)
        if not number or not abs(value) < 2**63 or value != int(value):
            raise ValueError(
                f"Argument `{name}` must hold whole numbers below 2^63, but is "
                f"{reprlib.repr(values)}."
            )
    return tuple(int(value) for value in found)


def positive(a: Any) -> Any:
    """Whether a number is positive and finite."""
    return (a > 0) & (a < float("inf"))


def nonnegative(a: Any) -> Any:
    """Whether a number is at least 0 and finite."""
    return (a >= 0) & (a < float("inf"))


def require_number(name: str, value: Any) -> None:
    """Refuse what is not one number."""
    try:
        shape = np.shape(value)
    except ValueError:  # Lists of different lengths.
        shape = (len(value), "…")
    if shape != ():
        raise ValueError(f"Argument `{name}` must be one number, but has shape {shape}.")


def require_shape(name: str, value: Array | np.ndarray, *shapes: tuple[int, ...]) -> None:
    """Refuse what has none of these shapes."""
    if value.shape not in shapes:
        allowed = " or ".join(str(s) for s in shapes)
        raise ValueError(
            f"Argument `{name}` must have shape {allowed}, but has shape {value.shape}."
        )


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
