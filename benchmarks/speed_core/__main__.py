"""Time of 200 steps of 29 791 particles on a 64³ grid, per material, scheme and kernels.

    python -m benchmarks.speed_core [MATERIAL …]

prints the table and writes `benchmarks/results/speed_core.json` and `.md`. Plain JAX and native
kernels take turns in one process. Compilation is timed apart; the run is the median of three,
after it, blocked until ready.
"""

import json
import os
import platform
import statistics
import sys
import time
from pathlib import Path

import jax
import numpy as np

import pgjax
from pgjax import boundary, models, native, sampling

STEPS, SIDE, CELLS = 200, 31, 64
RESULTS = Path(__file__).parent.parent / "results"

MATERIALS = {
    "fixed corotated": models.Material(models.FixedCorotated(1e5, 0.3)),
    "neo-Hookean": models.Material(models.NeoHookean(1e5, 0.3)),
    "Drucker-Prager": models.Material(models.StVKHencky(1e5, 0.3), models.DruckerPrager(30.0)),
    "von Mises": models.Material(models.StVKHencky(1e5, 0.3), models.VonMises(1e3)),
    "Herschel-Bulkley": models.Material(
        models.DevVolNeoHookean(1e5, 0.3), models.HerschelBulkley(1e3, 1.0)
    ),
}
SCHEMES = {"spline gradient": pgjax.SplineGradient(), "MLS": pgjax.MLS()}
KERNELS = ("plain JAX", "native") if native.available() else ("plain JAX",)


def setup(material, scheme):
    """A falling block above a floor: two particles per cell and direction, APIC, quadratic."""
    h = 1 / CELLS
    low = np.full(3, 0.25)
    x, volumes = sampling.block(low, low + SIDE * h / 2, h / 2)
    walls = boundary.Box((0.1,) * 3, (0.9,) * 3)
    scene = pgjax.Scene(
        pgjax.Grid((0, 0, 0), (CELLS,) * 3, h),
        material,
        volumes,
        gravity=(0, 0, -9.81),
        boundaries=[walls],
        scheme=scheme,
    )
    return scene, pgjax.initial_state(scene, x, (0, 0, -1.0))


def measure(material, scheme, kernels):
    """Seconds to compile and to run, and the nanoseconds per particle and step."""
    os.environ["PGJAX_NATIVE"] = str(int(kernels == "native"))
    jax.clear_caches()
    scene, state = setup(material, scheme)
    dt = pgjax.stable_dt(scene, state)

    def run():
        started = time.perf_counter()
        end = pgjax.simulate(scene, state, dt=dt, frames=4, substeps=STEPS // 4, save=nothing)
        jax.block_until_ready(end.final.v)
        return time.perf_counter() - started

    first = run()
    seconds = statistics.median(run() for _ in range(3))
    return {
        "compile_s": round(first - seconds, 2),
        "run_s": round(seconds, 2),
        "ns_per_particle_step": round(seconds / STEPS / len(state.v) * 1e9),
    }


def nothing(state):
    """Save nothing."""
    del state


def main():
    """Measure every pair and write the table."""
    rows = []
    for name in sys.argv[1:] or MATERIALS:
        material = MATERIALS[name]
        for label, scheme in SCHEMES.items():
            for kernels in KERNELS:
                row = {"material": name, "scheme": label, "kernels": kernels}
                rows.append(row | measure(material, scheme, kernels))
                print(rows[-1], flush=True)
    about = {
        "command": " ".join(["python -m benchmarks.speed_core", *map(repr, sys.argv[1:])]),
        "particles": SIDE**3,
        "grid": [CELLS] * 3,
        "steps": STEPS,
        "cores": os.cpu_count(),
        "machine": platform.processor() or platform.machine(),
        "device": jax.devices()[0].platform,
        "precision": "float32",
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "speed_core.json").write_text(json.dumps(about | {"rows": rows}, indent=1) + "\n")
    lines = [
        "# 200 steps of 29 791 particles on a 64³ grid",
        "",
        f"`{about['command']}`, {about['cores']} CPU cores, float32, JAX {about['jax']}, "
        f"Python {about['python']}. Quadratic APIC, eight particles per cell.",
        "",
        "| material | scheme | kernels | compile, s | run, s | ns per particle and step |",
        "|---|---|---|---|---|---|",
        *(
            f"| {r['material']} | {r['scheme']} | {r['kernels']} "
            f"| {r['compile_s']} | {r['run_s']} | {r['ns_per_particle_step']} |"
            for r in rows
        ),
    ]
    (RESULTS / "speed_core.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
