"""Scenes made by a program instead of a camera: Gaussians that are also particles of a solid.

Every body is filled throughout its volume, so that its Gaussians can be simulated as they are.
Lengths are in metres and z points up.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pgjax.render.gaussians import Gaussians

_POT_SPACING = 0.02
_WOOD_SPACING = 0.017
_LEAVES = 300
# One leaf: Gaussians of the stalk, of the midrib, of the left and right half, and of the tip, with
# their place along the blade (0 … 1) and side of it.
_STALK, _RIB = 3, 4
_LEAF_PAIRS = np.repeat([0.17, 0.37, 0.57, 0.77], 2)
_LEAF_S = np.array([0, 0, 0, 0.08, 0.28, 0.48, 0.68, *_LEAF_PAIRS, 0.93])
_LEAF_SIDE = np.array([0] * 7 + [-1, 1] * 4 + [0])

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
_UP = np.array([0.0, 0.0, 1.0])
_LIGHT = np.array([0.55, -0.45, 0.70]) / np.linalg.norm([0.55, -0.45, 0.70])

_TERRACOTTA = np.array([0.70, 0.37, 0.25])
_SOIL = np.array([0.20, 0.13, 0.09])
_BARK = np.array([0.54, 0.44, 0.34])
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

    def at(self, fraction: float) -> np.ndarray:
        """The point at a fraction of the length."""
        return self.points[round(fraction * (len(self.points) - 1))]


def ficus(seed: int = 0) -> Gaussians:
    """A potted ficus one metre high on the plane z = 0, of some 9000 Gaussians.

    Pot, soil and wood are filled solids; leaves are blades of flat Gaussians on stalks. A sun from
    one side and the sky are baked into the colours, with a faint gloss in the harmonics of degree
    1. The Gaussians of the pot and its soil come first, then those of the wood and the leaves.

    Args:
        seed: decides the shape of the tree and the place of its leaves.
    """
    rng = np.random.default_rng(seed)
    branches = _tree(rng)
    pot = _pot(rng)
    pot = _select(pot, _depth_inside(pot.means, branches) < 0.3 * _WOOD_SPACING)
    leaves = _leaves(*_buds(branches[1:], rng), rng)
    body = _Body(*_join([pot, _wood(branches, rng), leaves]))
    # A few per cent larger or smaller, for a height of exactly one metre.
    height = body.means[:, 2].max()
    return _lit(body._replace(means=body.means / height, scales=body.scales / height))


MODELS = {"ficus": ficus}
"""The models by name: functions of a seed."""


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of shape (…, 3) divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _join(records: Sequence[tuple]) -> Iterator[np.ndarray]:
    """The fields of several records, each in one array."""
    return (np.concatenate(fields) for fields in zip(*records, strict=True))


def _select(body: _Body, kept: np.ndarray) -> _Body:
    """The Gaussians that a mask selects."""
    return _Body(*(part[kept] for part in body))


def _frames(normals: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Right-handed orthonormal axes: near `along`, across it, and the normal; (n, 3, 3)."""
    across = _unit(np.cross(normals, along))
    return np.stack([np.cross(across, normals), across, normals], axis=-1)


