"""Rollouts: many steps in one compiled program, with bounded memory in reverse mode."""

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import (
    Array,
    Float,
    Scalar,
    concrete,
    positive,
    require,
    require_kind,
)
from pgjax.ledger import Flows, Ledger, balance, followed
from pgjax.monitor import note_frame, note_start
from pgjax.result import NEVER, SimulationWarning, Status
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.step import followed_step, step

# What a rollout carries: the state, and what flowed where a ledger is kept.
Carry = tuple[State, Flows | None]


@final
class Kinematics(eqx.Module):
    """What a trajectory keeps of each frame by default: enough to deform Gaussians.

    Attributes:
        x: positions, m, `(p, d)`.
        v: velocities, m/s, `(p, d)`.
        F: total deformation gradients, `(p, 3, 3)`.
    """

    x: Float[Array, "*batch p d"]
    v: Float[Array, "*batch p d"]
    F: Float[Array, "*batch p 3 3"]


def kinematics(state: State) -> Kinematics:
    """The default of `simulate(save=...)`."""
    return Kinematics(state.x, state.v, state.F)


@final
class Trajectory(eqx.Module):
    """The result of a rollout.

    Attributes:
        saved: what `save` returned, stacked: entry 0 is the initial state, entry f the state
            after f frames.
        t: times of the entries, s, `(frames + 1,)`.
        final: the last state; pass it to `simulate` to go on.
        status: per condition, the first step and a count.
        ledger: the accounts of each entry, with `simulate(ledger=True)`.
    """

    saved: Any
    t: Float[Array, "*batch _"]
    final: State
    status: Status
    ledger: Ledger | None = None

    def plot(self) -> Any:
        """Draw energies, momenta, the size of the steps and the smallest volume over time.

        Returns:
            A `matplotlib.figure.Figure`, which a notebook shows and `savefig` writes.

        Raises:
            ValueError: there is no ledger.
        """
        if self.ledger is None:
            raise ValueError("A trajectory must have a ledger to be drawn: simulate(ledger=True).")
        return self.ledger.plot(self.t)


def simulate(
    scene: Scene,
    state: State,
    *,
    dt: float | Array,
    frames: int | float,
    substeps: int | float,
    save: Callable[[State], Any] = kinematics,
    progress: bool | Callable[[int, int], None] = False,
    throw: bool = True,
    allow_unstable: bool = False,
    keep_states: bool = False,
    ledger: bool = False,
) -> Trajectory:
    """Run `frames × substeps` steps and keep `save(state)` of every frame, the first included.

    The compiled program is two nested scans, checkpointed in blocks of about √(frames·substeps)
    steps: reverse mode keeps about 2√T states, forward mode none. `jit`, `vmap`, `grad`, `jvp`
    apply to it.

    Args:
        scene: what is constant.
        state: where to start (`initial_state`, or `trajectory.final`).
        dt: time step, s. It is never changed silently; see `stable_dt`.
        frames: number of frames to run.
        substeps: steps per frame: a frame lasts `substeps · dt`.
        save: any function of the state whose result is stacked over frames.
        progress: True shows a bar; a function is called as `progress(frame, frames)`.
        throw: raise `SimulationError` when a particle was masked. Inside `jit`, `grad` or `vmap`
            nothing can be raised: look at `trajectory.status`.
        allow_unstable: accept a time step above the stable one.
        keep_states: reverse mode keeps the state of every step (T of them, and those of one frame
            once more), and so runs forward once less.
        ledger: keep accounts of mass, momenta and energies, and of what walls, forces and plastic
            flow put in and take out: `trajectory.ledger`. The motion is the same; a step costs
            about 1.5 times as much.

    Raises:
        ValueError: an argument is out of range, or dt is above the stable bound at rest.
        SimulationError: a particle left the grid or became NaN (with `throw`).
    """
    frames, substeps = check_arguments(scene, state, dt, frames, substeps, allow_unstable)
    report = reporter(progress, frames)
    trajectory = _rollout(
        scene,
        state,
        jnp.asarray(dt, state.dtype),
        frames,
        substeps,
        save,
        report,
        keep_states,
        ledger,
    )
    if throw:
        trajectory.status.check()
    return trajectory


