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
# # Sand, metal, jam
#
# What makes a material flow is its return map. First the three maps themselves, in the space of
# stresses; then what their parameters do to a column of sand, a bar of metal and a dollop of jam, in
# two dimensions (plane strain). It takes about a minute on two cores.

# %%
import os
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Video

import pgjax
from pgjax import boundary, models, render, sampling

FAST = os.environ.get("PGJAX_FAST") == "1"  # coarser grids
g = 9.81  # m/s²

# %% [markdown]
# ## Return maps
#
# A step carries the elastic deformation $F_e$ to a trial state. Where that is beyond the yield
# surface, the map brings it back. Here are trial states at random, and where they end: the sand in
# the plane of pressure $p = -\mathrm{tr}\,\tau/3$ and $q = \sqrt{3/2}\,\lVert\mathrm{dev}\,\tau\rVert$,
# the other two seen along the axis of pressure. The paste is on its way: in a step it comes the
# nearer to its circle the longer the step is against $\eta/2\mu$.

# %%
E, nu = 1e6, 0.3  # Pa, 1
tau_Y, sigma_Y, phi = 4e4, 4e4, 35.0  # Pa, Pa, degrees
hencky, split = models.StVKHencky(E, nu), models.DevVolNeoHookean(E, nu)
mu = float(split.mu)
dt = 1e-3  # s
sand = models.Material(hencky, models.DruckerPrager(phi))
metal = models.Material(hencky, models.VonMises(tau_Y))
paste = models.Material(split, models.HerschelBulkley(sigma_Y, viscosity=2 * mu * dt))


@jax.jit
def returned(material, H, dt):
    """Kirchhoff stresses of trial states `H (n, 3, 3)`, and after the return map, `(n, 3, 3)`."""
    law, still = material.elasticity, jnp.zeros((3, 3))

    def one(H):
        new, _ = material.plasticity.return_map(H, None, law, dt)
        return law.kirchhoff(H, still), law.kirchhoff(new, still)

    return jax.vmap(one)(H)


def pressure(tau):
    return -np.trace(tau, axis1=1, axis2=2) / 3


def shear(tau):
    """The norm of the deviator."""
    return np.linalg.norm(tau + pressure(tau)[:, None, None] * np.eye(3), axis=(1, 2))


def along_pressure(tau):
    """Principal stresses of states that are diagonal, seen along the axis of pressure."""
    a, b, c = tau[:, 0, 0], tau[:, 1, 1], tau[:, 2, 2]
    return (a - b) / np.sqrt(2), (2 * c - a - b) / np.sqrt(6)


strains = np.random.default_rng(0).normal(-0.02, 0.05, (60, 3))
states = jnp.asarray(np.expm1(strains)[:, :, None] * np.eye(3), jnp.float32)
results = {
    name: [np.asarray(tau) for tau in returned(material, states, dt)]
    for name, material in {"sand": sand, "metal": metal, "jam": paste}.items()
}
alpha = float(sand.plasticity.alpha)
circle = np.exp(2j * np.pi * np.linspace(0, 1, 200))

figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
for axis, (name, (trial, end)) in zip(axes, results.items(), strict=True):
    if name == "sand":
        at, to = [(pressure(t), np.sqrt(1.5) * shear(t)) for t in (trial, end)]
        p = np.array([0, 1.4e5])
        axis.plot(p / 1e3, np.sqrt(1.5) * 3 * alpha * p / 1e3, "k", label="yield surface")
        axis.set(xlabel="$p$, kPa", ylabel="$q$, kPa", xlim=(-150, 250), ylim=(-10, 200))
    else:
        at, to = along_pressure(trial), along_pressure(end)
        radius = tau_Y if name == "metal" else np.sqrt(2 / 3) * sigma_Y
        axis.plot(
            radius * circle.real / 1e3, radius * circle.imag / 1e3, "k", label="yield surface"
        )
        axis.set(xlabel=r"$(\tau_1 - \tau_2)/\sqrt{2}$, kPa")
        axis.set(ylabel=r"$(2\tau_3 - \tau_1 - \tau_2)/\sqrt{6}$, kPa", aspect="equal")
    axis.plot(*(np.stack(pair) / 1e3 for pair in zip(at, to, strict=True)), "0.8", lw=0.8)
    axis.plot(at[0] / 1e3, at[1] / 1e3, "o", color="C1", ms=3, label="trial")
    axis.plot(to[0] / 1e3, to[1] / 1e3, "o", color="C0", ms=3, label="returned")
    axis.set_title(name)
