"""The constitutive laws of a scene file, by name, and the return mappings that go with them.

Every number may be `{ file = "x.npy" }`, one value per Gaussian.
"""

from collections.abc import Callable
from typing import NamedTuple

from pgjax import models
from pgjax.models import AbstractElasticity, AbstractLaw, AbstractPlasticity
from pgjax.scenes.arrays import field
from pgjax.scenes.reader import Table


class Response(NamedTuple):
    """What makes the stress of a material."""

    law: AbstractLaw
    plasticity: AbstractPlasticity | None


Reader = Callable[[Table], Response]


def _solid(name: str) -> Reader:
    """The reader of an elastic law of `_SOLIDS`."""

    def read(t: Table) -> Response:
        elasticity = _SOLIDS[name].law(**_moduli(t))
        return Response(_damped(t, elasticity), t.optional("plasticity", _flow_of(name)))

    return read


def _moduli(t: Table) -> dict:
    return {"E": field(t, "E", above=0), "nu": field(t, "nu", above=-1, below=0.5)}


def _damped(t: Table, elasticity: AbstractElasticity) -> AbstractElasticity:
    viscosity = field(t, "damping_viscosity", None, at_least=0)
    if viscosity is None:
        return elasticity
    return models.KelvinVoigt(elasticity, viscosity)  # pyright: ignore[reportCallIssue]


def _snow(t: Table) -> Response:
    law = models.Snow(**_moduli(t), hardening=field(t, "hardening", 10.0, at_least=0))
    flow = models.CriticalStretches(
        field(t, "critical_compression", 2.5e-2, at_least=0, below=1),
        field(t, "critical_stretch", 7.5e-3, at_least=0),
    )
    return Response(_damped(t, law), flow)


def _fluid(t: Table) -> Response:
    law = models.Fluid(
        field(t, "bulk_modulus", above=0),
        field(t, "viscosity", 0.0, at_least=0),
        field(t, "gamma", 7.0, above=1),
    )
    return Response(law, None)


def _flow_of(law: str) -> Callable[[Table], AbstractPlasticity]:
    """The reader of a return mapping, if it is one of those that go with the law."""

    def read(t: Table) -> AbstractPlasticity:
        flow = t.choice("type", FLOWS)
        if flow not in _SOLIDS[law].flows:
            homes = [other for other, solid in _SOLIDS.items() if flow in solid.flows]
            raise t.error("type", f'go with law = "{law}", as it does with "{homes[0]}"')
        return t.kind("type", FLOWS)

    return read


def _drucker_prager(t: Table) -> AbstractPlasticity:
    return models.DruckerPrager(
        field(t, "friction_angle", at_least=0, below=90),
        field(t, "cohesion", None, at_least=0),
        volume_correction=t.boolean("volume_correction", False),
    )


def _von_mises(t: Table) -> AbstractPlasticity:
    yield_stress = field(t, "yield_stress", at_least=0)
    hardening = field(t, "hardening", None, at_least=0)
    softening = field(t, "softening", None, at_least=0)
    if hardening is not None and softening is not None:
        raise t.error("softening", "be left out where `hardening` is given")
    return models.VonMises(yield_stress, hardening, softening)


def _herschel_bulkley(t: Table) -> AbstractPlasticity:
    return models.HerschelBulkley(
        field(t, "yield_stress", at_least=0),
        field(t, "viscosity", at_least=0),
        field(t, "h", 1, above=0),
    )


FLOWS = {
    "drucker-prager": _drucker_prager,
    "von-mises": _von_mises,
    "herschel-bulkley": _herschel_bulkley,
}
"""The return mappings by name."""


class _Solid(NamedTuple):
    """An elastic law, and the return mappings that are consistent with it."""

    law: Callable[..., AbstractElasticity]
    flows: tuple[Callable[[Table], AbstractPlasticity], ...] = ()


_SOLIDS = {
    "fixed-corotated": _Solid(models.FixedCorotated),
    "stvk-hencky": _Solid(models.StVKHencky, (_drucker_prager, _von_mises)),
    "neo-hookean": _Solid(models.NeoHookean),
    "dev-vol-neo-hookean": _Solid(models.DevVolNeoHookean, (_herschel_bulkley,)),
}

LAWS: dict[str, Reader] = {
    **{name: _solid(name) for name in _SOLIDS},
    "fluid": _fluid,
    "snow": _snow,
}
"""The laws by name."""
