"""What goes wrong is named: at build by an error, in a rollout by a condition."""

import subprocess
import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from pgjax import boundary
from pgjax.result import Condition, SimulationError, SimulationWarning

JELLY = pm.Material(pm.NeoHookean(1e4, 0.3), density=1000.0)
ORIGIN = np.array([-0.4, 0.0])
H = 0.1
N = 12
DT = 1e-3
REST = boundary.Steady((0.0, 0.0))
HELD = boundary.Collider(boundary.Cuboid((0.2, 0.6), (2.0, 2.0)), boundary.Sticky())


def points(n=8, seed=0):
    """Particles near the middle of the grid."""
    return ORIGIN + H * (N / 2 + 0.9 * np.random.default_rng(seed).random((n, 2)))


def scene_of(n=8, material=JELLY, **kwargs):
    grid = pgjax.Grid(ORIGIN, (N, N), H)
    return pgjax.Scene(grid, material, np.full(n, 0.25 * H**2), **kwargs)


@eqx.filter_jit
def rollout(scene, state, dt, steps=12):
    return jax.lax.scan(lambda s, _: (pgjax.step(scene, s, dt), None), state, length=steps)[0]


def started(scene, x=None, v=(0.3, 0.2)):
    x = points(scene.particle_count) if x is None else x
    return pgjax.initial_state(scene, x, np.broadcast_to(v, x.shape))


def replaced(state, field, index, value):
    array = getattr(state, field)
    return eqx.tree_at(lambda s: getattr(s, field), state, array.at[index].set(value))


def same_bits(a, b, keep):
    for field in ("position", "v", "C", "He"):
        first, second = np.asarray(getattr(a, field))[keep], np.asarray(getattr(b, field))[keep]
        assert first.tobytes() == second.tobytes(), field


# --- In a rollout -------------------------------------------------------------------------------

FAR = [cells * sign for cells in (1.6, 2.6, 11, 1e9) for sign in (-1, 1)]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("cells", [*FAR, 1e30, -1e30])
def test_a_particle_outside_is_masked_and_the_others_untouched(axis, cells, holds):
    """H19: below 0 and beyond N, near and absurdly far; nothing wraps round."""
    scene = scene_of()
    state = started(scene)
    edge = 0.0 if cells < 0 else N * H
    left = replaced(state, "position", (0, axis), edge + cells * H)
    # The yardstick never had the particle.
    without = eqx.tree_at(lambda s: s.alive, state, state.alive.at[0].set(False))
    end, expected = rollout(scene, left, DT), rollout(scene, without, DT)
    assert not bool(end.alive[0])
    assert int(end.status.first[Condition.OUT_OF_DOMAIN]) == 0
    assert int(end.status.count[Condition.OUT_OF_DOMAIN]) == 1
    assert int(end.status.count[Condition.NONFINITE]) == 0
    same_bits(end, expected, slice(1, None))
    holds("H19", outcome="status: OUT_OF_DOMAIN")


