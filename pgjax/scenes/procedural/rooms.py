"""Places: ruins on their ground, a sofa with pillows above it."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pgjax.render import concatenate
from pgjax.render.gaussians import Gaussians
from pgjax.scenes.procedural.bodies import UP
from pgjax.scenes.procedural.solids import (
    Distance,
    Places,
    Solid,
    box,
    clouds,
    common,
    cylinder,
    filled,
    hollow,
    mixed,
    placed,
    plain,
    union,
    without,
)

Paint = Callable[[Places], Any]

# Ruins -------------------------------------------------------------------------------------------

_STONE_SPACING, _GROUND_SPACING = 0.0165, 0.025
_COURSE, _BLOCK = 0.075, 0.13  # height and length of the stones of a wall, m
_STONE, _DARK_STONE = np.array([0.56, 0.47, 0.34]), np.array([0.40, 0.33, 0.23])
_MARBLE, _DARK_MARBLE = np.array([0.62, 0.58, 0.52]), np.array([0.46, 0.42, 0.36])
_RUBBLE = np.array([0.52, 0.43, 0.30])  # what is inside
_JOINT, _MOSS = np.array([0.20, 0.16, 0.11]), np.array([0.24, 0.29, 0.12])
_GRASS, _DRY_GRASS, _EARTH = (0.19, 0.24, 0.11), (0.30, 0.31, 0.15), (0.31, 0.25, 0.17)
# The arch: middle of its foot, where its curve begins, radii of the curve, and half its depth, m.
_ARCH_X, _ARCH_Y, _SPRING = 0.04, 0.15, 0.36
_INTRADOS, _EXTRADOS, _ARCH_DEPTH = 0.15, 0.275, 0.07
_VOUSSOIRS = 9
_FLUTES = 9


def ruins(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """An arch, broken columns and stumps of walls on a round of grass, one metre wide.

    The ground is below z = 0 and of larger Gaussians. No shadow falls on it: they would stay when
    the walls are gone.

    Args:
        seed: of the unevenness of colours and stones.
        detail: how many times nearer the Gaussians are.
    """
    parts = [(_arch(), _arch_paint), (_walls(), _wall_paint), *_columns()]
    stones = [Solid(_weathered(shape, seed), paint) for shape, paint in parts]
    lower, upper = (-0.55, -0.45, 0.0), (0.55, 0.4, 0.8)
    built = filled(stones, lower, upper, _STONE_SPACING / detail, seed)
    soil = Solid(
        cylinder((0, 0, -0.05), (0, 0, 0), 1.0, 0.015),
        _ground_paint(union(*(stone.distance for stone in stones))),
        gloss=0.0,
    )
    lower, upper = (-1.05, -1.05, -0.07), (1.05, 1.05, 0.02)
    return concatenate([built, filled([soil], lower, upper, _GROUND_SPACING / detail, seed)])


def _weathered(shape: Distance, seed: int) -> Distance:
    """Stone whose surface has been eaten by the weather."""
    return lambda x: shape(x) + 0.014 * clouds(x, 0.06, seed)


def _broken(shape: Distance, top: Any, slope: Any) -> Distance:
    """Broken off at a rough plane through a point, which rises by a slope along x and along y."""
    normal = np.array([-slope[0], -slope[1], 1.0])
    normal /= np.linalg.norm(normal)
    return common(shape, lambda x: (x - np.asarray(top)) @ normal + 0.06 * clouds(x, 0.05, 7))


def _arch() -> Distance:
    """Two pillars with imposts, and the half circle between them."""
    width = (_EXTRADOS - _INTRADOS) / 2
    parts = []
    for side in (-1, 1):
        x = _ARCH_X + side * (_INTRADOS + width)
        half = np.array([width, _ARCH_DEPTH, _SPRING / 2])
        parts += [
            box((x, _ARCH_Y, _SPRING / 2), half, 0.01),
            box((x, _ARCH_Y, _SPRING), (width + 0.02, _ARCH_DEPTH + 0.02, 0.022), 0.006),
        ]
    middle = np.array([_ARCH_X, _ARCH_Y, _SPRING])
    depth = np.array([0, _ARCH_DEPTH, 0])
    bow = without(
        cylinder(middle - depth, middle + depth, _EXTRADOS, 0.01),
        cylinder(middle - 2 * depth, middle + 2 * depth, _INTRADOS),
        lambda x: x[:, 2] - _SPRING,
    )
    return union(*parts, bow)


def _walls() -> Distance:
    """A wall that descends in steps beside the arch, and a stump on the other side."""
    courses = [  # from x, to x, number of courses
        (0.30, 0.36, 6),
        (0.35, 0.43, 4),
        (0.42, 0.50, 2),
        (-0.50, -0.42, 3),
        (-0.43, -0.34, 2),
        (-0.35, -0.24, 4),
    ]
    return union(
        *(
            box(
                ((a + b) / 2, _ARCH_Y, n * _COURSE / 2),
                ((b - a) / 2 + 0.005, 0.06, n * _COURSE / 2),
                0.012,
            )
            for a, b, n in courses
        )
    )


def _columns() -> list[tuple[Distance, Paint]]:
    """A tall and two short columns, broken off, and a drum that has fallen long ago."""
    drum = cylinder((-0.10, -0.27, 0.076), (0.06, -0.21, 0.076), 0.082)
    return [
        _column((-0.40, -0.10), 0.082, 0.66, (0.7, 0.2)),
        _column((-0.19, -0.10), 0.075, 0.32, (-0.5, 0.5)),
        _column((0.33, -0.18), 0.082, 0.46, (-0.8, -0.2)),
        (drum, lambda p: _stone(p, _MARBLE, _DARK_MARBLE, np.zeros(len(p.x)))),
    ]


def _column(foot: Any, radius: float, height: float, slope: Any) -> tuple[Distance, Paint]:
    """A fluted shaft in drums on a round base and a square plinth, broken off at a height."""
    x, y = foot

    def groove(p: np.ndarray) -> np.ndarray:
        around = np.cos(_FLUTES * np.arctan2(p[:, 1] - y, p[:, 0] - x))
        return np.maximum(-around, 0) * (p[:, 2] > 0.1)

    def paint(p: Places) -> np.ndarray:
        gap = 0.5 * _near_multiple(p.x[:, 2] + 0.05, 0.21, 0.016)
        return _stone(p, _MARBLE, _DARK_MARBLE, np.maximum(gap, 0.45 * groove(p.x)))

    shaft = cylinder((x, y, 0), (x, y, 0.9), radius)
    fluted = _broken(lambda p: shaft(p) + 0.008 * groove(p), (x, y, height), slope)
    base = cylinder((x, y, 0.02), (x, y, 0.085), radius + 0.018, 0.015)
    plinth = box((x, y, 0.022), (radius + 0.028, radius + 0.028, 0.022), 0.005)
    return union(fluted, base, plinth), paint


def _stone(p: Places, light: np.ndarray, dark: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Uneven stone with joints, moss where rain stays, and rubble inside."""
    color = mixed(clouds(p.x, 0.12, 1) + 0.5 * (p.noise - 0.5), dark, light)
    color = mixed(joint * (p.depth < 0.03), color, _JOINT)
    moss = (clouds(p.x, 0.1, 2) - 0.5) * 4 * np.clip(p.normal[:, 2], 0, 1)
    color = mixed(moss * (p.depth < 0.015), color, _MOSS)
    return mixed(p.depth / 0.03 - 0.5, color, _RUBBLE * (0.85 + 0.3 * p.noise[:, None]))


