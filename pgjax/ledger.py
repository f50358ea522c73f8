"""Accounts of a rollout: what is conserved, what flows in and out, what is lost."""

from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._safe import safe_divide
from pgjax._types import Array, Float, Int, Scalar
from pgjax.linalg import volume_change
from pgjax.models.material import cast, particle_axes
from pgjax.scene import Scene
from pgjax.state import State
from pgjax.step import Stages
from pgjax.timestep import limits


@final
class Flows(eqx.Module):
    """What went in and out since the first step.

    Attributes:
        forces: work of forces and of prescribed motion of particles, J.
        push: momentum that forces and prescribed motion of particles gave, N s, `(d,)`.
        walls: work of the conditions of the grid, J: their impulse times the velocity the nodes
            have after it. Friction is negative, a wall at rest without friction does none.
        impulse: momentum that they gave, N s, `(d,)`.
        plastic: energy that the return mappings released, J.
        damping: energy that `grid_damping` took, J.
    """

    forces: Float[Array, "*batch"]
    push: Float[Array, "*batch d"]
    walls: Float[Array, "*batch"]
    impulse: Float[Array, "*batch d"]
    plastic: Float[Array, "*batch"]
    damping: Float[Array, "*batch"]

    @staticmethod
    def none(state: State) -> "Flows":
        """Before the first step."""
        zero, vector = jnp.zeros((), state.dtype), jnp.zeros((state.v.shape[1],), state.dtype)
        return Flows(zero, vector, zero, vector, zero, zero)


@final
class Ledger(eqx.Module):
    """The accounts of each frame, the first included; in two dimensions per metre of depth.

    Particles that were masked do not count any more.

    Attributes:
        mass: kg.
        momentum: kg m/s, `(d,)`.
        angular_momentum: about the world's origin with the part of C, kg m²/s, `(3,)` or `(1,)`.
        kinetic: with the part of C, J.
        elastic: stored by the laws, J.
        potential: of gravity, zero at the world's origin, J.
        flows: what went in and out since the first step.
        cfl: largest part of a cell that anything moves in a step, `Δt (|v| + 1.5 √d h ‖C‖)/h`.
        smallest_volume: smallest ratio of volumes, det F.
        near_edge: particles within a cell of where their stencil leaves the grid.
        lost: particles that were masked.
    """

    mass: Float[Array, "*batch"]
    momentum: Float[Array, "*batch d"]
    angular_momentum: Float[Array, "*batch k"]
    kinetic: Float[Array, "*batch"]
    elastic: Float[Array, "*batch"]
    potential: Float[Array, "*batch"]
    flows: Flows
    cfl: Float[Array, "*batch"]
    smallest_volume: Float[Array, "*batch"]
    near_edge: Int[Array, "*batch"]
    lost: Int[Array, "*batch"]

    @property
    def total(self) -> Float[Array, "*batch"]:
        """Kinetic, elastic and potential energy, J."""
        return self.kinetic + self.elastic + self.potential

    @property
    def numerical(self) -> Float[Array, "*batch"]:
        """Energy gone since the first frame that nothing else accounts for, J.

        The transfers and the time integration take it, what is stopped at a wall, and what has no
        account of its own: viscosity, `shear_damping`, particles that are held or were masked;
        fibres that pull give.
        """
        start, flows = self.total[..., :1], self.flows
        given = flows.forces + flows.walls - flows.plastic - flows.damping
        return start + given - self.total

    def plot(self, t: Array) -> Any:
        """Draw the accounts over the times of the frames.

        Args:
            t: s, `(frames + 1,)`: `trajectory.t`.

        Returns:
            A `matplotlib.figure.Figure`, which a notebook shows and `savefig` writes.
        """
        from matplotlib.figure import Figure  # Slow to import, needed here only.

        figure = Figure(figsize=(10, 6), layout="constrained")
        (energies, momenta), (steps, shapes) = figure.subplots(2, 2, sharex=True)
        flows = self.flows
        _curves(
            energies,
            t,
            "energy, J",
            {
                "kinetic": self.kinetic,
                "elastic": self.elastic,
                "potential": self.potential - self.potential[0],
                "dissipated": flows.plastic + flows.damping,
                "work of walls": flows.walls,
                "work of forces": flows.forces,
                "numerical loss": self.numerical,
            },
        )
        names = ("x", "y", "z")[: self.momentum.shape[-1]]
        along = {n: self.momentum[:, k] for k, n in enumerate(names)}
        of_walls = {f"{n} of walls": flows.impulse[:, k] for k, n in enumerate(names)}
        _curves(momenta, t, "momentum, kg m/s", along | of_walls)
        _curves(steps, t, "cells per step", {"fastest particle": self.cfl})
        _curves(shapes, t, "smallest det F", {"smallest det F": self.smallest_volume})
        for axis in (steps, shapes):
            axis.set_xlabel("t, s")
        return figure


