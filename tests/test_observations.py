"""What is seen of a motion: residuals, their derivatives, and fits from each kind of data."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identification import FRAME, TRUTH, block, elastic_problem, motion, parameters

import pgjax
from pgjax import models
from pgjax._types import Array, parameter
from pgjax.inverse import (
    Chamfer,
    Cloud,
    Huber,
    Parameter,
    Pictures,
    Positions,
    Problem,
    Sinkhorn,
    Stage,
    descend,
    fit,
    gradient_check,
)
from pgjax.inverse.levenberg import evaluate
from pgjax.models.strain import hencky_strain
from pgjax.render import Camera, Gaussians

float64 = pytest.mark.float64


def painted(x):
    """Round Gaussians with a pattern."""
    n, dtype = len(x), jnp.zeros(()).dtype
    colour = 0.8 * np.sin(x @ np.array([[17.0, 5, -9], [-7, 15, 4], [6, -9, 16]]))
    return Gaussians.from_scales(
        jnp.asarray(x, dtype),
        jnp.broadcast_to(jnp.asarray([1.0, 0, 0, 0], dtype), (n, 4)),
        jnp.full((n, 3), 0.03, dtype),
        jnp.full((n,), 0.8, dtype),
        jnp.asarray(colour[:, None, :], dtype),
    )


def cameras(count):
    return [
        Camera.orbit(
            (0.5, 0.5, 0.35),
            up=(0, 0, 1),
            azimuth=0.4 + k,
            elevation=0.2,
            radius=1.2,
            width=40,
            height=36,
            fov_y=0.6,
        )
        for k in range(count)
    ]


def pictured(channel, views=1, frames=4, unknowns=None):
    """A problem whose pictures are drawn from its own simulation at the truth."""
    build, x = block()
    at = cameras(views) if views > 1 else cameras(1)[0]
    tail = (3,) if channel == "rgb" else ()
    shape = (frames, *((views,) if views > 1 else ()), 36, 40, *tail)
    blank = Pictures(painted(x), at, np.ones(shape), channel=channel, background=(0.1, 0.2, 0.3))
    problem = Problem(unknowns or parameters(), build, blank, frame_dt=FRAME)
    seen, status = problem.see(jnp.asarray(problem.space.vector(TRUTH), jnp.zeros(()).dtype))
    status.check()
    found = Pictures(
        painted(x),
        at,
        np.asarray(seen[0])[1:],
        channel=channel,
        background=(0.1, 0.2, 0.3),
        sigma=0.01,
    )
    return problem.observing(found)


@float64
@pytest.mark.parametrize(
    ("channel", "views"),
    [
        ("silhouette", 1),
        pytest.param("rgb", 2, marks=pytest.mark.slow),
        pytest.param("depth", 1, marks=pytest.mark.slow),
    ],
)
def test_derivatives_of_pictures(channel, views):
    problem = pictured(channel, views, frames=5)
    check = gradient_check(problem, steps=(1e-4, 1e-5, 1e-6))
    # A pixel at whose depth the order of two Gaussians changes has a kink.
    assert check.best.max() < (1e-3 if channel == "depth" else 1e-4)
    assert check.modes < 1e-9


@float64
def test_fit_from_pictures(measure):
    found = fit(pictured("rgb", frames=6), tolerance=1e-7)
    measure(
        "ID3",
        "error of log10 E from one camera",
        abs(np.log10(found.values["E"] / 2e4)),
        below=3e-3,
    )
    measure("ID3", "error of nu from one camera", abs(found.values["nu"] - 0.3), below=3e-3)
    off = np.max(np.abs(found.values["v0"] - TRUTH["v0"]))
    measure("ID3", "error of v0 from one camera, m/s", off, below=1e-3)


@float64
@pytest.mark.slow
def test_fit_from_silhouettes():
    known = parameters(nu=Parameter(0.3, fixed=True), E=Parameter(2e4, fixed=True))
    found = fit(pictured("silhouette", 2, frames=3, unknowns=known), tolerance=1e-4)
    np.testing.assert_allclose(found.values["v0"], TRUTH["v0"], atol=5e-3)


@pytest.mark.float64
def test_squares_are_averages():
    """Of the differences, over the noise of an average; what is missing counts as no difference."""
    problem = pictured("rgb", 2, frames=2)
    (exact,) = problem.observations
    rng = np.random.default_rng(0)
    seen = np.asarray(exact.data) + 0.01 * rng.standard_normal(exact.data.shape)
    seen = jnp.asarray(seen, exact.data.dtype)
    exact = eqx.tree_at(lambda o: o.data, exact, exact.data.at[0, 0, :5, :5].set(jnp.nan))
    single = np.asarray(exact.compare(seen))
    assert single.shape == (2, 2, 36, 40, 3)
    squares = np.asarray(exact.coarser(16).compare(seen))
    assert squares.shape == (2, 2, 3, 3, 3)
    # The last row of squares has 4 rows of pixels, the last column 8 columns.
    padded = np.pad(single, ((0, 0), (0, 0), (0, 12), (0, 8), (0, 0)))
    expected = padded.reshape(2, 2, 3, 16, 3, 16, 3).sum(axis=(3, 5)) / 16
    np.testing.assert_allclose(squares, expected, rtol=1e-4, atol=1e-4)
    assert problem.coarser(16).outcome(
        jnp.asarray(problem.space.start, jnp.zeros(()).dtype)
    ).residual.shape == (2 * 2 * 3 * 3 * 3,)


@float64
@pytest.mark.slow
def test_squares_lead_where_pixels_do_not():
    """A body seen far from where it is: through squares a step ends much nearer."""
    unknowns = parameters(
        nu=Parameter(0.3, fixed=True),
        E=Parameter(2e4, fixed=True),
        v0=Parameter((-1.6, -0.2, -1.5), lower=-3, upper=3),
    )
    problem = pictured("rgb", 2, frames=4, unknowns=unknowns)
    plain = fit(problem, trials=4, intervals=False)
    led = fit(problem, stages=[Stage(coarser=12)], trials=4, intervals=False)
    off = [np.max(np.abs(found.values["v0"] - TRUTH["v0"])) for found in (plain, led)]
    assert off[1] < 0.1 * off[0]


def test_pictures_are_checked():
    _, x = block()
    with pytest.raises(ValueError, match=r"shape \(frames, 36, 40, 3\) for rgb from one camera"):
        Pictures(painted(x), cameras(1)[0], np.zeros((2, 36, 40)))
    with pytest.raises(ValueError, match="`channel` must be"):
        Pictures(painted(x), cameras(1)[0], np.zeros((2, 36, 40)), channel="colour")
    with pytest.raises(ValueError, match="`pixels` must be a whole number ≥ 1, but is 0"):
        Pictures(painted(x), cameras(1)[0], np.zeros((2, 36, 40, 3))).coarser(0)
    with pytest.raises(ValueError, match="`frames` must ascend"):
        Positions(np.zeros((2, 5, 3)), frames=[3, 1])
    with pytest.raises(ValueError, match="`particles` must name 5"):
        Positions(np.zeros((2, 5, 3)), particles=[0, 1])
    with pytest.raises(ValueError, match="`sigma` must broadcast"):
        Positions(np.zeros((2, 5, 3)), sigma=np.ones(4))
    with pytest.raises(ValueError, match="`weights` must have shape"):
        Positions(np.zeros((2, 5, 3)), weights=[1.0])


def cloud_problem(matching, count=60):
    """Every third particle in another order, and the velocity unknown."""
    unknowns = parameters(
        nu=Parameter(0.3, fixed=True),
        E=Parameter(2e4, fixed=True),
        v0=Parameter((0.3, -0.1, -1.4), lower=-3, upper=3),
    )
    build, x = block()
    index = np.random.default_rng(2).permutation(len(x))[:count]
    blank = Cloud(np.zeros((3, count, 3)), matching=matching, particles=np.sort(index), sigma=1e-2)
    problem = Problem(unknowns, build, blank, frame_dt=FRAME)
    data = np.asarray(motion(build, TRUTH, frames=3, substeps=problem.substeps).x)[1:, index]
    found = Cloud(data, matching=matching, particles=np.sort(index), sigma=1e-2)
    return problem.observing(found)


@float64
@pytest.mark.parametrize(
    ("matching", "error"),
    [
        (Chamfer(), 1e-6),
        pytest.param(Sinkhorn(0.02, iterations=200), 1e-2, marks=pytest.mark.slow),
    ],
)
def test_fit_without_correspondence(matching, error):
    problem = cloud_problem(matching)
    check = gradient_check(problem, steps=(1e-4, 1e-5, 1e-6))
    assert check.best.max() < 1e-5
    found = fit(problem, tolerance=1e-8)
    np.testing.assert_allclose(found.values["v0"], TRUTH["v0"], atol=error)


@float64
def test_sinkhorn_is_a_transport_plan():
    """Against the assignment of least cost, which a small blur comes close to."""
    from scipy.optimize import linear_sum_assignment

    rng = np.random.default_rng(0)
    x, data = rng.uniform(size=(12, 3)), rng.uniform(size=(12, 3))
    r = np.asarray(Sinkhorn(0.01, iterations=3000)(jnp.asarray(x), jnp.asarray(data)))
    rows, columns = linear_sum_assignment(((x[:, None] - data[None]) ** 2).sum(-1))
    expected = np.zeros_like(data)
    expected[columns] = x[rows] - data[columns]
    np.testing.assert_allclose(r, expected, atol=2e-3)


@float64
def test_outliers_do_not_decide():
    problem = elastic_problem(frames=4, unknowns=parameters(nu=Parameter(0.3, fixed=True)))
    data = np.array(problem.observations[0].data)
    data[:, ::9] += 0.3
    spoilt = fit(problem.observing(Positions(data)), tolerance=1e-3, intervals=False)
    robust = problem.observing(Positions(data, robust=Huber()))
    kept = fit(robust, tolerance=1e-3, intervals=False)
    errors = [np.abs(f.values["v0"] - TRUTH["v0"]).max() for f in (kept, spoilt)]
    assert errors[0] < 0.05 * errors[1]


@float64
def test_frames_and_weights():
    """A frame of weight 0 says nothing; a missing one is not compared."""
    problem = elastic_problem(frames=3)
    data = np.asarray(problem.observations[0].data)
    start = problem.space.start
    first = evaluate(problem.observing(Positions(data[:1], frames=[1])), start)
    weighted = evaluate(problem.observing(Positions(data, weights=[1.0, 0, 0])), start)
    np.testing.assert_allclose(weighted.cost, first.cost, rtol=1e-6)
    assert problem.observing(Positions(data[[0, 2]], frames=[1, 3])).until(2).observations[
        0
    ].frames == (1,)
    with pytest.raises(ValueError, match="not before the first observed frame"):
        problem.observing(Positions(data[2:], frames=[3])).until(2)


class Learned(models.AbstractElasticity):
    """Hencky's energy and what a network of two invariants of the log strain adds to it."""

    network: eqx.nn.MLP
    E: Array = parameter()
    nu: Array = parameter()

    def energy_of(self, eps):
        square, trace = jnp.sum(eps * eps), jnp.trace(eps) ** 2
        added = self.network(10 * jnp.stack([square, trace])) / 10
        return self.mu * (square + added) + self.lam / 2 * trace

    def kirchhoff(self, H, L, history=None):
        del L, history
        eps, _ = hencky_strain(H)
        return jax.grad(self.energy_of)(eps)


