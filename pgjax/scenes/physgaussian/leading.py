"""The conditions of particles in a configuration file: pushed, held, led, released."""

import math
from typing import Any

import numpy as np

from pgjax.scenes.physgaussian.common import (
    START,
    Make,
    Pieces,
    Setting,
    box_of,
    inside,
    nobody,
    times_of,
)
from pgjax.scenes.physgaussian.releasing import releases
from pgjax.scenes.reader import Table
from pgjax.scenes.regions import CylinderRegion, Points, unit

# The reference builds so many layers, whatever it is asked for.
_LAYERS = 50


def impulse(t: Table) -> Make:
    """The same force on each particle of a box, for some steps."""
    force, box = t.vector("force"), box_of(t, point=(1.0, 1.0, 1.0), size=(1.0, 1.0, 1.0))
    steps, start = t.integer("num_dt", 1), t.number(START, 0.0)

    def make(here: Setting) -> Pieces:
        """A push with the momentum of all particles of the box together."""
        count = int(inside(box, here.x).sum())
        if not count:
            return nobody()
        duration = steps * here.substep_dt
        momentum = [f * duration * count for f in force]
        push = {"type": "impulse", "momentum": momentum, "start": start, "duration": duration}
        note = (
            f"{list(force)} N on each of {count} particles for {duration:g} s is the momentum "
            f"{[float(f'{p:.4g}') for p in momentum]} kg m/s, shared by mass: change it with the "
            f"model, not with the number of particles"
        )
        return Pieces([], [], [push | {"region": box.corners()}], [note])

    return make


def translation(t: Table) -> Make:
    """The particles of a box, with one velocity."""
    box, velocity, times = box_of(t), t.vector("velocity"), times_of(t)

    def make(here: Setting) -> Pieces:
        """Particles that are held, or led with one velocity."""
        if not box.holds(here.x):
            return nobody()
        moving = {"type": "velocity", "velocity": list(velocity)}
        lead = moving if any(velocity) else {"type": "hold"}
        return Pieces([], [lead | times.window() | {"region": box.corners()}], [], [])

    return make


def rotation(t: Table) -> Make:
    """The particles of a cylinder, around and along its axis."""
    point, normal = t.vector("point"), t.vector("normal")
    if not any(normal):
        raise t.error("normal", "not be zero")
    half_height, radius = t.vector("half_height_and_radius", size=2, above=0)
    spin, speed = t.number("rotation_scale"), t.number("translation_scale", 0.0)
    times, n = times_of(t), unit(normal)
    ends = (np.asarray(point) - half_height * n, np.asarray(point) + half_height * n)

    def make(here: Setting) -> Pieces:
        """Particles of a cylinder that are led around and along its axis."""
        first, last = ends[0].tolist(), ends[1].tolist()
        cylinder = CylinderRegion(tuple(first), tuple(last), radius)
        if not cylinder.contains(Points(here.x, np.zeros(0, int))).any():
            return nobody()
        motion: dict[str, Any] = {"pivot": list(point)}
        notes = []
        if spin:
            motion["angular_velocity"] = (-math.degrees(spin) * n + 0.0).tolist()
            notes.append(f"rotation_scale = {spin:g} turns with {-spin:g} rad/s about the normal")
        if speed:
            motion["velocity"] = (speed * n).tolist()
        lead = {"type": "move", "motion": motion} if spin or speed else {"type": "hold"}
        region = {"shape": "cylinder", "start": first, "end": last, "radius": radius}
        return Pieces([], [lead | times.window() | {"region": region}], [], notes)

    return make


def release(t: Table) -> Make:
    """Held particles that are let go along an axis."""
    normal = t.vector("normal")
    if sum(c != 0 for c in normal) != 1:
        raise t.error("normal", "be along one of the axes")
    axis = int(np.argmax(np.abs(normal)))
    first, last = t.number("start_position"), t.number("end_position")
    if first == last:
        raise t.error("end_position", "differ from `start_position`")
    asked, times = t.integer("num_layers", _LAYERS), times_of(t)

    def make(here: Setting) -> Pieces:
        """Particles that are held, and let go layer by layer."""
        layers = _LAYERS if here.legacy else asked
        leads = releases(here.x, here.domain, axis, (first, last), layers, times.end)
        if not leads:
            return nobody()
        was = "" if layers == _LAYERS else f" (the reference: always {_LAYERS})"
        if here.legacy and asked != _LAYERS:
            was = f", not the {asked} of `num_layers`"
        notes = [f"num_layers: {layers}{was}, in one condition"]
        if times.start > 0:
            notes.append(f"held from the beginning, not from start_time = {times.start:g} s on")
        return Pieces([], leads, [], notes)

    return make
