"""Solids by their signed distance, filled with Gaussians that are lit by sky and sun.

A distance is a function of points `(n, 3)` to `(n,)`: negative inside, and outside at most as far
as the surface really is.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pgjax.render.gaussians import Gaussians
from pgjax.scenes.procedural.bodies import LIGHT, Body, disks_and_balls, join, lit, unit

Distance = Callable[[np.ndarray], np.ndarray]

# The layer that becomes the surface, and where its Gaussians are put; of the spacing.
_LAYER, _DEPTH = 0.75, 0.2
# How far sky and sun are looked for, m, and in how many steps.
_SKY, _SUN = np.geomspace(0.02, 0.3, 5), np.geomspace(0.02, 0.8, 20)


class Places(NamedTuple):
    """What a paint may depend on.

    Attributes:
        x: points, m, `(n, 3)`.
        normal: outward, of the nearest surface, `(n, 3)`.
        depth: below the surface, m, `(n,)`.
        noise: one random number from 0 to 1 for each, `(n,)`.
    """

    x: np.ndarray
    normal: np.ndarray
    depth: np.ndarray
    noise: np.ndarray


class Solid(NamedTuple):
    """A solid with a colour.

    Attributes:
        distance: signed, m.
        paint: from `Places` to albedo `(n, 3)` or `(3,)`, red, green and blue from 0 to 1.
        gloss: of its surface; 0.03 is dull, 0.3 shines.
    """

    distance: Distance
    paint: Callable[[Places], Any]
    gloss: float = 0.03


def filled(
    solids: Sequence[Solid], lower: Any, upper: Any, spacing: float, seed: int = 0
) -> Gaussians:
    """Gaussians that fill solids within a box; where they overlap, the first one owns the place.

    The solids are lattices of the spacing, whose outermost layer lies on the surface as flat disks.
    All are one body: what touches sticks together, and no surface is between them. Light is baked
    in: sky as far as nothing is near, sun where nothing is in its way; what is inside is lit
    evenly.

    Args:
        solids: what is filled.
        lower: lower corner of a box around them, m.
        upper: upper corner.
        spacing: of the Gaussians, m.
        seed: of the noise in colours and places.
    """
    rng = np.random.default_rng(seed)
    whole = union(*(solid.distance for solid in solids))
    x = _lattice(np.asarray(lower, float), np.asarray(upper, float), spacing)
    x = x + 0.12 * spacing * rng.uniform(-1, 1, x.shape)
    x = x[whole(x) < (1 - _LAYER) * spacing]
    distance, normal = whole(x), normals(whole, x)
    surface = distance > -_LAYER * spacing
    x = x + np.where(surface, -_DEPTH * spacing - distance, 0)[:, None] * normal
    own = np.argmax(np.stack([s.distance(x) <= 0.3 * spacing for s in solids]), axis=0)
    places = Places(x, normal, np.maximum(-whole(x), 0), rng.uniform(0, 1, len(x)))
    bodies, order = [], []
    for index, solid in enumerate(solids):
        mine = np.flatnonzero(own == index)
        here = Places(*(part[mine] for part in places))
        albedo = np.broadcast_to(solid.paint(here), here.x.shape)
        # What is inside faces the sun, for the day it is torn open.
        facing = np.where(surface[mine, None], here.normal, LIGHT)
        body = disks_and_balls(here.x, facing, surface[mine], spacing, albedo)
        bodies.append(body._replace(gloss=np.full(len(mine), solid.gloss)))
        order.append(mine)
    body, inside = Body(*join(bodies)), ~surface[np.concatenate(order)]
    sky, sun = _sky(whole, body), _sun(whole, body)
    return lit(body, np.where(inside, 0.9, sky), np.where(inside, 0.6, sun))


def _lattice(lower: np.ndarray, upper: np.ndarray, spacing: float) -> np.ndarray:
    """A cubic lattice in a box, `(n, 3)`."""
    lines = [np.arange(a + spacing / 2, b, spacing) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def normals(distance: Distance, x: np.ndarray, step: float = 1e-3) -> np.ndarray:
    """Unit gradients of a distance, by central differences over a step in metres, `(n, 3)`."""
    offsets = step * np.eye(3)
    gradient = np.stack([distance(x + e) - distance(x - e) for e in offsets], axis=-1)
    # On the middle of a symmetric body there is no direction; any will do.
    flat = np.linalg.norm(gradient, axis=-1, keepdims=True) < 1e-3 * step
    return unit(np.where(flat, [0.0, 0.0, 1.0], gradient))


def _sky(whole: Distance, body: Body) -> np.ndarray:
    """How free the place in front of each is, from 0 to 1, `(n,)`."""
    normal = unit(body.frames[..., 2] + [0.0, 0.0, 0.5])
    hidden = np.zeros(len(normal))
    for far in _SKY:
        hidden += np.clip(1 - whole(body.means + far * normal) / far, 0, 1) / len(_SKY)
    return 1 - 0.85 * hidden


def _sun(whole: Distance, body: Body) -> np.ndarray:
    """How much of a sun that is not quite a point reaches each, from 0 to 1, `(n,)`."""
    start = body.means + 0.015 * body.frames[..., 2]
    seen = np.ones(len(start))
    for far in _SUN:
        seen = np.minimum(seen, np.clip(0.5 + 6 * whole(start + far * LIGHT) / far, 0, 1))
    return seen


# Shapes ------------------------------------------------------------------------------------------


def ball(center: Any, radius: float) -> Distance:
    """A ball."""
    return lambda x: np.linalg.norm(x - np.asarray(center), axis=-1) - radius


def ellipsoid(center: Any, radii: Any) -> Distance:
    """An ellipsoid with axes along x, y and z; near its surface the distance is nearly right."""
    c, r = np.asarray(center), np.asarray(radii, float)

    def distance(x: np.ndarray) -> np.ndarray:
        k0 = np.linalg.norm((x - c) / r, axis=-1)
        k1 = np.linalg.norm((x - c) / r**2, axis=-1)
        return np.where(k1 > 1e-9, k0 * (k0 - 1) / np.maximum(k1, 1e-9), -r.min())

    return distance


def limb(start: Any, end: Any, radius: float, end_radius: float | None = None) -> Distance:
    """A segment with a radius that changes linearly from one rounded end to the other."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    r1 = radius if end_radius is None else end_radius

    def distance(x: np.ndarray) -> np.ndarray:
        t = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        return np.linalg.norm(x - a - t[:, None] * (b - a), axis=-1) - radius - t * (r1 - radius)

    return distance


