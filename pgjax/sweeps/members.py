"""Which members a sweep has: all combinations of values, or those of a list."""

import dataclasses
import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, final

import jax.numpy as jnp
import numpy as np

from pgjax._types import Array
from pgjax.result import NEVER

Values = dict[str, Array]


@final
@dataclasses.dataclass(frozen=True)
class Members:
    """The values of each parameter for each of n members.

    Attributes:
        values: by name, `(n,)` or `(n, d)`.
        shape: how many values each parameter has, where the members are all combinations; else
            `(n,)`.
    """

    values: dict[str, np.ndarray]
    shape: tuple[int, ...]

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def some(self, indices: Any) -> Values:
        """The values of some members, with their number in front; of one, without."""
        return {
            name: jnp.asarray(values[indices], jnp.zeros(()).dtype)
            for name, values in self.values.items()
        }


def combined(vary: Any) -> Members:
    """The members of a dict of values (all combinations, the last name fastest) or a list of dicts.

    Raises:
        ValueError: there are none, or something in it is not a finite number.
    """
    if isinstance(vary, Mapping):
        return _all_combinations(vary)
    if isinstance(vary, Sequence) and not isinstance(vary, str):
        return _listed(vary)
    raise ValueError(
        f"Argument `vary` must be a dict of values by name, or a list of such dicts with one value "
        f"each, but is {reprlib.repr(vary)}."
    )


def _all_combinations(vary: Mapping[str, Any]) -> Members:
    axes = {name: _numbers(name, values) for name, values in vary.items()}
    if not axes:
        raise ValueError("Argument `vary` must name at least one parameter, but is empty.")
    shape = tuple(len(values) for values in axes.values())
    count = math.prod(shape)
    if count >= NEVER:
        raise ValueError(
            f"Argument `vary` must give fewer than 2^31 members, but gives {count}, all "
            f"combinations of {' x '.join(map(str, shape))} values."
        )
    places = np.unravel_index(np.arange(count), shape)
    chosen = zip(axes.items(), places, strict=True)
    return Members({name: values[at] for (name, values), at in chosen}, shape)


def _listed(vary: Sequence[Any]) -> Members:
    names = list(vary[0]) if len(vary) and isinstance(vary[0], Mapping) else []
    if not names:
        raise ValueError(
            f"Argument `vary` must hold at least one dict with a value by name, but is "
            f"{reprlib.repr(vary)}."
        )
    for place, member in enumerate(vary):
        if not isinstance(member, Mapping) or set(member) != set(names):
            raise ValueError(
                f"Argument `vary` must give values of {', '.join(names)} for each member, but "
                f"member {place} is {reprlib.repr(member)}."
            )
    values = {name: _numbers(name, [member[name] for member in vary]) for name in names}
    return Members(values, (len(vary),))


def _numbers(name: str, values: Any) -> np.ndarray:
    """The values of a parameter, `(n,)` or `(n, d)`."""
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        array = np.asarray(np.nan)
    if array.ndim not in (1, 2) or array.size == 0 or not np.isfinite(array).all():
        raise ValueError(
            f"Argument `vary` must give a sequence of finite numbers, or of vectors of them, for "
            f"`{name}`, but gives {reprlib.repr(values)}."
        )
    return array
