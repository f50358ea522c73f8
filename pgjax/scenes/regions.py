"""Regions of a scene file: which particles a material, a motion or the simulation itself takes.

A region is closed: points on its faces belong to it.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple, final

import numpy as np

from pgjax.scenes.arrays import label_field
from pgjax.scenes.reader import Table

Triple = tuple[float, float, float]


class Points(NamedTuple):
    """Where particles are, `(p, 3)`, and which Gaussian of their model's file each is, `(p,)`."""

    x: np.ndarray
    rows: np.ndarray


class AbstractRegion(abc.ABC):
    """A part of space, or of the Gaussians of a model."""

    @abc.abstractmethod
    def contains(self, points: Points) -> np.ndarray:
        """Which points belong to the region, boolean `(p,)`."""


@final
@dataclasses.dataclass(frozen=True)
class BoxRegion(AbstractRegion):
    """An axis-aligned box."""

    lower: Triple
    upper: Triple

    def contains(self, points: Points) -> np.ndarray:
        """`lower ≤ x ≤ upper` in each direction."""
        x = points.x
        return np.all((x >= np.asarray(self.lower)) & (x <= np.asarray(self.upper)), axis=-1)


@final
@dataclasses.dataclass(frozen=True)
class SphereRegion(AbstractRegion):
    """A ball."""

    center: Triple
    radius: float

    def contains(self, points: Points) -> np.ndarray:
        """`|x − c| ≤ r`."""
        return _length(points.x - np.asarray(self.center)) <= self.radius


@final
@dataclasses.dataclass(frozen=True)
class CylinderRegion(AbstractRegion):
    """A solid cylinder with flat ends at two points of its axis."""

    start: Triple
    end: Triple
    radius: float

    def contains(self, points: Points) -> np.ndarray:
        """Between the ends, and no farther than r from the axis."""
        axis = unit(np.subtract(self.end, self.start))
        length = np.subtract(self.end, self.start) @ axis
        from_start = points.x - np.asarray(self.start)
        along = from_start @ axis
        across = _length(from_start - along[:, None] * axis)
        return (along >= 0) & (along <= length) & (across <= self.radius)


@final
@dataclasses.dataclass(frozen=True)
class HalfSpaceRegion(AbstractRegion):
    """The side of a plane that its normal points to."""

    point: Triple
    normal: Triple

    def contains(self, points: Points) -> np.ndarray:
        """`(x − p)·n ≥ 0`."""
        return (points.x - np.asarray(self.point)) @ np.asarray(self.normal) >= 0


@final
@dataclasses.dataclass(frozen=True)
class LabelRegion(AbstractRegion):
    """The Gaussians of a model that have one of some labels."""

    labels: np.ndarray
    values: tuple[int, ...]

    def contains(self, points: Points) -> np.ndarray:
        """`label ∈ values`."""
        return np.isin(self.labels[points.rows], self.values)


@final
@dataclasses.dataclass(frozen=True)
class Selection:
    """Which particles a table of the scene file is about.

    Attributes:
        name: how messages call the table.
        model: the name of the model the particles are of; any if None.
        region: the region they are in; everywhere if None.
        lengths: lengths of the table's files of one value per Gaussian, by where they are named.
    """

    name: str
    model: str | None
    region: AbstractRegion | None
    lengths: Mapping[str, int]


def selection(t: Table) -> Selection:
    """What the keys `model` and `region` of a table select."""
    name, chosen = t.text("model", None), t.optional("region", region)
    return Selection(t.name, name, chosen, t.lengths)


def region(t: Table) -> AbstractRegion:
    """A region from its table; without `shape` it is a box."""
    return t.kind("shape", SHAPES, "box")


def _box(t: Table) -> AbstractRegion:
    box = BoxRegion(t.vector("lower"), t.vector("upper"))
    if not all(a < b for a, b in zip(box.lower, box.upper, strict=True)):
        raise t.error("upper", f"be above `lower` = {list(box.lower)}")
    return box


def _sphere(t: Table) -> AbstractRegion:
    return SphereRegion(t.vector("center"), t.number("radius", above=0))


def _cylinder(t: Table) -> AbstractRegion:
    cylinder = CylinderRegion(t.vector("start"), t.vector("end"), t.number("radius", above=0))
    if cylinder.start == cylinder.end:
        raise t.error("end", "differ from `start`")
    return cylinder


def _half_space(t: Table) -> AbstractRegion:
    half = HalfSpaceRegion(t.vector("point"), t.vector("normal"))
    if not any(half.normal):
        raise t.error("normal", "not be zero")
    return half


def _labels(t: Table) -> AbstractRegion:
    labels, values = label_field(t, "file"), t.integers("values")
    present = np.unique(labels)
    missing = sorted(set(values) - set(present.tolist()))
    if missing:
        some = ", ".join(map(str, present[:20])) + (", …" if len(present) > 20 else "")
        rule = f"be labels of {t.text('file')!r}, which holds {some} and no {missing[0]}"
        raise t.error("values", rule)
    return LabelRegion(labels, values)


SHAPES = {
    "box": _box,
    "sphere": _sphere,
    "cylinder": _cylinder,
    "half-space": _half_space,
    "labels": _labels,
}
"""The regions by name."""


def unit(direction: Any) -> np.ndarray:
    """The vector of length 1 along a direction that is not zero, however small or large."""
    v = np.asarray(direction, np.float64)
    v = v / np.abs(v).max()
    return v / np.linalg.norm(v)


def _length(v: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(v * v, axis=-1))
