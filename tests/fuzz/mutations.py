"""Valid content made wrong: values of another type or size, keys lost or doubled, bytes damaged."""

import contextlib
import copy
import datetime
import math
import os
import time
import tracemalloc
import warnings

from hypothesis import settings
from hypothesis import strategies as st

# What refusing a file may take: seconds of computing, which tracing memory makes six times as long,
# and bytes.
SECONDS, BYTES = 12.0, 64 << 20


def fuzz(examples):
    """Settings of a fuzz test: so many examples, or PGJAX_FUZZ_EXAMPLES of them."""
    wanted = int(os.environ.get("PGJAX_FUZZ_EXAMPLES", "0"))
    return settings(settings.get_profile("fuzz"), max_examples=wanted or examples)


def nested(depth, kind=list):
    """A list in a list in a list …"""
    value = 1
    for _ in range(depth):
        value = [value] if kind is list else {"a": value}
    return value


NUMBERS = [0, -1, 1, 2, 3, 7, 2**31, 2**63, -(2**63), 10**30, 10**400, 0.5, -0.0, 1e-9, 1e9, 1e-320]
NUMBERS += [1e-160, 1e160, 1e308, -1e308, math.nan, math.inf, -math.inf]
TEXTS = ["", "x", "a" * 5000, "../../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "~"]
TEXTS += [
    "~nobody-here/x",
    "a\0b",
    "\x1b[31mred",
    "\u202e",
    ".",
    "..",
    "a/b",
    "\\",
    "²",
    "con",
    "-i",
]
OTHERS = [True, False, [], {}, [[]], [{}], [1.0, 2.0], [0.0, 0.0, 0.0], [math.nan, 0.0, 0.0]]
OTHERS += [
    [1e-200, 0.0, 0.0],
    [1e200, 1e200, 1e200],
    ["a", "b", "c"],
    [1, True, 2.0],
    {"file": "/dev/zero"},
]
OTHERS += [{"file": "values.npy"}, {"file": "missing.npy"}, {"a": {"b": [1]}}, nested(80)]
TOML_ONLY = [
    datetime.datetime(1979, 5, 27, 7, 32),
    datetime.date(1979, 5, 27),
    datetime.time(7, 32),
]


def places(tree, here=()):
    """Ways to every value of a tree of dicts and lists."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in items:
        yield (*here, key)
        if isinstance(value, dict | list):
            yield from places(value, (*here, key))


def at(tree, place):
    """The value at the end of a way."""
    for key in place:
        tree = tree[key]
    return tree


def values(*more):
    """Wrong values of any kind."""
    return st.sampled_from([*NUMBERS, *TEXTS, *OTHERS, *more]) | st.floats() | st.integers()


@st.composite
def damaged(draw, tree, extra=()):
    """A tree with one to three edits."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        known = list(places(tree))
        if not known:
            return tree
        *way, key = place = draw(st.sampled_from(known))
        home = at(tree, way)
        match draw(st.sampled_from(["replace", "replace", "replace", "drop", "double", "move"])):
            case "replace":
                home[key] = copy.deepcopy(draw(values(*extra)))
            case "drop":
                del home[key]
            case "double" if isinstance(home, list):
                home.append(copy.deepcopy(home[key]))
            case "double":
                home[draw(st.sampled_from([f"{key}x", f"{key}"[:-1], "name", "file"]))] = home[key]
            case "move":
                home[key] = copy.deepcopy(at(tree, draw(st.sampled_from(known))))
        del place
    return tree


@st.composite
def damaged_bytes(draw, content):
    """Bytes with a few of them changed, cut off, doubled or added."""
    raw = bytearray(content)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(raw) - 1, 0)))
        match draw(st.sampled_from(["flip", "flip", "set", "cut", "double", "insert", "zero"])):
            case "flip" if raw:
                raw[place] ^= 1 << draw(st.integers(0, 7))
            case "set" if raw:
                raw[place] = draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF, 0x0A, 0x20, 0x39, 0x2D]))
            case "cut":
                del raw[place:]
            case "double":
                raw[place:place] = raw[place : place + draw(st.integers(1, 64))]
            case "insert":
                raw[place:place] = draw(st.binary(min_size=1, max_size=16))
            case "zero":
                end = min(place + draw(st.integers(1, 16)), len(raw))
                raw[place:end] = bytes(end - place)
    return bytes(raw)


class refused:
    """What happens inside ends well or with one of these errors; warnings are no errors here."""

    def __init__(self, *errors):
        self.errors, self.error = errors, None
        self.caught = warnings.catch_warnings()

    def __enter__(self):
        self.caught.__enter__()
        warnings.simplefilter("ignore")
        return self

    def __exit__(self, kind, error, traceback):
        self.caught.__exit__(kind, error, traceback)
        self.error = error
        return error is not None and isinstance(error, self.errors)

    def __str__(self):
        return str(self.error)


@contextlib.contextmanager
def cheaply(seconds=SECONDS, size=BYTES):
    """What happens inside takes little time and memory."""
    tracemalloc.start()
    begun = time.process_time()
    try:
        yield
        spent, peak = time.process_time() - begun, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert spent < seconds, f"{spent:.1f} s"
    assert peak < size, f"{peak / 2**20:.0f} MiB"
