"""`pgjax fit`: parameters of a scene from what was recorded of it."""

import argparse
import sys
from pathlib import Path
from typing import Any

from pgjax.cli.folders import next_folder


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    fit = commands.add_parser("fit", help="find parameters of a scene from what was recorded of it")
    fit.add_argument("case", type=Path, help="a case file (.toml)")
    fit.add_argument(
        "--data",
        type=Path,
        help="a video, a folder of numbered pictures or an .npz, in place of the case's own",
    )
    fit.add_argument("--out", type=Path, help="output folder, new or empty (default: out/NAME)")
    fit.add_argument(
        "--dry-run", action="store_true", help="check everything, say what it costs, write nothing"
    )
    fit.set_defaults(command=_fit)


def _fit(options: argparse.Namespace) -> int:
    from pgjax.cases import prepare, read_case, solve
    from pgjax.scenes.record import require_empty

    if options.out is not None:
        require_empty(options.out)
    case = read_case(options.case, options.data)
    folder = options.out or next_folder(case.name)
    prepared = prepare(case)
    problem, particles = prepared.problem, prepared.plan.scene.particle_count
    for note in prepared.notes:
        print(f"warning: {note}", file=sys.stderr)
    print(
        f"fit        {', '.join(problem.names)} to {problem.frames} frames, "
        f"{particles} particles, {problem.substeps} steps a frame"
    )
    moved = particles * problem.substeps * problem.frames * (1 + problem.space.size)
    print(f"each point {moved:.2g} particle-steps, those of tangents included")
    if options.dry_run:
        return 0
    found, report = solve(prepared, folder, report=lambda line: print(line, flush=True))
    print(found.summary())
    print(f"wrote      {report}")
    return 0
