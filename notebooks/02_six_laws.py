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
# # Six laws side by side
#
# The six constitutive models of PhysGaussian's supplement: first the stress of one particle along
# paths of stretch and shear, beside its closed form, then one body made of each of them that falls
# on the same ground. It takes about a minute on two cores.

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
from scipy.optimize import brentq

import pgjax
from pgjax import boundary, models, render, sampling
from pgjax.scenes.procedural import MODELS

FAST = os.environ.get("PGJAX_FAST") == "1"  # fewer particles and frames
temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)

# %% [markdown]
# ## The laws
#
# Three are elastic, three flow beyond a yield surface. All have the same Young's modulus, Poisson's
# ratio and density, so that they agree where strains are small and nothing yields:
#
# | law | Kirchhoff stress $\tau$ or where it flows |
# |---|---|
# | fixed corotated | $2\mu (F - R) F^\mathsf{T} + \lambda J (J - 1) I$ |
# | StVK in the Hencky strain $\varepsilon = \tfrac12 \log F F^\mathsf{T}$ | $2\mu\,\varepsilon + \lambda\,\mathrm{tr}(\varepsilon)\, I$ |
# | neo-Hookean | $\mu (F F^\mathsf{T} - I) + \lambda \log J\, I$ |
# | Drucker–Prager | $\lVert\mathrm{dev}\,\tau\rVert \le -\alpha\,\mathrm{tr}\,\tau$, $\ \alpha = \sqrt{2/3}\; 2\sin\varphi/(3 - \sin\varphi)$ |
# | von Mises | $\lVert\mathrm{dev}\,\tau\rVert \le \tau_Y$ |
# | Herschel–Bulkley | above $\sqrt{2/3}\,\sigma_Y$ the deviator relaxes, the faster the lower $\eta$ |

# %%
E, nu = 2e5, 0.3  # Pa, 1
phi, tau_Y = 40.0, 1e4  # degrees, Pa
sigma_Y, eta = 2e3, 400.0  # Pa, Pa s

hencky = models.StVKHencky(E, nu)
split = models.DevVolNeoHookean(E, nu)
laws = {
    "fixed corotated": models.Material(models.FixedCorotated(E, nu)),
    "StVK–Hencky": models.Material(hencky),
    "neo-Hookean": models.Material(models.NeoHookean(E, nu)),
    "Drucker–Prager": models.Material(hencky, models.DruckerPrager(phi)),
    "von Mises": models.Material(hencky, models.VonMises(tau_Y)),
    "Herschel–Bulkley": models.Material(split, models.HerschelBulkley(sigma_Y, eta)),
}
mu, lam = float(hencky.mu), float(hencky.lam)

# %% [markdown]
# ## One particle
#
# A law sees one particle and nothing of the grid: $H = F - I$ goes in, a stress comes out. A step
# is $F_e \leftarrow (I + \Delta t\, L)\, F_e$ and the return map, whatever the law.


# %%
def step(material, H, L, dt):
    """The elastic `H` after a step with velocity gradient `L`, and its Kirchhoff stress."""
    H = H + dt * (L + L @ H)
    if material.plasticity is not None:
        H, _ = material.plasticity.return_map(H, None, material.elasticity, dt)
    return H, material.elasticity.kirchhoff(H, L)


@jax.jit
def shear(material, rates, dt, H):
    """`τ (n, 3, 3)` while the shear grows at `rates` (n,), from `H`."""

    def one(H, rate):
        return step(material, H, jnp.zeros((3, 3)).at[0, 1].set(rate), dt)

    return jax.lax.scan(one, H, rates)[1]


@jax.jit
def pull(material, rates, dt):
    """`τ (n, 3, 3)` while a bar with free sides is stretched at `rates` (n,)."""

    def one(carry, rate):
        H, w = carry

        def sideways(w):
            new, tau = step(material, H, jnp.diag(jnp.stack([rate, w, w])), dt)
            return tau[1, 1], (new, tau)

        def newton(_, w):
            (stress, _), slope = jax.value_and_grad(sideways, has_aux=True)(w)
            return w - stress / slope

        w = jax.lax.fori_loop(0, 6, newton, w)  # the sides are free of stress
        _, (new, tau) = sideways(w)
        return (new, w), tau

    return jax.lax.scan(one, (jnp.zeros((3, 3)), jnp.zeros(())), rates)[1]


