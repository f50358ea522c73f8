"""The sweep: groups of members that need about the same time step, one compiled program."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from pgjax.state import State
from pgjax.sweeps.layout import Layout, laid_out
from pgjax.sweeps.need import Build
from pgjax.sweeps.outcome import outcome
from pgjax.sweeps.program import Measure, Program, Save, Task
from pgjax.sweeps.results import tabulated
from pgjax.sweeps.run import Keep, Run
from pgjax.sweeps.store import fingerprint, open_store, require_empty
from pgjax.sweeps.table import Table
from pgjax.timestep import ELASTIC_FRACTION


def nothing(state: State) -> None:
    """A trajectory that keeps no frames."""
    del state


def sweep(
    build: Build,
    vary: Any,
    *,
    frames: int,
    frame_dt: float,
    measure: Measure = outcome,
    save: Save = nothing,
    dt: float | None = None,
    fraction: float = ELASTIC_FRACTION,
    allow_unstable: bool = False,
    at_once: int | None = None,
    memory: float | None = None,
    devices: Sequence[jax.Device] | None = None,
    folder: str | Path | None = None,
    resume: bool = False,
    share: tuple[int, int] | None = None,
    keep: Keep | None = None,
    progress: bool | Callable[[int, int], None] = False,
) -> Table:
    """Simulate many members of one scene, in one compiled program, and measure each.

    The members are sorted by the steps per frame they need and run in groups, one on each device
    at a time. All members of a group take the steps of the one that needs most: their time step
    is the frame divided by them. A frame lasts equally long for all members.

    A member that fails is a row that says why; it never ends the sweep and never harms another.

    Args:
        build: from the values by name to scene and initial state. It is traced: the number of
            particles and the grid must not depend on the values.
        vary: values by name, of which all combinations are run; or a list of dicts with one value
            by name, the members themselves. A value is a number or a vector.
        frames: number of frames.
        frame_dt: duration of a frame, s.
        measure: `(scene, start, trajectory) -> {name: array}`, traced for one member. What is one
            number becomes a column, the rest is in `Table.arrays`.
        save: what `trajectory.saved` holds of each frame, as for `simulate`; nothing by default.
        dt: the longest time step, s, in place of the stable one of each group. A member whose bound
            at rest is below it fails.
        fraction: part of the elastic limit, as for `stable_dt`.
        allow_unstable: accept a `dt` above the bound of a member.
        at_once: members in a group. By default as few as keep the threads of a CPU busy, and as
            many as `memory` allows elsewhere. A sweep that goes on keeps the groups it began with.
        memory: bytes that the groups of one device may take; a part of what it has by default.
        devices: where to run; those of this process by default.
        folder: new or empty; results are kept there as they come, and `sweep.csv` at the end.
        resume: go on with the unfinished sweep in the folder. What was finished is not run again.
        share: `(i, n)`: run every n-th group from the i-th (from 0) on, while other processes run
            the rest in the same folder. Who finds that all are there writes the table. By default
            that of this process of `jax.distributed`, if there are several.
        keep: takes the number and the arrays of each member as it is finished, which are then in
            no table.
        progress: True shows a bar; a function is called as `progress(done, members)`.

    Returns:
        One row per member. With `share`, members that others have not finished are "pending".

    Raises:
        ValueError: an argument is out of range, or the folder holds something else. A parameter
            out of its range is an error of its members, in their rows.
    """
    layout = laid_out(
        build,
        vary,
        frames=frames,
        frame_dt=frame_dt,
        measure=measure,
        save=save,
        dt=dt,
        fraction=fraction,
        allow_unstable=allow_unstable,
        at_once=at_once,
        memory=memory,
        devices=devices,
    )
    task = Task(build, measure, save, frames, frame_dt)
    report = _bar() if progress is True else progress or None
    return perform(layout, task, folder, resume=resume, share=share, keep=keep, progress=report)


def perform(
    layout: Layout,
    task: Task,
    folder: str | Path | None,
    *,
    resume: bool,
    share: tuple[int, int] | None,
    keep: Keep | None,
    progress: Callable[[int, int], None] | None,
) -> Table:
    """`sweep`, once it is laid out."""
    share = _share(share, folder)
    if not layout.able:
        table = tabulated(layout.members, layout.need, [])
        if folder is not None:
            require_empty(Path(folder), shared=share is not None)
            Path(folder).mkdir(parents=True, exist_ok=True)
            table.to_csv(Path(folder) / "sweep.csv")
        return table
    store = None
    if folder is not None:
        marks = fingerprint(layout, task)
        if share is not None:
            # All have to make the same groups, whatever memory or threads they have.
            marks["at_once"] = str(layout.lanes)
        store = open_store(
            Path(folder),
            marks,
            layout.lanes,
            resume=resume,
            shared=share is not None,
        )
        layout = dataclasses.replace(layout, lanes=store.lanes)
    program = Program(task, layout.devices, layout.lanes)
    return Run(layout, program, store, keep, progress).play(share)


def _share(share: tuple[int, int] | None, folder: str | Path | None) -> tuple[int, int] | None:
    """Which of the groups are those of this process: `(i, n)`; None for all."""
    if share is None and jax.process_count() > 1:
        share = jax.process_index(), jax.process_count()
    if share is None:
        return None
    index, count = share
    if not 0 <= index < count:
        raise ValueError(f"Argument `share` must be (i, n) with 0 ≤ i < n, but is {share}.")
    if folder is None:
        raise ValueError(
            "Argument `folder` must be given where several processes share a sweep, one that all "
            "of them see, but is None."
        )
    return share


def _bar() -> Callable[[int, int], None]:
    """A progress bar in a terminal or a notebook."""
    from tqdm.auto import tqdm  # Slow to import, needed here only.

    bar = tqdm(unit="member")

    def show(done: int, members: int) -> None:
        bar.total = members
        bar.update(done - bar.n)
        if done >= members:
            bar.close()

    return show
