"""Level 0: the transfers between particles and grid (V01–V05)."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import SCHEMES, axial, cross, kinetic_energy, roll

import pgjax.models as pm
from pgjax.grid import Grid
from pgjax.models.material import cast
from pgjax.scene import Scene, initial_state
from pgjax.splines import BSpline
from pgjax.transfer import Payload, gather, reference, scatter, stencil

H = 1 / 16
DTYPES = [
    pytest.param(jnp.float64, 1e-14, marks=pytest.mark.float64, id="f64"),
    pytest.param(jnp.float32, 2e-6, id="f32"),
]
LAYOUTS = pytest.mark.parametrize("periodic", [False, True], ids=["open", "periodic"])
DIMENSIONS = pytest.mark.parametrize("d", [2, 3])
DEGREES = pytest.mark.parametrize("degree", [2, 3])


def grid_of(d, periodic):
    return Grid(np.linspace(-0.3, 0.7, d), (6, 5, 7)[:d], H, periodic=(periodic,) * d)


def places(d, dtype):
    """Random positions, exact nodes and mid-cells, and their neighbours in floating point."""
    rng = np.random.default_rng(0)
    anywhere = rng.uniform(0, 5, (10_000, d)) * H
    special = rng.integers(0, 10, (200, d)) / 2 * H
    near = [np.nextafter(special.astype(dtype), np.asarray(s, dtype)) for s in (-9, 9)]
    x = np.concatenate([anywhere, special, *near]).astype(dtype)
    return jnp.asarray(x[np.all(x >= 0, axis=1)])


@eqx.filter_jit
def rows(grid, spline, x):
    """`w`, `∇w` and `x_i − x_p` along each direction, `(p, k, d)`, in units of h."""
    at, inside = stencil(grid, spline, x)
    return jax.vmap(lambda xi: reference.stencil(spline.degree, xi)[1:])(at.xi), inside


def weights(grid, spline, x):
    """Weights `(p, nodes)`, their gradients and `x_i − x_p` `(p, nodes, d)`, in units of h."""
    along, inside = rows(cast(grid, x.dtype), spline, x)
    assert bool(jnp.all(inside))
    d, k = x.shape[1], spline.width
    choice = np.stack(np.meshgrid(*[np.arange(k)] * d, indexing="ij"), -1).reshape(-1, d)
    axis = np.arange(d)
    w, dw, dx = (np.asarray(a)[:, choice, axis] for a in along)
    slope = [np.prod(np.where(axis == j, dw, w), axis=-1) for j in axis]
    return np.prod(w, axis=-1), np.stack(slope, axis=-1), dx


def largest(error):
    return np.max(np.abs(np.asarray(error)))


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
@DEGREES
def test_v01_weights(measure, degree, dtype, tolerance):
    spline, worst = BSpline(degree), {}
    for d, periodic in itertools.product((2, 3), (False, True)):
        w, dw, dx = weights(grid_of(d, periodic), spline, places(d, dtype))
        assert w.dtype == dtype
        errors = {
            "Σw = 1": w.sum(1) - 1,
            "Σ∇w = 0": dw.sum(1),
            "Σw x_i = x_p": np.einsum("pn,pni->pi", w, dx),
            "Σx_i ∇wᵀ = I": np.einsum("pni,pnj->pij", dx, dw) - np.eye(d, dtype=dtype),
            "ΣwΔxΔxᵀ = D I": np.einsum("pn,pni,pnj->pij", w, dx, dx)
            - (spline.moment * np.eye(d)).astype(dtype),
            "negative part of w": np.minimum(w, 0),
        }
        for name, error in errors.items():
            worst[name] = max(worst.get(name, 0.0), largest(error))
    for name, error in worst.items():
        measure("V01", f"{name}, degree {degree}, {dtype.__name__}", error, below=tolerance)


@pytest.mark.float64
@DEGREES
def test_v01_gradient_is_the_derivative_of_the_weight(measure, degree):
    grid, spline = grid_of(2, False), BSpline(degree)
    # Inside the cells: at their borders the second derivative of a quadratic spline jumps.
    x = jnp.asarray(np.random.default_rng(1).uniform(0, 5, (300, 2)) * H)
    value, slope = jax.jvp(lambda x: rows(grid, spline, x)[0][0], (x,), (jnp.ones_like(x),))
    error = largest(H * slope - rows(grid, spline, x)[0][1])
    assert value.shape == slope.shape
    measure("V01", f"∇w − AD of w, degree {degree}", error, below=1e-13)


@pytest.mark.float64
@DEGREES
def test_v01_roughness_of_the_spline(measure, degree):
    """The constant g = D max Σ w′²/w of the stable time step, over positions within a cell."""
    spline = BSpline(degree)
    offset = (degree - 1) / 2 + jnp.linspace(1e-6, 1 - 1e-6, 200_001)
    w, dw = jax.vmap(spline.weights)(offset[:, None])
    g = spline.moment * jnp.max(jnp.sum(dw[..., 0] ** 2 / w[..., 0], axis=1))
    measure("V01", f"|g − roughness|, degree {degree}", abs(g - spline.roughness), below=1e-5)


@eqx.filter_jit
def transfer_both_ways(grid, spline, x, payload, values):
    at, _ = stencil(grid, spline, x)
    return scatter(grid, at, payload), gather(grid, at, values)


@pytest.mark.float64
@DEGREES
@DIMENSIONS
@LAYOUTS
def test_v02_adjointness(measure, periodic, d, degree):
    rng = np.random.default_rng(2)
    grid, n, c = grid_of(d, periodic), 60, d + 1
    x = jnp.asarray(rng.uniform(0, 5, (n, d)) * H)
    payload = Payload(
        *(jnp.asarray(rng.normal(size=s)) for s in ((n, c), (n, c, d), (n, c, d))),
    )
    values = jnp.asarray(rng.normal(size=(*grid.node_shape, c)))
    sent, (a, B, S) = transfer_both_ways(grid, BSpline(degree), x, payload, values)
    left = jnp.sum(sent * values)
    terms = [jnp.sum(p * q) for p, q in ((payload.a, a), (payload.B, H * B), (payload.S, S))]
    error = abs(left - sum(terms)) / sum(abs(t) for t in terms)
    layout = "periodic" if periodic else "open"
    measure("V02", f"⟨P2G a, b⟩ = ⟨a, G2P b⟩, degree {degree}, {d}-D, {layout}", error, below=1e-13)


def free_scene(d, periodic, name, seed):
    """Particles anywhere, masses over four decades, no force: one step only transfers."""
    rng = np.random.default_rng(seed)
    spline, scheme, _ = SCHEMES[name]
    volumes = 10 ** rng.uniform(-2, 2, 60)
    x = rng.uniform(0, 5, (60, d)) * H
    grid = grid_of(d, periodic)
    scene = Scene(grid, pm.Material(pm.NeoHookean(1e3, 0.3)), volumes, spline=spline, scheme=scheme)
    return scene, x + np.asarray(grid.origin), rng


@pytest.mark.float64
@pytest.mark.parametrize(
    ("d", "periodic", "name"),
    [
        (2, False, "quadratic-mls"),
        (2, True, "cubic-grad"),
        (3, False, "cubic-mls"),
        (3, True, "quadratic-grad"),
    ],
)
def test_v03_v04_one_step_of_transfers(measure, d, periodic, name):
    """An affine field passes unchanged, and no field gains energy."""
    scene, x, rng = free_scene(d, periodic, name, 3)
    A, b = rng.normal(size=(d, d)), rng.normal(size=d)
    # Along a periodic direction an affine field is a constant one.
    A = 0 * A if periodic else A
    state = initial_state(scene, x, x @ A.T + b, C=np.broadcast_to(A, (len(x), d, d)))
    dt = 1e-3 * H
    after, _ = roll(scene, state, dt, 1)
    error = jnp.maximum(largest(after.v - state.v), H * largest(after.C - state.C))
    case = f"{name}, {d}-D, {'periodic' if periodic else 'open'}"
    measure("V03", f"v = A x + b, {case}", error / largest(state.v), below=1e-12)

    random = initial_state(
        scene, x, rng.normal(size=x.shape), C=rng.normal(size=(len(x), d, d)) / H
    )
    after, _ = roll(scene, random, dt, 1)
    gain = kinetic_energy(scene, after) / kinetic_energy(scene, random) - 1
    measure("V04", f"energy gained in P2G and G2P, {case}", gain, below=1e-14)


@eqx.filter_jit
def there_and_back(grid, spline, x, m, v, C):
    """Mass and velocity of the nodes, and what the particles get back."""
    at, _ = stencil(grid, spline, x)
    a = jnp.concatenate([m[:, None] * v, m[:, None]], axis=1)
    sums = scatter(grid, at, Payload(a, m[:, None, None] * C, None))
    mass, momentum = sums[..., -1:], sums[..., :-1]
    node_v = jnp.where(mass > 0, momentum / jnp.where(mass > 0, mass, 1), 0)
    new_v, moment, _ = gather(grid, at, node_v)
    return mass, node_v, new_v, moment / (spline.moment * grid.h)


@pytest.mark.float64
@DEGREES
@DIMENSIONS
def test_v04_v05_energy_and_momenta_on_the_grid(measure, d, degree):
    scene, x, rng = free_scene(d, False, "quadratic-grad", 4)
    grid, spline, m = scene.grid, BSpline(degree), scene.masses
    D = spline.moment * H**2
    x = jnp.asarray(x - np.asarray(grid.origin)[None])
    v = jnp.asarray(rng.normal(size=x.shape))
    C = jnp.asarray(rng.normal(size=(len(x), d, d))) / H
    mass, node_v, new_v, new_C = there_and_back(grid, spline, x, m, v, C)
    nodes = grid.nodes().reshape(-1, d)
    mass, node_v = mass.reshape(-1, 1), node_v.reshape(-1, d)

    def of_particles(v, C):
        return jnp.sum(m[:, None] * v, axis=0), m[:, None] * (cross(x, v) + D * axial(C))

    def energy(v, C):
        return 0.5 * jnp.sum(m * (jnp.sum(v**2, axis=1) + D * jnp.sum(C**2, axis=(1, 2))))

    case = f"degree {degree}, {d}-D"
    on_grid = 0.5 * jnp.sum(mass * node_v**2)
    measure("V04", f"energy gained in P2G, {case}", on_grid / energy(v, C) - 1, below=1e-14)
    measure("V04", f"energy gained in G2P, {case}", energy(new_v, new_C) / on_grid - 1, below=1e-14)

    measure("V05", f"mass, {case}", abs(jnp.sum(mass) / jnp.sum(m) - 1), below=1e-14)
    grid_P = jnp.sum(mass * node_v, axis=0)
    grid_L = jnp.sum(mass * cross(nodes, node_v), axis=0)
    for way, (P, L) in (("P2G", of_particles(v, C)), ("G2P", of_particles(new_v, new_C))):
        size = jnp.sum(m[:, None] * jnp.abs(v))
        measure("V05", f"P in {way}, {case}", largest(P - grid_P) / size, below=1e-14)
        error = largest(jnp.sum(L, axis=0) - grid_L) / jnp.sum(jnp.abs(L))
        measure("V05", f"L in {way}, {case}", error, below=1e-14)
