"""What a plan consists of, as points, lines and arrows in space: what a preview draws."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pgjax.boundary import (
    Box,
    Collider,
    Complement,
    Offset,
    ParticleForce,
    ParticleImpulse,
    ParticleMotion,
    Wind,
)
from pgjax.boundary.shapes import normal
from pgjax.scenes.build import Plan

# Points of all particles, of each material at least, of what is marked, of what does not move.
_PARTICLES, _FEWEST, _MARKED, _STILL = 6000, 200, 120, 2500
# Nodes of the lattice walls are found on, along the longest side; half a shell in its spacings.
_NODES, _SHELL = 40, 0.6
# How much further than the grid a wall that moves is looked for, in extents of the grid.
_FURTHER = 0.5
_TIMES, _ARROWS, _ARROW = 24, 8, 0.3
_MATERIALS = ("tab:orange", "tab:blue", "tab:green", "tab:purple", "tab:pink", "tab:cyan")
_SHAPES = {"HalfSpace": "half-space", "SampledSDF": "sampled surface"}
_WALLS = ("saddlebrown", "teal", "slateblue", "olive", "dimgray")


class Mark(NamedTuple):
    """Something to be drawn.

    Attributes:
        label: in the legend; one of several with the same label is listed there.
        kind: `"points"`, `"lines"` or `"arrows"`.
        data: points `(n, 3)`, lines `(n, m, 3)`, or arrows from and to `(n, 2, 3)`, m.
        colour: of Matplotlib.
        marker: of points.
        size: of points, in points; of lines their width.
        alpha: opacity.
        outside: whether it may lie far outside of the grid.
    """

    label: str
    kind: str
    data: np.ndarray
    colour: str
    marker: str = "."
    size: float = 2.5
    alpha: float = 1.0
    outside: bool = False


def marks(plan: Plan) -> list[Mark]:
    """Everything there is to see of a plan before it runs."""
    return [
        *_still(plan),
        *_walls(plan),
        *_particles(plan),
        *_conditions(plan),
        *_velocities(plan),
        _domain(plan),
        *_gravity(plan),
        *_camera(plan),
    ]


def domain(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the grid, m."""
    grid = plan.scene.grid
    lower = np.asarray(grid.origin, np.float64)
    return lower, lower + np.asarray(grid.shape) * float(grid.h)


def _some(rows: np.ndarray, most: int) -> np.ndarray:
    """At most so many of some rows, the same each time."""
    if len(rows) <= most:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, most, replace=False))


def _positions(plan: Plan) -> np.ndarray:
    return np.asarray(plan.state.x, np.float64)


def _length(plan: Plan) -> float:
    """Of an arrow, m."""
    return _ARROW * float(np.ptp(_positions(plan), axis=0).max())


