"""Values of a scene file are changed in its text; comments and all else stay as they are."""

import copy
import itertools
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import tomli_w

from pgjax.scenes.reader import SceneError
from pgjax.scenes.settings import Place

LONGEST = 1 << 20
"""Bytes of a scene file at most."""
_HEADER = re.compile(r"\s*\[\[?\s*([^\[\]]+?)\s*\]\]?\s*(#.*)?$")


def edited(text: str, changes: Mapping[Place, Any], name: str) -> str:
    """The text of a scene file with some values changed, added or (None) taken away.

    Args:
        text: of the file.
        changes: values by where they stand.
        name: of the file, for messages.

    Raises:
        SceneError: the file is written so that a value cannot be changed in its place.
    """
    lines = text.split("\n")
    for place, value in changes.items():
        _put(lines, place, value)
    made = "\n".join(lines)
    try:
        same = tomllib.loads(made) == _expected(tomllib.loads(text), changes)
    except ValueError:
        same = False
    if not same:
        raise SceneError(
            f"{name} is written so that these keys must be changed by hand: "
            f"{', '.join(f'[{t}] {k} = {v}' for (t, _, k), v in changes.items())}."
        )
    return made


def _expected(content: dict[str, Any], changes: Mapping[Place, Any]) -> dict[str, Any]:
    """What the changed file has to say."""
    made = copy.deepcopy(content)
    for (name, number, key), value in changes.items():
        table = made.setdefault(name, {})
        table = table[number] if isinstance(table, list) else table
        *outer, last = key.split(".")
        for part in outer:
            table = table.setdefault(part, {})
        if value is None:
            table.pop(last, None)
        else:
            table[last] = value
    return made


def _put(lines: list[str], place: Place, value: Any) -> None:
    """Change one value in the lines of its table, or begin the table at the end."""
    name, number, key = place
    found = _sections(lines, f"{name}.{key.rpartition('.')[0]}") if "." in key else []
    if found:
        # The inner table has a header of its own.
        _in_table(lines, *found[number], key.rpartition(".")[2], value)
        return
    found = _sections(lines, name)
    if found:
        _in_table(lines, *found[number], key, value)
    elif value is not None:
        lines += [f"[{name}]", _line(key, value), ""]


def _sections(lines: list[str], name: str) -> list[tuple[int, int]]:
    """First and last + 1 line of the content of every table of a name."""
    heads = [(i, m[1]) for i, line in enumerate(lines) if (m := _HEADER.match(line))]
    heads.append((len(lines), ""))
    return [(i + 1, end) for (i, head), (end, _) in itertools.pairwise(heads) if head == name]


def _in_table(lines: list[str], start: int, end: int, key: str, value: Any) -> None:
    outer, _, inner = key.rpartition(".")
    for i in range(start, end):
        if re.match(rf"\s*{re.escape(key)}\s*=", lines[i]):
            if value is None:
                lines[i] = f"# {lines[i]}"
            else:
                comment = re.search(r"(\s+#[^'\"]*)$", lines[i])
                lines[i] = _line(key, value) + (comment[1] if comment else "")
            return
        if outer and (m := re.match(rf"(\s*{re.escape(outer)}\s*=\s*\{{)\s*(.*)$", lines[i])):
            room = "" if m[2].startswith("}") else ", "
            lines[i] = f"{m[1]} {_line(inner, value)}{room or ' '}{m[2]}"
            return
    if value is not None:
        # After the last line of the table that is not empty or a comment on what follows.
        last = max(
            (i for i in range(start, end) if lines[i].strip() and lines[i].strip()[0] != "#"),
            default=start - 1,
        )
        lines.insert(last + 1, _line(key, value))


def _line(key: str, value: Any) -> str:
    return tomli_w.dumps({"key": value}).strip().replace("key", key, 1)