def box(center: Any, half: Any, rounding: float = 0.0) -> Distance:
    """A box with edges along x, y and z, which may be rounded."""
    c, b = np.asarray(center), np.asarray(half, float) - rounding

    def distance(x: np.ndarray) -> np.ndarray:
        q = np.abs(x - c) - b
        outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
        return outside + np.minimum(q.max(axis=-1), 0) - rounding

    return distance


def cylinder(start: Any, end: Any, radius: float, rounding: float = 0.0) -> Distance:
    """A cylinder between the middles of its flat ends, whose edges may be rounded."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    axis, half = unit(b - a), np.linalg.norm(b - a) / 2

    def distance(x: np.ndarray) -> np.ndarray:
        along = (x - (a + b) / 2) @ axis
        across = np.linalg.norm(x - (a + b) / 2 - along[:, None] * axis, axis=-1)
        q = np.stack([across - radius, np.abs(along) - half], axis=-1) + rounding
        outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
        return outside + np.minimum(q.max(axis=-1), 0) - rounding

    return distance


def ring(center: Any, axis: Any, radius: float, thickness: float) -> Distance:
    """A torus around an axis, of a radius, with a radius of its tube."""
    c, n = np.asarray(center), unit(np.asarray(axis, float))

    def distance(x: np.ndarray) -> np.ndarray:
        along = (x - c) @ n
        across = np.linalg.norm(x - c - along[:, None] * n, axis=-1)
        return np.hypot(across - radius, along) - thickness

    return distance


def turned_profile(points: Any) -> Distance:
    """A solid of revolution about z: a polygon of (radius, z), closed along the axis."""
    corners = np.asarray(points, float)

    def distance(x: np.ndarray) -> np.ndarray:
        p = np.stack([np.hypot(x[:, 0], x[:, 1]), x[:, 2]], axis=-1)
        return _polygon(p, corners)

    return distance


def extruded(points: Any, half_thickness: float, axis: int = 1) -> Distance:
    """A polygon in the plane across an axis (the other two in order), of a thickness."""
    corners = np.asarray(points, float)
    rest = [i for i in range(3) if i != axis]

    def distance(x: np.ndarray) -> np.ndarray:
        q = np.stack([_polygon(x[:, rest], corners), np.abs(x[:, axis]) - half_thickness], axis=-1)
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    return distance


def _polygon(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Signed distance of points `(n, 2)` to a closed polygon `(k, 2)`."""
    nearest, inside = np.full(len(p), np.inf), np.zeros(len(p), bool)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        e, w = b - a, p - a
        t = np.clip(w @ e / max(e @ e, 1e-300), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(w - t[:, None] * e, axis=-1))
        crosses = (a[1] > p[:, 1]) != (b[1] > p[:, 1])
        height = np.where(e[1] == 0, 1.0, e[1])
        inside ^= crosses & (w[:, 0] < e[0] * w[:, 1] / height)
    return np.where(inside, -nearest, nearest)


