"""How walls and led particles move in a scene file: `motion = { … }`, and time windows."""

import math
from collections.abc import Callable
from typing import Any

from pgjax.boundary import AbstractMotion, KeyFrames, Steady
from pgjax.scenes.reader import Table
from pgjax.scenes.regions import Triple
from pgjax.scenes.turns import radians

ZERO = (0.0, 0.0, 0.0)

# A motion, once it is known where the centre of what moves is: it turns about that by default.
Motion = Callable[[Any], AbstractMotion]


def motion(t: Table) -> Motion:
    """A steady motion, or a path through key frames."""
    pivot = t.vector("pivot", None)
    make = _key_frames(t) if t.has("keyframes") else _steady(t)
    return lambda center: make(center if pivot is None else pivot)


def window(t: Table, start: float = -math.inf, end: Any = math.inf) -> dict[str, Any]:
    """The times `start` and `end` between which something acts; the defaults, or `REQUIRED`."""
    start, end = t.number("start", start), t.number("end", end)
    if not end > start:
        raise t.error("end", f"be after `start` = {start:g} s")
    return {"start": start, "end": end}


def _steady(t: Table) -> Motion:
    t.tables("keyframes")
    velocity, spin = t.vector("velocity", ZERO), radians(t.vector("angular_velocity", ZERO))
    times = window(t, start=0.0)
    return lambda pivot: Steady(velocity, spin, pivot, **times)


def _key_frames(t: Table) -> Motion:
    times: list[float] = []
    shifts, turns = [ZERO], [ZERO]
    for frame in t.tables("keyframes"):
        time, shift, turn = frame.read(lambda f: _key_frame(f, shifts[-1], turns[-1]))
        if times and time <= times[-1]:
            raise frame.error("time", f"be after that of the key frame before, {times[-1]:g} s")
        times.append(time)
        shifts.append(shift)
        turns.append(turn)
    if len(times) < 2:
        raise t.error("keyframes", "hold at least two key frames")
    places, angles = shifts[1:], [radians(turn) for turn in turns[1:]]
    return lambda pivot: KeyFrames(times, places, angles, pivot)


def _key_frame(t: Table, shift: Triple, turn: Triple) -> tuple[float, Triple, Triple]:
    """Time, shift and turn; what is left out stays as in the key frame before."""
    return t.number("time"), t.vector("shift", shift), t.vector("turn", turn)
