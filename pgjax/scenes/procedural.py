"""Scenes made by a program instead of a camera: Gaussians that are also particles of a solid.

Every body is filled throughout its volume, so that its Gaussians can be simulated as they are.
Lengths are in metres and z points up.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pgjax.render.gaussians import Gaussians

POT_SPACING = 0.02
WOOD_SPACING = 0.017
LEAVES = 310
STALK = 3
"""Gaussians of a leaf's stalk; they are followed by those of its blade."""

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_UP = np.array([0.0, 0.0, 1.0])
_LIGHT = np.array([0.55, -0.45, 0.70]) / np.linalg.norm([0.55, -0.45, 0.70])

_TERRACOTTA = np.array([0.74, 0.38, 0.25])
_SOIL = np.array([0.20, 0.13, 0.09])
_BARK = np.array([0.50, 0.40, 0.31])
_DARK_GREEN = np.array([0.14, 0.37, 0.15])
_LIGHT_GREEN = np.array([0.37, 0.55, 0.19])
_MIDRIB = np.array([0.66, 0.80, 0.42])


class _Body(NamedTuple):
    """Unlit Gaussians: orthonormal axes in the columns of `frames`, the last one the normal."""

    means: np.ndarray
    frames: np.ndarray
    scales: np.ndarray
    albedo: np.ndarray
    gloss: np.ndarray


class _Branch(NamedTuple):
    """A curve with unit tangents and the radius of the wood around it, at m places."""

    points: np.ndarray
    tangents: np.ndarray
    radii: np.ndarray


def ficus(seed: int = 0) -> Gaussians:
    """A potted ficus one metre high on the plane z = 0, of some 8000 Gaussians.

    Pot, soil and wood are filled solids; leaves are blades of flat Gaussians on stalks. A sun from
    one side and the sky are baked into the colours, with a faint gloss in the harmonics of degree
    1. The Gaussians of the pot come first, then soil, wood and leaves.

    Args:
        seed: decides the shape of the tree and the place of its leaves.
    """
    rng = np.random.default_rng(seed)
    branches = _tree(rng)
    pot = _pot(rng)
    pot = _select(pot, _depth_inside(pot.means, branches) < 0.3 * WOOD_SPACING)
    leaves = _leaves(*_buds(branches[1:], rng), rng)
    return _lit(_fit_height(_join([pot, _wood(branches, rng), leaves])))


MODELS = {"ficus": ficus}
"""The models by name: functions of a seed."""


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of shape (…, 3) divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _join(bodies: Sequence[_Body]) -> _Body:
    """All Gaussians of several bodies."""
    return _Body(*(np.concatenate(parts) for parts in zip(*bodies, strict=True)))


def _select(body: _Body, kept: np.ndarray) -> _Body:
    """The Gaussians that a mask selects."""
    return _Body(*(part[kept] for part in body))


def _fit_height(body: _Body) -> _Body:
    """The body enlarged or shrunk by a few per cent, so that its highest Gaussian is at z = 1."""
    factor = 1 / body.means[:, 2].max()
    return body._replace(means=factor * body.means, scales=factor * body.scales)


