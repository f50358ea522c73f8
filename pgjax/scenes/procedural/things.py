"""Things: flowers in a vase, a microphone, balls that show a material."""

from collections.abc import Callable
from itertools import pairwise
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
    ball,
    box,
    clouds,
    cylinder,
    ellipsoid,
    filled,
    limb,
    mixed,
    plain,
    ring,
    turned_profile,
    union,
    without,
)

Paint = Callable[[Places], Any]


def _facing(direction: Any) -> np.ndarray:
    """The smallest rotation that turns z into a direction, `(3, 3)`."""
    target = np.asarray(direction, float) / np.linalg.norm(direction)
    return Rotation.align_vectors([target], [[0, 0, 1]])[0].as_matrix()


def _posed(shape: Distance, paint: Paint, center: Any, direction: Any, gloss: float) -> Solid:
    """A solid that is drawn about the origin and along z, at a place and along a direction."""
    turn, c = _facing(direction), np.asarray(center, float)
    return Solid(
        lambda x: shape((x - c) @ turn),
        lambda p: paint(p._replace(x=(p.x - c) @ turn, normal=p.normal @ turn)),
        gloss,
    )


# A vase ------------------------------------------------------------------------------------------

_FLOWER_SPACING, _DECK_SPACING = 0.0155, 0.02
# Outside up and inside down, radius and height, m.
_VASE = [
    *[(0, 0), (0.10, 0), (0.112, 0.012), (0.148, 0.09), (0.158, 0.16), (0.146, 0.23)],
    *[(0.112, 0.30), (0.102, 0.34), (0.108, 0.37), (0.125, 0.40), (0.115, 0.412), (0.09, 0.40)],
    *[(0.068, 0.36), (0.066, 0.32), (0.10, 0.24), (0.112, 0.16), (0.105, 0.10), (0.08, 0.05)],
    (0, 0.05),
]
_PORCELAIN, _COBALT, _GOLD = (0.58, 0.60, 0.62), (0.07, 0.14, 0.45), (0.55, 0.40, 0.12)
_STEM, _LEAF, _LEAF_RIB = (0.16, 0.36, 0.10), (0.12, 0.34, 0.12), (0.30, 0.50, 0.20)
_STEM_RADIUS = 0.0185
_GERBERA, _PETALS = 0.098, 11  # its radius, m, and how many petals it has
# Each flower: where its blossom is, whether a gerbera (or a tulip), and its colour.
_FLOWERS = [
    ((0.02, 0.03, 0.90), False, (0.60, 0.10, 0.12)),
    ((0.21, -0.06, 0.80), True, (0.60, 0.26, 0.05)),
    ((0.07, -0.22, 0.70), True, (0.60, 0.14, 0.32)),
    ((-0.17, -0.14, 0.78), True, (0.60, 0.52, 0.10)),
    ((-0.22, 0.08, 0.86), False, (0.45, 0.18, 0.55)),
    ((-0.03, 0.22, 0.80), True, (0.58, 0.50, 0.52)),
    ((0.17, 0.15, 0.88), False, (0.60, 0.33, 0.10)),
]


