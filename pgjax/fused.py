"""The passes of a step for the laws that have native kernels, each as one call.

`exchange.send` and `exchange.receive` in JAX are what their kernels are tested against, and what
runs where there is none.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pgjax import native
from pgjax._safe import safe_divide
from pgjax._types import Array, Bool, Float, Int
from pgjax.boundary.contact import AbstractContact, Separating, Slip, Sticky
from pgjax.exchange import Received, Receiver, Sender, Sent, receive, send
from pgjax.models.elasticity import RESPONSES
from pgjax.models.law import Response
from pgjax.models.plasticity import MAPPINGS
from pgjax.native.stages import stage
from pgjax.transfer import MLS, AbstractScheme, SplineGradient, primitive

Arrays = tuple[Array, ...]

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
    *operands: Array, law: str, degree: int, nodes: tuple[int, ...], mls: bool, whole: bool
) -> Arrays:
    del whole  # All nodes are cleared.
    *own, mu, lam, numbers = operands
    p = Sender(*own)
    n = p.xi.shape[0]

    def respond(He: Array, H: Array, C: Array) -> Response:
        del H, C
        return jax.vmap(RESPONSES[law])(He, _per_particle(mu, n), _per_particle(lam, n))

    return tuple(send(p, respond, _scheme(mls), numbers, degree=degree, nodes=nodes))


def _velocities_plain(*operands: Array, contact: str) -> Arrays:
    *sides, box, nodes, numbers, friction = operands
    if box.size:
        # Whatever a kernel left outside.
        nodes = jnp.where(_in_box(box, nodes.shape[:-1])[..., None], nodes, 0)
    mass = nodes[..., -1:]
    v = safe_divide(nodes[..., :-1], jnp.broadcast_to(mass, nodes[..., :-1].shape))
    v = numbers[0] * (v + jnp.broadcast_to(numbers[1:], v.shape))
    if contact != "none":
        wall = contact_of(contact, friction[0])
        for axis, side in enumerate(sides[: v.ndim - 1]):
            v = _touched(wall, axis, side, v)
    return (jnp.concatenate([jnp.where(mass > 0, v, 0), mass], axis=-1),)


def _in_box(box: Int[Array, " _"], shape: tuple[int, ...]) -> Bool[Array, "*grid"]:
    """Which nodes of a grid are in a box (see `velocities`)."""
    d = len(shape)
    places = jnp.indices(shape, box.dtype)
    first, end = (a.reshape(d, *[1] * d) for a in (box[:d], box[d:]))
    return jnp.all((places >= first) & (places < end), axis=0)


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
    operands: list[Array],
    types: list[Any],
    *,
    law: str,
    degree: int,
    mls: bool,
    whole: bool,
    **_: Any,
) -> Arrays | None:
    target = _kernel_of("send", "exchange", operands[Sender._fields.index("xi")])
    if target is None:
        return None
    grid, *others = types
    made, *rest = jax.ffi.ffi_call(target, [_packed_type(grid), *others])(
        *operands, **_attributes(_LAWS.index(law), degree, mls), whole=np.bool_(whole)
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
    masks=4,
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
    whole: bool = True,
) -> Sent:
    """`send` for a law of `RESPONSES` with its parameters μ and λ, Pa, as one native call.

    Unless the whole grid is wanted, nodes outside the box of all stencils may hold anything.
    """
    mu, lam = map(jnp.atleast_1d, parameters)
    static = {"law": law, "degree": degree, "nodes": nodes, "mls": isinstance(scheme, MLS)}
    return Sent(*_send(*p, mu, lam, numbers, **static, whole=whole))


def velocities(
    nodes: Float[Array, "*grid c"],
    kept: Float[Array, ""],
    gained: Float[Array, " d"],
    walls: tuple[AbstractContact, list[Int[Array, " _"]]] | None = None,
    box: Int[Array, " _"] | None = None,
) -> Float[Array, "*grid c"]:
    """From momentum and mass to velocity and mass; an empty node is at rest.

    Args:
        nodes: momentum, kg m/s, and mass, kg.
        kept: the part of the velocity that damping leaves.
        gained: what gravity adds to it before.
        walls: contact of a box, and for the nodes along each direction −1 behind its lower wall,
            1 behind its upper one, 0 elsewhere, int8.
        box: first node along each direction and end of the nodes that may have mass, int32
            `(2 d,)`; all of them if None. The others may hold anything, before and after.
    """
    numbers = jnp.concatenate([kept[None], gained])
    contact, sides = (None, []) if walls is None else walls
    friction = contact.friction if isinstance(contact, Separating) else jnp.zeros((), nodes.dtype)
    padded = [*sides, *[jnp.zeros((0,), jnp.int8)] * (3 - len(sides))]
    box = jnp.zeros((0,), jnp.int32) if box is None else box
    name = _CONTACTS[_CONTACT_TYPES.index(type(contact))]
    return _velocities(*padded, box, nodes, numbers, friction[None], contact=name)[0]


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
