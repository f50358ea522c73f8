"""The stable time step: what limits it at rest, and where a moving state is above it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Bool, Float, Scalar, concrete, require, require_kind, require_number
from pgjax.models.material import cast, particle_axes
from pgjax.models.viscous import positive_volume
from pgjax.result import NEVER
from pgjax.scene import Scene
from pgjax.state import State

# Fractions of the sharp limits below which no growth was seen: elastic (at most 1/2 of the
# bound even for particles moving through the grid), advective and of the deformation per step.
ELASTIC_FRACTION, ADVECTIVE_FRACTION, DEFORMATION_FRACTION = 0.5, 0.25, 0.2


class Limits(NamedTuple):
    """Sharp limits of the time step for each particle, s, `(p,)`; `elastic` with viscosity."""

    elastic: Float[Array, "*p"]
    advective: Float[Array, "*p"]
    deformation: Float[Array, "*p"]


def limits(scene: Scene, state: State) -> Limits:
    """The limits for the deformation and the speed a state has.

    Elastic: `β h/c` with c from a bound of the law's tangent at F, lowered by viscosity η J as
    `Scene.elastic_limit` says. Advective: one cell a step at
    `|v| + 1.5 √d h ‖C‖`. Deformation: `1/‖C‖`, which keeps `det(I + Δt L) > 0`.
    """
    scene = cast(scene, state.dtype)
    d, h = scene.grid.dimension, scene.grid.h
    total = state.He if state.H is None else state.H
    speeds, viscosities = [], []
    for material, part, history in zip(scene.materials, scene.slices, state.history, strict=True):

        def bound(material, H, total, history):
            modulus = material.tangent_bound(H, total, d, history) / material.density
            eta = material.elasticity.shear_viscosity().astype(H.dtype) * positive_volume(H)
            return jnp.sqrt(modulus), eta / material.density

        axes = (particle_axes(material, part.stop - part.start), 0, 0, 0)
        speed, viscosity = jax.vmap(bound, in_axes=axes)(
            material, state.He[part], total[part], history
        )
        speeds.append(speed)
        viscosities.append(viscosity)
    elastic = scene.elastic_limit(jnp.concatenate(speeds), jnp.concatenate(viscosities))
    spin = jnp.sqrt(jnp.sum(state.C**2, axis=(1, 2)))
    speed = jnp.sqrt(jnp.sum(state.v**2, axis=1)) + 1.5 * d**0.5 * h * spin
    return Limits(elastic, h / speed, 1 / spin)


@eqx.filter_jit
def _smallest_limits(scene: Scene, state: State) -> Limits:
    return jax.tree.map(jnp.min, limits(scene, state))


def above_bound(scene: Scene, state: State, dt: Scalar) -> Bool[Array, " p"]:
    """Which particles have a sharp limit below dt, for the status DT_ABOVE_BOUND."""
    limit = limits(scene, state)
    # Rounding in the bound of the tangent must not raise an alarm at exactly the limit.
    allowed = dt * (1 - 1e-5)
    exceeded = (limit.elastic < allowed) | (limit.advective < allowed)
    return (exceeded | (limit.deformation < allowed)) & state.alive


def stable_dt(
    scene: Scene,
    state: State | None = None,
    *,
    frame: float | None = None,
    fraction: float = ELASTIC_FRACTION,
) -> float:
    """A stable time step, s.

    `min(fraction β h/c, ¼ h/(|v| + 1.5 √d h ‖C‖), 0.2/‖C‖)`; the sharp `β` depends on spline,
    scheme and damping (1/√2 for the default). Viscosity η of `KelvinVoigt` and `Fluid` lowers
    the elastic limit Δt_e to the root of `(Δt/Δt_e)² + Δt η/(ρ D) = 1`, `D` = h²/4 (quadratic) or
    h²/3 (cubic); that of Herschel–Bulkley adds no limit.

    Args:
        scene: the scene; its parameters must be known (not traced).
        state: if given, its deformation and speed count too; otherwise the state of rest.
        frame: duration of a frame, s: the result then divides it exactly.
        fraction: part of the elastic limit; at most 0.5 is safe for moving particles.

    Raises:
        ValueError: `fraction` or `frame` is out of range, or a parameter is being traced.
    """
    require_kind("scene", scene, Scene)
    require_kind("state", state, State, type(None))
    require_number("fraction", fraction)
    require("fraction", fraction, "be in (0, 1]", lambda a: (a > 0) & (a <= 1))
    rest = concrete(scene.rest_limit())
    if rest is None:
        raise ValueError(
            "Argument `scene` must have known parameters, but some are being traced (jit, grad or "
            "vmap): compute the time step outside, for the stiffest value that can occur."
        )
    dt = fraction * float(rest)
    if state is not None:
        now = jax.tree.map(float, _smallest_limits(scene, state))
        dt = min(
            dt,
            fraction * now.elastic,
            ADVECTIVE_FRACTION * now.advective,
            DEFORMATION_FRACTION * now.deformation,
        )
    if frame is None:
        return dt
    require_number("frame", frame)
    require("frame", frame, "be positive and finite (s)", lambda a: (a > 0) & np.isfinite(a))
    return frame / substeps_for(frame, dt)


def substeps_for(frame: float, dt: float) -> int:
    """The smallest number of equal substeps of at most dt that make a frame exactly."""
    # A step of 0 is one that is below the smallest number.
    steps = float(frame) / float(dt) * (1 - 1e-9) if dt > 0 else np.inf
    if not steps < NEVER - 1:
        raise ValueError(
            f"A frame of {frame:g} s must take fewer than 2^31 steps, but the stable ones are of "
            f"{dt:g} s: is a material too stiff or too light, a particle too fast, or a frame too "
            f"long?"
        )
    return max(1, int(np.ceil(steps)))
