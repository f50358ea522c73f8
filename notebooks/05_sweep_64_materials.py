# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Sweep 64 materials in one `vmap`
#
# A ball is thrown on the floor 64 times at once, each time of another material: eight stiffnesses,
# eight yield stresses, one compiled program. Some splash, some are dented, some rebound: the phase
# diagram has the boundaries that dimensional analysis predicts. A minute on two cores.

# %%
import os
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Video

import pgjax
from pgjax import boundary, models, render, sampling

FAST = os.environ.get("PGJAX_FAST") == "1"  # fewer particles and frames
plt.rcParams |= {"figure.dpi": 80, "font.size": 11}

# %% [markdown]
# ## One member
#
# A ball of 0.3 m and 1000 kg/m³ meets a rough floor with v = 4 m/s. The law is Hencky's elasticity
# with von Mises plasticity, $\lVert \operatorname{dev} \tau \rVert \le \tau_Y$. There is a floor and
# nothing else: what spreads too far leaves the grid.

# %%
DENSITY, SPEED, NU = 1000.0, 4.0, 0.3
h = 1 / 11 if FAST else 1 / 24
grid = pgjax.Grid((-0.5, -0.5, -0.1), (round(1 / h), round(1 / h), round(0.9 / h)), h)
x, volumes = sampling.ball((0, 0, 0.22), 0.15, spacing=h / 2)
floor = boundary.Box((-9, -9, 0), (9, 9, 9), boundary.Separating(friction=0.3))


def scene(E, tau_Y):
    material = models.Material(models.StVKHencky(E, NU), models.VonMises(tau_Y), DENSITY)
    return pgjax.Scene(grid, material, volumes, gravity=(0, 0, -9.81), boundaries=[floor])


def start(scene):
    return pgjax.initial_state(scene, x, v=(0, 0, -SPEED))


# %% [markdown]
# All members share one time step, that of the stiffest: it has to be known before anything is
# traced.

# %%
stiffness = np.geomspace(3e4, 3e5 if FAST else 1e6, 8)  # E, Pa
strength = np.geomspace(1e3, 1e6, 8)  # τ_Y, Pa
stiffest = scene(stiffness[-1], strength[-1])
FRAME, FRAMES = 0.008, 20  # s
dt = pgjax.stable_dt(stiffest, start(stiffest), frame=FRAME)
substeps = round(FRAME / dt)
print(f"{len(x)} particles, {FRAMES * substeps} steps of {1e3 * dt:.3f} ms")


def throw(E, tau_Y):
    """Heights of all particles over time, and how the ball ends."""
    ball = scene(E, tau_Y)
    motion = pgjax.simulate(
        ball, start(ball), dt=dt, frames=FRAMES, substeps=substeps, save=lambda s: (s.x, s.v)
    )
    positions, velocities = motion.saved
    rebound = jnp.max(jnp.mean(velocities[..., 2], axis=1)) / SPEED
    extent = jnp.ptp(motion.final.x, axis=0)
    flowed = jnp.mean(jnp.any(motion.final.He != motion.final.H, axis=(1, 2)))
    return {
        "x": positions,
        "F": motion.final.F,
        "rebound": rebound,
        "aspect": 2 * extent[2] / (extent[0] + extent[1]),
        "flowed": flowed,
        "status": motion.status,
    }


# %% [markdown]
# ## Sixty-four members
#
# The sweep is `vmap`. What one member needs while it runs is a 64th of the temporary memory of the
# compiled program.

# %%
E, tau_Y = (jnp.asarray(a.ravel()) for a in np.meshgrid(stiffness, strength, indexing="ij"))
began = time.perf_counter()
program = jax.jit(jax.vmap(throw)).lower(E, tau_Y).compile()
compiling = time.perf_counter() - began
began = time.perf_counter()
members = jax.block_until_ready(program(E, tau_Y))
batch_seconds = time.perf_counter() - began

memory = program.memory_analysis()
print(f"compiled in {compiling:.1f} s, ran in {batch_seconds:.1f} s")
print(f"while it runs: {memory.temp_size_in_bytes / 64 / 1e3:.0f} kB per member")
print(f"what is kept:  {memory.output_size_in_bytes / 64 / 1e3:.0f} kB per member")

