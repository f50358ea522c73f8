"""Strict settings for the whole suite, and the fixtures that many tests share."""

import os
import pathlib

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Tests spend most of their time compiling: keep what was compiled between runs.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(pathlib.Path(__file__).parent.parent / ".jax_cache")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import jax
import pytest
from jaxtyping import install_import_hook

# PGJAX_TEST_FLOAT32=1 runs the suite in single precision (tests marked `float64` are left out).
FLOAT32 = os.environ.get("PGJAX_TEST_FLOAT32", "") == "1"

jax.config.update("jax_enable_x64", not FLOAT32)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

install_import_hook("pgjax", "beartype.beartype")


def pytest_configure(config):
    config.addinivalue_line("markers", "float64: needs double precision")


def pytest_collection_modifyitems(items):
    if FLOAT32:
        for item in items:
            if item.get_closest_marker("float64"):
                item.add_marker(pytest.mark.skip(reason="needs double precision"))


@pytest.fixture(scope="session")
def reference_data() -> pathlib.Path:
    """The folder of captured scenes and reference renders, which is not part of the project."""
    default = pathlib.Path(__file__).parent.parent.parent / "shared" / "data"
    folder = pathlib.Path(os.environ.get("PGJAX_REFERENCE_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"reference data not found at {folder} (set PGJAX_REFERENCE_DATA)")
    return folder
