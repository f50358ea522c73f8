"""What of a scene file can be varied, and the values that `--vary` gives it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import final

import numpy as np

from pgjax.cases.unknowns import Key, Place, find
from pgjax.models.material import parameter_paths
from pgjax.scenes import Plan, SceneError
from pgjax.scenes.reader import nearest

_RULE = "be KEY=FIRST:LAST:COUNT, KEY=FIRST:LAST:COUNT:log, or KEY=VALUE,VALUE,…"
_MOST_VALUES = 1_000_000


@final
@dataclasses.dataclass(frozen=True)
class Varied:
    """One `--vary`: the key in full, where its values go, and the values, `(n,)` or `(n, 3)`."""

    key: str
    place: Place
    values: np.ndarray


def varied(text: str, plan: Plan) -> Varied:
    """What one `--vary` says.

    Raises:
        SceneError: the key names nothing, or several things; or the values are no numbers.
    """
    name, sign, values = text.partition("=")
    if not sign or not name or not values:
        raise SceneError(f"Argument `--vary` must {_RULE}, but is {text!r}.")
    key = full_key(name.strip(), plan)
    place = find(Key(key, "Argument `--vary`"), plan)
    if place.now.ndim > 1 or place.now.shape not in ((), (2,), (3,)):
        raise SceneError(
            f"Argument `--vary` must name one number or one vector, but `{key}` is given for "
            f"{place.now.shape[0]} particles."
        )
    return Varied(key, place, _values(text, values, place.now.shape))


def full_key(name: str, plan: Plan) -> str:
    """The key that a name stands for: itself, or the only one that ends with it."""
    known = known_keys(plan)
    if name in known:
        return name
    fitting = [key for key in known if key.endswith(f".{name}")]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise SceneError(
            f"Argument `--vary` must say which of {', '.join(fitting)} is meant, but is {name!r}."
        )
    if "." in name:
        # Of a table that is counted although it is the only one.
        find(Key(name, "Argument `--vary`"), plan)
        return name
    short = {key.rpartition(".")[2] for key in known}
    raise SceneError(
        f"Argument `--vary` must name one of {', '.join(known)}{nearest(name, sorted(short))}, but "
        f"is {name!r}."
    )


def known_keys(plan: Plan) -> list[str]:
    """All keys that can be varied; tables are counted where there are several."""
    keys = []
    materials = plan.scene.materials
    for table, material in zip(_tables("material", materials), materials, strict=True):
        for path, _ in parameter_paths(material):
            group = path[0] if path[0] in ("plasticity", "active") else None
            keys.append(".".join((table, *((group,) if group else ()), path[-1])))
    boundaries = plan.scene.boundaries
    keys += [f"{table}.friction" for table in _tables("boundary", boundaries)]
    keys += [f"forces.{name}" for name in ("gravity", "grid_damping", "shear_damping")]
    for table in _tables("model", plan.models):
        keys += [f"{table}.velocity", f"{table}.angular_velocity"]
    return [key for key in dict.fromkeys(keys) if _can_be_found(key, plan)]


def _tables(kind: str, items: Sequence[object]) -> list[str]:
    return [kind] if len(items) == 1 else [f"{kind}.{i + 1}" for i in range(len(items))]


def _can_be_found(key: str, plan: Plan) -> bool:
    try:
        find(Key(key, ""), plan)
    except SceneError:
        return False
    return True


def _values(text: str, values: str, shape: tuple[int, ...]) -> np.ndarray:
    """`1e4:1e6:8:log`, `0.1,0.3` or, of a vector, `0,0,-1; 0,0,-2`."""
    try:
        if shape:
            made = np.asarray([_numbers(part) for part in values.split(";")])
        elif ":" in values:
            made = _range(values.split(":"))
        else:
            made = np.asarray(_numbers(values))
    except (ValueError, OverflowError) as error:
        rule = _RULE if not shape else "be KEY=X,Y,Z or KEY=X,Y,Z;X,Y,Z;… for a vector"
        raise SceneError(f"Argument `--vary` must {rule}, but is {text!r}: {error}.") from None
    if made.shape[1:] != shape:
        raise SceneError(
            f"Argument `--vary` must give vectors of {shape[0]} numbers, separated by semicolons, "
            f"but is {text!r}."
        )
    return made


def _numbers(text: str) -> list[float]:
    numbers = [float(part) for part in text.split(",")]
    if not all(map(math.isfinite, numbers)):
        raise ValueError("a value is not finite")
    return numbers


def _range(parts: list[str]) -> np.ndarray:
    if len(parts) not in (3, 4) or (len(parts) == 4 and parts[3] != "log"):
        raise ValueError("a range has two ends and a count, and may end with `log`")
    (first, last), count = _numbers(",".join(parts[:2])), int(parts[2])
    if not 1 <= count <= _MOST_VALUES:
        raise ValueError(f"the count is from 1 to {_MOST_VALUES}")
    if len(parts) == 3:
        return np.linspace(first, last, count)
    if not (first > 0 and last > 0):
        raise ValueError("the ends of a logarithmic range are positive")
    return np.geomspace(first, last, count)
