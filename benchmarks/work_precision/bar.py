"""The free bar of V27: single precision at small strains, and derivatives that are known."""

import functools
import math
import time
from typing import Any

import bars
import equinox as eqx
import jax
import jax.numpy as jnp
import manufactured
import numpy as np
from scenes import itself, roll, wide

from benchmarks.work_precision.rollouts import temporary, timed, watched, with_modulus
from benchmarks.work_precision.waves import LOOKS
from pgjax.simulate import repeated
from pgjax.state import State
from pgjax.step import step

STRAIN = 1e-5
SCHEME = "quadratic-mls"


def with_plain_F(state: State) -> State:
    """Keep F instead of F − I: round `I + H` to the precision of the state."""
    eye = jnp.broadcast_to(jnp.eye(3, dtype=state.dtype), state.He.shape)
    F = jax.lax.optimization_barrier(state.He + eye)
    return eqx.tree_at(lambda s: s.He, state, F - eye)


STORED = {"F − I": itself, "F": with_plain_F}


def upwards(scene: Any, state: State) -> Any:
    """Position and velocity along the bar."""
    del scene
    return state.position[:, 1], state.v[:, 1]


def precision(n: int, stored: str, of: str) -> dict[str, Any]:
    """RMS error over two periods, over the largest RMS of the motion, and the costs.

    Args:
        n: cells along the bar; it is a quarter as wide.
        stored: a name of `STORED`.
        of: whose error, "displacement" or "velocity".
    """
    bar = bars.bar(n, SCHEME, across=max(1, n // 4), strain=STRAIN)
    dt = 0.5 * float(bar.scene.rest_limit())
    steps = int(8 / manufactured.SPEED / dt)
    every = max(1, steps // (2 * LOOKS))
    with watched() as costs:
        _, (y, v) = roll(bar.scene, bar.state, dt, steps, upwards, STORED[stored], every)
    rate = np.pi / 2 * manufactured.SPEED
    phase = rate * dt * every * np.arange(1, steps // every + 1)[:, None]
    found, size, shape = {
        "displacement": (wide(y) - bar.Y, bar.speed / rate, np.sin(phase)),
        "velocity": (wide(v), bar.speed, np.cos(phase)),
    }[of]
    off = np.sqrt(np.mean((found - size * shape * bar.mode) ** 2, axis=1)).max()
    return {"error": off / (size * np.sqrt(np.mean(bar.mode**2)))} | vars(costs)


def block(kept: str, steps: int) -> int | None:
    """Steps between two states that reverse mode keeps; None where it keeps all it computed."""
    root = math.ceil(math.sqrt(steps))
    return {"all": None, "every step": 1, "every 8th step": 8, "every √T-th step": root}[kept]


def gradient(n: int, kept: str) -> dict[str, Any]:
    """Error of the derivative of the motion with respect to Young's modulus, and the costs.

    `q(T) = cos(π c T/2)` is the part of the first mode in the velocity after 1¼ periods; c is
    proportional to √E, so `dq/d log E = −sin(φ) φ/2`, φ = 5π/2.

    Args:
        n: cells along the bar, which is four wide.
        kept: what reverse mode keeps, as `block` names it.
    """
    bar = bars.bar(n, SCHEME, across=4, strain=1e-4)
    steps = math.ceil(5 / manufactured.SPEED / (0.5 * float(bar.scene.rest_limit())))
    dt = jnp.asarray(5 / manufactured.SPEED / steps, bar.state.dtype)
    weights = jnp.asarray(bar.mode / (bar.speed * np.sum(bar.mode**2)), bar.state.dtype)

    def value(log_E: Any, scene: Any, state: State) -> Any:
        E = jnp.exp(log_E) * jnp.asarray(scene.materials[0].elasticity.E, state.dtype)
        scene = with_modulus(scene, E)
        end = rolled(functools.partial(step, scene, dt=dt), state, steps, block(kept, steps))
        return jnp.sum(weights * end.v[:, 1])

    arguments = jnp.zeros((), bar.state.dtype), bar.scene, bar.state
    started = time.perf_counter()
    program = eqx.filter_jit(jax.value_and_grad(value)).lower(*arguments).compile()
    compilation = time.perf_counter() - started
    forward = eqx.filter_jit(value).lower(*arguments).compile()
    phase = 5 * np.pi / 2
    seconds, (_, slope) = timed(program, *arguments)
    beside, _ = timed(forward, *arguments)
    return {
        "error": abs(float(slope) / (-np.sin(phase) * phase / 2) - 1),
        "seconds": seconds,
        "compile": compilation,
        "memory": temporary(program),
        "particles": len(bar.Y),
        "steps": steps,
        "remark": f"{seconds / beside:.1f} × forward",
    }


def rolled(advance: Any, state: State, steps: int, size: int | None) -> State:
    """So many steps in blocks; a step is computed again from its state unless `size` is None."""
    if size is None:
        return repeated(advance, state, steps, block=steps)
    return repeated(jax.checkpoint(lambda s: advance(s)), state, steps, block=size)
