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
# # Your own law, wall and loss
#
# A column of clay and rubber stands on a table that is turned to and fro. Rubber, clay and table are
# written here, in a few lines each, and so is the loss that compares pictures. Where there is
# something built in to compare with, ours agrees to rounding; the gradient of the loss agrees with
# finite differences. A minute on two cores.

# %%
import importlib.util
import os
import tempfile
import threading
from pathlib import Path
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import Markdown, Video, display

import pgjax
from pgjax import boundary, models, render, sampling
from pgjax.models.strain import left_strain, log_volume

FAST = os.environ.get("PGJAX_FAST") == "1"  # fewer particles and frames
plt.rcParams |= {"figure.dpi": 80, "font.size": 11}
jax.config.update("jax_enable_x64", True)  # for the finite differences
temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)


# %% [markdown]
# ## Rubber from its energy
#
# A law sees one particle, as $H = F - I$. With $a = I_1 - 3 - 2 \log J$, which is 0 at rest and of
# second order around it, Gent's rubber stiffens until its chains are stretched out, at $a = J_m$:
#
# $$\psi = -\frac{\mu J_m}{2} \log\Bigl(1 - \frac{a}{J_m}\Bigr) + \frac{\lambda}{2} \log^2 J, \qquad
# \tau = \frac{\partial \psi}{\partial F} F^\mathsf{T}.$$
#
# The stress is the derivative of the energy, by `jax.grad`. A `parameter` is an array, one number or
# one per particle: it can be differentiated, and a new value compiles nothing.


# %%
@final
class Gent(models.AbstractElasticity):
    """Rubber of limited extensibility; neo-Hookean where `limit` is infinite."""

    E: jax.Array = models.parameter()
    nu: jax.Array = models.parameter()
    limit: jax.Array = models.parameter()  # J_m

    def energy(self, H, history=None):
        log_J, _ = log_volume(H)
        a = jnp.trace(left_strain(H)) - 2 * log_J
        chains = -self.mu * self.limit / 2 * jnp.log1p(-a / self.limit)
        return chains + self.lam / 2 * log_J**2

    def kirchhoff(self, H, L, history=None):
        return jax.grad(self.energy)(H) @ (jnp.eye(3, dtype=H.dtype) + H).T


# %% [markdown]
# With $J_m \to \infty$ this is the built-in `NeoHookean`, whose stress is written by hand from
# $B = F F^\mathsf{T} - I$. In double precision they agree to rounding. In single precision the
# derivative of an energy loses digits where the strain is small (it is a difference of two terms of
# the size of μ), the other form does not: that is what the hand-written stress is for.
#
# How stiff a law is at a strain decides the stable time step: $\rho c^2$ is the largest eigenvalue of
# the derivative of τ for $F \leftarrow (I + L) F$, $3\lambda + 2\mu$ at rest. Where a law stiffens as
# this one does, leave room for it, or have `simulate` watch it by a method `tangent_bound`.

# %%
rng = np.random.default_rng(0)
ours, built_in = Gent(1e5, 0.3, 1e15), models.NeoHookean(1e5, 0.3)
sizes = np.geomspace(1e-6, 0.2, 12)
H = jnp.asarray(sizes[:, None, None] * rng.normal(size=(12, 3, 3)) / 3)


@jax.jit
def stresses(law, H):
    return jax.vmap(lambda H: law.kirchhoff(H, None))(H)


@jax.jit
def largest_modulus(law, H):
    """ρ c² at each strain, Pa."""

    def one(H):
        F = jnp.eye(3) + H
        tangent = jax.jacfwd(lambda L: law.kirchhoff(H + L @ F, None))(jnp.zeros((3, 3)))
        tangent = tangent.reshape(9, 9)
        return jnp.max(jnp.linalg.eigvalsh((tangent + tangent.T) / 2))

    return jax.vmap(one)(H)


def relative(a, b):
    return np.linalg.norm(a - b, axis=(1, 2)) / np.linalg.norm(b, axis=(1, 2))


exact = stresses(built_in, H)
law_error = relative(stresses(ours, H), exact)
fine = {
    "derivative of the energy": Gent(jnp.float32(1e5), jnp.float32(0.3), jnp.float32(1e15)),
    "built in": models.NeoHookean(jnp.float32(1e5), jnp.float32(0.3)),
}

