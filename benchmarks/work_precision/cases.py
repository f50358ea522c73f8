"""The nine diagrams: what is run for each, at which sizes."""

import dataclasses
import importlib.util
from collections.abc import Callable
from typing import Any

from benchmarks.speed.processes import Refused
from benchmarks.speed.table import note
from benchmarks.work_precision.table import Panel, Point, extrapolated

# `ask(call, dtype, **arguments)` of one case.
Ask = Callable[..., Any]

EXACT = "the exact solution"
WAVE = "Standing wave (V24), two dimensions, A = {}"
CROSSING = "displacement, RMS over amplitude"
DISCS = "Two discs that collide (V21)"
LOST = "energy that is lost"
BAR = "Free bar (V27), strain 1e-5, two periods"


@dataclasses.dataclass(frozen=True)
class Case:
    """A diagram.

    Attributes:
        title: what is varied.
        measure: `(ask, quick) -> panels`.
    """

    title: str
    measure: Callable[[Ask, bool], list[Panel]]


def run(ask: Ask, call: str, series: str, n: int, dtype: str = "float32", **options: Any) -> Point:
    """The point that a worker measures."""
    point = Point(series, n, **ask(call, dtype, n=n, **options))
    backward = "" if point.backward is None else f", with gradient {point.backward:.3g} s"
    note(f"  {series}, n = {n}: error {point.error:.3g}, {point.seconds:.3g} s{backward}")
    return point


def splines(ask: Ask, quick: bool) -> list[Panel]:
    names = {
        "quadratic, MLS": "quadratic-mls",
        "quadratic, ∇w": "quadratic-grad",
        "cubic, MLS": "cubic-mls",
        "cubic, ∇w": "cubic-grad",
    }
    names = dict(list(names.items())[: 1 if quick else None])
    points = [
        run(ask, "waves.point", series, n, scheme=scheme, backward=True)
        for series, scheme in names.items()
        for n in ((8,) if quick else (8, 16, 32, 64, 128))
    ]
    over = ("seconds", "backward")
    return [Panel(WAVE.format(0.01), CROSSING, EXACT, 0.0, points, over)]


def time_steps(ask: Ask, quick: bool) -> list[Panel]:
    points = [
        run(ask, "waves.point", f"Δt = {f:g} of the bound", n, scheme="quadratic-mls", fraction=f)
        for f in (0.1, 0.25, 0.5, 0.9)
        for n in ((8,) if quick else (8, 16, 32, 64))
    ]
    return [Panel(WAVE.format(0.01), CROSSING, EXACT, 0.0, points)]


def particles_per_cell(ask: Ask, quick: bool) -> list[Panel]:
    panels = []
    for amplitude in (0.01, 0.05):
        points = [
            run(ask, "waves.point", f"{name}, {ppc}² per cell", n, **about, per_cell=ppc)
            for name, scheme in (("quadratic", "quadratic-mls"), ("cubic", "cubic-grad"))
            for about in ({"scheme": scheme, "amplitude": amplitude},)
            for ppc in (1, 2, 3, 4)
            for n in ((8,) if quick else (8, 16, 32, 64))
        ]
        panels.append(Panel(WAVE.format(amplitude), CROSSING, EXACT, 0.0, points))
    return panels


TRANSFERS = ("APIC", "RPIC, half", "RPIC", "PIC")


def transfers(ask: Ask, quick: bool) -> list[Panel]:
    def points(call: str, sizes: tuple[int, ...]) -> list[Point]:
        return [
            run(ask, call, transfer, n, scheme="quadratic-mls", transfer=transfer)
            for transfer in TRANSFERS
            for n in ((sizes[0],) if quick else sizes)
        ]

    waves, discs = points("waves.point", (8, 16, 32, 64)), points("bodies.point", (10, 20, 40, 80))
    return [
        Panel(WAVE.format(0.01), CROSSING, EXACT, 0.0, waves),
        Panel(DISCS, LOST, EXACT, 0.0, discs),
    ]


