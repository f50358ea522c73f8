"""Scenes with an exact solution: order in time, vortex, column, film (V25, V26, V28, V29)."""

import itertools

import energies
import equinox as eqx
import jax
import jax.numpy as jnp
import manufactured
import numpy as np
import pytest
from scenes import SCHEMES, itself, lattice, positions, roll, wide, without_affine

import pgjax.models as pm
from pgjax._types import parameter
from pgjax.boundary import Collider, HalfSpace, Slip, Sticky
from pgjax.grid import Grid
from pgjax.result import Condition
from pgjax.scene import Scene, initial_state
from pgjax.simulate import simulate
from pgjax.step import step

pytestmark = pytest.mark.float64


def fast(*names):
    """All schemes, those not named only among the slow tests."""
    return [n if n in names else pytest.param(n, marks=pytest.mark.slow) for n in SCHEMES]


def rms(a):
    """Root of the mean square of vectors, the last axis."""
    return np.sqrt(np.mean(np.sum(np.square(a), axis=-1), axis=-1))


# --- V25: order in time --------------------------------------------------------------------------


@eqx.filter_jit
def advance(scene, state, dt, steps, after):
    """So many steps: their number compiles nothing."""
    return jax.lax.fori_loop(0, steps, lambda _, s: after(step(scene, s, dt)), state)


def standing_wave(n, name):
    """V24's wave in one dimension, y, where it starts fully deformed; scene, state, X."""
    spline, scheme, _ = SCHEMES[name]
    moves = np.array([0.0, 1.0])
    X = lattice((0, 0), (1, n), 1 / n)
    scene = Scene(
        Grid(np.zeros(2), (1, n), 1 / n, periodic=(True, True)),
        pm.Material(pm.NeoHookean(manufactured.E, manufactured.NU), density=manufactured.RHO),
        np.full(len(X), (0.5 / n) ** 2),
        body_force=manufactured.StandingWave(jnp.asarray(moves)),
        X0=X,
        spline=spline,
        scheme=scheme,
    )
    F = np.tile(np.eye(3), (len(X), 1, 1))
    F[:, :2, :2] += np.eye(2) * (moves * manufactured.wave(np, X, 0.0, space=1))[:, None]
    # φ = π/2: at rest at first, v and C are zero.
    return scene, initial_state(scene, X + moves * manufactured.wave(np, X, 0.0), F=F), X


def refined(n, name, courants, after=itself):
    """Displacements at t = 0.4/c over the amplitude, for each `Δt = courant h/c`."""
    scene, start, X = standing_wave(n, name)
    out = []
    for courant in courants:
        steps = round(0.4 * n / courant)
        dt = 0.4 / manufactured.SPEED / steps
        end = advance(scene, start, jnp.asarray(dt), jnp.asarray(steps), after)
        out.append((wide(end.position) - X) / manufactured.AMPLITUDE)
    return out


def orders(values):
    """`log₂` of the ratios of the differences of successive values, each at half the Δt before."""
    changes = np.array([rms(a - b) for a, b in itertools.pairwise(values)])
    return np.log2(changes[:-1] / changes[1:])


def without_transfer_loss(values):
    """`u(Δt) − u(Δt/2)/2`: of `u = u* + a Δt + b/Δt` it leaves the first two terms."""
    return [a - b / 2 for a, b in itertools.pairwise(values)]


FIRST = {"within": (0.85, 1.15)}


@pytest.mark.parametrize("name", fast("quadratic-grad", "quadratic-mls"))
def test_v25_order_in_time(measure, name):
    """Symplectic Euler is of first order, but on a fixed grid `Δt → 0` is no limit.

    Each pair of transfers takes the same small part of the motion, so `u = u* + a Δt + b/Δt` with
    b of the order of h⁴. Without b the order is 1 on any grid; with it where a Δt is much the
    larger, as at n = 128 and Δt ≥ 0.1 h/c.
    """
    fine = orders(refined(128, name, (0.4, 0.2, 0.1)))
    measure("V25", f"order, Δt = 0.4 to 0.1 h/c, n = 128, {name}", fine[0], **FIRST)
    values = refined(32, name, (0.4, 0.2, 0.1, 0.05, 0.025))
    for i, order in enumerate(orders(without_transfer_loss(values))):
        case = f"{0.4 / 2**i} to {0.1 / 2**i} h/c, n = 32, {name}"
        measure("V25", f"order without the loss of transfers, Δt = {case}", order, **FIRST)
    raw = orders(values)[-1]
    measure("V25", f"and with it, Δt = 0.1 to 0.025 h/c, n = 32, {name}", raw, below=0.5)


