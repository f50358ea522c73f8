"""One time step of the Material Point Method, written as the algorithm reads."""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax import native
from pgjax._safe import safe_divide
from pgjax._types import Array, Bool, Float, Int, Scalar
from pgjax.boundary import AbstractGridCondition, Box, Particles, Region, change_if, sweep
from pgjax.exchange import EVENTS, Receiver, Sender, embed, is_finite, receive, send, where
from pgjax.fused import known, receive_natively, send_natively, velocities
from pgjax.grid import PAD, Grid
from pgjax.models.law import AbstractElasticity, Response
from pgjax.models.material import Material, cast, particle_axes
from pgjax.result import Condition
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.transfer import MLS, Payload, SplineGradient, Stencil, scatter, stencil

Vectors = Float[Array, "d n"]

# From so many nodes for each particle on, those without mass cost more than to leave them out.
_EMPTY = 4


def step(scene: Scene, state: State, dt: Float[Array, ""] | float) -> State:
    """Advance every particle by one explicit APIC step (PhysGaussian supplement, eqs. 1–3).

    A particle that is not finite or whose stencil leaves the grid is masked from this step on:
    it keeps its place, exerts nothing, and `status` counts it.

    Args:
        scene: what is constant.
        state: what changes.
        dt: time step, s.

    Returns:
        The state one step later. Differentiable in every array of `scene` and `state`.
    """
    return followed_step(scene, state, dt, whole=not leaves_nodes_out(scene)).after


class Stages(NamedTuple):
    """What a step passes through.

    Attributes:
        imposed: the state under forces and prescribed motion of particles.
        nodes: momentum and mass of the nodes, internal forces already in the momentum.
        walled: their velocity under gravity, damping and walls, and their mass.
        moved: the same once those that are led have the velocity of what leads them.
        after: the state one step later.
    """

    imposed: State
    nodes: Float[Array, "*grid c"]
    walled: Float[Array, "*grid c"]
    moved: Float[Array, "*grid c"]
    after: State


def followed_step(
    scene: Scene, state: State, dt: Float[Array, ""] | float, *, whole: bool = True
) -> Stages:
    """`step` with what lies between, for whoever keeps accounts.

    Unless the whole grid is wanted, nodes outside the box of all stencils may hold anything.
    """
    scene = cast(scene, state.dtype)
    dt = jnp.asarray(dt, state.dtype)
    t = state.step.astype(state.dtype) * dt

    held, imposed = impose(scene, state, t, dt)
    at, inside = stencil(scene.grid, scene.spline, imposed.position)
    sent, finite, nodes = particles_to_grid(scene, imposed, at, inside, t, dt, whole=whole)
    box = None if whole else box_of(scene.grid, at)
    walled = forces_and_boundaries(scene, region_of(scene.grid, at), nodes, t, dt, box=box)
    moved = led(walled, led_nodes(scene, sent, at, held), held)
    after = grid_to_particles(scene, sent, at, finite, held, moved, dt)
    return Stages(imposed, nodes, walled, moved, after)


def leaves_nodes_out(scene: Scene) -> bool:
    """Whether the passes keep to the nodes that have mass: in a grid that is mostly empty."""
    box, *others = scene.boundaries or (None,)
    walls = box is None or (isinstance(box, Box) and known(box.contact))
    apart = not any(scene.grid.periodic) and walls and not others and native.available()
    return apart and math.prod(scene.grid.padded_shape) > _EMPTY * scene.particle_count