def _disk(radius: float, spacing: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) that fill a disk on rings from its edge inwards, and the ring of each."""
    points, rings = [], []
    for ring, r in enumerate(np.arange(radius, 0, -spacing)):
        count = round(2 * math.pi * r / spacing) if r > 0.4 * spacing else 1
        angle = 2 * math.pi * (np.arange(count) + turn) / count
        points.append((count > 1) * r * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        rings.append(np.full(count, ring))
    return np.concatenate(points), np.concatenate(rings)


def _sweep(branch: _Branch, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (n, 3) that fill a branch disk by disk, and the ring and the place of each."""
    first = np.eye(3)[np.argmin(np.abs(branch.tangents.mean(axis=0)))]
    e1 = _unit(np.cross(branch.tangents, first))
    e2 = np.cross(branch.tangents, e1)
    # Half a turn more in every second disk staggers the points, which closes the surface best.
    disks = [_disk(radius, spacing, i % 2 / 2) for i, radius in enumerate(branch.radii)]
    place = np.repeat(np.arange(len(disks)), [len(ring) for _, ring in disks])
    disk, ring = _join(disks)
    return branch.points[place] + disk[:, :1] * e1[place] + disk[:, 1:] * e2[place], ring, place


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
    layers, z = 15, np.linspace(0.005, 0.277, 15)
    radii = np.where(z > 0.22, 0.168, 0.118 + 0.035 * z / 0.22)
    radii[[0, -1]] -= 0.008  # rounded edges
    axis = _Branch(z[:, None] * _UP, np.tile(_UP, (layers, 1)), radii)
    means, ring, layer = _sweep(axis, _POT_SPACING)
    bottom, top, above_soil = layer == 0, layer == layers - 1, layer > layers - 3
    wall = (ring < 2) | bottom
    ground = ~wall & (layer == layers - 3)
    inside = (ring == 1) & above_soil

    # Outwards on the side, inwards on its inner face, up or down elsewhere, and between at edges.
    vertical = 1.0 * (top | ground) - bottom
    horizontal = np.where(ring == 0, 1, np.where(vertical != 0, 0, 1 - 2 * inside))
    outward = _unit(means * [1, 1, 0] + [1e-9, 0, 0])
    normals = _unit(horizontal[:, None] * outward + vertical[:, None] * _UP)
    surface = (ring == 0) | inside | (vertical != 0)
    # The soil is uneven in colour, and shifted against a too regular lattice.
    tone = np.where(wall, 1, rng.uniform(0.75, 1.3, len(means)))[:, None]
    means = means + np.where(wall[:, None], 0, rng.uniform(-0.004, 0.004, means.shape))
    albedo = tone * np.where(wall[:, None], _TERRACOTTA, _SOIL)
    return _select(_solid(means, normals, surface, _POT_SPACING, albedo), wall | ~above_soil)


def _grow(
    start: np.ndarray, directions: Sequence[np.ndarray], length: float, radii: tuple[float, float]
) -> _Branch:
    """A branch from `start` whose direction and radius turn from one to the other value."""
    count = max(round(length / _WOOD_SPACING), 2) + 1
    t = np.linspace(0, 1, count)[:, None]
    tangents = _unit((1 - t) * directions[0] + t * directions[1])
    steps = length / (count - 1) * (tangents[1:] + tangents[:-1]) / 2
    points = start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    widths = radii[0] + (radii[1] - radii[0]) * t[:, 0]
    widths[-1] *= 0.55  # a rounded tip
    return _Branch(points, tangents, widths)


def _direction(azimuth: float, degrees: float) -> np.ndarray:
    """The unit vector of an azimuth in radians and an elevation in degrees."""
    return _unit(np.array([math.cos(azimuth), math.sin(azimuth), math.tan(math.radians(degrees))]))


def _tree(rng: np.random.Generator) -> list[_Branch]:
    """The trunk first, rooted in the soil; then its boughs, and two branches from each of them."""
    lean = rng.uniform(0, 2 * math.pi)
    ends = (_direction(lean, 60.0), _direction(lean + math.pi, 72.0))
    root = np.array([0, 0, 0.14]) - 0.02 * _direction(lean, 0.0)
    trunk = _grow(root, ends, 0.46, (0.040, 0.031))
    trunk.radii[0] *= 0.55
    # A flare where the trunk leaves the soil.
    trunk.radii[:] += 0.006 * np.exp(-(((trunk.points[:, 2] - 0.24) / 0.04) ** 2))
    branches = [trunk]
    for i, rise in enumerate(np.linspace(0, 1, 6)):
        azimuth = lean + i * _GOLDEN_ANGLE + rng.uniform(-0.2, 0.2)
        elevation = 16 + 62 * rise
        ends = (_direction(azimuth, elevation), _direction(azimuth, 38 + 40 * rise))
        length = rng.uniform(0.18, 0.21) + 0.06 * rise
        bough = _grow(trunk.at(0.86 + 0.14 * rise), ends, length, (0.025, 0.0215))
        branches.append(bough)
        for side, place in ((-1, 0.5), (1, 0.72)):
            turn = side * rng.uniform(0.75, 1.05) / math.cos(math.radians(0.6 * elevation))
            first = _direction(azimuth + turn, elevation - 5)
            last = _direction(azimuth + turn - 0.4 * side, elevation + 15)
            length = rng.uniform(0.12, 0.15)
            branches.append(_grow(bough.at(place), (first, last), length, (0.0215, 0.0205)))
    return branches


