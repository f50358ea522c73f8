"""The block in pgjax."""

# A parameter is given as a number and becomes an array.
# pyright: reportArgumentType=none

import functools

import jax
import numpy as np

import pgjax
from benchmarks.speed import cases
from benchmarks.speed.cases import Case
from pgjax import boundary, models, native

SCHEMES = {"MLS": pgjax.MLS, "∇w": pgjax.SplineGradient}


def material(name: str) -> models.Material:
    """One of `cases.MATERIALS`."""
    if name == "neo-Hookean":
        return models.Material(models.NeoHookean(cases.E, cases.NU), density=cases.DENSITY)
    if name == "fixed corotated":
        return models.Material(models.FixedCorotated(cases.E, cases.NU), density=cases.DENSITY)
    flow = {
        "Drucker-Prager": models.DruckerPrager(cases.FRICTION_ANGLE),
        "von Mises": models.VonMises(cases.YIELD_STRESS),
    }[name]
    return models.Material(models.StVKHencky(cases.E, cases.NU), flow, density=cases.DENSITY)


def setup(case: Case, scheme: str) -> tuple[pgjax.Scene, pgjax.State]:
    """Scene and initial state in JAX's default precision."""
    walls = (cases.WALL * cases.H,) * 3, ((case.cells - cases.WALL) * cases.H,) * 3
    scene = pgjax.Scene(
        pgjax.Grid((0, 0, 0), (case.cells,) * 3, cases.H),
        material(case.material),
        np.full(case.particles, case.volume),
        gravity=cases.GRAVITY,
        boundaries=[boundary.Box(*walls, boundary.Slip())],
        scheme=SCHEMES[scheme](),
    )
    begin = cases.start(case)
    return scene, pgjax.initial_state(scene, begin.x, begin.v, F=begin.F)


def kernels() -> str:
    """Which kernels are used, "native" or "plain JAX"; native ones are built and loaded now."""
    if not native.available():
        return "plain JAX"
    dtype = str(jax.numpy.zeros(()).dtype)
    loaded = [native.library(source, dtype) for source in native.HANDLERS]
    return "plain JAX" if None in loaded else "native"


def nothing(state: pgjax.State) -> None:
    """Save nothing of a frame."""
    del state


# One frame of many steps of which nothing is kept: `rollout(scene, state, substeps=…)`.
rollout = functools.partial(pgjax.simulate, dt=cases.DT, frames=1, save=nothing)


class Solver:
    """The same run as often as it is asked for."""

    def __init__(self, case: Case, variant: str):
        self.scene, self.state = setup(case, variant)
        self.final = self.state

    def reset(self) -> None:
        """Back to the initial state."""
        self.final = self.state

    def run(self, steps: int) -> None:
        """Advance, and wait for the result."""
        self.final = rollout(self.scene, self.final, substeps=steps).final
        jax.block_until_ready(self.final)

    def positions(self) -> np.ndarray:
        """Positions, m, `(p, 3)`."""
        return np.asarray(self.final.x)