def _curves(axis: Any, t: Array, label: str, curves: dict[str, Array]) -> None:
    """Those that are not zero, but for rounding, throughout."""
    sizes = {name: np.max(np.abs(np.asarray(values))) for name, values in curves.items()}
    for name, values in curves.items():
        if sizes[name] > 1e-6 * max(sizes.values()):
            axis.plot(np.asarray(t), np.asarray(values), label=name, lw=1.2)
    axis.set_ylabel(label)
    axis.grid(alpha=0.3)
    if len(axis.lines) > 1:
        axis.legend(fontsize=8)


def balance(scene: Scene, state: State, flows: Flows, dt: Scalar) -> Ledger:
    """The accounts of one state."""
    scene = cast(scene, state.dtype)
    mass = jnp.where(state.alive, scene.masses, 0)
    x = jnp.where(state.alive[:, None], state.x, 0)
    momentum, kinetic = motion(scene, state)
    spin = mass[:, None] * (_cross(x, state.v) + scene.D * _axial(state.C))
    J = 1 + jax.vmap(volume_change)(state.He if state.H is None else state.H)
    advective = limits(scene, state).advective
    return Ledger(
        mass=jnp.sum(mass),
        momentum=momentum,
        angular_momentum=jnp.sum(jnp.where(state.alive[:, None], spin, 0), axis=0),
        kinetic=kinetic,
        elastic=stored(scene, state),
        potential=-jnp.sum(mass * (x @ scene.gravity)),
        flows=flows,
        cfl=jnp.max(jnp.where(state.alive, dt / advective, 0)),
        smallest_volume=jnp.min(jnp.where(state.alive, J, jnp.inf)),
        near_edge=jnp.sum(state.alive & _near_edge(scene, state), dtype=jnp.int32),
        lost=jnp.sum(~state.alive, dtype=jnp.int32),
    )


def followed(scene: Scene, before: State, stages: Stages, flows: Flows, dt: Scalar) -> Flows:
    """The flows after one more step, from what it passed through."""
    scene = cast(scene, before.dtype)
    old, imposed, new = (motion(scene, s) for s in (before, stages.imposed, stages.after))
    nodes = _on_nodes(scene, stages, dt)
    # G2P keeps momentum: what the particles have more was given by what leads some of them.
    led = new.momentum - nodes.momentum if scene.particle_conditions else 0
    return Flows(
        forces=flows.forces + imposed.energy - old.energy + nodes.leading,
        push=flows.push + imposed.momentum - old.momentum + led,
        walls=flows.walls + nodes.work,
        impulse=flows.impulse + nodes.impulse,
        plastic=flows.plastic + _released(scene, stages),
        damping=flows.damping + nodes.damped,
    )


class Motion(NamedTuple):
    """Momentum, kg m/s, `(d,)`, and kinetic energy, J."""

    momentum: Float[Array, " d"]
    energy: Scalar


def motion(scene: Scene, state: State) -> Motion:
    """`Σ m v` and `½ Σ m (|v|² + D ‖C‖²)` of the particles."""
    mass = jnp.where(state.alive, scene.masses, 0)
    v = jnp.where(state.alive[:, None], state.v, 0)
    C = jnp.where(state.alive[:, None, None], state.C, 0)
    squares = jnp.sum(v**2, axis=1) + scene.D * jnp.sum(C**2, axis=(1, 2))
    return Motion(jnp.sum(mass[:, None] * v, axis=0), jnp.sum(mass * squares) / 2)


