"""Nine blocks, one of each material, thrown onto a floor with friction: the scene of the gradients.

The blocks never meet: block b depends on its own parameters alone, so one rollout, one tangent
and one cotangent serve all of them.
"""

import jax
import jax.numpy as jnp
import numpy as np

import pgjax
import pgjax.models as pm
from pgjax.boundary import Collider, HalfSpace, Separating
from pgjax.models.material import cast
from pgjax.transfer import Payload, scatter, stencil

# Spacing, particles along a side of a block, cells from one block to the next, node of the floor.
H, SIDE, APART, FLOOR, FRICTION = 0.1, 8, 15, 3, 0.3
FRAMES, SUBSTEPS = 10, 50
STEPS = FRAMES * SUBSTEPS

# Each block and its plastic parameters. The most sensitive stand near the origin of the grid,
# where positions are rounded least.
BLOCKS = {
    "sand": {"friction_angle": 30.0},
    "paste": {"yield_stress": 800.0, "viscosity": 50.0},
    "shear-thinning paste": {"yield_stress": 500.0, "viscosity": 300.0, "h": 0.7},
    "metal": {"yield_stress": 1000.0, "hardening": 0.1},
    "cohesive sand": {"friction_angle": 30.0, "cohesion": 0.01},
    "fixed corotated": {},
    "hencky": {},
    "neo-hookean": {},
    "dev/vol": {},
}
COUNT, PER_BLOCK = len(BLOCKS), SIDE**2
ELASTIC = {"E": 4e4, "nu": 0.3, "density": 1000.0}


def parameters() -> dict:
    """All parameters: one value per block, the plastic ones under the name of their block."""
    return {
        **{name: jnp.full((COUNT,), value) for name, value in ELASTIC.items()},
        "v0": jnp.tile(jnp.asarray([0.3, -1.0]), (COUNT, 1)),
        "x0": jnp.tile(jnp.asarray([0.0, 0.013]), (COUNT, 1)),
        "gravity": jnp.asarray([0.0, -9.8]),
        **{name: jax.tree.map(jnp.asarray, own) for name, own in BLOCKS.items() if own},
    }


def materials(p: dict) -> list[pm.Material]:
    """One material per block, in the order of `BLOCKS`."""
    laws = [
        (pm.StVKHencky, pm.DruckerPrager(**p["sand"])),
        (pm.DevVolNeoHookean, pm.HerschelBulkley(**p["paste"])),
        (pm.DevVolNeoHookean, pm.HerschelBulkley(**p["shear-thinning paste"])),
        (pm.StVKHencky, pm.VonMises(**p["metal"])),
        (pm.StVKHencky, pm.DruckerPrager(**p["cohesive sand"], volume_correction=True)),
        (pm.FixedCorotated, None),
        (pm.StVKHencky, None),
        (pm.NeoHookean, None),
        (pm.DevVolNeoHookean, None),
    ]
    return [
        pm.Material(elasticity(p["E"][b], p["nu"][b]), plasticity, density=p["density"][b])
        for b, (elasticity, plasticity) in enumerate(laws)
    ]


def _layout() -> np.ndarray:
    """Positions of all particles, slightly irregular, `(blocks, particles, 2)`."""
    axis = (np.arange(SIDE) + 0.5) * H / 2
    local = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = H * np.stack([3 + APART * np.arange(COUNT), np.full(COUNT, FLOOR)], axis=-1)
    x = corners[:, None] + local
    return x + 1e-3 * np.random.default_rng(0).standard_normal(x.shape)


POSITIONS = _layout()


def scene(p: dict) -> pgjax.Scene:
    """The scene for these parameters."""
    up = np.array([0.0, 1.0])
    return pgjax.Scene(
        pgjax.Grid(np.zeros(2), (APART * COUNT + 4, 14), H),
        materials(p),
        np.full(COUNT * PER_BLOCK, (H / 2) ** 2),
        counts=(PER_BLOCK,) * COUNT,
        gravity=p["gravity"],
        boundaries=(Collider(HalfSpace(FLOOR * H * up, up), Separating(FRICTION)),),
    )


def start(p: dict, dtype=jnp.float64) -> pgjax.State:
    """F = I, one velocity per block, a little above the floor."""
    x = jnp.asarray(POSITIONS) + p["x0"][:, None, :]
    v = jnp.broadcast_to(p["v0"][:, None, :], x.shape)
    return pgjax.initial_state(scene(p), x.reshape(-1, 2), v.reshape(-1, 2), dtype=dtype)


def displacement(state: pgjax.State) -> jax.Array:
    """What is differentiated: how far every particle moved, m, `(blocks, particles, 2)`."""
    return state.x.reshape(POSITIONS.shape) - jnp.asarray(POSITIONS, state.dtype)


def simulated(p: dict, dt) -> jax.Array:
    """`displacement` after every frame through `simulate`, `(FRAMES, blocks, particles, 2)`."""
    rollout = pgjax.simulate(
        scene(p), start(p), dt=dt, frames=FRAMES, substeps=SUBSTEPS, save=displacement
    )
    return rollout.saved[1:]


