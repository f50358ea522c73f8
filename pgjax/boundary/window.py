"""Windows of time: `start` belongs to them, `end` does not."""

import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Bool, Float, Scalar, concrete, require_number


def within(t: Scalar, start: Float[Array, "..."], end: Float[Array, "..."]) -> Bool[Array, "..."]:
    """Whether the step at t lies in the window `start ≤ t < end`, up to rounding.

    A step that falls on an end of the window but for rounding counts as on it, so that as many
    steps act as fit into the window, in either precision.
    """
    # Differences of times that are near each other are exact; those with ±∞ are infinite.
    return (t - start >= -slack(t)) & (t - end < -slack(t))


def slack(t: Scalar) -> Scalar:
    """By how much the time of a step may be wrong, s.

    `t = step · Δt` is rounded three times, with Δt, with the product and with the end of a window
    it is compared with: by at most half an ulp each.
    """
    return 4 * jnp.asarray(jnp.finfo(t.dtype).eps, t.dtype) * jnp.abs(t)


def require_window(start: Array, end: Array) -> None:
    """Refuse what is not one number, and a window that ends before it starts."""
    require_number("start", start)
    require_number("end", end)
    _require_order(start, end)


def require_windows(start: Array, end: Array, mask: Array) -> None:
    """The same of windows that may differ from particle to particle, at either end."""
    for name, value in (("start", start), ("end", end)):
        if value.shape not in ((), mask.shape):
            raise ValueError(
                f"Argument `{name}` must be one number or one per particle {mask.shape}, but has "
                f"shape {value.shape}."
            )
    _require_order(start, end)


def _require_order(start: Array, end: Array) -> None:
    first, last = concrete(start), concrete(end)
    if first is None or last is None:
        return
    first, last = np.broadcast_arrays(first, last)
    bad = np.argwhere(~(last > first))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        where = f" at index {index} ({len(bad)} bad entries)" if index else ""
        raise ValueError(
            f"Argument `end` must be after `start` = {first[index]} s, but is {last[index]} s"
            f"{where}."
        )
