"""Reading a TOML table strictly: every key is known, typed and in range, or the error says why."""

import contextlib
import difflib
import itertools
import math
import os
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, final

import numpy as np

from pgjax._files import is_file, is_folder, read_text

T = TypeVar("T")
REQUIRED: Any = object()
_LARGEST = 2**31 - 1
# A scene file is short: what is larger, or has deeper keys, would take the parser for ever.
_LONGEST_FILE, _DEEPEST_KEY = 1 << 20, 100
_BETWEEN_KEYS = re.compile(r"[=,{}\[\]\n]")
# Names further from what was meant are not looked at for a hint: how many, how long.
_MOST_NAMES, _LONGEST_NAME = 1000, 80
# Longer paths are cut in messages.
_LONGEST_PATH = 200
# No separators of any system, nothing that a terminal obeys, not `.` or `..`.
_FILE_NAME = re.compile(r"(?!\.{1,2}$)[^/\\:\x00-\x1f\x7f]+")
_LONGEST_FILE_NAME = 200
# Of a value of any length a message shows as much as fits into a line.
_SHORT = reprlib.Repr()
_SHORT.maxstring = 80


class SceneError(ValueError):
    """A scene file cannot be used; the message names file, key, rule and value."""


class Range(NamedTuple):
    """Bounds of a number; all numbers are finite."""

    above: float = -math.inf
    at_least: float = -math.inf
    below: float = math.inf

    def holds(self, value: Any) -> Any:
        """Whether a number, or which entries of an array, are within the bounds."""
        inside = (value > self.above) & (value >= self.at_least) & (value < self.below)
        return np.isfinite(value) & inside

    def __str__(self) -> str:
        bounds = [f"above {self.above:g}"] if self.above > -math.inf else []
        bounds += [f"at least {self.at_least:g}"] if self.at_least > -math.inf else []
        bounds += [f"below {self.below:g}"] if self.below < math.inf else []
        return f"a finite number {' and '.join(bounds)}".rstrip()


