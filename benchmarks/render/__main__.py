"""Time of an image of a capture and of its gradient, with one thread and with all.

    python -m benchmarks.render [--pictures FOLDER]

prints a table and writes `benchmarks/results/render_images.json` and `.md`. The captures are found
in `PGJAX_REFERENCE_DATA` (default `../shared/data`). The whole object is in the frame. Forward is
the colour of the image, backward the gradient of a weighted sum of it with respect to means,
factors, opacities and harmonics; both compiled before, median of nine runs in single precision.
"""

import argparse
import dataclasses
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pgjax import native
from pgjax.render import Camera, load_gaussians, render, save_image

ROOT = Path(__file__).parent.parent.parent
RESULTS = ROOT / "benchmarks" / "results"
CASES = (("guitar.compressed.ply", 800), ("playbot_31000.ply", 256))
REPEATS = 9


def capture(name, size):
    """The Gaussians of a file, and a camera that has all of them in view."""
    folder = Path(os.environ.get("PGJAX_REFERENCE_DATA", ROOT.parent / "shared" / "data"))
    gaussians = load_gaussians(folder / "splats" / name)
    low, high = np.quantile(np.asarray(gaussians.means), [0.01, 0.99], axis=0)
    camera = Camera.orbit(
        (low + high) / 2,
        up=[0, -1, 0],
        azimuth=0.6,
        elevation=0.25,
        radius=1.3 * np.linalg.norm(high - low),
        width=size,
        height=size,
        fov_y=0.85,
    )
    return gaussians, camera


def milliseconds(function, *operands):
    jax.block_until_ready(function(*operands))
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(function(*operands))
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def measure(name, size, pictures):
    """One row of the table."""
    gaussians, camera = capture(name, size)
    image = render(gaussians, camera, background=(1, 1, 1))
    if pictures:
        save_image(Path(pictures) / f"{name.split('.')[0]}_{size}.png", image.rgb)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=image.rgb.shape), jnp.float32)

    def loss(parts, frames):
        moved = dataclasses.replace(gaussians, frames=frames, **parts)
        return jnp.sum(weights * render(moved, camera).rgb)

    parts = {part: getattr(gaussians, part) for part in ("means", "factors", "opacities", "sh")}
    gradient = jax.jit(jax.value_and_grad(loss))
    return {
        "capture": name,
        "gaussians": len(gaussians),
        "pixels": size,
        # A pair of a splat and a tile are 64 of a splat and a pixel.
        "pairs_per_pixel": 64 * int(image.pairs) / size**2,
        "forward_ms": milliseconds(jax.jit(lambda g: render(g, camera).rgb), gaussians),
        "gradient_ms": milliseconds(gradient, parts, gaussians.frames),
        "threads": len(os.sched_getaffinity(0)),
    }


def with_threads(threads, pictures):
    """The rows of a process of its own that may use so many processors."""
    allowed = sorted(os.sched_getaffinity(0))[:threads]
    command = [sys.executable, "-m", "benchmarks.render", "--worker", "--pictures", pictures]
    # XLA takes as many threads as there are processors for it when it starts.
    run = subprocess.run(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        preexec_fn=lambda: os.sched_setaffinity(0, allowed),
    )
    return json.loads(run.stdout)


def table(rows):
    head = "| capture | Gaussians | image | pairs per pixel | threads | forward | with gradient |"
    lines = [head, "|---|---|---|---|---|---|---|"]
    for row in rows:
        lines.append(
            f"| {row['capture']} | {row['gaussians']} | {row['pixels']}² | "
            f"{row['pairs_per_pixel']:.0f} | {row['threads']} | {row['forward_ms']:.1f} ms | "
            f"{row['gradient_ms']:.1f} ms |"
        )
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.render")
    parser.add_argument("--pictures", default="", help="a folder for the images")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print(json.dumps([measure(*case, options.pictures) for case in CASES]))
        return
    counts = sorted({1, len(os.sched_getaffinity(0))})
    rows = [row for count in counts for row in with_threads(count, options.pictures)]
    facts = {"machine": platform.processor() or platform.machine(), "jax": jax.__version__}
    facts["native"] = native.available()
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "render_images.json").write_text(json.dumps({**facts, "rows": rows}, indent=1))
    (RESULTS / "render_images.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
