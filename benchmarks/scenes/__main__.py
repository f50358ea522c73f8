"""All scenes of pgjax: whether they run, how long that takes, and whether they move as they should.

    python -m benchmarks.scenes [--scenes NAME …] [--keep FOLDER]

runs each preset as `pgjax run` does, checks its motion, and writes `scenes_cpu.json`, `.md` and
the gallery: `docs/gallery.md` with the pictures `docs/images/gallery/NAME.png`. Rows of scenes that
were not run now are kept. `--keep` leaves the folders of the runs.
"""

import argparse
import json
import sys
import tempfile
import time
import warnings
from pathlib import Path

from benchmarks.scenes import report
from benchmarks.scenes.checks import CHECKS
from benchmarks.scenes.history import History
from pgjax.scenes import plan, read_scene, resolve, run

ROOT = Path(__file__).parents[2]


def main() -> int:
    """Run the scenes; 1 if a check failed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", nargs="+", default=list(CHECKS), choices=list(CHECKS))
    parser.add_argument("--keep", type=Path, help="where to leave the runs, a new folder each")
    options = parser.parse_args()
    target = ROOT / "benchmarks" / "results" / "scenes_cpu.json"
    rows = {row["scene"]: row for row in report.stored(target)}
    for name in options.scenes:
        with tempfile.TemporaryDirectory() as temporary:
            rows[name] = one(name, (options.keep or Path(temporary)) / name)
        print(report.line(rows[name]), flush=True)
        ordered = [rows[scene] for scene in CHECKS if scene in rows]
        report.write(target, ordered)
        report.write_gallery(ROOT / "docs", ordered)
    return int(any(not report.is_green(rows[name]) for name in options.scenes))


def one(name: str, folder: Path) -> dict:
    """A row of the table: a scene is run and measured, its pictures are put in the gallery."""
    started = time.perf_counter()
    planned = plan(read_scene(resolve(name)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run(planned, folder, trajectory_frames=True)
    seconds = time.perf_counter() - started
    history = History(planned, folder)
    pictures = ROOT / "docs" / "images" / "gallery"
    report.write_strip(pictures / f"{name}.png", folder / "video.mp4")
    return {
        "scene": name,
        "law": report.law(planned),
        "gaussians": planned.scene.particle_count + len(planned.still),
        "particles": planned.scene.particle_count,
        "steps": planned.frames * planned.substeps,
        "frames": planned.frames,
        "seconds": round(seconds, 1),
        "status": json.loads((folder / "run.json").read_text())["status"],
        "warnings": sorted({str(w.message) for w in caught}),
        "checks": [check.measured(history) for check in CHECKS[name]],
    }


if __name__ == "__main__":
    sys.exit(main())