# %% [markdown]
# ### Elastic: the same modulus, other laws
#
# The slope at rest is $E$ in tension and $\mu$ in shear for all three. At large strain they part: in
# tension the Hencky law softens with the logarithm, the others harden.

# %%
n = 500
dt = 1.0 / n
# ln(stretch) runs from 0 to ±ln 2 in a second: 1 + Δt L is one n-th root of the stretch.
outwards, inwards = (n * math.expm1(s * math.log(2) / n) * jnp.ones(n) for s in (1, -1))
stretch = 2.0 ** (np.arange(1, n + 1) / n)
gamma = 2.0 * np.arange(1, n + 1) / n

elastic = ["fixed corotated", "StVK–Hencky", "neo-Hookean"]
rest = jnp.zeros((3, 3))
tension = {name: np.asarray(pull(laws[name], outwards, dt)[:, 0, 0]) for name in elastic}
pressed = {name: np.asarray(pull(laws[name], inwards, dt)[:, 0, 0]) for name in elastic}
sheared = {name: np.asarray(shear(laws[name], 2 * jnp.ones(n), dt, rest)) for name in elastic}

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for name in elastic:
    both = np.concatenate([pressed[name][::-1], [0], tension[name]])
    left.plot(np.concatenate([1 / stretch[::-1], [1], stretch]), both / 1e3, label=name)
    right.plot(gamma, sheared[name][:, 0, 1] / 1e3, label=name)
left.plot([0.75, 1.25], [-0.25 * E / 1e3, 0.25 * E / 1e3], ":k", label="slope $E$")
right.plot([0, 1], [0, mu / 1e3], ":k", label=r"slope $\mu$")
left.set(xlabel="stretch, free sides", ylabel=r"axial stress $\tau_{11}$, kPa")
right.set(xlabel=r"shear $\gamma$", ylabel=r"shear stress $\tau_{12}$, kPa")
left.legend()
right.legend()
plt.show()

# %% [markdown]
# Closed forms: in simple shear the principal stretches are $e^{\pm a}$ with $a = \sinh^{-1}(\gamma/2)$,
# and $F F^\mathsf{T}$ and its root $V$ are known. In tension the Hencky law is $\tau_{11} = E \log s$;
# for the neo-Hookean one the sides follow from $\mu(q^2 - 1) + \lambda \log(s q^2) = 0$.

# %%
root = np.sqrt(4 + gamma**2)
side = [
    brentq(lambda q, s=s: mu * (q * q - 1) + lam * math.log(s * q * q), 0.2, 2) for s in stretch
]
exact = {
    "fixed corotated, shear": (
        sheared["fixed corotated"][:, 0, 1],
        2 * mu * gamma * (1 - 1 / root),
    ),
    "StVK–Hencky, shear": (sheared["StVK–Hencky"][:, 0, 1], 4 * mu * np.arcsinh(gamma / 2) / root),
    "neo-Hookean, shear": (sheared["neo-Hookean"][:, 0, 1], mu * gamma),
    "neo-Hookean, normal stress": (sheared["neo-Hookean"][:, 0, 0], mu * gamma**2),
    "StVK–Hencky, tension": (tension["StVK–Hencky"], E * np.log(stretch)),
    "StVK–Hencky, compression": (pressed["StVK–Hencky"], -E * np.log(stretch)),
    "neo-Hookean, tension": (tension["neo-Hookean"], mu * (stretch**2 - np.square(side))),
}

# %% [markdown]
# ### Plastic: a cycle of shear
#
# Shear to 0.3, back to −0.3, and again. The metal yields at $\tau_Y/\sqrt2$ wherever it comes from.
# The sand is under a pressure $p$, yields at $3\alpha p/\sqrt2$ and would have no strength without
# it. The paste holds $\sigma_Y/\sqrt3$ at rest and $\eta\dot\gamma/2$ more while it flows.

# %%
cycle = jnp.concatenate([jnp.ones(300), -jnp.ones(600), jnp.ones(600)])  # 1/s
gamma_cycle = np.cumsum(np.asarray(cycle)) / 1000
alpha = math.sqrt(2 / 3) * 2 * math.sin(math.radians(phi)) / (3 - math.sin(math.radians(phi)))