# %% [markdown]
# Nothing can be raised inside of `vmap`: a member that fails says so in its status, with the step
# and the number of particles, and the others do not notice.

# %%
ok = np.asarray(members["status"].ok)
for k in np.flatnonzero(~ok):
    status = jax.tree.map(lambda a, k=k: a[k], members["status"])
    print(f"E = {E[k]:.2g} Pa, τ_Y = {tau_Y[k]:.2g} Pa: {status.messages()[0].partition('.')[0]}")

# %% [markdown]
# ## What they look like
#
# The balls as Gaussians, 64 pictures per frame, drawn by one `vmap` of `render`.

# %%
PIXELS = 48
camera = render.Camera.look_at(
    (0, -2.2, 0.6), (0, 0, 0.3), up=(0, 0, 1), width=PIXELS, height=PIXELS, fov_y=0.39
)
stripes = np.where((np.arctan2(x[:, 1], x[:, 0]) // 0.5 + x[:, 2] // 0.06) % 2 == 0, 0.85, 0.35)
colours = np.stack([stripes, 0.7 * stripes + 0.1, 1.0 - stripes], axis=1)


def picture(x):
    """A ball of round grains, two colours in squares, on white."""
    n = len(volumes)
    ball = render.Gaussians.from_scales(
        x,
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (n, 1)),
        jnp.full((n, 3), 0.3 * h),
        jnp.full((n,), 0.95),
        jnp.asarray((colours - 0.5) / 0.2821, x.dtype)[:, None, :],
    )
    return render.render(ball, camera, background=(1, 1, 1)).rgb


pictures = jax.jit(jax.vmap(picture))
faded = jnp.where(jnp.asarray(ok), 1.0, 0.35)[:, None, None, None]


def mosaic(frame):
    """Stiffness upwards, strength to the right; failed members are pale."""
    tiles = 1 - faded * (1 - pictures(members["x"][:, frame]))
    tiles = np.asarray(tiles).reshape(8, 8, PIXELS, PIXELS, 3)[::-1]
    return np.clip(tiles.transpose(0, 2, 1, 3, 4).reshape(8 * PIXELS, 8 * PIXELS, 3), 0, 1)


def video(frames, fps):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        render.save_video(path, frames, fps=fps)
        return Video(path.read_bytes(), embed=True, mimetype="video/mp4")


video([mosaic(f) for f in range(0, FRAMES + 1, 4 if FAST else 1)], fps=3 if FAST else 10)

# %% [markdown]
# ## The phase diagram
#
# Two numbers decide: $\tau_Y/\rho v^2$ says whether the material can stop the ball before it is
# flat, and $\tau_Y/(v\sqrt{\rho E})$ whether the impact yields at all, since $v\sqrt{\rho E}$ is the
# stress of an elastic impact. Both lines are drawn with the prefactor 1.

# %%
rebound, aspect, flowed = (
    np.where(ok, np.asarray(members[name]), np.nan).reshape(8, 8)
    for name in ("rebound", "aspect", "flowed")
)
inertia = DENSITY * SPEED**2
impact = SPEED * np.sqrt(DENSITY * stiffness)


def edges(values):
    """Borders of cells whose centres are spaced evenly in the logarithm."""
    half = np.sqrt(values[1] / values[0])
    return np.append(values / half, values[-1] * half)


fig, axes = plt.subplots(1, 3, figsize=(16, 5), constrained_layout=True)
sides = (strength[0], strength[-1])
for ax, (name, value, top) in zip(
    axes[:2],
    [
        ("velocity after / before impact", rebound, 1.0),
        ("height / width at the end", aspect, 1.0),
    ],
    strict=True,
):
    mesh = ax.pcolormesh(edges(strength), edges(stiffness), value, vmin=0, vmax=top)
    fig.colorbar(mesh, ax=ax, label=name)
    ax.axvline(inertia, color="w", ls="--", label=r"$\tau_Y = \rho v^2$")
    ax.plot(impact, stiffness, "w-", label=r"$\tau_Y = v\sqrt{\rho E}$")
    failed_E, failed_Y = np.asarray(E)[~ok], np.asarray(tau_Y)[~ok]
    ax.plot(failed_Y, failed_E, "rx", ms=9, mew=2, ls="", label="left the grid")
    ax.set(xscale="log", yscale="log", xlabel=r"yield stress $\tau_Y$, Pa", ylabel="E, Pa")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=9, facecolor="0.6")

