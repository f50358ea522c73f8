"""Animals: a wolf of sand and a sitting fox."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pgjax.render.gaussians import Gaussians, concatenate
from pgjax.scenes.procedural.solids import (
    Distance,
    Places,
    Solid,
    ball,
    blend,
    clouds,
    cylinder,
    ellipsoid,
    filled,
    limb,
    mixed,
    on_both_sides,
    plain,
)

_WOLF_SPACING = 0.0145
_GROUND_SPACING = 0.022
# Height of the ground, m: a little below the paws, so that no Gaussian of the two is level.
_GROUND_TOP = -0.005
_FOX_SPACING = 0.017

_GREY = np.array([0.38, 0.34, 0.295])
_CHARCOAL = np.array([0.16, 0.14, 0.125])
_AMBER = np.array([0.60, 0.38, 0.08])
_CREAM = np.array([0.56, 0.50, 0.41])
_SAND = np.array([0.50, 0.40, 0.26])
_DUNE = np.array([0.56, 0.46, 0.31])

_ORANGE = np.array([0.58, 0.22, 0.05])
_RUST = np.array([0.44, 0.14, 0.03])
_WHITE = np.array([0.60, 0.57, 0.52])
_SOCK = np.array([0.07, 0.05, 0.045])
_BLACK = np.array([0.03, 0.03, 0.03])
_GRASS = np.array([0.17, 0.30, 0.07])
_FLESH = np.array([0.45, 0.14, 0.12])


def wolf(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A standing grey wolf of sand, one metre from nose to tail, looking along x, on sandy ground.

    The wolf is above the plane z = 0, of some 18 000 Gaussians; the ground, a flat disk, below it.

    Args:
        seed: of the noise in colours and places.
        detail: 2 for Gaussians half as far apart.
    """
    nose = ball((0.494, 0, 0.558), 0.022)
    eyes = on_both_sides(ball((0.392, 0.046, 0.618), 0.014))
    solids = [
        Solid(nose, plain(_BLACK, 0.1), gloss=0.15),
        Solid(eyes, plain(_AMBER, 0.1), gloss=0.3),
        Solid(_wolf_body(), _wolf_fur),
    ]
    spacing = _WOLF_SPACING / detail
    statue = filled(solids, (-0.53, -0.2, 0.0), (0.53, 0.2, 0.8), spacing, seed)
    return concatenate([statue, _ground(_DUNE, 0.85, _GROUND_SPACING / detail, seed)])


