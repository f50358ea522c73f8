"""Food: a loaf of bread, a slice of toast, jam above bread on a plate, and a cake on a plate."""

import numpy as np

from pgjax.render.gaussians import Gaussians, concatenate
from pgjax.scenes.procedural.solids import (
    Distance,
    Places,
    Solid,
    ball,
    blend,
    box,
    clouds,
    cylinder,
    ellipsoid,
    filled,
    limb,
    mixed,
    placed,
    plain,
    turned_profile,
    union,
)

# Half the axes of the loaf, m, and the power of its shape: 2 would be an ellipsoid.
_LOAF, _LOAF_POWER = np.array([0.5, 0.24, 0.22]), 2.6
_LOAF_HEIGHT = 0.13
# The cuts in its crust: where they cross the crest, and their slant, width and depth.
_CUTS, _SLANT, _CUT_WIDTH, _CUT_DEPTH = (-0.34, -0.17, 0.0, 0.17, 0.34), 0.45, 0.045, 0.035
_CRUST = 0.016

_GOLDEN = np.array([0.56, 0.36, 0.15])
_BROWN = np.array([0.42, 0.21, 0.07])
_DARK_BROWN = np.array([0.22, 0.10, 0.04])
# Inside there is less light.
_CRUMB = np.array([0.84, 0.73, 0.52])
_PORE = np.array([0.62, 0.43, 0.21])
_FLOUR = np.array([0.58, 0.50, 0.38])
_BUTTER = np.array([0.72, 0.62, 0.25])
_CHINA = np.array([0.55, 0.57, 0.60])
_BLUE = np.array([0.12, 0.22, 0.45])
_JAM = np.array([0.50, 0.02, 0.05])
_FRUIT = np.array([0.30, 0.01, 0.04])
_SEED = np.array([0.52, 0.28, 0.10])
_SPONGE = np.array([0.55, 0.37, 0.14])
_CREAM = np.array([0.60, 0.55, 0.49])
_CHERRY = np.array([0.50, 0.02, 0.05])