@pytest.mark.slow
@float64
def test_a_network_as_a_law():
    """Gradients with respect to its weights through 200 steps, and a descent that uses them."""
    build, _ = block()
    target = motion(build, TRUTH, frames=4, substeps=50, frame_dt=0.04)

    def cost(law):
        scene, state = build({n: jnp.asarray(v) for n, v in TRUTH.items()})
        scene = eqx.tree_at(lambda s: s.materials, scene, (models.Material(law),))
        made = pgjax.simulate(
            scene, state, dt=0.04 / 50, frames=4, substeps=50, save=lambda s: s.x, throw=False
        )
        return jnp.mean((made.saved - target.x) ** 2) * 1e4

    network = eqx.nn.MLP(2, "scalar", 6, 1, activation=jnp.tanh, key=jax.random.key(0))
    law = Learned(network, 1.5e4, 0.3)
    free, rest = eqx.partition(law, eqx.is_inexact_array)
    value = jax.jit(lambda f: cost(eqx.combine(f, rest)))
    slope = jax.grad(value)(free)
    leaves, shape = jax.tree.flatten(free)
    rng = np.random.default_rng(0)
    along = shape.unflatten([jnp.asarray(rng.normal(size=leaf.shape)) for leaf in leaves])
    # E counts in Pa.
    along = eqx.tree_at(lambda f: (f.E, f.nu), along, (1e4 * along.E, 0.05 * along.nu))
    expected = sum(
        jnp.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, (slope, along)), strict=True)
    )

    def moved(step):
        return value(jax.tree.map(lambda a, d: a + step * d, free, along))

    difference = (moved(1e-6) - moved(-1e-6)) / 2e-6
    np.testing.assert_allclose(expected, difference, rtol=1e-5)
    end = descend(cost, law, steps=8, rate=0.1, where=lambda law: law.network)
    assert end.best.E == law.E
    assert end.cost < 0.5 * end.history[0].cost
