"""Materials of scene files: every law, every flow, fibres, values per Gaussian, mistakes."""

import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scene_files import GRID, MODEL, planned, write

from pgjax import models, simulate
from pgjax.scenes import SceneError, read_scene
from pgjax.scenes.fibres import Sine

MODULI = "E = 2e4\nnu = 0.3\n"
DENSITY = "density = 500\n"


def material(law, *lines):
    return "\n".join(["[[material]]", f'law = "{law}"', DENSITY, *lines])


HENCKY = models.StVKHencky(2e4, 0.3)
SOLIDS = {
    "fixed-corotated": models.FixedCorotated(2e4, 0.3),
    "stvk-hencky": HENCKY,
    "neo-hookean": models.NeoHookean(2e4, 0.3),
    "dev-vol-neo-hookean": models.DevVolNeoHookean(2e4, 0.3),
}
CASES = {
    **{material(name, MODULI): models.Material(law, None, 500.0) for name, law in SOLIDS.items()},
    **{
        material(name, MODULI, "damping_viscosity = 3"): models.Material(
            models.KelvinVoigt(law, 3.0), None, 500.0
        )
        for name, law in SOLIDS.items()
    },
    material("fluid", "bulk_modulus = 1e4"): models.Material(models.Fluid(1e4), None, 500.0),
    material("fluid", "bulk_modulus = 1e4", "viscosity = 0.5", "gamma = 5"): models.Material(
        models.Fluid(1e4, 0.5, 5.0), None, 500.0
    ),
    material("snow", MODULI): models.Material(models.Snow(2e4, 0.3), None, 500.0),
    material(
        "snow",
        MODULI,
        "hardening = 7",
        "critical_compression = 0.02",
        "critical_stretch = 0.01",
        "damping_viscosity = 1",
    ): models.Material(
        models.KelvinVoigt(models.Snow(2e4, 0.3, 7.0), 1.0),
        models.CriticalStretches(0.02, 0.01),
        500.0,
    ),
    material(
        "stvk-hencky",
        MODULI,
        'plasticity = { type = "drucker-prager", friction_angle = 35 }',
    ): models.Material(HENCKY, models.DruckerPrager(35.0), 500.0),
    material(
        "stvk-hencky",
        MODULI,
        'plasticity = { type = "drucker-prager", friction_angle = 35, cohesion = 0.001, '
        "volume_correction = true }",
    ): models.Material(HENCKY, models.DruckerPrager(35.0, 0.001, volume_correction=True), 500.0),
    material(
        "stvk-hencky", MODULI, 'plasticity = { type = "von-mises", yield_stress = 200 }'
    ): models.Material(HENCKY, models.VonMises(200.0), 500.0),
    material(
        "stvk-hencky",
        MODULI,
        'plasticity = { type = "von-mises", yield_stress = 200, hardening = 0.1 }',
    ): models.Material(HENCKY, models.VonMises(200.0, 0.1), 500.0),
    material(
        "stvk-hencky",
        MODULI,
        "damping_viscosity = 2",
        'plasticity = { type = "von-mises", yield_stress = 200, softening = 0.1 }',
    ): models.Material(models.KelvinVoigt(HENCKY, 2.0), models.VonMises(200.0, None, 0.1), 500.0),
    material(
        "dev-vol-neo-hookean",
        MODULI,
        'plasticity = { type = "herschel-bulkley", yield_stress = 20, viscosity = 5 }',
    ): models.Material(SOLIDS["dev-vol-neo-hookean"], models.HerschelBulkley(20.0, 5.0), 500.0),
    material(
        "dev-vol-neo-hookean",
        MODULI,
        'plasticity = { type = "herschel-bulkley", yield_stress = 20, viscosity = 5, h = 0.5 }',
    ): models.Material(
        SOLIDS["dev-vol-neo-hookean"], models.HerschelBulkley(20.0, 5.0, 0.5), 500.0
    ),
    material(
        "neo-hookean", MODULI, "active = { direction = [0, 0, 2], activation = 3e3 }"
    ): models.Material(
        SOLIDS["neo-hookean"], None, 500.0, models.ActiveStress((0.0, 0.0, 2.0), 3e3)
    ),
    material(
        "fluid",
        "bulk_modulus = 1e4",
        "active = { direction = [1, 0, 0], activation = -1e3, frequency = 2, phase = 90 }",
    ): models.Material(
        models.Fluid(1e4),
        None,
        500.0,
        models.ActiveStress((1.0, 0.0, 0.0), -1e3, Sine(2.0, np.pi / 2)),
    ),
}


