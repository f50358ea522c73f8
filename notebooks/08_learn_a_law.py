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
# # Learn a law with a network
#
# Blocks of an unknown material fly through space and wobble; all that is recorded are positions of
# particles, with noise. The elastic energy is a small network, trained through the simulator in
# reverse mode. What it has learned is then asked about what it has not seen: a beam that falls and
# swings on a wall, and the stress–stretch curves themselves. Two minutes on two cores.

# %%
import os
import tempfile
from pathlib import Path
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from IPython.display import Video

import pgjax
from pgjax import boundary, models, render, sampling
from pgjax.inverse import descend
from pgjax.models.strain import left_strain, log_volume

FAST = os.environ.get("PGJAX_FAST") == "1"  # fewer motions and steps
plt.rcParams |= {"figure.dpi": 80, "font.size": 11}

# %% [markdown]
# ## An energy that cannot be unphysical
#
# With $I_1 = \operatorname{tr} F F^\mathsf{T}$ and $a = I_1 - 3 - 2 \log J$, which is zero at rest and
# of second order around it, let
#
# $$\psi = N(a, J - 1) - N(0, 0) - \partial_J N(0, 0)\,(J - 1),$$
#
# where the network N has softplus units and non-negative weights, but for those of $J - 1$ in its
# first layer: it is convex, and does not decrease with $a$. By construction, whatever the weights:
#
# - the law is objective and isotropic, since ψ is a function of invariants of $F F^\mathsf{T}$;
# - the body at rest has no stress and no energy, since $\psi = 0$, $\partial\psi/\partial F = 0$ at
#   $F = I$;
# - ψ is polyconvex, since $a$ is a convex function of $F$ and $J$: waves travel in every direction at
#   every strain.
#
# Its moduli at rest can be read off: $\mu = 2\,\partial_a N$ and $\lambda = \partial_{JJ} N$.

# %%
SCALE = 1e4  # Pa


class Convex(eqx.Module):
    """Convex in (a, j) and non-decreasing in a."""

    linear: jax.Array
    first: jax.Array
    bias: jax.Array
    second: jax.Array

    def __init__(self, width, key):
        keys = jax.random.split(key, 3)
        # At first nearly linear in a, and curved in j.
        self.linear = jnp.full((), -0.5, jnp.float32)
        normal = jax.random.normal(keys[0], (2, width))
        self.first = normal * jnp.array([[1.0], [4.0]]) - jnp.array([[3.0], [0.0]])
        self.bias = jax.random.normal(keys[1], (width,))
        self.second = jax.random.normal(keys[2], (width,)) - 2.5

    def __call__(self, a, j):
        on_a, on_j = self.first
        hidden = jax.nn.softplus(jax.nn.softplus(on_a) * a + on_j * j + self.bias)
        return jax.nn.softplus(self.linear) * a + jnp.sum(jax.nn.softplus(self.second) * hidden)

    def slope(self):
        """The derivative along j at rest."""
        return jnp.sum(jax.nn.softplus(self.second) * jax.nn.sigmoid(self.bias) * self.first[1])


@final
class Learned(models.AbstractLaw):
    """The stress is the derivative of the network."""

    network: Convex

    def energy(self, H, history=None):
        log_J, J = log_volume(H)
        a = jnp.trace(left_strain(H)) - 2 * log_J
        rest, slope = self.network(0.0, 0.0), self.network.slope()
        return SCALE * (self.network(a, J - 1) - rest - slope * (J - 1))

    def kirchhoff(self, H, L, history=None):
        return jax.grad(self.energy)(H) @ (jnp.eye(3, dtype=H.dtype) + H).T

    def moduli(self):
        """μ and λ at rest, Pa."""
        on_a = jax.grad(self.network, argnums=0)(0.0, 0.0)
        on_J = jax.grad(jax.grad(self.network, argnums=1), argnums=1)(0.0, 0.0)
        return 2 * SCALE * on_a, SCALE * on_J

    def rest_modulus(self, dimension):
        mu, lam = self.moduli()
        return dimension * lam + 2 * mu


def young(law):
    """E and ν at rest."""
    mu, lam = (float(m) for m in law.moduli())
    return mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))


untrained = Learned(Convex(8, jax.random.key(0)))
truth = models.NeoHookean(E=6e4, nu=0.35)
print("before training: E = {:.2e} Pa, ν = {:.2f}".format(*young(untrained)))

# %% [markdown]
# ## What is recorded
#
# A block of 0.2 m in free flight, without gravity, started with velocities that are linear in the
# position, $v = A (X - \bar X)$: each $A$ stretches, shears and squeezes it in its own way. Positions
# of all particles in eight frames have noise of 0.2 mm.