def _depth_inside(points: np.ndarray, branches: Sequence[_Branch]) -> np.ndarray:
    """How deep points lie inside the wood (negative outside), from the nearest place of it."""
    depth = np.full(len(points), -np.inf)
    for branch in branches:
        distance, place = KDTree(branch.points).query(points)
        depth = np.maximum(depth, branch.radii[place] - distance)
    return depth


def _wood(branches: Sequence[_Branch], rng: np.random.Generator) -> _Body:
    """Filled branches; what lies inside an earlier one, or too near to its points, is left out."""
    bodies, earlier = [], np.empty((0, 3))
    for i, branch in enumerate(branches):
        means, ring, place = _sweep(branch, _WOOD_SPACING)
        kept = _depth_inside(means, branches[:i]) < 0.2 * _WOOD_SPACING
        if len(earlier):
            kept &= KDTree(earlier).query(means)[0] > 0.55 * _WOOD_SPACING
        normals = means - branch.points[place] + 1e-6 * branch.tangents[place]
        tip = place == len(branch.points) - 1
        normals = _unit(_unit(normals) + np.where(tip[:, None], branch.tangents[place], 0))
        # Bark in darker and lighter bands, and green towards the tips of the branches.
        bands = rng.uniform(0.9, 1.1, len(branch.points))[place]
        tone = bands * rng.uniform(0.93, 1.07, len(means))
        young = (i > 0) * 0.6 * (place / place.max())[:, None]
        albedo = tone[:, None] * ((1 - young) * _BARK + young * _DARK_GREEN)
        body = _solid(means, normals, (ring == 0) | tip, _WOOD_SPACING, albedo)
        bodies.append(_select(body, kept))
        earlier = np.concatenate([earlier, means[kept]])
    return _Body(*_join(bodies))


