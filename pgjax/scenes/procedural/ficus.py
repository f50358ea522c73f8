"""A potted ficus."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from pgjax.render.gaussians import Gaussians
from pgjax.scenes.procedural.bodies import (
    LIGHT,
    UP,
    Body,
    axes,
    disks_and_balls,
    join,
    lit,
    select,
    transmittance,
    unit,
)

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

_TERRACOTTA = np.array([0.70, 0.37, 0.25])
_SOIL = np.array([0.20, 0.13, 0.09])
_BARK = np.array([0.54, 0.44, 0.34])
_DARK_GREEN = np.array([0.14, 0.37, 0.15])
_LIGHT_GREEN = np.array([0.37, 0.55, 0.19])
_MIDRIB = np.array([0.66, 0.80, 0.42])


class _Branch(NamedTuple):
    """A curve with unit tangents and the radius of the wood around it, at m places."""

    points: np.ndarray
    tangents: np.ndarray
    radii: np.ndarray

    def at(self, fraction: float) -> np.ndarray:
        """The point at a fraction of the length."""
        return self.points[round(fraction * (len(self.points) - 1))]


def ficus(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A potted ficus one metre high on the plane z = 0, of some 9000 Gaussians.

    Pot, soil and wood are filled solids; leaves are blades of flat Gaussians on stalks. A sun from
    one side and the sky are baked into the colours, with a faint gloss in the harmonics of degree
    1. The Gaussians of the pot and its soil come first, then those of the wood and the leaves.

    Args:
        seed: decides the shape of the tree and the place of its leaves.
        detail: must be 1: leaves are drawn by hand.

    Raises:
        ValueError: `detail` is not 1.
    """
    if detail != 1:
        raise ValueError(f"Argument `detail` must be 1 for a ficus, but is {detail:g}.")
    rng = np.random.default_rng(seed)
    branches = _tree(rng)
    pot = _pot(rng)
    pot = select(pot, _depth_inside(pot.means, branches) < 0.3 * _WOOD_SPACING)
    leaves = _leaves(*_buds(branches[1:], rng), rng)
    body = Body(*join([pot, _wood(branches, rng), leaves]))
    # A few per cent larger or smaller, for a height of exactly one metre.
    height = body.means[:, 2].max()
    body = body._replace(means=body.means / height, scales=body.scales / height)
    return lit(body, transmittance(body.means, UP), transmittance(body.means, LIGHT))


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
    e1 = unit(np.cross(branch.tangents, first))
    e2 = np.cross(branch.tangents, e1)
    # Half a turn more in every second disk staggers the points, which closes the surface best.
    disks = [_disk(radius, spacing, i % 2 / 2) for i, radius in enumerate(branch.radii)]
    place = np.repeat(np.arange(len(disks)), [len(ring) for _, ring in disks])
    disk, ring = join(disks)
    return branch.points[place] + disk[:, :1] * e1[place] + disk[:, 1:] * e2[place], ring, place


def _pot(rng: np.random.Generator) -> Body:
    """A tapered pot with a rim, two rings thick, filled with soil to below the rim."""
    layers, z = 15, np.linspace(0.005, 0.277, 15)
    radii = np.where(z > 0.22, 0.168, 0.118 + 0.035 * z / 0.22)
    radii[[0, -1]] -= 0.008  # rounded edges
    axis = _Branch(z[:, None] * UP, np.tile(UP, (layers, 1)), radii)
    means, ring, layer = _sweep(axis, _POT_SPACING)
    bottom, top, above_soil = layer == 0, layer == layers - 1, layer > layers - 3
    wall = (ring < 2) | bottom
    ground = ~wall & (layer == layers - 3)
    inside = (ring == 1) & above_soil

    # Outwards on the side, inwards on its inner face, up or down elsewhere, and between at edges.
    vertical = 1.0 * (top | ground) - bottom
    horizontal = np.where(ring == 0, 1, np.where(vertical != 0, 0, 1 - 2 * inside))
    outward = unit(means * [1, 1, 0] + [1e-9, 0, 0])
    normals = unit(horizontal[:, None] * outward + vertical[:, None] * UP)
    surface = (ring == 0) | inside | (vertical != 0)
    # The soil is uneven in colour, and shifted against a too regular lattice.
    tone = np.where(wall, 1, rng.uniform(0.75, 1.3, len(means)))[:, None]
    means = means + np.where(wall[:, None], 0, rng.uniform(-0.004, 0.004, means.shape))
    albedo = tone * np.where(wall[:, None], _TERRACOTTA, _SOIL)
    return select(
        disks_and_balls(means, normals, surface, _POT_SPACING, albedo), wall | ~above_soil
    )


