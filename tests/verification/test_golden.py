"""Level 5: golden values of two scenes, to notice a change that nobody meant (V45).

Right or wrong they are not: V21 and V35 say that. Where a change of the method is meant, renew them
with what `python tests/verification/test_golden.py` prints.
"""

import jax
import pytest
import variants
from discs import collide
from flows import collapse

pytestmark = pytest.mark.float64


def discs(name):
    """V21: two discs, n = 20, after the impact."""
    t, total, kinetic, _ = collide(20, name)
    return {
        "energy that is left": total[-1],
        "least kinetic energy": kinetic.min(),
        "its time, s": t[kinetic.argmin()],
    }


def sand(phi):
    """V35: a column of sand as high as wide, 8 cells, at rest again."""
    deposit = collapse(1.0, phi, n=8)
    return {
        "runout": deposit.runout,
        "height": deposit.height,
        "lowest particle, cells": deposit.lowest,
        "kinetic energy at the end": deposit.energy,
    }


RUNS = {
    "V21, quadratic-grad": lambda: discs("quadratic-grad"),
    "V21, cubic-mls": lambda: discs("cubic-mls"),
    "V35, 20°": lambda: sand(20.0),
    "V35, 30°": lambda: sand(30.0),
}

GOLDEN = {
    "V21, quadratic-grad": {
        "energy that is left": 0.656666497764,
        "least kinetic energy": 0.00186517975568,
        "its time, s": 1.94787503266,
    },
    "V21, cubic-mls": {
        "energy that is left": 0.515262825365,
        "least kinetic energy": 0.00137069232259,
        "its time, s": 1.93063720051,
    },
    "V35, 20°": {
        "runout": 0.994774002499,
        "height": 0.843602587237,
        "lowest particle, cells": 0.16291044893,
        "kinetic energy at the end": 6.60003691574e-06,
    },
    "V35, 30°": {
        "runout": 0.606958429195,
        "height": 0.945282050089,
        "lowest particle, cells": 0.186970298918,
        "kinetic energy at the end": 3.94758206955e-06,
    },
}


@pytest.mark.parametrize("run", RUNS)
def test_v45_golden_values(measure, run):
    for what, value in RUNS[run]().items():
        gap = abs(value / GOLDEN[run][what] - 1)
        measure("V45", f"{run}: change of {what}", gap, below=1e-6)


@pytest.mark.parametrize("run", RUNS)
def test_v45_rounding_does_not_matter(measure, monkeypatch, run):
    """Another machine rounds otherwise: a change of 1e-13 cells of all positions, 1e3 roundings."""
    variants.instead(monkeypatch, variants.nudged(1e-13))
    gaps = [abs(value / GOLDEN[run][what] - 1) for what, value in RUNS[run]().items()]
    measure("V45", f"{run}: what 1e-13 cells change", max(gaps), below=1e-6)


def test_v45_notices_a_change(measure, monkeypatch):
    """Negative control: what the starting positions are off by 1e-3 cells does to them."""
    variants.instead(monkeypatch, variants.nudged(1e-3))
    gaps = [abs(v / GOLDEN["V35, 30°"][what] - 1) for what, v in RUNS["V35, 30°"]().items()]
    measure("V45", "negative control: what 1e-3 cells change", max(gaps), above=1e-5)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    for run, values in RUNS.items():
        print(f'    "{run}": {{')
        for what, value in values().items():
            print(f'        "{what}": {float(value):.12g},')
        print("    },")