def test_v25_loss_of_transfers(measure):
    """b is of the order of h⁴: the part of u that an affine velocity on a stencil leaves out."""
    loss = []
    for n in (32, 64):
        values = refined(n, "quadratic-grad", (0.1, 0.05, 0.025))
        first, second = (a - b for a, b in itertools.pairwise(values))
        # first = a Δt/2 − b/Δt, second = a Δt/4 − 2 b/Δt.
        loss.append(rms(first - 2 * second) / 3 * 0.1 / n)
    measure("V25", "order of b in h, n = 32 to 64", np.log2(loss[0] / loss[1]), within=(3.5, 4.5))


def test_v25_fails_without_the_affine_velocity(measure):
    """Negative control: PIC, whose loss in each step is no small correction."""
    values = refined(32, "quadratic-grad", (0.4, 0.2, 0.1, 0.05), without_affine)
    order = orders(without_transfer_loss(values))[0]
    measure("V25", "negative control: order of PIC", order, below=0.5)


# --- V26: the generalized vortex -----------------------------------------------------------------

E, NU, RHO = 1000.0, 0.3, 1000.0
MU, LAM = energies.lame(E, NU)


class Vortex(eqx.Module):
    """A ring 0.75 < R < 1.25 whose circles turn to and fro, at rest at both rims; body force.

    `x = R(α) X`, `α = G sin(πt) (1 − 8ξ² + 16ξ⁴)`, `ξ = 2 (|X| − 1)`. The rims have no traction.

    Args:
        G: largest angle.
        stress_sign: of the divergence of stress; −1 is wrong.
    """

    G: jax.Array = parameter()
    stress_sign: jax.Array = parameter(default=1.0)

    def place(self, X, t):
        """Exact position of one particle."""
        xi = 2 * (jnp.sqrt(jnp.sum(X * X)) - 1)
        alpha = self.G * jnp.sin(jnp.pi * t) * (1 - 8 * xi**2 + 16 * xi**4)
        c, s = jnp.cos(alpha), jnp.sin(alpha)
        return jnp.stack([c * X[0] - s * X[1], s * X[0] + c * X[1]])

    def velocity(self, X, t):
        """Its rate."""
        return jax.jvp(lambda t: self.place(X, t), (t,), (jnp.ones_like(t),))[1]

    def nominal_stress(self, X, t):
        """`P = ∂ψ/∂F` of the neo-Hookean energy in plane strain."""

        def energy(F):
            log_J = jnp.log(jnp.linalg.det(F))
            return MU / 2 * jnp.sum(F * F) - MU * log_J + LAM / 2 * log_J**2

        return jax.grad(energy)(jax.jacfwd(self.place)(X, t))

    def __call__(self, X, t):
        """`∂²x/∂t² − Div P/ρ`."""
        acceleration = jax.jvp(lambda t: self.velocity(X, t), (t,), (jnp.ones_like(t),))[1]
        divergence = jnp.einsum("ijj->i", jax.jacfwd(self.nominal_stress)(X, t))
        return acceleration - self.stress_sign * divergence / RHO

    def closed_form(self, X, t):
        """The same written out, for many X (numpy)."""
        R, polar = np.linalg.norm(X, axis=1), np.arctan2(X[:, 1], X[:, 0])
        xi = 2 * (R - 1)
        h, h1, h2 = 1 - 8 * xi**2 + 16 * xi**4, 2 * (64 * xi**3 - 16 * xi), 4 * (192 * xi**2 - 16)
        g, g1 = float(self.G) * np.sin(np.pi * t), float(self.G) * np.pi * np.cos(np.pi * t)
        A = MU / RHO * R * (g * h1) ** 2 - R * (g1 * h) ** 2
        B = -(np.pi**2) * R * g * h - MU / RHO * g * (3 * h1 + R * h2)
        c, s = np.cos(polar + g * h), np.sin(polar + g * h)
        return np.stack([A * c - B * s, A * s + B * c], axis=1)


