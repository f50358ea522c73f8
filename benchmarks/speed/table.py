"""The one table: rows of numbers, a column per code."""

import dataclasses
import math
import sys

COLUMNS = ("pgjax MLS", "pgjax ∇w", "Taichi serialised", "Taichi atomics", "Warp")


@dataclasses.dataclass(frozen=True)
class Row:
    """One quantity of one case, by code.

    Attributes:
        quantity: what was measured.
        unit: its unit.
        material: a name of `cases.MATERIALS`.
        particles: number of particles.
        threads: number of threads; None where the numbers do not depend on it.
        values: the number of each code that has one.
    """

    quantity: str
    unit: str
    material: str
    particles: int
    threads: int | None
    values: dict[str, float]


def note(text: str) -> None:
    """Say what goes on, apart from the table."""
    print(text, file=sys.stderr, flush=True)


def number(value: float | None) -> str:
    """Three digits, or a dash where there is nothing."""
    if value is None:
        return "–"
    if not math.isfinite(value):
        return str(value)
    if value != 0 and abs(value) < 1e-3:
        return f"{value:.1e}"
    if abs(value) < 100:
        return f"{value:.3g}"
    return f"{value:.0f}"


def markdown(rows: list[Row]) -> str:
    """All rows, those of one quantity beside each other, in order of appearance."""
    order = list(dict.fromkeys(row.quantity for row in rows))
    lines = [
        " | ".join(["| quantity", "unit", "material", "particles", "threads", *COLUMNS]) + " |",
        "|---|---|---|--:|--:|" + "--:|" * len(COLUMNS),
    ]
    for row in sorted(rows, key=lambda row: order.index(row.quantity)):
        head = [row.quantity, row.unit, row.material, f"{row.particles:,}".replace(",", " ")]
        head.append("–" if row.threads is None else str(row.threads))
        cells = [number(row.values.get(name)) for name in COLUMNS]
        lines.append("| " + " | ".join([*head, *cells]) + " |")
    return "\n".join(lines) + "\n"
