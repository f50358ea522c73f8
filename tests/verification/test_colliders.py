"""V31 and relatives: bodies that slide, roll, are carried and are stopped by colliders."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
from pgjax import models, sampling
from pgjax.boundary import (
    Collider,
    Complement,
    Cuboid,
    HalfSpace,
    KeyFrames,
    ParticleMotion,
    Separating,
    Slip,
    Sphere,
    Steady,
    Sticky,
)

pytestmark = pytest.mark.float64
G = 9.81


def rubber(E=1e5):
    return models.Material(models.NeoHookean(E, 0.3), density=1000.0)


def nothing(state):
    del state


def end_of(scene, state, duration, *, frames=1, save=nothing):
    frame = duration / frames
    dt = pgjax.stable_dt(scene, state, frame=frame)
    substeps = round(frame / dt)
    return pgjax.simulate(scene, state, dt=dt, frames=frames, substeps=substeps, save=save), dt


# --- A flat block on an incline ------------------------------------------------------------------


def slide(friction, v0, duration, *, angle=30.0, scheme=None):
    """A block, settled under the normal part of gravity, on a plane that is then inclined."""
    h, theta = 0.05, np.radians(angle)
    x, volumes = sampling.block((0.2, 2 * h), (0.4, 3 * h), h / 2)
    down = -G * np.cos(theta)

    def scene(along, damping):
        floor = Collider(HalfSpace((0.0, 2 * h), (0.0, 1.0)), Separating(friction))
        grid = pgjax.Grid((0, 0), (60, 8), h)
        options = {"boundaries": [floor], "scheme": scheme, "grid_damping": damping}
        return pgjax.Scene(grid, rubber(), volumes, gravity=(along, down), **options)

    level, inclined = scene(0.0, 40.0), scene(G * np.sin(theta), 0.0)
    rest = end_of(level, pgjax.initial_state(level, x), 0.5)[0].final
    moving = jnp.broadcast_to(jnp.asarray([v0, 0.0]), rest.v.shape)
    start = eqx.tree_at(
        lambda s: (s.v, s.C, s.step), rest, (moving, 0 * rest.C, jnp.zeros((), jnp.int32))
    )
    trajectory, dt = end_of(inclined, start, duration)
    return float(jnp.mean(trajectory.final.x - start.x, axis=0)[0]), dt


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.4])
@pytest.mark.parametrize("scheme", [None, pgjax.MLS()], ids=["grad", "mls"])
def test_v31_sliding_block(friction, scheme, measure):
    """`x = v₀ t + ½ a t²`, `a = g (sin θ − μ cos θ)`, in the sum of the steps taken."""
    v0, duration = 1.0, 0.6
    x, dt = slide(friction, v0, duration, scheme=scheme)
    a = G * (np.sin(np.pi / 6) - friction * np.cos(np.pi / 6))
    n = round(duration / dt)
    exact = v0 * duration + a * dt * dt * n * (n + 1) / 2
    name = f"block, friction {friction}, {'mls' if scheme else 'grad'}, relative error"
    measure("V31", name, abs(x / exact - 1), below=1e-10 if friction == 0 else 1e-5)


def test_v31_block_sticks(measure):
    """tan θ < μ: it stays, but for its own elastic shear (of the order of 1 mm)."""
    x, _ = slide(0.7, 0.0, 1.0)
    later, _ = slide(0.7, 0.0, 2.0)
    measure("V31", "block with μ > tan θ: way in the first second, m", x, below=1e-3)
    measure("V31", "block with μ > tan θ: way in the second, m", later - x, below=2e-5)


# --- A bowl --------------------------------------------------------------------------------------


def fall_into_bowl(fraction, contact):
    """A small body slides down a frictionless bowl: speed at the lowest point over √(2 g drop)."""
    h, R, angle = 0.05, 1.0, np.radians(60)
    grid = pgjax.Grid((-1.3, -1.3), (52, 40), h)
    # Sunk in so far that all its nodes are in the wall: a point mass on a circle.
    x, volumes = sampling.ball((1.07 * np.sin(angle), -1.07 * np.cos(angle)), 0.03, h / 2)
    bowl = Collider(Complement(Sphere((0.0, 0.0), R)), contact)
    scene = pgjax.Scene(grid, rubber(1e6), volumes, gravity=(0, -G), boundaries=[bowl])
    state = pgjax.initial_state(scene, x)
    dt = pgjax.stable_dt(scene, state, frame=0.028, fraction=fraction)
    trajectory = pgjax.simulate(
        scene,
        state,
        dt=dt,
        frames=25,
        substeps=round(0.028 / dt),
        save=lambda s: (jnp.mean(s.x, axis=0), jnp.mean(s.v, axis=0)),
    )
    place, velocity = (np.asarray(a) for a in trajectory.saved)
    i = np.argmin(place[:, 1])
    assert 5 < i < 25
    return np.linalg.norm(velocity[i]) / np.sqrt(2 * G * (place[0, 1] - place[i, 1]))


@pytest.mark.slow
def test_v31_bowl(measure):
    fine = fall_into_bowl(0.1, Slip())
    coarse = fall_into_bowl(0.2, Separating(0.0))
    measure("V31", "bowl: speed at the bottom over √(2 g drop), error", abs(fine - 1), below=1e-3)
    measure("V31", "bowl, twice the time step, separating: error", abs(coarse - 1), below=2e-3)


# --- Moving bodies -------------------------------------------------------------------------------


def test_conveyor(measure):
    """`v = μ g t` on a belt until it has the speed of the belt, which it then keeps."""
    h, speed, friction = 0.05, 0.6, 0.3
    x, volumes = sampling.block((0.2, 2 * h), (0.4, 3 * h), h / 2)
    belt = Collider(
        HalfSpace((0.0, 2 * h), (0.0, 1.0)), Separating(friction), surface_velocity=(speed, 0.0)
    )
    grid = pgjax.Grid((0, 0), (30, 8), h)
    scene = pgjax.Scene(grid, rubber(), volumes, gravity=(0, -G), boundaries=[belt])
    state = pgjax.initial_state(scene, x)
    early, _ = end_of(scene, state, 0.15)
    gained = float(jnp.mean(early.final.v, axis=0)[0])
    measure(
        "conveyor",
        "speed over μ g t while it slides",
        gained / (friction * G * 0.15),
        within=(0.99, 1.01),
    )
    late, _ = end_of(scene, state, 0.5)
    kept = float(jnp.mean(late.final.v, axis=0)[0])
    measure("conveyor", "speed over that of the belt", kept / speed, within=(0.99, 1.01))


def drum(material, contact, *, h=1 / 24, omega=0.8, fill=0.0, damping=0.0):
    """A drum of radius 0.4 that turns about its axis, filled up to the height `fill`."""
    grid = pgjax.Grid((-0.5, -0.5), (24, 24), h)
    x, volumes = sampling.ball((0.0, 0.0), 0.4, h / 2)
    kept = x[:, 1] < fill
    x, volumes = x[kept], volumes[kept]
    wall = Collider(Complement(Sphere((0.0, 0.0), 0.4)), contact, Steady((0.0, 0.0), omega))
    options = {"boundaries": [wall], "gravity": (0.0, -G), "grid_damping": damping}
    scene = pgjax.Scene(grid, material, volumes, **options)
    return scene, pgjax.initial_state(scene, x)


def test_drum_takes_a_sticking_body_along(measure):
    """A rubber core glued into a drum turns with it, once it has been spun up."""
    scene, state = drum(rubber(3e4), Sticky(), omega=2.0, fill=1.0)
    scene = eqx.tree_at(
        lambda s: (s.gravity, s.shear_damping), scene, (jnp.zeros(2), jnp.asarray(30.0))
    )
    end = end_of(scene, state, 1.0)[0].final
    spin = (end.C[:, 1, 0] - end.C[:, 0, 1]) / 2
    measure(
        "drum", "spin of the core over that of the drum", jnp.mean(spin) / 2.0, within=(0.98, 1.02)
    )
    turned = jnp.sum(end.x[:, 0] * state.x[:, 1] - end.x[:, 1] * state.x[:, 0])
    assert float(turned) < 0  # counter-clockwise, as a positive rate says


@pytest.mark.parametrize(("phi", "acts_as"), [(20.0, 24.0), (30.0, 34.7)])
def test_sand_in_a_drum_is_inclined_by_its_angle_of_repose(phi, acts_as, measure):
    """The centre of mass is carried up on the side that rises, to the angle the sand can hold.

    In plane strain that is `tan = 2√3 sin φ/(3 − sin φ)`; the surface of flowing sand is a few
    degrees steeper. The first avalanche, at 1.5 s, is left out.
    """
    sand = models.Material(models.StVKHencky(1e5, 0.3), models.DruckerPrager(phi), 1500.0)
    scene, state = drum(sand, Separating(1.0), fill=-0.05, omega=0.5)

    def save(s):
        return jnp.mean(s.x, axis=0), jnp.max(jnp.linalg.norm(s.x, axis=1))

    center, reach = end_of(scene, state, 5.0, frames=20, save=save)[0].saved
    x, y = np.asarray(center).T
    steeper = np.degrees(np.arctan2(x, -y))[12:].mean() - acts_as
    measure("drum", f"φ = {phi}: mean inclination above {acts_as}°", steeper, within=(0.0, 5.0))
    measure("drum", f"φ = {phi}: furthest beyond the wall, m", reach.max() - 0.4, below=1 / 48)


def test_sand_on_a_smooth_drum_stays_level(measure):
    sand = models.Material(models.StVKHencky(1e5, 0.3), models.DruckerPrager(30.0), 1500.0)
    scene, state = drum(sand, Separating(0.0), fill=-0.05)
    end = end_of(scene, state, 1.5)[0].final
    x, y = np.asarray(jnp.mean(end.x, axis=0))
    angle = abs(np.degrees(np.arctan2(x, -y)))
    measure("drum", "smooth wall: inclination, degrees", angle, below=1.0)


def press(h):
    """Stretch and stress over closed form in the middle of a bar pressed to nine tenths."""
    L, E, nu, s = 0.5, 1e5, 0.3, 0.9
    x, volumes = sampling.block((0.1, 0.0), (0.1 + L, h), h / 2)
    grid = pgjax.Grid((0, 0), (round(0.7 / h), 1), h, periodic=(False, True))
    # Slowly against the sound speed, and then held.
    path = KeyFrames((0.0, 0.4, 10.0), [(0, 0), ((s - 1) * L, 0), ((s - 1) * L, 0)])
    walls = [
        Collider(HalfSpace((0.1, 0.0), (1.0, 0.0)), Slip()),
        Collider(HalfSpace((0.1 + L, 0.0), (-1.0, 0.0)), Slip(), path),
    ]
    scene = pgjax.Scene(grid, rubber(E), volumes, boundaries=walls, grid_damping=20.0)
    end = end_of(scene, pgjax.initial_state(scene, x), 1.0)[0].final
    middle = abs(x[:, 0] - 0.3) < 0.1
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    law = scene.materials[0].elasticity
    tau = jax.vmap(lambda H: law.kirchhoff(H, jnp.zeros_like(H)))(end.He)[:, 0, 0]
    stress = np.asarray(tau)[middle] / (mu * (s * s - 1) + lam * np.log(s))
    return np.asarray(end.F)[middle, 0, 0].mean(), stress


def test_v33_piston(measure):
    """Uniaxial strain between a wall and a piston: the stress of simple compression.

    Nodes see the piston once it has passed them: its place is uncertain by part of a cell, at h/L
    = 1/20 and 1/40, and the error follows h.
    """
    errors = []
    for h in (0.025, 0.0125):
        stretch, stress = press(h)
        errors.append(abs(stretch - 0.9))
        measure("V33", f"piston, h = {h}: spread of the stress", np.std(stress), below=0.02)
    measure("V33", "piston: error of the stretch at h/L = 1/40", errors[1], below=0.5 / 40)
    measure("V33", "piston: error at twice h, ratio", errors[0] / errors[1], within=(1.5, 2.8))
    measure("V33", "piston: stress over closed form", stress.mean(), within=(0.88, 1.0))


def test_a_body_in_a_collider_is_pushed_and_nothing_is_nan():
    """Particles that start inside a body which moves at the sound speed: finite, and carried."""
    x, volumes = sampling.ball((0.5, 0.5), 0.15, 0.05)
    c = 10.0
    ram = Collider(Cuboid((0.45, 0.5), (0.2, 0.2)), Separating(0.2), Steady((c, 0.0), end=0.02))
    grid = pgjax.Grid((0, 0), (24, 12), 0.1)
    scene = pgjax.Scene(grid, rubber(), volumes, boundaries=[ram])
    state = pgjax.initial_state(scene, x)
    trajectory = pgjax.simulate(scene, state, dt=5e-4, frames=4, substeps=10)
    assert bool(trajectory.status.ok)
    assert float(jnp.mean(trajectory.final.x[:, 0])) > 0.6
    assert bool(jnp.isfinite(trajectory.final.He).all())


# --- Derivatives ---------------------------------------------------------------------------------


def throw(friction, speed, spin, center, *, fall=0.02):
    """A drop on a moving, turning disc and a held corner: mean place and speed after 80 steps."""
    x, volumes = sampling.ball((0.5, 0.62), 0.12, 0.05)
    disc = Collider(
        Sphere((center, 0.3), 0.2),
        Separating(friction),
        Steady(jnp.stack([speed, 0 * speed]), spin, jnp.stack([center, 0 * center + 0.3])),
    )
    grid = pgjax.Grid((0, 0), (10, 10), 0.1)
    hold = ParticleMotion(x[:, 1] > 0.7, Steady(jnp.stack([0 * speed, -speed])), end=fall)
    options = {"boundaries": [disc], "particle_conditions": [hold], "gravity": (0, -G)}
    scene = pgjax.Scene(grid, rubber(), volumes, **options)
    state = pgjax.initial_state(scene, x, v=(0.3, -3.0))
    trajectory = pgjax.simulate(scene, state, dt=1e-3, frames=1, substeps=80, save=nothing)
    end = trajectory.final
    return jnp.concatenate([jnp.mean(end.x, axis=0), jnp.mean(end.v, axis=0)])


@pytest.mark.slow
def test_derivatives_in_the_parameters_of_colliders(measure):
    """Forward = reverse = central differences, for friction, velocity, spin and place.

    A node that comes to lie inside or outside is a jump: the differences are taken over steps so
    small that none does.
    """
    at = tuple(jnp.asarray(a) for a in (0.3, 0.8, 3.0, 0.52))
    forward = jax.jit(jax.jacfwd(throw, argnums=(0, 1, 2, 3)))(*at)
    reverse = jax.jit(jax.jacrev(throw, argnums=(0, 1, 2, 3)))(*at)
    value = jax.jit(throw)
    for k, name in enumerate(("friction", "velocity", "spin", "place")):
        f, r = np.asarray(forward[k]), np.asarray(reverse[k])
        size = np.abs(f).max()
        assert size > 1e-5
        measure(
            "colliders", f"{name}: forward against reverse", np.abs(f - r).max() / size, below=1e-11
        )
        eps = 1e-7
        high, low = ([*at[:k], at[k] + s * eps, *at[k + 1 :]] for s in (1, -1))
        difference = np.asarray(value(*high) - value(*low)) / (2 * eps)
        error = np.abs(f - difference).max() / size
        measure("colliders", f"{name}: against central differences", error, below=1e-5)
