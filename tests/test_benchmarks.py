"""The benchmarks run; how fast anything is, no test says."""

import importlib.util
import json
import math
import pathlib
import subprocess
import sys

import pytest

from pgjax.scenes import presets

ROOT = pathlib.Path(__file__).parent.parent
SPEED = ("speed", "--quick", "--without-peers", "--materials", "neo-Hookean")


def rows(text):
    """The cells of each row of a Markdown table, without its head."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def run_benchmark(name, *options):
    """What it prints, in a process of its own."""
    command = [sys.executable, "-m", f"benchmarks.{name}", *options]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return run


@pytest.mark.float64
@pytest.mark.slow
def test_quick_speed_table_is_whole():
    run = run_benchmark(*SPEED)
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


def numbers_of(table):
    """The numbers of the one case in a table of `benchmarks.render`, by head of the column."""
    heads, _, cells = (
        [cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()
    )
    case = heads.index("threads") + 1
    return {
        head: float(cell)
        for head, cell in zip(heads[case:], cells[case:], strict=True)
        if cell != "–"
    }


@pytest.mark.slow
@pytest.mark.float64
def test_quick_render_tables_are_whole():
    times, memory = (
        run_benchmark("render", "--quick", "--without-peers").stdout.strip().split("\n\n")
    )
    quantities = ("forward", "tangent", "gradient")
    found = numbers_of(times)
    assert set(found) == {f"pgjax {quantity}" for quantity in quantities}
    assert all(math.isfinite(ms) and ms > 0 for ms in found.values())
    found = numbers_of(memory)
    for quantity in quantities:
        assert found[f"XLA's part {quantity}"] > 0
        assert found[f"compile {quantity}"] > 0


def test_pytorch_draws_the_same_picture():
    if None in map(importlib.util.find_spec, ("torch", "gsplat")):
        pytest.skip("torch and gsplat are not installed (extra `benchmarks`)")
    times, _, off = run_benchmark("render", "--quick").stdout.strip().split("\n\n")
    assert {f"ratio {q}" for q in ("forward", "tangent", "gradient")} <= set(numbers_of(times))
    found = numbers_of(off)
    assert found["image, 99.9 %"] < 1e-5
    assert found["tangent"] < 1e-4
    assert found["gradient"] < 1e-4


def test_captures_that_are_not_there_are_named(tmp_path):
    options = ("--data", str(tmp_path), "--out", str(tmp_path), "--scenes", "guitar")
    run = run_benchmark("render", *options, "--without-peers")
    assert "guitar is left out" in run.stderr
    assert not list(tmp_path.iterdir())


def test_every_scene_is_checked():
    sys.path.insert(0, str(ROOT))
    try:
        from benchmarks.scenes.checks import CHECKS
    finally:
        sys.path.remove(str(ROOT))
    assert set(CHECKS) == set(presets())
    assert all(len(checks) >= 2 for checks in CHECKS.values())
    measured = {check.what for checks in CHECKS.values() for check in checks}
    assert len(measured) > 15


def test_the_committed_table_of_scenes_is_green():
    rows = json.loads((ROOT / "benchmarks" / "results" / "scenes_cpu.json").read_text())["rows"]
    assert {row["scene"] for row in rows} == set(presets())
    for row in rows:
        assert row["seconds"] <= 120
        assert all(check["holds"] for check in row["checks"]), row["scene"]
        assert (ROOT / "docs" / "images" / "gallery" / f"{row['scene']}.png").is_file()