class _Nodes(NamedTuple):
    """On the grid in one step: momentum after walls, what walls, led nodes and damping did."""

    momentum: Float[Array, " d"]
    impulse: Float[Array, " d"]
    work: Scalar
    leading: Scalar
    damped: Scalar


def _on_nodes(scene: Scene, stages: Stages, dt: Scalar) -> _Nodes:
    momentum, mass = stages.nodes[..., :-1], stages.nodes[..., -1:]
    v = safe_divide(momentum, jnp.broadcast_to(mass, momentum.shape))
    free = jnp.where(mass > 0, v + jnp.broadcast_to(dt * scene.gravity, v.shape), 0)
    damped = jnp.exp(-scene.grid_damping * dt) * free
    walled, moved = stages.walled[..., :-1], stages.moved[..., :-1]
    given = mass * (walled - damped)
    nodes = tuple(range(scene.grid.dimension))
    return _Nodes(
        momentum=jnp.sum(mass * walled, axis=nodes),
        impulse=jnp.sum(given, axis=nodes),
        work=jnp.sum(given * walled),
        leading=jnp.sum(mass * (moved - walled) * moved),
        damped=jnp.sum(mass * (free**2 - damped**2)) / 2,
    )


def _released(scene: Scene, stages: Stages) -> Scalar:
    """`Σ V⁰ (ψ(Fe trial) − ψ(Fe))`: what the return mappings gave away.

    The trial state is `A Fe` with the step's total `A = F Fᵒˡᵈ⁻¹`.
    """
    old, new = stages.imposed, stages.after
    if not scene.is_plastic or old.H is None or new.H is None:
        return jnp.zeros((), old.dtype)
    eye = jnp.eye(3, dtype=old.dtype)

    def trial(He: Array, H_old: Array, H_new: Array) -> Array:
        return He + (H_new - H_old) @ jnp.linalg.inv(eye + H_old) @ (eye + He)

    at_trial = eqx.tree_at(
        lambda s: (s.He, s.alive), old, (jax.vmap(trial)(old.He, old.H, new.H), new.alive)
    )
    return stored(scene, at_trial) - stored(scene, new)


def stored(scene: Scene, state: State) -> Scalar:
    """`Σ V⁰ ψ(Fe)`, J; fibres that pull store nothing."""
    parts = []
    for material, part, history in zip(scene.materials, scene.slices, state.history, strict=True):

        def energy(material, H, history):
            return material.elasticity.elastic().energy(H, history)

        axes = (particle_axes(material, part.stop - part.start), 0, 0)
        parts.append(jax.vmap(energy, in_axes=axes)(material, state.He[part], history))
    density = jnp.where(state.alive, jnp.concatenate(parts), 0)
    return jnp.sum(scene.volumes * density)


def _cross(a: Float[Array, "p d"], b: Float[Array, "p d"]) -> Float[Array, "p k"]:
    """`a × b`: three components, or in the plane the one across it."""
    if a.shape[1] == 2:
        return (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[:, None]
    return jnp.cross(a, b)


def _axial(C: Float[Array, "p d d"]) -> Float[Array, "p k"]:
    """Axial vector of `C − Cᵀ`."""
    pairs = ((1, 0),) if C.shape[1] == 2 else ((2, 1), (0, 2), (1, 0))
    return jnp.stack([C[:, i, j] - C[:, j, i] for i, j in pairs], axis=1)


def _near_edge(scene: Scene, state: State) -> Array:
    """Whether a particle one cell farther, in any direction, could leave the grid."""
    grid, spline = scene.grid, scene.spline

    def near(x: Float[Array, " d"]) -> Array:
        first = spline.base(grid.cells(jnp.where(jnp.isfinite(x), x, 0)))
        return ~(grid.contains(first - 1, spline.width) & grid.contains(first + 1, spline.width))

    return jax.vmap(near)(state.position)