@pytest.mark.parametrize("field", ["position", "v", "C", "He"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_in_mid_run_stays_with_its_particle(field, value, holds):
    """H22: the others are bitwise those of a run in which the particle is masked at that step."""
    scene = scene_of()
    state = rollout(scene, started(scene), DT)
    index = (3, *(0,) * (getattr(state, field).ndim - 1))
    end = rollout(scene, replaced(state, field, index, value), DT)
    masked = eqx.tree_at(lambda s: s.alive, state, state.alive.at[3].set(False))
    expected = rollout(scene, masked, DT)
    same_bits(end, expected, np.arange(8) != 3)
    assert int(end.status.first[Condition.NONFINITE]) == 12
    assert int(end.status.count[Condition.NONFINITE]) == 1
    holds("H22", outcome="status: NONFINITE")


def test_nan_of_a_users_force_is_found(holds):
    """H53: only the particle it was given to is lost."""

    def force(X0, t):
        return jnp.where((X0[0] > 0.24) & (t > 3.5 * DT), jnp.nan, 0.0) * jnp.ones(2)

    x = points()
    x[:, 0] = 0.2
    x[5, 0] = 0.25
    scene = scene_of(body_force=force, X0=x)
    end = rollout(scene, started(scene, x), DT)
    np.testing.assert_array_equal(np.flatnonzero(~np.asarray(end.alive)), [5])
    assert int(end.status.first[Condition.NONFINITE]) == 4
    assert np.isfinite(np.asarray(end.position)).all()
    holds("H53", outcome="status: NONFINITE")


def test_the_error_says_when_and_what_to_do():
    scene = scene_of()
    state = started(scene, v=(0.0, -20.0))
    run = {"dt": DT, "frames": 5, "substeps": 20}
    with pytest.raises(SimulationError) as info:
        pgjax.simulate(scene, state, **run)
    message = str(info.value)
    assert "OUT_OF_DOMAIN from step" in message
    assert "8 particle(s) left the grid" in message
    assert "Enlarge the grid" in message
    trajectory = pgjax.simulate(scene, state, **run, throw=False)
    assert not bool(trajectory.status.ok)
    assert bool(trajectory.status.happened(Condition.OUT_OF_DOMAIN))
    assert f"from step {int(trajectory.status.first[Condition.OUT_OF_DOMAIN])} on" in message
    # What left stays where it left, at rest.
    assert np.isfinite(np.asarray(trajectory.saved.x)).all()
    assert (np.asarray(trajectory.final.v) == 0).all()


def test_far_above_the_bound_nothing_crashes(holds):
    """H13: at 25 times the stable step the run ends, and says at which step it broke."""
    scene = scene_of()
    state = replaced(started(scene), "He", (0, 0, 0), 0.2)
    dt = 25 * float(scene.elastic_limit(scene.rest_sound_speed()))
    with pytest.raises(ValueError, match="must be below the stable time step"):
        pgjax.simulate(scene, state, dt=dt, frames=2, substeps=100)
    with pytest.warns(SimulationWarning, match="25.00 of the stable one"):
        end = pgjax.simulate(
            scene, state, dt=dt, frames=2, substeps=100, throw=False, allow_unstable=True
        )
    lost = end.status.count[np.array([Condition.NONFINITE, Condition.OUT_OF_DOMAIN])]
    assert int(lost.sum()) > 0
    first = end.status.first[np.array([Condition.NONFINITE, Condition.OUT_OF_DOMAIN])]
    assert 0 < int(first.min()) < 200
    holds("H13", outcome="refused; overridden: status: NONFINITE or OUT_OF_DOMAIN")


@pytest.mark.parametrize(
    ("material", "stretches", "condition"),
    [
        (JELLY, (1.0, -0.5, 1.0), Condition.INVERTED),
        (JELLY, (0.05, 0.1, 1.0), Condition.CLAMPED),
        (pm.Material(pm.StVKHencky(1e4, 0.3)), (1.0, 1e-5, 1.0), Condition.CLAMPED),
        (pm.Material(pm.DevVolNeoHookean(1e4, 0.3)), (1.0, 1e-3, 1.0), Condition.CLAMPED),
        (pm.Material(pm.FixedCorotated(1e4, 0.3)), (1.0, -0.5, 1.0), Condition.INVERTED),
        (pm.Material(pm.StVKHencky(1e4, 0.3)), (3.0, 1.0, 1.0), Condition.ELLIPTICITY_LOST),
        (JELLY, (400.0, 1.0, 1.0), Condition.DT_ABOVE_BOUND),
    ],
)
def test_soft_conditions_warn_and_are_counted(material, stretches, condition):
    """One deformed particle among eight at rest, held in place: exactly that one is counted."""
    scene = scene_of(material=material, boundaries=[HELD])
    state = started(scene, v=(0.0, 0.0))
    state = eqx.tree_at(
        lambda s: s.He, state, state.He.at[2].set(jnp.diag(jnp.asarray(stretches)) - jnp.eye(3))
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        end = pgjax.simulate(scene, state, dt=DT / 4, frames=1, substeps=3)
    assert any(str(w.message).startswith(condition.name) for w in caught)
    per_step = condition in (Condition.INVERTED, Condition.CLAMPED)
    # In each of three steps, or before the first and after the frame.
    assert int(end.status.count[condition]) == (3 if per_step else 2)
    assert int(end.status.first[condition]) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SimulationWarning)
        on = pgjax.simulate(scene, end.final, dt=DT / 4, frames=1, substeps=3)
    assert int(on.status.count[condition]) == (6 if per_step else 3)
    assert np.isfinite(np.asarray(end.final.position)).all()


def test_what_single_precision_does_not_resolve_is_said():
    scene = scene_of()
    state = pgjax.initial_state(scene, points(), dtype=np.float32)
    state = replaced(state, "He", 0, jnp.diag(jnp.asarray([1e3, 0.0, -0.9995], jnp.float32)))
    scene = scene_of(boundaries=[HELD])
    end = pgjax.simulate(scene, state, dt=1e-7, frames=1, substeps=1, throw=False)
    assert int(end.status.count[Condition.F32_RESOLUTION]) == 2  # At the start and the end.


def test_a_crowded_cell_is_said():
    n = 30_001
    scene = scene_of(n, boundaries=[HELD])
    x = np.full((n, 2), 0.25) + 1e-6 * np.arange(n)[:, None]
    state = pgjax.initial_state(scene, x, dtype=np.float32)
    with pytest.warns(SimulationWarning, match="F32_RESOLUTION"):
        pgjax.simulate(scene, state, dt=DT, frames=1, substeps=1)


# --- Before anything is compiled ----------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["x", "v", "C", "F"])
def test_input_that_is_not_finite(field, bad):
    scene = scene_of()
    values = {
        "x": points(),
        "v": np.zeros((8, 2)),
        "C": np.zeros((8, 2, 2)),
        "F": np.tile(np.eye(3), (8, 1, 1)),
    }
    values[field][(5, 1)] = bad
    with pytest.raises(ValueError, match=rf"Argument `{field}` must be finite.*index \(5, 1"):
        pgjax.initial_state(scene, **values)


def simulated(**changes):
    scene = scene_of()
    run = {"dt": DT, "frames": 1, "substeps": 1} | changes
    return pgjax.simulate(scene, run.pop("state", started(scene)), **run)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: pm.NeoHookean(1e5, 0.5), "`nu` must be below 0.5, but is 0.5"),
        (lambda: pm.NeoHookean(1e5, -1.0), "`nu` must be above -1, but is -1.0"),
        (lambda: pm.NeoHookean(0.0, 0.3), "`E` must be positive and finite"),
        (lambda: pm.NeoHookean(np.nan, 0.3), "`E` must be positive and finite .*, but is nan"),
        (lambda: pm.NeoHookean([1e5, -2.0], 0.3), "`E` must be positive.*but is -2.0"),
        (lambda: pm.Material(pm.NeoHookean(1e5, 0.3), density=0), "`density` must be positive"),
        (lambda: scene_of(0), "`volumes` must hold at least one particle"),
        (lambda: scene_of(n=8, counts=(7,)), "`counts` must give the particles"),
        (lambda: scene_of(gravity=(0, 0, -9.81)), r"`gravity` must have shape \(2,\)"),
        (lambda: scene_of(gravity=(0, np.nan)), "`gravity` must be finite"),
        (lambda: scene_of(grid_damping=-1.0), "`grid_damping` must be at least 0"),
        (lambda: scene_of(body_force=lambda X, _: X), "`X0` must be given with `body_force`"),
        (
            lambda: scene_of(material=pm.Material(pm.NeoHookean([1e5, 1e5], 0.3))),
            r"`E` must be one number or one per particle .*\(8,\)",
        ),
        (
            lambda: pgjax.Scene(pgjax.Grid(ORIGIN, (N, N), H), JELLY, [1.0, -1.0]),
            r"`volumes` must be positive and finite, but is -1.0 at index \(1,\)",
        ),
        (lambda: pgjax.Grid((0, 0), (8, 8), 0.0), "`h` must be positive"),
        (lambda: pgjax.Grid((0, 0), (8, 3), 0.1), "`shape` must be at least 4"),
        (lambda: pgjax.Grid((0, 0), (8, 0), 0.1, periodic=(True, True)), "at least 1"),
        (lambda: pgjax.Grid((0,), (8, 8), 0.1), r"`origin` must have shape \(2,\)"),
        (lambda: pgjax.Grid((0,), (8,), 0.1), "2 or 3 entries"),
        (lambda: pgjax.Grid((0, 0, 0), (1291,) * 3, 0.1), "fewer than 2\\^29 nodes"),
        (lambda: pgjax.BSpline(1), "`degree` must be 2 or 3, but is 1"),
        (lambda: pgjax.initial_state(scene_of(), points(7)), r"`x` must have shape \(8, 2\)"),
        (lambda: pgjax.initial_state(scene_of(), points() + 1), "`x` must lie inside the grid"),
        (lambda: pgjax.initial_state(scene_of(), points(), np.zeros(3)), "`v` must have shape"),
        (lambda: pgjax.initial_state(scene_of(), points(), dtype=np.float16), "float32 or float64"),
        (lambda: simulated(dt=0.0), "`dt` must be positive and finite"),
        (lambda: simulated(dt=-1e-3), "`dt` must be positive and finite"),
        (lambda: simulated(dt=np.nan), "`dt` must be positive and finite"),
        (lambda: simulated(dt=1.0), "`dt` must be below the stable time step"),
        (lambda: simulated(frames=0), "`frames` must be a whole number"),
        (lambda: simulated(substeps=2.5), "`substeps` must be a whole number"),
        (lambda: simulated(state=started(scene_of(5))), "must hold the particles of the scene"),
        (lambda: boundary.HalfSpace((0, 0), (0, 0)), "`normal` must not be zero"),
        (lambda: boundary.Box((0, 0), (1, -1)), "`upper` must be above `lower`"),
        (lambda: boundary.Separating(-0.1), "`friction` must be at least 0"),
        (
            lambda: boundary.Collider(boundary.Sphere((0, 0), 1.0), start=2.0, end=1.0),
            "`end` must be after `start`",
        ),
        (
            lambda: boundary.ParticleImpulse(np.zeros(8, bool), (1.0, 0.0)),
            "`mask` must select at least one particle",
        ),
        (lambda: boundary.ParticleMotion(np.ones(8), REST), "`mask` must be a boolean"),
        (
            lambda: scene_of(particle_conditions=[boundary.ParticleMotion(np.ones(3, bool), REST)]),
            r"`mask` must have shape \(8,\)",
        ),
    ],
)
def test_bad_arguments_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()