def check_arguments(
    scene: Scene,
    state: State,
    dt: float | Array,
    frames: int | float,
    substeps: int | float,
    allow_unstable: bool,
) -> tuple[int, int]:
    """Refuse what `simulate` cannot run; the numbers of frames and substeps."""
    for name, value in (("frames", frames), ("substeps", substeps)):
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
            raise ValueError(f"Argument `{name}` must be a whole number ≥ 1, but is {value!r}.")
    require_kind("scene", scene, Scene)
    require_kind("state", state, State)
    _check_count(state, int(frames) * int(substeps))
    _check_particles(scene, state)
    _check_dt(scene, dt, allow_unstable)
    return int(frames), int(substeps)


def _check_count(state: State, steps: int) -> None:
    """The counter of steps has 31 bits."""
    before = concrete(state.step)
    done = 0 if before is None else int(before.max())
    if done + steps >= NEVER:
        raise ValueError(
            f"Arguments `frames` and `substeps` must make fewer than 2^31 steps together with the "
            f"{done} before, but make {steps}."
        )


def _check_particles(scene: Scene, state: State) -> None:
    expected = (scene.particle_count, scene.grid.dimension)
    if state.v.shape != expected:
        raise ValueError(
            f"Argument `state` must hold the particles of the scene (velocities of shape "
            f"{expected}), but holds {state.v.shape}."
        )


def _check_dt(scene: Scene, dt: float | Array, allow_unstable: bool) -> None:
    """The time step against the sharp bound at rest, before anything is compiled."""
    require("dt", dt, "be positive and finite (s), one number", positive)
    value = concrete(dt)
    if value is None:
        return
    if value.ndim:
        raise ValueError(f"Argument `dt` must be positive and finite (s), one number, but is {dt}.")
    limit = concrete(scene.rest_limit())
    if limit is None or limit.ndim:
        return
    ratio, suggestion = float(value) / float(limit), 0.5 * float(limit)
    if ratio > 1 + 1e-6 and not allow_unstable:
        raise ValueError(
            f"Argument `dt` must be below the stable time step {float(limit):.4g} s, but is "
            f"{float(value):.4g} s ({ratio:.2f} of it): use {suggestion:.3g} s, or pass "
            f"`allow_unstable=True`."
        )
    if ratio > 0.8:
        warnings.warn(
            f"The time step {float(value):.4g} s is {ratio:.2f} of the stable one at rest; moving "
            f"particles may become unstable. Recommended: {suggestion:.3g} s.",
            SimulationWarning,
            stacklevel=4,
        )


@eqx.filter_jit
def _rollout(
    scene: Scene,
    state: State,
    dt: Scalar,
    frames: int,
    substeps: int,
    save: Callable[[State], Any],
    report: Callable[[int, int], None] | None,
    keep_states: bool,
    ledger: bool,
) -> Trajectory:
    """The nested scans of one device."""
    plan = Blocks.of(frames, substeps, keep_states)

    def advance(carry: Carry) -> Carry:
        state, flows = carry
        if flows is None:
            return step(scene, state, dt), None
        stages = followed_step(scene, state, dt)
        return stages.after, followed(scene, state, stages, flows, dt)

    def kept(carry: Carry) -> tuple[Any, Ledger | None]:
        state, flows = carry
        return save(state), None if flows is None else balance(scene, state, flows, dt)

    def frame(carry: Carry) -> Carry:
        advanced = jax.checkpoint(lambda c: advance(c))
        state, flows = repeated(advanced, carry, substeps, block=plan.steps)
        return note_frame(scene, state, dt), flows

    start: Carry = note_start(scene, state, dt), Flows.none(state) if ledger else None
    end, (saved, accounts) = over_frames(frame, kept, start, frames, plan, report)
    t = times(state, dt, frames, substeps)
    return Trajectory(saved, t, end[0], end[0].status, accounts)


