"""Arguments of any kind and size: a result, or an error that names argument, rule and value."""

import math
import os
import pathlib
import subprocess
import sys

import arguments
import jaxtyping
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mutations import fuzz, refused

import pgjax

# The type checker of the tests looks at some arguments before the package does.
ERRORS = ValueError, jaxtyping.TypeCheckError
REAL = st.floats(width=64) | st.integers() | st.sampled_from(arguments.UNUSUAL[:10])
ARRAYS = hnp.arrays(np.float64, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=8))
PLACES = [(call, name) for call, valid in arguments.CALLS.items() for name in valid]


def test_values_of_any_type_are_named():
    """In a process of its own, in which no types are checked."""
    script = pathlib.Path(arguments.__file__)
    done = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert not done.stdout, done.stdout


@fuzz(120)
@given(place=st.sampled_from(PLACES), value=REAL | ARRAYS | st.lists(REAL, max_size=4))
def test_numbers_of_any_size(place, value):
    call, name = place
    with refused(*ERRORS) as refusal:
        call(**(arguments.CALLS[call] | {name: value}))
    if isinstance(refusal.error, ValueError):
        assert any(words in str(refusal) for words in arguments.NAMED), refusal


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: pgjax.Grid((0, 0), (8, 8), [0.1, 0.2]), "`h` must be one number"),
        (lambda: pgjax.Grid((0, 0), (8, 8), "fine"), "`h` must be a number or an array"),
        (lambda: pgjax.Scene(arguments.GRID, arguments.JELLY, 1.0), r"`volumes` must have shape"),
        (
            lambda: pgjax.Scene(arguments.GRID, [arguments.JELLY] * 2, np.ones(8), counts=(-1, 9)),
            "`counts` must give the particles",
        ),
        (
            lambda: pgjax.simulate(
                arguments.SCENE, arguments.STATE, dt=1e-9, frames=2**20, substeps=2**11
            ),
            "fewer than 2.31 steps",
        ),
        (lambda: arguments.models.NeoHookean("soft", 0.3), "`E` must be a number or an array"),
    ],
)
def test_found_by_fuzzing(call, words):
    with pytest.raises(ERRORS, match=words):
        call()


@pytest.mark.parametrize(
    "shape", [(8.5, 8), (10**400, 8), (math.nan, 8), (math.inf, 8), "88", None]
)
def test_numbers_of_cells_are_whole(shape):
    with pytest.raises(ERRORS):
        pgjax.Grid((0, 0), shape, 0.1)