tiles = axes[2]
tiles.imshow(mosaic(FRAMES))
middle = PIXELS * (np.arange(8) + 0.5)
decades = {n: rf"$10^{n}$" for n in (3, 4, 5, 6)}
tiles.set_xticks(np.interp(list(decades), np.log10(strength), middle), decades.values())
tiles.set_yticks(np.interp([5, 6], np.log10(stiffness), middle[::-1]), [decades[5], decades[6]])
tiles.set(xlabel=r"yield stress $\tau_Y$, Pa", ylabel="E, Pa", title=f"after {FRAME * FRAMES} s")
plt.show()

# %% [markdown]
# ## One at a time
#
# Some of the same throws by the same function, compiled once and called for one member after the
# other. Both ways use all cores; `vmap` saves the calls, and keeps all members in memory at once.

# %%
one = jax.jit(throw)
jax.block_until_ready(one(E[0], tau_Y[0]))
some = np.arange(0, 64, 16 if FAST else 8) + 3
began = time.perf_counter()
alone = [jax.block_until_ready(one(E[k], tau_Y[k])) for k in some]
single_seconds = (time.perf_counter() - began) / len(some)
apart = max(
    float(jnp.max(jnp.abs(a["x"] - members["x"][k]))) for k, a in zip(some, alone, strict=True)
)

print(f"one at a time: {single_seconds:.3f} s each, from {len(some)} of them")
print(f"in the batch:  {batch_seconds / 64:.3f} s each")
print(f"largest distance between the two: {apart:.1e} m")

# %% [markdown]
# ## The same in one call
#
# `pgjax.sweep` takes the function that builds a member and the values to combine. It groups members
# that need about the same time step, so that soft ones do not take the steps of the stiffest, bounds
# the memory, spreads groups over devices, and tabulates; a member that fails is a row that says why.


# %%
def build(values):
    ball = scene(values["E"], values["tau_Y"])
    return ball, start(ball)


began = time.perf_counter()
table = pgjax.sweep(build, {"E": stiffness, "tau_Y": strength}, frames=FRAMES, frame_dt=FRAME)
print(f"{time.perf_counter() - began:.1f} s with compiling, substeps per frame by stiffness:")
print(table.on_grid("substeps")[:, -1].astype(int))
print(table.summary())

# %% [markdown]
# Most members take larger time steps here than above, and end at the same height but for the error
# of time: a contact begins and ends a step earlier or later.

# %%
heights = np.asarray(jnp.mean(members["x"][:, -1, :, 2], axis=1))
both = ok & table.ok
off = np.abs(heights - table["mean_height"])[both].max()
print(f"mean heights at the end differ by at most {1e3 * off:.1f} mm")

# %% [markdown]
# ## The claim
#
# The batch computes what its members would alone, and `sweep` the same but for the time step. Those
# that fail are those that are too soft to stay on the grid. Far below $\tau_Y = \rho v^2$ every ball
# ends as a puddle, whatever its stiffness; none yields above three times $v\sqrt{\rho E}$, all do
# below a third of it.

# %%
assert apart < 1e-5
assert ok.sum() >= 48
assert off < 0.06  # a fifth of the ball
assert np.all(np.asarray(tau_Y)[~both] < 0.2 * inertia)
yield_ratio = strength[None, :] / impact[:, None]
known = np.isfinite(flowed)
assert np.all(flowed[known & (yield_ratio > 3)] == 0)
assert np.all(flowed[known & (yield_ratio < 1 / 3)] > 0.1)
assert np.all(aspect[:, strength < 0.2 * inertia][known[:, strength < 0.2 * inertia]] < 0.15)
assert np.all(rebound[yield_ratio > 3] > 0.6)