def impose(scene: Scene, state: State, t: Scalar, dt: Scalar) -> tuple[Bool[Array, " p"], State]:
    """Body forces, prescribed velocities and pushes; which particles are held in this step.

    They act before anything is checked, so that a NaN from a user's function is found.
    """
    v = state.v
    if scene.body_force is not None:
        acceleration = jax.vmap(scene.body_force, in_axes=(0, None))(scene.X0, t)
        v = v + dt * acceleration.astype(state.dtype)
    mass = jnp.where(state.alive, scene.masses, 0)
    x = where(state.alive & is_finite(state.position), state.x, 0)
    particles = Particles(x, v, state.C, mass, jnp.zeros_like(state.alive))
    for condition in scene.particle_conditions:
        before, particles = particles, condition(particles, t, dt)
        # What is led already stays so, whatever comes later in the list.
        particles = particles._replace(
            v=where(before.held, before.v, particles.v),
            C=where(before.held, before.C, particles.C),
            held=before.held | particles.held,
        )
    v, C = particles.v, particles.C
    return particles.held, eqx.tree_at(lambda s: (s.v, s.C), state, (v, C))


def particles_to_grid(
    scene: Scene,
    state: State,
    at: Stencil,
    inside: Bool[Array, " p"],
    t: Scalar,
    dt: Scalar,
    *,
    whole: bool = True,
) -> tuple[State, Bool[Array, " p"], Float[Array, "*grid c"]]:
    """Momentum and mass of the nodes, the internal forces already in the momentum.

    Returns:
        The state, in which particles that cannot go on are masked; which are finite; the nodes.
    """
    particles = Sender(
        alive=state.alive,
        inside=inside,
        xi=at.xi,
        position=state.position,
        mass=scene.masses,
        volume=scene.volumes,
        v=state.v,
        C=state.C,
        He=state.He,
        H=state.He[:, :0] if state.H is None else state.H,
    )
    numbers = jnp.stack([dt, scene.grid.h, scene.D])
    shape = {"degree": scene.spline.degree, "nodes": scene.grid.padded_shape}
    known_law = _native_law(scene)
    if known_law is not None:
        name, law = known_law
        moduli = law.mu, law.lam
        sent = send_natively(particles, name, moduli, scene.scheme, numbers, **shape, whole=whole)
    else:
        respond = functools.partial(_respond, scene, state.history, t)
        sent = send(particles, respond, scene.scheme, numbers, **shape)
    events: dict[Condition, Array] = dict(zip(EVENTS, sent.events, strict=True))
    status = state.status.note(events, state.step)
    state = eqx.tree_at(lambda s: (s.alive, s.status), state, (sent.alive, status))
    return state, sent.finite, scene.grid.fold(sent.nodes)


def _native_law(scene: Scene) -> tuple[str, AbstractElasticity] | None:
    """The law a native kernel of the whole stage knows, where the scene has no other."""
    material, *others = scene.materials
    law = material.elasticity
    name = law.kernel()
    if others or material.active is not None or name is None:
        return None
    if not isinstance(scene.scheme, MLS | SplineGradient):
        return None
    assert isinstance(law, AbstractElasticity)
    return name, law


def _respond(
    scene: Scene,
    histories: tuple[Any, ...],
    t: Scalar,
    He: Float[Array, "p 3 3"],
    H: Float[Array, "p 3 3"],
    C: Float[Array, "p d d"],
) -> Response:
    """Each material's response on its own slice."""
    parts = []
    for material, part, history in zip(scene.materials, scene.slices, histories, strict=True):

        def law(material, He, H, L, history):
            return material.response(He, H, L, history, t)

        axes = (particle_axes(material, part.stop - part.start), 0, 0, 0, 0)
        one = jax.vmap(law, in_axes=axes)
        parts.append(one(material, He[part], H[part], embed(C[part]), history))
    return Response(*(jnp.concatenate(values) for values in zip(*parts, strict=True)))


