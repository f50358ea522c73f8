"""What a step costs, beside the same method in Taichi and Warp, and what derivatives cost.

    python -m benchmarks.speed [--quick] [--out DIR] [--materials …] [--sizes …] [--without-peers]

prints one table and writes it to `benchmarks/results/speed_cpu.json`, `.md` and `.png`. All codes
run the same block from the same start in single precision with quadratic splines. Trajectories
are compared first; a code that does not follow is not timed. `pip install -e ".[benchmarks]"`
installs the peers; one that is missing is left out.
"""

import argparse
import dataclasses
import importlib.util
import os
import shlex
import sys
from pathlib import Path

from benchmarks.speed import cases, forward, inside, report
from benchmarks.speed.cases import Case
from benchmarks.speed.processes import Process, Refused
from benchmarks.speed.table import Row, markdown, note

RESULTS = Path(__file__).parents[1] / "results"


@dataclasses.dataclass(frozen=True)
class Plan:
    """How much is measured.

    Attributes:
        sides: particles along the edge of each block.
        inner: the same of the block whose stages, compilation and derivatives are measured.
        checked: the same of the block that is compared with double precision.
        cells: cells along the edge of the grid; by `cases.grid_cells` if None.
        threads: numbers of threads.
        columns: schemes of pgjax.
        rounds: rounds of a small block; a large one has at most three.
        work: particle-steps of a timed run.
        steps: steps of the rollout that is differentiated.
        lengths: steps of longer rollouts, of which only the memory is asked for.
    """

    sides: tuple[int, ...]
    inner: int
    checked: int
    cells: int | None
    threads: tuple[int, ...]
    columns: tuple[str, ...]
    rounds: int
    work: float
    steps: int
    lengths: tuple[int, ...]

    def case(self, material: str, side: int) -> Case:
        """The block of this size."""
        return Case(material, side, self.cells or cases.grid_cells(side))


QUICK = Plan((8,), 8, 8, 16, (1,), ("pgjax MLS",), 1, 1e4, 8, ())


def full(sizes: list[str]) -> Plan:
    """The plan of the stored results."""
    sides = tuple(cases.SIZES[name] for name in sizes)
    inner = max(side for side in sides if side <= max(min(sides), cases.SIZES["64k"]))
    threads = tuple(n for n in (1, 2) if n <= len(os.sched_getaffinity(0)))
    columns, lengths = tuple(forward.PGJAX), (256, 1024)
    return Plan(sides, inner, min(sides), None, threads, columns, 5, 4e6, 64, lengths)


def peers(wanted: bool) -> dict[str, tuple[str, str]]:
    """The columns of the other codes that are installed."""
    found = {}
    for module, columns in (("taichi", forward.TAICHI), ("warp", forward.WARP)):
        if wanted and importlib.util.find_spec(module) is None:
            note(f'{module} is not installed and left out: pip install "pgjax[benchmarks]"')
        elif wanted:
            found |= columns
    return found


def measure(plan: Plan, materials: list[str], others: dict[str, tuple[str, str]]) -> list[Row]:
    """All rows."""
    rows: list[Row] = []
    own = {name: forward.PGJAX[name] for name in plan.columns}
    for material in materials:
        for side in plan.sides:
            for threads in plan.threads:
                # Warp's kernels run on one thread.
                codes = {**own, **others}
                codes = {n: c for n, c in codes.items() if threads == 1 or c[0] != "warp"}
                rounds = plan.rounds if side <= cases.SIZES["64k"] else min(3, plan.rounds)
                case = plan.case(material, side)
                try:
                    rows += _told(forward.measure(case, threads, codes, rounds, plan.work))
                except Refused as error:
                    note(f"{material}, {case.particles}: not measured, {error}")
        if others:
            rows += _told(forward.accuracy(plan.case(material, plan.checked), {**own, **others}))
        rows += _inside(plan, material)
    return rows


def _inside(plan: Plan, material: str) -> list[Row]:
    """The rows about pgjax alone."""
    case, small = plan.case(material, plan.inner), plan.case(material, plan.checked)
    columns, most = list(plan.columns), max(plan.threads)
    rounds = min(3, plan.rounds)
    rows: list[Row] = []
    for threads in plan.threads:
        rows += _told(inside.stages(case, threads, columns, 4 * plan.rounds))
        rows += _told(inside.gradient_cost(case, threads, columns, plan.steps, rounds))
    rows += _told(inside.compilation(case, most, columns))
    rows += _told(inside.gradient_memory(case, columns, list(plan.lengths)))
    return rows + _told(inside.gradient_errors(small, columns, plan.steps))


def _told(rows: list[Row]) -> list[Row]:
    """The rows, each said as soon as it is there."""
    for row in rows:
        values = ", ".join(f"{name} {value:.4g}" for name, value in row.values.items())
        threads = "" if row.threads is None else f", {row.threads} thread(s)"
        note(f"{row.material}, {row.particles}{threads}, {row.quantity}: {values}")
    return rows


def options(arguments: list[str]) -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser("python -m benchmarks.speed", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--quick", action="store_true", help="tiny, one round, nothing stored")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--materials", nargs="+", choices=cases.MATERIALS, metavar="MATERIAL")
    parser.add_argument("--sizes", nargs="+", choices=tuple(cases.SIZES), default=[*cases.SIZES])
    parser.add_argument("--without-peers", action="store_true", help="pgjax alone")
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> None:
    """Measure, print the table, store it."""
    chosen = options(arguments)
    if not hasattr(os, "sched_setaffinity"):
        sys.exit("The threads of a process can be limited on Linux only; this is another system.")
    plan = QUICK if chosen.quick else full(chosen.sizes)
    others = peers(wanted=not chosen.without_peers)
    with Process(None) as process:
        kernels = process.ask("with_pgjax.kernels")
    note(f"pgjax runs with {kernels} kernels.")
    rows = measure(plan, chosen.materials or list(cases.MATERIALS), others)
    print(markdown(rows))
    if not chosen.quick:
        command = shlex.join(["python", "-m", "benchmarks.speed", *arguments])
        report.store(rows, command, kernels, chosen.out)


if __name__ == "__main__":
    main(sys.argv[1:])
