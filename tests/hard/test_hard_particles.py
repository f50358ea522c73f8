"""Hard states of particles: any deformation, a spin too fast, none, one alone, two in one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from hard.bodies import (
    MATERIALS,
    NU,
    E,
    block,
    every_material,
    is_finite,
    kinetic,
    largest,
    momentum,
    motion,
    run,
    slopes,
    tolerance,
    world,
)
from pgjax.result import Condition

ODD = 14  # The particle that is different.
PRECISE = ("float32", pytest.param("float64", marks=pytest.mark.float64))


def deformed(name, F):
    """A block at rest in which one particle has another deformation, and a stable time step."""
    x = block()
    scene = world(name, x)
    every = np.tile(np.eye(3), (len(x), 1, 1))
    every[ODD] = F
    state = pgjax.initial_state(scene, x, F=every)
    # What is clamped or turned inside out has no smaller limit than it had before.
    return scene, state, min(pgjax.stable_dt(scene, state), 0.2 * pgjax.stable_dt(scene))


def volume_ratio(state):
    return np.linalg.det(np.asarray(state.Fe, np.float64)[ODD])


def survives(name, F, steps=200, *, smooth=True):
    """The state after so many steps: finite, who is lost is counted, derivatives are finite.

    Args:
        smooth: whether derivatives are looked at.
    """
    scene, state, dt = deformed(name, F)
    assert not smooth or is_finite(slopes(scene, state, dt))
    end = run(scene, state, dt, steps)
    assert is_finite(end)
    count = end.status.count
    lost = int(jnp.sum(~end.alive))
    assert lost == int(count[Condition.NONFINITE] + count[Condition.OUT_OF_DOMAIN])
    if not lost:
        # A body at rest whose parts flew apart, some by now at rest again.
        speed = max(largest(end.v), float(scene.rest_sound_speed()))
        scale = float(jnp.sum(scene.masses)) * speed
        assert largest(momentum(scene, end)) < tolerance(1e-11, 1e-3) * scale
    return scene, end, dt


def conditions(state):
    """The outcome for the table: what the status says."""
    names = [c.name for c in Condition if int(state.status.count[c])]
    return f"status: {', '.join(names)}" if names else "holds"


def energies(scene, state):
    """Kinetic and elastic energy, J."""
    law = scene.materials[0].elasticity
    return kinetic(scene, state), float(scene.volumes @ jax.vmap(law.energy)(state.He))


# --- Deformations -------------------------------------------------------------------------------


@every_material
@pytest.mark.parametrize(
    "stretch",
    [(1.0, -0.5, 1.0), pytest.param((-0.9, 1.2, 1.0), marks=pytest.mark.slow)],
    ids=str,
)
def test_h01_inverted(name, stretch, holds):
    """Turned inside out among sound neighbours: harmless, counted in every step that it stays so.

    `F ← (I + Δt L) F` changes the sign of det F only where det(I + Δt L) < 0, which no stable
    step reaches: what is inverted stays inverted, whatever its stress. That of fixed corotated
    elasticity draws it towards det F = 0, that of the others is that of its mirror image.

    An energy that is continued through det F = 0, so that it pushes back, is worse. Continued by a
    parabola below J = 0.01, neo-Hookean elasticity has at J = −0.5 a stable step 48 times shorter,
    and at that of the others all 36 particles are lost; a block that hits the floor at ten times
    the speed of sound stays crushed at J = 4e-16, since Kirchhoff stress vanishes with J.
    """
    scene, state, _ = deformed(name, np.diag(stretch))
    assert is_finite(slopes(scene, state, pgjax.stable_dt(scene, state)))
    before = sum(energies(scene, state))
    end = run(scene, state, pgjax.stable_dt(scene, state), 400)
    assert is_finite(end)
    # Sand that nothing holds together flies apart.
    assert bool(end.status.ok) or name == "sand"
    assert sum(energies(scene, end)) < 1.001 * before
    assert int(end.status.count[Condition.INVERTED]) == 400 or not bool(end.alive[ODD])
    assert -1.5 < volume_ratio(end) < 0
    holds("H01", material=name, outcome=conditions(end))


@every_material
@pytest.mark.parametrize("stretch", [(1.0, 0.0, 1.0), (0.0, 1.3, 1.0)], ids=str)
def test_h02_singular(name, stretch, holds):
    """No volume at all: det F = 0 is counted with the inverted."""
    _, end, _ = survives(name, np.diag(stretch))
    assert int(end.status.first[Condition.INVERTED]) == 0
    holds("H02", material=name, outcome=conditions(end))


@every_material
@pytest.mark.parametrize("stretch", [(1.0, 0.0, 0.0), (0.0, 0.0, 0.0)], ids=str)
def test_h03_rank_one_and_zero(name, stretch, holds):
    _, end, _ = survives(name, np.diag(stretch))
    assert int(end.status.first[Condition.INVERTED]) == 0
    holds("H03", material=name, outcome=conditions(end))


@every_material
def test_h07_stretched_a_thousandfold(name, holds):
    """At the time step for this stretch its energy comes back, and no more than that."""
    F = np.diag([1e3, 1.0, 1.0])
    scene, end, dt = survives(name, F)
    start = deformed(name, F)[1]
    assert dt < pgjax.stable_dt(scene) / 4
    assert energies(scene, end)[0] < 1.01 * energies(scene, start)[1]
    holds("H07", material=name, outcome=conditions(end))


@every_material
@pytest.mark.parametrize("least", [1e-3, 1e-6])
def test_h08_crushed(name, least, holds):
    """It is not crushed further, nor turned inside out."""
    _, end, _ = survives(name, np.diag([1.0, least, 1.0]))
    assert volume_ratio(end) > 0.9 * least
    assert int(end.status.count[Condition.INVERTED]) == 0
    holds("H08", material=name, outcome=conditions(end))


@every_material
def test_h09_condition_of_a_million(name, holds):
    """In single precision derivatives of the return mapping of paste are lost by then."""
    lost = name == "paste" and jnp.zeros(()).dtype == jnp.float32
    _, end, _ = survives(name, np.diag([1e3, 1e-3, 1.0]), smooth=not lost)
    holds("H09", material=name, outcome=conditions(end))


# --- Derivatives where singular values coincide --------------------------------------------------

MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
KAPPA = LAM + 2 * MU / 3


def principal(name, s):
    """Principal Kirchhoff stresses by the textbook, and their derivatives `∂τ_i/∂s_j`."""
    J, one = np.prod(s), np.eye(3)
    if name == "FixedCorotated":
        slope = 2 * MU * np.diag(2 * s - 1) + LAM * J * (2 * J - 1) / s
    elif name == "StVKHencky":
        slope = 2 * MU * np.diag(1 / s) + LAM / s
    elif name == "NeoHookean":
        slope = 2 * MU * np.diag(s) + LAM / s
    else:
        b = J ** (-2 / 3) * s**2
        deviator = one - 1 / 3
        slope = KAPPA * J**2 / s + MU * deviator @ (np.diag(2 * b / s) - 2 / 3 * b[:, None] / s)
    return np.broadcast_to(slope, (3, 3))


def divided(name, s, i, j):
    """`(τ_i − τ_j)/(s_i² − s_j²)` without a difference of equal numbers."""
    if name == "FixedCorotated":
        return 2 * MU * (1 - 1 / (s[i] + s[j]))
    if name == "StVKHencky":
        ratio = (s[i] ** 2 - s[j] ** 2) / s[j] ** 2
        return MU / s[j] ** 2 * (np.log1p(ratio) / ratio if ratio else 1)
    return MU if name == "NeoHookean" else MU * np.prod(s) ** (-2 / 3)


def textbook_derivative(name, s):
    """`∂τ_kl/∂F_ij` at `F = diag(s)`."""
    result = np.zeros((3, 3, 3, 3))
    for i in range(3):
        result[range(3), range(3), i, i] = principal(name, s)[:, i]
        for j in {0, 1, 2} - {i}:
            # dF = e_i e_jᵀ changes b_ij by s_j.
            result[i, j, i, j] = result[j, i, i, j] = divided(name, s, i, j) * s[j]
    return result


@jax.jit
def stress_derivatives(material, F):
    """Forward and reverse, of many F."""

    def tau(F):
        H = F - jnp.eye(3, dtype=F.dtype)
        return material.elasticity.kirchhoff(H, jnp.zeros_like(H))

    return jax.vmap(jax.jacfwd(tau))(F), jax.vmap(jax.jacrev(tau))(F)


def derivative_error(name, stretches, dtype):
    """The largest error for these stretches, in the axes and turned, relative to the largest."""
    s = np.asarray(stretches, dtype).astype(np.float64)
    law = {"paste": pm.DevVolNeoHookean(E, NU)}.get(name, MATERIALS[name].elasticity)
    material = eqx.tree_at(lambda m: m.elasticity, MATERIALS["NeoHookean"], law)
    material = jax.tree.map(lambda a: a.astype(dtype), material)
    exact = np.array([textbook_derivative(name, one) for one in s])
    F = np.array([np.diag(one) for one in s])
    # Quarter turns are exact in any precision: F → R F and τ → R τ Rᵀ.
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = np.einsum("ka,lb,ic,pabcj->pklij", R, R, R, exact)
    worst = 0.0
    for matrices, expected in ((F, exact), (R @ F, turned)):
        for got in stress_derivatives(material, jnp.asarray(matrices, dtype)):
            error = largest(np.asarray(got, np.float64) - expected)
            worst = max(worst, error / largest(expected))
    return worst


ELASTIC = pytest.mark.parametrize("name", ["FixedCorotated", "StVKHencky", "NeoHookean", "paste"])


@pytest.mark.parametrize("dtype", PRECISE)
@ELASTIC
def test_h05_derivatives_at_equal_stretches(name, dtype, holds):
    """At rest, turned, and where two or three coincide: the divided differences of the law."""
    stretches = [(1, 1, 1), (1, 1, 2), (2, 1, 1), (1.5, 1.5, 1.5), (0.5, 2, 0.5)]
    error = derivative_error(name, stretches, dtype)
    assert error < {"float32": 1e-6, "float64": 1e-12}[dtype]
    holds("H05", material=name, precision=dtype)


@pytest.mark.parametrize("dtype", PRECISE)
@ELASTIC
def test_h06_derivatives_at_nearly_equal_stretches(name, dtype, holds):
    """No 1/gap: gaps from 1e-3 down to the last bit."""
    stretches = [(1 + g, 1, 1 - g) for g in 10.0 ** -np.arange(3.0, 10)]
    stretches += [(2, 1 + g, 1) for g in 10.0 ** -np.arange(3.0, 10)]
    error = derivative_error(name, stretches, dtype)
    assert error < {"float32": 1e-5, "float64": 1e-10}[dtype]
    holds("H06", material=name, precision=dtype)


# --- One, two in one place, none ----------------------------------------------------------------


def lone(name, count, volume, **kwargs):
    """`count` particles in one place, deformed and in motion, of a total volume."""
    x = np.tile([0.53, 0.61], (count, 1))
    scene = world(name, x, volumes=np.full(count, volume / count))
    F = np.array([[1.05, 0.02, 0], [0.01, 0.97, 0], [0, 0, 1]])
    C = np.array([[0.3, -1.0], [0.8, 0.2]])
    moved = {"C": np.tile(C, (count, 1, 1)), "F": np.tile(F, (count, 1, 1))} | kwargs
    return scene, pgjax.initial_state(scene, x, (0.05, -0.04), **moved)


@every_material
def test_h23_one_particle(name, holds):
    """Its place is `x + v t` whatever it does inside; undeformed it flies unchanged."""
    scene, state = lone(name, 1, 2e-3)
    dt = pgjax.stable_dt(scene)
    end = run(scene, state, dt, 50)
    size = tolerance(1e-13, 1e-5)
    assert largest(end.v - state.v) < size
    assert largest(end.x - state.x - 50 * dt * state.v) < size
    assert largest(end.He - state.He) > 1e-3
    scene, state = lone(name, 1, 2e-3, C=0.0, F=np.eye(3)[None])
    end = run(scene, state, dt, 50)
    assert largest(end.He) < size
    holds("H23", material=name)


@every_material
def test_h23_two_in_one_place_are_one(name, holds):
    (one, alone), (two, pair) = lone(name, 1, 2e-3), lone(name, 2, 2e-3)
    dt = pgjax.stable_dt(one)
    alone, pair = run(one, alone, dt, 50), run(two, pair, dt, 50)
    for a, b in zip(motion(alone), motion(pair), strict=True):
        assert largest(b - a) < tolerance(1e-12, 1e-4) * max(1, largest(a))
    holds("H23", material=name)


@every_material
def test_h24_a_material_without_particles(name, holds):
    """An empty slice beside a full one changes nothing; a scene without any is refused."""
    x = block()
    scene = world(name, x)
    two = world((scene.materials[0], MATERIALS["NeoHookean"]), x, counts=(len(x), 0))
    states = [
        pgjax.initial_state(s, x, (0.1, 0.0), C=np.full((36, 2, 2), 0.5)) for s in (scene, two)
    ]
    dt = pgjax.stable_dt(scene)
    ends = [run(s, state, dt, 5) for s, state in zip((scene, two), states, strict=True)]
    for a, b in zip(*map(motion, ends), strict=True):
        assert largest(b - a) < tolerance(1e-13, 1e-5)
    with pytest.raises(ValueError, match="`volumes` must hold at least one particle, but is empty"):
        world(name, x[:0])
    holds("H24", material=name, outcome="refused")


# --- Spin and rate -------------------------------------------------------------------------------


@every_material
@pytest.mark.parametrize("rate", [(5.0, 5.0), (-5.0, 0.0), (-5.0, -5.0)], ids=str)
def test_h38_a_rate_too_large_for_the_step(name, rate, holds):
    """`‖C‖ Δt = 5`: said before the first step, and counted if it turns the particle over."""
    scene, state = lone(name, 1, 2e-3, F=np.eye(3)[None])
    dt = pgjax.stable_dt(scene)
    state = eqx.tree_at(lambda s: s.C, state, jnp.diag(jnp.asarray(rate))[None] / dt)
    assert pgjax.stable_dt(scene, state) <= 0.2 * dt / 5
    end = pgjax.simulate(scene, state, dt=dt, frames=1, substeps=1, throw=False).final
    again = pgjax.simulate(scene, end, dt=dt, frames=1, substeps=1, throw=False).final
    assert int(end.status.first[Condition.DT_ABOVE_BOUND]) == 0
    assert is_finite(end, again)
    if np.prod(1 + np.array(rate)) < 0:
        assert int(again.status.count[Condition.INVERTED]) == 1
    # At the step recommended nothing is said.
    end = pgjax.simulate(scene, state, dt=pgjax.stable_dt(scene, state), frames=1, substeps=1)
    assert not int(end.status.count.sum())
    holds("H38", material=name, outcome="status: DT_ABOVE_BOUND")


@every_material
def test_h51_what_is_lost_has_no_derivative(name, holds):
    """Left the grid, NaN, or masked: exactly 0, and the living do not feel it."""
    x = block()
    scene = world(name, x)
    state = pgjax.initial_state(scene, x, (0.3, -0.2))
    out, nan, dead = 3, 11, 20
    lost = np.isin(np.arange(len(x)), (out, nan, dead))
    position = state.position.at[out].set(1e30).at[nan].set(jnp.nan)
    alive = state.alive.at[dead].set(False)
    state = eqx.tree_at(lambda s: (s.position, s.alive), state, (position, alive))
    _, (of_scene, of_state) = slopes(scene, state, pgjax.stable_dt(scene), ~lost)
    for leaf in (of_scene.volumes, *motion(of_state)):
        assert (np.asarray(leaf)[lost] == 0).all()
        assert is_finite(leaf)
        assert (np.abs(np.asarray(leaf)[~lost]).reshape((~lost).sum(), -1).max(axis=1) > 0).all()
    holds("H51", material=name)