def squeezed(p):
    """`H` of a particle under the pressure p, Pa."""
    return math.expm1(-p / (3 * lam + 2 * mu)) * jnp.eye(3)


rates, pressures = [1.0, 10.0], [5e3, 1e4]  # 1/s, Pa
figure, axes = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained", sharex=True)
tau = np.asarray(shear(laws["von Mises"], cycle, 1e-3, rest))[:, 0, 1]
axes[0].plot(gamma_cycle, tau / 1e3, label="von Mises")
flows = {"von Mises": (np.abs(tau[[299, 899, 1499]]), tau_Y / math.sqrt(2))}
for p in pressures:
    tau = np.asarray(shear(laws["Drucker–Prager"], cycle, 1e-3, squeezed(p)))[:, 0, 1]
    axes[1].plot(gamma_cycle, tau / 1e3, label=f"$p$ = {p / 1e3:.0f} kPa")
    flows[f"Drucker–Prager, {p / 1e3:.0f} kPa"] = (
        np.abs(tau[[299, 899, 1499]]),
        3 * alpha * p / math.sqrt(2),
    )
for rate in rates:
    tau = np.asarray(shear(laws["Herschel–Bulkley"], rate * cycle, 1e-3 / rate, rest))[:, 0, 1]
    axes[2].plot(gamma_cycle, tau / 1e3, label=rf"$\dot\gamma$ = {rate:.0f}/s")
    flows[f"Herschel–Bulkley, {rate:.0f}/s"] = (
        np.abs(tau[[299, 899, 1499]]),
        sigma_Y / math.sqrt(3) + eta / 2 * rate,
    )
for axis, name in zip(axes, ["von Mises", "Drucker–Prager", "Herschel–Bulkley"], strict=True):
    for key, (_, level) in flows.items():
        if key.startswith(name):
            axis.axhline(level / 1e3, color="k", ls=":", lw=1)
            axis.axhline(-level / 1e3, color="k", ls=":", lw=1)
    axis.set(title=name, xlabel=r"shear $\gamma$", ylabel=r"shear stress $\tau_{12}$, kPa")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
plt.show()

# %% [markdown]
# ## One body
#
# A fox falls on rough ground at 3 m/s, made of each of them. Model, grid and ground are the same.

# %%
made = MODELS["fox"](0, 0.5 if FAST else 0.7)
fox = made[np.asarray(made.means[:, 2]) > -0.003]  # without the lawn it sits on
x0 = np.asarray(fox.means)
volumes = sampling.neighbour_volumes(x0)
h = 0.06 if FAST else 0.045
shape = [round(size / h) for size in (2.4, 2.0, 1.3)]
grid = pgjax.Grid((-1.3, -1.0, -0.15), shape, h)
ground = boundary.Collider(
    boundary.HalfSpace((0, 0, -0.6 * h), (0, 0, 1)), boundary.Separating(friction=0.8)
)
fps, frames = 24, 12 if FAST else 28


def fall(material):
    """Positions and deformations of a fox of this material, every 1/24 s."""
    scene = pgjax.Scene(
        grid, material, volumes, gravity=(0, 0, -9.81), boundaries=[ground], scheme=pgjax.MLS()
    )
    state = pgjax.initial_state(scene, x0 + np.array([0, 0, 0.05]), v=(0, 0, -3.0))
    dt = pgjax.stable_dt(scene, frame=1 / fps, fraction=0.4)
    return pgjax.simulate(scene, state, dt=dt, frames=frames, substeps=round(1 / fps / dt))


falling = ["neo-Hookean", "von Mises"] if FAST else list(laws)
motions = {name: fall(laws[name]) for name in falling}