def forces_and_boundaries(
    scene: Scene,
    region: Region,
    momentum_and_mass: Float[Array, "*grid c"],
    t: Scalar,
    dt: Scalar,
    *,
    box: Int[Array, " _"] | None = None,
) -> Float[Array, "*grid c"]:
    """Velocity of the nodes, and their mass: gravity, damping, then each condition in order.

    Damping is `exp(−γ Δt)`. Empty nodes stay at rest. No node outside the region has mass.
    """
    kept, gained = jnp.exp(-scene.grid_damping * dt), dt * scene.gravity
    if not scene.boundaries:
        return velocities(momentum_and_mass, kept, gained, box=box)
    walls, *others = scene.boundaries
    if isinstance(walls, Box) and not others and known(walls.contact) and native.available():
        axes = [a + start for a, start in zip(scene.grid.axes(), scene.grid.origin, strict=True)]
        touched = walls.contact, walls.sides(axes)
        return velocities(momentum_and_mass, kept, gained, touched, box=box)

    def constrained(x: Vectors, momentum_and_mass: Float[Array, "c n"], region: Region) -> Array:
        """Of n nodes, components first."""
        momentum, mass = momentum_and_mass[:-1], momentum_and_mass[-1:]
        v = safe_divide(momentum, jnp.broadcast_to(mass, momentum.shape))
        v = kept * (v + gained[:, None])
        for condition in scene.boundaries:
            if isinstance(condition, AbstractGridCondition):
                v = condition.on_nodes(x, v, t, region)
            else:
                v = jax.vmap(condition, in_axes=(1, 1, None), out_axes=1)(x, v, t)
        return jnp.concatenate([jnp.where(mass > 0, v, 0), mass])

    return sweep(scene.grid, constrained, momentum_and_mass, region)


def led_nodes(
    scene: Scene, state: State, at: Stencil, held: Bool[Array, " p"]
) -> Float[Array, "*grid c"] | None:
    """Momentum and mass of the nodes, of led particles alone; None where no condition leads any."""
    if not any(getattr(condition, "leads", True) for condition in scene.particle_conditions):
        return None
    mass = jnp.where(held & state.alive, scene.masses, 0)[:, None]
    v, C = (where(state.alive, a, 0) for a in (state.v, state.C))
    values = jnp.concatenate([mass * v, mass], axis=1)
    return scatter(scene.grid, at, Payload(values, mass[:, :, None] * C, None))


def led(
    moved: Float[Array, "*grid c"], leading: Float[Array, "*grid c"] | None, held: Bool[Array, " p"]
) -> Float[Array, "*grid c"]:
    """The nodes most of whose mass is led have the velocity of what leads them.

    Led particles that only kept their own velocity would be a dashpot: what hangs from them would
    creep, at a speed in proportion to Δt, until it tears off.
    """
    if leading is None:
        return moved

    def take_over(moved: Float[Array, "*grid c"]) -> Float[Array, "*grid c"]:
        momentum, mass = leading[..., :-1], leading[..., -1:]
        v = safe_divide(momentum, jnp.broadcast_to(mass, momentum.shape))
        own, total = moved[..., :-1], moved[..., -1:]
        return jnp.concatenate([jnp.where(2 * mass > total, v, own), total], axis=-1)

    return change_if(jnp.any(held), take_over, moved)


def box_of(grid: Grid, at: Stencil) -> Int[Array, " _"]:
    """First node of all stencils along each direction, and the end: numbers in the padded grid."""
    first, last = at.span()
    box = jnp.concatenate([first, last + 1]).astype(jnp.int32) + PAD
    return jnp.clip(box, 0, np.tile(np.asarray(grid.padded_shape, np.int32), 2))


def region_of(grid: Grid, at: Stencil) -> Region:
    """The box of all nodes that can have mass, half a cell wider on each side."""
    first, last = at.span()
    wide = np.asarray(grid.periodic)
    low = jnp.where(wide, -jnp.inf, (first - 0.5) * grid.h + grid.origin)
    high = jnp.where(wide, jnp.inf, (last + 0.5) * grid.h + grid.origin)
    return Region(low, high)


