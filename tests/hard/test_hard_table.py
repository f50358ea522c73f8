"""The table of hard cases is whole."""

import pathlib
import re

TESTS = pathlib.Path(__file__).parents[1]


def test_every_hard_case_keeps_an_outcome():
    """H01 to H56, each by a test that keeps what held for `python -m benchmarks.verification`."""
    texts = [path.read_text() for path in TESTS.rglob("test_*.py")]
    kept = {case for text in texts for case in re.findall(r'holds\(\s*"(H\d\d)"', text)}
    assert kept == {f"H{i:02d}" for i in range(1, 57)}
