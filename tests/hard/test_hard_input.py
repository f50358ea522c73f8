"""Hard input: what is not a number, not positive, of another type, broken in the file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

import pgjax
import pgjax.models as pm
from hard.bodies import (
    MATERIALS,
    NU,
    E,
    H,
    N,
    block,
    is_finite,
    largest,
    motion,
    run,
    tolerance,
    world,
)
from pgjax import boundary
from pgjax.render import load_ply
from pgjax.render.ply import columns

BAD = (np.nan, np.inf, -np.inf)


def spoilt(count, value, at=5):
    """Ones, with another value in one place."""
    values = np.ones(count)
    values[at] = value
    return values


# --- Not a number ---------------------------------------------------------------------------------

HENCKY = pm.StVKHencky(E, NU)
PER_PARTICLE = {
    "volumes": lambda a: pgjax.Scene(pgjax.Grid((0, 0), (N, N), H), MATERIALS["sand"], a),
    "density": lambda a: pm.Material(HENCKY, density=a),
    "E": lambda a: pm.NeoHookean(a, NU),
    "nu": lambda a: pm.NeoHookean(E, 0.3 * a),
    "yield_stress": lambda a: pm.VonMises(a),
    "hardening": lambda a: pm.VonMises(1.0, a),
    "friction_angle": lambda a: pm.DruckerPrager(30 * a),
    "cohesion": lambda a: pm.DruckerPrager(30.0, a),
    "viscosity": lambda a: pm.HerschelBulkley(1.0, a),
    "h": lambda a: pm.HerschelBulkley(1.0, 1.0, a),
}
# Infinite strength and viscosity are limits with a meaning: elastic.
LIMITS = {"yield_stress", "viscosity"}


@pytest.mark.parametrize("name", PER_PARTICLE)
@pytest.mark.parametrize("bad", BAD)
def test_h21_values_per_particle_that_are_not_finite(name, bad, holds):
    """The field and the first index are named."""
    if name in LIMITS and bad == np.inf:
        pytest.skip("the limit of an elastic material")
    with pytest.raises(ValueError, match=rf"`{name}` must .*, but is -?(nan|inf) at index \(5,\)"):
        PER_PARTICLE[name](spoilt(8, bad))
    holds("H21", outcome="refused")


SINGLE = {
    "origin": lambda a: pgjax.Grid((0.0, a), (N, N), H),
    "h": lambda a: pgjax.Grid((0.0, 0.0), (N, N), a),
    "gravity": lambda a: world("sand", block(), gravity=(0.0, a)),
    "friction": lambda a: boundary.Separating(a),
    "upper": lambda a: boundary.Box((0.0, 0.0), (1.0, a)),
    "center": lambda a: boundary.Sphere((0.0, a), 1.0),
    "radius": lambda a: boundary.Sphere((0.0, 0.0), a),
    "normal": lambda a: boundary.HalfSpace((0.0, 0.0), (0.0, a)),
    "velocity": lambda a: boundary.Steady((0.0, a)),
    "momentum": lambda a: boundary.ParticleImpulse(np.ones(8, bool), (0.0, a)),
}


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("bad", BAD)
def test_h21_single_values_that_are_not_finite(name, bad, holds):
    if name == "upper" and bad == np.inf:
        pytest.skip("a wall that is nowhere")
    with pytest.raises(ValueError, match=rf"Argument `{name}` must .*but is"):
        SINGLE[name](bad)
    holds("H21", outcome="refused")


@pytest.mark.parametrize("name", ["grid_damping", "shear_damping"])
@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_h21_damping_that_is_not_a_rate(name, bad, holds):
    with pytest.raises(ValueError, match=f"Argument `{name}` must be at least 0 .*but is"):
        world("sand", block(), **{name: bad})
    holds("H21", outcome="refused")


@pytest.mark.parametrize("value", [0.0, -0.0, -1e-300, -1.0])
@pytest.mark.parametrize("name", ["volumes", "density", "E"])
def test_h27_no_mass_and_no_volume(name, value, holds):
    with pytest.raises(ValueError, match=rf"`{name}` must be positive.*at index \(5,\)"):
        PER_PARTICLE[name](spoilt(8, value))
    holds("H27", outcome="refused")


# --- Limits of the parameters ---------------------------------------------------------------------


def rolled(material, steps=60):
    """A block thrown into a trough, after so many steps; finite."""
    x = block(center=(0.55, 0.4))
    floor = boundary.Box((1.5 * H, 2 * H), (9.5 * H, 9.0), boundary.Separating(0.5))
    scene = world(material, x, walls=floor, gravity=(0.0, -9.8))
    state = pgjax.initial_state(scene, x, (0.3, -1.0))
    end = run(scene, state, pgjax.stable_dt(scene), steps)
    assert is_finite(end)
    assert bool(end.status.ok)
    return end


def test_h40_infinite_strength_is_elastic(holds):
    """Metal and paste that cannot yield, and paste that is too viscous to, are elastic."""
    devvol = pm.DevVolNeoHookean(E, NU)
    for law, plasticity in (
        (HENCKY, pm.VonMises(np.inf)),
        (devvol, pm.HerschelBulkley(np.inf, 10.0)),
        (devvol, pm.HerschelBulkley(50.0, np.inf)),
    ):
        elastic, plastic = rolled(pm.Material(law)), rolled(pm.Material(law, plasticity))
        assert largest(elastic.He) > 0.01
        for a, b in zip(motion(elastic), motion(plastic), strict=True):
            assert largest(b - a) < tolerance(1e-10, 1e-3) * max(1, largest(a))
        holds("H40", material=type(plasticity).__name__)


@pytest.mark.parametrize("strength", [0.0, 1e-12])
@pytest.mark.parametrize("viscosity", [None, 0.0, 10.0])
def test_h40_no_strength_flows(strength, viscosity, holds):
    """What cannot bear shear spreads in the trough, finite; its stress is a pressure."""
    if viscosity is None:
        material = pm.Material(HENCKY, pm.VonMises(strength))
    else:
        material = pm.Material(pm.DevVolNeoHookean(E, NU), pm.HerschelBulkley(strength, viscosity))
    end = rolled(material)
    law = material.elasticity
    tau = np.asarray(jax.vmap(lambda H: law.kirchhoff(H, jnp.zeros_like(H)))(end.He))
    if not viscosity:
        deviator = tau - np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        assert largest(deviator) < tolerance(1e-9, 1e-2)
    assert largest(tau) > 1.0
    holds("H40", material="metal" if viscosity is None else "paste")


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: pm.VonMises(-1e-12), "yield_stress"),
        (lambda: pm.HerschelBulkley(-1.0, 1.0), "yield_stress"),
        (lambda: pm.HerschelBulkley(1.0, -1e-12), "viscosity"),
        (lambda: pm.DruckerPrager(-1.0), "friction_angle"),
        (lambda: pm.DruckerPrager(90.0), "friction_angle"),
        (lambda: pm.DruckerPrager(30.0, -1e-9), "cohesion"),
    ],
)
def test_h40_negative_strength_is_refused(make, name, holds):
    with pytest.raises(ValueError, match=f"Argument `{name}` must be .*but is"):
        make()
    holds("H40", outcome="refused")


# --- Types ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16, np.int32, np.float64])
def test_h47_other_types_of_input(dtype, holds):
    """Half precision, integers and doubles become the precision of the simulation."""
    x = np.array([[4, 5], [6, 5], [5, 7]])
    grid = pgjax.Grid((0, 0), (N, N), 1)
    scene = pgjax.Scene(grid, MATERIALS["NeoHookean"], np.asarray([1, 2, 1], dtype))
    precision = tolerance(np.float64, np.float32)
    v = np.asarray([1, -1], dtype)
    state = pgjax.initial_state(scene, np.asarray(x, dtype), v)
    exact = pgjax.initial_state(scene, x.astype(float), (1.0, -1.0))
    end, expected = run(scene, state, 1e-3, 3), run(scene, exact, 1e-3, 3)
    for a, b in zip(motion(end), motion(expected), strict=True):
        assert a.dtype == precision
        assert (np.asarray(a) == np.asarray(b)).all()
    holds("H47", material="NeoHookean")


def test_h48_double_precision_that_is_off(holds):
    """Asked for where JAX would silently give single precision."""
    scene = world("NeoHookean", block())
    with jax.enable_x64(False), pytest.raises(ValueError, match="`dtype` must be float32 unless"):
        pgjax.initial_state(scene, block(), dtype=np.float64)
    for dtype in (np.float16, jnp.bfloat16, np.int32, np.complex64):
        with pytest.raises(ValueError, match="`dtype` must be float32 or float64, but is"):
            pgjax.initial_state(scene, block(), dtype=dtype)
    holds("H48", outcome="refused")


# --- Files ----------------------------------------------------------------------------------------


def capture(path, **spoil):
    """Eight Gaussians in a file; `spoil` gives values of single columns of the third."""
    table = np.zeros(8, [(name, "<f4") for name in columns(1)])
    table["x"], table["rot_0"] = np.arange(8), 1
    for i in range(3):
        table[f"scale_{i}"] = -3
    for name, value in spoil.items():
        table[name][2] = value
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return path


@pytest.mark.parametrize(
    "spoil",
    [
        {"rot_1": np.nan},
        {"rot_0": 0.0},
        {"x": np.inf},
        {"opacity": np.nan},
        {"scale_1": np.nan},
        {"scale_1": np.inf},
        {"f_dc_0": np.nan},
    ],
    ids=lambda spoil: "-".join(f"{k}={v}" for k, v in spoil.items()),
)
def test_h56_broken_gaussians_are_counted(spoil, tmp_path, holds):
    """Left out with a warning that says how many; the others are as they were."""
    with pytest.warns(UserWarning, match="1 of the 8 Gaussians"):
        gaussians = load_ply(capture(tmp_path / "broken.ply", **spoil))
    assert len(gaussians) == 7
    assert is_finite(gaussians)
    assert 2.0 not in np.asarray(gaussians.means)[:, 0]
    holds("H56", outcome="left out and counted")


@pytest.mark.parametrize("spoil", [{"scale_0": -np.inf}, {"scale_0": -200.0}, {"opacity": -np.inf}])
def test_h56_flat_and_invisible_gaussians(spoil, tmp_path, recwarn, holds):
    """A scale of 0 is a disc and an opacity of 0 invisible: kept if finite, else counted."""
    gaussians = load_ply(capture(tmp_path / "flat.ply", **spoil))
    counted = [w for w in recwarn if "1 of the 8 Gaussians" in str(w.message)]
    assert len(gaussians) == 8 - len(counted)
    assert is_finite(gaussians)
    assert is_finite(gaussians.covariances)
    holds("H56", outcome="holds")
