"""A material: an elastic law, a return mapping if it has one, and a density."""

import dataclasses
from typing import Any, final

import equinox as eqx
import jax

from pgjax._types import Array, is_parameter, parameter, require
from pgjax.models.elasticity import AbstractElasticity
from pgjax.models.plasticity import AbstractPlasticity


@final
class Material(eqx.Module):
    """What a slice of the particles is made of.

    Args:
        elasticity: an elastic law, e.g. `FixedCorotated(E=1e5, nu=0.3)`.
        plasticity: a return mapping that goes with it, e.g. `VonMises(...)` with `StVKHencky`.
        density: mass per rest volume, kg/m³. One value or one per particle of the slice.
    """

    elasticity: AbstractElasticity
    plasticity: AbstractPlasticity | None = None
    density: Array = parameter(default=1000.0)

    def __check_init__(self):
        require(
            "density",
            self.density,
            "be positive and finite (kg/m³)",
            lambda a: (a > 0) & (a < float("inf")),
        )
        if self.plasticity is not None and not self.plasticity.goes_with(self.elasticity):
            raise ValueError(
                f"Argument `plasticity` must go with the elastic law: "
                f"{type(self.plasticity).__name__} is not written for "
                f"{type(self.elasticity).__name__}."
            )

    def initial_history(self) -> float | None:
        """What one particle remembers at the start; None if nothing."""
        return None if self.plasticity is None else self.plasticity.initial_history()


def particle_axes(tree: Any, count: int) -> Any:
    """`in_axes` for `vmap`: 0 for each parameter given per particle, None for every other leaf.

    Raises:
        ValueError: if a parameter is neither one number nor `count` numbers.
    """
    axes = jax.tree.map(lambda _: None, tree)
    for path in _parameter_paths(tree):
        value = _follow(tree, path)
        if value is None or value.ndim == 0:
            continue
        if value.shape != (count,):
            raise ValueError(
                f"Argument `{path[-1]}` must be one number or one per particle of the material "
                f"(shape ({count},)), but has shape {value.shape}."
            )
        axes = eqx.tree_at(
            lambda t, path=path: _follow(t, path), axes, 0, is_leaf=lambda leaf: leaf is None
        )
    return axes


def _parameter_paths(tree: Any, prefix: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Names of all fields declared with `parameter()` in a tree of modules."""
    if not isinstance(tree, eqx.Module):
        return []
    paths = []
    for field in dataclasses.fields(tree):
        here = (*prefix, field.name)
        if is_parameter(field):
            paths.append(here)
        else:
            paths.extend(_parameter_paths(getattr(tree, field.name), here))
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
