"""Random input that is the same in every run; PGJAX_FUZZ_EXAMPLES asks for more of it."""

import faulthandler
import os

import pytest
from hypothesis import HealthCheck, settings

EXAMPLES = int(os.environ.get("PGJAX_FUZZ_EXAMPLES", "0"))
# What hangs is ended with a traceback of where.
PATIENCE = 300

settings.register_profile(
    "fuzz",
    derandomize=not EXAMPLES,
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    print_blob=False,
)


@pytest.fixture(autouse=True)
def in_bounded_time():
    """No input may make a reader wait for ever."""
    if not EXAMPLES:
        faulthandler.dump_traceback_later(PATIENCE, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()