def _near_multiple(value: np.ndarray, step: float, width: Any) -> np.ndarray:
    """Whether values are within half a width of a multiple of a step."""
    return np.abs((value + step / 2) % step - step / 2) < width / 2


def _wall_paint(p: Places) -> np.ndarray:
    """Courses of blocks, each shifted by half a block against the one below."""
    course = np.floor(p.x[:, 2] / _COURSE)
    along = p.x[:, 0] + course % 2 * _BLOCK / 2
    joint = _near_multiple(p.x[:, 2], _COURSE, 0.018) | _near_multiple(along, _BLOCK, 0.018)
    return _stone(p, _STONE, _DARK_STONE, 0.75 * joint)


def _arch_paint(p: Places) -> np.ndarray:
    """Large blocks below, wedge-shaped ones in the curve."""
    x, z = p.x[:, 0] - _ARCH_X, p.x[:, 2] - _SPRING
    around = np.arctan2(z, x) / np.pi * _VOUSSOIRS
    wedge = _near_multiple(around, 1, 0.04 / np.maximum(np.hypot(x, z), 0.1))
    joint = np.where(z > 0.02, wedge, _near_multiple(p.x[:, 2], _SPRING / 4, 0.018))
    return _stone(p, _STONE * 1.05, _DARK_STONE, 0.75 * joint)