class Blocks(NamedTuple):
    """How a rollout is checkpointed, about √T steps at a time.

    Attributes:
        steps: in a block of steps inside a frame.
        frames: in a group; None where the blocks of steps bound the memory already.
    """

    steps: int
    frames: int | None

    @staticmethod
    def of(frames: int, substeps: int, keep_states: bool) -> "Blocks":
        """Frames are grouped, or divided, so that a block has about √T steps."""
        root = math.sqrt(frames * substeps)
        if keep_states:
            return Blocks(substeps, frames)
        steps = math.ceil(root)
        return Blocks(steps, None if substeps > steps else max(1, round(root / substeps)))


def over_frames(
    frame: Callable[[Any], Any],
    kept: Callable[[Any], Any],
    start: Any,
    frames: int,
    blocks: Blocks,
    report: Callable[[int, int], None] | None,
) -> tuple[Any, Any]:
    """Apply `frame` to what is carried; what is `kept` of the start and of every frame, stacked."""

    def one(carry: Any, index: Array) -> tuple[Any, Any]:
        carry = frame(carry)
        if report is not None:
            jax.debug.callback(functools.partial(_call, report), index, frames)
        # A function of its own: `save` may be a module that holds traced arrays.
        return carry, jax.checkpoint(lambda c: kept(c))(carry)

    first = kept(start)
    if blocks.frames is None:
        end, rest = jax.lax.scan(one, start, jnp.arange(frames, dtype=jnp.int32))
    else:
        end, rest = checkpointed_scan(one, start, frames, group=blocks.frames)
    return end, jax.tree.map(lambda a, b: jnp.concatenate([jnp.asarray(a)[None], b]), first, rest)


def times(state: State, dt: Scalar, frames: int, substeps: int) -> Float[Array, " _"]:
    """Times of the entries of a trajectory, s."""
    return (state.step + substeps * jnp.arange(frames + 1, dtype=jnp.int32)).astype(dt.dtype) * dt


def repeated(advance: Callable[[Any], Any], state: Any, count: int, *, block: int) -> Any:
    """Apply `advance` count times; reverse mode keeps the states between blocks only."""
    final, _ = checkpointed_scan(lambda s, _: (advance(s), None), state, count, group=block)
    return final


def checkpointed_scan(
    body: Callable[[Any, Array], tuple[Any, Any]], state: Any, count: int, *, group: int
) -> tuple[Any, Any]:
    """`lax.scan(body, state, arange(count))`, rematerialised in groups of about `group`."""
    group = min(group, count)
    if group == 1 or group == count:
        wrapped = jax.checkpoint(body) if group == 1 else body
        return jax.lax.scan(wrapped, state, jnp.arange(count, dtype=jnp.int32))
    group = _even_group(count, group)
    groups = -(-count // group)

    def one(state: Any, index: Array) -> tuple[Any, Any]:
        if groups * group == count:
            return body(state, index)
        # The last group is filled up with steps that are skipped.
        shape = jax.eval_shape(body, state, index)[1]
        nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape)
        return jax.lax.cond(index < count, body, lambda s, _: (s, nothing), state, index)

    @jax.checkpoint
    def many(state: Any, indices: Array) -> tuple[Any, Any]:
        return jax.lax.scan(one, state, indices)

    indices = jnp.arange(groups * group, dtype=jnp.int32).reshape(groups, group)
    final, out = jax.lax.scan(many, state, indices)
    return final, jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:count], out)


def _even_group(count: int, group: int) -> int:
    """A divisor of count within a factor of two of `group`, if there is one; else `group`."""
    near = [g for g in range(max(2, group // 2), 2 * group + 1) if count % g == 0]
    return min(near, key=lambda g: abs(math.log(g / group)), default=group)


def _call(report: Callable[[int, int], None], index: Any, frames: Any) -> None:
    report(int(index) + 1, int(frames))


def reporter(
    progress: bool | Callable[[int, int], None], frames: int
) -> Callable[[int, int], None] | None:
    """What is called after each frame."""
    return _meter(frames) if progress is True else progress or None


def _meter(frames: int) -> Callable[[int, int], None]:
    """A progress bar in a terminal or a notebook."""
    from tqdm.auto import tqdm  # Slow to import, needed here only.

    bar = tqdm(total=frames, unit="frame")

    def show(frame: int, frames: int) -> None:
        bar.update(frame - bar.n)
        if frame >= frames:
            bar.close()

    return show
