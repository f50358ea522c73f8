"""A plan in words: what will be compiled, what it needs, what it will write."""

import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike

from pgjax import native
from pgjax._types import is_parameter
from pgjax.models import Material
from pgjax.scene import Scene
from pgjax.scenes.build import Plan
from pgjax.state import State
from pgjax.step import in_native_stages, leaves_nodes_out


def summary(plan: Plan) -> str:
    """What will be compiled, in a few lines."""
    return "\n".join(f"{name:10} {text}" for name, text in facts(plan))


def facts(plan: Plan) -> list[tuple[str, str]]:
    """The lines of the summary: what each is about, and what it says."""
    scene = plan.scene
    bound = float(scene.rest_limit())
    grid = scene.grid
    return [
        (
            "scene",
            f"{plan.name}: {scene.particle_count} particles"
            + (f", {len(plan.still)} Gaussians that do not move" if len(plan.still) else ""),
        ),
        *(
            ("material", f"{_describe(m)}, {count} particles")
            for m, count in zip(scene.materials, scene.counts, strict=True)
        ),
        (
            "grid",
            f"{' x '.join(map(str, grid.shape))} cells of {float(grid.h):.4g} m, "
            f"{_spline(plan)} spline, {type(scene.scheme).__name__}",
        ),
        (
            "time step",
            f"{plan.dt:.4g} s, {plan.dt / bound:.2f} of the stable one at rest; "
            f"{plan.substeps} steps a frame, {plan.frames} frames at {plan.fps:g} per second",
        ),
        (
            "computing",
            f"{state_kind(plan)} on {jax.devices()[0].platform.upper()}, {_kernels(plan)}, JAX "
            f"{jax.__version__}",
        ),
        *(("left out", part) for part in _left_out(plan)),
        *(("note", note) for note in plan.notes),
    ]


def _kernels(plan: Plan) -> str:
    """What runs the steps."""
    if not native.available():
        return "plain JAX"
    in_place = in_native_stages(plan.scene, plan.state)
    return "native kernels" if in_place else "native transfers, laws in JAX"


def _left_out(plan: Plan) -> list[str]:
    """What this scene does not need, and so does not pay for; a line each."""
    scene, parts = plan.scene, []
    flowing = sum(
        count
        for material, count in zip(scene.materials, scene.counts, strict=True)
        if material.plasticity is not None
    )
    if not flowing:
        parts.append("no material flows: no return mapping, no total deformation, no history")
    elif flowing < scene.particle_count:
        parts.append(f"return mappings of {scene.particle_count - flowing} particles without one")
    if len(plan.still):
        parts.append(f"the simulation of {len(plan.still)} Gaussians that do not move")
    if leaves_nodes_out(scene):
        parts.append("nodes without mass: most of the grid is empty")
    return parts


def forecast(plan: Plan, folder: Path, *, ply_frames: bool, trajectory_frames: bool) -> str:
    """What a run would compile, need and write; nothing is compiled or written for it."""
    scene = plan.scene
    files = [f"{folder}: video.mp4, first.png, last.png, run.json"]
    if ply_frames:
        size = (len(plan.moving) + len(plan.still)) * (14 + 3 * plan.moving.sh.shape[1]) * 4
        files.append(_series("ply", plan.frames, size))
    if trajectory_frames:
        d = scene.grid.dimension
        size = scene.particle_count * (2 * d + 9) * plan.state.dtype.itemsize
        files.append(_series("npz", plan.frames, size))
    memory = needed_memory(scene, plan.state)
    lines = [
        f"steps      {plan.frames * plan.substeps} in all; the largest stable one at rest is "
        f"{float(scene.rest_limit()):.4g} s",
        f"memory     about {_size(sum(memory))} to simulate, forward: "
        + ", ".join(f"{name} {_size(size)}" for name, size in memory._asdict().items()),
        *(f"compiles   {part}" for part in _compiled(plan)),
        *(f"writes     {part}" for part in files),
    ]
    return "\n".join(lines)


class Memory(NamedTuple):
    """Bytes that one frame of the simulation takes, forward, estimated from shapes."""

    scene: int
    state: int
    grid: int
    transfers: int