fig, axes = plt.subplots(1, 3, figsize=(16, 4), layout="constrained")
for name, law in fine.items():
    single = relative(np.asarray(stresses(law, H.astype(jnp.float32)), np.float64), exact)
    axes[0].loglog(sizes, single, "o-", label=f"{name}, float32")
axes[0].loglog(sizes, law_error, "k.:", label="one against the other, float64")
axes[0].set(xlabel="strain", ylabel="relative error of the stress", title="two ways to a stress")
axes[0].legend(fontsize=9)

stretch = np.linspace(0.5, 1.6, 12 if FAST else 56)
volume_preserving = jnp.asarray([np.diag([s, s**-0.5, s**-0.5]) - np.eye(3) for s in stretch])
for law, name in ((built_in, "neo-Hookean"), (Gent(1e5, 0.3, 1.5), "Gent, $J_m$ = 1.5")):
    tau = stresses(law, volume_preserving)
    axes[1].plot(stretch, (tau[:, 0, 0] - tau[:, 1, 1]) / 1e3, label=name)
    modulus = largest_modulus(law, volume_preserving) / (3 * law.lam + 2 * law.mu)
    axes[2].plot(stretch, 1 / np.sqrt(modulus), label=name)
axes[1].set(xlabel="stretch", ylabel=r"$\tau_{11} - \tau_{22}$, kPa", title="pulled, at J = 1")
axes[1].legend(fontsize=9)
axes[2].set(xlabel="stretch", ylabel=r"$c$ at rest / $c$", ylim=(0, 1.1), title="stable time step")
plt.show()

# %% [markdown]
# ## Clay: a return mapping
#
# In Hencky strain a return mapping is one function: from the trial strain the new one, whether it
# changed, and what the particle remembers. Voce hardening saturates,
# $\tau_Y = \tau_\infty - (\tau_\infty - \tau_0)\, e^{-\delta \alpha}$ with α the plastic strain so
# far; with $\tau_\infty = \tau_0$ it is the built-in `VonMises`.


# %%
@final
class Voce(models.AbstractHenckyPlasticity):
    """Von Mises plasticity whose yield stress saturates."""

    first: jax.Array = models.parameter()  # τ₀, Pa
    last: jax.Array = models.parameter()  # τ_∞, Pa
    rate: jax.Array = models.parameter()  # δ

    def initial_history(self):
        return 0.0

    def flow(self, eps, history, elasticity):
        shear = eps - jnp.trace(eps) / 3 * jnp.eye(3, dtype=eps.dtype)
        norm = jnp.sqrt(jnp.sum(shear**2) + 1e-24)  # no division by 0, nor in the derivative
        tau_Y = self.last - (self.last - self.first) * jnp.exp(-self.rate * history)
        dgamma = jnp.maximum(norm - tau_Y / (2 * elasticity.mu), 0)
        return eps - dgamma * shear / norm, dgamma > 0, history + dgamma


# %% [markdown]
# ## A table: a condition of the grid
#
# A condition is any function of one node, `(x, v, t) -> v`. As an `eqx.Module` it has parameters
# that can be differentiated. Below $z = 0.1$ m everything turns with the table, at
# $\omega(t) = \omega_0 \cos 2\pi f t$.


# %%
class Turntable(eqx.Module):
    rate: jax.Array = models.parameter()  # ω₀, rad/s
    frequency: jax.Array = models.parameter()  # f, 1/s

    def __call__(self, x, v, t):
        omega = self.rate * jnp.cos(2 * np.pi * self.frequency * t)
        table = omega * jnp.stack([-x[1], x[0], 0 * x[2]])
        return jnp.where(x[2] <= 0.1 + 1e-9, table, v)


# %% [markdown]
# ## The column
#
# 15 cm of clay below, 25 cm of rubber on top of it, on the table.

# %%
h = 0.05
grid = pgjax.Grid((-0.35, -0.35, 0), (14, 14, 12), h)
spacing = h / 2 if FAST else h / 2.5
clay, clay_volumes = sampling.block((-0.08, -0.08, 0.1), (0.08, 0.08, 0.25), spacing)
rubber, rubber_volumes = sampling.block((-0.08, -0.08, 0.25), (0.08, 0.08, 0.5), spacing)
x, volumes = np.concatenate([clay, rubber]), np.concatenate([clay_volumes, rubber_volumes])
FRAME, FRAMES = 0.01, 6 if FAST else 30  # s
print(f"{len(clay)} particles of clay, {len(rubber)} of rubber")


