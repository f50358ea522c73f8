"""`pgjax sweep`: a scene file, what is varied of it, and a folder of results."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array
from pgjax.cases.unknowns import Building
from pgjax.render import prepare_surroundings, save_image
from pgjax.scene import Scene
from pgjax.scenes import Plan, SceneError
from pgjax.scenes.run import carried
from pgjax.scenes.schema import TimePart
from pgjax.simulate import Kinematics, Trajectory, kinematics
from pgjax.state import State
from pgjax.storage import save_arrays
from pgjax.sweeps.keys import Varied, varied
from pgjax.sweeps.layout import Layout, laid_out
from pgjax.sweeps.mosaic import save_mosaic
from pgjax.sweeps.outcome import outcome
from pgjax.sweeps.program import Task
from pgjax.sweeps.sweep import nothing, perform
from pgjax.sweeps.table import Table


@final
class Checked(eqx.Module):
    """`build` of a scene with values put into it; those out of their range are refused."""

    building: Building

    def __call__(self, values: Mapping[str, Array]) -> tuple[Scene, State]:
        """Scene and initial state.

        Raises:
            ValueError: a value is known and out of its range.
        """
        scene, state = self.building(values)
        check(scene)
        return scene, state


def check(tree: Any) -> None:
    """Do again what the constructors of all records in a tree do: no value was looked at since."""
    if isinstance(tree, list | tuple):
        for item in tree:
            check(item)
    if not isinstance(tree, eqx.Module):
        return
    for field in dataclasses.fields(tree):
        check(getattr(tree, field.name, None))
    for kind in type(tree).__mro__:
        if "__check_init__" in vars(kind):
            vars(kind)["__check_init__"](tree)


@final
@dataclasses.dataclass(frozen=True)
class Study:
    """A sweep of a scene file.

    Attributes:
        plan: the scene.
        varied: what is varied of it.
        fraction: part of the elastic limit of the time step.
        dt: the scene's own time step, s, if it has one.
        trajectories: whether those of all members are written.
    """

    plan: Plan
    varied: tuple[Varied, ...]
    fraction: float
    dt: float | None = None
    trajectories: bool = False

    @property
    def build(self) -> Checked:
        """From the values by key to scene and initial state."""
        places = tuple((v.key, v.place) for v in self.varied)
        return Checked(Building(self.plan.scene, self.plan.state, places))

    @property
    def vary(self) -> dict[str, np.ndarray]:
        """The values by key."""
        return {v.key: v.values for v in self.varied}

    @property
    def task(self) -> Task:
        """What is done with each member."""
        measure = _with_frames if self.trajectories else _with_last_frame
        save = kinematics if self.trajectories else nothing
        return Task(self.build, measure, save, self.plan.frames, 1 / self.plan.fps)

    def layout(self, *, at_once: int | None, memory: float | None) -> Layout:
        """How it will run; the arguments are those of `sweep`."""
        task = self.task
        return laid_out(
            task.build,
            {v.key: v.values for v in self.varied},
            frames=task.frames,
            frame_dt=task.frame_dt,
            measure=task.measure,
            save=task.save,
            dt=self.dt,
            fraction=self.fraction,
            allow_unstable=self.plan.allow_unstable,
            at_once=at_once,
            memory=memory,
            devices=None,
        )

    def forecast(self, layout: Layout, folder: Path) -> str:
        """What will be run, what it needs and what it writes."""
        groups, need = layout.groups(), layout.need.substeps
        frames, particles = self.plan.frames, self.plan.scene.particle_count
        varied = [f"{v.key}: {_shortened(v.values)}" for v in self.varied]
        steps = sum(int(need[g].max()) * layout.lanes for g in groups) * frames
        bytes_at_once = layout.bytes_per_member * layout.lanes * len(layout.devices)
        files = ["sweep.csv", "sweep.png", "pictures/"]
        files += ["trajectories/"] if self.trajectories else []
        lines = [("scene", f"{self.plan.name}: {particles} particles, {frames} frames")]
        lines += [("varied", text) for text in varied]
        lines += [
            (
                "members",
                f"{len(layout.members)}, of which {len(need) - layout.able} cannot be simulated",
            )
        ]
        if groups:
            lines += [
                (
                    "steps",
                    f"{need[need > 0].min()} to {need.max()} a frame, {steps} in all: "
                    f"{steps * particles:.2g} particle-steps",
                ),
                (
                    "groups",
                    f"{len(groups)} of {layout.lanes}, one time step in each, on "
                    f"{len(layout.devices)} {layout.devices[0].platform.upper()} device(s)",
                ),
                ("memory", f"about {bytes_at_once / 1e6:.3g} MB at a time, forward"),
            ]
        lines += [("writes", f"{folder}: {', '.join(files)}")]
        return "\n".join(f"{name:10} {text}" for name, text in lines)

    def run(
        self,
        layout: Layout,
        folder: Path,
        progress: Callable[[int, int], None],
        *,
        resume: bool,
        share: tuple[int, int] | None,
    ) -> Table:
        """Run all members and write what came of them.

        Writes `sweep.csv`, `sweep.png` (the last frames of all members side by side), `pictures/`
        with each of them and, if asked, `trajectories/`.

        Args:
            layout: how it runs.
            folder: new or empty, unless it goes on.
            progress: called as `progress(done, members)`.
            resume: as for `sweep`.
            share: as for `sweep`.
        """
        keep = _Keeper(self, folder)
        table = perform(
            layout, self.task, folder, resume=resume, share=share, keep=keep, progress=progress
        )
        if not table.pending:
            save_mosaic(folder / "sweep.png", table, folder / "pictures")
        return table


def study(plan: Plan, time: TimePart, vary: Sequence[str], *, trajectories: bool) -> Study:
    """The sweep of a scene with the values of `--vary`.

    Raises:
        SceneError: one of them is unusable, or two are of the same key.
    """
    made = tuple(varied(text, plan) for text in vary)
    keys = [v.key for v in made]
    for key in keys:
        if keys.count(key) > 1:
            raise SceneError(
                f"Argument `--vary` must name each parameter once, but {key} is there twice."
            )
    return Study(plan, made, time.fraction, time.dt, trajectories)


def _shortened(values: np.ndarray) -> str:
    texts = [" ".join(f"{a:.4g}" for a in np.atleast_1d(value)) for value in values]
    shown = texts if len(texts) <= 8 else [*texts[:3], "…", *texts[-2:]]
    return f"{len(values)} value(s), {', '.join(shown)}"


def _with_last_frame(scene: Scene, start: State, trajectory: Trajectory) -> dict[str, Array]:
    end = trajectory.final
    return {**outcome(scene, start, trajectory), "last_x": end.x, "last_F": end.F}


def _with_frames(scene: Scene, start: State, trajectory: Trajectory) -> dict[str, Array]:
    saved: Kinematics = trajectory.saved
    own = {"t": trajectory.t, "x": saved.x, "v": saved.v, "F": saved.F}
    return {**_with_last_frame(scene, start, trajectory), **own}


@final
class _Keeper:
    """Draws the last frame of a member, and writes its trajectory."""

    def __init__(self, study: Study, folder: Path):
        self._study = study
        self._folder = folder
        plan = study.plan
        self._around = prepare_surroundings(plan.still, plan.camera(plan.frames))

    def __call__(self, member: int, arrays: dict[str, np.ndarray]) -> None:
        plan = self._study.plan
        moved, _ = carried(plan, jnp.asarray(arrays["last_x"]), jnp.asarray(arrays["last_F"]))
        image = self._around.render(moved, background=plan.view.background)
        save_image(self._place("pictures") / f"{member:05d}.png", image.rgb)
        if self._study.trajectories:
            frames = {name: arrays[name] for name in ("t", "x", "v", "F")}
            save_arrays(self._place("trajectories") / f"{member:05d}.npz", frames)

    def _place(self, name: str) -> Path:
        place = self._folder / name
        place.mkdir(exist_ok=True)
        return place