@eqx.filter_jit
def for_all(function, X, t):
    """`function(X, t)` for each particle and, with several times, for each of them."""
    over_X = jax.vmap(function, in_axes=(0, None))
    return jax.vmap(over_X, in_axes=(None, 0))(X, t) if jnp.ndim(t) else over_X(X, t)


def ring(n, per_cell, vortex, name):
    """The ring at t = 0: scene, state, X, a time step of 0.2 h/c; h = 1/n."""
    spline, scheme, _ = SCHEMES[name]
    h, cells = 1 / n, int(1.25 * n) + 5
    X = lattice((-cells * h,) * 2, (2 * cells,) * 2, h, per_cell)
    R = np.linalg.norm(X, axis=1)
    X = X[(R > 0.75) & (R < 1.25)]
    scene = Scene(
        Grid([-cells * h] * 2, (2 * cells,) * 2, h),
        pm.Material(pm.NeoHookean(E, NU), density=RHO),
        np.full(len(X), (h / per_cell) ** 2),
        body_force=vortex,
        X0=X,
        spline=spline,
        scheme=scheme,
    )
    v, C = (
        for_all(f, jnp.asarray(X), jnp.zeros(()))
        for f in (vortex.velocity, jax.jacfwd(vortex.velocity))
    )
    return scene, initial_state(scene, X, v, C=C), X, 0.2 * h / ((LAM + 2 * MU) / RHO) ** 0.5


def vortex_error(n, name, G, per_cell=2, *, stress_sign=1.0):
    """`max_t RMS |x − x_exact|` over 1 s, over the largest RMS displacement."""
    vortex = Vortex(G, stress_sign)
    scene, state, X, dt = ring(n, per_cell, vortex, name)
    every = int(0.05 / dt) + 1
    dt = 0.05 / every
    _, x = roll(scene, state, dt, 20 * every, positions, every=every)
    exact = wide(for_all(vortex.place, jnp.asarray(X), jnp.asarray(0.05 * np.arange(1, 21))))
    return rms(wide(x) - exact).max() / rms(exact - X).max()


def test_v26_body_force():
    """By differentiation, and written out in the polar basis that turns with α."""
    vortex, X = Vortex(0.7), np.random.default_rng(3).uniform(0.55, 0.85, (50, 2))
    force = for_all(vortex, jnp.asarray(X), jnp.asarray(0.37))
    np.testing.assert_allclose(force, vortex.closed_form(X, 0.37), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", fast("quadratic-grad"))
def test_v26_vortex(measure, name):
    """G = 0.1: a body with free surfaces that turns and shears."""
    coarse, fine = (vortex_error(n, name, 0.1) for n in (16, 32))
    measure.curve("V26", "vortex: error", name, (1 / 16, 1 / 32), (coarse, fine), order=2)
    measure("V26", f"error, G = 0.1, h = 1/32, {name}", fine, below=3e-2)
    rate = np.log2(coarse / fine)
    measure("V26", f"rate from h = 1/16 to 1/32, G = 0.1, {name}", rate, above=1.8)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCHEMES)
def test_v26_strong_vortex(measure, name):
    """G = 0.3 needs nine particles in a cell: four leave cells empty, and the body breaks."""
    error = vortex_error(32, name, 0.3, per_cell=3)
    measure("V26", f"error, G = 0.3, 9 particles per cell, h = 1/32, {name}", error, below=3e-2)
    if name == "quadratic-grad":
        broken = vortex_error(32, name, 0.3, per_cell=2)
        measure("V26", "G = 0.3, 4 particles per cell: error", broken, above=0.1)


