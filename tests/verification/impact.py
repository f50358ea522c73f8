"""Nine blocks, one of each material, thrown onto a floor with friction: the scene of the gradients.

The blocks never meet, so one rollout, one tangent and one cotangent serve all of them: entry b of
`losses` depends on the parameters of block b alone.
"""

import jax
import jax.numpy as jnp
import numpy as np

import pgjax
import pgjax.models as pm
from pgjax.boundary import HalfSpace, Separating
from pgjax.transfer import Payload, scatter, stencil

H, SIDE, APART, FLOOR, FRICTION = 0.1, 8, 13, 3, 0.3
ROUNDING = 1e-13

# What each block is made of, and its plastic parameters. E, nu, density and v0 belong to all.
BLOCKS = {
    "fixed corotated": {},
    "hencky": {},
    "neo-hookean": {},
    "dev/vol": {},
    "metal": {"yield_stress": 2000.0, "hardening": 0.1},
    "sand": {"friction_angle": 30.0},
    "cohesive sand": {"friction_angle": 30.0, "cohesion": 0.01},
    "paste": {"yield_stress": 1000.0, "viscosity": 50.0},
    "shear-thinning paste": {"yield_stress": 1000.0, "viscosity": 50.0, "h": 0.7},
}
COUNT = len(BLOCKS)
PER_BLOCK = SIDE**2
COMMON = {
    "E": 1e5,
    "nu": 0.3,
    "density": 1000.0,
    "v0": np.array([0.5, -1.0]),
    "x0": np.array([0.0, 0.013]),
    "gravity": np.array([0.0, -9.8]),
}


def parameters() -> dict:
    """All parameters, as arrays: `{"E": …, "v0": …, "metal": {"yield_stress": …}, …}`."""
    plastic = {name: values for name, values in BLOCKS.items() if values}
    return jax.tree.map(jnp.asarray, COMMON | plastic)


def materials(p: dict) -> list[pm.Material]:
    """One material per block, in the order of `BLOCKS`."""
    E, nu = p["E"], p["nu"]
    hencky, paste = pm.StVKHencky(E, nu), pm.DevVolNeoHookean(E, nu)
    laws = [
        (pm.FixedCorotated(E, nu), None),
        (hencky, None),
        (pm.NeoHookean(E, nu), None),
        (paste, None),
        (hencky, pm.VonMises(**p["metal"])),
        (hencky, pm.DruckerPrager(**p["sand"])),
        (hencky, pm.DruckerPrager(**p["cohesive sand"], volume_correction=True)),
        (paste, pm.HerschelBulkley(**p["paste"])),
        (paste, pm.HerschelBulkley(**p["shear-thinning paste"])),
    ]
    return [pm.Material(*law, density=p["density"]) for law in laws]


def _layout() -> tuple[np.ndarray, np.ndarray]:
    """Positions of all particles (slightly irregular) and the weights of the loss."""
    rng = np.random.default_rng(0)
    axis = (np.arange(SIDE) + 0.5) * H / 2
    local = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = H * np.stack([3 + APART * np.arange(COUNT), np.full(COUNT, FLOOR)], axis=-1)
    x = corners[:, None] + local + 1e-3 * rng.standard_normal((COUNT, PER_BLOCK, 2))
    weights = (1 + rng.standard_normal(x.shape)) / PER_BLOCK
    return x.reshape(-1, 2), weights


POSITIONS, WEIGHTS = _layout()


def scene(p: dict) -> pgjax.Scene:
    """The scene for these parameters."""
    up = np.array([0.0, 1.0])
    return pgjax.Scene(
        pgjax.Grid(np.zeros(2), (APART * COUNT + 4, 14), H),
        materials(p),
        np.full(COUNT * PER_BLOCK, (H / 2) ** 2),
        counts=(PER_BLOCK,) * COUNT,
        gravity=p["gravity"],
        boundaries=(HalfSpace(FLOOR * H * up, up, Separating(FRICTION)),),
    )


def start(p: dict, dtype=jnp.float64) -> pgjax.State:
    """F = I, one velocity, a little above the floor."""
    x = jnp.asarray(POSITIONS) + p["x0"][None, :]
    return pgjax.initial_state(scene(p), x, p["v0"], dtype=dtype)


def loss(state: pgjax.State) -> jax.Array:
    """Weighted sum of the displacements of each block, m, `(blocks,)`."""
    weights = jnp.asarray(WEIGHTS, state.dtype)
    moved = state.x - jnp.asarray(POSITIONS, state.dtype)
    return jnp.sum(weights * moved.reshape(weights.shape), axis=(1, 2))


def losses(p: dict, dt: float, dtype=jnp.float64, frames: int = 10, substeps: int = 50):
    """Losses after every frame, `(frames + 1, blocks)`."""
    rollout = pgjax.simulate(
        scene(p), start(p, dtype), dt=dt, frames=frames, substeps=substeps, save=loss
    )
    return rollout.saved


