"""Solids by their signed distance: negative inside, positive outside, in metres.

All but the cylinder exist in two dimensions, too: a sphere is a disc there. Distances are exact,
so that their gradient is the unit normal.
"""

import abc
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._safe import dot, safe_divide, safe_norm
from pgjax._types import (
    Array,
    Float,
    Scalar,
    as_float_array,
    concrete,
    numbers,
    parameter,
    positive,
    require,
    require_kind,
    require_like,
    require_vector,
)
from pgjax.boundary.motion import require_turn, turn_like
from pgjax.linalg import apply, rotation_change
from pgjax.splines import BSpline

Vector = Float[Array, " d"]


class AbstractShape(eqx.Module):
    """A solid. A new one implements `signed_distance` only; the normal is its gradient."""

    @abc.abstractmethod
    def signed_distance(self, x: Vector) -> Scalar:
        """Distance of x to the surface, m; negative inside."""


@final
class HalfSpace(AbstractShape):
    """Everything behind a plane; the material is on the side the normal points to.

    Args:
        point: any point of the plane, m.
        normal: points out of the solid; need not have length 1.
    """

    point: Array = eqx.field(converter=numbers("point"))
    normal: Array = eqx.field(converter=numbers("normal"))

    def __check_init__(self):
        require_vector("point", self.point)
        require_like("normal", self.normal, "point", self.point)
        _nonzero("normal", self.normal)

    def signed_distance(self, x: Vector) -> Scalar:
        """`(x − point)·n`."""
        return dot(x - self.point, self.normal) / safe_norm(self.normal)


@final
class Sphere(AbstractShape):
    """A ball (a disc in two dimensions).

    Args:
        center: m.
        radius: m.
    """

    center: Array = eqx.field(converter=numbers("center"))
    radius: Array = parameter()

    def __check_init__(self):
        require_vector("center", self.center)
        require("radius", self.radius, "be positive and finite (m)", positive)

    def signed_distance(self, x: Vector) -> Scalar:
        """`|x − center| − radius`."""
        return safe_norm(x - self.center) - self.radius


@final
class Cuboid(AbstractShape):
    """A box (a rectangle in two dimensions), along the axes or turned.

    Args:
        center: m.
        half_size: half its extents before it is turned, m.
        turn: rotation vector about the centre, rad, `(3,)`; an angle in two dimensions. None if
            it is not turned.
    """

    center: Array
    half_size: Array
    turn: Array | None

    def __init__(self, center: Any, half_size: Any, turn: Any = None):
        self.center = as_float_array(center, "center")
        self.half_size = as_float_array(half_size, "half_size")
        self.turn = None if turn is None else turn_like(turn, self.center)

    def __check_init__(self):
        require_vector("center", self.center)
        require_like("half_size", self.half_size, "center", self.center)
        require("half_size", self.half_size, "be positive (m)", lambda a: a > 0)
        if self.turn is not None:
            require_turn("turn", self.turn, self.center)

    def signed_distance(self, x: Vector) -> Scalar:
        """Distance to the nearest face, edge or corner."""
        r = x - self.center
        if self.turn is not None:
            r = r + apply(rotation_change(-self.turn), r)
        return _outside_and_inside(jnp.abs(r) - self.half_size)


@final
class Cylinder(AbstractShape):
    """A cylinder with flat ends, in three dimensions.

    Args:
        start: centre of one end, m, `(3,)`.
        end: centre of the other, m.
        radius: m.
    """

    start: Array = eqx.field(converter=numbers("start"))
    end: Array = eqx.field(converter=numbers("end"))
    radius: Array = parameter()

    def __check_init__(self):
        if self.start.shape != (3,):
            raise ValueError(
                f"Argument `start` must have shape (3,), but has shape {self.start.shape}."
            )
        _segment(self.start, self.end, self.radius)

    def signed_distance(self, x: Vector) -> Scalar:
        """Distance to the side, an end, or the edge between them."""
        length = safe_norm(self.end - self.start)
        axis = (self.end - self.start) / length
        r = x - (self.start + self.end) / 2
        along = dot(r, axis)
        across = safe_norm(r - along * axis)
        return _outside_and_inside(jnp.stack([jnp.abs(along) - length / 2, across - self.radius]))


@final
class Capsule(AbstractShape):
    """Everything within `radius` of the segment from `start` to `end`.

    Args:
        start: m.
        end: m.
        radius: m.
    """

    start: Array = eqx.field(converter=numbers("start"))
    end: Array = eqx.field(converter=numbers("end"))
    radius: Array = parameter()

    def __check_init__(self):
        _segment(self.start, self.end, self.radius)

    def signed_distance(self, x: Vector) -> Scalar:
        """`|x − nearest point of the segment| − radius`."""
        along = self.end - self.start
        s = dot(x - self.start, along) / dot(along, along)
        return safe_norm(x - self.start - jnp.clip(s, 0, 1) * along) - self.radius