def column(rubber_law, clay_flow, table, E_clay=1.5e5):
    above = models.Material(rubber_law, density=1000.0)
    below = models.Material(models.StVKHencky(E_clay, 0.3), clay_flow, density=1800.0)
    return pgjax.Scene(
        grid,
        [below, above],
        volumes,
        counts=[len(clay), len(rubber)],
        gravity=(0, 0, -9.81),
        boundaries=[table],
    )


def built(theta):
    """The column of θ: E of the rubber, τ₀ of the clay, ω₀ of the table."""
    E, tau_0, omega = theta
    return column(Gent(E, 0.3, 1.5), Voce(tau_0, 3 * tau_0, 5.0), Turntable(omega, 2.5))


truth = jnp.array([6e4, 1500.0, 14.0])
scene = built(truth)
dt = pgjax.stable_dt(scene, frame=FRAME, fraction=0.35)
substeps = round(FRAME / dt)


def kept(state):
    """Of each frame. A function with a name is the same in each call, and compiled once."""
    return state.x, state.F


def moved(scene):
    """Positions and deformations in all frames."""
    state = pgjax.initial_state(scene, x)
    run = {"dt": dt, "frames": FRAMES, "substeps": substeps, "keep_states": True}
    return pgjax.simulate(scene, state, **run, save=kept).saved


# %% [markdown]
# Against what is built in: an infinite $J_m$, a constant yield stress and a constant ω.

# %%
by_us = column(Gent(6e4, 0.3, 1e12), Voce(1500.0, 1500.0, 5.0), Turntable(14.0, 0.0))
table = boundary.Collider(
    boundary.HalfSpace((0, 0, 0.1), (0, 0, 1)),
    boundary.Sticky(),
    boundary.Steady((0, 0, 0), angular_velocity=(0, 0, 14.0), pivot=(0, 0, 0)),
)
by_them = column(models.NeoHookean(6e4, 0.3), models.VonMises(1500.0), table)
(x_ours, _), (x_theirs, _) = moved(by_us), moved(by_them)
apart = float(jnp.max(jnp.abs(x_ours - x_theirs)))
travelled = float(jnp.max(jnp.abs(x_theirs[-1] - x)))
print(f"in {FRAMES * substeps} steps: at most {apart:.1e} m apart, {travelled:.2f} m travelled")

# %% [markdown]
# ## A film of it
#
# Grains as Gaussians, deformed with the material. Clay is brown, rubber blue, and each has stripes
# to see the twist by.

