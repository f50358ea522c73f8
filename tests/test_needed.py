"""What a scene does not need is not in its program, and leaving it out changes nothing."""

import jax
import numpy as np
import pytest

import pgjax
from benchmarks.ablations import bodies, laws
from benchmarks.ablations.measure import change, compare, rollout
from pgjax import boundary, models

SIDE = 2


def lowered(*materials, walls=None):
    """The program of a step, as text."""
    scene, state = bodies.thrown(*materials, side=SIDE, walls=walls or [])
    return jax.jit(pgjax.step).lower(scene, state, np.float32(1e-4)).as_text()


def test_only_the_operations_of_the_laws_are_compiled(monkeypatch):
    """In plain JAX an eigenproblem is a loop; a return mapping in Hencky strain has logarithms."""
    monkeypatch.setenv("PGJAX_NATIVE", "0")
    jax.clear_caches()

    def count(material):
        text = lowered(material)
        return [text.count(f"stablehlo.{name}") for name in ("while", "sqrt", "log")]

    # log J of neo-Hookean is not of a decomposition.
    assert count(bodies.jelly(models.NeoHookean))[:2] == [0, 0]
    loops, _, logarithms = count(bodies.jelly())
    assert (loops, logarithms) == (1, 0)
    loops, _, logarithms = count(bodies.sand())
    assert loops > 1
    assert logarithms > 0
    jax.clear_caches()


def test_without_plasticity_there_is_neither_history_nor_total_deformation():
    elastic = models.Material(models.StVKHencky(bodies.E, bodies.NU), density=bodies.DENSITY)
    _, state = bodies.thrown(elastic, side=SIDE)
    assert state.H is None
    assert jax.tree.leaves(state.history) == []
    _, flowing = bodies.thrown(bodies.sand(), side=SIDE)
    assert flowing.H is not None
    plain, mapped = (len(lowered(material)) for material in (elastic, bodies.sand()))
    assert plain < mapped


def final(setup, seconds=0.05, **options):
    """Start and final places."""
    dt = pgjax.stable_dt(*setup)
    program = rollout(*setup, seconds=seconds, dt=dt, **options)
    return np.asarray(setup[1].x), program.run()


def test_slices_are_the_laws_of_their_particles():
    kinds = (models.NeoHookean, models.FixedCorotated, models.StVKHencky)
    slices = bodies.thrown(*(bodies.jelly(law) for law in kinds), side=3)
    which = laws.with_layers(slices[0], 3)
    law = laws.OneOfThree(bodies.E, bodies.NU, which)
    everywhere = bodies.thrown(models.Material(law, None, bodies.DENSITY), side=3)
    (start, one), (_, other) = final(slices), final(everywhere)
    assert change(start, one, other) <= 1e-6
    # They are three laws: with one for all the motion is another.
    _, alike = final(bodies.thrown(bodies.jelly(), side=3))
    assert change(start, one, alike) > 1e-5


def test_what_lies_still_far_away_changes_nothing():
    h = bodies.H
    x, volumes = pgjax.sampling.block((4 * h,) * 3, (7 * h,) * 3, spacing=h / 2)
    floor = boundary.Box((3.5 * h,) * 3, (20 * h,) * 3, boundary.Separating(0.4))

    def run(places):
        resting = np.arange(len(places)) >= len(x)
        held = boundary.ParticleMotion(resting, boundary.Steady((0.0, 0.0, 0.0)))
        scene = pgjax.Scene(
            pgjax.Grid((0, 0, 0), (24,) * 3, h),
            bodies.jelly(),
            np.full(len(places), volumes[0]),
            gravity=bodies.GRAVITY,
            boundaries=[floor],
            particle_conditions=[held],
        )
        v = np.where(resting[:, None], 0.0, np.array([[0.5, 0.0, -2.0]]))
        return final((scene, pgjax.initial_state(scene, places, v)))

    far = x + np.array([10 * h, 0, 0])
    (start, alone), (_, beside) = run(x), run(np.concatenate([x, far]))
    assert change(start, alone, beside[: len(x)]) <= (1e-12 if jax.config.jax_enable_x64 else 1e-6)
    assert np.abs(alone - start).max() > h / 4


def test_a_comparison_is_of_programs_that_take_turns():
    setup = bodies.thrown(bodies.jelly(), side=SIDE)
    short, long = (rollout(*setup, seconds=s, dt=1e-4) for s in (1e-3, 3e-2))
    measured = compare(long, short, 3)
    # Thirty times as many steps; the rest of a call takes its time, too, on a busy machine more.
    assert measured["times faster"] > 1.5
    assert measured["memory"] == pytest.approx(measured["memory without"], rel=0.2)