def needed_memory(scene: Scene, state: State) -> Memory:
    """What the simulation takes, without drawing and without derivatives.

    The state is there three times: before the frame, after it, and between two steps. A node
    has mass and momentum, which a sweep of conditions takes, and twice what it returns. Native
    transfers hold the payload of each particle; in plain JAX a particle has its window of nodes
    and three rows of weights for each node of a direction. Native stages work in place: a state
    before and one after, nodes of four numbers (in the plane a copy of them without the
    fourth), positions.
    """
    d, k, number = scene.grid.dimension, scene.spline.width, state.dtype.itemsize
    states, particle, node = 3, d + 1 + 2 * d * d + d, 2 + 3 * d if scene.boundaries else 2 * d
    if not native.available():
        particle = k**d * (d + 1) + 3 * k * d + (d + 1) * (1 + 2 * d)
    if in_native_stages(scene, state):
        states, particle, node = 2, d, 4 if d == 3 else 8
    return Memory(
        scene=_bytes(scene),
        state=states * _bytes(state),
        grid=math.prod(scene.grid.padded_shape) * node * number,
        transfers=scene.particle_count * particle * number,
    )


def _bytes(tree: Any) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)))


def _size(count: int) -> str:
    """Bytes for a person."""
    for unit, size in (("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count / 1e3:.3g} kB"


def _series(kind: str, frames: int, size: int) -> str:
    place = {"ply": "ply", "npz": "trajectory"}[kind]
    return (
        f"{place}/00000.{kind} to {place}/{frames:05d}.{kind}: {frames + 1} files of about "
        f"{_size(size)}, {_size((frames + 1) * size)} in all"
    )


def _compiled(plan: Plan) -> list[str]:
    """What is compiled and what is not, a sentence each."""
    scene = plan.scene
    d, k = scene.grid.dimension, scene.spline.width
    laws = dict.fromkeys(type(m.elasticity).__name__ for m in scene.materials)
    flows = dict.fromkeys(type(m.plasticity).__name__ for m in scene.materials if m.plasticity)
    fibres = ", fibres" if any(m.active for m in scene.materials) else ""
    remembered = any(history is not None for history in plan.state.history)
    periodic = [axis for axis, is_on in zip("xyz", scene.grid.periodic, strict=False) if is_on]
    return [
        f"stress: {', '.join(laws)}{fibres}",
        f"plasticity: {', '.join(flows)}, with{'' if remembered else 'out'} a history"
        if flows
        else "no plasticity: no return mapping, no total deformation, no history",
        f"transfers: {_spline(plan)} spline, {k**d} nodes for each particle, "
        f"{type(scene.scheme).__name__}",
        f"boundaries: {_names(scene.boundaries)}",
        f"particle conditions: {_names(scene.particle_conditions)}",
        f"periodic along {', '.join(periodic)}" if periodic else "no periodic direction",
    ]


def _names(conditions: tuple[Any, ...]) -> str:
    """Kinds of conditions with their number, and what each is made of: `Box (Separating)`."""
    counts: dict[str, int] = {}
    for condition in conditions:
        name = getattr(condition, "__name__", type(condition).__name__)
        parts = [type(a).__name__ for a in vars(condition).values() if isinstance(a, eqx.Module)]
        name += f" ({', '.join(parts)})" if parts else ""
        counts[name] = counts.get(name, 0) + 1
    return ", ".join(f"{n} x {name}" if n > 1 else name for name, n in counts.items()) or "none"


def _spline(plan: Plan) -> str:
    return {2: "quadratic", 3: "cubic"}[plan.scene.spline.degree]


def state_kind(plan: Plan) -> str:
    """The precision, in words."""
    return {"float32": "single precision", "float64": "double precision"}[plan.state.dtype.name]


def _describe(material: Material) -> str:
    law = type(material.elasticity).__name__
    if material.plasticity is not None:
        law += f" + {type(material.plasticity).__name__}"
    # The parameters of the law itself, or of the one that a wrapper such as Kelvin–Voigt holds.
    inner = material.elasticity.elastic()
    values = ", ".join(
        f"{field.name} {_range(getattr(inner, field.name))}"
        for field in dataclasses.fields(inner)
        if is_parameter(field) and getattr(inner, field.name) is not None
    )
    return f"{law} ({values}; {_range(material.density)} kg/m3)"


def _range(a: ArrayLike) -> str:
    a = np.asarray(a)
    return f"{a.min():.4g}" if a.min() == a.max() else f"{a.min():.4g} to {a.max():.4g}"