@pytest.mark.parametrize("text", CASES)
def test_every_law(tmp_path, text):
    """What the file says is what Python would make."""
    (part,) = read_scene(write(tmp_path, MODEL, GRID, text)).materials
    expected = CASES[text]
    assert eqx.tree_equal(part.material, expected, rtol=1e-12)


def test_a_sine_in_time():
    signal = Sine(2.0, np.pi / 6)
    np.testing.assert_allclose(signal(jnp.asarray(0.0)), 0.5, rtol=1e-12)
    np.testing.assert_allclose(signal(jnp.asarray(1 / 12)), np.sin(np.pi / 3 + np.pi / 6))


PER_GAUSSIAN = {
    'E = { file = "a.npy" }': lambda m: m.elasticity.E,
    'nu = { file = "nu.npy" }': lambda m: m.elasticity.nu,
    'density = { file = "a.npy" }': lambda m: m.density,
}


@pytest.mark.parametrize("key", PER_GAUSSIAN)
def test_numbers_from_a_file(tmp_path, key):
    values = np.linspace(1e4, 2e4, 200)
    np.save(tmp_path / "a.npy", values)
    np.save(tmp_path / "nu.npy", values / 1e5)
    name = key.split(" ")[0]
    lines = {"E": "E = 2e4", "nu": "nu = 0.3", "density": "density = 500", name: key}
    text = "\n".join(['[[material]]\nlaw = "neo-hookean"', *lines.values()])
    p = planned(tmp_path, MODEL, GRID, text)
    expected = values / 1e5 if name == "nu" else values
    np.testing.assert_allclose(PER_GAUSSIAN[key](p.scene.materials[0]), expected)


EVERYWHERE = [
    ("stvk-hencky", "damping_viscosity = {f}", lambda m: m.elasticity.viscosity),
    ("snow", "hardening = {f}", lambda m: m.elasticity.hardening),
    ("snow", "critical_compression = {f}", lambda m: m.plasticity.critical_compression),
    ("snow", "critical_stretch = {f}", lambda m: m.plasticity.critical_stretch),
    (
        "stvk-hencky",
        'plasticity = {{ type = "von-mises", yield_stress = {f}, softening = {f} }}',
        lambda m: m.plasticity.softening,
    ),
    (
        "stvk-hencky",
        'plasticity = {{ type = "drucker-prager", friction_angle = {f}, cohesion = {f} }}',
        lambda m: m.plasticity.cohesion,
    ),
    (
        "dev-vol-neo-hookean",
        'plasticity = {{ type = "herschel-bulkley", yield_stress = {f}, viscosity = 1, h = {f} }}',
        lambda m: m.plasticity.h,
    ),
    (
        "neo-hookean",
        "active = {{ direction = [0, 0, 1], activation = {f} }}",
        lambda m: m.active.activation,
    ),
    (
        "neo-hookean",
        "active = {{ direction = [0, 0, 1], activation = 1, frequency = {f}, phase = {f} }}",
        lambda m: m.active.signal.frequency,
    ),
]


@pytest.mark.parametrize(
    ("law", "line", "get"),
    [
        e if i % 3 == 0 else pytest.param(*e, marks=pytest.mark.slow)
        for i, e in enumerate(EVERYWHERE)
    ],
)
def test_every_parameter_may_be_a_file(tmp_path, law, line, get):
    """And a step of the simulation takes it."""
    values = np.linspace(0.2, 0.4, 200)
    np.save(tmp_path / "f.npy", values)
    text = material(law, MODULI, line.format(f='{ file = "f.npy" }'))
    p = planned(tmp_path, MODEL, GRID, text)
    np.testing.assert_allclose(get(p.scene.materials[0]), values)
    moved = simulate(p.scene, p.state, dt=p.dt, frames=1, substeps=1).final
    assert bool(moved.status.ok)


