"""Scenes over eight simulated devices, measured against one device: `python parallel_cases.py`.

Prints what each case found as one line of JSON. The number of devices of a process is fixed when
JAX starts, so that the tests run this as a program of its own.
"""

import json
import os
import sys
import warnings

os.environ["XLA_FLAGS"] = " ".join(
    [
        "--xla_force_host_platform_device_count=8",
        # They run for milliseconds and compile for seconds.
        "--xla_backend_optimization_level=0",
        "--xla_llvm_disable_expensive_passes=true",
    ]
)

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import typecheck  # noqa: F401
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
install_import_hook("pgjax", "typecheck.check")

import pgjax  # noqa: E402
from pgjax import boundary, models, parallel, sampling  # noqa: E402
from pgjax.result import Condition  # noqa: E402

LAYOUTS = {"shared": parallel.SharedGrid(), "slabs": parallel.Slabs()}
H = 1 / 40
DT = 2e-4


def furthest(found, expected):
    """The largest difference of any leaf over the largest value of that leaf."""
    worst, place = 0.0, ""
    leaves = jax.tree_util.tree_leaves_with_path(expected)
    for (path, b), a in zip(leaves, jax.tree.leaves(found), strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        assert a.shape == b.shape
        if b.size:
            size = np.max(np.abs(np.where(np.isfinite(b), b, 0)), initial=0)
            off = float(np.max(np.where(a == b, 0, np.abs(a - b))) / max(size, 1e-3))
            if off > worst:
                worst, place = off, jax.tree_util.keystr(path)
    print(f"{worst:.1e} at {place}", file=sys.stderr)
    return worst


def bar(E, v):
    """A bar of metal that flies along a long box and hits its end; scene and state."""
    grid = pgjax.Grid((0.5, -0.2, 0.0), (42, 8, 8), H)
    x, volumes = sampling.block((0.6, -0.15, 0.05), (1.3, -0.05, 0.15), spacing=H / 2)
    metal = models.Material(models.StVKHencky(E, 0.3), models.VonMises(400.0, 0.3))
    box = boundary.Box((0.55, -0.15, 0.05), (1.45, -0.05, 0.15), boundary.Separating(0.2))
    scene = pgjax.Scene(grid, metal, volumes, gravity=(0, 0, -9.81), boundaries=[box])
    stretched = jnp.asarray(x)[:, :1] * jnp.array([[0.4, 0.0, 0.1]])
    return scene, pgjax.initial_state(scene, x, v[None, :] + stretched)


V0 = jnp.array([16.0, 0.3, -0.5])
BAR = {"dt": DT, "frames": 2, "substeps": 25}


def bar_forward():
    """Both layouts on the native path (or without, as the environment says)."""
    scene, state = bar(2e5, V0)
    alone = pgjax.simulate(scene, state, **BAR)
    x = np.asarray(alone.saved.x[:, :, 0] - 0.5) / H
    cells = np.floor(x).astype(int)
    found = {"crossed": float(np.mean(np.abs(cells[-1] - cells[0]) >= 6))}
    seldom = parallel.Slabs(axis=0, starts=(5, 10, 15, 20, 25, 30, 35), capacity=2000, every=3)
    for name, layout in (("shared", parallel.SharedGrid()), ("slabs", seldom)):
        # The second frame goes on from the end of the first.
        frame = {**BAR, "frames": 1, "layout": layout}
        middle = parallel.simulate(scene, state, **frame)
        end = parallel.simulate(scene, middle.final, **frame)
        found[name] = furthest(end.final, alone.final)
        found[f"{name} saved"] = furthest(end.saved.F[1], alone.saved.F[2])
    return found


def bar_gradients():
    """With respect to stiffness and initial velocity, in both modes, and by differences."""

    def loss(E, v, run, **how):
        scene, state = bar(E, v)
        x = run(scene, state, **BAR, **how).saved.x[-1]
        return jnp.mean(jnp.sin(9 * x)) + jnp.mean(x[:, 2] ** 2)

    at, along = (jnp.asarray(2e5), V0), (jnp.asarray(3e4), jnp.array([0.2, 0.5, -0.3]))
    one = eqx.filter_jit(lambda *at: jax.grad(loss, (0, 1))(*at, pgjax.simulate))(*at)
    found = {}
    for name, layout in LAYOUTS.items():

        def shared(*at, layout=layout):
            return loss(*at, parallel.simulate, layout=layout)

        both = jax.jit(jax.grad(shared, (0, 1)))(*at)
        found[name] = furthest(both, one)
        slope = float(both[0] * along[0] + both[1] @ along[1])
        forward = float(jax.jit(lambda *a, f=shared: jax.jvp(f, at, a)[1])(*along))
        found[f"{name} forward mode"] = abs(forward / slope - 1)
        run, step = jax.jit(shared), 1e-5
        ahead, behind = (
            run(*(a + s * step * d for a, d in zip(at, along, strict=True))) for s in (1, -1)
        )
        found[f"{name} differences"] = abs(float(ahead - behind) / (2 * step) / slope - 1)
    return found


def _slowed(particles, t, dt):
    """Towards the mean velocity: a condition that looks at all particles at once."""
    del t
    mass = particles.mass[:, None]
    mean = parallel.total(jnp.sum(mass * particles.v, 0)) / parallel.total(jnp.sum(mass))
    return particles._replace(v=particles.v + 5 * dt * (mean[None, :] - particles.v))


def conditions_of(x):
    """Some of each kind, and one of the caller's own."""
    mask = np.arange(len(x)) % 5 == 0
    return [
        boundary.ParticleImpulse(mask, (0.05, 0.1), start=5 * DT, duration=10 * DT),
        boundary.ParticleForce(~mask, (0.0, 3.0)),
        boundary.ParticleMotion(
            x[:, 0] > 0.9,
            boundary.Steady((-0.5, 0.1)),
            end=np.where(x[:, 1] > 0.15, 15 * DT, 50 * DT),
        ),
        boundary.Wind((3.0, 0.0), 0.5, mask=mask),
        _slowed,
    ]


def mixed():
    """Two materials, every kind of condition, a particle that leaves, accounts; in the plane."""
    grid = pgjax.Grid((0.0, 0.0), (44, 14), H)
    blocks = [sampling.block((a, 0.1), (a + 0.4, 0.2), spacing=H / 2) for a in (0.1, 0.55)]
    counts = [len(b[0]) for b in blocks]
    x, volumes = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
    # One particle above the others is thrown out.
    x[-1] = 0.55, 0.3
    v = np.stack([1.5 + np.sin(40 * x[:, 0]), np.cos(30 * x[:, 0])], axis=1)
    v[-1] = 0.0, 40.0
    E = jnp.full(counts[0], 3e4).at[::3].set(5e4)
    jelly = models.FixedCorotated(E, 0.3)
    sand = models.StVKHencky(4e4, 0.3), models.DruckerPrager(30.0, 5.0, True)
    materials = [
        models.Material(jelly, density=jnp.linspace(900.0, 1100.0, counts[0])),
        models.Material(*sand),
    ]
    ball = boundary.Sphere((0.5, 0.12), 0.06)
    walls = [
        boundary.Collider(boundary.HalfSpace((0.0, 0.1), (0.05, 1.0))),
        boundary.Collider(ball, boundary.Separating(0.4), boundary.Steady((0.4, 0.0))),
    ]
    scene = pgjax.Scene(
        grid, materials, volumes, counts=counts, gravity=(0, -9.81), boundaries=walls,
        particle_conditions=conditions_of(x), X0=x, grid_damping=0.3, shear_damping=2.0,
        body_force=lambda X, t: jnp.stack([jnp.sin(9 * X[1]), 40 * t]),
    )  # fmt: skip
    state = pgjax.initial_state(scene, x, v)
    run = {"dt": DT, "frames": 2, "substeps": 20, "throw": False, "ledger": True}
    alone = pgjax.simulate(scene, state, **run)
    found = {"lost": int(alone.status.count[Condition.OUT_OF_DOMAIN])}
    for name, layout in LAYOUTS.items():
        out = parallel.simulate(scene, state, layout=layout, **run)
        found[name] = furthest(out, alone)
        found[f"{name} status"] = furthest(out.status, alone.status)
    return found


def laws():
    """More laws, one after the other across the slabs, with conditions of particles."""
    grid = pgjax.Grid((0.0, 0.0), (44, 14), H)
    dev_vol = models.DevVolNeoHookean(4e4, 0.3)
    materials = [
        models.Material(models.NeoHookean(4e4, 0.3)),
        models.Material(dev_vol, models.HerschelBulkley(200.0, 30.0, 0.6)),
        models.Material(models.Fluid(2e4, 0.4, 7.0)),
    ]
    blocks = [sampling.block((a, 0.1), (a + 0.25, 0.2), spacing=H / 2) for a in (0.1, 0.4, 0.7)]
    x, volumes = (np.concatenate(arrays) for arrays in zip(*blocks, strict=True))
    counts = [len(b[0]) for b in blocks]
    v = np.stack([3 + np.sin(40 * x[:, 0]), np.cos(30 * x[:, 0])], axis=1)
    # One particle above the others is thrown out.
    x[-1], v[-1] = (0.55, 0.3), (0.0, 40.0)
    scene = pgjax.Scene(
        grid, materials, volumes, counts=counts, particle_conditions=conditions_of(x)
    )
    state = pgjax.initial_state(scene, x, v)
    run = {"dt": DT, "frames": 1, "substeps": 30, "throw": False}
    alone = pgjax.simulate(scene, state, **run)
    out = parallel.simulate(scene, state, layout=parallel.Slabs(every=2), **run)
    return {
        "lost": int(alone.status.count[Condition.OUT_OF_DOMAIN]),
        "status": furthest(out.status, alone.status),
        "slabs": furthest(out, alone),
    }


def periodic():
    """Particles go round and meet a body across the seam; with derivatives."""
    grid = pgjax.Grid((0.0, 0.0), (44, 8), H, periodic=(True, False))
    x, volumes = sampling.block((0.1, 0.05), (1.0, 0.15), spacing=H / 2)
    body = boundary.Collider(boundary.Sphere((0.02, 0.1), 0.03), boundary.Slip())
    floor = boundary.Collider(boundary.HalfSpace((0.0, 0.05), (0.0, 1.0)))

    def loss(E, v, run, **how):
        jelly = models.Material(models.NeoHookean(E, 0.3))
        scene = pgjax.Scene(grid, jelly, volumes, gravity=(0, -3), boundaries=[floor, body])
        state = pgjax.initial_state(scene, x, v)
        final = run(
            scene, state, dt=DT, frames=1, substeps=40, throw=False, keep_states=True, **how
        ).final
        return jnp.mean(jnp.sin(9 * final.x)), final

    at = jnp.asarray(2e4), jnp.array([20.0, 0.1])
    both = jax.value_and_grad(loss, (0, 1), has_aux=True)
    (_, alone), slopes = both(*at, pgjax.simulate)
    (_, out), found = both(*at, parallel.simulate, layout=parallel.Slabs())
    return {
        "around": float(np.mean(np.asarray(alone.x[:, 0]) > 44 * H)),
        "slabs": furthest(out, alone),
        "slopes": furthest(found, slopes),
    }


def overflow():
    """More particles want to be in a slab than there is room for."""
    grid = pgjax.Grid((0.0, 0.0), (40, 8), H)
    x, volumes = sampling.block((0.1, 0.05), (0.9, 0.15), spacing=H / 2)
    gas = models.Material(models.NeoHookean(100.0, 0.0))
    scene = pgjax.Scene(grid, gas, volumes)
    # All rush to the middle.
    state = pgjax.initial_state(scene, x, v=np.stack([8 * np.sign(0.5 - x[:, 0]), 0 * x[:, 1]], 1))
    slabs = parallel.Slabs(starts=(5, 10, 15, 20, 25, 30, 35), capacity=88)
    run = {"dt": 5e-4, "frames": 1, "substeps": 60, "layout": slabs}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        out = parallel.simulate(scene, state, throw=False, **run)
        try:
            parallel.simulate(scene, state, **run)
        except pgjax.SimulationError as error:
            message = str(error)
    return {
        "counted": int(out.status.count[Condition.OVERFLOW]),
        "masked": int(np.sum(~np.asarray(out.final.alive))),
        "others": int(np.sum(np.asarray(out.status.count[jnp.array([0, 1])]))),
        "finite": bool(np.all(np.isfinite(out.saved.x))),
        "message": message,
    }


CASES = {f.__name__: f for f in (bar_forward, bar_gradients, mixed, laws, periodic, overflow)}

if __name__ == "__main__":
    for name in sys.argv[1:]:
        print(json.dumps({"case": name, **CASES[name]()}), flush=True)
