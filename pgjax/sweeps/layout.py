"""How a sweep will run: what each member needs, and which of them run together."""

import dataclasses
from collections.abc import Sequence
from typing import Any, final

import jax
import numpy as np

from pgjax._types import positive, require, require_number
from pgjax.sweeps.members import Members, combined
from pgjax.sweeps.memory import lanes_within, per_member
from pgjax.sweeps.need import Build, Need, needs
from pgjax.sweeps.program import Measure, Save


@final
@dataclasses.dataclass(frozen=True)
class Layout:
    """Decided before anything is simulated.

    Attributes:
        members: all of them.
        need: steps per frame of each, or why it cannot be simulated.
        devices: where they run.
        lanes: members in a group.
        bytes_per_member: what one takes while it runs; 0 if none can be simulated.
    """

    members: Members
    need: Need
    devices: tuple[jax.Device, ...]
    lanes: int
    bytes_per_member: int

    @property
    def able(self) -> int:
        """How many members can be simulated."""
        return int(np.sum(self.need.substeps > 0))

    @property
    def first(self) -> int:
        """Number of the first one that can be."""
        return int(np.argmax(self.need.substeps > 0))

    def groups(self) -> list[np.ndarray]:
        """The members that can be simulated, those that need most steps first, in groups."""
        able = np.flatnonzero(self.need.substeps > 0)
        order = able[np.argsort(-self.need.substeps[able], kind="stable")]
        return [order[i : i + self.lanes] for i in range(0, len(order), self.lanes)]


def laid_out(
    build: Build,
    vary: Any,
    *,
    frames: int,
    frame_dt: float,
    measure: Measure,
    save: Save,
    dt: float | None,
    fraction: float,
    allow_unstable: bool,
    at_once: int | None,
    memory: float | None,
    devices: Sequence[jax.Device] | None,
) -> Layout:
    """The layout of a sweep; the arguments are those of `sweep`.

    Raises:
        ValueError: an argument is out of range, or `memory` is too small for one member.
    """
    _check(frames, frame_dt, dt, at_once, memory)
    members = combined(vary)
    need = needs(build, members, frame_dt, dt=dt, fraction=fraction, allow_unstable=allow_unstable)
    chosen = tuple(jax.local_devices() if devices is None else devices)
    layout = Layout(members, need, chosen, at_once or 1, 0)
    if not layout.able:
        return layout
    one, particles = per_member(build, members.some(layout.first), measure, save, frames)
    if at_once is None:
        at_once = lanes_within(memory, one, particles, chosen, layout.able)
    return dataclasses.replace(layout, lanes=at_once, bytes_per_member=one)


def _check(
    frames: int, frame_dt: float, dt: float | None, at_once: int | None, memory: float | None
) -> None:
    counts = {"frames": frames} | ({} if at_once is None else {"at_once": at_once})
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"Argument `{name}` must be a whole number ≥ 1, but is {value!r}.")
    lengths = {"frame_dt": (frame_dt, "s"), "dt": (dt, "s"), "memory": (memory, "bytes")}
    for name, (value, unit) in lengths.items():
        if value is not None:
            require_number(name, value)
            require(name, value, f"be positive and finite ({unit})", positive)
