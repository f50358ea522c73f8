"""What particles give to the grid and take from it: the two halves of a step.

`send` is finiteness, stress and P2G, `receive` is G2P, motion, deformation and return mapping.
For the built-in laws each is one native kernel on a CPU; `_send` and `_receive` say the same in
JAX, for every law.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pgjax import native
from pgjax._safe import safe_divide
from pgjax._types import Array, Bool, Float, Int
from pgjax.boundary.contact import AbstractContact, Separating, Slip, Sticky
from pgjax.models.elasticity import RESPONSES
from pgjax.models.law import Response
from pgjax.models.plasticity import MAPPINGS
from pgjax.native.stages import stage
from pgjax.result import Condition
from pgjax.transfer import MLS, AbstractScheme, SplineGradient, primitive

# What `send` counts (`Event` in native/exchange.h).
EVENTS = (Condition.NONFINITE, Condition.OUT_OF_DOMAIN, Condition.INVERTED, Condition.CLAMPED)

Arrays = tuple[Array, ...]
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


# The same for the laws that have native kernels.

_LAWS = ("neo_hookean", "fixed_corotated", "stvk_hencky")
_MAPS = ("elastic", "von_mises", "drucker_prager")
_CONTACTS = ("none", "sticky", "slip", "separating")
_CONTACT_TYPES = (type(None), Sticky, Slip, Separating)


def known(contact: AbstractContact) -> bool:
    """Whether `velocities` takes it."""
    return type(contact) in _CONTACT_TYPES


def contact_of(name: str, friction: Array) -> AbstractContact:
    """The contact of a name in `_CONTACTS`."""
    kind = _CONTACT_TYPES[_CONTACTS.index(name)]
    assert issubclass(kind, AbstractContact)
    return Separating(friction) if kind is Separating else kind()


def _scheme(mls: bool) -> AbstractScheme:
    return MLS() if mls else SplineGradient()


def _per_particle(values: Array, count: int) -> Array:
    return jnp.broadcast_to(values, (count,))


def _send_plain(
    *operands: Array, law: str, degree: int, nodes: tuple[int, ...], mls: bool
) -> Arrays:
    *own, mu, lam, numbers = operands
    p = Sender(*own)
    n = p.xi.shape[0]

    def respond(He: Array, H: Array, C: Array) -> Response:
        del H, C
        return jax.vmap(RESPONSES[law])(He, _per_particle(mu, n), _per_particle(lam, n))

    return tuple(send(p, respond, _scheme(mls), numbers, degree=degree, nodes=nodes))


def _velocities_plain(*operands: Array, contact: str) -> Arrays:
    *sides, nodes, numbers, friction = operands
    mass = nodes[..., -1:]
    v = safe_divide(nodes[..., :-1], jnp.broadcast_to(mass, nodes[..., :-1].shape))
    v = numbers[0] * (v + jnp.broadcast_to(numbers[1:], v.shape))
    if contact != "none":
        wall = contact_of(contact, friction[0])
        for axis, side in enumerate(sides[: v.ndim - 1]):
            v = _touched(wall, axis, side, v)
    return (jnp.concatenate([jnp.where(mass > 0, v, 0), mass], axis=-1),)


def _touched(contact: AbstractContact, axis: int, side: Array, v: Array) -> Array:
    """The velocities of a grid after the two walls across one direction."""
    d = v.shape[-1]
    shape = [1] * d
    shape[axis] = -1
    side = jnp.broadcast_to(side.reshape(shape), v.shape[:-1])
    inward = -side[..., None].astype(v.dtype) * jnp.eye(d, dtype=v.dtype)[axis].reshape(*[1] * d, d)
    flat = jax.vmap(contact)(v.reshape(-1, d), inward.reshape(-1, d))
    return jnp.where(side[..., None] != 0, flat.reshape(v.shape), v)


def _receive_plain(*operands: Array, mapping: str, degree: int, mls: bool) -> Arrays:
    *own, first, second, third, numbers = operands
    p = Receiver(*own)
    n = p.xi.shape[0]
    given = [_per_particle(a, n) for a in (first, second, third) if a.size]

    def mapped(H: Array) -> tuple[Array, Array]:
        new, history = jax.vmap(MAPPINGS[mapping])(H, *given)
        return new, history

    out = receive(p, mapped if given else None, _scheme(mls), numbers, degree=degree)
    history = p.v[:0, 0] if out.history is None else jnp.where(p.alive, out.history, 0)
    return tuple(out._replace(history=history))


def _kernel(name: str, source: str, dtype: Any, dimension: int) -> str | None:
    """What XLA knows a kernel by; None without."""
    library = native.library(source, jnp.dtype(dtype).name, dimension)
    return None if library is None else library.targets[name]


def _kernel_of(name: str, source: str, xi: Array) -> str | None:
    # The kernels count particles in 32 bits.
    return _kernel(name, source, xi.dtype, xi.shape[-1]) if xi.shape[-2] < 2**31 else None


def _attributes(kind: int, degree: int, mls: bool) -> dict[str, Any]:
    return {"kind": np.int64(kind), "degree": np.int64(degree), "mls": np.bool_(mls)}


def _map_kind(mapping: str) -> int:
    return next(i for i, name in enumerate(_MAPS) if mapping.startswith(name))


def _packed_type(like: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((*like.shape[:-1], primitive.CHANNELS), like.dtype)


def _send_native(
    operands: list[Array], types: list[Any], *, law: str, degree: int, mls: bool, **_: Any
) -> Arrays | None:
    target = _kernel_of("send", "exchange", operands[Sender._fields.index("xi")])
    if target is None:
        return None
    grid, *others = types
    made, *rest = jax.ffi.ffi_call(target, [_packed_type(grid), *others])(
        *operands, **_attributes(_LAWS.index(law), degree, mls)
    )
    return made[..., : grid.shape[-1]], *rest


def _send_tangent(
    operands: list[Array], types: list[Any], *, law: str, degree: int, mls: bool, **_: Any
) -> Arrays | None:
    target = _kernel_of("send_tangent", "exchange_tangent", operands[Sender._fields.index("xi")])
    if target is None:
        return None
    call = jax.ffi.ffi_call(target, _packed_type(types[0]))
    made = call(*operands, **_attributes(_LAWS.index(law), degree, mls))
    return (made[..., : types[0].shape[-1]],)


def _send_pull(
    operands: list[Array], types: list[Any], *, law: str, degree: int, mls: bool, **_: Any
) -> Arrays | None:
    target = _kernel_of("send_pull", "exchange_pull", operands[Sender._fields.index("xi")])
    if target is None:
        return None
    *given, bar = operands
    call = jax.ffi.ffi_call(target, types)
    packed = primitive.with_channels(bar)
    return tuple(call(*given, packed, **_attributes(_LAWS.index(law), degree, mls)))


def _velocities_native(operands: list[Array], types: list[Any], *, contact: str) -> Arrays | None:
    *sides, nodes, numbers, friction = operands
    target = _kernel("velocities", "exchange", nodes.dtype, nodes.shape[-1] - 1)
    if target is None:
        return None
    call = jax.ffi.ffi_call(target, _packed_type(nodes), input_output_aliases={len(sides): 0})
    kind = np.int64(_CONTACTS.index(contact))
    made = call(*sides, primitive.with_channels(nodes), numbers, friction, contact=kind)
    return (made[..., : types[0].shape[-1]],)


def _velocities_tangent(operands: list[Array], types: list[Any], *, contact: str) -> Arrays | None:
    *sides, nodes, numbers, friction, dnodes, dnumbers, dfriction = operands
    target = _kernel("velocities_tangent", "exchange", nodes.dtype, nodes.shape[-1] - 1)
    if target is None:
        return None
    kind = np.int64(_CONTACTS.index(contact))
    packed, dpacked = map(primitive.with_channels, (nodes, dnodes))
    call = jax.ffi.ffi_call(target, _packed_type(nodes))
    made = call(*sides, packed, numbers, friction, dpacked, dnumbers, dfriction, contact=kind)
    return (made[..., : types[0].shape[-1]],)


def _velocities_pull(
    operands: list[Array], types: list[Any], *, contact: str, **_: Any
) -> Arrays | None:
    *sides, nodes, numbers, friction, bar = operands
    target = _kernel("velocities_pull", "exchange_pull", nodes.dtype, nodes.shape[-1] - 1)
    if target is None:
        return None
    kind = np.int64(_CONTACTS.index(contact))
    packed, packed_bar = map(primitive.with_channels, (nodes, bar))
    call = jax.ffi.ffi_call(target, [_packed_type(nodes), *types[1:]])
    made, *others = call(*sides, packed, numbers, friction, packed_bar, contact=kind)
    return made[..., : nodes.shape[-1]], *others


def _receive_native(
    operands: list[Array], types: list[Any], *, mapping: str, degree: int, mls: bool
) -> Arrays | None:
    target = _kernel_of("receive", "exchange", operands[Receiver._fields.index("xi")])
    if target is None:
        return None
    at = Receiver._fields.index("nodes")
    given = list(operands)
    given[at] = primitive.with_channels(operands[at])
    # The particles are changed in place.
    in_place = {Receiver._fields.index(f): i for i, f in enumerate(Received._fields[:-1])}
    call = jax.ffi.ffi_call(target, types, input_output_aliases=in_place)
    return tuple(call(*given, **_attributes(_map_kind(mapping), degree, mls)))


def _receive_tangent(
    operands: list[Array], types: list[Any], *, mapping: str, degree: int, mls: bool
) -> Arrays | None:
    xi = Receiver._fields.index("xi")
    target = _kernel_of("receive_tangent", "exchange_tangent", operands[xi])
    if target is None:
        return None
    given, at = list(operands), Receiver._fields.index("nodes")
    # The tangents of the floating operands follow the operands themselves.
    for i in (at, at + (len(operands) - xi) // 2):
        given[i] = primitive.with_channels(given[i])
    correct = np.bool_(mapping.endswith("corrected"))
    call = jax.ffi.ffi_call(target, types)
    return tuple(call(*given, correct=correct, **_attributes(_map_kind(mapping), degree, mls)))


def _receive_pull(
    operands: list[Array], types: list[Any], *, mapping: str, degree: int, mls: bool, **_: Any
) -> Arrays | None:
    target = _kernel_of("receive_pull", "exchange_pull", operands[Receiver._fields.index("xi")])
    if target is None:
        return None
    at, given, made = Receiver._fields.index("nodes"), list(operands), list(types)
    given[at] = primitive.with_channels(operands[at])
    masks = len(operands) - len(Received._fields) - len(types)
    made[at - masks] = _packed_type(types[at - masks])
    correct = np.bool_(mapping.endswith("corrected"))
    call = jax.ffi.ffi_call(target, made)
    bars = call(*given, correct=correct, **_attributes(_map_kind(mapping), degree, mls))
    channels = operands[at].shape[-1]
    return tuple(b[..., :channels] if i == at - masks else b for i, b in enumerate(bars))


_send = stage(
    "send",
    _send_plain,
    1,
    _send_native,
    masks=2,
    tangent=_send_tangent,
    pull=_send_pull,
)
_velocities = stage(
    "velocities",
    _velocities_plain,
    1,
    _velocities_native,
    masks=3,
    tangent=_velocities_tangent,
    pull=_velocities_pull,
)
_receive = stage(
    "receive",
    _receive_plain,
    1,
    _receive_native,
    masks=3,
    tangent=_receive_tangent,
    pull=_receive_pull,
)


def send_natively(
    p: Sender,
    law: str,
    parameters: tuple[Array, Array],
    scheme: AbstractScheme,
    numbers: Float[Array, "3"],
    *,
    degree: int,
    nodes: tuple[int, ...],
) -> Sent:
    """`send` for a law of `RESPONSES` with its parameters μ and λ, Pa, as one native call."""
    mu, lam = map(jnp.atleast_1d, parameters)
    mls = isinstance(scheme, MLS)
    return Sent(*_send(*p, mu, lam, numbers, law=law, degree=degree, nodes=nodes, mls=mls))


def velocities(
    nodes: Float[Array, "*grid c"],
    kept: Float[Array, ""],
    gained: Float[Array, " d"],
    walls: tuple[AbstractContact, list[Int[Array, " _"]]] | None = None,
) -> Float[Array, "*grid c"]:
    """From momentum and mass to velocity and mass; an empty node is at rest.

    Args:
        nodes: momentum, kg m/s, and mass, kg.
        kept: the part of the velocity that damping leaves.
        gained: what gravity adds to it before.
        walls: contact of a box, and for the nodes along each direction −1 behind its lower wall,
            1 behind its upper one, 0 elsewhere, int8.
    """
    numbers = jnp.concatenate([kept[None], gained])
    contact, sides = (None, []) if walls is None else walls
    friction = contact.friction if isinstance(contact, Separating) else jnp.zeros((), nodes.dtype)
    padded = [*sides, *[jnp.zeros((0,), jnp.int8)] * (3 - len(sides))]
    name = _CONTACTS[_CONTACT_TYPES.index(type(contact))]
    return _velocities(*padded, nodes, numbers, friction[None], contact=name)[0]


def receive_natively(
    p: Receiver,
    mapping: str,
    parameters: tuple[Array, ...],
    scheme: AbstractScheme,
    numbers: Float[Array, "4"],
    *,
    degree: int,
) -> Received:
    """`receive` for a mapping of `MAPPINGS` ("elastic" for none) as one native call."""
    given = [jnp.atleast_1d(a) for a in parameters]
    given += [numbers[:0]] * (3 - len(given))
    mls = isinstance(scheme, MLS)
    out = Received(*_receive(*p, *given, numbers, mapping=mapping, degree=degree, mls=mls))
    return out if parameters else out._replace(history=None)
