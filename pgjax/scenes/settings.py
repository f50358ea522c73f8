"""What decides how finely a scene is computed, and what of its file says so."""

import dataclasses
from typing import Any

from pgjax.scenes.interior import PER_NODE
from pgjax.scenes.model import ModelPart
from pgjax.scenes.schema import SCHEMES, SPLINES, SceneFile
from pgjax.splines import BSpline
from pgjax.transfer import AbstractScheme

# Where a value stands in a scene file: the table, which of several, and the key in it.
Place = tuple[str, int, str]


@dataclasses.dataclass(frozen=True)
class Setting:
    """A discretisation.

    Attributes:
        spacing: of the grid, m.
        particle_spacing: in spacings of the grid; each Gaussian is a particle if None.
        spline: of the transfers.
        scheme: of the transfers.
        fraction: of the stable time step at rest.
        dt: largest time step, s; by `fraction` if None.
    """

    spacing: float
    particle_spacing: float | None
    spline: BSpline
    scheme: AbstractScheme
    fraction: float
    dt: float | None = None

    def __str__(self) -> str:
        particles = "a particle each Gaussian"
        if self.particle_spacing is not None:
            particles = f"{1 / self.particle_spacing**3:.3g} particles a cell"
        step = f"{self.fraction:g} of the bound" if self.dt is None else f"dt {self.dt:g} s"
        return (
            f"{self.spacing:.4g} m, {particles}, {_name(SPLINES, self.spline)}, "
            f"{_name(SCHEMES, self.scheme)}, {step}"
        )


def own(file: SceneFile) -> Setting:
    """The setting of a scene file."""
    grid, time = file.grid, file.time
    return Setting(
        grid.spacing, grid.particle_spacing, grid.spline, grid.scheme, time.fraction, time.dt
    )


def applied(file: SceneFile, setting: Setting) -> SceneFile:
    """The scene in another setting, with the same Gaussians."""
    grid = dataclasses.replace(
        file.grid,
        spacing=setting.spacing,
        particle_spacing=setting.particle_spacing,
        spline=setting.spline,
        scheme=setting.scheme,
    )
    time = dataclasses.replace(file.time, fraction=setting.fraction, dt=setting.dt)
    models = tuple(_kept(m, file.grid.spacing, setting.spacing) for m in file.models)
    return dataclasses.replace(file, grid=grid, time=time, models=models)


def changes(file: SceneFile, setting: Setting) -> dict[Place, Any]:
    """The keys that differ from the scene file's; None for one that is to go."""
    now, made = own(file), applied(file, setting)
    found: dict[Place, Any] = {}
    for name in ("spacing", "particle_spacing", "spline", "scheme"):
        old, new = getattr(now, name), getattr(setting, name)
        if old != new:
            found["grid", 0, name] = _text(new)
    for name in ("fraction", "dt"):
        old, new = getattr(now, name), getattr(setting, name)
        if old != new:
            found["time", 0, name] = new
    for number, (old, new) in enumerate(zip(file.models, made.models, strict=True)):
        if old.split_longer_than != new.split_longer_than:
            found["model", number, "split_longer_than"] = new.split_longer_than
        if old.fill is not None and new.fill is not None and old.fill != new.fill:
            found["model", number, "fill.spacing"] = new.fill.spacing
    return found


def _kept(model: ModelPart, before: float, after: float) -> ModelPart:
    """A model whose Gaussians do not change with the grid: what is in its spacings is rescaled."""
    split, fill = model.split_longer_than, model.fill
    if before == after:
        return model
    if split is not None:
        split = float(f"{split * before / after:.6g}")
    if fill is not None and fill.spacing is None:
        fill = dataclasses.replace(fill, spacing=float(f"{PER_NODE * before:.6g}"))
    return dataclasses.replace(model, split_longer_than=split, fill=fill)


def _text(value: Any) -> Any:
    """A value as the scene file has it."""
    if isinstance(value, BSpline):
        return _name(SPLINES, value)
    return _name(SCHEMES, value) if isinstance(value, AbstractScheme) else value


def _name(names: dict[str, Any], value: Any) -> str:
    return next(name for name, other in names.items() if other == value)