REST_3D = boundary.Steady((0.0, 0.0, 0.0))
DISC = boundary.Sphere((0.0, 0.0), 1.0)
ALL = np.ones(8, bool)


def speed(_x, v, _t):
    return jnp.sqrt(jnp.sum(v * v))


def nothing(*_):
    return None


@pytest.mark.parametrize(
    "condition",
    [
        boundary.Collider(boundary.Sphere((0.0, 0.0, 0.0), 1.0)),
        boundary.Collider(DISC, motion=REST_3D),
        boundary.Collider(DISC, surface_velocity=(1.0, 0.0, 0.0)),
        boundary.Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
        speed,
    ],
    ids=lambda condition: getattr(condition, "__name__", type(condition).__name__),
)
def test_walls_of_another_dimension_are_named(condition):
    """Which one it is, before anything is compiled."""
    name = getattr(condition, "__name__", type(condition).__name__)
    words = rf"`boundaries` must hold .* of shape \(2,\), but number 2 \({name}\) (raises|returns) "
    with pytest.raises(ValueError, match=words):
        scene_of(boundaries=[HELD, condition])


@pytest.mark.parametrize(
    "condition",
    [
        boundary.ParticleMotion(ALL, REST_3D),
        boundary.ParticleForce(ALL, (1.0, 0.0, 0.0)),
        boundary.ParticleImpulse(ALL, (1.0, 0.0, 0.0)),
        boundary.Wind((1.0, 0.0, 0.0), 1.0),
        nothing,
    ],
    ids=lambda condition: getattr(condition, "__name__", type(condition).__name__),
)
def test_conditions_of_another_dimension_are_named(condition):
    name = getattr(condition, "__name__", type(condition).__name__)
    words = rf"8 particles in 2 dimensions, but number 1 \({name}\) (raises|returns shape None)"
    with pytest.raises(ValueError, match=words):
        scene_of(particle_conditions=[condition])


