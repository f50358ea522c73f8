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
# # A captured scene moves
#
# A scene captured as Gaussians is read from a `.ply`, becomes a body of rubber, hops, lands, and is
# drawn to a video. These are the parts that `pgjax run` puts together, one cell each. At the end it
# is checked that every Gaussian was deformed as the material around it was. It takes about a minute
# on two cores.

# %%
import importlib.util
import math
import os
import tempfile
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Markdown, Video
from scipy.spatial import KDTree

import pgjax
from pgjax import boundary, models, render, sampling
from pgjax.scenes.procedural import MODELS

FAST = os.environ.get("PGJAX_FAST") == "1"  # fewer particles and frames
temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)

# %% [markdown]
# ## The capture
#
# There is no photograph to train from here, so a program makes the Gaussians: a fox on a lawn,
# filled throughout. It is written as a trainer would write it, in arbitrary units, with $y$ down.

# %%
made = MODELS["fox"](0, 0.5 if FAST else 0.85)
y_down = jnp.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
as_captured = render.Similarity(3.0, y_down, jnp.array([0.4, -0.2, 5.0]))
render.save_ply(folder / "fox.ply", made.transformed(as_captured))

capture = render.load_ply(folder / "fox.ply")
print(f"{len(capture)} Gaussians, harmonics of degree {capture.degree}")
print("from", np.asarray(capture.means.min(axis=0)), "to", np.asarray(capture.means.max(axis=0)))

# %% [markdown]
# ## Placement
#
# The simulation is in metres with $z$ up: a similarity $x_\text{sim} = s\,Q\,x + t$ takes the
# capture there. What is above the lawn is simulated, the lawn is drawn only. Where it ends shows in
# the heights of the Gaussians.

# %%
upright = y_down.T  # Q
turned = np.asarray(capture.means @ upright.T)
lawn_ends = 0.19  # in units of the capture, read off the figure
moves = turned[:, 2] > lawn_ends

lower, upper = turned[moves].min(axis=0), turned[moves].max(axis=0)
scale = 1.0 / (upper - lower).max()  # the fox is 1 m long
foot = np.array([*(lower + upper)[:2] / 2, lower[2]])
to_simulation = render.Similarity(scale, upright, -scale * foot)
placed = capture.transformed(to_simulation)
fox, lawn = placed[moves], placed[~moves]

camera = render.Camera.orbit(
    (0.1, 0, 0.6),
    up=(0, 0, 1),
    azimuth=math.radians(-55),
    elevation=math.radians(8),
    radius=3.3,
    fov_y=math.radians(30),
    width=240,
    height=240,
)
white = (1.0, 1.0, 1.0)

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
left.hist(turned[:, 2], bins=120, color="0.5")
left.axvline(lawn_ends, color="C3", label="end of the lawn")
left.set(xlabel="height, units of the capture", ylabel="Gaussians", yscale="log")
left.legend()
right.imshow(np.clip(render.render(placed, camera, background=white).rgb, 0, 1))
right.set_title(f"{len(fox)} Gaussians move, {len(lawn)} do not")
right.axis("off")
plt.show()

# %% [markdown]
# ## From Gaussians to a body
#
# Every Gaussian that moves is a particle. Its rest volume comes from the distances to its
# neighbours, its mass from the density. The wall is a half-space; it acts before its nodes are
# reached, so it stands 0.6 spacings of the grid below the lawn that is seen. `stable_dt` knows the
# sharp bound of the time step for this law, grid and speed.

# %%
x0 = np.asarray(fox.means)
volumes = sampling.neighbour_volumes(x0)

h = 0.06 if FAST else 0.038  # m
shape = [round(size / h) for size in (1.7, 1.02, 1.67)]
grid = pgjax.Grid(origin=(-0.85, -0.51, -0.12), shape=shape, h=h)
rubber = models.Material(models.FixedCorotated(E=1.5e5, nu=0.35), density=1000.0)
floor = boundary.Collider(
    boundary.HalfSpace((0, 0, -0.6 * h), (0, 0, 1)), boundary.Separating(friction=0.6)
)
scene = pgjax.Scene(
    grid, rubber, volumes, gravity=(0, 0, -9.81), boundaries=[floor], scheme=pgjax.MLS()
)
state = pgjax.initial_state(scene, x0, v=(0.3, 0, 2.3))

fps = 24
dt = pgjax.stable_dt(scene, state, frame=1 / fps)
substeps = round(1 / fps / dt)
print(f"{1000 * volumes.sum():.1f} l, so {1000 * volumes.sum():.1f} kg")
print(f"time step {1e6 * dt:.0f} µs, {substeps} in a frame")

# %% [markdown]
# ## The motion
#
# `ledger=True` keeps the accounts of mass, momentum and energy. What nothing else explains is
# called numerical: what is stopped at the floor, and what the transfers dissipate.

# %%
frames = 15 if FAST else 36
motion = pgjax.simulate(scene, state, dt=dt, frames=frames, substeps=substeps, ledger=True)
motion.plot()

# %% [markdown]
# ## The pictures
#
# `deform` carries a Gaussian along: its mean goes to $x$, its covariance becomes
# $A = F A_0 F^\mathsf{T}$, its harmonics turn with the rotation in $F$. The lawn does not move and
# is projected once.

# %%
around = render.prepare_surroundings(lawn, camera)


@jax.jit
def picture(x, F):
    return jnp.clip(around.render(render.deform(fox, x, F), background=white).rgb, 0, 1)


