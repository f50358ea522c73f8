"""What each scene has to show, and by which number it is seen."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.scenes.history import History
from pgjax.measures import heap_angle, turn_between, volume_change
from pgjax.sampling import pieces

Measure = Callable[[History], float]

# A piece is more than a crumb: this part of the particles.
_PIECE = 0.02


class Check(NamedTuple):
    """A number that has to lie between two others, both of which count as inside."""

    what: str
    measure: Measure
    least: float = -math.inf
    most: float = math.inf

    def measured(self, history: History) -> dict:
        """The value, what is demanded of it, and whether it is met."""
        value = float(self.measure(history))
        bounds = [f"≥ {self.least:g}"] if self.least > -math.inf else []
        bounds += [f"≤ {self.most:g}"] if self.most < math.inf else []
        return {
            "what": self.what,
            "value": value,
            "demand": ", ".join(bounds),
            "holds": self.least <= value <= self.most,
        }


# Of the whole body ---------------------------------------------------------------------------


def height(x: np.ndarray) -> float:
    """Height of a body, m, without the thousandth of its particles that lies highest."""
    return float(np.quantile(x[:, 2], 0.999) - x[:, 2].min())


def height_left(history: History) -> float:
    """Final height, as a part of the first."""
    return height(history.last["x"]) / height(history.X)


def spread(history: History) -> float:
    """By how much the body became wider: radius of gyration, as a part of the first."""
    wide = [np.sqrt(np.var(x[:, :2], axis=0).sum()) for x in (history.X, history.last["x"])]
    return wide[1] / wide[0]


def speed_left(history: History) -> float:
    """RMS speed at the end, m/s."""
    return float(np.sqrt(np.mean(np.sum(history.last["v"] ** 2, axis=-1))))


def volume_left(history: History) -> float:
    """Change of the volume at the end, as a part of it."""
    return abs(volume_change(history.last["F"], history.volumes))


def slope(history: History) -> float:
    """Slope of the heap at the end, degrees."""
    return heap_angle(history.last["x"], cell=history.h)


def parts(history: History) -> float:
    """Number of pieces at the end, crumbs apart."""
    labels = pieces(history.last["x"], reach=history.h)
    return float((np.bincount(labels) > _PIECE * len(labels)).sum())


def least_part(history: History) -> float:
    """Particles of the second largest piece, as a part of all."""
    counts = np.bincount(pieces(history.last["x"], reach=history.h), minlength=2)
    return float(counts[1] / counts.sum())


# Of some of its particles --------------------------------------------------------------------


def moved(which: Callable[[History], np.ndarray]) -> Measure:
    """How far some particles were from their places at most, RMS, m."""
    return lambda history: float(_way(history, which).max())


def off(which: Callable[[History], np.ndarray]) -> Measure:
    """How far some particles are from their places at the end, RMS, m."""
    return lambda history: float(_way(history, which)[-1])


def _way(history: History, which: Callable[[History], np.ndarray]) -> np.ndarray:
    """RMS distance of some particles from their places, frame by frame, m."""
    mine = which(history)
    way = history.positions[:, mine] - history.X[mine]
    return np.sqrt(np.mean(np.sum(way**2, axis=-1), axis=-1))


def turned(first: tuple, second: tuple) -> Measure:
    """By how much one box of particles is turned against another at the end, degrees."""
    return lambda history: turn_between(
        history.X, history.last["x"], history.box(*first), history.box(*second)
    )


def most_turned(first: tuple, second: tuple) -> Measure:
    """The same at its largest."""
    return lambda history: max(
        turn_between(history.X, x, history.box(*first), history.box(*second))
        for x in history.positions
    )


def box(lower, upper) -> Callable[[History], np.ndarray]:
    """The particles that start in a box."""
    return lambda history: history.box(lower, upper)


def squeezed(index: int) -> Measure:
    """Least height of a material's particles on the way, as a part of the first."""

    def measure(history: History) -> float:
        mine = history.material(index)
        heights = [height(x) for x in history.positions[:, mine]]
        return min(heights) / heights[0]

    return measure