def test_scenes_are_made_and_checked_inside_transformations():
    """The check is of shapes: values that are traced or batched pass, wrong shapes do not."""

    def scene(p, point=(0.0, 0.0)):
        wall = boundary.Collider(boundary.Sphere(jnp.asarray(point) + p, 1.0), motion=REST)
        wind = boundary.Wind(lambda x, _: p * x, rate=p)
        return scene_of(boundaries=[wall, lambda _x, v, _t: p * v], particle_conditions=[wind])

    def shift(p):
        return jnp.sum(scene(p).boundaries[0].shape.center)

    one = jnp.asarray(1.0)
    assert float(jax.grad(shift)(one)) == 2
    np.testing.assert_array_equal(jax.jit(jax.vmap(shift))(jnp.arange(3.0)), [0, 2, 4])
    batch = jax.vmap(lambda p: scene_of(boundaries=[boundary.Box((p, p), (p + 1, p + 1))]))(
        jnp.arange(3.0)
    )
    assert batch.boundaries[0].lower.shape == (3, 2)
    moved = eqx.tree_at(lambda s: s.boundaries[0].lower, batch, batch.boundaries[0].lower - 1)
    assert float(moved.boundaries[0].lower[0, 0]) == -1
    with pytest.raises(ValueError, match="`boundaries` must"):
        jax.vmap(lambda p: scene(p, (0.0, 0.0, 0.0)).volumes)(jnp.arange(3.0))


def test_functions_may_have_another_precision_than_the_default():
    """What a function closes over has the precision of the state, not of the scene."""
    normal = jnp.asarray([0.0, 1.0], jnp.float32)
    scene = scene_of(boundaries=[lambda _x, v, _t: v - jnp.sum(v * normal) * normal])
    state = pgjax.initial_state(scene, points(), dtype=np.float32)
    assert bool(rollout(scene, state, DT, steps=1).status.ok)


def test_double_precision_must_be_switched_on():
    code = """
import numpy as np, pgjax, pgjax.models as pm
scene = pgjax.Scene(pgjax.Grid((0, 0), (8, 8), 0.1), pm.Material(pm.NeoHookean(1e4, 0.3)), [1.0])
assert pgjax.initial_state(scene, np.full((1, 2), 0.4)).dtype == np.float32
try:
    pgjax.initial_state(scene, np.full((1, 2), 0.4), dtype=np.float64)
except ValueError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "`dtype` must be float32 unless double precision is switched on" in done.stdout
