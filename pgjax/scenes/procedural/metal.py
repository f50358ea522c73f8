"""Things of metal: a soda can under a press, and a toy aeroplane."""

from collections.abc import Sequence

import numpy as np

from pgjax.render.gaussians import Gaussians, concatenate
from pgjax.scenes.procedural.solids import (
    Distance,
    Places,
    Solid,
    blend,
    clouds,
    cylinder,
    ellipsoid,
    extruded,
    filled,
    hollow,
    limb,
    mixed,
    on_both_sides,
    placed,
    plain,
    turned_profile,
    union,
)

_CAN_SPACING = 0.02
_CAN_RADIUS, _CAN_WALL = 0.26, 0.047
# Radius and height, m, from the foot of a can along its outside to the middle of its lid.
_CAN_PROFILE = (
    (0, 0.03), (0.15, 0.03), (0.18, 0), (0.215, 0), (_CAN_RADIUS, 0.065),
    (_CAN_RADIUS, 0.86), (0.215, 0.955), (0.215, 1.0), (0.185, 1.0), (0.17, 0.97), (0, 0.97),
)  # fmt: skip
_PLANE_SPACING = 0.0125
# Height of the axis of the fuselage, m.
_AXIS = 0.22

_ALUMINIUM = np.array([0.50, 0.51, 0.53])
_CAN_RED = np.array([0.50, 0.03, 0.05])
_WHITE = np.array([0.60, 0.60, 0.58])
_STEEL = np.array([0.26, 0.28, 0.31])
_TABLE = np.array([0.40, 0.28, 0.18])
_PAINT_RED = np.array([0.52, 0.06, 0.04])
_YELLOW = np.array([0.58, 0.42, 0.05])
_GLASS = np.array([0.08, 0.17, 0.30])
_BLACK = np.array([0.06, 0.06, 0.07])
_RAW = np.array([0.45, 0.45, 0.46])