# How shapes are put together ---------------------------------------------------------------------


def union(*parts: Distance) -> Distance:
    """All of them."""
    return lambda x: np.min([part(x) for part in parts], axis=0)


def blend(width: float, *parts: Distance) -> Distance:
    """All of them, grown together where they meet, within a width in metres."""

    def distance(x: np.ndarray) -> np.ndarray:
        d = np.stack([part(x) for part in parts])
        least = d.min(axis=0)
        return least - width * np.log(np.exp(-(d - least) / width).sum(axis=0))

    return distance


def without(whole: Distance, *parts: Distance) -> Distance:
    """The first, where none of the others is."""
    return lambda x: np.maximum(whole(x), -union(*parts)(x))


def common(*parts: Distance) -> Distance:
    """Where all of them are."""
    return lambda x: np.max([part(x) for part in parts], axis=0)


def hollow(part: Distance, thickness: float) -> Distance:
    """A skin of a thickness inside the surface."""
    return lambda x: np.maximum(part(x), -part(x) - thickness)


def placed(part: Distance, shift: Any = (0, 0, 0), turn: Any = (0, 0, 0)) -> Distance:
    """Turned by a rotation vector in degrees about the origin, then shifted."""
    back = Rotation.from_rotvec(np.radians(np.asarray(turn, float))).as_matrix()
    return lambda x: part((x - np.asarray(shift, float)) @ back)


def on_both_sides(part: Distance) -> Distance:
    """Mirrored in the plane y = 0: what is drawn for y > 0 is there for y < 0, too."""
    return lambda x: part(x * [1, 0, 1] + np.abs(x) * [0, 1, 0])


# Colours -----------------------------------------------------------------------------------------


def plain(color: Any, uneven: float = 0.06) -> Callable[[Places], np.ndarray]:
    """One colour, by some part lighter and darker from place to place."""
    return lambda p: np.asarray(color) * (1 + uneven * (2 * p.noise - 1))[:, None]


def mixed(amount: np.ndarray, first: Any, second: Any) -> np.ndarray:
    """Colours from the first (0) to the second (1), `(n, 3)`."""
    t = np.clip(amount, 0, 1)[:, None]
    return (1 - t) * np.asarray(first) + t * np.asarray(second)


def clouds(x: np.ndarray, size: float, seed: int = 0) -> np.ndarray:
    """A smooth random field from 0 to 1 whose features have a size in metres, `(n,)`."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(0, 1, (24, 3)), rng.uniform(0, 2 * math.pi, 24)
    total = np.cos(x @ waves.T * 2 / size + phases).sum(axis=-1)
    return 0.5 + np.clip(total / (2 * math.sqrt(24)), -0.5, 0.5)