@final
class Table:
    """One table of a scene file. Take what is expected, then `close` it: the rest is an error.

    Args:
        name: how messages call it, e.g. `ficus.toml [grid]`.
        data: the parsed table.
        folder: what paths are relative to.

    Attributes:
        lengths: lengths of the files with one value per Gaussian that were read here or in a table
            within this one, by the place where they are named.
    """

    def __init__(self, name: str, data: Mapping[str, Any], folder: Path = Path()):
        self.name = name
        self.folder = folder
        self.lengths: dict[str, int] = {}
        self._data = dict(data)
        self._known: dict[str, None] = {}
        self._chosen = ""

    def error(self, key: str, rule: str) -> SceneError:
        """The error of a key whose value breaks a rule."""
        value = _SHORT.repr(self._data.get(key))
        return SceneError(f"{self.name}: `{key}` must {rule}, but is {value}.")

    def has(self, key: str) -> bool:
        """Whether the key is given."""
        return key in self._data

    def is_a(self, key: str, kind: type) -> bool:
        """Whether the key is given, with a value of this kind."""
        return isinstance(self._data.get(key), kind)

    def _take(self, key: str, default: Any) -> Any:
        self._known[key] = None
        if key not in self._data and default is REQUIRED:
            others = [k for k in self._data if k not in self._known]
            misspelt = _nearest(key, others)
            hint = f" (is `{misspelt}` meant?)" if misspelt else ""
            raise SceneError(f"{self.name}: `{key}` is missing{hint}.")
        return self._data.get(key, default)

    def number(self, key: str, default: Any = REQUIRED, **bounds: float) -> Any:
        """A finite number in a `Range`; the default is returned as it is."""
        value = self._take(key, default)
        if key not in self._data:
            return value
        if not _is_number(value):
            raise self.error(key, "be a number")
        allowed = Range(**bounds)
        if not allowed.holds(_as_float(value)):
            raise self.error(key, f"be {allowed}")
        return float(value)

    def integer(
        self, key: str, default: Any = REQUIRED, *, at_least: int = 1, at_most: int = _LARGEST
    ) -> Any:
        """A whole number."""
        value = self._take(key, default)
        if key not in self._data:
            return value
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not whole or not at_least <= value <= at_most:
            raise self.error(key, f"be a whole number, at least {at_least}, at most {at_most}")
        return value

    def boolean(self, key: str, default: bool) -> bool:
        """True or false."""
        value = self._take(key, default)
        if not isinstance(value, bool):
            raise self.error(key, "be true or false")
        return value

    def booleans(self, key: str, default: tuple[bool, bool, bool]) -> tuple[bool, bool, bool]:
        """Three times true or false, one for each direction."""
        value = self._take(key, list(default))
        if not isinstance(value, list) or len(value) != 3 or {type(v) for v in value} != {bool}:
            raise self.error(key, "be a list of 3 times true or false")
        return value[0], value[1], value[2]

    def text(self, key: str, default: Any = REQUIRED) -> Any:
        """A string."""
        value = self._take(key, default)
        if key in self._data and not isinstance(value, str):
            raise self.error(key, "be a string")
        return value

    def path(self, key: str, default: Any = REQUIRED) -> Any:
        """A path, relative to the scene file; it may name nothing yet."""
        text = self.text(key, default)
        if key not in self._data:
            return text
        try:
            return self.folder / Path(text).expanduser()
        except RuntimeError:
            raise self.error(key, "name a file in a home folder that is known") from None

    def existing_path(self, key: str) -> Path:
        """A path, relative to the scene file, of a file or folder that is there."""
        path = self.path(key)
        if not is_file(path) and not is_folder(path):
            raise missing_file(f"{self.name}: `{key}`", path)
        return path

    def file_name(self, key: str, default: str) -> str:
        """A string that can name a file or folder in another one, and leads nowhere else."""
        name = self.text(key, default)
        if not _FILE_NAME.fullmatch(name) or len(os.fsencode(name)) > _LONGEST_FILE_NAME:
            rule = f"name a folder, without slashes, in at most {_LONGEST_FILE_NAME} bytes"
            raise SceneError(f"{self.name}: `{key}` must {rule}, but is {_SHORT.repr(name)}.")
        return name

    def vector(self, key: str, default: Any = REQUIRED, *, size: int = 3, **bounds: float) -> Any:
        """A list of finite numbers in a `Range`."""
        value = self._take(key, default)
        if key not in self._data:
            return value
        numbers = isinstance(value, Sequence) and all(_is_number(v) for v in value)
        if not numbers or len(value) != size:
            raise self.error(key, f"be a list of {size} numbers")
        allowed = Range(**bounds)
        if not all(allowed.holds(_as_float(v)) for v in value):
            raise self.error(key, f"be a list of {size} numbers, each {allowed}")
        return tuple(float(v) for v in value)

    def integers(self, key: str) -> tuple[int, ...]:
        """A list of at least one whole number."""
        value = self._take(key, REQUIRED)
        whole = isinstance(value, list) and all(
            isinstance(v, int) and not isinstance(v, bool) for v in value
        )
        if not whole or not value:
            raise self.error(key, "be a list of whole numbers")
        return tuple(value)

    def texts(self, key: str, default: Any = REQUIRED) -> Any:
        """A list of strings."""
        value = self._take(key, default)
        if key not in self._data:
            return value
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise self.error(key, "be a list of strings")
        return tuple(value)

    def choice(self, key: str, choices: Mapping[str, T], default: Any = REQUIRED) -> T:
        """What a name stands for."""
        name = self.text(key, default)
        if name not in choices:
            raise self.error(key, f"be one of {', '.join(choices)}{nearest(str(name), choices)}")
        return choices[name]

    def kind(
        self, key: str, readers: Mapping[str, Callable[["Table"], T]], default: Any = REQUIRED
    ) -> T:
        """What the reader of a named kind makes of this table; other keys may depend on it."""
        reader = self.choice(key, readers, default)
        self._chosen = f' with {key} = "{self._data.get(key, default)}"'
        return reader(self)

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> "Table":
        """A sub-table; an absent one reads as the default."""
        value = self._take(key, REQUIRED if default is None else default)
        if not isinstance(value, Mapping):
            raise self.error(key, "be a table")
        inner = Table(f"{self.name} [{key}]", value, self.folder)
        inner.lengths = self.lengths
        return inner

    def optional(self, key: str, reader: Callable[["Table"], T]) -> T | None:
        """What a reader makes of a sub-table; None where it is absent."""
        if key in self._data:
            return self.table(key).read(reader)
        self._known[key] = None
        return None

    def tables(self, key: str, *, required: bool = False) -> list["Table"]:
        """A list of tables, `[[key]]`."""
        value = self._take(key, REQUIRED if required else [])
        if not isinstance(value, list) or not all(isinstance(v, Mapping) for v in value):
            raise self.error(key, f"be written as [[{key}]] tables")
        names = (f"{self.name} [[{key}]] {i + 1}" for i in range(len(value)))
        return [Table(name, v, self.folder) for name, v in zip(names, value, strict=True)]

    def variants(self, key: str, parts: Sequence[str]) -> tuple["Table", dict[str, "Table"]]:
        """This table without a key, and what each table that is written under it makes of the rest.

        Such a table says what is different in some of the `parts`, which are tables themselves.
        """
        plain = {name: value for name, value in self._data.items() if name != key}
        made = {}
        for name, changes in self._data.get(key, {}).items() if self.is_a(key, dict) else ():
            label = f"{self.name} [{key}.{name}]"
            here = Table(label, changes if isinstance(changes, dict) else {name: changes})
            varied = dict(plain)
            for part in parts:
                if here.has(part) and not isinstance(plain.get(part, {}), dict):
                    raise here.error(part, "be left out where the scene has several of it")
                varied[part] = {**plain.get(part, {}), **dict(here.table(part, {})._data)}
            here.close()
            made[name] = Table(label, {k: v for k, v in varied.items() if v}, self.folder)
        if self.has(key) and not self.is_a(key, dict):
            raise self.error(key, "be a table of tables")
        return Table(self.name, plain, self.folder), made

    def read(self, reader: Callable[["Table"], T]) -> T:
        """Apply a reader to this table; `ValueError`s name the table, leftovers are errors."""
        with naming(self.name):
            result = reader(self)
        self.close()
        return result

    def close(self) -> None:
        """Raise for the first key nobody asked for."""
        for key in self._data:
            if key not in self._known:
                raise SceneError(
                    f"{self.name}: `{key}` is not a known key{self._chosen}"
                    f"{nearest(key, self._known)}; allowed are {', '.join(self._known)}."
                )