def _grow(
    start: np.ndarray, directions: Sequence[np.ndarray], length: float, radii: tuple[float, float]
) -> _Branch:
    """A branch from `start` whose direction and radius turn from one to the other value."""
    count = max(round(length / _WOOD_SPACING), 2) + 1
    t = np.linspace(0, 1, count)[:, None]
    tangents = unit((1 - t) * directions[0] + t * directions[1])
    steps = length / (count - 1) * (tangents[1:] + tangents[:-1]) / 2
    points = start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    widths = radii[0] + (radii[1] - radii[0]) * t[:, 0]
    widths[-1] *= 0.55  # a rounded tip
    return _Branch(points, tangents, widths)


def _direction(azimuth: float, degrees: float) -> np.ndarray:
    """The unit vector of an azimuth in radians and an elevation in degrees."""
    return unit(np.array([math.cos(azimuth), math.sin(azimuth), math.tan(math.radians(degrees))]))


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


def _wood(branches: Sequence[_Branch], rng: np.random.Generator) -> Body:
    """Filled branches; what lies inside an earlier one, or too near to its points, is left out."""
    bodies, earlier = [], np.empty((0, 3))
    for i, branch in enumerate(branches):
        means, ring, place = _sweep(branch, _WOOD_SPACING)
        kept = _depth_inside(means, branches[:i]) < 0.2 * _WOOD_SPACING
        if len(earlier):
            kept &= KDTree(earlier).query(means)[0] > 0.55 * _WOOD_SPACING
        normals = means - branch.points[place] + 1e-6 * branch.tangents[place]
        tip = place == len(branch.points) - 1
        normals = unit(unit(normals) + np.where(tip[:, None], branch.tangents[place], 0))
        # Bark in darker and lighter bands, and green towards the tips of the branches.
        bands = rng.uniform(0.9, 1.1, len(branch.points))[place]
        tone = bands * rng.uniform(0.93, 1.07, len(means))
        young = (i > 0) * 0.6 * (place / place.max())[:, None]
        albedo = tone[:, None] * ((1 - young) * _BARK + young * _DARK_GREEN)
        body = disks_and_balls(means, normals, (ring == 0) | tip, _WOOD_SPACING, albedo)
        bodies.append(select(body, kept))
        earlier = np.concatenate([earlier, means[kept]])
    return Body(*join(bodies))


def _buds(
    branches: Sequence[_Branch], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where leaves grow: places on the bark, their stalks' directions and their blades' directions.

    They go around each branch by the golden angle, as leaves do, and are denser near its tip.
    """
    points, tangents, radii = join(branches)
    counts = np.array([len(branch.points) for branch in branches])
    ends = np.cumsum(counts)
    number = np.arange(_LEAVES)
    owner = np.searchsorted(ends, (number + 0.5) / _LEAVES * ends[-1])
    from_tip = np.rint(0.8 * rng.uniform(0, 1, _LEAVES) ** 1.8 * (counts[owner] - 1)).astype(int)
    place, angle = ends[owner] - 1 - from_tip, number[:, None] * _GOLDEN_ANGLE
    e1 = unit(np.cross(tangents[place], [0.9, 0.4, 0.0]))
    normals = np.cos(angle) * e1 + np.sin(angle) * np.cross(tangents[place], e1)
    places = points[place] + radii[place, None] * normals
    outward = unit(places - [0, 0, 0.6])
    # At the tip of a branch stalks go on along it.
    sideways = np.where(from_tip[:, None] > 0, 1, 0.5) * normals
    stalks = unit(sideways + 0.5 * tangents[place] + 0.5 * outward + 0.15 * UP)
    wander = rng.normal(0, 0.3, places.shape)
    return places, stalks, unit(0.8 * stalks + 0.8 * outward - 0.1 * UP + wander)


def _leaves(
    places: np.ndarray, stalks: np.ndarray, blades: np.ndarray, rng: np.random.Generator
) -> Body:
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
    up = unit(UP + rng.normal(0, 0.35, blades.shape) + 0.4 * unit(places - [0, 0, 0.65]))
    across = unit(np.cross(up, blades))[:, None]
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
    flat = unit(np.cross(along, np.cross(upward - fold * side * across, along)))
    own = axes(flat.reshape(-1, 3), along.reshape(-1, 3))
    length = np.where(is_stalk, 0.6 * gap, np.where(is_rib, 0.11, 0.125) * L)
    breadth = np.where(is_rib, 0.0016, np.where(half > 0, 0.40, 0.33) * w)
    thickness = np.where(is_stalk, 0.0016, 0.0012) + 0 * w
    scales = np.concatenate([length, breadth, thickness], axis=-1).reshape(-1, 3)

    # Each leaf has its own green, which is lighter towards the tip and on the midrib.
    lightness = 0.55 * rng.uniform(0, 1, (n, 1, 1)) + 0.35 * s
    green = _DARK_GREEN + lightness * (_LIGHT_GREEN - _DARK_GREEN)
    green = green * rng.uniform(0.8, 1.15, (n, 1, 1))
    albedo = np.where(is_rib, 0.55 * _MIDRIB + 0.45 * green, green).reshape(-1, 3)
    return Body(means.reshape(-1, 3), own, scales, albedo, np.full(len(albedo), 0.12))
