"""Sand: a column that collapses (V35), and an infinite slope (V30)."""

from typing import Any

import flows
import numpy as np

from benchmarks.work_precision.rollouts import watched

ANGLE = np.deg2rad(40.0)


def runout(n: int, per_cell: int = 2) -> float:
    """Of a column as high as wide, φ = 30°, over its width."""
    return float(flows.collapse(1.0, 30.0, n=n, per_cell=per_cell).runout)


def column(n: int, per_cell: int, reference: float) -> dict[str, Any]:
    """Relative error of the runout, and the costs."""
    with watched() as costs:
        error = abs(runout(n, per_cell) / reference - 1)
    return {"error": error} | vars(costs)


def slope(n: int, per_cell: int) -> dict[str, Any]:
    """Relative error of the acceleration along a slope of 40°, and the costs."""
    with watched() as costs:
        t, v = flows.slope(n, ANGLE, 1.5, per_cell=per_cell)
    flowing = (t > 0.4) & (t < 1.0)
    ratio = np.polyfit(t[flowing], v[flowing], 1)[0] / flows.acceleration(ANGLE)
    return {"error": float(abs(ratio - 1))} | vars(costs)