@contextlib.contextmanager
def naming(name: str) -> Iterator[None]:
    """Put a name in front of the message of a `ValueError` that is not a `SceneError` yet."""
    try:
        yield
    except SceneError:
        raise
    except ValueError as error:
        raise SceneError(f"{name}: {error}") from error


def nearest(name: str, known: Iterable[str]) -> str:
    """The hint at the known name that is most like this one; nothing if none is."""
    close = _nearest(name, known)
    return f" (did you mean `{close}`?)" if close else ""


def _nearest(name: str, known: Iterable[str]) -> str:
    """The known name that is most like this one; empty if none is."""
    if len(name) > _LONGEST_NAME:
        return ""
    short = itertools.islice((k for k in known if len(k) <= _LONGEST_NAME), _MOST_NAMES)
    return next(iter(difflib.get_close_matches(name, list(short), n=1)), "")


def missing_file(where: str, path: Path) -> SceneError:
    """The error of a path that names nothing, with the nearest name in its folder."""
    return SceneError(f"{where} must name a file, but there is no {shown(path)}{_neighbour(path)}.")


def shown(path: Path) -> str:
    """A path in a message: its end where it is long, nothing in it that a terminal obeys."""
    text = str(path)
    text = text if len(text) <= _LONGEST_PATH else f"…{text[-_LONGEST_PATH:]}"
    return text if text.isprintable() else repr(text)


def _neighbour(path: Path) -> str:
    if not is_folder(path.parent):
        return ""
    return nearest(path.name, (p.name for p in path.parent.iterdir() if p.name != path.name))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _as_float(value: float) -> float:
    """The number; infinity for an integer that is too large."""
    try:
        return float(value)
    except OverflowError:
        return math.inf


def parse(path: Path) -> Table:
    """The root table of a TOML file."""
    return Table(path.name, content(path), path.parent)


def content(path: Path) -> dict[str, Any]:
    """What is written in a TOML file."""
    if not is_file(path):
        raise SceneError(f"The scene file {shown(path)} does not exist{_neighbour(path)}.")
    try:
        text = read_text(path, _LONGEST_FILE)
        if any(part.count(".") > _DEEPEST_KEY for part in _BETWEEN_KEYS.split(text)):
            raise ValueError(f"it has a key of more than {_DEEPEST_KEY} parts")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} is not a TOML file: {error}.") from error