def _buds(
    branches: Sequence[_Branch], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where leaves grow: places on the bark, their stalks' directions and their blades' directions.

    They go around each branch by the golden angle, as leaves do, and are denser near its tip.
    """
    points, tangents, radii = _join(branches)
    counts = np.array([len(branch.points) for branch in branches])
    ends = np.cumsum(counts)
    number = np.arange(_LEAVES)
    owner = np.searchsorted(ends, (number + 0.5) / _LEAVES * ends[-1])
    from_tip = np.rint(0.8 * rng.uniform(0, 1, _LEAVES) ** 1.8 * (counts[owner] - 1)).astype(int)
    place, angle = ends[owner] - 1 - from_tip, number[:, None] * _GOLDEN_ANGLE
    e1 = _unit(np.cross(tangents[place], [0.9, 0.4, 0.0]))
    normals = np.cos(angle) * e1 + np.sin(angle) * np.cross(tangents[place], e1)
    places = points[place] + radii[place, None] * normals
    outward = _unit(places - [0, 0, 0.6])
    # At the tip of a branch stalks go on along it.
    sideways = np.where(from_tip[:, None] > 0, 1, 0.5) * normals
    stalks = _unit(sideways + 0.5 * tangents[place] + 0.5 * outward + 0.15 * _UP)
    wander = rng.normal(0, 0.3, places.shape)
    return places, stalks, _unit(0.8 * stalks + 0.8 * outward - 0.1 * _UP + wander)


def _leaves(
    places: np.ndarray, stalks: np.ndarray, blades: np.ndarray, rng: np.random.Generator
) -> _Body:
    """Leaves: a stalk, then pairs of disks left and right of a light midrib on a blade bent down.

    The blade is an arc in the plane of its direction d and normal n: with the angle β over its
    length L it is at `L (d sin(β s) − n (1 − cos(β s))) / β` for s in [0, 1]. The width of each
    half is proportional to `w(s) = s (1 − s) (2 − s)`: round at the stalk, pointed at the tip.
    """
    n = len(places)
    L, width, bend, gap = (
        rng.uniform(low, high, (n, 1, 1))
        for low, high in ((0.09, 0.115), (0.024, 0.029), (0.4, 1.0), (0.010, 0.0135))
    )
    up = _unit(_UP + rng.normal(0, 0.35, blades.shape) + 0.4 * _unit(places - [0, 0, 0.65]))
    across = _unit(np.cross(up, blades))[:, None]
    d, normal, stalk = blades[:, None], np.cross(blades, across[:, 0])[:, None], stalks[:, None]

    s, side, half = _LEAF_S[:, None], _LEAF_SIDE[:, None], np.abs(_LEAF_SIDE[:, None])
    is_stalk, is_rib = (np.arange(len(s))[:, None] < end for end in (_STALK, _STALK + _RIB))
    tangent = d * np.cos(bend * s) - normal * np.sin(bend * s)
    upward = normal * np.cos(bend * s) + d * np.sin(bend * s)
    w = width * 1.5 * math.sqrt(3) * s * (1 - s) * (2 - s)
    slope = width * 1.5 * math.sqrt(3) * (2 - 6 * s + 3 * s * s) / L
    # The halves of the blade rise a little from the midrib.
    fold = 0.3
    sideways = side * across + half * fold * upward
    from_bark = (np.minimum(np.arange(len(s)), _STALK - 1) + 0.7)[:, None] * gap
    arc = L * (d * np.sin(bend * s) - normal * (1 - np.cos(bend * s))) / bend
    means = places[:, None] + from_bark * stalk + arc + 0.5 * w * sideways + 0.001 * is_rib * upward

    # Disks follow the middle of their half of the blade; stalks are round.
    along = np.where(is_stalk, stalk, tangent + 0.5 * slope * sideways)
    flat = _unit(np.cross(along, np.cross(upward - fold * side * across, along)))
    axes = _frames(flat.reshape(-1, 3), along.reshape(-1, 3))
    length = np.where(is_stalk, 0.6 * gap, np.where(is_rib, 0.11, 0.125) * L)
    breadth = np.where(is_rib, 0.0016, np.where(half > 0, 0.40, 0.33) * w)
    thickness = np.where(is_stalk, 0.0016, 0.0012) + 0 * w
    scales = np.concatenate([length, breadth, thickness], axis=-1).reshape(-1, 3)

    # Each leaf has its own green, which is lighter towards the tip and on the midrib.
    lightness = 0.55 * rng.uniform(0, 1, (n, 1, 1)) + 0.35 * s
    green = _DARK_GREEN + lightness * (_LIGHT_GREEN - _DARK_GREEN)
    green = green * rng.uniform(0.8, 1.15, (n, 1, 1))
    albedo = np.where(is_rib, 0.55 * _MIDRIB + 0.45 * green, green).reshape(-1, 3)
    return _Body(means.reshape(-1, 3), axes, scales, albedo, np.full(len(albedo), 0.12))


def _transmittance(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Light that reaches points from a direction, through balls that widen along a cone.

    `T = exp(−Σ ρ a Δt / 2)`, with ρ the Gaussians per volume in a ball, a the area of one of them,
    and Δt the diameter of the ball.
    """
    tree, area, depth = KDTree(points), 1.5e-4, np.zeros(len(points))
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
    light = 0.3 + 0.5 * sky[:, None] + sunlight[:, None] * np.array([1.0, 0.97, 0.88])
    color = np.clip(body.albedo * light, 0.02, 1.0)
    mirror = 2 * facing[:, None] * normal - _LIGHT
    strength = (body.gloss * (0.2 + sunlight))[:, None, None] * np.ones(3)
    c0, c1 = math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi))
    # The basis at degree 1 is c1 (−y, z, −x).
    linear = mirror[:, [1, 2, 0]] * [1, -1, 1] / c1
    sh = np.concatenate([(color[:, None] - 0.5) / c0, linear[:, :, None] * strength], axis=1)
    quaternions = np.roll(Rotation.from_matrix(body.frames).as_quat(), 1, axis=-1)
    parts = (body.means, quaternions, body.scales, np.full(len(normal), 0.95), sh)
    return Gaussians.from_scales(*(jnp.asarray(part, dtype=float) for part in parts))
