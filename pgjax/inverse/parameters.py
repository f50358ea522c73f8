"""The unknowns: names, first guesses, the space they are looked for in, and what is known before.

A solver works in *free coordinates* u: the logarithm of a parameter that has a scale, the
parameter itself otherwise. Bounds hold in every iterate of every solver.
"""

from collections.abc import Mapping
from typing import Any, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Float

Values = dict[str, Array]


@final
class Parameter(eqx.Module):
    """One unknown: a number, or an array of them (a velocity, a field over particles).

    Args:
        start: the first guess, in physical units.
        lower, upper: bounds, in physical units; no iterate is ever outside. A parameter the stable
            time step depends on must have the bound on its stiff side.
        log: look for the logarithm: for what is positive and known to an order of magnitude only.
        fixed: keep it at `start`.
        prior: `(mean, deviation)` known from elsewhere. For a logarithmic parameter the deviation
            is relative (0.1 for 10 %), else in the parameter's units.
        unit: for reports, e.g. "Pa".
    """

    start: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    prior: tuple[np.ndarray, np.ndarray] | None
    log: bool = eqx.field(static=True)
    fixed: bool = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    def __init__(
        self,
        start: Any,
        *,
        lower: Any = None,
        upper: Any = None,
        log: bool = False,
        fixed: bool = False,
        prior: tuple[Any, Any] | None = None,
        unit: str = "",
    ):
        self.start = np.asarray(start, np.float64)
        self.log, self.fixed, self.unit = bool(log), bool(fixed), unit
        self.lower = self._bound("lower", lower, 0.0 if log else -np.inf)
        self.upper = self._bound("upper", upper, np.inf)
        self._check()
        self.prior = None if prior is None else self._checked_prior(*prior)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the values."""
        return self.start.shape

    def replace(self, **changes: Any) -> "Parameter":
        """The same parameter with other arguments."""
        arguments = {
            name: getattr(self, name)
            for name in ("start", "lower", "upper", "log", "fixed", "prior", "unit")
        }
        return Parameter(**(arguments | changes))

    def to_free(self, value: Any) -> np.ndarray:
        """Free coordinates of physical values."""
        value = np.asarray(value, np.float64)
        if not self.log:
            return value
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(value))

    def to_physical(self, u: Any) -> Any:
        """Physical values of free coordinates, traced or not."""
        if not self.log:
            return u
        return np.exp(u) if isinstance(u, np.ndarray) else jnp.exp(u)

    def _bound(self, name: str, value: Any, default: float) -> np.ndarray:
        bound = np.asarray(default if value is None else value, np.float64)
        try:
            return np.broadcast_to(bound, self.shape).copy()
        except ValueError:
            raise ValueError(
                f"Argument `{name}` must be one number or have the shape {self.shape} of `start`, "
                f"but has shape {bound.shape}."
            ) from None

    def _check(self) -> None:
        if not np.isfinite(self.start).all():
            raise ValueError(f"Argument `start` must be finite, but is {self.start}.")
        if self.log and (self.lower < 0).any():
            raise ValueError(
                f"Argument `lower` must be at least 0 for a logarithmic parameter, but is "
                f"{self.lower}."
            )
        if not (self.lower < self.upper).all():
            raise ValueError(
                f"Argument `lower` must be below `upper` ({self.upper}), but is {self.lower}."
            )
        inside = (self.lower <= self.start) & (self.start <= self.upper)
        if not inside.all() or (self.log and not (self.start > 0).all()):
            raise ValueError(
                f"Argument `start` must be {'positive and ' if self.log else ''}in "
                f"[{self.lower}, {self.upper}], but is {self.start}."
            )

    def _checked_prior(self, mean: Any, deviation: Any) -> tuple[np.ndarray, np.ndarray]:
        pair = []
        for name, value in (("mean", mean), ("deviation", deviation)):
            value = np.asarray(value, np.float64)
            positive = name == "deviation" or self.log
            if not np.isfinite(value).all() or (positive and not (value > 0).all()):
                raise ValueError(
                    f"Argument `prior` must hold a finite{' positive' * positive} {name}, but is "
                    f"{value}."
                )
            pair.append(np.broadcast_to(value, self.shape).copy())
        return pair[0], pair[1]


@final
class Space(eqx.Module):
    """The free coordinates of all parameters that are not fixed, as one vector."""

    # Of all parameters, in their order, which a dictionary would lose inside of `jit`.
    labels: tuple[str, ...] = eqx.field(static=True)
    members: tuple[Parameter, ...]

    def __init__(self, parameters: Mapping[str, Parameter]):
        if not parameters:
            raise ValueError("Argument `parameters` must name at least one, but is empty.")
        for name, parameter in parameters.items():
            if not isinstance(parameter, Parameter):
                raise ValueError(
                    f"Argument `parameters` must hold a `Parameter` for each name, but {name!r} is "
                    f"{parameter!r}."
                )
        if all(parameter.fixed for parameter in parameters.values()):
            raise ValueError("Argument `parameters` must leave one free, but all are fixed.")
        self.labels, self.members = tuple(parameters), tuple(parameters.values())

    @property
    def parameters(self) -> dict[str, Parameter]:
        """All of them by name."""
        return dict(zip(self.labels, self.members, strict=True))

    @property
    def free(self) -> dict[str, Parameter]:
        """Those that are not fixed."""
        return {name: p for name, p in self.parameters.items() if not p.fixed}

    @property
    def names(self) -> list[str]:
        """One per coordinate: `E`, `v0[2]`."""
        return [
            name + (f"[{','.join(map(str, index))}]" if index else "")
            for name, parameter in self.free.items()
            for index in np.ndindex(parameter.shape)
        ]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(p.start.size for p in self.free.values())

    @property
    def start(self) -> np.ndarray:
        """First guess, `(size,)`."""
        return self.vector({name: p.start for name, p in self.free.items()})

    @property
    def logarithmic(self) -> np.ndarray:
        """Which coordinates are logarithms, `(size,)`."""
        return _joined([np.full(p.shape, p.log) for p in self.free.values()])

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the coordinates, `(size,)` each."""
        lower = _joined([p.to_free(p.lower) for p in self.free.values()])
        upper = _joined([p.to_free(p.upper) for p in self.free.values()])
        return lower, upper

    def vector(self, values: Mapping[str, Any]) -> np.ndarray:
        """Coordinates of physical values of the free parameters.

        Raises:
            ValueError: a name is missing or unknown, or a value has the wrong shape.
        """
        parts = []
        unknown = sorted(set(values) - set(self.parameters))
        if unknown:
            raise ValueError(
                f"Argument `values` must name parameters ({', '.join(self.parameters)}), but names "
                f"{', '.join(unknown)}."
            )
        for name, parameter in self.free.items():
            if name not in values:
                raise ValueError(f"Argument `values` must hold {name!r}, but does not.")
            value = np.asarray(values[name], np.float64)
            if value.shape != parameter.shape:
                raise ValueError(
                    f"Argument `values` must hold {name!r} of shape {parameter.shape}, but its "
                    f"shape is {value.shape}."
                )
            parts.append(parameter.to_free(value))
        return _joined(parts)

    def values(self, u: Float[Array, " size"] | np.ndarray) -> Values:
        """Physical values of all parameters, the fixed ones too, at free coordinates u."""
        if isinstance(u, np.ndarray):
            u = jnp.asarray(u, jnp.zeros(()).dtype)
        values: Values = {}
        place = 0
        for name, parameter in self.parameters.items():
            if parameter.fixed:
                values[name] = jnp.asarray(parameter.start, dtype=u.dtype)
                continue
            part = u[place : place + parameter.start.size].reshape(parameter.shape)
            place += parameter.start.size
            values[name] = parameter.to_physical(part)
        return values

    def known(self, u: np.ndarray) -> dict[str, np.ndarray]:
        """The same on the host, in double precision, never outside of the bounds."""
        values, place = {}, 0
        for name, parameter in self.parameters.items():
            values[name] = parameter.start
            if not parameter.fixed:
                part = np.asarray(u[place : place + parameter.start.size], np.float64)
                place += parameter.start.size
                value = np.asarray(parameter.to_physical(part.reshape(parameter.shape)))
                values[name] = np.asarray(np.clip(value, parameter.lower, parameter.upper))
        return values

    def prior_residual(self, u: Float[Array, " size"]) -> Float[Array, " k"]:
        """`(u − mean)/deviation` of every entry that has a prior; constant of fixed parameters."""
        parts, place = [], 0
        for parameter in self.members:
            at = jnp.asarray(parameter.start, u.dtype).ravel()
            at = jnp.log(at) if parameter.log else at
            if not parameter.fixed:
                at = u[place : place + parameter.start.size]
                place += parameter.start.size
            if parameter.prior is not None:
                mean, deviation = (jnp.asarray(a, u.dtype).ravel() for a in parameter.prior)
                parts.append((at - (jnp.log(mean) if parameter.log else mean)) / deviation)
        return jnp.concatenate(parts) if parts else jnp.zeros((0,), u.dtype)

    def prior_rows(self) -> np.ndarray:
        """Its derivative, which is constant, `(size, k)`."""
        size = self.size
        columns, place = [], 0
        for parameter in self.members:
            count = parameter.start.size
            if parameter.prior is not None:
                block = np.zeros((size, count))
                if not parameter.fixed:
                    block[place : place + count] = np.diag(1 / parameter.prior[1].ravel())
                columns.append(block)
            place += 0 if parameter.fixed else count
        return np.concatenate(columns, axis=1) if columns else np.zeros((size, 0))


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in parts])


def moduli(
    *,
    mu: Any = None,
    lam: Any = None,
    kappa: Any = None,
) -> dict[str, Any]:
    """`{"E": …, "nu": …}` from two other moduli, to be given to a law as `**moduli(...)`.

    Args:
        mu: shear modulus, Pa.
        lam: Lamé's first parameter, Pa; or
        kappa: bulk modulus, Pa, in three dimensions.
    """
    if mu is None or (lam is None) == (kappa is None):
        raise ValueError(
            "Arguments must be `mu` and one of `lam` and `kappa`, but are "
            f"mu={mu}, lam={lam}, kappa={kappa}."
        )
    if lam is None:
        lam = kappa - 2 * mu / 3
    return {"E": mu * (3 * lam + 2 * mu) / (lam + mu), "nu": lam / (2 * (lam + mu))}
