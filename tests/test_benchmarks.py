"""The benchmarks run; how fast anything is, no test says."""

import math
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).parent.parent
COMMAND = ["-m", "benchmarks.speed", "--quick", "--without-peers", "--materials", "neo-Hookean"]


def rows(text):
    """The cells of each row of a Markdown table, without its head."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_quick_speed_table_is_whole():
    run = subprocess.run(
        [sys.executable, *COMMAND], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    table = rows(run.stdout)
    numbers = {row[0]: [float(cell) for cell in row[5:] if cell != "–"] for row in table}
    assert all(values for values in numbers.values()), run.stdout
    assert all(math.isfinite(v) and v > 0 for values in numbers.values() for v in values)
    measured = " ".join(numbers)
    parts = ("forward", "stage: stress and P2G", "stage: G2P and update", "compilation")
    for part in (*parts, "memory", "gradient"):
        assert part in measured, run.stderr
    for mode in ("reverse mode", "forward mode"):
        (error,) = next(v for name, v in numbers.items() if name.startswith(mode))
        assert error < 1e-6