@final
class Complement(AbstractShape):
    """Everything outside another shape: a bowl, a drum, a tube with the material inside.

    Args:
        shape: the hollow.
    """

    shape: AbstractShape

    def signed_distance(self, x: Vector) -> Scalar:
        """That of the hollow with the other sign."""
        return -self.shape.signed_distance(x)


@final
class Offset(AbstractShape):
    """Everything within a distance of another shape or, if that is negative, so deep inside it.

    A wall stops material somewhat before its nodes are reached: about 0.6 spacings of the grid.
    Put back by `Offset(shape, -0.6 * h)` it is felt where the shape is.

    Args:
        shape: the other.
        distance: how far its surface is moved outwards, m.
    """

    shape: AbstractShape
    distance: Array = parameter()

    def __check_init__(self):
        require_kind("shape", self.shape, AbstractShape)
        require("distance", self.distance, "be finite (m)", np.isfinite)

    def signed_distance(self, x: Vector) -> Scalar:
        """That of the other less `distance`."""
        return self.shape.signed_distance(x) - self.distance


@final
class SampledSDF(AbstractShape):
    """Signed distance given at the nodes of a regular grid, interpolated smoothly between them.

    Quadratic B-splines with coefficients that reproduce quadratic functions: distance and normal
    are continuous. Outside the grid the distance to the grid is added. `sample_mesh` and
    `sample_points` make one from a mesh or from particles.

    Args:
        origin: first node, m, `(d,)`.
        spacing: distance of the nodes, m.
        values: signed distance at the nodes, m, one axis per direction, at least 3 along each.
            They are kept as `coefficients` of the splines, m, of the same shape: to change or to
            differentiate values, make another one of them.
    """

    origin: Array
    spacing: Array
    coefficients: Array

    def __init__(self, origin: Any, spacing: Any, values: Any):
        self.origin = as_float_array(origin, "origin")
        self.spacing = as_float_array(spacing, "spacing")
        values = as_float_array(values, "values")
        # Checked here, since the values are not kept.
        require_vector("origin", self.origin)
        require("spacing", self.spacing, "be positive and finite (m)", positive)
        d = self.origin.shape[0]
        if values.ndim != d or min(values.shape) < 3:
            raise ValueError(
                f"Argument `values` must have {d} axes of at least 3 nodes each, but has shape "
                f"{values.shape}."
            )
        require("values", values, "be finite (m)", np.isfinite)
        self.coefficients = _coefficients(values)

    def signed_distance(self, x: Vector) -> Scalar:
        """Interpolated inside the grid, continued by the distance to it outside."""
        spline, d = BSpline(2), x.shape[0]
        xi = (x - self.origin) / self.spacing
        last = jnp.asarray(self.coefficients.shape, x.dtype) - 1
        # Half a cell from the edge, so that every stencil has its three nodes.
        near = jnp.clip(xi, 0.5, last - 0.5)
        base = jnp.minimum(spline.base(near), last - 2)
        w, _ = spline.weights(near - jax.lax.stop_gradient(base))
        start = [base[i].astype(jnp.int32) for i in range(d)]
        c = jax.lax.dynamic_slice(self.coefficients.astype(x.dtype), start, (3,) * d)
        for i in range(d):
            c = jnp.tensordot(w[:, i], c, axes=1)
        return c + self.spacing * safe_norm(xi - near)


def _coefficients(values: Array) -> Array:
    """Spline coefficients `f − δ²f/8` along each axis: they reproduce quadratic functions."""
    for axis in range(values.ndim):
        f = jnp.moveaxis(values, axis, 0)
        # Continued linearly at the ends, where the second difference vanishes.
        second = f[2:] - 2 * f[1:-1] + f[:-2]
        values = jnp.moveaxis(f.at[1:-1].add(-second / 8), 0, axis)
    return values


def normal(shape: AbstractShape, x: Vector) -> Vector:
    """Outward unit normal; 0 where the distance has no gradient (the centre of a sphere)."""
    gradient = jax.grad(shape.signed_distance)(x)
    length = safe_norm(gradient)
    return safe_divide(gradient, jnp.broadcast_to(length, gradient.shape))


def _outside_and_inside(q: Array) -> Scalar:
    """Distance to a product of intervals from the signed distances to each."""
    return safe_norm(jnp.maximum(q, 0)) + jnp.minimum(jnp.max(q), 0)


def _segment(start: Array, end: Array, radius: Array) -> None:
    require_vector("start", start)
    require_like("end", end, "start", start)
    require("radius", radius, "be positive and finite (m)", positive)
    a, b = concrete(start), concrete(end)
    if a is not None and b is not None and (a == b).all():
        raise ValueError(f"Argument `end` must differ from `start`, but both are {a}.")


def _nonzero(name: str, vector: Array) -> None:
    value = concrete(vector)
    if value is not None and not (value * value).sum() > 0:
        raise ValueError(f"Argument `{name}` must not be zero, but is {value}.")
