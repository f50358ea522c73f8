"""Level 5: single precision (V43), and one motion however it is run (V44; see `test_rollout`)."""

import discs
import equinox as eqx
import jax
import jax.numpy as jnp
import manufactured
import numpy as np
import pytest
import scenes
import variants
from flows import collapse

import pgjax
import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Separating
from pgjax.storage import load_state, save_state

pytestmark = pytest.mark.float64


# --- V43: float32 against float64 ----------------------------------------------------------------


def in_both(run, monkeypatch):
    """What `run` gives in double and in single precision."""
    double = run()
    variants.instead(monkeypatch, variants.in_single_precision)
    return double, run()


def watched(monkeypatch):
    """A list of all that the rollouts from here on observe."""
    seen = []

    def variant(usual):
        def roll(*args):
            result = usual(*args)
            seen.append(scenes.wide(result[1]))
            return result

        return roll

    variants.instead(monkeypatch, variant)
    return seen


def apart(x, y):
    """`max_t RMS |x − y|` over the amplitude of the wave, as its error is measured."""
    square = np.sum(((x - y) / manufactured.AMPLITUDE) ** 2, axis=-1)
    return np.sqrt(np.mean(square, axis=-1)).max()


@pytest.mark.parametrize("n", [pytest.param(16, marks=pytest.mark.slow), 32])
def test_v43_elastic_wave(measure, monkeypatch, n):
    """V24 in two dimensions: its error, and the motion itself."""
    seen = watched(monkeypatch)
    double, single = in_both(lambda: manufactured.error(n, 2, "quadratic-grad"), monkeypatch)
    measure(
        "V43", f"V24, n = {n}: change of the error, over it", abs(single / double - 1), below=2e-3
    )
    off = apart(*seen) / double
    measure("V43", f"V24, n = {n}: float32 − float64, over the error", off, below=2e-3)


@pytest.mark.parametrize("n", [20, pytest.param(40, marks=pytest.mark.slow)])
def test_v43_two_discs(measure, monkeypatch, n):
    """V21: what the energy does, over the part that the grid takes."""

    def run():
        t, total, kinetic, _ = discs.collide(n, "quadratic-grad")
        return total, kinetic, t[kinetic.argmin()]

    double, single = in_both(run, monkeypatch)
    lost = 1 - double[0][-1]
    for what, a, b in zip(("total", "kinetic"), double, single, strict=False):
        off = np.abs(a - b).max() / lost
        measure("V43", f"V21, n = {n}: {what} energy at any time, over that lost", off, below=2e-3)
    off = abs(double[2] - single[2])
    measure("V43", f"V21, n = {n}: time of least kinetic energy, s", off, below=2e-3)


@pytest.mark.parametrize("n", [8, pytest.param(16, marks=pytest.mark.slow)])
def test_v43_column_of_sand(measure, monkeypatch, n):
    """V35: where the sand comes to rest, beside what refinement of the grid changes (0.11)."""
    double, single = in_both(lambda: collapse(1.0, 30.0, n=n), monkeypatch)
    assert single.lost == 0
    for what in ("runout", "height"):
        off = abs(getattr(single, what) - getattr(double, what))
        measure("V43", f"V35, {n} cells: {what}, over the width", off, below=2e-3 * 0.11)
    # Of a body at rest, 4e-6 of the potential energy: only its size.
    ratio = single.energy / double.energy
    measure("V43", f"V35, {n} cells: kinetic energy at the end", ratio, within=(0.9, 1.1))


def test_v43_tells_motions_apart(measure, monkeypatch):
    """Negative control: positions that are off by 1e-3 cells at first."""
    seen = watched(monkeypatch)
    double = manufactured.error(16, 2, "quadratic-grad")
    variants.instead(monkeypatch, variants.nudged(1e-3))
    manufactured.error(16, 2, "quadratic-grad")
    measure("V43", "negative control: start off by 1e-3 cells", apart(*seen) / double, above=2e-3)


# --- V44: one motion, however it is run ----------------------------------------------------------

DT = 1e-3
METAL = pm.Material(pm.StVKHencky(1e4, 0.3), pm.VonMises(50.0, hardening=0.1), density=1000.0)


def falling(friction_angle=30.0):
    """Metal and sand that fall on a rough floor; scene and state."""
    rng = np.random.default_rng(0)
    floor = Collider(HalfSpace([0.0, 0.43], [0.0, 1.0]), Separating(0.3))
    sand = pm.Material(pm.StVKHencky(1e4, 0.3), pm.DruckerPrager(friction_angle), 1000.0)
    scene = pgjax.Scene(
        pgjax.Grid([0.0, 0.0], (12, 12), 0.1),
        [METAL, sand],
        np.full(24, 1e-3),
        counts=(12, 12),
        gravity=[0.0, -9.8],
        boundaries=(floor,),
    )
    return scene, pgjax.initial_state(
        scene, 0.4 + 0.3 * rng.random((24, 2)), rng.normal(size=(24, 2))
    )


def difference(a, b):
    """Largest difference of two trees, each array over its largest entry."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    wide = [(scenes.wide(x), scenes.wide(y)) for x, y in pairs]
    return max(
        np.abs(x - y).max(initial=0) / max(np.abs(y).max(initial=0), 1e-300) for x, y in wide
    )


def bits(tree):
    return [(np.asarray(a).dtype, np.asarray(a).tobytes()) for a in jax.tree.leaves(tree)]


@pytest.mark.slow
def test_v44_plastic_jit_is_eager(measure):
    """One step of metal and sand on a rough floor, compiled operation by operation."""
    scene, state = falling()
    state = pgjax.simulate(scene, state, dt=DT, frames=1, substeps=20).final
    eager = pgjax.step(scene, state, DT)
    jitted = eqx.filter_jit(pgjax.step)(scene, state, DT)
    measure("V44", "jit = eager, a step of metal and sand", difference(jitted, eager), below=1e-13)


def test_v44_plastic_batch_is_separate(measure):
    """`vmap` over angles of friction."""

    def motion(angle):
        return pgjax.simulate(*falling(angle), dt=DT, frames=2, substeps=20).saved

    angles = jnp.asarray([10.0, 25.0, 40.0])
    batch = eqx.filter_jit(jax.vmap(motion))(angles)
    separate = jax.tree.map(lambda *a: jnp.stack(a), *[motion(angle) for angle in angles])
    assert difference(separate.x[0], separate.x[2]) > 1e-6
    gap = difference(batch, separate)
    measure("V44", "vmap over angles of friction = separate, 40 steps", gap, below=1e-13)


@pytest.mark.parametrize(
    "dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.slow)], ids=["f64", "f32"]
)
def test_v44_restart_from_a_file(measure, tmp_path, dtype):
    """State to disk, back, and on: every bit is that of the run in one piece."""
    scene, state = falling()
    state = variants.converted(state, dtype)
    whole = pgjax.simulate(scene, state, dt=DT, frames=4, substeps=5)
    half = pgjax.simulate(scene, state, dt=DT, frames=2, substeps=5)
    save_state(tmp_path / "half.npz", half.final)
    back = load_state(tmp_path / "half.npz", scene)
    rest = pgjax.simulate(scene, back, dt=DT, frames=2, substeps=5)
    same = sum(a != b for a, b in zip(bits(rest.final), bits(whole.final), strict=True))
    measure("V44", f"restart from a file: arrays that differ, {dtype.__name__}", same, below=0)
    assert bits(rest.saved) == bits(jax.tree.map(lambda a: a[2:], whole.saved))
