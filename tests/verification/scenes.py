"""Scenes and rollouts that the verification cases share."""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax.scene import Scene
from pgjax.splines import BSpline
from pgjax.state import State
from pgjax.step import step
from pgjax.transfer import MLS, AbstractScheme, SplineGradient
from pgjax.transfer.scheme import Flux

# The four combinations of spline and gradient, with β of the stable time step.
SCHEMES = {
    "quadratic-grad": (BSpline(2), SplineGradient(), 2**-0.5),
    "quadratic-mls": (BSpline(2), MLS(), 1.0),
    "cubic-grad": (BSpline(3), SplineGradient(), 1.1054),
    "cubic-mls": (BSpline(3), MLS(), 2 / 3**0.5),
}


def lattice(lower: Any, cells: tuple[int, ...], h: float, per_cell: int = 2) -> np.ndarray:
    """Evenly spaced particles, `per_cell` along each direction of each cell, `(p, d)`."""
    axes = [
        a + (np.arange(n * per_cell) + 0.5) * h / per_cell
        for a, n in zip(lower, cells, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(cells))


def itself(state: State) -> State:
    """The identity: nothing is done after a step."""
    return state


def nothing(scene: Scene, state: State) -> None:
    """Observe nothing."""
    del scene, state


def without_affine(state: State) -> State:
    """PIC: forget C after every step."""
    return eqx.tree_at(lambda s: s.C, state, jnp.zeros_like(state.C))


def roll(
    scene: Scene,
    state: State,
    dt: Any,
    steps: int,
    observe: Callable[[Scene, State], Any] = nothing,
    after: Callable[[State], State] = itself,
    every: int = 1,
) -> tuple[State, Any]:
    """`steps` steps; what `observe` saw after each `every` of them, stacked."""
    # An array, so that a new time step compiles nothing.
    return _roll(scene, state, jnp.asarray(dt, state.dtype), steps, observe, after, every)


@eqx.filter_jit
def _roll(
    scene: Scene,
    state: State,
    dt: jax.Array,
    steps: int,
    observe: Callable[[Scene, State], Any],
    after: Callable[[State], State],
    every: int,
) -> tuple[State, Any]:
    def advance(state: State, _: Any) -> tuple[State, None]:
        return after(step(scene, state, dt)), None

    def frame(state: State, _: Any) -> tuple[State, Any]:
        state, _ = jax.lax.scan(advance, state, None, length=every)
        return state, observe(scene, state)

    return jax.lax.scan(frame, state, None, length=steps // every)


def elastic_strain(scene: Scene, state: State) -> Any:
    """`Fe − I`, for `observe`."""
    del scene
    return state.He


def wide(a: Any) -> np.ndarray:
    """On the host in double precision, so that the comparison adds no rounding."""
    return np.asarray(a, np.float64)


def largest(error: Any) -> float:
    """The maximum norm."""
    return float(np.max(np.abs(wide(error))))


def positions(scene: Scene, state: State) -> Any:
    """Positions, for `observe`."""
    del scene
    return state.x


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """`a × b` for the last axis; one number in two dimensions."""
    if a.shape[-1] == 2:
        return (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])[..., None]
    return jnp.cross(a, b)


def axial(C: jax.Array) -> jax.Array:
    """Axial vector of `C − Cᵀ`; one number in two dimensions."""
    W = C - jnp.swapaxes(C, -1, -2)
    if C.shape[-1] == 2:
        return W[..., 1, 0][..., None]
    return jnp.stack([W[..., 2, 1], W[..., 0, 2], W[..., 1, 0]], axis=-1)


def momenta(scene: Scene, state: State) -> tuple[jax.Array, jax.Array]:
    """`P = Σ m v` and `L = Σ m (x × v + D axial(C − Cᵀ))`, in the precision of the scene."""
    x, v, C = (a.astype(scene.volumes.dtype) for a in (state.position, state.v, state.C))
    m = scene.masses[:, None]
    return jnp.sum(m * v, axis=0), jnp.sum(m * (cross(x, v) + scene.D * axial(C)), axis=0)


def kinetic_energy(scene: Scene, state: State) -> jax.Array:
    """`½ Σ m (|v|² + D ‖C‖²)`: with the affine part, what a transfer may only lower."""
    v, C = (a.astype(scene.volumes.dtype) for a in (state.v, state.C))
    density = jnp.sum(v**2, axis=1) + scene.D * jnp.sum(C**2, axis=(1, 2))
    return 0.5 * jnp.sum(scene.masses * density)


@final
class MissingTimeStep(AbstractScheme):
    """A negative control: the supplement's misprint `F ← (I + ∇v) F`, without Δt.

    Args:
        dt: the time step by which the step multiplies.
    """

    dt: jax.Array = eqx.field(converter=jnp.asarray)

    def velocity_gradient(self, C: Flux, slope: Flux) -> Flux:
        """`∇v/Δt`."""
        del C
        return slope / self.dt

    def split(self, flux: Flux, D: jax.Array) -> tuple[Flux | None, Flux | None]:
        """As `SplineGradient`."""
        return SplineGradient().split(flux, D)

    def roughness(self, spline: BSpline) -> float:
        """As `SplineGradient`."""
        return spline.roughness
