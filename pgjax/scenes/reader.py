"""Reading a TOML table strictly: every key is known, typed and in range, or the error says why."""

import difflib
import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, final

T = TypeVar("T")
_REQUIRED: Any = object()


class SceneError(ValueError):
    """A scene file cannot be used; the message names file, key, rule and value."""


@final
class Table:
    """One table of a scene file. Take what is expected, then `close` it: the rest is an error.

    Args:
        name: how messages call it, e.g. `ficus.toml [grid]`.
        data: the parsed table.
    """

    def __init__(self, name: str, data: Mapping[str, Any]):
        self._name = name
        self._data = dict(data)
        self._known: list[str] = []

    def error(self, key: str, rule: str) -> SceneError:
        """The error of a key whose value breaks a rule."""
        return SceneError(f"{self._name}: `{key}` must {rule}, but is {self._data.get(key)!r}.")

    def has(self, key: str) -> bool:
        """Whether the key is given."""
        return key in self._data

    def _take(self, key: str, default: Any) -> Any:
        self._known.append(key)
        if key not in self._data and default is _REQUIRED:
            misspelt = difflib.get_close_matches(key, self._data, n=1)
            hint = f" (is `{misspelt[0]}` meant?)" if misspelt else ""
            raise SceneError(f"{self._name}: `{key}` is missing{hint}.")
        return self._data.get(key, default)

    def number(
        self,
        key: str,
        default: Any = _REQUIRED,
        *,
        above: float = -math.inf,
        at_least: float = -math.inf,
        below: float = math.inf,
    ) -> Any:
        """A finite number in a range; the default is returned as it is."""
        value = self._take(key, default)
        if key not in self._data:
            return value
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, "be a number")
        if not (math.isfinite(value) and above < value < below and value >= at_least):
            bounds = [f"above {above:g}"] if above > -math.inf else []
            bounds += [f"at least {at_least:g}"] if at_least > -math.inf else []
            bounds += [f"below {below:g}"] if below < math.inf else []
            raise self.error(key, f"be a finite number {' and '.join(bounds)}".rstrip())
        return float(value)

    def integer(self, key: str, default: Any = _REQUIRED, *, at_least: int = 1) -> Any:
        """A whole number."""
        value = self._take(key, default)
        if key in self._data and (
            isinstance(value, bool) or not isinstance(value, int) or value < at_least
        ):
            raise self.error(key, f"be a whole number, at least {at_least}")
        return value

    def boolean(self, key: str, default: bool) -> bool:
        """True or false."""
        value = self._take(key, default)
        if not isinstance(value, bool):
            raise self.error(key, "be true or false")
        return value

    def text(self, key: str, default: Any = _REQUIRED) -> Any:
        """A string."""
        value = self._take(key, default)
        if key in self._data and not isinstance(value, str):
            raise self.error(key, "be a string")
        return value

    def vector(self, key: str, default: Any = _REQUIRED, *, size: int = 3) -> Any:
        """A list of finite numbers."""
        value = self._take(key, default)
        if key not in self._data:
            return value
        numbers = isinstance(value, Sequence) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
            for v in value
        )
        if not numbers or len(value) != size:
            raise self.error(key, f"be a list of {size} finite numbers")
        return tuple(float(v) for v in value)

    def choice(self, key: str, choices: Mapping[str, T], default: Any = _REQUIRED) -> T:
        """What a name stands for."""
        name = self.text(key, default)
        if name not in choices:
            hint = _nearest(str(name), choices)
            raise self.error(key, f"be one of {', '.join(choices)}{hint}")
        return choices[name]

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> "Table":
        """A sub-table; an absent one reads as the default."""
        value = self._take(key, _REQUIRED if default is None else default)
        if not isinstance(value, Mapping):
            raise self.error(key, "be a table")
        return Table(f"{self._name} [{key}]", value)

    def tables(self, key: str, *, required: bool = False) -> list["Table"]:
        """A list of tables, `[[key]]`."""
        value = self._take(key, _REQUIRED if required else [])
        if not isinstance(value, list) or not all(isinstance(v, Mapping) for v in value):
            raise self.error(key, f"be written as [[{key}]] tables")
        return [Table(f"{self._name} [[{key}]] {i + 1}", v) for i, v in enumerate(value)]

    def read(self, reader: Callable[["Table"], T]) -> T:
        """Apply a reader to this table; `ValueError`s name the table, leftovers are errors."""
        try:
            result = reader(self)
        except SceneError:
            raise
        except ValueError as error:
            raise SceneError(f"{self._name}: {error}") from error
        self.close()
        return result

    def close(self) -> None:
        """Raise for the first key nobody asked for."""
        for key in self._data:
            if key not in self._known:
                raise SceneError(
                    f"{self._name}: `{key}` is not a known key{_nearest(key, self._known)}; "
                    f"allowed are {', '.join(self._known)}."
                )


def _nearest(name: str, known: Any) -> str:
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean `{close[0]}`?)" if close else ""


def parse(path: Path) -> Table:
    """The root table of a TOML file."""
    if not path.is_file():
        raise SceneError(f"The scene file {path} does not exist.")
    try:
        return Table(path.name, tomllib.loads(path.read_text(encoding="utf-8")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{path} is not a TOML file: {error}") from error