# %%
PIXELS = 160
camera = render.Camera.look_at(
    (0.75, -1.25, 0.75), (0, 0, 0.26), up=(0, 0, 1), width=PIXELS, height=PIXELS, fov_y=0.36
)
stripe = (np.arctan2(x[:, 1], x[:, 0]) // (np.pi / 4)) % 2 == 0
is_clay = np.arange(len(x)) < len(clay)
dark, light = (
    np.array([[0.35, 0.2, 0.1], [0.1, 0.2, 0.5]]),
    np.array([[0.8, 0.6, 0.4], [0.5, 0.7, 0.95]]),
)
colours = np.where(stripe[:, None], dark[(~is_clay).astype(int)], light[(~is_clay).astype(int)])
grains = render.Gaussians.from_scales(
    jnp.asarray(x),
    jnp.tile(jnp.array([1.0, 0, 0, 0]), (len(x), 1)),
    jnp.full((len(x), 3), 0.45 * spacing),
    jnp.full(len(x), 0.9),
    jnp.asarray((colours - 0.5) / 0.28209479)[:, None, :],  # harmonics of degree 0
)


RULE = render.Rule(alpha_max=0.999, stop=0.0, smooth=True)  # no jumps but those of the order


@jax.jit
def picture(x, F):
    body = render.deform(grains, x, F)
    return render.render(body, camera, background=(1, 1, 1), rule=RULE).rgb


motion = moved(scene)
path = folder / "column.mp4"
every = 2 if FAST else 1
render.save_video(path, map(picture, *(a[::every] for a in motion)), fps=20 // every)
Video(path.read_bytes(), embed=True, mimetype="video/mp4")

# %% [markdown]
# With the extra `view` the same frames can be looked at from all sides while this notebook is
# running.

# %%
if importlib.util.find_spec("viser") and not FAST:
    from pgjax import view

    (folder / "run" / "ply").mkdir(parents=True)
    for f in range(FRAMES + 1):
        body = render.deform(grains, *(a[f] for a in motion))
        render.save_ply(folder / "run" / "ply" / f"{f:05d}.ply", body)
    app = view.App(view.show_run(folder / "run", up="z"))
    threading.Thread(target=app.run, daemon=True).start()
    display(Markdown(f"[Open the viewer]({app.url}) (while the kernel runs)"))

# %% [markdown]
# ## A loss of pictures
#
# The column is seen in three pictures. The loss compares them with what other parameters would have
# shown; it is a function of JAX like any other.

# %%
SEEN = FRAMES * np.array([3] if FAST else [1, 2, 3]) // 3


def pictures(motion):
    return jnp.stack([picture(*(a[f] for a in motion)) for f in SEEN])


observed = pictures(motion)


def loss(theta):
    return jnp.mean((pictures(moved(built(theta))) - observed) ** 2)


guess = truth * jnp.array([1.3, 0.7, 0.9])
value, slope = jax.jit(jax.value_and_grad(loss))(guess)
print(f"loss {float(value):.3e}")

shown = pictures(moved(built(guess)))
fig, axes = plt.subplots(1, 3, figsize=(11, 3.9), layout="constrained")
difference = np.abs(np.asarray(shown - observed)[-1]).mean(axis=-1)
for ax, (title, image) in zip(
    axes, [("observed", observed[-1]), ("guess", shown[-1])], strict=False
):
    ax.imshow(np.clip(np.asarray(image), 0, 1))
    ax.set_title(title)
drawn = axes[2].imshow(difference, cmap="magma")
axes[2].set_title("difference")
fig.colorbar(drawn, ax=axes[2], label="mean of the colours, 0 to 1")
for ax in axes:
    ax.axis("off")
plt.show()

# %% [markdown]
# ## Is the gradient right?
#
# Reverse mode against central differences with steps from coarse to fine, relative to
# the parameter. Large steps see the curvature of the loss, and grains that change their order in
# depth, where an image jumps and has no derivative; small ones see rounding.


# %%
def central(k, delta):
    above, below = (loss(guess.at[k].mul(1 + d)) for d in (delta, -delta))
    return float(above - below) / (2 * delta)


names = ["E of the rubber", "τ₀ of the clay", "ω₀ of the table"]
deltas = np.array([1e-6]) if FAST else np.logspace(-2, -8, 4)
differences = np.array([[central(k, d) for d in deltas] for k in range(3)])
reverse = np.asarray(slope * guess)  # ∂ loss/∂ log θ
off = np.abs(differences / reverse[:, None] - 1)

fig, ax = plt.subplots(figsize=(7, 4.2), layout="constrained")
for k, name in enumerate(names):
    ax.loglog(deltas, off[k], "o-", label=name)
ax.set(xlabel="relative step δ", ylabel="|difference/reverse mode − 1|")
ax.legend(fontsize=9)
plt.show()

for k, name in enumerate(names):
    best = differences[k][np.argmin(off[k])]
    print(f"∂ loss/∂ log θ, {name:16s} reverse {reverse[k]: .6e}, differences {best: .6e}")

# %% [markdown]
# ## The claim
#
# Where there is something built in, what is written here agrees with it: the stress to rounding, the
# largest eigenvalue of the tangent at rest with $3\lambda + 2\mu$, a whole motion of two materials
# and a turning table. Gradients through pictures, contact, flow and both laws are those of finite
# differences.

# %%
assert law_error[sizes > 1e-3].max() < 1e-9
np.testing.assert_allclose(modulus[np.argmin(np.abs(stretch - 1))], 1, rtol=1e-8)
assert apart < 1e-7 * travelled
assert np.all(off.min(axis=1) < 1e-4)