def precisions(ask: Ask, quick: bool) -> list[Panel]:
    stored = {
        "float32, F − I (the library)": ("float32", "F − I"),
        "float32, F": ("float32", "F"),
        "float64": ("float64", "F − I"),
    }
    panels = []
    for of in ("velocity", "displacement"):
        points = [
            run(ask, "bar.precision", series, n, dtype, stored=kept, of=of)
            for series, (dtype, kept) in stored.items()
            for n in ((8,) if quick else (8, 16, 32, 64))
        ]
        panels.append(Panel(BAR, f"{of}, RMS", EXACT + " of small strains", 1e-5, points))
    return panels


def stress_kernels(ask: Ask, quick: bool) -> list[Panel]:
    laws = {
        "Jacobi on B, native": "library",
        "Jacobi on B, plain JAX": "Jacobi on B, plain JAX",
        "polar through Jacobi SVD": "polar through Jacobi SVD",
        "LAPACK SVD": "LAPACK SVD",
    }
    points = [
        run(ask, "bodies.point", series, n, scheme="quadratic-mls", law=law, backward=True)
        for series, law in laws.items()
        for n in ((10,) if quick else (10, 20, 40))
    ]
    over = ("seconds", "backward")
    return [Panel(DISCS + ", fixed corotated", LOST, EXACT, 0.0, points, over)]


def sand(ask: Ask, quick: bool) -> list[Panel]:
    note("  the reference of the runout …")
    sizes = (2, 4, 8) if quick else (16, 32, 64)
    known = [ask("sand.runout", "float64", n=n) for n in sizes]
    limit, uncertainty = extrapolated(*known)
    note(f"  runout {known}: {limit:.4g} ± {uncertainty:.1%}")
    columns = [
        run(ask, "sand.column", f"{ppc}² per cell", n, per_cell=ppc, reference=limit)
        for ppc in (2, 3)
        for n in ((4,) if quick else (4, 8, 16, 32))
    ]
    slopes = [
        run(ask, "sand.slope", f"{ppc}² per cell", n, per_cell=ppc)
        for ppc in (1, 2, 3)
        for n in ((8,) if quick else (8, 16, 32, 64))
    ]
    reference = f"{limit:.3g} from n = 16, 32, 64 in float64"
    return [
        Panel("Column of sand (V35)", "runout", reference, uncertainty, columns),
        Panel("Infinite slope of sand (V30)", "acceleration", EXACT, 0.0, slopes),
    ]


def checkpoints(ask: Ask, quick: bool) -> list[Panel]:
    points = [
        run(ask, "bar.gradient", f"{kept} kept{suffix}", n, dtype, kept=kept)
        for dtype, suffix in (("float32", ""), ("float64", ", float64"))
        for kept in ("all", "every step", "every 8th step", "every √T-th step")
        if not suffix or kept == "every √T-th step"
        for n in ((8,) if quick else (8, 16, 32, 64))
    ]
    over = ("seconds", "memory")
    return [Panel("Free bar (V27), 1¼ periods, gradient", "dq/dE", EXACT, 1e-4, points, over)]


def codes(ask: Ask, quick: bool) -> list[Panel]:
    names = ["pgjax MLS", "pgjax ∇w"]
    for name in ("Taichi", "Warp"):
        if importlib.util.find_spec(name.lower()):
            names.append(name)
        else:
            note(f'{name} is not installed and left out: pip install "pgjax[benchmarks]"')
    panels = []
    for strain, sizes in (("0.1", (8, 16, 24, 32)), ("1e-5", (8, 16, 24))):
        points = []
        for name in names:
            for n in (8,) if quick else sizes:
                about = {"code": name, "strain": float(strain), "runs": 3 if n > 16 else 5}
                try:
                    # A process of its own: the constants of a block are compiled in.
                    points.append(run(ask, "codes.point", name, n, "fresh", **about))
                except Refused as error:
                    note(f"  {name}, n = {n}: left out, {error}")
        title = f"Cube on a roller, fixed corotated, strain {strain}"
        panels.append(Panel(title, "velocity, RMS", EXACT, 0.0, points))
    return panels


CASES = {
    "WP1": Case("Spline and gradient", splines),
    "WP2": Case("Time step", time_steps),
    "WP3": Case("Particles per cell", particles_per_cell),
    "WP4": Case("Transfers", transfers),
    "WP5": Case("Precision", precisions),
    "WP6": Case("Ways to the stress", stress_kernels),
    "WP7": Case("Sand", sand),
    "WP8": Case("What reverse mode keeps", checkpoints),
    "WP9": Case("Beside other codes", codes),
}
