"""Points of work and precision, and what is read off them: fronts, and the cost of an error."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

TARGETS = (0.1, 0.03, 0.01)


@dataclasses.dataclass(frozen=True)
class Point:
    """One run.

    Attributes:
        series: what is compared.
        n: cells along the length of the case.
        error: relative; what it is, the panel says.
        seconds: median wall time of the rollout, compiled before.
        compile: seconds to trace and compile it; None where it is not known.
        memory: temporary memory of the compiled program, bytes; None where it is not known.
        backward: seconds of value and gradient together; None where there is none.
        particles: number of particles.
        steps: number of steps.
        remark: what else is to be known.
    """

    series: str
    n: int
    error: float
    seconds: float
    particles: int
    steps: int
    compile: float | None = None
    memory: float | None = None
    backward: float | None = None
    remark: str = ""


@dataclasses.dataclass(frozen=True)
class Panel:
    """Points that share an error and a reference.

    Attributes:
        title: the physical case.
        error: what is plotted upwards.
        reference: what the error is measured against.
        uncertainty: relative uncertainty of the reference; 0 if it is exact.
        points: of all series, in any order.
        over: costs the error is drawn over, names of `COSTS`.
    """

    title: str
    error: str
    reference: str
    uncertainty: float
    points: list[Point]
    over: tuple[str, ...] = ("seconds",)

    @property
    def series(self) -> list[str]:
        """Their names in order of appearance."""
        return list(dict.fromkeys(point.series for point in self.points))

    def of(self, series: str) -> list[Point]:
        """The points of one series, the coarsest first."""
        return sorted((p for p in self.points if p.series == series), key=lambda p: p.n)

    def resolved(self, point: Point) -> bool:
        """Whether the error is at least three times what is not known of the reference."""
        return math.isfinite(point.error) and point.error >= 3 * self.uncertainty


def read_panel(content: dict[str, Any]) -> Panel:
    """A panel from JSON."""
    points = [Point(**point) for point in content["points"]]
    return Panel(**content | {"points": points, "over": tuple(content["over"])})


def front(points: list[Point], over: str = "seconds") -> list[Point]:
    """The points than which none is both cheaper and more accurate, the cheapest first.

    More accurate by a hundredth: what differs by rounding alone is the same.
    """
    known = [p for p in points if getattr(p, over) is not None and math.isfinite(p.error)]
    best: list[Point] = []
    for point in sorted(known, key=lambda p: (getattr(p, over), p.error)):
        if not best or point.error < 0.99 * best[-1].error:
            best.append(point)
    return best


class Reached(NamedTuple):
    """What it costs to reach an error.

    Attributes:
        cost: interpolated between two points of the front, logarithmic in both.
        at_most: whether the cheapest point is better already.
    """

    cost: float
    at_most: bool


def reach(points: list[Point], target: float, over: str = "seconds") -> Reached | None:
    """Where the front of a series reaches an error; None where it does not."""
    before = None
    for point in front(points, over):
        cost = getattr(point, over)
        if point.error <= target:
            if before is None:
                return Reached(cost, at_most=True)
            share = math.log(target / before.error) / math.log(point.error / before.error)
            start = getattr(before, over)
            return Reached(start * (cost / start) ** share, at_most=False)
        before = point
    return None


def extrapolated(coarse: float, middle: float, fine: float) -> tuple[float, float]:
    """Limit of a value at three spacings, each half of the one before; its uncertainty, relative.

    Richardson with the order the three show, kept between ½ and 2; the uncertainty is the
    distance from the finest value to the limit.
    """
    ratio = (middle - coarse) / (fine - middle) if fine != middle else 4.0
    limit = fine + (fine - middle) / (min(max(ratio, 2**0.5), 4.0) - 1)
    return limit, abs(limit - fine) / abs(limit)


def told(seconds: float | None) -> str:
    """A time with its unit, three digits."""
    if seconds is None:
        return "–"
    if seconds < 1:
        return f"{_digits(1e3 * seconds)} ms"
    return f"{_digits(seconds)} s"


def _digits(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def bytes_told(size: float | None) -> str:
    """Memory in MB, three digits."""
    return "–" if size is None else f"{_digits(size / 1e6)} MB"


def percent(error: float) -> str:
    """An error in percent."""
    return f"{100 * error:.3g} %" if math.isfinite(error) else "not finite"


# Cost: what it is called on an axis and in the head of a column, and how it is told.
COSTS: dict[str, tuple[str, str, Callable[[float | None], str]]] = {
    "seconds": ("wall time, s", "", told),
    "backward": ("wall time of value and gradient, s", "with gradient ", told),
    "memory": ("temporary memory, bytes", "memory ", bytes_told),
}


def _reached(panel: Panel, series: str, target: float, over: str) -> str:
    if target < 3 * panel.uncertainty:
        return "below the reference"
    reached = reach(panel.of(series), target, over)
    if reached is None:
        return "not reached"
    return ("≤ " if reached.at_most else "") + COSTS[over][2](reached.cost)


def headline(panel: Panel) -> str:
    """What it costs to reach each error, per series, as a Markdown table."""
    asked = [(over, target) for over in panel.over for target in TARGETS]
    heads = [f"{COSTS[over][1]}{100 * target:g} %" for over, target in asked]
    lines = [f"| series | {' | '.join(heads)} |", "|---|" + "--:|" * len(heads)]
    for series in panel.series:
        cells = [_reached(panel, series, target, over) for over, target in asked]
        lines.append(f"| {series} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def details(panel: Panel) -> str:
    """Every point, as a Markdown table. An error the reference cannot resolve is in brackets."""
    heads = ("series", "n", "particles", "steps", "error", "time", "with gradient", "compilation")
    heads = (*heads, "memory", "remark")
    lines = [f"| {' | '.join(heads)} |", "|---|" + "--:|" * (len(heads) - 2) + "---|"]
    for series in panel.series:
        for p in panel.of(series):
            error = percent(p.error)
            cells = (
                series,
                str(p.n),
                f"{p.particles:,}".replace(",", " "),
                str(p.steps),
                error if panel.resolved(p) else f"({error})",
                told(p.seconds),
                told(p.backward),
                told(p.compile),
                bytes_told(p.memory),
                p.remark,
            )
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