# %%
h, NOISE = 1 / 15, 2e-4
X, volumes = sampling.block((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1), spacing=h / 2)
grid = pgjax.Grid((-0.3, -0.3, -0.3), (9, 9, 9), h)
FRAME, FRAMES = 0.008, 6 if FAST else 8  # s
rng = np.random.default_rng(1)
rates = jnp.asarray(22 * rng.normal(size=(2 if FAST else 4, 3, 3)), jnp.float32)  # A, 1/s


def material(law):
    return models.Material(law, density=1000.0)


def wobble(law, A, save=lambda s: s.x):
    """Positions in all frames."""
    scene = pgjax.Scene(grid, material(law), volumes)
    state = pgjax.initial_state(scene, X, X @ A.T)
    run = {"dt": dt, "frames": FRAMES, "substeps": substeps, "throw": False}
    return pgjax.simulate(scene, state, **run, save=save, keep_states=True).saved[1:]


scene = pgjax.Scene(grid, material(truth), volumes)
dt = pgjax.stable_dt(scene, frame=FRAME, fraction=0.35)
substeps = round(FRAME / dt)
wobbles = jax.jit(jax.vmap(wobble, in_axes=(None, 0)))
clean = wobbles(truth, rates)
seen = clean + NOISE * rng.standard_normal(clean.shape).astype(np.float32)
print(f"{len(rates)} motions of {len(X)} particles, {FRAMES * substeps} steps of {1e3 * dt:.2f} ms")

# %% [markdown]
# ## Training
#
# The loss is the mean square distance in units of the noise: 1 is as good as it gets. Its gradient
# goes backwards through all steps of all motions. `descend` runs an optimizer of optax and takes
# back a step after which the simulation fails.


# %%
def loss(law):
    return jnp.mean((wobbles(law, rates) - seen) ** 2) / NOISE**2


STEPS = 40 if FAST else 300
schedule = optax.cosine_decay_schedule(0.1, STEPS, alpha=0.02)
trained = descend(loss, untrained, steps=STEPS, optimizer=optax.adam(schedule))
law = trained.best
print(f"loss {trained.history[0].cost:.0f} → {trained.cost:.3f} in {STEPS} steps")
print("after training: E = {:.3e} Pa, ν = {:.3f}".format(*young(law)))
print(f"the truth:      E = {float(truth.E):.3e} Pa, ν = {float(truth.nu):.3f}")

# %% [markdown]
# ## The curves
#
# Grey is where nine in ten of what particles went through in the record lies: stretches of the
# isochoric part, and volumes.

# %%
strains = jax.jit(jax.vmap(lambda A: wobble(truth, A, save=lambda s: s.F)))(rates)
F_seen = np.asarray(strains, np.float64).reshape(-1, 3, 3)
J_seen = np.linalg.det(F_seen)
stretch_seen = np.linalg.svd(F_seen, compute_uv=False) / np.cbrt(J_seen)[:, None]
ranges = [np.quantile(a, [0.05, 0.95]) for a in (stretch_seen, J_seen)]


@jax.jit
def stress(law, F):
    return jax.vmap(lambda F: law.kirchhoff(F - jnp.eye(3), None))(F)


def curves(law, s):
    """Pulled at constant volume: τ₁₁ − τ₂₂; swollen: mean stress. Pa."""
    pulled = stress(law, jnp.stack([np.diag([a, a**-0.5, a**-0.5]) for a in s]))
    swollen = stress(law, jnp.stack([np.cbrt(a) * np.eye(3) for a in s]))
    return pulled[:, 0, 0] - pulled[:, 1, 1], np.trace(swollen, axis1=1, axis2=2) / 3


s = np.linspace(0.6, 1.5, 91)
exact, learned, before = (curves(m, s) for m in (truth, law, untrained))
fig, axes = plt.subplots(1, 3, figsize=(15, 4.4), layout="constrained")
axes[0].semilogy([step.cost for step in trained.history])
axes[0].axhline(1, color="k", ls=":", label="the noise")
axes[0].set(xlabel="step", ylabel="loss", title="training")
axes[0].legend(fontsize=9)
for k, (ax, name, label) in enumerate(
    zip(
        axes[1:],
        ["stretch at constant volume", "volume ratio J"],
        [r"$\tau_{11} - \tau_{22}$, kPa", r"mean of $\tau$, kPa"],
        strict=True,
    )
):
    ax.axvspan(*ranges[k], color="0.9", label="recorded")
    ax.plot(s, exact[k] / 1e3, "k", lw=3, alpha=0.4, label="truth")
    ax.plot(s, learned[k] / 1e3, "C1", label="learned")
    ax.plot(s, before[k] / 1e3, "C0:", label="untrained")
    ax.set(xlabel=name, ylabel=label)
    ax.legend(fontsize=9)
