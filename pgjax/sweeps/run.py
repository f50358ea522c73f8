"""A sweep that goes on: call after call, what is finished is kept."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import final

import numpy as np

from pgjax.sweeps.layout import Layout
from pgjax.sweeps.program import Program
from pgjax.sweeps.results import MEASURED, Results, members_of, tabulated
from pgjax.sweeps.store import Store
from pgjax.sweeps.table import Table

Keep = Callable[[int, dict[str, np.ndarray]], None]

# Seconds between two files of results: what is lost if the process is killed.
_PATIENCE = 10


@final
@dataclasses.dataclass(frozen=True)
class Run:
    """A sweep that has been planned.

    Attributes:
        layout: what runs together.
        program: what runs them.
        store: where results are kept, if anywhere.
        keep: takes the arrays of each member.
        progress: called as `progress(done, members)`.
    """

    layout: Layout
    program: Program
    store: Store | None
    keep: Keep | None
    progress: Callable[[int, int], None] | None

    def play(self, share: tuple[int, int] | None) -> Table:
        """Run what is left of the share, and make the table."""
        groups = self.layout.groups()
        results = [] if self.store is None else self.store.results()
        done = members_of(results)
        first, stride = share or (0, 1)
        mine = range(first, len(groups), stride)
        left = [groups[g] for g in mine if not done.issuperset(groups[g].tolist())]
        with _writing(self.store) as write:
            for found in self._calls(left):
                write(found)
                results.append(found)
                done |= members_of([found])
                if self.progress is not None:
                    self.progress(len(done), self.layout.able)
        return self._finished(share is not None, results)

    def _calls(self, groups: Sequence[np.ndarray]) -> Iterator[Results]:
        """The results of call after call."""
        at_a_time = len(self.program.devices)
        for start in range(0, len(groups), at_a_time):
            found = self._called(groups[start : start + at_a_time])
            yield found if self.keep is None else _handed_over(found, self.keep)

    def _called(self, groups: Sequence[np.ndarray]) -> Results:
        """Run some groups, at most one for each device."""
        program, lanes = self.program, self.program.lanes
        # A call always has the same size. What is missing is filled up, and left out again.
        padded = [*groups, *[groups[-1]] * (len(program.devices) - len(groups))]
        member = np.concatenate([np.resize(group, lanes) for group in padded])
        kept = np.concatenate([i * lanes + np.arange(len(g)) for i, g in enumerate(groups)])
        substeps = np.asarray([self.layout.need.substeps[group].max() for group in padded])
        measured, status, seconds = program(self.layout.members.some(member), substeps)
        steps = np.repeat(substeps, lanes)[kept]
        return {
            "member": member[kept],
            "substeps": steps,
            "dt": program.frame_dt / steps,
            "seconds": np.full(len(kept), seconds / len(kept)),
            "status.first": np.asarray(status.first)[kept],
            "status.count": np.asarray(status.count)[kept],
            **{MEASURED + name: a[kept] for name, a in measured.items()},
        }

    def _finished(self, shared: bool, results: Sequence[Results]) -> Table:
        """The table; on disk if it is complete."""
        if self.store is not None and shared:
            # What the others have done meanwhile.
            results = self.store.results()
        table = tabulated(self.layout.members, self.layout.need, results)
        if self.store is not None and not table.pending:
            table.to_csv(self.store.folder / "sweep.csv")
            if not shared:
                # Another process may just be reading.
                self.store.clear()
        return table


@contextlib.contextmanager
def _writing(store: Store | None) -> Iterator[Callable[[Results], None]]:
    """What takes results and writes those of some seconds at a time; the rest at the end."""
    waiting: list[Results] = []
    latest = time.monotonic()

    def write_all() -> None:
        if store is not None and waiting:
            store.add(waiting)
        waiting.clear()

    def write(found: Results) -> None:
        nonlocal latest
        waiting.append(found)
        if time.monotonic() - latest > _PATIENCE:
            write_all()
            latest = time.monotonic()

    try:
        yield write
    finally:
        # Also when it is interrupted.
        write_all()


def _handed_over(found: Results, keep: Keep) -> Results:
    """The results without the arrays, which somebody else keeps."""
    arrays = {name: a for name, a in found.items() if name.startswith(MEASURED) and a.ndim > 1}
    for row, member in enumerate(found["member"]):
        keep(int(member), {n.removeprefix(MEASURED): a[row] for n, a in arrays.items()})
    return {name: a for name, a in found.items() if name not in arrays}