axes[0].legend(loc="upper left", fontsize=8)
plt.show()

# %% [markdown]
# How far beyond the surface a state is: $f = \lVert\mathrm{dev}\,\tau\rVert - k$. The maps of sand and
# metal end at $f \le 0$, on the surface where they did anything, and do nothing the second time.

# %%
(sand_trial, sand_end), (metal_trial, metal_end), (jam_trial, jam_end) = results.values()
f_sand = shear(sand_end) - 3 * alpha * pressure(sand_end)
f_metal = shear(metal_end) - tau_Y
moved = {name: np.abs(trial - end).max(axis=(1, 2)) > 0 for name, (trial, end) in results.items()}
half_way = (shear(jam_end) - np.sqrt(2 / 3) * sigma_Y) / (
    shear(jam_trial) - np.sqrt(2 / 3) * sigma_Y
)
print(
    f"sand : {moved['sand'].sum()} of 60 flow, and end at |f| < {np.abs(f_sand[moved['sand']]).max():.2g} Pa"
)
print(
    f"metal: {moved['metal'].sum()} of 60 flow, and end at |f| < {np.abs(f_metal[moved['metal']]).max():.2g} Pa"
)
print(f"jam  : {moved['jam'].sum()} of 60 flow, and keep {half_way[moved['jam']].mean():.4f} of f")

# %% [markdown]
# ## Flow curves
#
# A paste that is sheared steadily at $\dot\gamma$ bears
# $\tau = \sigma_Y/\sqrt3 + \eta/\sqrt2\,(\dot\gamma/\sqrt2)^h$: the exponent $h$ makes it thin
# ($h < 1$) or thicken as it is sheared faster. The dots are what the map itself ends in.


# %%
@jax.jit
def steady(h, rate):
    """Shear stress of the paste after a shear of 1 at this rate, Pa."""
    law, flow = models.DevVolNeoHookean(1e6, nu), models.HerschelBulkley(100.0, 20.0, h)
    steps = 300 if FAST else 1000
    L = jnp.zeros((3, 3)).at[0, 1].set(rate)
    dt = 1 / rate / steps

    def step(_, H):
        return flow.return_map(H + dt * (L + L @ H), None, law, dt)[0]

    H = jax.lax.fori_loop(0, steps, step, jnp.zeros((3, 3)))
    return law.kirchhoff(H, L)[0, 1]


exponents, rates = np.array([0.5, 1.0, 1.5]), np.geomspace(0.1, 100, 7)  # 1, 1/s
found = np.asarray(jax.vmap(jax.vmap(steady, (None, 0)), (0, None))(exponents, rates))
known = 100 / np.sqrt(3) + 20 / np.sqrt(2) * (rates / np.sqrt(2)) ** exponents[:, None]
plt.figure(figsize=(6, 3.4), layout="constrained")
for h, dots, line in zip(exponents, found, known, strict=True):
    (curve,) = plt.loglog(rates, line, lw=1)
    plt.loglog(rates, dots, "o", color=curve.get_color(), label=f"$h$ = {h:g}")
plt.xlabel(r"rate of shear $\dot\gamma$, 1/s")
plt.ylabel(r"shear stress $\tau_{12}$, Pa")
plt.legend()
plt.show()

# %% [markdown]
# ## Sand: the angle of friction
#
# A column as high as it is wide stands at a smooth wall on rough ground, and is let go. One program,
# `vmap`ped over $\varphi$, lets four sands run. The cone matches $\varphi$ in a triaxial test; in plane
# strain it acts as $\tan^{-1}(3\alpha/\sqrt2)$. Deposits are flatter than that: what runs down
# overshoots.


# %%
def wall(axis, contact):
    """The half-plane behind the origin across one axis."""
    return boundary.Collider(boundary.HalfSpace((0, 0), np.eye(2)[axis]), contact)


def run(material_of, values, x, volumes, grid, boundaries, seconds, frames, **forces):
    """Trajectories of one set-up for all values of a parameter, `(values, frames + 1, p, 2)`."""

    def scene(value):
        return pgjax.Scene(grid, material_of(value), volumes, boundaries=boundaries, **forces)

    state = pgjax.initial_state(scene(values[0]), x)
    dt = min(pgjax.stable_dt(scene(v), frame=seconds / frames, fraction=0.4) for v in values)
    substeps = round(seconds / frames / dt)

    def motion(value):
        run = pgjax.simulate(scene(value), state, dt=dt, frames=frames, substeps=substeps)
        return run.t, run.saved.x, run.final.alive  # the less is kept, the faster it compiles

    t, x, alive = jax.jit(jax.vmap(motion))(jnp.asarray(values))
    assert bool(alive.all())
    return np.asarray(t)[0], np.asarray(x)