def test_v26_too_strong_a_vortex_is_reported(measure):
    """G = 1 is beyond the method: what comes out is wrong, and is said to be, and not NaN."""
    frames, n = 20, 16
    scene, state, _, dt = ring(n, 2, Vortex(1.0), "quadratic-grad")
    substeps = int(1 / frames / dt) + 1
    dt = 1 / frames / substeps
    end = simulate(scene, state, dt=dt, frames=frames, substeps=substeps, throw=False).final
    lost = sum(int(jnp.sum(~jnp.isfinite(a))) for a in (end.position, end.v, end.C, end.He))
    measure("V26", "G = 1: entries of the state that are not finite", lost, below=0)
    early = int(end.status.first[Condition.DT_ABOVE_BOUND]) * dt
    measure("V26", "G = 1: the time step is reported at, s", early, within=(0.0, 0.5))
    assert not bool(end.status.ok)


def test_v26_fails_with_a_sign_error(measure):
    """Negative control: the body force with the wrong sign of the stress."""
    error = vortex_error(16, "quadratic-grad", 0.1, stress_sign=-1.0)
    measure("V26", "negative control: force with a wrong sign, error", error, above=0.5)


# --- V28: a column under its own weight ----------------------------------------------------------

COLUMN_E = 1e4


def column(n, name, law=pm.NeoHookean):
    """A laterally confined column of height 1 m, compressed by 15 % at its foot, come to rest.

    Returns:
        Y at the start, stretches, and the load `ρ₀ g`, which is also the largest stress.
    """
    spline, scheme, _ = SCHEMES[name]
    mu, lam = energies.lame(COLUMN_E, NU)
    h, load = 1 / n, 0.15 * (lam + 2 * mu)
    X = lattice((0, 0), (1, n), h)
    scene = Scene(
        Grid(np.zeros(2), (1, n + 4), h, periodic=(True, False)),
        pm.Material(law(COLUMN_E, NU), density=RHO),
        np.full(len(X), (h / 2) ** 2),
        gravity=[0.0, -load / RHO],
        boundaries=(Collider(HalfSpace([0.0, 0.0], [0.0, 1.0]), Slip()),),
        spline=spline,
        scheme=scheme,
        # Nearly critical for the slowest mode, π c/(2 L) = 5.8/s.
        grid_damping=11.0,
    )
    dt = 0.5 * float(scene.rest_limit())
    end, _ = roll(scene, initial_state(scene, X), dt, int(2.5 / dt))
    assert np.abs(wide(end.v)).max() < 1e-4  # At rest, beside √(g L) = 1.4 m/s.
    return X[:, 1], wide(end.Fe)[:, 1, 1], load


def nominal_stress(law, F):
    """`P_yy` of uniaxial strain, from the energy of each law."""
    mu, lam = energies.lame(COLUMN_E, NU)
    return {
        pm.NeoHookean: mu * (F - 1 / F) + lam * np.log(F) / F,
        pm.FixedCorotated: (2 * mu + lam) * (F - 1),
        pm.StVKHencky: (2 * mu + lam) * np.log(F) / F,
    }[law]


def column_error(Y, P, load, margin=0.0):
    """RMS of `P + ρ₀ g (L − Y)` over the largest stress, away from the ends."""
    kept = (margin < Y) & (margin < 1 - Y)
    return rms((P + load * (1 - Y))[kept, None]) / load


# The ends see half a spline of air: a wider one spoils a longer piece.
WHOLE = {"quadratic-grad": 0.07, "quadratic-mls": 0.07, "cubic-grad": 0.08, "cubic-mls": 0.07}


@pytest.mark.parametrize("name", fast("quadratic-grad", "cubic-grad"))
def test_v28_column_under_its_own_weight(measure, name):
    whole, middle = {}, {}
    for n in (16, 32):
        Y, F, load = column(n, name)
        P = nominal_stress(pm.NeoHookean, F)
        inside = middle[n] = column_error(Y, P, load, 3 / n)
        whole[n] = column_error(Y, P, load)
        measure("V28", f"error 3 cells off the ends, n = {n}, {name}", inside, below=0.012)
    h = [1 / n for n in whole]
    measure.curve("V28", "column: error off the ends", name, h, middle.values())
    measure.curve("V28", "column: error", name, h, whole.values(), order=0.5)
    measure("V28", f"error of the whole column, n = 16, {name}", whole[16], below=WHOLE[name])
    # Errors of the ends, in a part of the column that shrinks with h: √h.
    ratio = whole[16] / whole[32]
    measure("V28", f"whole column, n = 16 over n = 32, {name}", ratio, within=(1.2, 1.7))


