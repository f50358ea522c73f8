"""Everything that is constant in time."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import (
    Array,
    Float,
    Scalar,
    as_float_array,
    as_tuple,
    concrete,
    floating,
    parameter,
    positive,
    require,
    require_kind,
    require_shape,
    whole_numbers,
)
from pgjax.boundary import Particles
from pgjax.grid import Grid
from pgjax.models import Material
from pgjax.models.material import cast, particle_axes
from pgjax.result import Status
from pgjax.splines import BSpline
from pgjax.state import State
from pgjax.transfer import AbstractScheme, SplineGradient


@final
class Scene(eqx.Module):
    """A scene: grid, materials, walls, forces. Differentiate with respect to any array in it.

    Args:
        grid: the background grid.
        materials: one material, or several; each owns a contiguous slice of the particles.
        volumes: rest volume of each particle, m³ (m² in two dimensions), `(p,)`. The mass of a
            particle is its material's density times this.
        counts: number of particles of each material, in order. Not needed for one material.
        gravity: m/s², `(d,)`; zero by default.
        boundaries: conditions of the grid, `(x, v, t) -> v` for one node, applied in order.
        particle_conditions: prescribed motion, forces and wind, `(particles, t, dt) -> particles`
            for all particles (`boundary.Particles`), applied in order. Both kinds are called once
            here with shapes alone (`jax.eval_shape`), so that one of the wrong dimension is named.
        body_force: acceleration `b(X0, t) -> (d,)` of one particle, m/s²; `X0` is needed.
        X0: initial positions for `body_force`, m, `(p, d)`.
        spline: interpolation, quadratic by default.
        scheme: `SplineGradient()` (the original MPM) or `MLS()`.
        grid_damping: γ, 1/s: grid velocities decay as `exp(−γ t)`, whatever the time step.
        shear_damping: r, 1/s: the symmetric part of C decays as `exp(−r t)`; infinity is RPIC.
    """

    grid: Grid
    materials: tuple[Material, ...]
    volumes: Array
    counts: tuple[int, ...] = eqx.field(static=True)
    gravity: Array
    boundaries: tuple[Callable, ...]
    particle_conditions: tuple[Callable, ...]
    body_force: Callable | None
    X0: Array | None
    spline: BSpline
    scheme: AbstractScheme
    grid_damping: Array = parameter()
    shear_damping: Array = parameter()

    def __init__(
        self,
        grid: Grid,
        materials: Material | Sequence[Material],
        volumes: Any,
        *,
        counts: Sequence[int] | None = None,
        gravity: Any = None,
        boundaries: Sequence[Callable] = (),
        particle_conditions: Sequence[Callable] = (),
        body_force: Callable | None = None,
        X0: Any = None,
        spline: BSpline | None = None,
        scheme: AbstractScheme | None = None,
        grid_damping: Any = 0.0,
        shear_damping: Any = 0.0,
    ):
        require_kind("grid", grid, Grid)
        self.grid = grid
        single = isinstance(materials, Material)
        self.materials = (materials,) if single else as_tuple("materials", materials)
        self.volumes = as_float_array(volumes, "volumes")
        counts = self.volumes.shape if counts is None else counts
        self.counts = whole_numbers("counts", counts)
        gravity = jnp.zeros_like(grid.origin) if gravity is None else gravity
        self.gravity = as_float_array(gravity, "gravity")
        self.boundaries = as_tuple("boundaries", boundaries)
        self.particle_conditions = as_tuple("particle_conditions", particle_conditions)
        self.body_force = body_force
        self.X0 = None if X0 is None else as_float_array(X0, "X0")
        self.spline = BSpline(2) if spline is None else spline
        self.scheme = SplineGradient() if scheme is None else scheme
        self.grid_damping = grid_damping
        self.shear_damping = shear_damping

    def __check_init__(self):
        if self.volumes.ndim != 1:
            raise ValueError(
                f"Argument `volumes` must have shape (p,), but has shape {self.volumes.shape}."
            )
        for material in self.materials:
            require_kind("materials", material, Material)
        require_kind("spline", self.spline, BSpline)
        require_kind("scheme", self.scheme, AbstractScheme)
        d, n = self.grid.dimension, self.particle_count
        if n == 0:
            raise ValueError("Argument `volumes` must hold at least one particle, but is empty.")
        require("volumes", self.volumes, "be positive and finite", positive)
        fits = len(self.counts) == len(self.materials) and sum(self.counts) == n
        if not fits or min(self.counts) < 0:
            raise ValueError(
                f"Argument `counts` must give the particles of each of {len(self.materials)} "
                f"material(s), {n} in all, but is {self.counts}."
            )
        for material, count in zip(self.materials, self.counts, strict=True):
            particle_axes(material, count)
        require_shape("gravity", self.gravity, (d,))
        require("gravity", self.gravity, "be finite", np.isfinite)
        for name in ("grid_damping", "shear_damping"):
            value = getattr(self, name)
            require_shape(name, value, ())
            require(name, value, "be at least 0 (1/s)", lambda a: a >= 0)
        for condition in self.particle_conditions:
            mask = getattr(condition, "mask", None)
            if mask is not None:
                require_shape("mask", mask, (n,))
        _check_conditions(self)
        if self.body_force is not None and self.X0 is None:
            raise ValueError("Argument `X0` must be given with `body_force`, but is None.")
        if self.X0 is not None:
            require_shape("X0", self.X0, (n, d))

    @property
    def particle_count(self) -> int:
        """Number of particles p."""
        return self.volumes.shape[0]

    @property
    def slices(self) -> tuple[slice, ...]:
        """The particles of each material."""
        ends = np.cumsum(self.counts)
        return tuple(slice(int(e) - c, int(e)) for e, c in zip(ends, self.counts, strict=True))

    @property
    def D(self) -> Array:
        """`Σ w (x_i − x_p)(x_i − x_p)ᵀ = D I`, m²."""
        return self.spline.moment * self.grid.h**2

    @property
    def masses(self) -> Float[Array, " p"]:
        """Density times rest volume, kg."""
        parts = [
            jnp.broadcast_to(material.density, (count,))
            for material, count in zip(self.materials, self.counts, strict=True)
        ]
        return jnp.concatenate(parts).astype(self.volumes.dtype) * self.volumes

    @property
    def is_plastic(self) -> bool:
        """Whether any material flows, so that total and elastic deformation differ."""
        return any(material.plasticity is not None for material in self.materials)

    def rest_sound_speed(self) -> Scalar:
        """`c = √(max(dλ + 2μ, 2μ)/ρ)` of the stiffest material at rest, m/s."""
        d = self.grid.dimension
        speeds = [jnp.max(jnp.sqrt(m.rest_modulus(d) / m.density)) for m in self.materials]
        return jnp.max(jnp.stack(speeds))

    def elastic_limit(
        self, sound_speed: Float[Array, "..."], viscosity: Float[Array, "..."] | float = 0.0
    ) -> Float[Array, "..."]:
        """The sharp bound of the time step, s: `β(s) h/c` without viscosity.

        A kinematic viscosity ν = η/ρ alone allows `D/ν`; together the step has to satisfy
        `(Δt c/(β h))² + Δt ν/D ≤ 1`, exact for an isolated particle.
        """
        undamped = self.scheme.stable_courant(self.spline) * self.grid.h / sound_speed
        damped = self.scheme.stable_courant(self.spline, 0.0) * self.grid.h / sound_speed
        # RPIC keeps at least this part of the symmetric C in any step below the bound.
        kept = jnp.exp(-self.shear_damping * undamped)
        elastic = damped + (undamped - damped) * jnp.where(jnp.isnan(kept), 0, kept)
        ratio = elastic * viscosity / self.D
        return 2 * elastic / (ratio + jnp.sqrt(ratio * ratio + 4))

    def rest_limit(self) -> Scalar:
        """The sharp bound of the time step at rest, s: the smallest of all particles."""
        d, limits = self.grid.dimension, []
        for m in self.materials:
            viscosity = m.elasticity.shear_viscosity().astype(m.density.dtype) / m.density
            c = jnp.sqrt(m.rest_modulus(d) / m.density)
            limits.append(jnp.min(self.elastic_limit(c, viscosity)))
        return jnp.min(jnp.stack(limits))


def initial_state(
    scene: Scene,
    x: Any,
    v: Any = 0.0,
    *,
    C: Any = 0.0,
    F: Any = None,
    dtype: Any = None,
) -> State:
    """The state at the start.

    Args:
        scene: the scene.
        x: positions, m, `(p, d)`, inside the grid.
        v: velocities, m/s: one number, `(d,)` or `(p, d)`.
        C: affine velocities, 1/s: 0 or `(p, d, d)`.
        F: elastic and total deformation gradient at the start, `(p, 3, 3)`; the identity if None.
        dtype: precision of the simulation; JAX's default float if None.

    Raises:
        ValueError: a shape is wrong, a value is not finite, or a particle is outside the grid.
    """
    require_kind("scene", scene, Scene)
    dtype = _precision(dtype)
    n, d = scene.particle_count, scene.grid.dimension
    x = _array("x", x, (n, d))
    require("x", x, "be finite", np.isfinite)
    # In the precision of the input, before anything is rounded to the simulation's.
    position = _relative(x, scene.grid.origin)
    _check_inside(scene, position)
    v = jnp.broadcast_to(_array("v", v, (n, d), (d,), ()), (n, d))
    C = jnp.broadcast_to(_array("C", C, (n, d, d), ()), (n, d, d))
    H = jnp.zeros((n, 3, 3), dtype)
    if F is not None:
        F = _array("F", F, (n, 3, 3))
        H = jnp.asarray(F - np.broadcast_to(np.eye(3, dtype=F.dtype), F.shape), dtype)
    for name, value in (("v", v), ("C", C), ("F", H)):
        require(name, value, "be finite", np.isfinite)
    history = tuple(
        None if (start := m.initial_history()) is None else jnp.full((c,), start, dtype)
        for m, c in zip(scene.materials, scene.counts, strict=True)
    )
    return State(
        position=position.astype(dtype),
        v=v.astype(dtype),
        C=C.astype(dtype),
        He=H.astype(dtype),
        H=H.astype(dtype) if scene.is_plastic else None,
        history=history,
        alive=jnp.ones((n,), bool),
        step=jnp.zeros((), jnp.int32),
        status=Status.clear(),
        origin=scene.grid.origin.astype(dtype),
    )


def _precision(dtype: Any) -> Any:
    default = jnp.zeros(()).dtype
    if dtype is None:
        return default
    try:
        known = np.dtype(dtype)
    except TypeError:
        known = None
    if known not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise ValueError(f"Argument `dtype` must be float32 or float64, but is {dtype}.")
    dtype = known
    if dtype == np.float64 and default != np.float64:
        raise ValueError(
            "Argument `dtype` must be float32 unless double precision is switched on "
            '(`jax.config.update("jax_enable_x64", True)`), but is float64.'
        )
    return dtype


def _relative(x: Array | np.ndarray, origin: Array) -> Array:
    """`x − origin`, on the host in double precision where both are known."""
    x_known, origin_known = concrete(x), concrete(origin)
    if x_known is None or origin_known is None:
        x = jnp.asarray(x)
        return x - origin.astype(x.dtype)[None, :]
    return jnp.asarray((x_known.astype(np.float64) - origin_known).astype(x_known.dtype))


def _array(name: str, value: Any, *shapes: tuple[int, ...]) -> Array | np.ndarray:
    """The value as a floating array of one of the given shapes."""
    value = floating(name, value)
    require_shape(name, value, *shapes)
    return value


def _check_conditions(scene: Scene) -> None:
    """Every condition goes with the dimension and the particles of the scene, by shapes alone."""
    d, n = scene.grid.dimension, scene.particle_count
    vector, number = _shape(d), _shape()
    held = _shape(n, dtype=bool)
    particles = Particles(_shape(n, d), _shape(n, d), _shape(n, d, d), _shape(n), held)
    _check_calls(
        f"`boundaries` must hold functions `(x, v, t) -> v` of vectors of shape ({d},)",
        scene.boundaries,
        (vector, vector, number),
        vector,
    )
    _check_calls(
        f"`particle_conditions` must hold functions `(particles, t, dt) -> particles` of {n} "
        f"particles in {d} dimensions",
        scene.particle_conditions,
        (particles, number, number),
        particles,
    )


def _check_calls(
    rule: str, functions: tuple[Callable, ...], arguments: tuple[Any, ...], expected: Any
) -> None:
    """Each function takes the arguments and returns something of the expected shapes."""
    for place, function in enumerate(functions, start=1):
        name = getattr(function, "__name__", type(function).__name__)
        try:
            shapes = _returned_shapes(function, arguments)
        except Exception as error:  # Whatever a user's function raises.
            reason = str(error).partition("\n")[0]
            raise ValueError(
                f"Argument {rule}, but number {place} ({name}) raises {type(error).__name__}: "
                f"{reason}"
            ) from error
        if shapes != _shapes(expected):
            raise ValueError(
                f"Argument {rule}, but number {place} ({name}) returns shape {shapes}."
            )


def _returned_shapes(function: Callable, arguments: tuple[Any, ...]) -> Any:
    """Shapes of what a function returns, without computing it."""
    leaves, structure = jax.tree.flatten(function)
    known = all(eqx.is_array(leaf) for leaf in leaves)
    abstract = tuple(
        jax.ShapeDtypeStruct(a.shape, a.dtype) if eqx.is_array(a) else a for a in leaves
    )
    # Conditions made of numbers alone are traced once, however often scenes are made of them.
    traced = _traced_shapes if known else _traced_shapes.__wrapped__
    return traced(structure, abstract, arguments)


@functools.lru_cache(maxsize=256)
def _traced_shapes(structure: Any, leaves: tuple[Any, ...], arguments: tuple[Any, ...]) -> Any:
    """The same of a function that is given as a tree.

    The precision of the state is not known yet: it is enough that one will do.
    """
    function = jax.tree.unflatten(structure, leaves)

    def in_precision(dtype: Any) -> Any:
        given = jax.tree.map(
            lambda a: jax.ShapeDtypeStruct(a.shape, bool if a.dtype == bool else dtype), arguments
        )
        return _shapes(eqx.filter_eval_shape(lambda f, *a: cast(f, dtype)(*a), function, *given))

    default = jnp.zeros(()).dtype
    try:
        return in_precision(default)
    except Exception:
        if default == jnp.float32:
            raise
        return in_precision(jnp.float32)


def _shape(*shape: int, dtype: Any = jnp.float32) -> Any:
    """An array of which only this is known."""
    return jax.ShapeDtypeStruct(shape, dtype)


def _shapes(tree: Any) -> Any:
    """The shapes of the arrays of a tree, and the kind of whatever else is in it."""
    return jax.tree.map(lambda a: getattr(a, "shape", type(a).__name__), tree)


def _check_inside(scene: Scene, position: Array) -> None:
    known, h = concrete(position), concrete(scene.grid.h)
    if known is None or h is None:
        return
    free = ~np.asarray(scene.grid.periodic)
    size = np.asarray(scene.grid.shape) * h
    slack = 1e-6 * h
    outside = ((known < -slack) | (known > size + slack)) & free
    if outside.any():
        index = int(np.argwhere(outside.any(axis=1))[0, 0])
        raise ValueError(
            f"Argument `x` must lie inside the grid, from {np.asarray(scene.grid.origin)} to "
            f"{np.asarray(scene.grid.origin) + size}, but particle {index} is at "
            f"{known[index] + np.asarray(scene.grid.origin)} "
            f"({int(outside.any(axis=1).sum())} particles are outside)."
        )