def can(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A hollow soda can, one metre high, on a table and under the plate of a press.

    The can is from z = 0 to 1, of some 13 000 Gaussians; the plate is above 1.05, and the table,
    on which the can casts no shadow, below 0.

    Args:
        seed: of the noise in colours and places.
        detail: 2 for Gaussians half as far apart.
    """
    spacing = _CAN_SPACING / detail
    shell = hollow(turned_profile(_CAN_PROFILE), _CAN_WALL)
    tab = ellipsoid((0.03, 0, 0.985), (0.075, 0.042, 0.024))
    solids = [Solid(tab, plain(_ALUMINIUM), gloss=0.3), Solid(shell, _label, gloss=0.3)]
    body = filled(solids, (-0.3, -0.3, 0), (0.3, 0.3, 1.04), spacing, seed)
    return concatenate([body, _press(spacing, seed), _table(spacing, seed)])


def _label(p: Places) -> np.ndarray:
    """A red label with a white wave and a badge, between rims of aluminium."""
    x, y, z = p.x.T
    angle = np.arctan2(y, x)
    wave = np.abs(z - 0.42 - 0.09 * np.sin(2 * angle + 1)) < 0.055
    thread = np.abs(z - 0.315 - 0.09 * np.sin(2 * angle + 1)) < 0.016
    # One badge in front, and one behind.
    across = _CAN_RADIUS * np.abs(np.mod(angle + 1.05 + np.pi / 2, np.pi) - np.pi / 2)
    badge = np.hypot(across, z - 0.68) < 0.11
    core = np.hypot(across, z - 0.68) < 0.07
    white = (wave | thread | badge) & ~core
    label = mixed(white * 1.0, _CAN_RED, _WHITE)
    label = np.where(core[:, None], _YELLOW, label)
    printed = (z > 0.085) & (z < 0.85) & (np.hypot(x, y) > _CAN_RADIUS - 0.6 * _CAN_WALL)
    return np.where(printed[:, None], label, _ALUMINIUM) * (0.95 + 0.1 * p.noise)[:, None]


def _press(spacing: float, seed: int) -> Gaussians:
    """A round plate of steel on a rod."""
    plate = cylinder((0, 0, 1.05), (0, 0, 1.1), 0.37, 0.01)
    rod = cylinder((0, 0, 1.08), (0, 0, 1.3), 0.06, 0.01)
    steel = Solid(union(plate, rod), plain(_STEEL, 0.1), gloss=0.2)
    return filled([steel], (-0.4, -0.4, 1.0), (0.4, 0.4, 1.32), spacing, seed)


def _table(spacing: float, seed: int) -> Gaussians:
    """A wooden disk whose upper side is the plane z = 0."""

    def paint(p: Places) -> np.ndarray:
        grain = clouds(p.x * [0.25, 2, 1], 0.05, seed)
        return _TABLE * (0.75 + 0.4 * grain + 0.1 * p.noise)[:, None]

    disk = cylinder((0, 0, -2.5 * spacing), (0, 0, 0), 0.6, 0.5 * spacing)
    return filled([Solid(disk, paint)], (-0.65, -0.65, -0.1), (0.65, 0.65, 0.05), spacing, seed)


def plane(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A toy aeroplane with a propeller, its nose along x, one metre long, of 13 000 Gaussians.

    It hovers: the axis of the fuselage is 0.22 m above the plane z = 0.

    Args:
        seed: of the noise in colours and places.
        detail: 2 for Gaussians half as far apart.
    """
    solids = [
        Solid(_propeller(), plain(_BLACK), gloss=0.2),
        Solid(_spinner(), plain(_YELLOW), gloss=0.3),
        Solid(_wings(), _wing_paint, gloss=0.2),
        Solid(_tail_planes(), _tail_paint, gloss=0.2),
        Solid(_fuselage(), _fuselage_paint, gloss=0.25),
    ]
    return filled(solids, (-0.55, -0.5, 0), (0.55, 0.5, 0.5), _PLANE_SPACING / detail, seed)


def _fuselage() -> Distance:
    """A tapered body with a cockpit's bulge."""
    return blend(
        0.012,
        limb((0.12, 0, _AXIS), (-0.46, 0, _AXIS + 0.03), 0.092, 0.03),
        limb((0.12, 0, _AXIS), (0.34, 0, _AXIS), 0.092, 0.075),
        ellipsoid((0.1, 0, _AXIS + 0.085), (0.12, 0.055, 0.055)),
    )


def _fuselage_paint(p: Places) -> np.ndarray:
    """Red with a white belly and a white ring, a cockpit of glass and three windows a side."""
    x, y, z = p.x.T
    z = z - _AXIS
    below = z < -0.025 + 0.08 * np.clip(-x, 0, 1)
    band = np.abs(x + 0.27) < 0.022
    color = mixed((below | band) * 1.0, _PAINT_RED, _WHITE)
    color = np.where((x > 0.335)[:, None], _YELLOW, color)
    frame = (np.abs(x - 0.12) < 0.009) | (np.abs(z - 0.083) < 0.008)
    cockpit = (((x - 0.1) / 0.115) ** 2 + ((z - 0.085) / 0.06) ** 2 < 1) & (z > 0.078)
    windows = [np.hypot(x - at, z - 0.022) < 0.02 for at in (-0.06, -0.125, -0.19)]
    glass = (cockpit & ~frame) | (np.any(windows, axis=0) & (np.abs(y) > 0.03))
    color = np.where(glass[:, None], _GLASS, color)
    return _skinned(p, color)


def _board(corners: Sequence[tuple[float, float]], axis: int) -> Distance:
    """A flat part with rounded edges, 0.01 m larger than its corners say."""
    core = extruded(corners, 0.011, axis)
    return lambda x: core(x) - 0.01


def _wings() -> Distance:
    corners = [(0.16, 0), (0.14, 0.4), (0.11, 0.455), (0.04, 0.455), (0.01, 0.4), (-0.02, 0)]
    return placed(on_both_sides(_board(corners, axis=2)), (0, 0, _AXIS - 0.04))


def _wing_paint(p: Places) -> np.ndarray:
    """White with red tips and a red stripe."""
    side = np.abs(p.x[:, 1])
    red = (side > 0.39) | (np.abs(side - 0.31) < 0.018)
    return _skinned(p, mixed(red * 1.0, _WHITE, _PAINT_RED))


def _tail_planes() -> Distance:
    """A fin and two stabilisers."""
    corners = [(-0.36, 0), (-0.395, 0.15), (-0.41, 0.165), (-0.465, 0.165), (-0.47, 0)]
    stabilisers = placed(on_both_sides(_board(corners, axis=2)), (0, 0, _AXIS + 0.03))
    fin = [(-0.29, 0.03), (-0.41, 0.205), (-0.475, 0.205), (-0.475, 0.03)]
    return union(stabilisers, placed(_board(fin, axis=1), (0, 0, _AXIS)))


def _tail_paint(p: Places) -> np.ndarray:
    """White with red tips."""
    tip = (np.abs(p.x[:, 1]) > 0.125) | (p.x[:, 2] - _AXIS > 0.155)
    return _skinned(p, mixed(tip * 1.0, _WHITE, _PAINT_RED))


def _propeller() -> Distance:
    """Three flat blades."""
    blade = ellipsoid((0, 0, 0.105), (0.019, 0.033, 0.1))
    blades = [placed(blade, (0.435, 0, _AXIS), (turn, 0, 0)) for turn in (10, 130, 250)]
    return union(*blades)


def _spinner() -> Distance:
    return limb((0.4, 0, _AXIS), (0.475, 0, _AXIS), 0.048, 0.02)


def _skinned(p: Places, color: np.ndarray) -> np.ndarray:
    """Paint outside, bare metal inside."""
    bare = np.clip((p.depth - 0.008) / 0.01, 0, 1)
    return mixed(bare, color, _RAW) * (0.95 + 0.1 * p.noise)[:, None]
