"""The result of a sweep: one row per member."""

import collections
import csv
import dataclasses
import os
from collections.abc import Iterator
from typing import Any, final

import numpy as np

from pgjax._files import replacing, with_suffix

# What can come of a member.
OK, WARNED, FAILED, PENDING = _STATUSES = ("ok", "warned", "failed", "pending")


@final
@dataclasses.dataclass(frozen=True)
class Table:
    """One row per member, in the order of the members.

    Attributes:
        columns: by name, `(n,)`, of parameters that are vectors `(n, d)`: parameters, what was
            measured, `status` ("ok"; "warned" where a condition makes part of the result doubtful;
            "failed" where a particle was lost or nothing could be simulated; "pending" where
            another process has not finished yet), `message` with the reason, `dt` (s), `substeps`
            per frame and `seconds` of computing. What is not known is NaN, -1 or empty.
        arrays: by name, `(n, …)`: what was measured and is no number.
        parameters: names of those that were varied.
        shape: how many values each had, where the members are all combinations; else `(n,)`.
    """

    columns: dict[str, np.ndarray]
    arrays: dict[str, np.ndarray]
    parameters: tuple[str, ...]
    shape: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.columns["status"])

    def __getitem__(self, name: str) -> np.ndarray:
        """A column or an array.

        Raises:
            KeyError: there is none of that name.
        """
        if name not in self.columns and name not in self.arrays:
            known = ", ".join((*self.columns, *self.arrays))
            raise KeyError(f"There is no column {name!r}, but {known}.")
        return self.columns[name] if name in self.columns else self.arrays[name]

    @property
    def ok(self) -> np.ndarray:
        """Which members were simulated and lost no particle, `(n,)`."""
        return np.isin(self.columns["status"], (OK, WARNED))

    @property
    def pending(self) -> int:
        """How many members another process has not finished yet."""
        return int(np.sum(self.columns["status"] == PENDING))

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The columns member by member, vectors number by number as `velocity.x`."""
        flat = dict(self._flat())
        return [dict(zip(flat, row, strict=True)) for row in zip(*flat.values(), strict=True)]

    def on_grid(self, name: str) -> np.ndarray:
        """A column or an array with one axis for each parameter, in the order of `parameters`."""
        values = self[name]
        return values.reshape(*self.shape, *values.shape[1:])

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write all columns, one row per member; numbers are exact.

        Args:
            path: a name that ends with .csv, in an existing folder; replaced if it is there.

        Raises:
            ValueError: it cannot be written.
        """
        with (
            replacing(with_suffix(path, (".csv",))) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            flat = dict(self._flat())
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(flat)
            writer.writerows(zip(*flat.values(), strict=True))

    def summary(self) -> str:
        """How many members ended how."""
        counts = {s: int(np.sum(self.columns["status"] == s)) for s in _STATUSES}
        told = [f"{count} {status}" for status, count in counts.items() if count]
        return f"{len(self)} members: {', '.join(told)}"

    def reasons(self) -> list[tuple[str, int]]:
        """The messages of members, and how many have each; the most frequent first."""
        return collections.Counter(m for m in self.columns["message"] if m).most_common()

    def _flat(self) -> Iterator[tuple[str, list[Any]]]:
        for name, values in self.columns.items():
            if values.ndim == 1:
                yield name, _plain(values)
                continue
            ends = "xyz" if values.shape[1] <= 3 else map(str, range(values.shape[1]))
            for end, part in zip(ends, values.T, strict=False):
                yield f"{name}.{end}", _plain(part)


def _plain(values: np.ndarray) -> list[Any]:
    """Python's own numbers and texts; of single precision the shortest that means the same."""
    if not np.issubdtype(values.dtype, np.floating):
        return values.tolist()
    numbers = [float(str(value)) for value in values]
    return [int(n) if n.is_integer() and abs(n) < 2**53 else n for n in numbers]