# %%
camera = render.Camera.orbit(
    (-0.1, 0, 0.35),
    up=(0, 0, 1),
    azimuth=math.radians(-60),
    elevation=math.radians(12),
    radius=3.4,
    fov_y=math.radians(32),
    width=180,
    height=150,
)
tiles, _ = sampling.block((-1.25, -1.0), (1.15, 1.0), spacing=0.05)
odd = np.floor(tiles / 0.2).sum(axis=1) % 2
n = len(tiles)
around = render.prepare_surroundings(
    render.Gaussians.from_scales(
        jnp.asarray(np.column_stack([tiles, np.full(n, -0.03)]), jnp.float32),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (n, 1)),
        jnp.tile(jnp.array([0.025, 0.025, 0.004]), (n, 1)),
        jnp.full(n, 0.9),
        jnp.tile(jnp.asarray(0.6 + 0.4 * odd, jnp.float32)[:, None, None], (1, 1, 3)),
    ),
    camera,
)


@jax.jit
def picture(x, F):
    F, _ = render.bound_stretch(F, 2.0)  # what has flowed far is drawn as grains
    return jnp.clip(around.render(render.deform(fox, x, F), background=(1.0, 1.0, 1.0)).rgb, 0, 1)


films = {
    name: [np.asarray(picture(m.saved.x[f], m.saved.F[f])) for f in range(frames + 1)]
    for name, m in motions.items()
}


rows = [falling[k : k + 3] for k in range(0, len(falling), 3)]


def side_by_side(f):
    return np.vstack([np.hstack([films[name][f] for name in row]) for row in rows])


print("\n".join(", ".join(row) for row in rows))
render.save_video(folder / "laws.mp4", map(side_by_side, range(frames + 1)), fps=12)
Video(folder / "laws.mp4", embed=True, width=540)

# %%
shown = np.linspace(0, frames, 5).astype(int)
n = len(falling)
figure, axes = plt.subplots(n, 5, figsize=(9, 1.6 * n), layout="constrained")
for row, (name, film) in zip(axes, films.items(), strict=True):
    for axis, f in zip(row, shown, strict=True):
        axis.imshow(film[f])
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    row[0].set_ylabel(name)
for axis, f in zip(axes[0], shown, strict=True):
    axis.set_title(f"{f / fps:.2f} s")
plt.show()

# %% [markdown]
# How high the fox is says who comes back: the elastic ones do, the others keep the shape that they
# have flowed to.

# %%
t = np.asarray(motions["von Mises"].t)
heights = {
    name: np.ptp(np.quantile(np.asarray(m.saved.x)[..., 2], [0.01, 0.99], axis=1), axis=0)
    for name, m in motions.items()
}
plt.figure(figsize=(7, 3.4), layout="constrained")
for name, height in heights.items():
    plt.plot(t, height, "-" if name in elastic else "--", label=name)
plt.xlabel("time, s")
plt.ylabel("height of the fox, m")
plt.legend(loc="upper left", bbox_to_anchor=(1.02, 1))
plt.show()

# %% [markdown]
# With the extra `view` they can be looked at from all sides, one beside the other, while this
# notebook is running.

# %%
if importlib.util.find_spec("viser") and not FAST:
    from pgjax import view

    (folder / "ply").mkdir()
    for f in range(frames + 1):
        row = []
        for k, m in enumerate(motions.values()):
            F, _ = render.bound_stretch(m.saved.F[f], 2.0)
            row.append(render.deform(fox, m.saved.x[f] + jnp.array([0, 1.2 * k, 0]), F))
        render.save_ply(folder / "ply" / f"{f:05d}.ply", render.concatenate(row))
    app = view.App(view.show_run(folder, up="z"))
    threading.Thread(target=app.run, daemon=True).start()
    display(Markdown(f"[Open the viewer]({app.url}) (while the kernel runs)"))

# %%
for name, (found, expected) in exact.items():
    error = np.abs(found - expected).max() / np.abs(expected).max()
    print(f"{name:28} {error:.1e} of the largest stress")
    assert error < 1e-4, name
for name, (found, expected) in flows.items():
    error = np.abs(found / expected - 1).max()
    print(f"{name:28} {error:.1e} of the stress it flows at, {expected / 1e3:.2f} kPa")
    assert error < 0.02, name
kept = {name: height[-1] / height[0] for name, height in heights.items()}
print(", ".join(f"{name} {part:.2f}" for name, part in kept.items()), "of the height at the end")
stays = max(part for name, part in kept.items() if name not in elastic)
assert all(kept[name] > stays + 0.1 for name in kept if name in elastic)
