"""The standing wave of V24 in two dimensions: exact, smooth, periodic."""

import math
from typing import Any

import manufactured
from scenes import itself, without_affine

from benchmarks.work_precision.rollouts import Costs, watched

# How often the error is looked at.
LOOKS = 32


def point(n: int, scheme: str, **options: Any) -> dict[str, Any]:
    """What `wave` measures, as JSON."""
    error, costs = wave(n, scheme, **options)
    return {"error": error} | vars(costs)


def wave(
    n: int,
    scheme: str,
    *,
    fraction: float = 0.5,
    amplitude: float = 0.01,
    per_cell: int = 2,
    transfer: str = "APIC",
    backward: bool = False,
) -> tuple[float, Costs]:
    """`max_t RMS |u − u_exact|/A` over one crossing, and its costs.

    Args:
        n: cells per wave length.
        scheme: a name of `scenes.SCHEMES`.
        fraction: time step over the bound at rest.
        amplitude: A over the wave length.
        per_cell: particles in each direction of a cell.
        transfer: a name of `transfers`.
        backward: whether the gradient is timed, too.
    """
    about: dict[str, Any] = {"per_cell": per_cell, "amplitude": amplitude}
    start = manufactured.standing_wave(n, 2, scheme, **about)
    dt = fraction * float(start.scene.rest_limit())
    damping, after = transfers(dt)[transfer]
    start = manufactured.standing_wave(n, 2, scheme, damping=damping, **about)
    every = max(1, int(1 / manufactured.SPEED / dt) // LOOKS)
    with watched(backward=backward) as costs:
        error = manufactured.wave_error(start, dt, every=every, after=after)
    return float(error), costs


def transfers(dt: float) -> dict[str, tuple[float, Any]]:
    """Name: `shear_damping` of the scene, 1/s, and what is done after a step."""
    return {
        "APIC": (0.0, itself),
        "RPIC, half": (math.log(2) / dt, itself),
        "RPIC": (math.inf, itself),
        "PIC": (0.0, without_affine),
    }
