"""What particles give to the grid and take from it: the two halves of a step.

`send` is finiteness, stress and P2G, `receive` is G2P, motion, deformation and return mapping, in
JAX, for every law. For the built-in laws each is one native kernel on a CPU: `fused`.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp

from pgjax._types import Array, Bool, Float, Int
from pgjax.models.law import Response
from pgjax.result import Condition
from pgjax.transfer import AbstractScheme, primitive

# What `send` counts (`Event` in native/exchange.h).
EVENTS = (Condition.NONFINITE, Condition.OUT_OF_DOMAIN, Condition.INVERTED, Condition.CLAMPED)

# The stress of particles from elastic and total `F − I` and the affine velocity.
Respond = Callable[[Array, Array, Array], Response]
# The return mapping of particles: `H -> (H, what is remembered)`.
Map = Callable[[Array], tuple[Array, Any]]


class Sender(NamedTuple):
    """The operands of `send` for p particles.

    Attributes:
        alive: not masked before, `(p,)`.
        inside: whether the stencil fits in the grid, `(p,)`.
        xi: positions in cells, `(p, d)`.
        position: positions relative to the grid, m, `(p, d)`; looked at for finiteness.
        mass: kg, `(p,)`.
        volume: rest volumes, m³, `(p,)`.
        v: velocities, m/s, `(p, d)`.
        C: affine velocities, 1/s, `(p, d, d)`.
        He: elastic `Fe − I`, `(p, 3, 3)`.
        H: total `F − I`, `(p, 3, 3)`; `(p, 0, 3)` where it is He.
    """

    alive: Bool[Array, " p"]
    inside: Bool[Array, " p"]
    xi: Float[Array, "p d"]
    position: Float[Array, "p d"]
    mass: Float[Array, " p"]
    volume: Float[Array, " p"]
    v: Float[Array, "p d"]
    C: Float[Array, "p d d"]
    He: Float[Array, "p 3 3"]
    H: Float[Array, "p _ 3"]


class Sent(NamedTuple):
    """What comes of it.

    Attributes:
        nodes: momentum and mass of the padded grid, the internal forces already in the momentum.
        alive: which particles go on, `(p,)`.
        finite: which are finite, `(p,)`.
        events: how many particles had each of `EVENTS`, int32 `(4,)`.
    """

    nodes: Float[Array, "*nodes c"]
    alive: Bool[Array, " p"]
    finite: Bool[Array, " p"]
    events: Int[Array, "4"]


class Receiver(NamedTuple):
    """The operands of `receive` for p particles.

    Attributes:
        alive: not masked, `(p,)`; the others keep their place.
        finite: whether the deformation is, `(p,)`; where not it becomes the identity.
        held: which keep v and C, `(p,)`.
        xi: positions in cells, `(p, d)`.
        nodes: velocities of the padded grid, m/s, and a last channel that nobody looks at.
        position: positions relative to the grid, m, `(p, d)`.
        v: velocities, m/s, `(p, d)`.
        C: affine velocities, 1/s, `(p, d, d)`.
        He: elastic `Fe − I`, `(p, 3, 3)`.
        H: total `F − I`, `(p, 3, 3)`; `(p, 0, 3)` where it is He.
    """

    alive: Bool[Array, " p"]
    finite: Bool[Array, " p"]
    held: Bool[Array, " p"]
    xi: Float[Array, "p d"]
    nodes: Float[Array, "*nodes c"]
    position: Float[Array, "p d"]
    v: Float[Array, "p d"]
    C: Float[Array, "p d d"]
    He: Float[Array, "p 3 3"]
    H: Float[Array, "p _ 3"]


class Received(NamedTuple):
    """The particles one step later, and what their return mapping says."""

    position: Float[Array, "p d"]
    v: Float[Array, "p d"]
    C: Float[Array, "p d d"]
    He: Float[Array, "p 3 3"]
    H: Float[Array, "p _ 3"]
    history: Any


def send(
    p: Sender,
    respond: Respond,
    scheme: AbstractScheme,
    numbers: Float[Array, "3"],
    *,
    degree: int,
    nodes: tuple[int, ...],
) -> Sent:
    """Finiteness, stress and P2G.

    `m_i = Σ w m_p`, `m_i v_i = Σ w m_p (v_p + C_p (x_i − x_p)) − Δt Σ V⁰ τ ∇w` (PhysGaussian
    supplement, eqs. 1–2). A particle that is not finite, or whose stress is not, gives nothing.

    Args:
        p: the particles.
        respond: their stress.
        scheme: how it becomes a force.
        numbers: Δt, h and D.
        degree: of the spline.
        nodes: shape of the padded grid.
    """
    d = p.xi.shape[-1]
    dt, h, D = numbers
    fields = (p.position, p.v, p.C, p.He, p.H)
    finite = functools.reduce(operator.and_, map(is_finite, fields))
    sound = p.alive & p.inside & finite
    # Harmless values where a particle is dead, so that neither it nor its derivative spreads.
    v, C, He, H = (where(sound, a, 0) for a in (p.v, p.C, p.He, p.H))
    tau, inverted, clamped = respond(He, H if H.size else He, C)
    stress_finite = is_finite(tau)
    alive = sound & stress_finite
    mass = jnp.where(alive, p.mass, 0)[:, None]
    flux = -dt * p.volume[:, None, None] * where(alive, tau, 0)[:, :d, :d]
    to_B, to_S = scheme.split(flux, D)
    B = mass[:, :, None] * C
    B = B if to_B is None else B + to_B
    S = B[:, :, :0] if to_S is None else to_S / h
    values = jnp.concatenate([mass * v, mass], axis=1)
    grid = primitive.scatter(p.xi, values, B * h, S, degree=degree, nodes=nodes)
    events = (
        p.alive & ~(finite & stress_finite),
        p.alive & finite & ~p.inside,
        alive & inverted,
        alive & clamped,
    )
    counts = jnp.stack([jnp.sum(event, dtype=jnp.int32) for event in events])
    return Sent(grid, alive, finite, counts)


def receive(
    p: Receiver,
    mapping: Map | None,
    scheme: AbstractScheme,
    numbers: Float[Array, "4"],
    *,
    degree: int,
) -> Received:
    """The particles one step later.

    `v = Σ w v_i`, `C = Σ w v_i (x_i − x_p)ᵀ/D` (eq. 3), `x ← x + Δt v`, `F ← (I + Δt L) F`, and
    back to the yield surface.

    Args:
        p: the particles and the grid.
        mapping: their return mapping, if any.
        scheme: which gradient L deforms them.
        numbers: Δt, h, D/h² and what RPIC damping keeps of the symmetric C in a step.
        degree: of the spline.
    """
    dt, h, moment, kept = numbers
    alive, d = p.alive, p.xi.shape[-1]
    slope = scheme.needs_slope
    grid_v = p.nodes[..., :d]
    v, moments, slopes = primitive.gather(p.xi, grid_v, degree=degree, graded=d, slope=slope)
    C = moments / moment / h
    L = embed(where(alive, scheme.velocity_gradient(C, slopes / h if slope else None), 0))
    v = where(p.held, where(alive, p.v, 0), v)
    C = where(p.held, where(alive, p.C, 0), _damp_shear(C, kept))
    He = _stretched(where(p.finite, p.He, 0), L, dt)
    H = _stretched(where(p.finite, p.H, 0), L, dt) if p.H.size else p.H
    history = None
    if mapping is not None:
        mapped, history = mapping(where(alive, He, 0))
        He = where(alive, mapped, He)
    position = where(alive, p.position + dt * v, p.position)
    return Received(position, where(alive, v, 0), where(alive, C, 0), He, H, history)


def _stretched(
    H: Float[Array, "p 3 3"], L: Float[Array, "p 3 3"], dt: Float[Array, ""]
) -> Float[Array, "p 3 3"]:
    """`F ← (I + Δt L) F`, written on `H = F − I`."""
    return H + dt * (L + L @ H)


def _damp_shear(C: Float[Array, "p d d"], kept: Float[Array, ""]) -> Float[Array, "p d d"]:
    """RPIC as a rate: the part of the symmetric C that is kept; 0 and 1 are both exact."""
    transposed = jnp.swapaxes(C, 1, 2)
    return (C - transposed) / 2 + kept * (C + transposed) / 2


def where(mask: Bool[Array, " p"], a: Array, b: Array | int) -> Array:
    """`where`, the mask being per particle."""
    return jnp.where(mask.reshape(-1, *(1,) * (a.ndim - 1)), a, b)


def is_finite(a: Array) -> Bool[Array, " p"]:
    """Whether every entry of a particle's value is finite."""
    return jnp.all(jnp.isfinite(a), axis=tuple(range(1, a.ndim)))


def embed(A: Float[Array, "p d d"]) -> Float[Array, "p 3 3"]:
    """A 2×2 tensor as the upper corner of a 3×3 one (plane strain); 3×3 unchanged."""
    missing = 3 - A.shape[-1]
    return jnp.pad(A, ((0, 0), (0, missing), (0, missing))) if missing else A