def grid_to_particles(
    scene: Scene,
    state: State,
    at: Stencil,
    finite: Bool[Array, " p"],
    held: Bool[Array, " p"],
    grid_v: Float[Array, "*grid c"],
    dt: Scalar,
) -> State:
    """Move and deform the particles, then return to the yield surface."""
    particles = Receiver(
        alive=state.alive,
        finite=finite,
        held=held,
        xi=at.xi,
        nodes=scene.grid.unfold(grid_v),
        position=state.position,
        v=state.v,
        C=state.C,
        He=state.He,
        H=state.He[:, :0] if state.H is None else state.H,
    )
    # r = ∞ and r = 0 are both exact.
    kept = jnp.exp(-scene.shear_damping * dt)
    moment = jnp.asarray(scene.spline.moment, state.dtype)
    numbers, degree = jnp.stack([dt, scene.grid.h, moment, kept]), scene.spline.degree
    known_map = _native_mapping(scene, state)
    if known_map is not None:
        out = receive_natively(particles, *known_map, scene.scheme, numbers, degree=degree)
        material, history = scene.materials[0], state.history[0]
        if material.plasticity is not None:
            history = material.plasticity.remember(history, out.history)
        # There are other materials only where none of them flows.
        histories = (history, *state.history[1:])
    else:
        mapping = functools.partial(_return_map, scene, state.history, dt)
        plastic = scene.is_plastic
        out = receive(particles, mapping if plastic else None, scene.scheme, numbers, degree=degree)
        histories = out.history if plastic else state.history

    def kept_where_dead(part: slice, new: Any, old: Any) -> Any:
        return jax.tree.map(functools.partial(jnp.where, state.alive[part]), new, old)

    return State(
        position=out.position,
        v=out.v,
        C=out.C,
        He=out.He,
        H=None if state.H is None else out.H,
        history=tuple(map(kept_where_dead, scene.slices, histories, state.history)),
        alive=state.alive,
        step=state.step + 1,
        status=state.status,
        origin=state.origin,
    )


def _native_mapping(scene: Scene, state: State) -> tuple[str, tuple[Array, ...]] | None:
    """The mapping a native kernel of the whole stage knows, and its parameters."""
    if not isinstance(scene.scheme, MLS | SplineGradient):
        return None
    if not scene.is_plastic:
        return "elastic", ()
    (material, *others), history = scene.materials, state.history[0]
    if others:
        return None
    assert material.plasticity is not None
    name = material.plasticity.kernel()
    if name is None:
        return None

    def parameters(material: Material, history: Array | None) -> tuple[Array, ...]:
        assert material.plasticity is not None
        assert isinstance(material.elasticity, AbstractElasticity)
        return material.plasticity.parameters(history, material.elasticity)

    axes = particle_axes(material, state.v.shape[0]), None if history is None else 0
    if jax.tree.leaves(axes):
        parameters = jax.vmap(parameters, in_axes=axes)
    return name, parameters(material, history)


def in_native_stages(scene: Scene, state: State) -> bool:
    """Whether the passes over particles and grid are native and work in place."""
    box, *others = scene.boundaries or (None,)
    walls = box is None or (isinstance(box, Box) and known(box.contact))
    known_passes = _native_law(scene) is not None and _native_mapping(scene, state) is not None
    return native.available() and known_passes and walls and not others


def _return_map(
    scene: Scene, histories: tuple[Any, ...], dt: Scalar, H: Float[Array, "p 3 3"]
) -> tuple[Float[Array, "p 3 3"], tuple[Any, ...]]:
    """Each material maps its own slice; a slice without plasticity passes unchanged."""
    parts, new = [], []
    for material, part, history in zip(scene.materials, scene.slices, histories, strict=True):
        if material.plasticity is None:
            parts.append(H[part])
            new.append(history)
            continue

        def mapping(material, H, history):
            return material.plasticity.return_map(H, history, material.elasticity, dt)

        axes = (particle_axes(material, part.stop - part.start), 0, 0)
        mapped, remembered = jax.vmap(mapping, in_axes=axes)(material, H[part], history)
        parts.append(mapped)
        new.append(remembered)
    return jnp.concatenate(parts), tuple(new)
