# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # How stiff is it, by its video?
#
# A block of jelly sticks to a plate that stops; how it wobbles and sags is filmed. From the compressed
# video alone come Young's modulus, Poisson's ratio and how fast the plate was, with intervals. It is
# done twice: with a film made by the estimator's own discretisation (tier *self*), and with one from
# another grid, other particles and another time step (tier *cross*), which is what a real film is
# like. It takes about a minute on two cores.

# %%
import math
import os
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Video
from scipy.spatial import KDTree

import pgjax
from pgjax import boundary, models, render, sampling
from pgjax.inverse import Parameter, Pictures, Problem, fit

FAST = os.environ.get("PGJAX_FAST") == "1"  # fewer frames and pixels
temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)

# %% [markdown]
# ## The body and its camera
#
# The block is known as Gaussians, one for each particle of the estimator. Its pattern is what makes
# the inside of a silhouette tell something.

# %%
lower, upper = (0.36, 0.36, 0.0), (0.64, 0.64, 0.28)  # m
cells = 12 if FAST else 18
X, _ = sampling.block(lower, upper, spacing=0.5 / cells)


def painted(X):
    """Gaussians of the block, with coloured stripes."""
    u = (X - np.array(lower)) / (np.array(upper) - np.array(lower))
    rgb = 0.5 + 0.4 * np.cos(2 * np.pi * (2 * u + np.array([0.0, 0.33, 0.67])))
    n, size = len(X), 0.35 / cells
    return render.Gaussians.from_scales(
        jnp.asarray(X, jnp.float32),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (n, 1)),
        jnp.full((n, 3), size),
        jnp.full(n, 0.9),
        jnp.asarray((rgb - 0.5) / 0.28209479, jnp.float32)[:, None, :],  # harmonics of degree 0
    )


gaussians = painted(X)
pixels = 48 if FAST else 96
camera = render.Camera.orbit(
    (0.52, 0.48, 0.13),
    up=(0, 0, 1),
    azimuth=math.radians(-65),
    elevation=math.radians(15),
    radius=1.0,
    fov_y=math.radians(34),
    width=pixels,
    height=pixels,
)
white = (1.0, 1.0, 1.0)

# %% [markdown]
# ## The simulation
#
# What is known of the set-up: shape, density and gravity, and that the jelly sticks to the plate. A wall
# acts where its nodes are, so each grid has nodes at the height of the plate.


# %%
def simulator(cells, spacing):
    """`build(values)`, from parameters to scene and initial state, and the particles."""
    h = 1 / cells
    x, volumes = sampling.block(lower, upper, spacing)
    grid = pgjax.Grid((0, 0, -3 * h), (cells, cells, round(0.4 / h) + 3), h)
    plate = boundary.Collider(boundary.HalfSpace((0, 0, 0), (0, 0, 1)), boundary.Sticky())

    def build(values):
        jelly = models.Material(models.FixedCorotated(values["E"], values["nu"]), density=1000.0)
        scene = pgjax.Scene(
            grid, jelly, volumes, gravity=(0, 0, -9.81), boundaries=[plate], scheme=pgjax.MLS()
        )
        v0 = jnp.append(values["v0"], 0.0)
        return scene, pgjax.initial_state(scene, x, v0)

    return build, x


build, particles = simulator(cells, 0.5 / cells)
truth = {"E": 2e4, "nu": 0.3, "v0": np.array([0.6, -0.3])}  # Pa, 1, m/s
frame_dt = 1 / 40  # s
frames = 8 if FAST else 16

unknowns = {
    "E": Parameter(8e3, lower=3e3, upper=6e4, log=True, unit="Pa"),
    "nu": Parameter(0.2, lower=0.0, upper=0.42),
    "v0": Parameter((0.4, 0.0), lower=-2, upper=2, unit="m/s"),
}

# %% [markdown]
# ## Two films
#
# Both are simulated with the true values, drawn, and written as an .mp4 of 8 bits per channel at half
# the resolution of colour: what is read back is all that the fits get to see. For tier *cross* the
# spacing of the grid is 1.5 times as fine, the particles are others, and the time step is half as long;
# the Gaussians of the block ride on the nearest particle, $x = x_p + F_p (X - X_p)$.


# %%
@jax.jit
def picture(x, F):
    moved = render.deform(gaussians, x, F)
    return jnp.clip(render.render(moved, camera, background=white).rgb, 0, 1)