@pytest.mark.parametrize("law", [pm.FixedCorotated, pm.StVKHencky])
def test_v28_of_any_law(measure, law):
    Y, F, load = column(16, "quadratic-grad", law)
    P = nominal_stress(law, F)
    inside, whole = column_error(Y, P, load, 3 / 16), column_error(Y, P, load)
    measure("V28", f"error 3 cells off the ends, n = 16, {law.__name__}", inside, below=0.012)
    measure("V28", f"error of the whole column, n = 16, {law.__name__}", whole, below=0.07)


def test_v28_fails_with_the_kirchhoff_stress(measure):
    """Negative control: `τ = P F` is another stress at 15 % of strain."""
    Y, F, load = column(16, "quadratic-grad")
    error = column_error(Y, F * nominal_stress(pm.NeoHookean, F), load, 3 / 16)
    measure("V28", "negative control: Kirchhoff for nominal stress", error, above=0.024)


# --- V29: a Bingham film -------------------------------------------------------------------------


def velocity(scene, state):
    """Along the slope."""
    del scene
    return state.v[:, 0]


def film(ny, name, wall=0.0):
    """A film of depth 1 m on a slope of 30°, from rest to its steady flow, one cell wide.

    `u = ρ g sin θ/(2 η_b) (y₀² − (y₀ − y)²)`, η_b = η/2, and a plug above
    `y₀ = H − τ_y/(ρ g sin θ)`, τ_y = σ_Y/√3.

    Args:
        ny: cells in the depth.
        name: scheme.
        wall: place of the no-slip wall, in cells.

    Returns:
        RMS error of u over its RMS, and the change in the last tenth of the time.
    """
    spline, scheme, _ = SCHEMES[name]
    h, viscosity, y0, kappa = 1 / ny, 1500.0, 0.7, 1e6 / (3 * (1 - 2 * NU))
    along, down = 9.8 * np.sin(np.pi / 6), -9.8 * np.cos(np.pi / 6)
    X = lattice((0, 0), (1, ny), h)
    # At rest at first under the pressure of its weight, `κ/2 (J² − 1)`.
    J = np.sqrt(1 + 2 * RHO * down * (1 - X[:, 1]) / kappa)
    paste = pm.HerschelBulkley(3**0.5 * (1 - y0) * RHO * along, 2 * viscosity)
    scene = Scene(
        Grid([0.0, -4 * h], (1, ny + 8), h, periodic=(True, False)),
        pm.Material(pm.DevVolNeoHookean(1e6, NU), paste, RHO),
        (h / 2) ** 2 / J,
        gravity=[along, down],
        boundaries=(Collider(HalfSpace([0.0, wall * h], [0.0, 1.0]), Sticky()),),
        spline=spline,
        scheme=scheme,
    )
    dt = 0.5 * float(scene.rest_limit())
    every = round(0.01 / dt)
    state = initial_state(scene, X, F=J[:, None, None] ** (1 / 3) * np.eye(3))
    _, u = roll(scene, state, dt, 200 * every, velocity, every=every)
    # Particles pass cells: a mean over 0.2 s.
    before, last = wide(u)[-40:-20].mean(axis=0), wide(u)[-20:].mean(axis=0)
    y = np.minimum(X[:, 1], y0)
    exact = RHO * along / (2 * viscosity) * (y0**2 - (y0 - y) ** 2)
    return [rms(a[:, None]) / rms(exact[:, None]) for a in (last - exact, last - before)]


@pytest.mark.parametrize("name", fast("quadratic-grad"))
def test_v29_bingham_film(measure, name):
    for ny, demand in ((16, 0.07), (32, 0.05)):
        error, change = film(ny, name)
        case = f"{ny} cells deep, {name}"
        measure("V29", f"error of the velocity, {case}", error, below=demand)
        measure("V29", f"its change in 0.2 s, {case}", change, below=2e-3)


def test_v29_fails_with_the_wall_one_node_lower(measure):
    """Negative control: the material ends on the last node that is held."""
    error, _ = film(16, "quadratic-grad", wall=-1.0)
    measure("V29", "negative control: wall one node lower, error", error, above=0.5)
