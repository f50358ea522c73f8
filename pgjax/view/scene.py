"""A scene file whose materials can be given other values while it is looked at."""

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, final

from pgjax.scenes import plan
from pgjax.scenes.reader import Table, content
from pgjax.scenes.schema import scene_from
from pgjax.view.show import Show, show_plan

Place = tuple[str | int, ...]
"""The keys that lead to a value, e.g. `("material", 0, "plasticity", "yield_stress")`."""

_UNITS = {
    "E": "Pa",
    "density": "kg/m³",
    "damping_viscosity": "Pa·s",
    "bulk_modulus": "Pa",
    "yield_stress": "Pa",
    "friction_angle": "degrees",
    "activation": "Pa",
    "frequency": "1/s",
    "phase": "degrees",
}


@final
class Live:
    """A scene file, to be simulated with its own values or with others.

    Attributes:
        texts: the numbers of its materials by the keys that lead to them, as they are written.
    """

    def __init__(self, path: Path, *, ply: Path | None = None, frames: int | None = None):
        self._path = path
        self._ply = ply
        self._frames = frames
        data = content(path)
        found = _numbers(data.get("material"), ("material",))
        self.texts: dict[Place, str] = {place: f"{value:g}" for place, value in found}

    def show(self, texts: Mapping[Place, str] | None = None) -> Show:
        """The scene with other values of materials, each as it would be written in the file.

        Raises:
            SceneError: a value breaks a rule, or the scene is not usable.
        """
        data = content(self._path)
        for place, text in (texts or {}).items():
            if text != self.texts.get(place):
                _at(data, place[:-1])[place[-1]] = _value(text)
        file = scene_from(Table(self._path.name, data, self._path.parent), self._path.stem)
        return show_plan(plan(file, ply=self._ply, frames=self._frames))


def label(place: Place) -> str:
    """A key and its unit."""
    key = str(place[-1])
    unit = _UNITS.get(key)
    return f"{key} ({unit})" if unit else key


def _numbers(value: Any, place: Place) -> Iterator[tuple[Place, float]]:
    """All numbers in the tables of the materials, but for their regions and vectors."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        yield place, value
    elif isinstance(value, dict):
        for key, inner in value.items():
            if key not in ("region", "direction"):
                yield from _numbers(inner, (*place, key))
    elif isinstance(value, list) and place == ("material",):
        for index, inner in enumerate(value):
            yield from _numbers(inner, (*place, index))


def _at(data: Any, place: Place) -> Any:
    for key in place:
        data = data[key]
    return data


def _value(text: str) -> Any:
    """A value as TOML reads it; what is none stays a text, and the reader refuses it."""
    try:
        read = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return read["value"] if len(read) == 1 else text