def filmed(name, x, F):
    """Frames of the moving Gaussians, through a video file, `(frames + 1, h, w, 3)` in [0, 1]."""
    render.save_video(folder / name, map(picture, x, F), fps=1 / frame_dt)
    return render.load_video(folder / name).pictures / np.float32(255)


@eqx.filter_jit
def rollout(scene, state, substeps):
    """Positions and deformations of all frames, and which particles were not lost."""
    motion = pgjax.simulate(scene, state, dt=frame_dt / substeps, frames=frames, substeps=substeps)
    return motion.saved.x, motion.saved.F, motion.final.alive


def played(build, values, substeps):
    """The first two for a `build` and values by name."""
    x, F, alive = rollout(*build(jax.tree.map(jnp.float32, values)), substeps)
    assert bool(alive.all())
    return x, F


blank = Pictures(gaussians, camera, np.zeros((frames, pixels, pixels, 3)), background=white)
problem = Problem(unknowns, build, blank, frame_dt=frame_dt)

fine_build, fine = simulator(round(1.5 * cells), 0.31 / cells)
x_fine, F_fine = played(fine_build, truth, 2 * math.ceil(1.5 * problem.substeps))
_, nearest = KDTree(fine).query(X)
offset = jnp.asarray(X - fine[nearest], jnp.float32)
F_ridden = F_fine[:, nearest]
x_ridden = x_fine[:, nearest] + jnp.einsum("fpij,pj->fpi", F_ridden, offset)

films = {
    "self": filmed("self.mp4", *played(build, truth, problem.substeps)),
    "cross": filmed("cross.mp4", x_ridden, F_ridden),
}
print(f"{len(particles)} particles in the estimator, {len(fine)} in the film of tier cross")
Video(folder / "cross.mp4", embed=True, width=288)

# %% [markdown]
# A residual is the difference of a pixel over its noise. What is wrong with a pixel of a compressed
# video is shared by its neighbours, so that squares of 2 × 2 pixels are compared. The noise of 0.02 is
# a guess, which the fit corrects by what is left of the residual.

# %%
problems = {
    tier: problem.observing(
        Pictures(gaussians, camera, film[1:], background=white, sigma=0.02).coarser(2)
    )
    for tier, film in films.items()
}

# %% [markdown]
# ## The loss, and its derivative
#
# Half the squared residual over the modulus, everything else being true, and its slope by `jax.jvp`
# through simulation and picture. The slope is zero where the loss is least, which is at the truth for
# tier *self* and near it for tier *cross*.

# %%
free = problem.space.vector(truth)


@eqx.filter_jit
def loss_and_slope(problem, log_E):
    def loss(log_E):
        return problem.outcome(jnp.asarray(free, jnp.float32).at[0].set(log_E)).cost

    return jax.jvp(loss, (log_E,), (jnp.ones(()),))


moduli = np.geomspace(5e3, 5e4, 5 if FAST else 21)
scans = {
    tier: np.array([loss_and_slope(p, jnp.float32(np.log(E))) for E in moduli]).T
    for tier, p in problems.items()
}
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
for tier, (cost, slope) in scans.items():
    left.loglog(moduli / 1e3, cost, "o-", ms=3, label=tier)
    right.semilogx(moduli / 1e3, slope, "o-", ms=3, label=tier)
for axis in (left, right):
    axis.axvline(truth["E"] / 1e3, color="0.5", ls=":", label="truth")
    axis.set_xticks([5, 10, 20, 50], ["5", "10", "20", "50"])
    axis.set_xticks([], minor=True)
    axis.set_xlabel("$E$, kPa")
    axis.legend()
left.set_ylabel("loss")
right.set_ylabel(r"$\partial$ loss / $\partial \log E$")
plt.show()

# %% [markdown]
# ## The fits
#
# Levenberg–Marquardt on the residual vector from guesses that are off by a factor of two. Intervals
# come from $(J^\mathsf{T} J / s^2)^{-1}$ with the noise $s$ that is left, and are widened where the
# estimate scatters between frames or the secant disagrees with the derivative.

# %%
tolerance = 1e-3 if FAST else None  # None: that of the precision
found = {tier: fit(p, trials=20, tolerance=tolerance) for tier, p in problems.items()}
for tier, result in found.items():
    print(
        f"tier {tier}: {result.iterations} points, {result.simulations} simulations, "
        f"noise {0.02 * result.uncertainty.noise:.3f}"
    )
    print(result.summary(), "\n")