x, F = motion.saved.x, motion.saved.F
film = [np.asarray(picture(x[f], F[f])) for f in range(frames + 1)]
render.save_video(folder / "fox.mp4", film, fps=fps)
Video(folder / "fox.mp4", embed=True, width=360)

# %%
shown = np.linspace(0, frames, 6).astype(int)
figure, axes = plt.subplots(1, 6, figsize=(12, 2.3), layout="constrained")
for axis, f in zip(axes, shown, strict=True):
    axis.imshow(film[f])
    axis.set_title(f"{f / fps:.2f} s")
    axis.axis("off")
plt.show()

# %% [markdown]
# ## Does what is drawn belong to what moves?
#
# The simulation carries $F$ by $\dot F = L F$; the motion of the particles themselves is another
# witness. For every particle the linear map that takes its neighbours from where they were to
# where they are,
#
# $$\hat F = \arg\min_F \sum_{j \in \text{neighbours}}
#     \lVert (x_j - x) - F (X_j - X) \rVert^2,$$
#
# gives a covariance $\hat F A_0 \hat F^\mathsf{T}$ that should be the one that is drawn, up to
# what $F$ varies among the neighbours. Keeping $A_0$ as it was, as if the Gaussian were a bead that
# is only carried along, is the yardstick.

# %%
_, neighbours = KDTree(x0).query(x0, k=13)


def fitted(x):
    """The map of each neighbourhood, (p, 3, 3)."""
    X = x0[neighbours[:, 1:]] - x0[:, None]
    y = x[neighbours[:, 1:]] - x[:, None]
    # The normal equations of the least squares: F (Σ X Xᵀ) = Σ y Xᵀ.
    return np.einsum("pki,pkj->pij", y, X) @ np.linalg.inv(np.einsum("pki,pkj->pij", X, X))


def relative(A, B):
    return np.linalg.norm(A - B, axis=(1, 2)) / np.linalg.norm(B, axis=(1, 2))


A0 = np.asarray(fox.covariances)
drawn, carried = [], []
for f in range(1, frames + 1):
    F_hat = fitted(np.asarray(x[f]))
    A_hat = F_hat @ A0 @ F_hat.transpose(0, 2, 1)
    A = np.asarray(render.deform(fox, x[f], F[f]).covariances)
    drawn.append(np.median(relative(A, A_hat)))
    carried.append(np.median(relative(A0, A_hat)))

t = np.asarray(motion.t)[1:]
plt.figure(figsize=(7, 3), layout="constrained")
plt.semilogy(t, carried, label="$A_0$, not deformed", color="0.5")
plt.semilogy(t, drawn, label="as drawn, $F A_0 F^T$")
plt.xlabel("time, s")
plt.ylabel("median error of the covariance")
plt.legend()
plt.show()

# %% [markdown]
# The accounts say the same of momentum: what the fox has gained is what gravity and the floor gave
# it, to rounding, and until it lands its centre of mass is on a parabola.

# %%
ledger = motion.ledger
mass, momentum = float(ledger.mass[0]), np.asarray(ledger.momentum)
t = np.asarray(motion.t)
gravity = mass * np.outer(t, [0, 0, -9.81])
unexplained = momentum - momentum[0] - gravity - np.asarray(ledger.flows.impulse)

weights = volumes / volumes.sum()
height = np.einsum("p,fp->f", weights, np.asarray(x)[..., 2])
parabola = height[0] + 2.3 * t - 9.81 / 2 * t * (t + dt)  # as a method of first order has it
aloft = np.abs(np.asarray(ledger.flows.impulse)).max(axis=1) == 0

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.plot(t, parabola, "--", color="0.5", label="free flight")
left.plot(t, height, label="centre of mass")
left.set(xlabel="time, s", ylabel="height, m", ylim=(0, 1.1 * height.max()))
left.legend()
right.plot(t, momentum[:, 2], label="of the fox")
right.plot(t, momentum[0, 2] + gravity[:, 2], "--", color="0.5", label="start and gravity")
right.plot(t, ledger.flows.impulse[:, 2], label="from the floor")
right.set(xlabel="time, s", ylabel="vertical momentum, kg m/s")
right.legend()
plt.show()

# %% [markdown]
# With the extra `view` the same frames can be looked at from all sides while this notebook is
# running.

# %%
if importlib.util.find_spec("viser") and not FAST:
    from pgjax import view

    (folder / "run" / "ply").mkdir(parents=True)
    for f in range(frames + 1):
        moved = render.concatenate([render.deform(fox, x[f], F[f]), lawn])
        render.save_ply(folder / "run" / "ply" / f"{f:05d}.ply", moved)
    app = view.App(view.show_run(folder / "run", up="z"))
    threading.Thread(target=app.run, daemon=True).start()
    display(Markdown(f"[Open the viewer]({app.url}) (while the kernel runs)"))

# %%
print(f"covariances as drawn: off by {max(drawn):.3f} at most, undeformed {max(carried):.3f}")
missing = np.abs(unexplained).max() / np.abs(momentum).max()
print(f"momentum that nothing explains: {missing:.1e} of the largest")
print(f"height in free flight: off by {1000 * np.abs(height - parabola)[aloft].max():.2f} mm")

assert max(drawn) < 0.05, "Gaussians are deformed as their neighbourhood is"
assert max(carried) > 4 * max(drawn), "not so if they were beads"
assert missing < 1e-4
assert aloft.sum() > 5
assert np.abs(height - parabola)[aloft].max() < 1e-3
assert not motion.status.messages()
