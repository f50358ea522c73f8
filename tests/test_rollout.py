"""Rollouts: one motion, however it is compiled, cut, batched or sliced; and what drives it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from pgjax.boundary import (
    Collider,
    Cuboid,
    HalfSpace,
    ParticleForce,
    ParticleImpulse,
    ParticleMotion,
    Separating,
    Steady,
    Sticky,
    Wind,
)
from pgjax.simulate import checkpointed_scan

H, DT = 0.1, 1e-3
METAL = pm.Material(pm.StVKHencky(1e4, 0.3), pm.VonMises(50.0, hardening=0.1), density=1000.0)
JELLY = pm.Material(pm.NeoHookean(2e4, 0.2), density=500.0)
advance = eqx.filter_jit(pgjax.step)


def particles(n, seed=0, lower=0.4, size=0.3, d=2):
    """Random positions and velocities."""
    rng = np.random.default_rng(seed)
    return lower + size * rng.random((n, d)), rng.normal(size=(n, d))


def two_bodies(**kwargs):
    """Six particles of metal and six of jelly falling on a floor with friction."""
    x, v = particles(12)
    floor = Collider(HalfSpace([0.0, 0.43], [0.0, 1.0]), Separating(0.3))
    scene = pgjax.Scene(
        pgjax.Grid([0.0, 0.0], (12, 12), H),
        [METAL, JELLY],
        np.full(12, 1e-3),
        counts=(6, 6),
        gravity=[0.0, -9.8],
        boundaries=(floor,),
        **kwargs,
    )
    return scene, pgjax.initial_state(scene, x, v)


def one_body(material=JELLY, n=9, x=None, v=None, **kwargs):
    """A free body in the middle of the grid."""
    start, speed = particles(n)
    start = start if x is None else x
    kwargs = {"grid": pgjax.Grid([0.0, 0.0], (12, 12), H)} | kwargs
    scene = pgjax.Scene(kwargs.pop("grid"), material, np.full(len(start), 1e-3), **kwargs)
    return scene, pgjax.initial_state(scene, start, speed if v is None else v)


def run(scene, state, steps, dt=DT):
    for _ in range(steps):
        state = advance(scene, state, dt)
    return state


def difference(a, b):
    """Largest difference of two trees, relative to the largest entry of each array."""
    gaps = [0.0]
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        assert x.shape == y.shape
        gaps.append(np.max(np.abs(x - y), initial=0) / max(np.max(np.abs(y), initial=0), 1e-300))
    return max(gaps)


def identical(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def kept(states):
    """What `simulate` saves by default, of a list of states."""
    return jax.tree.map(lambda *a: jnp.stack(a), *[pgjax.Kinematics(s.x, s.v, s.F) for s in states])


@pytest.mark.slow
@pytest.mark.float64
def test_jit_scan_and_loop_are_one(measure):
    """V44. Entry 0 of what is saved is the initial state; a restart changes no bit."""
    jelly, at_rest = one_body()
    eager, jitted = pgjax.step(jelly, at_rest, DT), advance(jelly, at_rest, DT)
    measure("V44", "jit = eager, one step", difference(jitted, eager), below=1e-13)
    scene, state = two_bodies()
    loop = [state]
    for _ in range(4):
        loop.append(run(scene, loop[-1], 5))
    whole = pgjax.simulate(scene, state, dt=DT, frames=4, substeps=5)
    measure("V44", "scan = loop, 20 steps", difference(whole.saved, kept(loop)), below=1e-13)
    measure("V44", "scan = loop, final state", difference(whole.final, loop[-1]), below=1e-13)
    assert identical(jax.tree.map(lambda a: a[:1], whole.saved), kept([state]))
    np.testing.assert_allclose(whole.t, 5 * DT * np.arange(5), rtol=1e-14)

    half = pgjax.simulate(scene, state, dt=DT, frames=2, substeps=5)
    rest = pgjax.simulate(scene, half.final, dt=DT, frames=2, substeps=5)
    assert identical(rest.final, whole.final)
    assert identical(rest.saved, jax.tree.map(lambda a: a[2:], whole.saved))
    np.testing.assert_array_equal(rest.t, whole.t[2:])


@pytest.mark.float64
def test_batch_of_scenes(measure):
    """V44: `vmap` over E equals separate runs, and a member that fails disturbs no other."""

    def motion(E):
        scene, state = one_body(pm.Material(pm.NeoHookean(E, 0.3), density=1000.0))
        return pgjax.simulate(scene, state, dt=DT, frames=2, substeps=10)

    batched = eqx.filter_jit(jax.vmap(motion))
    stiffness = jnp.asarray([5e3, 1e4, 2e4])
    batch = batched(stiffness)
    separate = [motion(E) for E in stiffness]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *separate)
    measure(
        "V44", "vmap over scenes = separate", difference(batch.saved, stacked.saved), below=1e-13
    )
    assert batch.status.ok.all()

    broken = batched(stiffness.at[1].set(jnp.nan))
    np.testing.assert_array_equal(broken.status.ok, [True, False, True])
    np.testing.assert_array_equal(
        broken.status.happened(pgjax.Condition.NONFINITE), [False, True, False]
    )
    others = jnp.asarray([0, 2])
    for good, bad in zip(jax.tree.leaves(batch), jax.tree.leaves(broken), strict=True):
        np.testing.assert_array_equal(good[others], bad[others])
    assert np.isfinite(broken.saved.x).all()


def test_save_takes_any_function_and_a_new_number_does_not_compile():
    """`save` returns any tree; it is traced once, however many values E, dt and gravity take."""
    traced = []

    def save(state):
        traced.append(1)
        return {"step": state.step, "top": jnp.max(state.x[:, 1]), "nothing": None}

    def motion(E, dt, g):
        material = pm.Material(pm.NeoHookean(E, 0.3), density=1000.0)
        scene, state = one_body(material, gravity=[0.0, g])
        return pgjax.simulate(scene, state, dt=dt, frames=3, substeps=4, save=save)

    first = motion(1e4, DT, -1.0)
    assert set(first.saved) == {"step", "top", "nothing"}
    np.testing.assert_array_equal(first.saved["step"], [0, 4, 8, 12])
    count = len(traced)
    tops = [motion(*values).saved["top"][-1] for values in ((2e4, DT, -1), (1e4, 2 * DT, 3.0))]
    assert len(traced) == count
    assert len({float(first.saved["top"][-1]), *map(float, tops)}) == 3


def test_progress_is_reported_once_per_frame():
    scene, state = one_body()
    seen = []
    pgjax.simulate(
        scene, state, dt=DT, frames=7, substeps=2, progress=lambda *frame: seen.append(frame)
    )
    jax.effects_barrier()
    assert sorted(seen) == [(frame, 7) for frame in range(1, 8)]


@pytest.mark.float64
def test_float32_stays_float32():
    """H47: a float32 state in a float64 scene gives float32 everywhere, and float64 likewise."""
    for dtype in (jnp.float32, jnp.float64):
        scene, state = two_bodies()
        state = pgjax.initial_state(scene, state.x, state.v, dtype=dtype)
        result = jax.eval_shape(
            lambda state, scene=scene: pgjax.simulate(scene, state, dt=DT, frames=2, substeps=3),
            state,
        )
        floating = [a for a in jax.tree.leaves(result) if jnp.issubdtype(a.dtype, jnp.floating)]
        assert {a.dtype for a in floating} == {jnp.dtype(dtype)}


@pytest.mark.float64
@pytest.mark.parametrize("count", [1, 2, 12, 13, 37])
@pytest.mark.parametrize("group", [1, 4, 6, 50])
def test_checkpointed_scan_is_a_scan(count, group):
    """Any number of steps in any groups: same values, same order, same gradient."""
    _, state = one_body(n=2)

    def body(state, i):
        v = jnp.sin(state.v) + 0.1 * i.astype(state.dtype)
        return eqx.tree_at(lambda s: (s.v, s.step), state, (v, state.step + 1)), {"v": v, "i": i}

    def cut(state):
        return checkpointed_scan(body, state, count, group=group)

    def plain(state):
        return jax.lax.scan(body, state, jnp.arange(count, dtype=jnp.int32))

    def gradient(scan):
        def total(v):
            final, out = scan(eqx.tree_at(lambda s: s.v, state, v))
            return jnp.sum(final.v) + jnp.sum(out["v"] ** 2)

        return jax.grad(total)(state.v)

    assert identical(cut(state), plain(state))
    np.testing.assert_allclose(gradient(cut), gradient(plain), rtol=1e-13)


@pytest.mark.parametrize(("frames", "substeps"), [(5, 7), (1, 13), (13, 1), (6, 4)])
def test_any_number_of_frames_and_substeps(frames, substeps, measure):
    """Odd and prime numbers: nothing is skipped, nothing is done twice."""
    scene, state = one_body()
    result = pgjax.simulate(scene, state, dt=DT, frames=frames, substeps=substeps)
    states = [state]
    for _ in range(frames):
        states.append(run(scene, states[-1], substeps))
    assert result.final.step == frames * substeps
    gap = difference(result.saved, kept(states))
    measure("V44", f"scan = loop, {frames} x {substeps} steps", gap, below=1e-13)


@pytest.mark.parametrize(
    "substeps",
    [
        pytest.param(None, id="one-frame", marks=pytest.mark.slow),
        pytest.param(8, id="many-frames"),
    ],
)
def test_reverse_mode_memory_grows_as_the_root(substeps, measure):
    """2√T + 60 states for T steps, in one long frame and in many short ones."""
    scene, state = one_body(n=400)
    size = sum(a.nbytes for a in (state.position, state.v, state.C, state.He))

    def states_held(steps):
        n = substeps or steps

        def loss(v):
            moving = eqx.tree_at(lambda s: s.v, state, v)
            motion = pgjax.simulate(
                scene, moving, dt=DT, frames=steps // n, substeps=n, save=lambda s: s.step
            )
            return jnp.sum(motion.final.x)

        compiled = jax.jit(jax.grad(loss)).lower(state.v).compile()
        return compiled.memory_analysis().temp_size_in_bytes / size

    short, long = states_held(256), states_held(1024)
    what = f"reverse mode, {'one frame' if substeps is None else 'many frames'}"
    measure("V44", f"{what}: states held, 256 steps", short, below=2 * 16 + 60)
    measure("V44", f"{what}: states held, 1024 steps", long, below=2 * 32 + 60)
    measure("V44", f"{what}: memory, 1024 against 256 steps", long / short, below=2.6)


def test_keeping_the_states_changes_nothing_but_the_memory():
    """Same gradient; T states, those of one frame once more, and a few."""
    scene, state = one_body(n=400)
    size = sum(a.nbytes for a in (state.position, state.v, state.C, state.He))

    def gradient(keep_states):
        def loss(v):
            moving = eqx.tree_at(lambda s: s.v, state, v)
            motion = pgjax.simulate(
                scene, moving, dt=DT, frames=4, substeps=64, keep_states=keep_states
            )
            return jnp.sum(motion.final.x)

        compiled = jax.jit(jax.grad(loss)).lower(state.v).compile()
        return compiled(state.v), compiled.memory_analysis().temp_size_in_bytes / size

    (few, little), (all_of_them, much) = gradient(False), gradient(True)
    np.testing.assert_allclose(all_of_them, few, rtol=0, atol=1e-4 * float(jnp.abs(few).max()))
    assert little < 2 * 16 + 60
    assert 256 < much < 256 + 64 + 60


def test_materials_far_apart_do_not_meet(measure, holds):
    """H43: slices of one scene equal separate scenes."""
    x, v = particles(12, size=0.2)
    x = x + 0.6 * (np.arange(12) >= 6)[:, None] - 0.2
    grid = pgjax.Grid([0.0, 0.0], (12, 12), H)
    scene = pgjax.Scene(grid, [METAL, JELLY], np.full(12, 1e-3), counts=(6, 6))
    together = run(scene, pgjax.initial_state(scene, x, v), 30)
    for material, part in ((METAL, slice(0, 6)), (JELLY, slice(6, 12))):
        alone_in, state = one_body(material, x=x[part], v=v[part])
        alone = run(alone_in, state, 30)
        gap = difference(
            (together.x[part], together.v[part], together.C[part], together.Fe[part]),
            (alone.x, alone.v, alone.C, alone.Fe),
        )
        law = type(material.elasticity).__name__
        # Alone and together the sums at a node are in another order.
        bound = 1e-13 if alone.x.dtype == jnp.float64 else 1e-5
        measure("H43", f"{law} beside another material = alone, 30 steps", gap, below=bound)
        holds("H43", material=law)


@pytest.mark.float64
def test_values_per_particle_are_slices(measure):
    """One material with a value per particle equals two materials."""
    x, v = particles(12)
    first = np.arange(12) < 6

    def of(E, nu, density, strength, hardening):
        plasticity = pm.VonMises(strength, hardening=hardening)
        return pm.Material(pm.StVKHencky(E, nu), plasticity, density=density)

    one, two = (1e4, 0.3, 1000.0, 50.0, 0.1), (2e4, 0.1, 500.0, 80.0, 0.0)
    grid, volumes = pgjax.Grid([0.0, 0.0], (12, 12), H), np.full(12, 1e-3)
    sliced = pgjax.Scene(grid, [of(*one), of(*two)], volumes, counts=(6, 6))
    values = [np.where(first, a, b) for a, b in zip(one, two, strict=True)]
    mixed = pgjax.Scene(grid, of(*values), volumes)
    a, b = (run(s, pgjax.initial_state(s, x, v), 30) for s in (mixed, sliced))
    gap = difference((a.x, a.v, a.C, a.Fe, a.F), (b.x, b.v, b.C, b.Fe, b.F))
    assert np.abs(np.asarray(a.He - a.H)).max() > 1e-3
    measure("V44", "values per particle = slices, 30 steps", gap, below=1e-13)


@pytest.mark.float64
def test_periodic_direction(measure):
    """A body that crosses the seam moves as one that does not, and returns after one period."""
    grid = pgjax.Grid([0.0, 0.0], (8, 12), H, periodic=(True, False))
    x, v = particles(9, size=0.25)
    v = 0.2 * v + np.array([20.0, 0.0])
    scene, state = one_body(x=x, v=v, grid=grid)
    at_seam = pgjax.initial_state(scene, x + np.array([3 * H, 0.0]), v)
    inside, across = run(scene, state, 40), run(scene, at_seam, 40)
    assert (across.x[:, 0] > 0.8).any()
    assert across.alive.all()
    gap = difference(
        (inside.position[:, 0] + 3 * H, inside.x[:, 1], inside.v, inside.He),
        (across.position[:, 0], across.x[:, 1], across.v, across.He),
    )
    measure("V44", "across the periodic seam = inside, 40 steps", gap, below=1e-12)


@pytest.mark.float64
def test_plane_strain_is_a_slab(measure):
    """d = 2 equals d = 3 one cell wide and periodic, plastic flow included."""
    x, v = particles(10)
    flat, state = one_body(METAL, x=x, v=v)
    box = pgjax.Grid([0.0, 0.0, 0.0], (12, 12, 1), H, periodic=(False, False, True))
    slab = pgjax.Scene(box, METAL, np.full(10, 1e-3 * H))
    thick = pgjax.initial_state(
        slab, np.pad(x, ((0, 0), (0, 1)), constant_values=0.03), np.pad(v, ((0, 0), (0, 1)))
    )
    flat_end, slab_end = run(flat, state, 50), run(slab, thick, 50)
    gap = difference(
        (flat_end.x, flat_end.v, flat_end.C, flat_end.He, flat_end.H, flat_end.history),
        (
            slab_end.x[:, :2],
            slab_end.v[:, :2],
            slab_end.C[:, :2, :2],
            slab_end.He,
            slab_end.H,
            slab_end.history,
        ),
    )
    assert np.abs(flat_end.He[:, 2, 2]).max() > 1e-4
    assert np.abs(slab_end.v[:, 2]).max() < 1e-12
    measure("V21", "d = 2 against a periodic slab, 50 steps", gap, below=1e-10)


@pytest.mark.float64
def test_led_particles_follow_exactly(measure):
    """Held particles move with the value while the window lasts, whatever pulls at them."""
    held = np.arange(9) < 4
    value, start, end = np.array([0.3, -0.2]), 10 * DT, 30 * DT
    hold = ParticleMotion(held, Steady(value), start=start, end=end)
    scene, state = one_body(gravity=[0.0, -9.8], particle_conditions=(hold,))
    before = run(scene, state, 10)
    during = run(scene, before, 20)
    exact = np.asarray(before.x)[held] + 20 * DT * value
    measure("V44", "held particles", np.max(np.abs(during.x[held] - exact)), below=1e-14)
    np.testing.assert_array_equal(during.v[held], np.tile(value, (4, 1)))
    assert not np.allclose(before.v[held], value)
    after = run(scene, during, 5)
    assert not np.allclose(after.v[held], value)


@pytest.mark.float64
def test_what_is_held_is_not_pushed():
    """Forces and wind that come after a hold in the list do not move what it holds."""
    every = np.ones(9, bool)
    hold = ParticleMotion(every, Steady([0.0, 0.0]))
    for push in (Wind([1.5, 0.0], 2.0), ParticleForce(every, [1.0, 0.0])):
        scene, state = one_body(particle_conditions=(hold, push))
        np.testing.assert_array_equal(run(scene, state, 5).x, state.x)


@pytest.mark.float64
def test_a_sticky_body_takes_what_is_inside_along():
    """Nodes in the box have the velocity in the window: the particles inside follow it."""
    velocity = np.array([0.5, 0.25])
    start, end = 2 * DT, 6 * DT
    box = Cuboid([0.55, 0.55], [0.35, 0.35])
    push = Collider(box, Sticky(), Steady(velocity, start=start), start=start, end=end)
    scene, state = one_body(boundaries=(push,))
    before = run(scene, state, 2)
    assert not np.allclose(before.v, velocity)
    during = run(scene, before, 4)
    np.testing.assert_allclose(during.v, np.tile(velocity, (9, 1)), rtol=1e-12)
    exact = np.asarray(before.x) + 4 * DT * velocity
    np.testing.assert_allclose(during.x, exact, rtol=1e-12)
    after = run(scene, during, 20)
    assert np.abs(np.asarray(after.v) - velocity).max() > 1e-6


@pytest.mark.float64
@pytest.mark.parametrize("duration", [0.0, 0.0125])
def test_impulse_is_a_total_momentum(duration, measure):
    """It depends neither on the number of particles nor on the time step, nor how they meet."""
    momentum, gaps = np.array([0.02, -0.01]), []
    for n in (5, 20):
        push = ParticleImpulse(np.arange(n) < n // 2, momentum, start=0.0033, duration=duration)
        scene, state = one_body(n=n, v=np.zeros((n, 2)), particle_conditions=(push,))
        for dt in (DT, 0.7 * DT):
            assert (run(scene, state, 3, dt).v == 0).all()
            end = run(scene, state, int(0.03 / dt), dt)
            total = np.sum(scene.masses[:, None] * end.v, axis=0)
            gaps.append(np.max(np.abs(total - momentum)) / np.max(np.abs(momentum)))
    measure("V44", f"total momentum of a push of {duration} s", max(gaps), below=1e-12)


@pytest.mark.float64
def test_damping_does_not_depend_on_the_time_step(measure):
    """`v ∝ exp(−γ t)` and the symmetric part of C ∝ exp(−r t), to rounding, for any dt."""
    gamma, r, duration = 3.0, 40.0, 0.02
    # Too soft to feel its own stress.
    dust = pm.Material(pm.NeoHookean(1e-9, 0.3), density=1000.0)
    C = np.array([[[1.0, 3.0], [-2.0, 0.5]]])
    symmetric, spin = (C + C.swapaxes(1, 2)) / 2, (C - C.swapaxes(1, 2)) / 2
    damping = {"grid_damping": gamma, "shear_damping": r}
    scene, state = one_body(dust, x=np.array([[0.52, 0.57]]), v=np.array([[0.4, 0.2]]), **damping)
    state = eqx.tree_at(lambda s: s.C, state, jnp.asarray(C))
    slow = np.exp(-gamma * duration)
    for steps in (10, 40):
        end = run(scene, state, steps, duration / steps)
        speed = difference(end.v, slow * state.v)
        measure("V44", f"grid damping, {steps} steps", speed, below=1e-12)
        exact = slow * (spin + np.exp(-r * duration) * symmetric)
        measure("V44", f"shear damping, {steps} steps", difference(end.C, exact), below=1e-10)


@pytest.mark.float64
def test_body_force(measure):
    """`v = Σ Δt b(X0, t)` for particles that do not touch, each with its own X0."""
    x = np.array([[0.2, 0.3], [0.9, 0.8]])

    def push(X0, t):
        return jnp.stack([X0[1] * jnp.cos(50 * t), -X0[0] * t])

    scene, state = one_body(x=x, v=np.zeros((2, 2)), body_force=push, X0=x)
    end = run(scene, state, 20)
    t = DT * np.arange(20)
    exact = DT * np.stack([x[:, 1] * np.cos(50 * t).sum(), -x[:, 0] * t.sum()], axis=1)
    measure("V44", "body force on free particles", difference(end.v, exact), below=1e-12)