def bread(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A loaf a metre long, along x, with slanted cuts in its crust and crumb full of pores."""

    def distance(x: np.ndarray) -> np.ndarray:
        return np.maximum(_loaf(x) + _CUT_DEPTH * _cut(x), -x[:, 2])

    def paint(p: Places) -> np.ndarray:
        baked = 0.25 + 0.9 * p.x[:, 2] / (_LOAF_HEIGHT + _LOAF[2]) + clouds(p.x, 0.12, seed) - 0.5
        crust = mixed(1.6 * baked - 0.9, mixed(1.6 * baked, _GOLDEN, _BROWN), _DARK_BROWN)
        floury = np.clip(1.4 * _cut(p.x), 0, 1) * (p.normal[:, 2] > 0)
        crust = mixed(floury, crust * (0.9 + 0.2 * p.noise)[:, None], _GOLDEN * 0.4 + _FLOUR * 0.6)
        return np.where((p.depth < _CRUST)[:, None], crust, _crumb(p, seed))

    solid = Solid(distance, paint, gloss=0.04)
    return filled([solid], (-0.55, -0.3, -0.03), (0.55, 0.3, 0.4), 0.0145 / detail, seed)


def _loaf(x: np.ndarray) -> np.ndarray:
    """Between an ellipsoid and a box; never further than its surface, as its norm is convex."""
    q = np.abs(x - [0, 0, _LOAF_HEIGHT]) / _LOAF + 1e-9
    norm = (q**_LOAF_POWER).sum(axis=-1) ** (1 / _LOAF_POWER)
    slope = np.linalg.norm(q ** (_LOAF_POWER - 1) / _LOAF, axis=-1) * norm ** (1 - _LOAF_POWER)
    return (norm - 1) / slope


def _cut(x: np.ndarray) -> np.ndarray:
    """How much a place above or below the crest belongs to a cut, from 0 to 1."""
    along = x[:, 0] + _SLANT * x[:, 1]
    off = np.min([np.abs(along - cut) for cut in _CUTS], axis=0) / _CUT_WIDTH
    reach = np.clip((0.19 - np.abs(x[:, 1])) / 0.05, 0, 1) * np.clip((x[:, 2] - 0.12) / 0.1, 0, 1)
    return np.clip(1 - off**2, 0, 1) * reach


def _crumb(p: Places, seed: int) -> np.ndarray:
    """Pale crumb, with darker pores."""
    pores = np.maximum(clouds(p.x, 0.04, seed + 1), clouds(p.x, 0.025, seed + 2))
    return mixed(5 * (pores - 0.68) + 0.5 * (p.noise - 0.5), _CRUMB, _PORE)


def toast(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A slice of toast that stands upright across y, browned, with butter on its front."""
    slice_ = placed(_slice(0.07), turn=(90, 0, 0))
    pat = placed(box((0, 0, 0), (0.085, 0.04, 0.075), 0.012), (-0.2, -0.09, 0.6), (0, 12, 0))
    molten = ellipsoid((-0.2, -0.06, 0.56), (0.15, 0.035, 0.17))
    butter = union(pat, blend(0.01, molten, ellipsoid((-0.23, -0.06, 0.42), (0.05, 0.035, 0.12))))

    def paint(p: Places) -> np.ndarray:
        return _toasted(p.x[:, [0, 2]], np.abs(p.normal[:, 1]), p, seed)

    solids = [Solid(butter, plain(_BUTTER), gloss=0.25), Solid(slice_, paint)]
    return filled(solids, (-0.55, -0.2, -0.05), (0.55, 0.15, 1.05), 0.016 / detail, seed)


def _slice(half_thickness: float) -> Distance:
    """A slice of a tin loaf that lies on z = 0: its foot at y = 0, its two lobes towards y = 1."""
    z, top = half_thickness * np.array([[0, 0, 1], [0, 0, -1]]), 0.74
    lobes = [
        cylinder(z[0] + [x, top, 0], z[1] + [x, top, 0], 0.235, rounding=0.03) for x in (-0.2, 0.2)
    ]
    return blend(0.015, box((0, 0.39, 0), (0.39, 0.39, half_thickness), 0.03), *lobes)


def _toasted(plane: np.ndarray, face: np.ndarray, p: Places, seed: int) -> np.ndarray:
    """The colours of a toasted slice, by the two coordinates of its plane.

    Args:
        plane: as in `_slice`, m, `(n, 2)`.
        face: how much the surface is a face of the slice, and not its rim, `(n,)`.
        p: the places.
        seed: of the clouds.
    """
    middle = np.hypot((plane[:, 0]) / 0.42, (plane[:, 1] - 0.48) / 0.48)
    baked = 1.3 - 1.1 * middle**2 + 1.5 * (clouds(p.x, 0.1, seed) - 0.5)
    baked += 0.9 * (clouds(p.x, 0.03, seed + 3) - 0.5) + 0.3 * (p.noise - 0.5)
    browned = mixed(baked, 1.15 * _GOLDEN, 1.1 * _BROWN)
    outside = mixed(3 * (face - 0.6), _DARK_BROWN * (0.8 + 0.4 * p.noise)[:, None], browned)
    return np.where((p.depth < _CRUST)[:, None], outside, _crumb(p, seed))


def jam(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A dollop of red jam above a slice of bread on a plate: all jam is above z = 0.2 m."""
    lumps = [
        ball((0, 0, 0.37), 0.155),
        ball((0.09, 0.03, 0.35), 0.1),
        ball((-0.08, 0.06, 0.37), 0.105),
        ball((-0.02, -0.09, 0.35), 0.1),
    ]
    tip = limb((0.01, 0, 0.47), (0.05, -0.02, 0.6), 0.1, 0.035)
    dollop = blend(0.02, *lumps, tip)

    def paint(p: Places) -> np.ndarray:
        color = mixed(3 * (clouds(p.x, 0.06, seed) - 0.55), _JAM, _FRUIT)
        return np.where((p.noise > 0.985)[:, None], _SEED, color)

    moved = filled(
        [Solid(dollop, paint, gloss=0.3)],
        (-0.25, -0.25, 0.15),
        (0.25, 0.25, 0.65),
        0.0105 / detail,
        seed,
    )
    slice_ = placed(_slice(0.055), (0, -0.46, 0.105))

    def bread_paint(p: Places) -> np.ndarray:
        inside = _crumb(p, seed) * np.array([0.72, 0.72, 0.7])
        rim = np.abs(p.normal[:, 2]) < 0.6
        return np.where(rim[:, None], _BROWN * (0.8 + 0.4 * p.noise)[:, None], inside)

    still = filled(
        [Solid(slice_, bread_paint), _plate(0.6)],
        (-0.65, -0.65, -0.03),
        (0.65, 0.65, 0.2),
        0.017 / detail,
        seed,
    )
    return concatenate([moved, still])


def _plate(radius: float) -> Solid:
    """A plate about the z axis, its flat top at z = 0.05, with a blue ring on its raised rim."""
    r = radius
    profile = [
        (0, 0),
        (0.6 * r, 0),
        (0.66 * r, 0.01),
        (r, 0.045),
        (r, 0.085),
        (0.72 * r, 0.055),
        (0, 0.05),
    ]

    def paint(p: Places) -> np.ndarray:
        off = np.abs(np.hypot(p.x[:, 0], p.x[:, 1]) - 0.93 * r)
        return mixed((off < 0.03 * r) * 1.0, _CHINA, _BLUE)

    return Solid(turned_profile(profile), paint, gloss=0.08)


def cake(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A round cake on a plate, which is all that is below z = 0.055 m.

    Sponge up to 0.42 m; two layers of cream in it, between 0.165 and 0.215 and between 0.305 and
    0.355 m; and cream on top, with rosettes around a cherry, that runs down the side.
    """
    rng = np.random.default_rng(seed)
    layers = [cylinder((0, 0, z), (0, 0, z + 0.05), 0.34, 0.015) for z in (0.165, 0.305)]
    topping = cylinder((0, 0, 0.415), (0, 0, 0.48), 0.345, 0.025)
    drips = [
        limb((*foot, 0.45), (*foot, low), 0.035)
        for foot, low in zip(_circle(11, 0.33), rng.uniform(0.3, 0.41, 11), strict=True)
    ]
    rosettes = [limb((*foot, 0.48), (*foot, 0.56), 0.065, 0.02) for foot in _circle(8, 0.26)]
    cream = union(*layers, blend(0.01, topping, *drips), *rosettes)
    sponge = cylinder((0, 0, 0.065), (0, 0, 0.43), 0.335, 0.02)

    def sponge_paint(p: Places) -> np.ndarray:
        holes = mixed(4 * (clouds(p.x, 0.035, seed) - 0.6), _SPONGE, 0.7 * _SPONGE)
        return holes * (0.9 + 0.2 * p.noise)[:, None]

    solids = [
        Solid(ball((0, 0, 0.54), 0.085), plain(_CHERRY), gloss=0.35),
        Solid(cream, plain(_CREAM, uneven=0.02), gloss=0.08),
        Solid(sponge, sponge_paint),
        _plate(0.6),
    ]
    return filled(solids, (-0.62, -0.62, -0.03), (0.62, 0.62, 0.65), 0.0165 / detail, seed)


def _circle(count: int, radius: float) -> np.ndarray:
    """Places on a circle about the origin of a plane, `(count, 2)`."""
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