# %%
names = problem.names
labels = ["log $E$", r"$\nu$", "$v_x$", "$v_y$"]
figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.4), layout="constrained")
for tier, result in found.items():
    costs = [trial.cost for trial in result.trials]
    left.semilogy(np.minimum.accumulate(costs), "o-", ms=3, label=tier)
left.set(xlabel="point", ylabel="smallest loss so far")
left.legend()

exact = [truth["E"], truth["nu"], *truth["v0"]]
units = np.array([truth["E"] / 100, 0.01, 0.01, 0.01])
for k, (tier, result) in enumerate(found.items()):
    for j, name in enumerate(names):
        interval = result.uncertainty.interval(name)
        ends = (np.array([interval.low, interval.high]) - exact[j]) / units[j]
        estimate = (result.rows()[j][1] - exact[j]) / units[j]
        middle.plot(ends, [j + 0.2 * k] * 2, color=f"C{k}", lw=2, label=tier if j == 0 else None)
        middle.plot(estimate, j + 0.2 * k, "o", color=f"C{k}", ms=4)
middle.axvline(0, color="0.5", ls=":")
middle.set_yticks(range(4), ["$E$ (1 %)", r"$\nu$ (0.01)", *(f"{v} (cm/s)" for v in labels[2:])])
middle.set(xlabel="estimate and 95 % interval, minus truth", ylim=(3.7, -0.5))
middle.legend()

image = right.imshow(found["cross"].uncertainty.correlation, cmap="RdBu", vmin=-1, vmax=1)
right.set_xticks(range(4), labels)
right.set_yticks(range(4), labels)
right.set_title("correlation, tier cross")
figure.colorbar(image, ax=right)
plt.show()

# %% [markdown]
# Observed, predicted by the fit of tier *cross*, and their difference (grey is none).

# %%
predicted = list(map(picture, *played(build, found["cross"].values, problem.substeps)))
shown = np.linspace(1, frames, 5).astype(int)
figure, axes = plt.subplots(3, 5, figsize=(9, 5.4), layout="constrained")
for column, f in zip(axes.T, shown, strict=True):
    seen, made = films["cross"][f], np.asarray(predicted[f])
    for axis, picture in zip(column, (seen, made, 0.5 + 2 * (seen - made)), strict=True):
        axis.imshow(np.clip(picture, 0, 1))
        axis.set(xticks=[], yticks=[])
    column[0].set_title(f"{f * frame_dt:.3f} s")
for axis, label in zip(axes[:, 0], ("observed", "predicted", "difference × 2"), strict=True):
    axis.set_ylabel(label)
plt.show()

# %% [markdown]
# ## What the numbers are worth
#
# Both films give the modulus to two percent and Poisson's ratio to 0.02; the two are correlated,
# since a softer block and a more compressible one sag alike. The intervals are of this order, but do
# not always hold the truth: they know noise and scatter between frames. What compression does to all
# frames alike is neither, nor is the error of a coarse grid in tier *cross*, which moves the velocity
# most. More frames do not help against it; a finer grid does.

# %%
off = {tier: np.array([row[1] for row in result.rows()]) - exact for tier, result in found.items()}
for tier, errors in off.items():
    print(
        f"tier {tier:5}: E off by {100 * errors[0] / truth['E']:+.2f} %, nu by {errors[1]:+.4f}, "
        f"v0 by {100 * np.abs(errors[2:]).max():.2f} cm/s at most"
    )

log_E, step = np.log(1.3e4), 0.02
_, slope = loss_and_slope(problems["cross"], jnp.float32(log_E))
(ahead, _), (behind, _) = (
    loss_and_slope(problems["cross"], jnp.float32(log_E + s)) for s in (step, -step)
)
secant = float(ahead - behind) / (2 * step)
print(f"slope {float(slope):.4g}, by differences {secant:.4g}")

assert all(result.converged for result in found.values())
assert abs(slope / secant - 1) < 0.05
# Tier self: what compression leaves of the film. Tier cross: what this grid can do.
for tier, (modulus, ratio, speed) in {
    "self": (0.02, 0.02, 0.01),
    "cross": (0.1, 0.05, 0.05),
}.items():
    allowed = np.array([modulus * truth["E"], ratio, speed, speed]) * (2 if FAST else 1)
    assert (np.abs(off[tier]) < allowed).all(), (tier, off[tier])
# The losses are least there, not at the ends of the scan.
for cost, _ in scans.values():
    assert abs(np.log(moduli[np.argmin(cost)] / truth["E"])) < 0.4
