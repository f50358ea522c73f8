"""Walls and obstacles of a scene file: `[[boundary]]`."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from pgjax._types import as_float_array
from pgjax.boundary import (
    AbstractContact,
    AbstractShape,
    Box,
    Capsule,
    Collider,
    Complement,
    Cuboid,
    Cylinder,
    HalfSpace,
    Offset,
    SampledSDF,
    Separating,
    Slip,
    Sphere,
    Steady,
    Sticky,
    sample_mesh,
    sample_points,
)
from pgjax.scenes.motions import ZERO, motion, window
from pgjax.scenes.reader import SceneError, Table
from pgjax.scenes.turns import rotation, rotation_vector


class Site(NamedTuple):
    """What a wall has to know of the scene it stands in.

    Attributes:
        spacing: of the grid, m.
        lower: lower corner of the grid, m.
        upper: upper corner of the grid, m.
        surroundings: centres of the Gaussians that do not move, m, `(n, 3)`.
    """

    spacing: float
    lower: np.ndarray
    upper: np.ndarray
    surroundings: np.ndarray


@dataclasses.dataclass(frozen=True)
class BoundaryPart:
    """A wall, and how messages call it.

    Attributes:
        name: of the table.
        make: the condition of the grid. Meshes and surroundings are sampled here.
    """

    name: str
    make: Callable[[Site], Callable]


class _Body(NamedTuple):
    """A shape and the centre it turns about if nothing else is said."""

    shape: AbstractShape
    center: Any


def boundary(t: Table) -> BoundaryPart:
    """A wall from its table."""
    return BoundaryPart(t.name, t.kind("type", TYPES))


def _contact(t: Table) -> AbstractContact:
    kind = t.choice("contact", CONTACTS, "separating")
    friction = t.number("friction", None, at_least=0)
    if kind is Separating:
        return Separating() if friction is None else Separating(friction)
    if friction is not None:
        raise t.error("friction", "be left out unless `contact` is separating")
    return kind()


def _box(t: Table) -> Callable[[Site], Callable]:
    lower, upper = t.vector("lower"), t.vector("upper")
    if not all(a < b for a, b in zip(lower, upper, strict=True)):
        raise t.error("upper", f"be above `lower` = {list(lower)}")
    box = Box(lower, upper, _contact(t))
    return lambda _: box


def _still_velocity(t: Table) -> Callable[[Site], Callable]:
    """A cuboid to which the material sticks and that moves from its start on."""
    shape = Cuboid(t.vector("center"), t.vector("half_size", above=0))
    times = window(t)
    start = times["start"] if math.isfinite(times["start"]) else 0.0
    steady = Steady(t.vector("velocity"), start=start)
    collider = Collider(shape, Sticky(), steady, **times)
    return lambda _: collider


def _collider(body: Callable[[Table], Callable[[Site], _Body]]) -> Callable:
    """The reader of a wall of some shape: contact, motion and window are the same for all."""

    def read(t: Table) -> Callable[[Site], Callable]:
        """The wall of a table, once its site is known."""
        shaped, contact, hollow = body(t), _contact(t), t.boolean("inside", False)
        moved, belt = t.optional("motion", motion), t.vector("surface_velocity", None)
        times, gap = window(t), t.number("gap", 0.0, at_least=0)

        def make(site: Site) -> Callable:
            """The wall itself."""
            shape, center = shaped(site)
            shape = Complement(shape) if hollow else shape
            return Collider(
                Offset(shape, -gap * site.spacing) if gap else shape,
                contact,
                None if moved is None else moved(center),
                surface_velocity=belt,
                **times,
            )

        return make

    return read


def _known(shape: AbstractShape, center: Any) -> Callable[[Site], _Body]:
    return lambda _: _Body(shape, center)


def _half_space(t: Table) -> Callable[[Site], _Body]:
    point, normal = t.vector("point"), t.vector("normal")
    if not any(normal):
        raise t.error("normal", "not be zero")
    return _known(HalfSpace(point, normal), point)


def _sphere(t: Table) -> Callable[[Site], _Body]:
    center = t.vector("center")
    return _known(Sphere(center, t.number("radius", above=0)), center)


def _cuboid(t: Table) -> Callable[[Site], _Body]:
    center, half_size = t.vector("center"), t.vector("half_size", above=0)
    turned = rotation(t)
    turn = rotation_vector(turned) if t.has("rotation") else None
    return _known(Cuboid(center, half_size, turn), center)


def _along(shape: Callable[..., AbstractShape]) -> Callable[[Table], Callable[[Site], _Body]]:
    """The reader of a shape around a segment (`start` and `end` of a wall are times)."""

    def read(t: Table) -> Callable[[Site], _Body]:
        """The shape of a table."""
        first, last = t.vector("from"), t.vector("to")
        if first == last:
            raise t.error("to", "differ from `from`")
        center = tuple((a + b) / 2 for a, b in zip(first, last, strict=True))
        return _known(shape(first, last, t.number("radius", above=0)), center)

    return read


def _mesh(t: Table) -> Callable[[Site], _Body]:
    file, scale = t.existing_path("file"), t.number("scale", 1.0, above=0)
    turn, position = rotation_vector(rotation(t)), as_float_array(t.vector("position", ZERO))
    spacing = t.number("spacing", None, above=0)

    def sampled(site: Site) -> _Body:
        """The mesh on a lattice as fine as the grid, unless the table says how fine."""
        with _libigl(t):
            body = sample_mesh(file, spacing=spacing or site.spacing, scale=scale, turn=turn)
        return _sampled(eqx.tree_at(lambda b: b.origin, body, body.origin + position))

    return sampled


def _surroundings(t: Table) -> Callable[[Site], _Body]:
    """The part of the capture that is not simulated, as far as it is in the grid."""
    spacing, radius = t.number("spacing", None, above=0), t.number("radius", None, above=0)
    thickness = t.number("thickness", None, at_least=0)

    def sampled(site: Site) -> _Body:
        """The still Gaussians near the grid as a wall."""
        fine = spacing or site.spacing
        ball = 2 * site.spacing if radius is None else radius
        x = site.surroundings
        # What is further outside than its balls reach touches nothing.
        near = np.all((x >= site.lower - ball) & (x <= site.upper + ball), axis=1)
        if not near.any():
            raise SceneError(
                f"{t.name}: `type` must be another, since no Gaussian that does not move is in the "
                f"grid (`surroundings = false` of a model removes them)."
            )
        with _libigl(t):
            body = sample_points(x[near], spacing=fine, radius=ball, thickness=thickness)
        return _sampled(body)

    return sampled


def _sampled(body: SampledSDF) -> _Body:
    middle = (np.asarray(body.coefficients.shape) - 1) / 2 * float(body.spacing)
    return _Body(body, np.asarray(body.origin) + middle)


@contextlib.contextmanager
def _libigl(t: Table) -> Iterator[None]:
    """Say which table needs libigl where it is not installed."""
    try:
        yield
    except RuntimeError as error:
        raise SceneError(f"{t.name}: {error}") from error


CONTACTS: dict[str, Callable[..., AbstractContact]] = {
    "sticky": Sticky,
    "slip": Slip,
    "separating": Separating,
}
"""The contacts by name."""

TYPES = {
    "box": _box,
    "half-space": _collider(_half_space),
    "cuboid": _collider(_cuboid),
    "sphere": _collider(_sphere),
    "cylinder": _collider(_along(Cylinder)),
    "capsule": _collider(_along(Capsule)),
    "mesh": _collider(_mesh),
    "surroundings": _collider(_surroundings),
    "velocity": _still_velocity,
}
"""The walls by name."""