width = 0.2  # m
h = width / (8 if FAST else 16)
frames = 20 if FAST else 32
block, areas = sampling.block((0, 0), (width, width), spacing=h / 2)
angles = [15.0, 20.0, 30.0, 40.0]  # degrees
t_sand, x_sand = run(
    lambda phi: models.Material(
        models.StVKHencky(4e5, 0.3), models.DruckerPrager(phi, volume_correction=True), 1500.0
    ),
    angles,
    block,
    areas,
    pgjax.Grid((0, 0), (round(5 * width / h), round(width / h) + 4), h),
    [wall(0, boundary.Slip()), wall(1, boundary.Sticky())],
    seconds=0.8,
    frames=frames,
    gravity=(0, -g),
)


def surface(x, bins):
    """Height of the highest particle of each bin, m."""
    number = np.digitize(x[:, 0], bins)
    return np.array([x[number == k, 1].max(initial=0) for k in range(1, len(bins))])


bins = np.arange(0, 5 * width, h)
runout = np.quantile(x_sand[:, -1, :, 0], 0.99, axis=1) / width - 1
tops = x_sand[:, -1, :, 1].max(axis=1) / width
slopes = np.degrees(np.arctan(tops / (1 + runout)))
alphas = np.array([models.DruckerPrager(phi).alpha for phi in angles])
acts_as = np.degrees(np.arctan(3 / np.sqrt(2) * alphas))

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.2), layout="constrained")
for phi, x in zip(angles, x_sand, strict=True):
    left.plot(
        (bins[1:] - h / 2) / width, surface(x[-1], bins) / width, label=rf"$\varphi$ = {phi:.0f}°"
    )
left.plot([0, 1, 1], [1, 1, 0], ":k", label="at first")
left.set(xlabel="$x/W$", ylabel="height/$W$", aspect="equal", xlim=(0, 4))
left.legend(fontsize=8)
right.plot(angles, slopes, "o-")
right.plot(angles, acts_as, ":k", label="angle of friction in plane strain")
right.set(xlabel=r"angle of friction $\varphi$, degrees", ylabel="slope of the deposit, degrees")
right.legend()
plt.show()

# %% [markdown]
# ## Metal: the yield stress
#
# A bar is stuck in a wall. Its weight grows and vanishes again within 0.7 s: what is left of the bend
# is plastic.

# %%
length, thickness = 0.3, 0.06  # m
h = thickness / (2 if FAST else 4)
bar, areas = sampling.block((-3 * h, 0), (length, thickness), spacing=h / 2)


def weight(X, t):
    """Twice the gravity of the earth, which comes and goes, m/s²."""
    del X
    return jnp.where(t < 0.7, jnp.sin(jnp.pi * t / 0.7) ** 2, 0) * jnp.array([0, -2 * g])


strengths = [2.8e4, 3.4e4, 4e4, 1e6]  # Pa
shape = (round(length / h) + 12, round(0.5 / h))
t_bar, x_bar = run(
    lambda tau_Y: models.Material(models.StVKHencky(1e6, 0.3), models.VonMises(tau_Y), 1000.0),
    strengths,
    bar,
    areas,
    pgjax.Grid((-6 * h, thickness + 0.1 - shape[1] * h), shape, h),
    [wall(0, boundary.Sticky())],
    seconds=1.0,
    frames=frames,
    body_force=weight,
    X0=bar,
    grid_damping=8.0,
)
tip = bar[:, 0] > length - h
sag = -(x_bar[:, :, tip, 1] - bar[tip, 1]).mean(axis=2)

plt.figure(figsize=(7, 3.4), layout="constrained")
for tau_Y, path in zip(strengths, sag, strict=True):
    plt.plot(t_bar, 100 * path, label=rf"$\tau_Y$ = {tau_Y / 1e3:.0f} kPa")
plt.xlabel("time, s")
plt.ylabel("sag of the tip, cm")
plt.legend()
plt.show()

# %% [markdown]
# ## Jam: where it stops, and when
#
# A dollop slumps on a plate. The yield stress says where it stops, the viscosity how long that
# takes: the two thick ones are still creeping when the film ends.