def _free_velocity(s: pgjax.Scene, state: pgjax.State, dt) -> tuple[jax.Array, jax.Array]:
    """Mass and velocity of the nodes before the floor acts, `(*grid, 1)` and `(*grid, 2)`."""
    at, _ = stencil(s.grid, s.spline, state.position)
    tau = jnp.concatenate(
        [
            jax.vmap(material.elasticity.kirchhoff)(state.He[part], state.He[part])
            for material, part in zip(s.materials, s.slices, strict=True)
        ]
    )
    mass = s.masses.astype(state.dtype)[:, None]
    rows = [(0, 0), (0, 1), (0, 0)]
    flux = -dt * s.volumes.astype(state.dtype)[:, None, None] * tau[:, :2, :2]
    payload = Payload(
        jnp.concatenate([mass * state.v, mass], axis=1),
        jnp.pad(mass[:, :, None] * state.C, rows),
        jnp.pad(flux, rows),
    )
    sums = scatter(s.grid, at, payload)
    m, momentum = sums[..., 2:], sums[..., :2]
    gravity = s.gravity.astype(state.dtype)[None, None, :]
    return m, momentum / jnp.where(m > 0, m, 1) + dt * gravity


def contact(s: pgjax.Scene, state: pgjax.State, dt) -> jax.Array:
    """Per node on or behind the floor: 0 empty, 1 leaving, 2 sliding, 3 sticking."""
    m, v = _free_velocity(s, state, dt)
    m, v = m[:, : FLOOR + 3, 0], v[:, : FLOOR + 3]
    sticks = FRICTION * jnp.abs(v[..., 1]) >= jnp.abs(v[..., 0])
    pressed = jnp.where(sticks, 3, 2)
    return jnp.where(m > 0, jnp.where(v[..., 1] >= 0, 1, pressed), 0).astype(jnp.int8)


def _principal(H: jax.Array) -> jax.Array:
    """Eigenvalues of F Fᵀ − I, `(p, 3)`."""
    Ht = jnp.swapaxes(H, 1, 2)
    return jnp.linalg.eigvalsh(H + Ht + H @ Ht)


def _deviation(a: jax.Array) -> jax.Array:
    return jnp.linalg.norm(a - jnp.mean(a, axis=1, keepdims=True), axis=1)


def _branch(material: pm.Material, trial: jax.Array, history) -> jax.Array:
    """0 elastic, 1 flows (shear), 2 at the tip; from the closed formula of each law."""
    law, elasticity = material.plasticity, material.elasticity
    mu = elasticity.mu.astype(trial.dtype)
    w = _principal(trial)
    if isinstance(law, pm.VonMises):
        strength = law.yield_stress.astype(w.dtype) / (2 * mu)
        hardened = strength + law.hardening.astype(w.dtype) * history
        return (_deviation(jnp.log1p(w) / 2) > hardened).astype(jnp.int8)
    if isinstance(law, pm.HerschelBulkley):
        volume = jnp.prod(1 + w, axis=1, keepdims=True) ** (-1 / 3)
        flows = mu * _deviation(volume * (1 + w)) > (2 / 3) ** 0.5 * law.yield_stress
        return flows.astype(jnp.int8)
    shift = 0.0 if law.cohesion is None else -3 * law.cohesion.astype(w.dtype)
    shift = shift if history is None else shift + history
    trace = jnp.sum(jnp.log1p(w) / 2, axis=1) + shift
    slope = law.alpha.astype(w.dtype) * (3 * elasticity.lam.astype(w.dtype) + 2 * mu) / (2 * mu)
    cone = _deviation(jnp.log1p(w) / 2) + slope * trace > 0
    # Sand in free flight is without stress up to rounding: that is the tip.
    return jnp.where(trace > -ROUNDING, 2, cone.astype(jnp.int8)).astype(jnp.int8)


def branches(s: pgjax.Scene, before: pgjax.State, after: pgjax.State) -> jax.Array:
    """The branch each particle took in one step; 0 for the elastic blocks."""
    eye = jnp.eye(3, dtype=before.dtype)[None]
    # dt L, from the update of the total deformation gradient F ← (I + dt L) F.
    rate = (after.H - before.H) @ jnp.linalg.inv(eye + before.H)
    trial = before.He + rate @ (eye + before.He)
    parts = [
        jnp.zeros(trial[part].shape[0], jnp.int8)
        if material.plasticity is None
        else _branch(material, trial[part], history)
        for material, part, history in zip(s.materials, s.slices, before.history, strict=True)
    ]
    return jnp.concatenate(parts)


def recorded(p: dict, dt: float, dtype=jnp.float64, steps: int = 500):
    """A plain loop of `step`: losses after every step, and what was decided in each.

    Returns:
        Losses `(steps, blocks)` and the record: first node of every stencil
        `(steps, blocks, …)`, yield branch, contact of the nodes below each block.
    """
    s = scene(p)
    dt = jnp.asarray(dt, dtype)

    def one(state, _):
        after = pgjax.step(s, state, dt)
        at, _ = stencil(s.grid, s.spline, state.position)
        floor = contact(s, state, dt)[3 : 3 + APART * COUNT]
        record = {
            "cell": at.first.astype(jnp.int16).reshape(COUNT, -1),
            "yield": branches(s, state, after).reshape(COUNT, -1),
            "contact": floor.reshape(COUNT, -1),
        }
        return after, (loss(after), record)

    return jax.lax.scan(one, start(p, dtype), None, length=steps)[1]
