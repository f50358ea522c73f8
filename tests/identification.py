"""A small body whose motion is cheap, for the tests of identification."""

import jax.numpy as jnp
import numpy as np

import pgjax
from pgjax import boundary, models, sampling
from pgjax.inverse import Parameter, Positions, Problem

CELLS = 12
TRUTH = {"E": 2e4, "nu": 0.3, "v0": np.array([0.4, -0.2, -1.5])}
FRAME = 0.02


def block(material_of=None, side=0.25, closed=True):
    """`build` of a block that falls on the floor, and its particles."""
    h = 1 / CELLS
    x, volumes = sampling.block((0.375,) * 3, (0.375 + side,) * 3, h / 2)
    x = x - np.array([0, 0, 0.1])
    grid = pgjax.Grid((0, 0, 0), (CELLS,) * 3, h)
    walls = boundary.Box((0.15,) * 3, (0.85,) * 3, boundary.Sticky())
    if material_of is None:
        material_of = elastic

    def build(values):
        scene = pgjax.Scene(
            grid,
            material_of(values),
            volumes,
            gravity=(0, 0, -9.81),
            boundaries=[walls] if closed else [],
            scheme=pgjax.MLS(),
        )
        return scene, pgjax.initial_state(scene, x, values["v0"])

    return build, x


def elastic(values):
    return models.Material(models.FixedCorotated(values["E"], values["nu"]))


def parameters(**changes):
    """First guesses off the truth by a factor of two or so."""
    unknowns = {
        "E": Parameter(8e3, lower=2e3, upper=5e4, log=True, unit="Pa"),
        "nu": Parameter(0.2, lower=0.0, upper=0.42),
        "v0": Parameter((0.0, 0.0, -1.0), lower=-3.0, upper=3.0, unit="m/s"),
    }
    return unknowns | changes


def motion(build, values, *, frames, substeps, frame_dt=FRAME):
    """Positions of all frames, the first included."""
    known = {n: jnp.asarray(v, jnp.zeros(()).dtype) for n, v in values.items()}
    scene, state = build(known)
    trajectory = pgjax.simulate(
        scene, state, dt=frame_dt / substeps, frames=frames, substeps=substeps
    )
    return trajectory.saved


def elastic_problem(frames=8, truth=TRUTH, noise=0.0, seed=0, **settings):
    """The block, all of whose particles are seen, in the problem's own discretisation."""
    build, x = block()
    unknowns = settings.pop("unknowns", parameters())
    blank = Positions(np.zeros((frames, *x.shape)))
    problem = Problem(unknowns, build, blank, frame_dt=FRAME, **settings)
    values = {n: truth.get(n, p.start) for n, p in unknowns.items()}
    seen = motion(build, values, frames=frames, substeps=problem.substeps)
    data = np.asarray(seen.x)[1:]
    data = data + noise * np.random.default_rng(seed).standard_normal(data.shape)
    return problem.observing(Positions(data, sigma=max(noise, 1e-3)))