def recorded(p: dict, dt, steps, dtype=jnp.float64) -> tuple[jax.Array, dict]:
    """A plain loop of `step`, and what was decided in each of the steps.

    Returns:
        `displacement` after every frame, and the record of each step, one row per block: first
        node of every stencil, branch of the return map, contact of the nodes of the floor.
    """
    s, dt = cast(scene(p), dtype), jnp.asarray(dt, dtype)
    initial = start(p, dtype)

    def decided(before, after):
        at, _ = stencil(s.grid, s.spline, before.position)
        return {
            "cell": at.first.astype(jnp.int16).reshape(COUNT, -1),
            "branch": _branches(s, before, after).reshape(COUNT, -1),
            "contact": _contact(s, before, at, dt),
        }

    def one(i, carry):
        state, record = carry
        after = pgjax.step(s, state, dt)
        now = decided(state, after) | {"moved": displacement(after)}
        return after, jax.tree.map(lambda all_, a: all_.at[i].set(a), record, now)

    shapes = jax.eval_shape(lambda a: decided(a, a) | {"moved": displacement(a)}, initial)
    record = jax.tree.map(lambda a: jnp.zeros((STEPS, *a.shape), a.dtype), shapes)
    _, record = jax.lax.fori_loop(0, steps, one, (initial, record))
    return record.pop("moved")[SUBSTEPS - 1 :: SUBSTEPS], record


def _contact(s: pgjax.Scene, state: pgjax.State, at, dt) -> jax.Array:
    """Per block and node of the floor: 0 empty, 1 leaving, 2 sliding, 3 sticking."""
    m, v = _free_velocity(s, state, at, dt)
    columns, rows = slice(2, 2 + APART * COUNT), slice(0, FLOOR + 3)
    m, v = m[columns, rows, 0], v[columns, rows]
    sticks = FRICTION * jnp.abs(v[..., 1]) >= jnp.abs(v[..., 0])
    pressed = jnp.where(sticks, 3, 2)
    state_of = jnp.where(m > 0, jnp.where(v[..., 1] >= 0, 1, pressed), 0)
    return state_of.astype(jnp.int8).reshape(COUNT, -1)


def _free_velocity(s: pgjax.Scene, state: pgjax.State, at, dt) -> tuple[jax.Array, jax.Array]:
    """Mass and velocity of the nodes before the floor acts, `(*grid, 1)` and `(*grid, 2)`."""
    stress = [
        jax.vmap(lambda H, law=material.elasticity: law.kirchhoff(H, H))(state.He[part])
        for material, part in zip(s.materials, s.slices, strict=True)
    ]
    mass = s.masses[:, None]
    flux = -dt * s.volumes[:, None, None] * jnp.concatenate(stress)[:, :2, :2]
    momentum = jnp.concatenate([mass * state.v, mass], axis=1)
    payload = Payload(momentum, mass[:, :, None] * state.C, flux)
    sums = scatter(s.grid, at, payload)
    m, momentum = sums[..., 2:], sums[..., :2]
    return m, momentum / jnp.where(m > 0, m, 1) + (dt * s.gravity)[None, None, :]


def _branches(s: pgjax.Scene, before: pgjax.State, after: pgjax.State) -> jax.Array:
    """The branch of the return map each particle took in one step; 0 for the elastic blocks."""
    eye = jnp.eye(3, dtype=before.dtype)[None]
    # dt L, from the update of the total deformation gradient F ← (I + dt L) F.
    rate = (after.H - before.H) @ jnp.linalg.inv(eye + before.H)
    trial = before.He + rate @ (eye + before.He)
    transposed = jnp.swapaxes(trial, 1, 2)
    w = jnp.linalg.eigvalsh(trial + transposed + trial @ transposed)
    parts = [
        jnp.zeros(w[part].shape[0], jnp.int8)
        if material.plasticity is None
        else _branch(material, w[part], history).astype(jnp.int8)
        for material, part, history in zip(s.materials, s.slices, before.history, strict=True)
    ]
    return jnp.concatenate(parts)


def _branch(material: pm.Material, w: jax.Array, history) -> jax.Array:
    """0 elastic, 1 flows, 2 tip, from the formula of the law; w are the eigenvalues of b − I."""
    law, mu, lam = material.plasticity, material.elasticity.mu, material.elasticity.lam
    strain = jnp.log1p(w) / 2
    norm = jnp.linalg.norm(strain - jnp.mean(strain, axis=1, keepdims=True), axis=1)
    if isinstance(law, pm.VonMises):
        return norm > law.yield_stress / (2 * mu) + law.hardening * history
    if isinstance(law, pm.HerschelBulkley):
        b = (1 + w) * jnp.prod(1 + w, axis=1, keepdims=True) ** (-1 / 3)
        shear = jnp.linalg.norm(b - jnp.mean(b, axis=1, keepdims=True), axis=1)
        return mu * shear > (2 / 3) ** 0.5 * law.yield_stress
    trace = jnp.sum(strain, axis=1)
    trace = trace if law.cohesion is None else trace - 3 * law.cohesion
    trace = trace if history is None else trace + history
    cone = norm + law.alpha * (3 * lam + 2 * mu) / (2 * mu) * trace > 0
    # Sand in free flight is without stress up to rounding: that is the tip.
    rounding = 10 * jnp.finfo(w.dtype).eps
    return jnp.where(trace > -rounding, 2, cone.astype(jnp.int32))
