"""Strict settings for the whole suite, and the fixtures that many tests share."""

import gc
import json
import os
import pathlib
import re

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Tests spend most of their time compiling: keep what was compiled between runs.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(pathlib.Path(__file__).parent.parent / ".jax_cache")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import jax
import jax.numpy as jnp
import pytest
from jaxtyping import install_import_hook

# PGJAX_TEST_FLOAT32=1 runs the suite in single precision (tests marked `float64` are left out).
FLOAT32 = os.environ.get("PGJAX_TEST_FLOAT32", "") == "1"

jax.config.update("jax_enable_x64", not FLOAT32)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

install_import_hook("pgjax", "typecheck.check")

# Tracing makes millions of objects that form no cycles; looking for some took an eighth of it.
gc.freeze()
gc.set_threshold(200_000, 20, 100)


def pytest_configure(config):
    config.addinivalue_line("markers", "float64: needs double precision, or one of two passes")
    config.addinivalue_line("markers", "hard: keeps the outcome of a hard case (`holds`)")


def pytest_collection_modifyitems(items):
    for item in items:
        if "holds" in item.fixturenames:
            item.add_marker(pytest.mark.hard)
        if FLOAT32 and item.get_closest_marker("float64"):
            item.add_marker(pytest.mark.skip(reason="needs double precision"))
    spare_variants(items)


def spare_variants(items):
    """Mark as slow what `pytest -m slow` and `python -m benchmarks.verification` run anyway.

    Of the variants of a verification case the first stays; of hard cases all stay in single
    precision and the first in double, of other tests the first in single and all in double.
    That a wrong model fails is not asked every day.
    """
    seen = set()
    for item in items:
        folder, case = item.path.parent.name, item.nodeid.partition("[")[0]
        if folder != "verification" and (folder == "hard") == FLOAT32:
            continue
        if item.get_closest_marker("slow") or item.get_closest_marker("skip"):
            continue
        if case in seen or (folder == "verification" and "_fails_" in case):
            item.add_marker(pytest.mark.slow)
        seen.add(case)


@pytest.fixture(scope="module", autouse=True)
def release_compiled_programs():
    """Forget, after each file, what its tests compiled.

    Every program XLA compiles for the CPU keeps some thirty memory mappings. A process may have
    65 530 on Linux; a whole suite's worth of programs exceeds that, and the compiler then dies
    of a segmentation fault. Large programs come back from the compilation cache on disk.
    """
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def reference_data() -> pathlib.Path:
    """The folder of captured scenes and reference renders, which is not part of the project."""
    default = pathlib.Path(__file__).parent.parent.parent / "shared" / "data"
    folder = pathlib.Path(os.environ.get("PGJAX_REFERENCE_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"reference data not found at {folder} (set PGJAX_REFERENCE_DATA)")
    return folder


@pytest.fixture
def measure(request):
    """`measure(case, quantity, value, below=… or above=… or within=(lo, hi))`: assert and keep.

    What a run measured is printed at its end as one table: value, demand, margin.
    `measure.curve(case, panel, series, x, y, order=…)` keeps what is drawn: y over x (h/L), in the
    panel of that title, beside a line of that order.
    """

    def check(case, quantity, value, *, below=None, above=None, within=None):
        value = float(value)
        if within is not None:
            low, high = within
            ok, demand = low <= value <= high, f"in [{low:.4g}, {high:.4g}]"
            margin = min(value - low, high - value) / (high - low)
        elif above is not None:
            ok, demand = value >= above, f">= {above:.3g}"
            margin = value / above if above else value
        else:
            ok, demand = value <= below, f"<= {below:.3g}"
            margin = below / value if value else float("inf")
        row = {
            "case": case,
            "quantity": quantity,
            "value": value,
            "demand": demand,
            "margin": float(margin),
            "ok": bool(ok),
        }
        request.node.user_properties.append(("measured", row))
        assert ok, f"{case}, {quantity}: {value:.4g}, demanded {demand}"

    def curve(case, panel, series, x, y, *, order=None, over="h/L"):
        kept = {
            "case": case,
            "panel": panel,
            "series": series,
            "x": [float(value) for value in x],
            "y": [float(value) for value in y],
            "order": order,
            "over": over,
        }
        request.node.user_properties.append(("curve", kept))

    check.curve = curve
    return check


@pytest.fixture
def holds(request):
    """`holds(case, outcome="holds", material="any")`: keep the outcome of a hard case.

    The outcome is "holds", "refused" (an error that names the argument) or "status: CONDITION".
    What is demanded is the name of the test and the first sentence of its docstring.
    """
    title = re.sub(r"^test_(h\d\d_)?", "", request.function.__name__).replace("_", " ")
    summary = " ".join((request.function.__doc__ or "").split("\n\n")[0].split())
    summary = re.sub(r"^(\w\d+[,:. ]+)+", "", summary)

    def keep(case, *, outcome="holds", material="any", precision=None):
        row = {
            "case": case,
            "what": f"{title}: {summary}" if summary else title,
            "material": material,
            "precision": precision or jnp.zeros(()).dtype.name,
            "outcome": outcome,
        }
        request.node.user_properties.append(("hard", row))

    return keep


def pytest_addoption(parser):
    parser.addoption(
        "--measured", default=None, help="write what the verification measured to this JSON file"
    )


def pytest_terminal_summary(terminalreporter, config):
    path = config.getoption("--measured")
    kept = {
        kind: [
            value
            for reports in terminalreporter.stats.values()
            for report in reports
            if getattr(report, "when", "") == "call"
            for name, value in report.user_properties
            if name == kind
        ]
        for kind in ("measured", "curve", "hard")
    }
    if not path or not any(kept.values()):
        return
    rows = kept["measured"]
    rows.sort(key=lambda row: row["case"])
    pathlib.Path(path).write_text(json.dumps(kept, indent=1) + "\n")
    terminalreporter.section("verification")
    for row in rows:
        terminalreporter.write_line(
            f"{row['case']:5} {row['quantity'][:58]:58} {row['value']:11.3e} "
            f"{row['demand']:24} {'ok' if row['ok'] else 'FAILED'}"
        )
