"""Savings that are choices of a whole scene: time step, spacing, particles that lie still."""

import dataclasses
from typing import Any

import numpy as np

import pgjax
from benchmarks.ablations.measure import Program, change, compare, rollout
from pgjax.scenes import Plan, plan, read_scene, resolve
from pgjax.scenes.run import carried

Row = dict[str, Any]

# What most published configurations of PhysGaussian have, s.
USUAL_DT = 1e-4
# Of a cell per frame: slower particles could be left alone.
ASLEEP = 1e-2


def automatic_dt(name: str, frames: int, rounds: int) -> Row:
    """The automatic time step against the usual fixed one; errors of both against a fine one."""
    planned = plan(read_scene(resolve(name)), frames=frames)
    seconds = planned.substeps * planned.dt * frames
    fixed, automatic, fine = (
        rollout(planned.scene, planned.state, seconds=seconds, dt=dt)
        for dt in (USUAL_DT, planned.dt, min(planned.dt, USUAL_DT) / 4)
    )
    truth, start = fine.run(), np.asarray(planned.state.x)
    errors = [change(start, truth, program.run()) for program in (fixed, automatic)]
    return {
        "what": f"automatic time step, {planned.dt:.2g} s (without: {USUAL_DT:g} s)",
        "scene": f"{name}, {planned.scene.particle_count} particles, {frames} frames",
        "test": "verification V25, test_timestep.py",
        "bound": None,
        "change": errors[1],
        "note": f"errors against a quarter of the smaller step: {errors[0]:.1e} without, "
        f"{errors[1]:.1e} with",
    } | compare(fixed, automatic, rounds)


def coarse_particles(name: str, frames: int, rounds: int) -> Row:
    """A grid twice as coarse, with particles of its own that carry all Gaussians."""
    file = read_scene(resolve(name))
    spacing = 2 * file.grid.spacing
    grid = dataclasses.replace(file.grid, spacing=spacing, particle_spacing=0.5)
    fine, coarse = (plan(f, frames=frames) for f in (file, dataclasses.replace(file, grid=grid)))
    programs = [_carrying(p, frames) for p in (fine, coarse)]
    start = np.asarray(fine.moving.means)
    one, other = (program.run() for program in programs)
    return {
        "what": "a grid twice as coarse whose particles carry the Gaussians",
        "scene": f"{name}, {fine.scene.particle_count} particles (with: "
        f"{coarse.scene.particle_count}), {frames} frames",
        "test": "test_merged.py",
        "bound": None,
        "change": change(start, one, other),
        "note": "`pgjax tune` says what a spacing costs in accuracy",
    } | compare(*programs, rounds)


def _carrying(planned: Plan, frames: int) -> Program:
    """The places of all moving Gaussians at the end."""
    seconds = planned.substeps * planned.dt * frames
    program = rollout(planned.scene, planned.state, seconds=seconds, dt=planned.dt)

    def places(state: pgjax.State) -> np.ndarray:
        return np.asarray(carried(planned, state.x, state.F)[0].means)

    return dataclasses.replace(program, places=places)


def asleep(name: str, rounds: int) -> Row:
    """How much time could be saved at most if particles at rest were left alone."""
    del rounds  # Nothing is timed.
    planned = plan(read_scene(resolve(name)))
    h = float(planned.scene.grid.h)
    run = pgjax.simulate(
        planned.scene,
        planned.state,
        dt=planned.dt,
        frames=planned.frames,
        substeps=planned.substeps,
        save=lambda state: state.x,
        allow_unstable=True,
    )
    way = np.linalg.norm(np.diff(np.asarray(run.saved), axis=0), axis=2)
    still = float(np.mean(way < ASLEEP * h))
    return {
        "what": "sleeping particles: not done",
        "scene": f"{name}, {planned.scene.particle_count} particles, {planned.frames} frames",
        "test": "",
        "bound": None,
        "change": None,
        "at most": 1 / (1 - still),
        "note": f"{still:.0%} of all particles move less than {ASLEEP:g} cells in a frame: without "
        f"them, and without what it costs to know, at most {1 / (1 - still):.2f} times faster",
    }