def fox(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A sitting fox, one metre high, looking along x, on grass.

    The fox is above the plane z = 0, of some 18 000 Gaussians; the grass, a flat disk, below it.

    Args:
        seed: of the noise in colours and places.
        detail: 2 for Gaussians half as far apart.
    """
    nose = ball((0.345, 0, 0.695), 0.026)
    eyes = on_both_sides(ball((0.222, 0.062, 0.752), 0.023))
    solids = [
        Solid(nose, plain(_BLACK, 0.1), gloss=0.3),
        Solid(eyes, plain(_BLACK, 0.1), gloss=0.3),
        Solid(_fox_tail(), _fox_tail_fur),
        Solid(_fox_body(), _fox_fur),
    ]
    spacing = _FOX_SPACING / detail
    animal = filled(solids, (-0.65, -0.3, 0.0), (0.45, 0.3, 1.05), spacing, seed)
    return concatenate([animal, _ground(_GRASS, 0.8, _GROUND_SPACING / detail, seed)])


def _chain(width: float, points: Sequence[Any], radii: Sequence[float]) -> Distance:
    """A limb through several points, with a radius at each of them, without corners."""
    parts = zip(points[:-1], points[1:], radii[:-1], radii[1:], strict=True)
    return blend(width, *(limb(*part) for part in parts))


def _ramp(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """From 0 at the start to 1 at the end, smoothly, `(n,)`."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def _ground(color: np.ndarray, radius: float, spacing: float, seed: int) -> Gaussians:
    """A flat disk; what stands on it casts no shadow."""

    def paint(p: Places) -> np.ndarray:
        tone = 0.8 + 0.2 * clouds(p.x, 0.12, seed) + 0.2 * p.noise
        return color * tone[:, None]

    top = np.array([0, 0, _GROUND_TOP])
    disk = cylinder(top - [0, 0, 2.5 * spacing], top, radius, 0.5 * spacing)
    upper = np.array([radius + spacing, radius + spacing, spacing])
    return filled([Solid(disk, paint)], -np.array([1, 1, 4]) * upper, upper, spacing, seed)


# The wolf ----------------------------------------------------------------------------------------


def _wolf_body() -> Distance:
    """Everything but eyes and nose."""
    trunk = blend(
        0.02,
        ellipsoid((0.12, 0, 0.41), (0.16, 0.115, 0.145)),
        ellipsoid((-0.06, 0, 0.43), (0.2, 0.095, 0.11)),
        ellipsoid((-0.2, 0, 0.43), (0.125, 0.1, 0.115)),
        _chain(0.01, [(0.12, 0, 0.45), (0.22, 0, 0.51), (0.30, 0, 0.57)], [0.135, 0.13, 0.085]),
        on_both_sides(limb((0.29, 0.06, 0.545), (0.245, 0.125, 0.5), 0.055, 0.02)),
    )
    head = blend(
        0.012,
        ellipsoid((0.325, 0, 0.595), (0.085, 0.085, 0.072)),
        limb((0.37, 0, 0.58), (0.475, 0, 0.548), 0.052, 0.034),
        limb((0.36, 0, 0.548), (0.46, 0, 0.523), 0.036, 0.022),
    )
    ear = _chain(
        0.006,
        [(0.29, 0.05, 0.64), (0.286, 0.061, 0.685), (0.282, 0.066, 0.722)],
        [0.038, 0.028, 0.012],
    )
    front = _chain(
        0.008,
        [(0.13, 0.062, 0.36), (0.145, 0.068, 0.21), (0.15, 0.068, 0.035)],
        [0.065, 0.042, 0.034],
    )
    thigh = ellipsoid((-0.2, 0.068, 0.34), (0.085, 0.052, 0.12))
    hind = _chain(
        0.008,
        [(-0.17, 0.072, 0.29), (-0.265, 0.072, 0.175), (-0.24, 0.072, 0.035)],
        [0.055, 0.037, 0.033],
    )
    front_paw = ellipsoid((0.17, 0.068, 0.027), (0.052, 0.039, 0.03))
    hind_paw = ellipsoid((-0.22, 0.072, 0.027), (0.052, 0.039, 0.03))
    legs = on_both_sides(blend(0.012, front, thigh, hind, front_paw, hind_paw))
    tail = _chain(
        0.012,
        [(-0.29, 0, 0.47), (-0.37, 0, 0.40), (-0.43, 0, 0.29), (-0.465, 0, 0.17)],
        [0.045, 0.06, 0.058, 0.018],
    )
    return blend(0.014, trunk, head, on_both_sides(ear), legs, tail)


def _wolf_fur(p: Places) -> np.ndarray:
    """Grey, with a dark saddle and bridge of the nose, pale belly, cheeks and legs; sand inside."""
    x, _, z = p.x.T
    tufts = clouds(p.x * [0.5, 1, 1], 0.03) - 0.5
    up = p.normal[:, 2] + 0.8 * tufts
    saddle = _ramp(up, -0.1, 0.7) * _ramp(z, 0.36, 0.45)
    tail_tip = _ramp(-x - z, 0.16, 0.24) * (x < -0.36)
    below = _ramp(-up, 0.0, 0.6)
    legs = _ramp(-z - 0.1 * tufts, -0.3, -0.14)
    cheeks = _ramp(x, 0.30, 0.34) * _ramp(-z - 0.03 * tufts, -0.575, -0.56)
    pale = np.maximum(np.maximum(below, legs), cheeks) * (x > -0.36)
    ears = (z > 0.66) & (p.normal[:, 0] > 0.5)
    color = mixed(np.maximum(saddle, tail_tip), mixed(pale, _GREY, _CREAM), _CHARCOAL)
    color = np.where(ears[:, None], _CHARCOAL, color)
    color = mixed(_ramp(p.depth, 0.008, 0.02), color, _SAND)
    return color * (0.82 + 0.36 * p.noise)[:, None]


# The fox -----------------------------------------------------------------------------------------


def _fox_body() -> Distance:
    """Everything but tail, eyes and nose."""
    trunk = blend(
        0.025,
        ellipsoid((-0.12, 0, 0.19), (0.17, 0.15, 0.17)),
        limb((-0.1, 0, 0.24), (0.06, 0, 0.5), 0.15, 0.11),
        limb((0.06, 0, 0.48), (0.1, 0, 0.66), 0.115, 0.085),
    )
    head = blend(
        0.015,
        ellipsoid((0.13, 0, 0.745), (0.115, 0.122, 0.1)),
        on_both_sides(limb((0.13, 0.085, 0.70), (0.10, 0.155, 0.672), 0.055, 0.02)),
        limb((0.2, 0, 0.715), (0.325, 0, 0.68), 0.062, 0.03),
    )
    ear = _chain(
        0.008,
        [(0.1, 0.068, 0.81), (0.095, 0.085, 0.89), (0.09, 0.1, 0.985)],
        [0.056, 0.043, 0.012],
    )
    haunch = ellipsoid((-0.1, 0.125, 0.15), (0.15, 0.075, 0.145))
    hind_paw = limb((-0.04, 0.165, 0.038), (0.07, 0.165, 0.036), 0.04, 0.036)
    front = _chain(
        0.01,
        [(0.08, 0.07, 0.42), (0.125, 0.072, 0.24), (0.14, 0.072, 0.045)],
        [0.075, 0.05, 0.042],
    )
    front_paw = ellipsoid((0.165, 0.072, 0.034), (0.066, 0.048, 0.038))
    limbs = blend(0.014, haunch, hind_paw, front, front_paw)
    return blend(0.016, trunk, head, on_both_sides(ear), on_both_sides(limbs))


def _fox_tail() -> Distance:
    return _chain(
        0.015,
        [(-0.22, 0, 0.09), (-0.34, 0, 0.10), (-0.46, 0, 0.17), (-0.53, 0, 0.30), (-0.54, 0, 0.43)],
        [0.055, 0.085, 0.1, 0.09, 0.02],
    )


def _fox_tail_fur(p: Places) -> np.ndarray:
    """Orange, with a white tip."""
    tip = _ramp(p.x[:, 2] + 0.03 * (clouds(p.x, 0.03) - 0.5), 0.30, 0.315)
    return mixed(tip, _tinted(p), _WHITE) * (0.9 + 0.2 * p.noise)[:, None]


def _fox_fur(p: Places) -> np.ndarray:
    """Orange above, white chest, cheeks and muzzle, black socks and ears; flesh inside."""
    x, y, z = p.x.T
    side = np.abs(y)
    rim = z + 0.03 * (clouds(p.x, 0.03) - 0.5)
    chest = (side < 0.085) & (p.normal[:, 0] > 0.25) & (rim > 0.24) & (rim < 0.68) & (x > 0)
    face = (z > 0.6) & (rim < 0.715 - 0.12 * np.maximum(x - 0.23, 0)) & (x > 0.06)
    ear = (z > 0.84) & (p.normal[:, 0] > 0.5) & (side > 0.05)
    socks = _ramp(-rim, -0.26, -0.19) * (x > 0.06)
    socks = np.maximum(socks, _ramp(-rim, -0.085, -0.06) * (x > -0.06))
    tips = _ramp(rim, 0.90, 0.93)
    color = mixed(((chest | face | ear) * 1.0), _tinted(p), _WHITE)
    color = mixed(np.maximum(socks, tips * ~ear), color, _SOCK)
    color = mixed(_ramp(p.depth, 0.012, 0.03), color, _FLESH)
    return color * (0.9 + 0.2 * p.noise)[:, None]


def _tinted(p: Places) -> np.ndarray:
    """Orange, rustier along the back."""
    return mixed(0.8 * _ramp(p.normal[:, 2] - p.normal[:, 0], 0.2, 1.3), _ORANGE, _RUST)
