"""Energies of a plane-strain body, from formulas of their own: nothing here comes from a law."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scenes import kinetic_energy

from pgjax.scene import Scene
from pgjax.state import State

Density = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]


def lame(E, nu):
    """Shear modulus and Lamé's first parameter, Pa."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def stretches(F: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Principal stretches of `F (p, 3, 3)` that does not leave the plane: in it two, across one.

    `σ₁ ± σ₂` are the lengths of the rotating and of the reflecting part of F.
    """
    turning = jnp.hypot(F[:, 0, 0] + F[:, 1, 1], F[:, 1, 0] - F[:, 0, 1])
    reflecting = jnp.hypot(F[:, 0, 0] - F[:, 1, 1], F[:, 1, 0] + F[:, 0, 1])
    return (turning + reflecting) / 2, (turning - reflecting) / 2, F[:, 2, 2]


def fixed_corotated(F: jax.Array, mu: jax.Array, lam: jax.Array) -> jax.Array:
    """`μ Σ (σ − 1)² + λ/2 (J − 1)²`, J/m³."""
    sigma = jnp.stack(stretches(F))
    return mu * jnp.sum((sigma - 1) ** 2, axis=0) + lam / 2 * (jnp.prod(sigma, axis=0) - 1) ** 2


def hencky(F: jax.Array, mu: jax.Array, lam: jax.Array) -> jax.Array:
    """`μ Σ ε² + λ/2 (Σ ε)²`, `ε = log σ`, J/m³."""
    eps = jnp.log(jnp.stack(stretches(F)))
    return mu * jnp.sum(eps**2, axis=0) + lam / 2 * jnp.sum(eps, axis=0) ** 2


def elastic(scene: Scene, F: jax.Array, density: Density) -> jax.Array:
    """`Σ V⁰ ψ(F)` of a scene of one material, J (per metre of depth, as all of them)."""
    law = scene.materials[0].elasticity
    return jnp.sum(scene.volumes * density(F, *lame(law.E, law.nu)))


def potential(scene: Scene, state: State) -> jax.Array:
    """`−Σ m g·x`, J."""
    return -jnp.sum(scene.masses * (state.x @ scene.gravity))


def total(scene: Scene, state: State, density: Density) -> jax.Array:
    """Kinetic with its affine part, elastic and potential, J."""
    stored = elastic(scene, state.Fe, density) + potential(scene, state)
    return kinetic_energy(scene, state) + stored


def staggered(kinetic: np.ndarray, stored: np.ndarray) -> np.ndarray:
    """`K_n + (V_{n−1} + V_n)/2` of a history that starts at n = 0: one entry less.

    A step accelerates at x_{n−1} and then moves with v_n: v_n belongs to the time half-way. Free
    fall keeps this sum exactly, whereas `K_n + V_n` falls and rises with `−½ Δt m g·v`.
    """
    return kinetic[1:] + (stored[1:] + stored[:-1]) / 2


def rise(energy: np.ndarray) -> float:
    """How far a history ever is above its least value so far."""
    return float(np.max(energy - np.minimum.accumulate(energy)))
