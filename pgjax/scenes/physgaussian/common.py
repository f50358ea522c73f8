"""What the conditions of a configuration file have in common."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from pgjax.scenes.reader import Table
from pgjax.scenes.regions import Triple

# How the conditions with a time window write its ends.
START, END = "start_time", "end_time"


@dataclasses.dataclass(frozen=True)
class Setting:
    """What conditions have to know of the scene they are in.

    Attributes:
        x: positions of the particles at the start, m, `(n, 3)`.
        domain: edge of the grid, m.
        n_grid: its cells along each edge.
        substep_dt: the time step of the file, s.
        duration: of the scene, s.
        legacy: whether defects that a result depends on are kept.
    """

    x: np.ndarray
    domain: float
    n_grid: int
    substep_dt: float
    duration: float
    legacy: bool


class Pieces(NamedTuple):
    """What a condition becomes: tables of the scene file, and notes, a line each.

    `leads` hold or move particles. In the reference the last one that leads a particle leads it, in
    a scene file the first.
    """

    walls: list[dict[str, Any]]
    leads: list[dict[str, Any]]
    pushes: list[dict[str, Any]]
    notes: list[str]


Make = Callable[[Setting], Pieces]


class Box(NamedTuple):
    """A box by its middle and half its extent; its faces do not belong to it."""

    point: Triple
    size: Triple

    def holds(self, x: np.ndarray) -> bool:
        """Whether a particle is in the box."""
        return bool(inside(self, x).any())

    def corners(self) -> dict[str, Any]:
        """The box as a region of a scene file."""
        middle, half = np.asarray(self.point), np.asarray(self.size)
        return {"lower": (middle - half).tolist(), "upper": (middle + half).tolist()}


def inside(box: Any, x: np.ndarray) -> np.ndarray:
    """Which points are in a box of `point` and (half) `size`."""
    return np.all(np.abs(x - np.asarray(box.point)) < np.asarray(box.size), axis=1)


def box_of(t: Table, **defaults: Triple) -> Box:
    """The box of a condition; with defaults both keys may be left out."""
    point, size = defaults.get("point"), defaults.get("size")
    if point is None:
        return Box(t.vector("point"), t.vector("size", above=0))
    return Box(t.vector("point", point), t.vector("size", size, above=0))


class Times(NamedTuple):
    """When a condition acts, s."""

    start: float
    end: float

    def window(self) -> dict[str, float]:
        """The keys of a scene file."""
        return {"start": self.start, "end": self.end}


def times_of(t: Table) -> Times:
    """When a condition acts; as good as always if nothing is said."""
    times = Times(t.number(START, 0.0), t.number(END, 1e3))
    if times.end <= times.start:
        raise t.error(END, f"be after `{START}` = {times.start:g} s")
    return times


def nobody() -> Pieces:
    """What a condition becomes that is about no particle."""
    return Pieces([], [], [], ["left out: no particle is in its region"])


def flag(t: Table, key: str) -> bool:
    """A switch, which the files write as true or false, or as 1 or 0; off by default."""
    if not t.has(key) or t.is_a(key, bool):
        return t.boolean(key, False)
    return bool(t.integer(key, 0, at_least=0, at_most=1))


def renamed(data: Mapping[str, Any]) -> dict[str, Any]:
    """A condition with its times under their own names: some files write `start` and `end`."""
    short = {"start": START, "end": END}
    return {short[k] if k in short and short[k] not in data else k: v for k, v in data.items()}
