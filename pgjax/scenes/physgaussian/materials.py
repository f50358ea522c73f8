"""The material of a configuration file, and its boxes with other moduli."""

from typing import Any, NamedTuple

import numpy as np

from pgjax.scenes.physgaussian.common import inside
from pgjax.scenes.physgaussian.keys import Config, Extra


class Materials(NamedTuple):
    """The `[[material]]` tables of a scene file, and notes, a line each."""

    tables: list[dict[str, Any]]
    notes: list[str]


def materials(config: Config, x: np.ndarray) -> Materials:
    """The materials of particles at the positions `x`, m, `(n, 3)`.

    In the reference the last box that holds a particle decides, in a scene file the first material.
    """
    notes = _law_notes(config)
    owner, density = np.full(len(x), -1), np.full(len(x), config.density)
    for index, extra in enumerate(config.extras):
        there = inside(extra, x)
        owner[there] = index
        if extra.density is not None:
            density[there] = extra.density
    tables = []
    for index in [*reversed(range(len(config.extras))), -1]:
        mine = owner == index
        if not mine.any():
            notes.append(f"{_name(index)}: left out: no particle is of it")
            continue
        extra = config.extras[index] if index >= 0 else None
        values, counts = np.unique(density[mine], return_counts=True)
        if len(values) > 1:
            notes.append(f"{_name(index)}: has one density, that of most of its particles")
        tables.append(_table(config, extra, float(values[np.argmax(counts)])))
    # Its faces, and what is outside of all boxes up to rounding, are somebody's too.
    tables[-1].pop("region", None)
    return Materials(tables, notes)


def _name(index: int) -> str:
    return "material" if index < 0 else f"additional_material_params {index + 1}"


def _table(config: Config, extra: Extra | None, density: float) -> dict[str, Any]:
    E, nu = (config.E, config.nu) if extra is None else (extra.E, extra.nu)
    table = {"law": _LAWS[config.material], "E": E, "nu": nu, "density": density}
    plasticity = _plasticity(config, E, nu)
    if plasticity:
        table["plasticity"] = plasticity
    if extra is not None:
        point, size = np.asarray(extra.point), np.asarray(extra.size)
        table["region"] = {"lower": (point - size).tolist(), "upper": (point + size).tolist()}
    return table


def _plasticity(config: Config, E: float, nu: float) -> dict[str, Any] | None:
    match config.material:
        case "metal":
            flow = {"type": "von-mises", "yield_stress": config.yield_stress}
            return flow | ({"hardening": config.xi} if config.hardening else {})
        case "plasticine":
            # Of a stress there, of twice the shear modulus here.
            softening = config.softening * (1 + nu) / E
            flow = {"type": "von-mises", "yield_stress": config.yield_stress}
            return flow | {"softening": softening}
        case "sand":
            return {"type": "drucker-prager", "friction_angle": config.friction_angle}
        case "foam":
            flow = {"type": "herschel-bulkley", "yield_stress": config.yield_stress, "h": 1.0}
            return flow | {"viscosity": config.plastic_viscosity}
    return None


def _law_notes(config: Config) -> list[str]:
    name = config.material
    notes = {
        "metal": ["material: metal has the stress of its strain (a factor of the stretch too many "
                  "in the reference, also with `--legacy`)"],
        "foam": ["material: foam is a deviatoric neo-Hookean solid with Herschel-Bulkley flow "
                 "(reference: Hencky strain, with a factor of the stretch too many)"],
        "snow": ["material: snow is Stomakhin's law with its usual hardening (the reference "
                 "computes no stress at all: that is not kept, also with `--legacy`)"],
        "plasticine": ["material: plasticine has the stress of Hencky strain (reference: fixed "
                       "corotated); softened through, it still resists compression"],
    }.get(name, [])  # fmt: skip
    if name == "metal" and config.xi and not config.hardening:
        notes.append(f"xi: {config.xi:g} not used, since `hardening` is 0")
    used = _USED[name]
    idle = [k for k in _ALL_USED if k in config.given and k not in used]
    if idle:
        notes.append(f"{', '.join(idle)}: not used by {name}")
    return notes


_LAWS = {
    "jelly": "fixed-corotated",
    "metal": "stvk-hencky",
    "sand": "stvk-hencky",
    "foam": "dev-vol-neo-hookean",
    "snow": "snow",
    "plasticine": "stvk-hencky",
}
_USED = {
    "jelly": (),
    "metal": ("yield_stress", "hardening", "xi"),
    "sand": ("friction_angle",),
    "foam": ("yield_stress", "plastic_viscosity"),
    "snow": (),
    "plasticine": ("yield_stress", "softening"),
}
_ALL_USED = tuple(dict.fromkeys(key for keys in _USED.values() for key in keys))
