"""One time step of the Material Point Method, written as the algorithm reads."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._safe import safe_divide
from pgjax._types import Array, Bool, Float, Scalar
from pgjax.boundary import AbstractGridCondition, Particles, Region, sweep
from pgjax.grid import Grid
from pgjax.models.material import cast, particle_axes
from pgjax.result import Condition
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.transfer import Payload, Stencil, gather, scatter, stencil

Vectors = Float[Array, "d n"]


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
    scene = cast(scene, state.dtype)
    dt = jnp.asarray(dt, state.dtype)
    t = state.step.astype(state.dtype) * dt

    held, state = _impose(scene, state, t, dt)
    state, at, tau = _stress(scene, state, t)
    momentum_and_mass = _particles_to_grid(scene, state, at, tau, dt)
    grid_v = _forces_and_boundaries(scene, at, momentum_and_mass, t, dt)
    v, C, L = _grid_to_particles(scene, at, grid_v)
    return _update(scene, state, held, v, C, L, dt)


def _impose(scene: Scene, state: State, t: Scalar, dt: Scalar) -> tuple[Bool[Array, " p"], State]:
    """Body forces, prescribed velocities and pushes; which particles are held in this step.

    They act before anything is checked, so that a NaN from a user's function is found.
    """
    v = state.v
    if scene.body_force is not None:
        acceleration = jax.vmap(scene.body_force, in_axes=(0, None))(scene.X0, t)
        v = v + dt * acceleration.astype(state.dtype)
    mass = jnp.where(state.alive, scene.masses, 0)
    x = _where(state.alive & _finite(state.position), state.x, 0)
    particles = Particles(x, v, state.C, mass, jnp.zeros_like(state.alive))
    for condition in scene.particle_conditions:
        before, particles = particles, condition(particles, t, dt)
        # What is led already stays so, whatever comes later in the list.
        particles = particles._replace(
            v=_where(before.held, before.v, particles.v),
            C=_where(before.held, before.C, particles.C),
            held=before.held | particles.held,
        )
    v, C = particles.v, particles.C
    return particles.held, eqx.tree_at(lambda s: (s.v, s.C), state, (v, C))


def _stress(scene: Scene, state: State, t: Scalar) -> tuple[State, Stencil, Float[Array, "p 3 3"]]:
    """Kirchhoff stress of every particle; those that cannot go on are masked here."""
    finite = _finite(state.position) & _finite(state.v) & _finite(state.C) & _finite(state.He)
    if state.H is not None:
        finite = finite & _finite(state.H)
    # Harmless values where a particle is dead, so that neither it nor its derivative spreads.
    state = _without_nan(state, finite)
    sound = state.alive & finite
    at, inside = stencil(scene.grid, scene.spline, _where(sound, state.position, 0))
    sound = sound & inside
    He, C = _where(sound, state.He, 0), _where(sound, state.C, 0)
    total = He if state.H is None else _where(sound, state.H, 0)

    tau, inverted, clamped = [], [], []
    for material, part, history in zip(scene.materials, scene.slices, state.history, strict=True):

        def law(material, H, total, L, history):
            return material.response(H, total, L, history, t)

        axes = (particle_axes(material, part.stop - part.start), 0, 0, 0, 0)
        one = jax.vmap(law, in_axes=axes)
        results = one(material, He[part], total[part], _embed(C[part]), history)
        for values, result in zip((tau, inverted, clamped), results, strict=True):
            values.append(result)
    tau, inverted, clamped = (jnp.concatenate(parts) for parts in (tau, inverted, clamped))
    tau_finite = _finite(tau)
    tau = _where(sound & tau_finite, tau, 0)
    alive = sound & tau_finite
    status = state.status.note(
        {
            Condition.NONFINITE: state.alive & ~(finite & (tau_finite | ~inside)),
            Condition.OUT_OF_DOMAIN: state.alive & finite & ~inside,
            Condition.INVERTED: alive & inverted,
            Condition.CLAMPED: alive & clamped,
        },
        state.step,
    )
    state = eqx.tree_at(lambda s: (s.alive, s.status), state, (alive, status))
    return state, at, tau


def _without_nan(state: State, finite: Bool[Array, " p"]) -> State:
    """Rest values for what is not finite; only the position stays as it is, to be seen."""

    def fields(s: State) -> tuple[Any, ...]:
        return tuple(a for a in (s.v, s.C, s.He, s.H) if a is not None)

    return eqx.tree_at(fields, state, tuple(_where(finite, a, 0) for a in fields(state)))


def _particles_to_grid(
    scene: Scene,
    state: State,
    at: Stencil,
    tau: Float[Array, "p 3 3"],
    dt: Scalar,
) -> Float[Array, "*grid c"]:
    """Momentum and mass of the nodes, the internal forces already in the momentum.

    `m_i = Σ w m_p`, `m_i v_i = Σ w m_p (v_p + C_p (x_i − x_p)) − Δt Σ V⁰ τ ∇w` (eqs. 1–2).
    """
    d = scene.grid.dimension
    mass = jnp.where(state.alive, scene.masses, 0)[:, None]
    v, C = _where(state.alive, state.v, 0), _where(state.alive, state.C, 0)
    flux = -dt * scene.volumes[:, None, None] * tau[:, :d, :d]
    to_B, to_S = scene.scheme.split(flux, scene.D)
    B = mass[:, :, None] * C
    B = B if to_B is None else B + to_B
    payload = Payload(jnp.concatenate([mass * v, mass], axis=1), B, to_S)
    return scatter(scene.grid, at, payload)


def _forces_and_boundaries(
    scene: Scene, at: Stencil, momentum_and_mass: Float[Array, "*grid c"], t: Scalar, dt: Scalar
) -> Float[Array, "*grid d"]:
    """Velocity of the nodes: gravity, damping `exp(−γ Δt)`, then each condition in order.

    Empty nodes stay at rest.
    """
    kept = jnp.exp(-scene.grid_damping * dt)

    def velocity(x: Vectors, momentum_and_mass: Float[Array, "c n"], region: Region) -> Vectors:
        """Of n nodes, components first."""
        momentum, mass = momentum_and_mass[:-1], momentum_and_mass[-1]
        v = safe_divide(momentum, jnp.broadcast_to(mass, momentum.shape))
        v = (v + (dt * scene.gravity)[:, None]) * kept
        for condition in scene.boundaries:
            if isinstance(condition, AbstractGridCondition):
                v = condition.on_nodes(x, v, t, region)
            else:
                v = jax.vmap(condition, in_axes=(1, 1, None), out_axes=1)(x, v, t)
        return jnp.where(mass > 0, v, 0)

    return sweep(scene.grid, velocity, momentum_and_mass, _region(scene.grid, at))


def _region(grid: Grid, at: Stencil) -> Region:
    """The box of all nodes that can have mass, half a cell wider on each side."""
    first, last = at.span()
    wide = np.asarray(grid.periodic)
    low = jnp.where(wide, -jnp.inf, (first - 0.5) * grid.h + grid.origin)
    high = jnp.where(wide, jnp.inf, (last + 0.5) * grid.h + grid.origin)
    return Region(low, high)


def _grid_to_particles(
    scene: Scene, at: Stencil, grid_v: Float[Array, "*grid d"]
) -> tuple[Float[Array, "p d"], Float[Array, "p d d"], Float[Array, "p d d"]]:
    """`v = Σ w v_i`, `C = Σ w v_i (x_i − x_p)ᵀ/D` and the gradient L that deforms (eq. 3)."""
    v, moment, slope = gather(scene.grid, at, grid_v, slope=scene.scheme.needs_slope)
    C = moment / scene.spline.moment / scene.grid.h
    L = scene.scheme.velocity_gradient(C, slope)
    return v, C, L


def _update(
    scene: Scene,
    state: State,
    held: Bool[Array, " p"],
    v: Float[Array, "p d"],
    C: Float[Array, "p d d"],
    L: Float[Array, "p d d"],
    dt: Scalar,
) -> State:
    """Move and deform the particles, then return to the yield surface."""
    alive = state.alive
    v = jnp.where(held[:, None], state.v, v)
    damped = _damp_shear(C, scene.shear_damping, dt)
    C = jnp.where(held[:, None, None], state.C, damped)
    L = _embed(L)
    He, history = _return_map(scene, state, _stretched(state.He, L, dt), dt)
    H = None if state.H is None else _where(alive, _stretched(state.H, L, dt), state.H)
    return State(
        position=_where(alive, state.position + dt * v, state.position),
        v=_where(alive, v, 0),
        C=_where(alive, C, 0),
        He=_where(alive, He, state.He),
        H=H,
        history=history,
        alive=alive,
        step=state.step + 1,
        status=state.status,
        origin=state.origin,
    )


def _stretched(
    H: Float[Array, "p 3 3"], L: Float[Array, "p 3 3"], dt: Scalar
) -> Float[Array, "p 3 3"]:
    """`F ← (I + Δt L) F`, written on `H = F − I`."""
    return H + dt * (L + L @ H)


def _damp_shear(C: Float[Array, "p d d"], rate: Scalar, dt: Scalar) -> Float[Array, "p d d"]:
    """RPIC as a rate: the symmetric part of C times `exp(−r Δt)`."""
    transposed = jnp.swapaxes(C, 1, 2)
    # r = ∞ and r = 0 are both exact.
    kept = jnp.exp(-rate * dt)
    return (C - transposed) / 2 + kept * (C + transposed) / 2


def _return_map(
    scene: Scene, state: State, H: Float[Array, "p 3 3"], dt: Scalar
) -> tuple[Float[Array, "p 3 3"], tuple]:
    """Each material maps its own slice; a slice without plasticity passes unchanged."""
    parts, histories = [], []
    for material, part, history in zip(scene.materials, scene.slices, state.history, strict=True):
        if material.plasticity is None:
            parts.append(H[part])
            histories.append(history)
            continue

        def mapping(material, H, history):
            return material.plasticity.return_map(H, history, material.elasticity, dt)

        axes = (particle_axes(material, part.stop - part.start), 0, 0)
        alive = state.alive[part]
        mapped, new = jax.vmap(mapping, in_axes=axes)(material, _where(alive, H[part], 0), history)
        parts.append(mapped)
        histories.append(jax.tree.map(functools.partial(jnp.where, alive), new, history))
    return jnp.concatenate(parts), tuple(histories)


def _where(mask: Bool[Array, " p"], a: Array, b: Array | int) -> Array:
    """`where`, the mask being per particle."""
    return jnp.where(mask.reshape(-1, *(1,) * (a.ndim - 1)), a, b)


def _finite(a: Array) -> Bool[Array, " p"]:
    """Whether every entry of a particle's value is finite."""
    return jnp.all(jnp.isfinite(a), axis=tuple(range(1, a.ndim)))


def _embed(A: Float[Array, "p d d"]) -> Float[Array, "p 3 3"]:
    """A 2×2 tensor as the upper corner of a 3×3 one (plane strain); 3×3 unchanged."""
    missing = 3 - A.shape[-1]
    return jnp.pad(A, ((0, 0), (0, missing), (0, missing))) if missing else A