def height_of(index: int) -> Measure:
    """Final height of a material's particles, as a part of the first."""

    def measure(history: History) -> float:
        mine = history.material(index)
        return height(history.last["x"][mine]) / height(history.X[mine])

    return measure


def jump(history: History) -> float:
    """How far the lowest particle rose at most, m."""
    return float(history.positions[..., 2].min(axis=1).max() - history.X[:, 2].min())


def lowest(history: History) -> float:
    """Height of the lowest particle at the end, m."""
    return float(history.last["x"][:, 2].min())


def highest(history: History) -> float:
    """Height of the highest particle at the end, m."""
    return float(history.last["x"][:, 2].max())


# Of each scene -------------------------------------------------------------------------------

_TAIL, _NOSE = ((-9, -9, -9), (-0.33, 9, 9)), ((0.27, -9, -9), (9, 9, 9))
_VASE, _BLOSSOMS = ((-9, -9, -9), (9, 9, 0.38)), ((-0.14, -0.14, 0.66), (0.14, 0.14, 9))
_FOOT, _HEAD = ((-9, -9, -9), (9, 9, 0.05)), ((-9, -9, 0.75), (9, 9, 9))

REST = Check("speed at the end, m/s", speed_left, most=0.05)
TORN = (
    Check("pieces", parts, 2, 2),
    Check("smaller piece, part of all particles", least_part, least=0.2),
)
HEAP = (
    Check("slope of the heap, degrees", slope, 12, 40),
    Check("final height / first", height_left, most=0.5),
    REST,
)
CHECKS: dict[str, tuple[Check, ...]] = {
    "ficus": (
        Check("the pot moved, m", moved(box((-9, -9, -9), (9, 9, 0.27))), most=1e-6),
        Check("the crown swayed, m", moved(box((-9, -9, 0.5), (9, 9, 9))), least=0.03),
        Check("change of volume", volume_left, most=0.02),
    ),
    "vasedeck": (
        Check("the vase moved, m", moved(box(*_VASE)), most=1e-6),
        Check("blossoms turned, degrees", most_turned(_VASE, _BLOSSOMS), 30, 36),
        Check("stems below them swayed, m", moved(box((-9, -9, 0.45), (9, 9, 0.62))), least=0.01),
    ),
    "fox": (
        Check("the feet left the ground, m", jump, least=0.1),
        Check("final height / first, nodding", height_left, 0.8, 1.05),
        Check("change of volume", volume_left, most=0.02),
    ),
    "plane": (
        Check("nose against tail, degrees", most_turned(_TAIL, _NOSE), least=25),
        Check("and at the end", turned(_TAIL, _NOSE), least=5),
        REST,
    ),
    "toast": TORN,
    "ruins": HEAP,
    "jam": (
        Check("final height / first", height_left, most=0.6),
        Check("final width / first", spread, least=1.25),
        REST,
    ),
    "sofa-suite": (
        Check("lowest particle, m (the seat: 0.25)", lowest, 0.22, 0.32),
        Check("highest particle, m (the back: 0.57)", highest, most=0.6),
        Check("speed at the end, m/s", speed_left, most=0.1),
    ),
    "materials": (
        Check("soft ball squeezed to", squeezed(0), most=0.7),
        Check("middle one", squeezed(1), 0.6, 0.9),
        Check("stiff one", squeezed(2), least=0.9),
    ),
    "microphone": (
        Check("the foot moved, m", moved(box(*_FOOT)), most=1e-6),
        Check("head against foot, degrees", most_turned(_FOOT, _HEAD), least=45),
        Check("change of volume", volume_left, most=0.02),
    ),
    "bread": TORN,
    "cake": (
        Check("final height / first", height_left, most=0.85),
        Check("final width / first", spread, least=1.1),
        REST,
    ),
    "can": (
        Check("can crushed to", squeezed(1), most=0.6),
        Check("and is so at the end", height_of(1), most=0.65),
        REST,
    ),
    "wolf": HEAP,
}
"""The scenes, in the order of the source, and what is demanded of each."""
