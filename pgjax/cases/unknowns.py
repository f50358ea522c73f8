"""The unknowns of a case: which number of the scene file each of them stands for."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array
from pgjax.inverse import Parameter
from pgjax.models.material import parameter_paths
from pgjax.scene import Scene
from pgjax.scenes import Plan, SceneError
from pgjax.scenes.reader import Table, nearest
from pgjax.state import State

# Keys of a material whose field has another name.
_OTHER_NAMES = {"damping_viscosity": "viscosity"}


@dataclasses.dataclass(frozen=True)
class Unknown:
    """One unknown of a case file.

    Attributes:
        key: of the scene file, `material.E`, `material.2.plasticity.yield_stress`,
            `model.velocity`, `boundary.1.friction`, `forces.gravity`; counted from 1.
        parameter: first guess, bounds, prior.
        label: of its table, for messages.
    """

    key: str
    parameter: Parameter
    label: str


@dataclasses.dataclass(frozen=True)
class Key:
    """A key of which only its place is looked for.

    Attributes:
        key: of the scene file, as that of an `Unknown`.
        label: what messages begin with.
    """

    key: str
    label: str


Named = Unknown | Key


def unknown(t: Table) -> Unknown:
    """An unknown from its table."""
    key = t.text("key")
    start = _numbers(t, "start")
    prior = t.optional("prior", lambda p: (_numbers(p, "mean"), _numbers(p, "deviation")))
    made = Parameter(
        start,
        lower=_numbers(t, "lower", None),
        upper=_numbers(t, "upper", None),
        log=t.boolean("log", False),
        prior=prior,
        unit=t.text("unit", ""),
    )
    return Unknown(key, made, t.name)


def _numbers(t: Table, key: str, *default: Any) -> Any:
    """One number, or a list of three."""
    return t.vector(key, *default) if t.is_a(key, list) else t.number(key, *default)


@final
class Place(eqx.Module):
    """Where a value goes: `(scene, state, value) -> (scene, state)`, and what stands there now.

    Attributes:
        now: the value of the scene file.
        put: replaces it.
    """

    now: Array
    put: Callable[[Scene, State, Array], tuple[Scene, State]] = eqx.field(static=True)


def place(unknown: Unknown, plan: Plan) -> Place:
    """Find what an unknown stands for in a plan.

    Raises:
        SceneError: the key names nothing that can be found, or has another shape.
    """
    found = find(unknown, plan)
    if found.now.shape != unknown.parameter.shape:
        raise SceneError(
            f"{unknown.label}: `start` must have the shape {found.now.shape} of `{unknown.key}` in "
            f"the scene, but has {unknown.parameter.shape}."
        )
    return found


def find(unknown: Named, plan: Plan) -> Place:
    """The place that a key names, whatever its shape.

    Raises:
        SceneError: the key names nothing that can be found.
    """
    group, *rest = unknown.key.split(".")
    finders = {"material": _of_material, "boundary": _of_boundary, "model": _of_model}
    if group == "forces" and rest:
        return _of_scene(".".join(rest), unknown, plan)
    if group in finders and rest:
        number = counted(rest[0])
        names = rest if number is None else rest[1:]
        if not names:
            raise _wrong(unknown, "name a key of the table, as in `material.E`")
        return finders[group](number, names, unknown, plan)
    groups = (*finders, "forces")
    raise _wrong(unknown, f"begin with {', '.join(groups)} and a dot{nearest(group, groups)}")


def counted(name: str) -> int | None:
    """The index, from 0, that a part of a key counts from 1; None if it is a name."""
    return int(name) - 1 if re.fullmatch(r"[0-9]{1,9}", name) else None


def _wrong(unknown: Named, rule: str) -> SceneError:
    return SceneError(f"{unknown.label}: `key` must {rule}, but is {unknown.key!r}.")


def _chosen(items: Any, number: int | None, kind: str, unknown: Named) -> int:
    """Which of several tables is meant."""
    if number is None and len(items) > 1:
        raise _wrong(unknown, f"say which of {len(items)} tables is meant, as in `{kind}.1.…`")
    number = number or 0
    if not 0 <= number < len(items):
        raise _wrong(unknown, f"count the [[{kind}]] tables from 1 to {len(items)}")
    return number


def _of_material(number: int | None, names: list[str], unknown: Named, plan: Plan) -> Place:
    index = _chosen(plan.scene.materials, number, "material", unknown)
    material = plan.scene.materials[index]
    inner = {"plasticity": "plasticity", "active": "active"}.get(names[0])
    if inner is not None:
        parts: tuple[str, ...] = (inner,)
    else:
        # What flows by itself (snow) has its keys in the table of the material.
        own = material.elasticity.elastic().companion() is not None
        parts = ("elasticity", "density", "plasticity") if own else ("elasticity", "density")
    if len(names) != (1 if inner is None else 2):
        raise _wrong(unknown, "be `material.KEY`, `material.plasticity.KEY`, `material.active.KEY`")
    paths = [path for path, _ in parameter_paths(material) if path[0] in parts]
    paths = [path for path in paths if _at(material, path) is not None]
    field = _OTHER_NAMES.get(names[-1], names[-1])
    fitting = [path for path in paths if path[-1] == field]
    if not fitting:
        known = sorted({path[-1] for path in paths})
        raise _wrong(unknown, f"end with one of {', '.join(known)}{nearest(names[-1], known)}")
    # That of the outermost law: damping is wrapped around what is damped.
    path = min(fitting, key=len)
    value = _at(material, path)

    def put(scene: Scene, state: State, new: Array) -> tuple[Scene, State]:
        return eqx.tree_at(lambda s: _at(s.materials[index], path), scene, new), state

    return Place(jnp.asarray(value), put)


def _at(tree: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        tree = getattr(tree, name)
    return tree


def _of_boundary(number: int | None, names: list[str], unknown: Named, plan: Plan) -> Place:
    index = _chosen(plan.scene.boundaries, number, "boundary", unknown)
    wall = plan.scene.boundaries[index]
    friction = getattr(getattr(wall, "contact", None), "friction", None)
    if names != ["friction"] or friction is None:
        raise _wrong(unknown, 'be `boundary.N.friction` of a wall with contact = "separating"')

    def put(scene: Scene, state: State, new: Array) -> tuple[Scene, State]:
        path = ("contact", "friction")
        return eqx.tree_at(lambda s: _at(s.boundaries[index], path), scene, new), state

    return Place(friction, put)


def _of_scene(name: str, unknown: Named, plan: Plan) -> Place:
    known = ("gravity", "grid_damping", "shear_damping")
    if name not in known:
        raise _wrong(unknown, f"end with one of {', '.join(known)}{nearest(name, known)}")

    def put(scene: Scene, state: State, new: Array) -> tuple[Scene, State]:
        return eqx.tree_at(lambda s: getattr(s, name), scene, new), state

    return Place(getattr(plan.scene, name), put)


def _of_model(number: int | None, names: list[str], unknown: Named, plan: Plan) -> Place:
    index = _chosen(plan.models, number, "model", unknown)
    model, mine = plan.models[index], plan.body == index
    x = np.asarray(plan.state.x, np.float64)
    center = np.average(x[mine], axis=0, weights=np.asarray(plan.scene.volumes)[mine])
    if names == ["velocity"]:
        now = np.asarray(model.velocity)

        def push(scene: Scene, state: State, new: Array) -> tuple[Scene, State]:
            change = jnp.where(mine[:, None], (new - now.astype(new.dtype))[None], 0)
            return scene, eqx.tree_at(lambda s: s.v, state, state.v + change)

        return Place(jnp.asarray(now), push)
    if names != ["angular_velocity"]:
        raise _wrong(unknown, "end with velocity or angular_velocity")
    now = np.asarray(model.angular_velocity)
    off = np.where(mine[:, None], x - center, 0)

    def turn(scene: Scene, state: State, new: Array) -> tuple[Scene, State]:
        # Of degrees per second, as in the scene file.
        spin = jnp.deg2rad(new) - now.astype(new.dtype)
        dv = jnp.cross(spin[None], jnp.asarray(off, new.dtype))
        dC = jnp.cross(jnp.eye(3, dtype=new.dtype), spin[None])
        dC = jnp.where(mine[:, None, None], dC[None], 0)
        return scene, eqx.tree_at(lambda s: (s.v, s.C), state, (state.v + dv, state.C + dC))

    return Place(jnp.rad2deg(jnp.asarray(now)), turn)


@final
class Building(eqx.Module):
    """`build` of a `Problem`: the scene and state of a plan with the values of the unknowns."""

    scene: Scene
    state: State
    places: tuple[tuple[str, Place], ...]

    def __call__(self, values: Mapping[str, Array]) -> tuple[Scene, State]:
        """Scene and initial state."""
        scene, state = self.scene, self.state
        for name, at in self.places:
            scene, state = at.put(scene, state, values[name])
        return scene, state