def _ground_paint(standing: Distance) -> Paint:
    """Grass with bare earth, most of it about the walls."""

    def paint(p: Places) -> np.ndarray:
        grass = mixed(clouds(p.x, 0.12, 3) + 0.6 * (p.noise - 0.5), _GRASS, _DRY_GRASS)
        near = np.exp(-np.maximum(standing(p.x + 0.03 * UP), 0) / 0.08)
        bare = 2.5 * (clouds(p.x, 0.2, 4) - 0.55) + near + 0.4 * (p.noise - 0.5)
        bare = np.maximum(bare, (p.normal[:, 2] < 0.5) * 1.0)
        return mixed(bare, grass, _EARTH)

    return paint


# A sofa and pillows ------------------------------------------------------------------------------

_SOFA_SPACING, _PILLOW_SPACING = 0.022, 0.0125
_SOFA_SKIN = 0.045  # as nobody sees more of it
_SEAT = 0.26  # its height, m
_FABRIC, _DARK_FABRIC, _WOOD = (0.20, 0.34, 0.36), (0.13, 0.23, 0.25), (0.34, 0.20, 0.10)
_WHITE, _STUFFING = np.array([0.60, 0.58, 0.54]), np.array([0.58, 0.56, 0.52])
_PILLOW_HALF = np.array([0.165, 0.15])  # from its middle to where the corners are, m
_PILLOW_EDGE, _PILLOW_BULGE, _PILLOW_WAIST = 0.017, 0.058, 0.10