def _frames(normals: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Right-handed orthonormal axes: near `along`, across it, and the normal; (n, 3, 3)."""
    across = _unit(np.cross(normals, along))
    return np.stack([np.cross(across, normals), across, normals], axis=-1)


def _disk(radius: float, spacing: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Points that fill a disk, on rings from the edge inwards.

    Returns the points (n, 2) and the number of the ring of each, 0 at the edge.
    """
    points, rings = [], []
    for ring in range(math.ceil(radius / spacing)):
        r = radius - ring * spacing
        count = max(round(2 * math.pi * r / spacing), 1) if r > 0.4 * spacing else 1
        angle = 2 * math.pi * (np.arange(count) + turn) / count
        r = r if count > 1 else 0.0
        points.append(r * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        rings.append(np.full(count, ring))
    return np.concatenate(points), np.concatenate(rings)


def _sweep(branch: _Branch, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that fill a branch, a disk at each of its places.

    Returns the points (n, 3), the number of the ring and the number of the place of each.
    """
    first = np.eye(3)[np.argmin(np.abs(branch.tangents.mean(axis=0)))]
    e1 = _unit(np.cross(branch.tangents, first))
    e2 = np.cross(branch.tangents, e1)
    points, rings, places = [], [], []
    for i, radius in enumerate(branch.radii):
        # Half a turn more in every second disk staggers the points, which closes the surface best.
        disk, ring = _disk(radius, spacing, i % 2 / 2)
        points.append(branch.points[i] + disk[:, :1] * e1[i] + disk[:, 1:] * e2[i])
        rings.append(ring)
        places.append(np.full(len(ring), i))
    return np.concatenate(points), np.concatenate(rings), np.concatenate(places)


def _solid(
    means: np.ndarray, normals: np.ndarray, surface: np.ndarray, spacing: float, albedo: np.ndarray
) -> _Body:
    """Overlapping flat disks where `surface` holds, and smaller balls that stay hidden inside."""
    flat, ball = np.array([0.66, 0.66, 0.15]) * spacing, np.full(3, 0.42 * spacing)
    along = np.where(np.abs(normals[:, 2:]) > 0.9, np.array([1.0, 0.0, 0.0]), _UP)
    scales = np.where(surface[:, None], flat, ball)
    return _Body(means, _frames(normals, along), scales, albedo, np.full(len(means), 0.03))


def _pot(rng: np.random.Generator) -> _Body:
    """A tapered pot with a rim, two rings thick, filled with soil to below the rim."""
    height, layers = 0.28, 15
    z = np.linspace(0.005, height - 0.003, layers)
    rim = z > 0.22
    radii = np.where(rim, 0.168, 0.118 + 0.035 * z / 0.22)
    radii[[0, -1]] -= 0.008  # rounded edges
    axis = _Branch(z[:, None] * _UP, np.tile(_UP, (layers, 1)), radii)
    means, ring, layer = _sweep(axis, POT_SPACING)
    surface_of_soil, top, bottom = layers - 3, layer == layers - 1, layer == 0
    wall = (ring < 2) | bottom
    kept = wall | (layer <= surface_of_soil)
    soil_top = ~wall & (layer == surface_of_soil)

    outward = _unit(means * [1, 1, 0] + 1e-9 * np.array([1, 0, 0]))
    inner_face = (ring == 1) & (layer > surface_of_soil)
    normals = np.where(inner_face[:, None], -outward, outward)
    normals = np.where((top | soil_top)[:, None], _UP, normals)
    normals = np.where((bottom & (ring > 0))[:, None], -_UP, normals)
    edge = (ring == 0) & (top | bottom)
    normals = np.where(edge[:, None], _unit(outward + _UP * np.where(top, 1, -1)[:, None]), normals)
    surface = (ring == 0) | inner_face | top | soil_top | bottom
    albedo = np.where(wall[:, None], _TERRACOTTA, _SOIL)
    albedo = albedo * np.where(wall, 1, rng.uniform(0.75, 1.3, len(means)))[:, None]
    # Lumps on the soil, and shifts inside it against a too regular lattice.
    shift = np.where(wall[:, None], 0, rng.uniform(-0.004, 0.004, means.shape))
    body = _solid(means + shift, normals, surface, POT_SPACING, albedo)
    # The pot before the soil.
    order = np.argsort(~wall, kind="stable")
    return _select(body, order[kept[order]])


def _grow(
    start: np.ndarray, first: np.ndarray, last: np.ndarray, length: float, radii: tuple
) -> _Branch:
    """A branch from `start` whose direction turns from `first` to `last`, with a rounded tip."""
    count = max(round(length / WOOD_SPACING), 2) + 1
    t = np.linspace(0, 1, count)[:, None]
    tangents = _unit((1 - t) * _unit(first) + t * _unit(last))
    steps = length / (count - 1) * (tangents[1:] + tangents[:-1]) / 2
    points = start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    widths = radii[0] + (radii[1] - radii[0]) * t[:, 0]
    widths[-1] *= 0.55
    return _Branch(points, tangents, widths)


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    """The unit vector of two angles in radians."""
    return np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )


def _tree(rng: np.random.Generator) -> list[_Branch]:
    """The trunk first, rooted in the soil; then its boughs, and two branches from each of them."""
    lean = rng.uniform(0, 2 * math.pi)
    trunk = _grow(
        np.array([0, 0, 0.14]) - 0.02 * _direction(lean, 0),
        _direction(lean, math.radians(60)),
        _direction(lean + math.pi, math.radians(72)),
        0.40,
        (0.038, 0.030),
    )
    # A flare at the root, where the trunk leaves the soil.
    trunk.radii[:] += 0.006 * np.exp(-(((trunk.points[:, 2] - 0.24) / 0.04) ** 2))
    branches = [trunk]
    for i in range(6):
        azimuth = lean + i * _GOLDEN_ANGLE + rng.uniform(-0.2, 0.2)
        rise = i / 5
        start = trunk.points[round((0.86 + 0.14 * rise) * (len(trunk.points) - 1))]
        elevation = math.radians(16 + 62 * rise)
        bough = _grow(
            start,
            _direction(azimuth, elevation),
            _direction(azimuth, elevation + math.radians(22 * (1 - rise))),
            rng.uniform(0.17, 0.20) + 0.04 * rise,
            (0.025, 0.0215),
        )
        branches += [bough, *_fork(bough, azimuth, elevation, rng)]
    return branches


def _fork(
    bough: _Branch, azimuth: float, elevation: float, rng: np.random.Generator
) -> list[_Branch]:
    """Two branches that leave a bough to the left and to the right."""
    branches = []
    for side, place in ((-1, 0.5), (1, 0.72)):
        start = bough.points[round(place * (len(bough.points) - 1))]
        turned = azimuth + side * rng.uniform(0.75, 1.05) / math.cos(0.6 * elevation)
        first = _direction(turned, elevation - math.radians(5))
        last = _direction(turned - 0.4 * side, elevation + math.radians(15))
        branches.append(_grow(start, first, last, rng.uniform(0.11, 0.14), (0.0215, 0.0205)))
    return branches


def _depth_inside(points: np.ndarray, branches: Sequence[_Branch]) -> np.ndarray:
    """How deep points lie inside the wood (negative outside), from the nearest place of it."""
    depth = np.full(len(points), -np.inf)
    for branch in branches:
        distance, place = cKDTree(branch.points).query(points)
        depth = np.maximum(depth, branch.radii[place] - distance)
    return depth


def _wood(branches: Sequence[_Branch], rng: np.random.Generator) -> _Body:
    """Filled branches; what lies inside an earlier one, or too near to its points, is left out."""
    bodies, earlier = [], np.empty((0, 3))
    for i, branch in enumerate(branches):
        means, ring, place = _sweep(branch, WOOD_SPACING)
        kept = _depth_inside(means, branches[:i]) < 0.2 * WOOD_SPACING
        if len(earlier):
            kept &= cKDTree(earlier).query(means)[0] > 0.55 * WOOD_SPACING
        normals = means - branch.points[place] + 1e-6 * branch.tangents[place]
        tip = place == len(branch.points) - 1
        normals = _unit(_unit(normals) + np.where(tip[:, None], branch.tangents[place], 0))
        # Bark: darker and lighter bands around the wood.
        tone = rng.uniform(0.9, 1.1, len(branch.points))[place] * rng.uniform(
            0.93, 1.07, len(means)
        )
        body = _solid(means, normals, (ring == 0) | tip, WOOD_SPACING, _BARK * tone[:, None])
        bodies.append(_select(body, kept))
        earlier = np.concatenate([earlier, means[kept]])
    return _join(bodies)


def _buds(
    branches: Sequence[_Branch], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where leaves grow: places on the bark, their stalks' directions and their blades' directions.

    They go around each branch by the golden angle, as leaves do, and are denser near its tip.
    """
    lengths = np.array([len(branch.points) for branch in branches], dtype=np.float64)
    owner = np.searchsorted(np.cumsum(lengths) / lengths.sum(), (np.arange(LEAVES) + 0.5) / LEAVES)
    along = 1 - 0.8 * rng.uniform(0, 1, LEAVES) ** 1.8
    places, normals, tangents = [], [], []
    for i in range(LEAVES):
        points, frame, radii = branches[owner[i]]
        place = round(along[i] * (len(points) - 1))
        angle = i * _GOLDEN_ANGLE
        e1 = _unit(np.cross(frame[place], _direction(0.3, 0.2)))
        normal = math.cos(angle) * e1 + math.sin(angle) * np.cross(frame[place], e1)
        places.append(points[place] + radii[place] * normal)
        normals.append(normal if place < len(points) - 1 else 0.5 * normal)
        tangents.append(frame[place])
    places, normals, tangents = map(np.array, (places, normals, tangents))
    outward = _unit(places - [0, 0, 0.55])
    stalks = _unit(normals + 0.5 * tangents + 0.5 * outward + 0.15 * _UP)
    wander = rng.normal(0, 0.3, places.shape)
    return places, stalks, _unit(0.8 * stalks + 0.8 * outward - 0.1 * _UP + wander)


def _half_width(s: np.ndarray) -> np.ndarray:
    """Half the width of a blade at the fraction s of its length, over its greatest value."""
    return np.sin(math.pi * s**0.75)


def _leaves(
    places: np.ndarray, stalks: np.ndarray, blades: np.ndarray, rng: np.random.Generator
) -> _Body:
    """Leaves: a stalk, then pairs of disks left and right of a light midrib on a blade bent down.

    The blade is an arc in the plane of its direction d and normal n: with the curvature κ over its
    length L it is at `L (d sin(κ s) − n (1 − cos(κ s))) / κ` for s in [0, 1].
    """
    # One leaf: position along the blade and side of it; stalk first, the tip last.
    s = np.array([0, 0, 0, 0.08, 0.28, 0.48, 0.68, *np.repeat([0.17, 0.37, 0.57, 0.77], 2), 0.93])
    side = np.array([0, 0, 0, 0, 0, 0, 0, *[-1, 1] * 4, 0])
    stalk, rib = np.arange(len(s)) < STALK, np.arange(len(s)) < 7
    n, k = len(places), len(s)
    L, width, bend = (
        rng.uniform(low, high, (n, 1, 1))
        for low, high in ((0.082, 0.105), (0.021, 0.026), (0.4, 1.0))
    )
    up = _unit(_UP + rng.normal(0, 0.35, blades.shape) + 0.4 * _unit(places - [0, 0, 0.6]))
    across = _unit(np.cross(up, blades))[:, None]
    d, normal = blades[:, None], np.cross(blades, across[:, 0])[:, None]

    phase = bend * s[:, None]
    tangent = d * np.cos(phase) - normal * np.sin(phase)
    upward = normal * np.cos(phase) + d * np.sin(phase)
    w = width * _half_width(s)[:, None]
    fold = 0.3
    sideways = side[:, None] * across * math.cos(fold) + np.abs(side)[:, None] * upward * fold
    gap = rng.uniform(0.010, 0.0135, (n, 1, 1))
    out = (np.minimum(np.arange(k), STALK - 1) + 0.7)[:, None] * gap
    arc = L * (d * np.sin(phase) - normal * (1 - np.cos(phase))) / bend
    means = places[:, None] + out * stalks[:, None] + arc + 0.5 * w * sideways

    # Disks follow the middle of their half of the blade, which runs at the slope w'(s) / 2 L.
    slope = width * (_half_width(s + 1e-4) - _half_width(s - 1e-4 * (s > 0)))[:, None] / 4e-4 / L
    along = np.where(stalk[:, None], stalks[:, None], tangent + slope * sideways)
    flat = upward - fold * side[:, None] * across
    flat = np.where(
        stalk[:, None], upward - along * np.sum(upward * along, -1, keepdims=True), flat
    )
    thin = np.full_like(w, 0.0012)
    length = np.where(rib[:, None], 0.11 * L, 0.125 * L)
    scales = np.where(rib[:, None], 0.0016, np.where(side[:, None] == 0, 0.33, 0.40) * w)
    scales = np.concatenate([np.where(stalk[:, None], 0.6 * gap, length), scales, thin], axis=-1)
    age = rng.uniform(0, 1, (n, 1, 1))
    green = _DARK_GREEN + (0.55 * age + 0.35 * s[:, None]) * (_LIGHT_GREEN - _DARK_GREEN)
    green = green * rng.uniform(0.8, 1.15, (n, 1, 1))
    albedo = np.where(rib[:, None], 0.55 * _MIDRIB + 0.45 * green, green)
    means = means + 0.001 * rib[:, None] * upward
    return _Body(
        means.reshape(-1, 3),
        _frames(_unit(flat).reshape(-1, 3), _unit(along).reshape(-1, 3)),
        scales.reshape(-1, 3),
        albedo.reshape(-1, 3),
        np.full(n * k, 0.12),
    )


def _transmittance(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Light that reaches points from a direction, through balls that widen along a cone.

    `T = exp(−Σ ρ a Δt / 2)`, with ρ the Gaussians per volume in a ball, a the area of one of them,
    and Δt the diameter of the ball.
    """
    tree, area, depth = cKDTree(points), 1.5e-4, np.zeros(len(points))
    for distance, radius in ((0.07, 0.03), (0.15, 0.05), (0.27, 0.07)):
        count = tree.query_ball_point(points + distance * direction, radius, return_length=True)
        depth += count / (4 / 3 * math.pi * radius**3) * area * 2 * radius / 2
    return np.exp(-depth)


def _lit(body: _Body) -> Gaussians:
    """Bake the light into the harmonics: sky and sun at degree 0, gloss at degree 1.

    `c(d) = c₀ + g (r · −d)` with r the mirror image of the sun, for the viewing direction d.
    """
    normal = body.frames[..., 2]
    facing = normal @ _LIGHT
    # Seen from either side, and a little light passes through.
    sun = np.maximum(facing + 0.25, 0) / 1.25 + 0.3 * np.maximum(-facing, 0) * (body.gloss > 0.1)
    sky = (0.75 + 0.25 * normal[:, 2]) * _transmittance(body.means, _UP)
    sunlight = 0.85 * sun * _transmittance(body.means, _LIGHT)
    light = 0.25 + 0.55 * sky[:, None] + sunlight[:, None] * np.array([1.0, 0.97, 0.88])
    color = np.clip(body.albedo * light, 0.02, 1.0)
    mirror = 2 * facing[:, None] * normal - _LIGHT
    strength = (body.gloss * (0.2 + sunlight))[:, None, None] * np.ones(3)
    c0, c1 = math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi))
    # The basis at degree 1 is c1 (−y, z, −x).
    linear = mirror[:, [1, 2, 0]] * [1, -1, 1] / c1
    sh = np.concatenate([(color[:, None] - 0.5) / c0, linear[:, :, None] * strength], axis=1)
    quaternions = np.roll(Rotation.from_matrix(body.frames).as_quat(), 1, axis=-1)
    opacities = np.full(len(normal), 0.95)
    dtype = jnp.zeros(()).dtype
    parts = (body.means, quaternions, body.scales, opacities, sh)
    return Gaussians.from_scales(*(jnp.asarray(part, dtype=dtype) for part in parts))
