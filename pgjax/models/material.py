"""A material: a constitutive law, a return mapping if it has one, fibres and a density."""

import dataclasses
from typing import Any, final

import equinox as eqx
import jax

from pgjax._types import Array, Matrix3, Scalar, is_parameter, parameter, require, require_kind
from pgjax.models.active import ActiveStress
from pgjax.models.law import AbstractElasticity, AbstractLaw, Response
from pgjax.models.plasticity import AbstractPlasticity


@final
class Material(eqx.Module):
    """What a slice of the particles is made of.

    Args:
        elasticity: a constitutive law, e.g. `FixedCorotated(E=1e5, nu=0.3)` or `Fluid(1e5)`.
        plasticity: a return mapping that goes with it, e.g. `VonMises(...)` with `StVKHencky`.
            A law that cannot do without one (`Fluid`, `Snow`) brings it along.
        density: mass per rest volume, kg/m³. One value or one per particle of the slice.
        active: fibres that pull, if any.
    """

    elasticity: AbstractLaw
    plasticity: AbstractPlasticity | None
    active: ActiveStress | None
    density: Array = parameter()

    def __init__(
        self,
        elasticity: AbstractLaw,
        plasticity: AbstractPlasticity | None = None,
        density: Any = 1000.0,
        active: ActiveStress | None = None,
    ):
        require_kind("elasticity", elasticity, AbstractLaw)
        companion = elasticity.companion() if plasticity is None else plasticity
        self.elasticity = elasticity
        self.plasticity = companion if isinstance(companion, AbstractPlasticity) else None
        self.density = density
        self.active = active

    def __check_init__(self):
        require(
            "density",
            self.density,
            "be positive and finite (kg/m³)",
            lambda a: (a > 0) & (a < float("inf")),
        )
        if self.plasticity is not None and not _fits(self.plasticity, self.elasticity.elastic()):
            raise ValueError(
                f"Argument `plasticity` must go with the elastic law: "
                f"{type(self.plasticity).__name__} is not written for "
                f"{type(self.elasticity).__name__}."
            )

    def initial_history(self) -> float | None:
        """What one particle remembers at the start; None if nothing."""
        return None if self.plasticity is None else self.plasticity.initial_history()

    def kirchhoff(
        self, H: Matrix3, total: Matrix3, L: Matrix3, history: Array | None, t: Scalar
    ) -> Matrix3:
        """Kirchhoff stress of one particle, Pa, from elastic and total `F − I` (`H`, `total`)."""
        return self.response(H, total, L, history, t).tau

    def response(
        self, H: Matrix3, total: Matrix3, L: Matrix3, history: Array | None, t: Scalar
    ) -> Response:
        """The same with what the status counts."""
        response = self.elasticity.response(H, L, history)
        if self.active is None:
            return response
        return response._replace(tau=response.tau + self.active.kirchhoff(total, t))

    def rest_modulus(self, dimension: int) -> Array:
        """`ρ₀ c²` at rest, Pa."""
        modulus = self.elasticity.rest_modulus(dimension)
        return modulus if self.active is None else modulus + self.active.rest_modulus()

    def tangent_bound(
        self, H: Matrix3, total: Matrix3, dimension: int, history: Array | None
    ) -> Scalar:
        """Upper bound of `ρ₀ c²` of one particle, Pa, from elastic and total `F − I`."""
        bound = self.elasticity.tangent_bound(H, dimension, history)
        return bound if self.active is None else bound + self.active.tangent_bound(total)


def _fits(plasticity: AbstractPlasticity, law: AbstractLaw) -> bool:
    """Whether the return mapping goes with the law; one that brings its own takes no other."""
    own = law.companion()
    if own is not None:
        return type(plasticity) is type(own)
    return isinstance(law, AbstractElasticity) and plasticity.goes_with(law)


def particle_axes(tree: Any, count: int) -> Any:
    """`in_axes` for `vmap`: 0 for each parameter given per particle, None for every other leaf.

    Raises:
        ValueError: if a parameter is neither one number nor `count` numbers.
    """
    axes = jax.tree.map(lambda _: None, tree)
    for path, rank in parameter_paths(tree):
        value = _follow(tree, path)
        if value is None or value.ndim == rank:
            continue
        allowed = (count, *value.shape[1:])
        if value.ndim != rank + 1 or value.shape != allowed:
            one = "number" if rank == 0 else "vector"
            raise ValueError(
                f"Argument `{path[-1]}` must be one {one} or one per particle of the material "
                f"(shape {allowed[: rank + 1]}), but has shape {value.shape}."
            )
        axes = eqx.tree_at(
            lambda t, path=path: _follow(t, path), axes, 0, is_leaf=lambda leaf: leaf is None
        )
    return axes


def parameter_paths(tree: Any, prefix: tuple[str, ...] = ()) -> list[tuple[tuple[str, ...], int]]:
    """Names of all fields declared with `parameter()` in a tree of modules, and their ranks."""
    if not isinstance(tree, eqx.Module):
        return []
    paths = []
    for field in dataclasses.fields(tree):
        here = (*prefix, field.name)
        if is_parameter(field):
            paths.append((here, field.metadata.get("rank", 0)))
        else:
            paths.extend(parameter_paths(getattr(tree, field.name), here))
    return paths


def _follow(tree: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        tree = getattr(tree, name)
    return tree


def cast(tree: Any, dtype: Any) -> Any:
    """The same tree with every floating array in `dtype`."""
    return jax.tree.map(
        lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a,
        tree,
    )