plt.show()

# %% [markdown]
# ## A motion it has not seen
#
# A beam of 0.3 m is held at a wall, falls under gravity and swings: another shape, other forces,
# a wall, ten times as long.

# %%
Y, beam_volumes = sampling.block((0, -0.05, -0.05), (0.35, 0.05, 0.05), spacing=h / 2)
clamp = boundary.Collider(boundary.HalfSpace((0.05, 0, 0), (1, 0, 0)), boundary.Sticky())
SWING = 15 if FAST else 40  # frames, twice as long as those above


@eqx.filter_jit
def swing(law):
    room = pgjax.Grid((-0.2, -0.2, -0.6), (10, 6, 12), h)
    scene = pgjax.Scene(
        room, material(law), beam_volumes, gravity=(0, 0, -9.81), boundaries=[clamp]
    )
    state = pgjax.initial_state(scene, Y)
    return pgjax.simulate(
        scene, state, dt=dt, frames=SWING, substeps=2 * substeps, save=lambda s: s.x, throw=False
    ).saved


beams = {"truth": swing(truth), "learned": swing(law), "untrained": swing(untrained)}


def rms(a):
    return float(jnp.sqrt(jnp.mean(jnp.sum(a**2, axis=-1))))


moved = rms(beams["truth"] - beams["truth"][0])
errors = {name: rms(x - beams["truth"]) / moved for name, x in beams.items()}
for name in ("untrained", "learned"):
    print(f"{name:9s} off by {100 * errors[name]:.2f} % of the displacement ({100 * moved:.1f} cm)")

# %%
camera = render.Camera.look_at(
    (0.75, -1.2, 0.3), (0.17, 0, -0.13), up=(0, 0, 1), fov_y=0.42, width=280, height=240
)
COLOURS = {"truth": (0.35, 0.35, 0.35), "learned": (1, 0.55, 0.1), "untrained": (0.2, 0.5, 0.75)}


def picture(f):
    """The three beams beside each other: the truth in front, then the learned one."""
    beside = [x[f] + jnp.array([0, 0.2 * k - 0.2, 0]) for k, x in enumerate(beams.values())]
    x, n = jnp.concatenate(beside), len(Y)
    lit = np.repeat([COLOURS[name] for name in beams], n, axis=0)
    lit = lit + np.where(np.tile(Y[:, :1] // h % 2 == 0, (3, 1)), 0.08, -0.08)  # bands
    grains = render.Gaussians.from_scales(
        x,
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (3 * n, 1)),
        jnp.full((3 * n, 3), 0.18 * h),
        jnp.full(3 * n, 0.9),
        jnp.asarray((lit - 0.5) / 0.2821, jnp.float32)[:, None, :],
    )
    return render.render(grains, camera, background=(1, 1, 1)).rgb


with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "beams.mp4"
    render.save_video(path, map(picture, range(0, SWING + 1, 4 if FAST else 1)), fps=20)
    film = Video(path.read_bytes(), embed=True, mimetype="video/mp4")
film

# %%
fig, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
tip = np.argmax(Y[:, 0])
t = 2 * FRAME * np.arange(SWING + 1)
for name, line in (("truth", "k"), ("learned", "C1--"), ("untrained", "C0:")):
    ax.plot(t, 100 * np.asarray(beams[name])[:, tip, 2], line, lw=2, label=name)
ax.set(xlabel="t, s", ylabel="height of the tip, cm")
ax.legend(fontsize=9)
plt.show()

# %% [markdown]
# ## The claim
#
# The network explains the record down to its noise, and has learned the law and not the record: it
# predicts a motion it has not seen, and its curves are the true ones where the record went. It is
# without stress at rest and turns with the body, as it was before training.

# %%
rng = np.random.default_rng(2)
F = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
for any_law in (untrained, law):
    at_rest, still, turned = stress(any_law, jnp.asarray([np.eye(3), F, Q @ F]))
    np.testing.assert_allclose(at_rest, 0, atol=1e-2)  # Pa
    np.testing.assert_allclose(turned, Q @ still @ Q.T, atol=1.0)
assert trained.cost < (30 if FAST else 2)
assert errors["learned"] < (0.05 if FAST else 0.01)
assert errors["learned"] < 0.2 * errors["untrained"]
for k, (low, high) in enumerate(ranges):
    inside = (s > low) & (s < high)
    worst = np.abs(learned[k] - exact[k])[inside].max() / np.abs(exact[k])[inside].max()
    assert worst < (0.2 if FAST else 0.06), worst
