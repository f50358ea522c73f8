"""The cases of the table, from the literature.

"elastic", "Newtonian", "plasticine", "sand" and "Herschel-Bulkley" follow the synthetic scenes of
X. Li et al., "PAC-NeRF", ICLR 2023: a body is thrown at a sticky floor before eleven cameras.
"tumbling" follows P. Ma et al., "NCLaw", ICML 2023; "dam break" follows "JAX-MPM" (2025).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import pgjax
from benchmarks.identification.bodies import Resolution, tilted_block
from benchmarks.identification.case import Case, Target
from pgjax import models, sampling
from pgjax.boundary import AbstractGridCondition, Box, Separating, Sticky
from pgjax.inverse import Parameter, Stage, moduli
from pgjax.models import Material

GRAVITY = (0.0, 0.0, -9.8)
SPEED = Target("absolute", 1e-3, 3e-3)


# A wall acts before its nodes, by so many cells: half for an edge, 0.8 for a face (see the docs).
BEHIND = 0.6


def _on_floor(volumes, materials, resolution: Resolution, **settings) -> pgjax.Scene:
    """A scene with a sticky floor that acts at z = 0."""
    floor = -BEHIND * resolution.h
    return pgjax.Scene(
        resolution.grid((-0.5, -0.5, -0.02), (0.5, 0.5, 0.9), above=floor),
        materials,
        volumes,
        gravity=GRAVITY,
        boundaries=[Box((-9.0, -9.0, floor), (9.0, 9.0, 9.0), Sticky())],
        spline=pgjax.BSpline(resolution.spline),
        scheme=pgjax.MLS(),
        **settings,
    )


def _thrown(material_of, height, size=(0.3, 0.22, 0.26)):
    """A tilted block thrown at a sticky floor: the build of a picture case."""

    def build(resolution: Resolution):
        x, volumes = tilted_block(size, (0.0, 0.0, height), resolution)

        def of(values):
            scene = _on_floor(volumes, material_of(values), resolution)
            return scene, pgjax.initial_state(scene, x, values["v0"])

        return x, of

    return build


def _velocity(start=(0.0, 0.0, -1.0)):
    return Parameter(start, lower=-4.0, upper=4.0, unit="m/s")


def _pictured(name, truth, parameters, material_of, targets, **settings) -> Case:
    """A body thrown at the floor, 14 frames at 24 per second.

    First v0, from the frame before the contact, and kept: errors of the model of the contact must
    not bend it. Then the material, through squares of pixels and through pixels.
    """
    truth = {**truth, "v0": np.array(settings.pop("v0", (0.3, -0.2, -2.0)))}
    stages = (
        Stage(frames=1, free=("v0",), coarser=8),
        Stage(frames=1, free=("v0",), keep=True),
        Stage(frames=6, free=tuple(parameters), coarser=8),
        Stage(free=tuple(parameters), coarser=8),
    )
    settings = {"stages": stages, "views": 11} | settings
    return Case(
        name=name,
        truth=truth,
        parameters={**parameters, "v0": _velocity()},
        # So high that the first frame is before the contact.
        build=_thrown(material_of, settings.pop("height", 0.4)),
        resolution=Resolution(settings.pop("cells", 30)),
        frames=14,
        frame_dt=1 / 24,
        targets={**targets, "v0": SPEED},
        watched=((0.0, 0.0, 0.2), 1.7),
        **settings,
    )


def _elastic(E: float, name: str) -> Case:
    return _pictured(
        name,
        {"E": E, "nu": 0.3},
        {
            "E": Parameter(1.5e5, lower=5e4, upper=2 * E, log=True, unit="Pa"),
            "nu": Parameter(0.2, lower=0.0, upper=0.42),
        },
        lambda v: Material(models.FixedCorotated(v["E"], v["nu"])),
        {"E": Target("log10", 3e-3, 3e-2), "nu": Target("absolute", 3e-3, 2e-2)},
        cells=32,
        # So that the rebound stays before the cameras.
        v0=(0.3, 0.4, -1.0),
        height=0.32,
    )


def _newtonian() -> Case:
    return _pictured(
        "Newtonian drop",
        {"viscosity": 200.0, "kappa": 1e5},
        {
            "viscosity": Parameter(50.0, lower=5.0, upper=500.0, log=True, unit="Pa s"),
            "kappa": Parameter(4e4, lower=1e4, upper=2e5, log=True, unit="Pa"),
        },
        lambda v: Material(models.Fluid(v["kappa"], v["viscosity"])),
        {"viscosity": Target("log10", 3e-3, 3e-2), "kappa": Target("log10", 5e-2, None)},
    )


def _herschel_bulkley() -> Case:
    def material(v):
        law = models.DevVolNeoHookean(**moduli(mu=v["mu"], kappa=v["kappa"]))
        return Material(law, models.HerschelBulkley(v["yield_stress"], v["eta"]))

    return _pictured(
        "Herschel-Bulkley",
        {"mu": 1e4, "kappa": 1e6, "yield_stress": 3e3, "eta": 10.0},
        {
            "mu": Parameter(3e4, lower=2e3, upper=1e5, log=True, unit="Pa"),
            "kappa": Parameter(4e5, lower=1e5, upper=2e6, log=True, unit="Pa"),
            "yield_stress": Parameter(1e3, lower=100.0, upper=2e4, log=True, unit="Pa"),
            "eta": Parameter(30.0, lower=1.0, upper=300.0, log=True, unit="Pa s"),
        },
        material,
        {
            "mu": Target("log10", 5e-2, None),
            "kappa": Target("log10", 1e-1, None),
            "yield_stress": Target("log10", 1e-2, 2e-2),
            "eta": Target("log10", 5e-2, 0.15),
        },
    )


def _plasticine() -> Case:
    def material(v):
        return Material(models.StVKHencky(v["E"], v["nu"]), models.VonMises(v["yield_stress"]))

    return _pictured(
        "plasticine",
        {"E": 2e6, "nu": 0.3, "yield_stress": 1.54e4},
        {
            "E": Parameter(1e6, lower=2e5, upper=3e6, log=True, unit="Pa"),
            "nu": Parameter(0.2, lower=0.0, upper=0.4),
            "yield_stress": Parameter(5e3, lower=500.0, upper=1e5, log=True, unit="Pa"),
        },
        material,
        {
            "E": Target("log10", 2e-2, 0.2),
            "nu": Target("absolute", 2e-2, None),
            "yield_stress": Target("log10", 1e-2, 5e-2),
        },
    )


def _sand() -> Case:
    def material(v):
        return Material(models.StVKHencky(1e6, 0.2), models.DruckerPrager(v["friction_angle"]))

    return _pictured(
        "sand",
        {"friction_angle": 40.0},
        {"friction_angle": Parameter(25.0, lower=5.0, upper=60.0, unit="degrees")},
        material,
        {"friction_angle": Target("absolute", 0.1, 0.5)},
    )


def _heterogeneous() -> Case:
    """Two moduli in the two halves of a block."""

    def build(resolution: Resolution):
        x, volumes = tilted_block((0.36, 0.2, 0.2), (0.0, 0.0, 0.34), resolution)
        order = np.argsort(x[:, 0] > 0, kind="stable")
        x, half = x[order], int(np.sum(x[:, 0] <= 0))

        def of(values):
            scene = _on_floor(
                volumes,
                [Material(models.FixedCorotated(values[n], 0.3)) for n in ("E1", "E2")],
                resolution,
                counts=(half, len(x) - half),
            )
            return scene, pgjax.initial_state(scene, x, (0.3, 0.4, -1.0))

        return x, of

    modulus = Parameter(3e5, lower=5e4, upper=2e6, log=True, unit="Pa")
    return Case(
        name="heterogeneous body",
        truth={"E1": 2e5, "E2": 1e6},
        parameters={"E1": modulus, "E2": modulus},
        build=build,
        resolution=Resolution(30),
        frames=14,
        frame_dt=1 / 24,
        targets={n: Target("log10", 1e-2, 5e-2) for n in ("E1", "E2")},
        stages=(Stage(frames=6, coarser=8),),
        views=11,
        watched=((0.0, 0.0, 0.2), 1.7),
    )


def _tumbling(name, truth, parameters, material_of, targets) -> Case:
    """A cube of 1000 particles tumbling in a box of 20³ cells: 1000 steps of 5e-4 s."""

    def build(resolution: Resolution):
        center, edge = np.full(3, 0.5), 0.25
        x, volumes = sampling.block(center - edge / 2, center + edge / 2, resolution.h / 2)
        x = center + resolution.jittered(x - center)
        # The walls act at 0.1 and, to 0.2 cells, at 0.9: their nodes are 17 cells apart here.
        behind = BEHIND * resolution.h
        grid = pgjax.Grid((-behind,) * 3, (resolution.cells + 2,) * 3, resolution.h)
        width = (np.round(0.8 * resolution.cells) + 1) * resolution.h
        walls = Box((0.1 - behind,) * 3, (0.1 - behind + width,) * 3, Separating(0.0))

        def of(values):
            scene = pgjax.Scene(
                grid,
                material_of(values),
                volumes,
                gravity=GRAVITY,
                boundaries=[walls],
                spline=pgjax.BSpline(resolution.spline),
                scheme=pgjax.MLS(),
            )
            omega = values["omega0"]
            v = values["v0"][None] + jnp.cross(omega[None], jnp.asarray(x - center, omega.dtype))
            spin = jnp.cross(jnp.eye(3, dtype=omega.dtype), -omega[None]).T
            return scene, pgjax.initial_state(scene, x, v, C=jnp.broadcast_to(spin, (len(x), 3, 3)))

        return x, of

    relative = Target("relative", 1e-4, 5e-2)
    return Case(
        name=f"tumbling {name}",
        truth={**truth, "v0": np.array([1.0, -1.5, -2.0]), "omega0": np.array([4.0, 4.0, 4.0])},
        parameters={
            **parameters,
            "v0": Parameter((0.5, -1.0, -1.5), lower=-4.0, upper=4.0, unit="m/s"),
            "omega0": Parameter((2.0, 2.0, 2.0), lower=-10.0, upper=10.0, unit="1/s"),
        },
        build=build,
        resolution=Resolution(20),
        frames=50,
        frame_dt=1e-2,
        targets={**dict.fromkeys(truth, relative), **targets, "v0": relative, "omega0": relative},
        stages=(
            # A spinning body widens as its stiffness lets it, so that its spin is not known before.
            Stage(frames=5, free=("v0", "omega0")),
            Stage(frames=5, free=("v0",), keep=True),
            Stage(frames=20, free=(*truth, "omega0")),
        ),
        substeps=20,
        double=True,
        trials=15,
        limit=10,
    )


def _solid(E: float, nu: float):
    return {
        "E": Parameter(E / 3, lower=E / 20, upper=1.5 * E, log=True, unit="Pa"),
        "nu": Parameter(0.3 if nu < 0.25 else 0.35, lower=0.0, upper=0.4),
    }


def _tumbling_cases() -> list[Case]:
    return [
        _tumbling(
            "jelly",
            {"E": 1e5, "nu": 0.2},
            _solid(1e5, 0.2),
            lambda v: Material(models.FixedCorotated(v["E"], v["nu"])),
            {},
        ),
        _tumbling(
            "plasticine",
            {"E": 3e5, "nu": 0.25, "yield_stress": 5e3},
            {
                **_solid(3e5, 0.25),
                "yield_stress": Parameter(1.5e3, lower=100.0, upper=5e4, log=True, unit="Pa"),
            },
            lambda v: Material(
                models.StVKHencky(v["E"], v["nu"]), models.VonMises(v["yield_stress"])
            ),
            {},
        ),
        _tumbling(
            "sand",
            {"E": 1e6, "nu": 0.2, "friction_angle": 25.0},
            {
                **_solid(1e6, 0.2),
                "friction_angle": Parameter(35.0, lower=5.0, upper=60.0, unit="degrees"),
            },
            lambda v: Material(
                models.StVKHencky(v["E"], v["nu"]), models.DruckerPrager(v["friction_angle"])
            ),
            {},
        ),
        _tumbling(
            "water",
            {"kappa": 8.3e4},
            {"kappa": Parameter(3e4, lower=5e3, upper=1.5e5, log=True, unit="Pa")},
            lambda v: Material(models.Fluid(v["kappa"])),
            {},
        ),
    ]


class Bands(AbstractGridCondition):
    """A floor at y = 0 whose friction differs from band to band along x."""

    friction: jax.Array
    width: float = eqx.field(static=True)

    def __call__(self, x, v, t):
        """Coulomb friction of the band the node is in."""
        del t
        count = self.friction.shape[0]
        # Nodes lie on the edges of the bands: rounding must not decide.
        band = jnp.clip(jnp.floor(x[0] / self.width + 1e-6).astype(int), 0, count - 1)
        held = Separating(self.friction[band])(v, jnp.asarray([0.0, 1.0], v.dtype))
        return jnp.where(x[1] <= 1e-6, held, v)


def _dam_break(seen: int) -> Case:
    """A column of water runs over five bands of a floor in two dimensions; the first is smooth.

    The stages follow the front from band to band.
    """
    bands = ("friction2", "friction3", "friction4", "friction5")

    def build(resolution: Resolution):
        x, volumes = sampling.block((0.0, 0.0), (1.0, 0.6), resolution.h / 2)
        x = np.maximum(resolution.jittered(x), 1e-6)
        grid = resolution.grid((-0.05, -0.05), (5.0, 1.2))
        walls = Box((0.0, -1.0), (5.0, 9.0), Separating(0.0))

        def of(values):
            friction = jnp.stack([jnp.zeros_like(values[bands[0]]), *(values[b] for b in bands)])
            scene = pgjax.Scene(
                grid,
                Material(models.Fluid(2e5, 1e-3)),
                volumes,
                gravity=(0.0, -9.8),
                boundaries=[Bands(friction, 0.8), walls],
                spline=pgjax.BSpline(resolution.spline),
                scheme=pgjax.MLS(),
            )
            return scene, pgjax.initial_state(scene, x)

        return x, of

    return Case(
        name=f"dam break, {seen} particles seen",
        truth=dict(zip(bands, (0.5, 0.1, 0.2, 0.0), strict=True)),
        parameters={band: Parameter(0.25, lower=0.0, upper=1.0) for band in bands},
        build=build,
        resolution=Resolution(25),
        frames=30,
        frame_dt=0.04,
        targets={band: Target("absolute", 5e-3, 2e-2) for band in bands},
        stages=tuple(Stage(frames=7 + 5 * k, free=(band,)) for k, band in enumerate(bands)),
        seen=seen,
        double=True,
        trials=15,
        limit=15,
    )


def all_cases() -> dict[str, Case]:
    """By name, in the order of the table."""
    cases = [
        _elastic(1e6, "elastic, E = 1e6"),
        _elastic(3e5, "elastic, E = 3e5"),
        _newtonian(),
        _herschel_bulkley(),
        _plasticine(),
        _sand(),
        *_tumbling_cases(),
        _dam_break(100),
        _dam_break(500),
        _heterogeneous(),
    ]
    return {case.name: case for case in cases}