def sofa_suite(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A sofa 1.2 m wide on the plane z = 0, and three pillows above its seat.

    What is above z = 0.42 and in front of the back (y < 0.12) are the pillows. No shadow of them
    falls on the sofa, as they will fall themselves.

    Args:
        seed: of the unevenness of colours.
        detail: how many times nearer the Gaussians are.
    """
    pillows = [
        ((-0.25, -0.07, 0.58), (32, 0, 12), _dots),
        ((0.25, -0.06, 0.60), (28, 0, -10), _zigzag),
        ((0.01, -0.08, 0.84), (15, 12, 5), _checks),
    ]
    # One by one: no shadow of one falls on another.
    spacing, around = _PILLOW_SPACING / detail, 1.1 * np.hypot(*_PILLOW_HALF)
    falling = [
        filled([_pillow(*pillow)], pillow[0] - around, pillow[0] + around, spacing, seed + index)
        for index, pillow in enumerate(pillows)
    ]
    lower, upper = (-0.65, -0.33, 0), (0.65, 0.33, 0.7)
    sofa = filled(_sofa(), lower, upper, _SOFA_SPACING / detail, seed)
    return concatenate([*falling, sofa])


def _sofa() -> list[Solid]:
    """A frame with arms and a back, three cushions to sit on and three to lean on, and feet."""
    third = 0.16  # half the width of a cushion
    frame = union(
        box((0, 0, 0.12), (0.59, 0.27, 0.06), 0.02),
        box((0, 0.235, 0.34), (0.59, 0.055, 0.28), 0.04),
        _left_and_right(box((0.54, -0.01, 0.24), (0.06, 0.29, 0.18), 0.045)),
    )
    seat = box((0, -0.07, _SEAT - 0.05), (third, 0.22, 0.05), 0.025)
    back = box((0, 0.17, _SEAT + 0.15), (third, 0.045, 0.17), 0.035)
    cushion = union(seat, back)
    cushions = union(cushion, _left_and_right(placed(cushion, (2 * third, 0, 0))))
    feet = union(*(cylinder((0.53, y, 0), (0.53, y, 0.08), 0.026) for y in (-0.23, 0.22)))
    return [
        Solid(hollow(cushions, _SOFA_SKIN), _cloth(_FABRIC), gloss=0.02),
        Solid(hollow(frame, _SOFA_SKIN), _cloth(_DARK_FABRIC), gloss=0.02),
        Solid(_left_and_right(feet), plain(_WOOD), gloss=0.15),
    ]


def _left_and_right(part: Distance) -> Distance:
    """What is drawn for x > 0 is there for x < 0, too."""
    return lambda x: part(np.abs(x) * [1, 0, 0] + x * [0, 1, 1])


def _cloth(color: Any) -> Paint:
    """Fabric with a weave that can just be seen."""
    return lambda p: (
        np.asarray(color) * (0.85 + 0.2 * clouds(p.x, 0.05, 6) + 0.1 * p.noise)[:, None]
    )


def _pillow(center: Any, turn: Any, cover: Callable[[np.ndarray], np.ndarray]) -> Solid:
    """A pillow with a seam around it and corners that stand out.

    Args:
        center: its middle, m.
        turn: from lying flat, a rotation vector in degrees.
        cover: the colours of places `(n, 2)` along and across, in metres from the middle.
    """
    back = Rotation.from_rotvec(np.radians(turn)).as_matrix()

    def local(x: np.ndarray) -> np.ndarray:
        return (x - np.asarray(center)) @ back

    def across(x: np.ndarray) -> np.ndarray:
        """From 0 in the middle to 1 on the seam, in both directions."""
        waist = 1 - _PILLOW_WAIST * np.maximum(1 - (x[:, 1::-1] / _PILLOW_HALF[::-1]) ** 2, 0)
        return np.abs(x[:, :2]) / (_PILLOW_HALF * waist)

    def shape(x: np.ndarray) -> np.ndarray:
        x = local(x)
        u = across(x)
        bulge = np.sqrt(np.prod(np.maximum(1 - u**2, 0), axis=-1))
        seam = (u - 1).max(axis=-1) * 0.75 * _PILLOW_HALF.min()
        return np.maximum(seam, 0.6 * (np.abs(x[:, 2]) - _PILLOW_EDGE - _PILLOW_BULGE * bulge))

    def paint(p: Places) -> np.ndarray:
        x = local(p.x)
        color = mixed((across(x).max(axis=-1) > 0.93) * 1.0, cover(x[:, :2]), _WHITE)
        return mixed(p.depth / 0.015 - 0.5, color, _STUFFING)

    return Solid(shape, paint, gloss=0.03)


def _dots(x: np.ndarray) -> np.ndarray:
    """White dots on mustard."""
    odd = np.floor(x[:, 1] / 0.06 + 0.5) % 2
    along = np.stack([x[:, 0] + 0.035 * odd, x[:, 1]], axis=-1) / [0.07, 0.06]
    apart = np.linalg.norm((along - np.round(along)) * [0.07, 0.06], axis=-1)
    return mixed((0.023 - apart) * 150, (0.56, 0.36, 0.06), _WHITE)


def _zigzag(x: np.ndarray) -> np.ndarray:
    """White zigzag lines on blue."""
    tooth = np.abs((x[:, 0] / 0.08) % 1 - 0.5) * 0.06
    line = np.abs(((x[:, 1] + tooth) / 0.065) % 1 - 0.5)
    return mixed((0.2 - line) * 10, (0.08, 0.15, 0.38), _WHITE)


def _checks(x: np.ndarray) -> np.ndarray:
    """A red and white check."""
    stripes = (np.abs((x / 0.08) % 1 - 0.5) < 0.25).sum(axis=-1) / 2
    return mixed(stripes, _WHITE, (0.52, 0.07, 0.08))