def test_directions_from_a_file(tmp_path):
    directions = np.random.default_rng(0).normal(size=(200, 3))
    np.save(tmp_path / "d.npy", directions)
    text = 'active = { direction = { file = "d.npy" }, activation = 1e3, frequency = 1 }'
    p = planned(tmp_path, MODEL, GRID, material("neo-hookean", MODULI, text))
    np.testing.assert_allclose(p.scene.materials[0].active.direction, directions)
    moved = simulate(p.scene, p.state, dt=p.dt, frames=1, substeps=2).final
    assert bool(moved.status.ok)
    assert float(np.abs(moved.v).max()) > 0


def test_fibres_pull(tmp_path):
    """With a constant activation the ball contracts along the fibres."""
    text = material("neo-hookean", MODULI, "active = { direction = [0, 0, 1], activation = 5e3 }")
    p = planned(tmp_path, MODEL, GRID, text)
    moved = simulate(p.scene, p.state, dt=p.dt, frames=1, substeps=p.substeps).final
    before, after = np.ptp(np.asarray(p.state.x), axis=0), np.ptp(np.asarray(moved.x), axis=0)
    assert after[2] < before[2]
    assert after[2] / before[2] < after[0] / before[0]


MISTAKES = [
    ('law = "jelly"', "be one of fixed-corotated, stvk-hencky, neo-hookean, dev-vol-neo-hookean, "),
    ('law = "fluidd"', "did you mean `fluid`?"),
    ('law = "fluid"\nE = 1e4', "`bulk_modulus` is missing"),
    (
        'law = "fluid"\nbulk_modulus = 1e4\nnu = 0.3',
        '`nu` is not a known key with law = "fluid"; allowed are law, bulk_modulus, viscosity, '
        "gamma, density, active, model, region",
    ),
    (
        'law = "fluid"\nbulk_modulus = 1e4\nplasticity = { type = "von-mises", yield_stress = 1 }',
        '`plasticity` is not a known key with law = "fluid"',
    ),
    ('law = "fluid"\nbulk_modulus = 1e4\nviscsity = 1', "did you mean `viscosity`?"),
    ('law = "fluid"\nbulk_modulus = 1e4\nviscosity = -1', "`viscosity` must be a finite number at"),
    ('law = "fluid"\nbulk_modulus = 1e4\ngamma = 1', "`gamma` must be a finite number above 1"),
    ('law = "fluid"\nbulk_modulus = 0', "`bulk_modulus` must be a finite number above 0"),
    ('law = "snow"\nE = 1\nnu = 0.2\ncritical_compression = 1', "at least 0 and below 1"),
    ('law = "snow"\nE = 1\nnu = 0.2\nhardening = -1', "`hardening` must be a finite number"),
    ('law = "neo-hookean"\nE = 1\nnu = 0.2\nhardening = 1', "`hardening` is not a known key with"),
    ('law = "neo-hookean"\nE = 1e999\nnu = 0.2', "`E` must be a finite number above 0"),
    ('law = "neo-hookean"\nE = 1' + "0" * 400 + "\nnu = 0.2", "`E` must be a finite number above"),
    ('law = "neo-hookean"\nE = nan\nnu = 0.2', "`E` must be a finite number above 0"),
    ('law = "neo-hookean"\nE = true\nnu = 0.2', "`E` must be a number"),
    (
        'law = "stvk-hencky"\nE = 1\nnu = 0.2\nplasticity = { type = "vonmises" }',
        "be one of drucker-prager, von-mises, herschel-bulkley (did you mean `von-mises`?)",
    ),
    (
        'law = "stvk-hencky"\nE = 1\nnu = 0.2\nplasticity = { type = "herschel-bulkley" }',
        'must go with law = "stvk-hencky", as it does with "dev-vol-neo-hookean"',
    ),
    (
        'law = "stvk-hencky"\nE = 1\nnu = 0.2\n'
        'plasticity = { type = "von-mises", yield_stress = 1, hardening = 1, softening = 1 }',
        "`softening` must be left out where `hardening` is given",
    ),
    (
        'law = "stvk-hencky"\nE = 1\nnu = 0.2\n'
        'plasticity = { type = "drucker-prager", friction_angle = 90 }',
        "`friction_angle` must be a finite number at least 0 and below 90",
    ),
    (
        'law = "stvk-hencky"\nE = 1\nnu = 0.2\n'
        'plasticity = { type = "drucker-prager", friction_angle = 9, yield_stress = 1 }',
        '`yield_stress` is not a known key with type = "drucker-prager"',
    ),
    ('law = "stvk-hencky"\nE = 1\nnu = 0.2\nplasticity = "von-mises"', "`plasticity` must be a t"),
    (
        'law = "neo-hookean"\nE = 1\nnu = 0.2\nactive = { direction = [0, 0, 0], activation = 1 }',
        "[active]: Argument `direction` must not be zero",
    ),
    (
        'law = "neo-hookean"\nE = 1\nnu = 0.2\n'
        "active = { direction = [0, 0, 1], activation = 1, phase = 10 }",
        "`phase` must be left out where there is no `frequency`",
    ),
    (
        'law = "neo-hookean"\nE = 1\nnu = 0.2\nactive = { direction = [0, 0, 1], actvation = 1 }',
        "[active]: `activation` is missing (is `actvation` meant?)",
    ),
    ('law = "neo-hookean"\nE = { file = "E.npy" }\nnu = 0.2', "[E]: `file` must name a file"),
    ('law = "neo-hookean"\nE = { fil = "E.npy" }\nnu = 0.2', "is `fil` meant?"),
    (
        'law = "neo-hookean"\nE = { file = "bad.npy", scale = 2 }\nnu = 0.2',
        "`file` = 'bad.npy' must hold numbers, each a finite number above 0, but value 3 is -1.0",
    ),
    (
        'law = "neo-hookean"\nE = { file = "ok.npy", scale = 2 }\nnu = 0.2',
        "[E]: `scale` is not a known key; allowed are file",
    ),
    (
        'law = "neo-hookean"\nE = 1\nnu = { file = "ok.npy" }',
        "each a finite number above -1 and below 0.5, but value 0 is 1.0 (5 are not)",
    ),
    (
        'law = "neo-hookean"\nE = { file = "text.npy" }\nnu = 0.2',
        "must hold numbers, but holds <U1",
    ),
    (
        'law = "neo-hookean"\nE = 1\nnu = 0.2\n'
        'active = { direction = { file = "ok.npy" }, activation = 1 }',
        "must have the shape n x 3, but has (5,)",
    ),
    ('law = "neo-hookean"\nE = 1\nnu = 0.2\nmodel = "apple"', "but none has one, but is 'apple'"),
]


@pytest.mark.parametrize(("lines", "words"), MISTAKES)
def test_mistakes(tmp_path, lines, words):
    np.save(tmp_path / "bad.npy", np.array([1.0, 2, 3, -1, np.nan]))
    np.save(tmp_path / "ok.npy", np.ones(5))
    np.save(tmp_path / "text.npy", np.array(["a"] * 5))
    text = f"[[material]]\ndensity = 1\n{lines}"
    with pytest.raises(SceneError, match=re.escape(words)) as error:
        read_scene(write(tmp_path, MODEL, GRID, text))
    assert str(error.value).startswith("scene.toml [[material]] 1")


def test_values_of_a_wrong_number(tmp_path):
    np.save(tmp_path / "E.npy", np.ones(5))
    text = material("neo-hookean", 'E = { file = "E.npy" }', "nu = 0.2")
    with pytest.raises(SceneError, match=r"each of the 200 Gaussians of .*ball\.ply, but"):
        planned(tmp_path, MODEL, GRID, text)