def vasedeck(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A porcelain vase of gerberas and tulips, one metre high, on a deck of boards below z = 0.

    Args:
        seed: of the unevenness of colours.
        detail: how many times nearer the Gaussians are.
    """
    solids = [Solid(turned_profile(_VASE), _vase_paint, gloss=0.3)]
    for index, (place, open_wide, color) in enumerate(_FLOWERS):
        solids += _flower(np.array(place), open_wide, color, index)
    lower, upper = (-0.4, -0.4, 0.0), (0.4, 0.4, 1.05)
    bouquet = filled(solids, lower, upper, _FLOWER_SPACING / detail, seed)
    boards = Solid(box((0, 0, -0.025), (0.62, 0.47, 0.025), 0.008), _deck_paint, gloss=0.06)
    # The vase stays where it is, and so may its shadow.
    foot = Solid(turned_profile(_VASE), plain((0.5, 0.5, 0.5)))
    lower, upper = (-0.7, -0.5, -0.06), (0.7, 0.5, 0.45)
    deck = filled([boards, foot], lower, upper, _DECK_SPACING / detail, seed)
    return concatenate([bouquet, deck[np.asarray(deck.means)[:, 2] < 0]])


def _flower(place: np.ndarray, open_wide: bool, color: Any, index: int) -> list[Solid]:
    """A stem from the neck of the vase to a blossom, with two leaves."""
    outward = place * [1, 1, 0] / max(np.hypot(*place[:2]), 0.05)
    start = 0.03 * outward + 0.12 * UP
    bend = 0.05 * outward + (0.42 + 0.2 * (place[2] - 0.42)) * UP
    t = np.linspace(0, 1, 9)[:, None]
    curve = (1 - t) ** 2 * start + 2 * t * (1 - t) * bend + t**2 * place
    tube = union(*(limb(a, b, _STEM_RADIUS) for a, b in pairwise(curve)))
    direction = outward * (1.0 if open_wide else 0.35) + UP
    head = _gerbera(color) if open_wide else _tulip(color)
    leaves = [_leaf(curve[k], outward, side * 70 + 25 * index) for k, side in ((5, 1), (6, -1))]
    return [_posed(*head, place, direction, 0.05), *leaves, Solid(tube, plain(_STEM))]


def _gerbera(color: Any) -> tuple[Distance, Paint]:
    """A shallow cup of petals about a dark, domed middle."""
    middle = ellipsoid((0, 0, 0.022), (0.034, 0.034, 0.022))

    def cut(x: np.ndarray) -> np.ndarray:
        return np.abs(np.cos(_PETALS / 2 * np.arctan2(x[:, 1], x[:, 0])))

    def shape(x: np.ndarray) -> np.ndarray:
        r = np.hypot(x[:, 0], x[:, 1])
        rim = r - _GERBERA * (0.78 + 0.22 * np.sqrt(cut(x)))
        sheet = np.abs(x[:, 2] - 2.5 * r**2) - 0.0175
        return np.minimum(0.8 * np.maximum(rim, sheet), middle(x))

    def paint(p: Places) -> np.ndarray:
        r = np.hypot(p.x[:, 0], p.x[:, 1]) / _GERBERA
        petal = mixed(0.9 - cut(p.x), color, np.asarray(color) * 0.55)
        petal = mixed(1.2 - 2 * r, petal, np.asarray(color) * 0.6 + [0.1, 0.08, 0])
        dotted = mixed(p.noise, (0.16, 0.10, 0.03), (0.50, 0.36, 0.06))
        flower = np.where((middle(p.x) < 0.008)[:, None], dotted, petal)
        return mixed((p.normal[:, 2] < -0.3) * 0.5, flower, _STEM)

    return shape, paint


def _tulip(color: Any) -> tuple[Distance, Paint]:
    """An egg of petals that close above."""
    egg = ellipsoid((0, 0, 0.045), (0.062, 0.062, 0.085))

    def fold(x: np.ndarray) -> np.ndarray:
        return np.abs(np.sin(1.5 * np.arctan2(x[:, 1], x[:, 0]) + 8 * x[:, 2]))

    def shape(x: np.ndarray) -> np.ndarray:
        tips = 0.112 - 0.03 * (1 - fold(x)) - x[:, 2]
        return np.maximum(egg(x) + 0.01 * (1 - fold(x)) ** 2, -tips)

    def paint(p: Places) -> np.ndarray:
        petal = mixed((0.35 - fold(p.x)) * 3, color, np.asarray(color) * 0.5)
        petal = mixed((p.x[:, 2] - 0.07) * 15, petal, np.asarray(color) * 0.7 + [0.18, 0.15, 0.05])
        return mixed(-(p.x[:, 2] + 0.015) * 60, petal, _STEM)

    return shape, paint


def _leaf(start: np.ndarray, outward: np.ndarray, around: float) -> Solid:
    """A pointed blade that rises from a stem, turned about the vertical away from outward."""
    turn = Rotation.from_euler("z", around, degrees=True)
    away = turn.apply(outward)
    along, half = np.array([0.75, 0.75, 0.8]) * (away + UP), 0.085
    along /= np.linalg.norm(along)
    upper = -away * along[2] + UP * np.hypot(*along[:2])
    axes = np.stack([along, np.cross(upper, along), upper], axis=-1)
    blade = ellipsoid((0, 0, 0), (half, 0.036, 0.019))

    def paint(p: Places) -> np.ndarray:
        local = (p.x - start - half * along) @ axes
        return mixed(1 - np.abs(local[:, 1]) / 0.009, _LEAF, _LEAF_RIB)

    return Solid(lambda x: blade((x - start - 0.9 * half * along) @ axes), paint, 0.12)


def _vase_paint(p: Places) -> np.ndarray:
    """White porcelain with a band of leaves in cobalt, and a golden lip."""
    z, around = p.x[:, 2], np.arctan2(p.x[:, 1], p.x[:, 0])
    wave = np.abs(np.sin(5 * around)) * 0.045
    figure = (np.abs(z - 0.16) < wave) & (np.abs(z - 0.16) > 0.35 * wave)
    lines = (np.abs(z - 0.235) < 0.009) | (np.abs(z - 0.075) < 0.009) | (z < 0.02)
    color = mixed((figure | lines) * (p.depth < 0.02), _PORCELAIN, _COBALT)
    return mixed((np.abs(z - 0.405) < 0.017) * (p.depth < 0.02), color, _GOLD)


def _deck_paint(p: Places) -> np.ndarray:
    """Boards along x with gaps and grain."""
    board = np.floor(p.x[:, 1] / 0.118 + 0.5)
    gap = np.abs((p.x[:, 1] / 0.118) % 1 - 0.5) > 0.43
    grain = clouds((p.x + board[:, None] * [0.7, 0, 0]) * [1, 9, 9], 0.16, 5)
    shade = 0.8 + 0.25 * np.sin(2.4 * board) ** 2
    wood = mixed(grain, (0.36, 0.21, 0.11), (0.52, 0.34, 0.19)) * shade[:, None]
    return mixed(gap * 0.75, wood, (0.10, 0.06, 0.03))


# A microphone ------------------------------------------------------------------------------------

_MICROPHONE_SPACING = 0.015
_CHROME, _BLACK, _GREY = (0.52, 0.53, 0.55), (0.09, 0.09, 0.10), (0.26, 0.26, 0.28)
_MESH, _MESH_GAP, _BRASS = (0.52, 0.53, 0.54), (0.13, 0.13, 0.14), (0.55, 0.42, 0.16)
_RUBBER = (0.30, 0.12, 0.10)  # what is inside
_HEAD, _HEAD_RADIUS = np.array([0, 0, 0.845]), 0.145


def microphone(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """A microphone on a round foot, one metre high: a grille over a tapered body.

    Args:
        seed: of the unevenness of colours.
        detail: how many times nearer the Gaussians are.
    """
    foot = [(0, 0), (0.20, 0), (0.21, 0.012), (0.205, 0.035), (0.10, 0.06), (0.06, 0.075), (0, 0.1)]
    body = [(0, 0.30), (0.055, 0.30), (0.068, 0.32), (0.072, 0.40), (0.088, 0.66), (0.08, 0.72)]
    front = np.array([0, -0.075, 0.56])
    solids = [
        Solid(box(front, (0.020, 0.022, 0.045), 0.01), plain((0.55, 0.08, 0.07)), 0.2),
        Solid(cylinder((0, 0, 0.665), (0, 0, 0.715), 0.108, 0.012), _inside(_BRASS), 0.35),
        Solid(ring(_HEAD, (0, 0, 1), _HEAD_RADIUS - 0.008, 0.02), _inside(_CHROME), 0.35),
        Solid(ball(_HEAD, _HEAD_RADIUS), _grille_paint, 0.15),
        Solid(turned_profile([*body, (0, 0.72)]), _inside(_GREY), 0.25),
        Solid(turned_profile(foot), _inside(_BLACK), 0.2),
        Solid(cylinder((0, 0, 0.04), (0, 0, 0.34), 0.047), _inside(_CHROME), 0.35),
    ]
    lower, upper = (-0.25, -0.25, 0), (0.25, 0.25, 1.02)
    return filled(solids, lower, upper, _MICROPHONE_SPACING / detail, seed)


def _inside(color: Any) -> Paint:
    """A colour over an inside of rubber."""
    return lambda p: mixed(p.depth / 0.02 - 1, plain(color)(p), _RUBBER)


def _grille_paint(p: Places) -> np.ndarray:
    """Wires that cross, on a ball."""
    local = p.x - _HEAD
    around = np.arctan2(local[:, 1], local[:, 0])
    height = np.arcsin(np.clip(local[:, 2] / _HEAD_RADIUS, -1, 1))
    checks = np.sin(8 * (around + height)) * np.sin(8 * (around - height))
    wire = mixed(0.5 + 2 * checks, _MESH_GAP, _MESH)
    return mixed(p.depth / 0.02 - 1, wire, _RUBBER)


# Balls that show a material ----------------------------------------------------------------------

_BALL_SPACING, _FLOOR_SPACING = 0.0145, 0.022
_BALL_RADIUS, _BALL_DISTANCE, _DROP, _TILE = 0.132, 0.37, 0.25, 0.12
_BALL_COLORS = [((0.60, 0.13, 0.20), 0.10), ((0.12, 0.42, 0.22), 0.2), ((0.16, 0.30, 0.55), 0.4)]

_CORE, _STAND = (0.60, 0.58, 0.52), (0.22, 0.22, 0.24)


def materials(seed: int = 0, detail: float = 1.0) -> Gaussians:
    """Three balls on stands, cut open about a white core, above a chequered floor.

    They hang side by side along x, with the stands 0.25 m above the floor; that is below z = 0 and
    takes no shadow of what will fall.

    Args:
        seed: of the unevenness of colours.
        detail: how many times nearer the Gaussians are.
    """
    solids = []
    for index, (color, gloss) in enumerate(_BALL_COLORS):
        solids += _material_ball(((index - 1) * _BALL_DISTANCE, 0, _DROP), color, gloss)
    lower, upper = (-0.55, -0.2, _DROP), (0.55, 0.2, _DROP + 0.4)
    balls = filled(solids, lower, upper, _BALL_SPACING / detail, seed)
    floor = Solid(box((0, 0, -0.025), (0.78, 0.48, 0.025), 0.008), _tiles, gloss=0.0)
    lower, upper = (-0.8, -0.5, -0.06), (0.8, 0.5, 0.01)
    return concatenate([balls, filled([floor], lower, upper, _FLOOR_SPACING / detail, seed)])


def _material_ball(foot: Any, color: Any, gloss: float) -> list[Solid]:
    """A thick shell that is cut open above and in front of a white core, and a stand."""
    # A little forward, for the weight that is missing there.
    middle = np.add(foot, (0, -0.005, 0.02 + _BALL_RADIUS))
    base = turned_profile([(0, 0), (0.125, 0), (0.13, 0.02), (0.115, 0.075), (0, 0.075)])

    def cut(x: np.ndarray) -> np.ndarray:
        across, ahead, above = (x - middle).T
        return np.maximum((np.abs(across + 0.012) + ahead) * np.sqrt(0.5), -above)

    def paint(p: Places) -> np.ndarray:
        within = np.linalg.norm(p.x - middle, axis=-1) < _BALL_RADIUS - 0.012
        face = within & (cut(p.x) < 0.01)
        return mixed(np.maximum(0.7 * face, p.depth / 0.03 - 1), color, 0.45 * np.array(color))

    return [
        Solid(ball(middle, 0.64 * _BALL_RADIUS), plain(_CORE, 0.03), gloss),
        Solid(without(ball(middle, _BALL_RADIUS), cut), paint, gloss),
        Solid(lambda x: base(x - np.asarray(foot)), plain(_STAND), gloss),
    ]


def _tiles(p: Places) -> np.ndarray:
    """A chequered floor."""
    odd = np.floor(p.x[:, :2] / _TILE).sum(axis=-1) % 2
    return mixed(odd, (0.30, 0.31, 0.33), (0.50, 0.51, 0.52)) * (0.96 + 0.08 * p.noise[:, None])