# %%
h = width / (6 if FAST else 12)
dollop, areas = sampling.block((0, 0), (width, width), spacing=h / 2)
recipes = np.array([[150.0, 20.0], [150.0, 200.0], [400.0, 20.0], [400.0, 200.0]])  # Pa, Pa s
t_jam, x_jam = run(
    lambda recipe: models.Material(
        models.DevVolNeoHookean(2e4, 0.3), models.HerschelBulkley(recipe[0], recipe[1]), 1300.0
    ),
    recipes,
    dollop,
    areas,
    pgjax.Grid((0, 0), (round(4 * width / h), round(width / h) + 4), h),
    [wall(0, boundary.Slip()), wall(1, boundary.Sticky())],
    seconds=1.6,
    frames=frames,
    gravity=(0, -g),
)
height = x_jam[..., 1].max(axis=2) / width
front = np.quantile(x_jam[..., 0], 0.99, axis=2) / width
half = [np.interp(0.5 * (1 + f[-1]), f, t_jam) for f in front]  # s

plt.figure(figsize=(8.5, 3.4), layout="constrained")
for (sigma_Y, eta), path in zip(recipes, front, strict=True):
    color, style = ("C0" if sigma_Y == 150 else "C1"), ("-" if eta == 20 else "--")
    label = rf"$\sigma_Y$ = {sigma_Y:.0f} Pa, $\eta$ = {eta:.0f} Pa s"
    plt.plot(t_jam, path, style, color=color, label=label)
plt.xlabel("time, s")
plt.ylabel("front over width")
plt.legend(loc="upper left", bbox_to_anchor=(1.02, 1))
plt.show()

# %% [markdown]
# ## All of them moving

# %%
rows = [
    ("sand", x_sand, [rf"$\varphi$ = {v:.0f}°" for v in angles], (0, 0.8, 0, 0.25)),
    (
        "metal",
        x_bar,
        [rf"$\tau_Y$ = {v / 1e3:.0f} kPa" for v in strengths],
        (-0.05, 0.35, -0.22, 0.1),
    ),
    ("jam", x_jam, [rf"{v[0]:.0f} Pa, {v[1]:.0f} Pa s" for v in recipes], (0, 0.8, 0, 0.25)),
]
figure, axes = plt.subplots(3, 4, figsize=(8, 4), dpi=80, layout="constrained")
clouds = []
for row, (name, x, labels, box) in zip(axes, rows, strict=True):
    row[0].set_ylabel(name)
    for axis, member, label in zip(row, x, labels, strict=True):
        color = member[0][:, 0] + member[0][:, 1]
        cloud = axis.scatter(*member[0].T, c=color, s=1.5, cmap="viridis")
        clouds.append((cloud, member))
        axis.set(xlim=box[:2], ylim=box[2:], aspect="equal", xticks=[], yticks=[])
        axis.set_title(label, fontsize=8)


def drawn(f):
    for cloud, member in clouds:
        cloud.set_offsets(member[f])
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255


with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "flows.mp4"
    shown = range(0, frames + 1, 5 if FAST else 1)
    render.save_video(path, map(drawn, shown), fps=12)
    video = Video(path.read_bytes(), embed=True, mimetype="video/mp4", width=640)
plt.show()
video

# %%
print("sand : slopes of", ", ".join(f"{s:.1f}°" for s in slopes))
print("metal: sag left", ", ".join(f"{100 * s:.1f} cm" for s in sag[:, -1]))
print("jam  : height", ", ".join(f"{v:.2f}" for v in height[:, -1]), "of the first")
print("jam  : half of the way after", ", ".join(f"{v:.2f} s" for v in half))

# The maps end on the surface, to the rounding of single precision.
assert np.abs(f_sand[moved["sand"]]).max() < 1e-5 * E
assert np.abs(f_metal[moved["metal"]]).max() < 1e-5 * E
assert max(f_sand.max(), f_metal.max()) < 1e-5 * E
np.testing.assert_allclose(half_way[moved["jam"]], 0.5, atol=0.01)
np.testing.assert_allclose(found, known, rtol=0.02)
# Rougher sand lies steeper, but flatter than its angle of friction.
assert (np.diff(slopes) > 1).all()
assert (slopes < acts_as).all()
# Softer metal stays bent further; what never yields comes back.
assert (np.diff(sag[:, -1]) < 0).all()
assert abs(sag[-1, -1]) < 0.2 * sag[0, -1]
# The yield stress says where the jam stops, the viscosity when.
assert (height[2:, -1] > 1.1 * height[:2, -1]).all()
assert half[1] > 1.2 * half[0]
assert half[3] > 1.2 * half[2]