def _box(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """The twelve edges of a box, `(12, 2, 3)`."""
    corners = np.array([[i >> k & 1 for k in range(3)] for i in range(8)])
    pairs = [(i, i | 1 << k) for i in range(8) for k in range(3) if not i >> k & 1]
    return np.where(corners[np.array(pairs)] == 1, upper, lower)


def _domain(plan: Plan) -> Mark:
    h = float(plan.scene.grid.h)
    return Mark(f"grid, cells of {h:.3g} m", "lines", _box(*domain(plan)), "0.45", size=1.0)


def _still(plan: Plan) -> Iterator[Mark]:
    x = np.asarray(plan.still.means, np.float64)
    lower, upper = domain(plan)
    margin = 0.25 * (upper - lower)
    near = np.flatnonzero(np.all((x >= lower - margin) & (x <= upper + margin), axis=1))
    if len(x):
        label = f"not simulated, only drawn: {len(x)}"
        yield Mark(label, "points", x[_some(near, _STILL)], "0.7", alpha=0.5)


def _particles(plan: Plan) -> Iterator[Mark]:
    x, scene = _positions(plan), plan.scene
    for i, (material, part) in enumerate(zip(scene.materials, scene.slices, strict=True)):
        rows = np.arange(len(x))[part]
        most = max(_FEWEST, _PARTICLES * len(rows) // len(x))
        law = type(material.elasticity.elastic()).__name__
        if material.plasticity is not None:
            law += f" + {type(material.plasticity).__name__}"
        label = f"material {i + 1}: {law}, {len(rows)} particles"
        yield Mark(label, "points", x[_some(rows, most)], _MATERIALS[i % len(_MATERIALS)])


def _walls(plan: Plan) -> Iterator[Mark]:
    for i, wall in enumerate(plan.scene.boundaries):
        colour = _WALLS[i % len(_WALLS)]
        name = f"boundary {i + 1}: "
        if isinstance(wall, Box):
            lines = _box(np.asarray(wall.lower, np.float64), np.asarray(wall.upper, np.float64))
            label = f"{name}box, {type(wall.contact).__name__.lower()}"
            yield Mark(label, "lines", lines, colour, size=1.2)
        elif isinstance(wall, Collider):
            yield from _collider(plan, wall, name, colour)
        else:
            label = f"{name}{getattr(wall, '__name__', type(wall).__name__)} (not drawn)"
            yield Mark(label, "points", np.zeros((0, 3)), colour)


def _collider(plan: Plan, wall: Collider, name: str, colour: str) -> Iterator[Mark]:
    shape, inside = wall.shape, ""
    if isinstance(shape, Offset):
        shape = shape.shape
    if isinstance(shape, Complement):
        shape, inside = shape.shape, "inside of a "
    kind = _SHAPES.get(type(shape).__name__, type(shape).__name__.lower())
    start = max(float(wall.start), 0.0)
    points = _shell(plan, wall, start)
    when = f", from {start:.3g} s" if start > 0 else ""
    when += "" if len(points) else ", not in the grid"
    label = f"{name}{inside}{kind}, {type(wall.contact).__name__.lower()}{when}"
    yield Mark(label, "points", points, colour, size=3.0, alpha=0.5)
    if wall.motion is not None and len(points):
        path = _path(wall.motion.at, points.mean(axis=0), start, min(float(wall.end), _end(plan)))
        yield Mark("way of what moves", "lines", path, "magenta", size=1.5)


def _end(plan: Plan) -> float:
    """When the run ends, s."""
    return plan.frames / plan.fps


def _shell(plan: Plan, wall: Collider, start: float) -> np.ndarray:
    """Points on the surface of a wall in or near the grid, as it is at a time, `(n, 3)`."""
    lower, upper = domain(plan)
    if wall.motion is not None:
        room = _FURTHER * (upper - lower)
        lower, upper = lower - room, upper + room
    spacing = float((upper - lower).max()) / _NODES
    axes = [np.arange(a, b + spacing / 2, spacing) for a, b in zip(lower, upper, strict=True)]
    dtype = plan.state.dtype
    x = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), dtype)
    time = jnp.asarray(start, dtype)

    @jax.jit
    @jax.vmap
    def look(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Distance to the surface and the nearest point of it."""
        pose = None if wall.motion is None else wall.motion.at(time)
        at_rest = x if pose is None else pose.to_rest(x)
        distance = wall.shape.signed_distance(at_rest)
        n = normal(wall.shape, at_rest)
        return distance, x - distance * (n if pose is None else pose.turned(n))

    distance, nearest = (np.asarray(a, np.float64) for a in look(x))
    return nearest[np.abs(distance) < _SHELL * spacing]


def _path(at: Callable[[Any], Any], x: np.ndarray, start: float, end: float) -> np.ndarray:
    """Where a point goes that a rigid motion carries from a time on, `(1, m, 3)`."""
    dtype = jnp.zeros(()).dtype
    times = jnp.linspace(start, max(end, start), _TIMES).astype(dtype)

    def place(t: jax.Array) -> jax.Array:
        first, now = at(times[0]), at(t)
        return now.R @ (first.to_rest(jnp.asarray(x, dtype)) - now.pivot) + now.center

    return np.asarray(jax.vmap(place)(times), np.float64)[None]


def _conditions(plan: Plan) -> Iterator[Mark]:
    x = _positions(plan)
    conditions: tuple[Any, ...] = plan.scene.particle_conditions
    for condition in conditions:
        mask = np.ones(len(x), bool) if condition.mask is None else np.asarray(condition.mask)
        rows = np.flatnonzero(mask)
        middle = x[rows].mean(axis=0) if len(rows) else x.mean(axis=0)
        if isinstance(condition, ParticleMotion):
            yield from _led(plan, condition, x[_some(rows, _MARKED)], middle, len(rows))
        elif isinstance(condition, ParticleImpulse):
            yield _arrow(plan, "impulse", condition.momentum, "N s", middle, "red")
        elif isinstance(condition, ParticleForce):
            yield _arrow(plan, "force", condition.force, "N", middle, "darkred")
        elif isinstance(condition, Wind) and not callable(condition.velocity):
            yield _arrow(plan, "wind", condition.velocity, "m/s", middle, "deepskyblue")
        else:
            label = f"{type(condition).__name__} on these"
            yield Mark(label, "points", x[_some(rows, _MARKED)], "red", marker="+", size=4)


def _led(
    plan: Plan, condition: ParticleMotion, x: np.ndarray, middle: np.ndarray, count: int
) -> Iterator[Mark]:
    start, end = np.max(np.asarray(condition.start)), np.asarray(condition.end)
    first = max(float(start), 0.0)
    path = _path(condition.motion.at, middle, first, min(float(end.max()), _end(plan)))
    moves = np.ptp(path[0], axis=0).max() > 1e-6 * _length(plan)
    until = ""
    if end.min() < _end(plan):
        until = f" until {end.min():.3g} s"
        if np.ptp(np.where(np.isfinite(end), end, 0)) > 0:
            until = " and released one after the other"
    colour = "magenta" if moves else "black"
    label = f"{'led' if moves else 'held'}{until}: {count} particles"
    yield Mark(label, "points", x, colour, marker="x", size=3.5)
    if moves:
        yield Mark("way of what moves", "lines", path, "magenta", size=1.5)


def _arrow(plan: Plan, name: str, vector: Any, unit: str, start: np.ndarray, colour: str) -> Mark:
    """An arrow of fixed length; its label says how much it stands for."""
    v = np.asarray(vector, np.float64)
    size = float(np.linalg.norm(v))
    direction = v / size if size > 0 else v
    data = np.stack([start, start + _length(plan) * direction])[None]
    return Mark(f"{name} {size:.3g} {unit}", "arrows", data, colour)


def _velocities(plan: Plan) -> Iterator[Mark]:
    """Some velocities at the start, in proportion."""
    x, v = _positions(plan), np.asarray(plan.state.v, np.float64)
    speed = np.linalg.norm(v, axis=1)
    if not speed.max() > 0:
        return
    rows = _some(np.flatnonzero(speed > 0.05 * speed.max()), _ARROWS)
    ends = x[rows] + _length(plan) * v[rows] / speed.max()
    label = f"velocity at the start, up to {speed.max():.3g} m/s"
    yield Mark(label, "arrows", np.stack([x[rows], ends], axis=1), "limegreen")


def _gravity(plan: Plan) -> Iterator[Mark]:
    g = np.asarray(plan.scene.gravity, np.float64)
    if g.any():
        lower, upper = domain(plan)
        corner = lower + np.array([0.07, 0.07, 0.95]) * (upper - lower)
        yield _arrow(plan, "gravity", g, "m/s²", corner, "dimgray")


def _camera(plan: Plan) -> Iterator[Mark]:
    """The frustum of the first frame, as far as the middle of the particles, and the way."""
    camera = plan.camera(0)
    eye = np.asarray(camera.position, np.float64)
    W = np.asarray(camera.world_to_camera, np.float64)[:3, :3]
    middle = _positions(plan).mean(axis=0)
    depth = 0.4 * max(float(W[2] @ (middle - eye)), float(camera.near))
    u = np.array([0, camera.width, camera.width, 0, 0])
    v = np.array([0, 0, camera.height, camera.height, 0])
    rays = np.stack(
        [
            (u - float(camera.cx)) / float(camera.fx),
            (v - float(camera.cy)) / float(camera.fy),
            np.ones(5),
        ],
        axis=1,
    )
    rim = eye + depth * rays @ W
    lines = np.stack([np.stack([eye, rim[i], rim[i + 1]]) for i in range(4)])
    yield Mark("camera", "lines", lines, "crimson", size=1.0, outside=True)
    eyes = [plan.camera(round(f)).position for f in np.linspace(0, plan.frames, _TIMES)]
    way = np.asarray(eyes, np.float64)
    if np.ptp(way, axis=0).max() > 1e-6 * np.linalg.norm(eye - middle):
        yield Mark("way of the camera", "lines", way[None], "crimson", size=2.0, outside=True)
