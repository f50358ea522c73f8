"""What an image of Gaussians and its derivatives cost, beside the same in PyTorch.

    python -m benchmarks.render --data DIR [--threads N …] [--quick] [--without-peers] […]

prints the tables and writes them to `benchmarks/results/render_cpu.json`, `.md` and `.png`. Scenes
are the captures found in the folder DIR and a landscape of 1 000 000 Gaussians. Pictures are
compared first; a code that draws another one is not timed. `pip install -e ".[benchmarks]"`
installs PyTorch and gsplat; where they are missing they are left out.
"""

import argparse
import dataclasses
import importlib.util
import os
import shlex
import sys
from pathlib import Path

from benchmarks.render import cases, report
from benchmarks.render.cases import Case
from benchmarks.render.measure import MODULE, Record, measure, tell
from benchmarks.speed.processes import Process
from benchmarks.speed.table import note

RESULTS = Path(__file__).parents[1] / "results"
QUICK = Case(cases.LANDSCAPE, 48, side=40)


def images(chosen: argparse.Namespace) -> list[Case]:
    """What can be drawn; a capture that is not there is named."""
    found = []
    for scene in chosen.scenes:
        case = Case(scene, 0, chosen.data)
        if case.file is None or case.file.is_file():
            found += [dataclasses.replace(case, size=size) for size in chosen.sizes]
        else:
            note(f"{scene} is left out: there is no file {case.file} (see --data)")
    return found


def has_peer(wanted: bool) -> bool:
    """Whether PyTorch and gsplat are wanted and installed."""
    missing = [name for name in ("torch", "gsplat") if importlib.util.find_spec(name) is None]
    if wanted and missing:
        names = " and ".join(missing)
        note(f'PyTorch is left out, without {names}: pip install "pgjax[benchmarks]"')
    return wanted and not missing


def options(arguments: list[str]) -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser("python -m benchmarks.render", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--data", default="", help="folder of the captures")
    parser.add_argument("--threads", type=int, nargs="+", default=[1], help="numbers of threads")
    parser.add_argument("--scenes", nargs="+", choices=cases.SCENES, default=[*cases.SCENES])
    parser.add_argument("--sizes", type=int, nargs="+", default=[*cases.SIZES], help="pixels")
    parser.add_argument("--rounds", type=int, default=5, help="times every number is measured")
    parser.add_argument(
        "--clock",
        choices=("wall", "cpu"),
        default="wall",
        help="cpu: on a busy machine, one thread",
    )
    parser.add_argument("--quick", action="store_true", help="tiny, one round, nothing stored")
    parser.add_argument("--without-peers", action="store_true", help="pgjax alone")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--pictures", default="", help="a folder for the images")
    return parser.parse_args(arguments)


def main(arguments: list[str]) -> None:
    """Measure, print the tables, store them."""
    chosen = options(arguments)
    if not hasattr(os, "sched_setaffinity"):
        sys.exit("The threads of a process can be limited on Linux only; this is another system.")
    if max(chosen.threads) > len(os.sched_getaffinity(0)):
        sys.exit(f"Only {len(os.sched_getaffinity(0))} CPUs may be used; ask for fewer threads.")
    if chosen.clock == "cpu" and max(chosen.threads) > 1:
        sys.exit("The time of the processor says nothing about several threads; use --clock wall.")
    peer = has_peer(wanted=not chosen.without_peers)
    with Process(None, module=MODULE) as process:
        kernels = process.ask("kernels")
    note(f"pgjax runs with {kernels} kernels.")
    rounds = 1 if chosen.quick else chosen.rounds
    command = shlex.join(["python", "-m", "benchmarks.render", *report.shown(arguments)])
    about = {"command": command, "kernels": kernels, "clock": chosen.clock, "rounds": rounds}
    records: list[Record] = []
    for case in [QUICK] if chosen.quick else images(chosen):
        for threads in chosen.threads:
            records.append(measure(case, threads, peer, rounds, chosen.clock, chosen.pictures))
            tell(records[-1])
            if not chosen.quick:
                report.store(records, about, chosen.out)
    print(report.tables(records))


if __name__ == "__main__":
    main(sys.argv[1:])
