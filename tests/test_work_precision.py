"""Work-precision diagrams: what is read off the points, and one point from the scene to the page.

How fast anything is, no test says.
"""

import dataclasses
import importlib
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parent.parent


@pytest.fixture
def benchmark(monkeypatch):
    """Import a module of the benchmark by its name."""
    monkeypatch.syspath_prepend(str(ROOT))
    return lambda name: importlib.import_module(f"benchmarks.work_precision.{name}")


def points(table, errors, series="a", **costs):
    """Points of one series that take 1, 10, 100 … seconds."""
    return [
        table.Point(series, 8 * 2**i, error, 10.0**i, particles=100, steps=10, **costs)
        for i, error in enumerate(errors)
    ]


def test_a_power_law_is_interpolated_exactly(benchmark):
    """Errors of `0.5 t^(-1/2)` reach 10 % after 25 s; 1 % after 2500 s."""
    table = benchmark("table")
    law = points(table, [0.5 * 10 ** (-i / 2) for i in range(5)])
    assert table.reach(law, 0.1) == (pytest.approx(25), False)
    assert table.reach(law[::-1], 0.01) == (pytest.approx(2500), False)
    assert table.reach(law, 0.001) is None
    assert table.reach(law, 0.9) == (1, True)


def test_what_another_point_beats_does_not_count(benchmark):
    table = benchmark("table")
    known = points(table, [0.5, 0.6, 0.05, float("nan"), 0.04, 0.05])
    assert [p.seconds for p in table.front(known)] == [1, 100, 10000]
    # From 50 % at 1 s to 5 % at 100 s: the point between them is worse than both.
    assert table.reach(known, 0.5 / 10**0.5) == (pytest.approx(10), False)
    assert table.front([]) == []


def test_the_front_of_another_cost(benchmark):
    """The slower one needs less memory; the one without a gradient is left out."""
    table = benchmark("table")
    fast, lean = points(table, [0.3, 0.3])
    fast = dataclasses.replace(fast, memory=2e6, backward=5.0)
    lean = dataclasses.replace(lean, memory=1e6)
    assert table.front([fast, lean]) == [fast]
    assert table.front([fast, lean], "memory") == [lean]
    assert table.front([fast, lean], "backward") == [fast]


@pytest.mark.parametrize("order", [0.5, 1, 2])
def test_a_limit_is_extrapolated(benchmark, order):
    values = [3 + 0.4 * h**order for h in (1, 1 / 2, 1 / 4)]
    limit, uncertainty = benchmark("table").extrapolated(*values)
    assert limit == pytest.approx(3)
    assert uncertainty == pytest.approx(0.4 / 4**order / 3)


def test_an_irregular_sequence_is_not_trusted(benchmark):
    limit, uncertainty = benchmark("table").extrapolated(1.0, 1.2, 1.1)
    assert limit == pytest.approx(1.1 - 0.1 / (2**0.5 - 1))
    assert uncertainty > 0.25


def case(table, errors, uncertainty):
    """A case as it is stored, with a series that is exact from the start."""
    known = points(table, errors, "∇w, every √T", backward=2.0, memory=3e6)
    known += points(table, [0.02], "MLS")
    over = ("seconds", "backward")
    panel = table.Panel("Wave", "displacement", "finer", uncertainty, known, over)
    return {
        "title": "Splines",
        "date": "2026-01-01",
        "minutes": 1.0,
        "panels": [dataclasses.asdict(panel)],
    }


def test_the_page_is_made_of_the_stored_table(benchmark, tmp_path):
    table, report = benchmark("table"), benchmark("report")
    report.keep("WP1", case(table, [0.9], 0.0), tmp_path)
    report.keep("WP2", case(table, [0.5, 0.05, 0.005], 0.005), tmp_path)
    report.keep("WP1", case(table, [0.5, 0.2], 0.0), tmp_path)
    report.draw_up(tmp_path)
    page = (tmp_path / "work_precision_cpu.md").read_text()
    first, second = page.split("## WP2")
    assert "90 %" not in first
    assert "| ∇w, every √T | not reached |" in first
    assert "| MLS | ≤ 1 s | ≤ 1 s | not reached |" in first
    # From 50 % at 1 s to 5 % at 10 s, and 0.5 % at 100 s.
    assert "| ∇w, every √T | 5 s | 16.7 s | below the reference |" in second
    assert "(0.5 %)" in second
    for name in ("wp1", "wp2"):
        assert (tmp_path / f"work_precision_{name}.png").stat().st_size > 5000
        assert f"(work_precision_{name}.png)" in page


def test_a_point_from_a_worker(benchmark):
    """Eight cells per wave length: a quarter of the amplitude is lost on one crossing."""
    table, main = benchmark("table"), benchmark("__main__")
    with main.Workers() as workers:
        answer = workers.ask("waves.point", "float32", n=8, scheme="quadratic-mls")
    point = table.Point("MLS", 8, **answer)
    assert 0.2 < point.error < 0.3
    assert point.particles == 256
    assert point.steps == 19
    assert 0 < point.seconds < 60
    assert 0 < point.memory < 1e6
