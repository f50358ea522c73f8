"""The cheapest setting of a scene whose motion is within a given error of the limit of refinement.

The scene is run on a ladder of grids whose spacings differ by √2, with eight particles in a cell;
from them the limit is extrapolated. On a cheap rung every other choice is tried alone; those that
pay are put together and run. Whatever is chosen was run over all frames that were asked for.
"""

import dataclasses
import math
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from pgjax.scenes.refinement import Limit, refined, scale
from pgjax.scenes.schema import SceneFile
from pgjax.scenes.settings import Setting, own
from pgjax.scenes.trial import Trial, Trials
from pgjax.splines import BSpline
from pgjax.transfer import MLS, SplineGradient

RATIO = 2**0.5
# Rungs of the ladder, in factors of √2 finer than the scene's own spacing: the first that is run,
# the finest and the coarsest there is.
_FIRST, _FINEST, _COARSEST = -2, 4, -4
# Particles at half a spacing: eight in a cell. Others, in spacings; other time steps.
_EIGHT, _OTHERS, _FRACTIONS = 0.5, (0.4, 2 / 3), (0.25, 0.9)
# Cells along each side of the box of a grid, at least.
_CELLS = 8
# Time goes with this power of 1/spacing: a solid in space, and its time step.
_POWER = 4
# The rung on which choices are tried alone may be so many times above the error asked for.
_ROUGH = 4.0
# What is expected of a setting before it is run, in the error that is left to it.
_MARGIN = 0.9
# Combinations that are run at most.
_TRIES = 4


@dataclasses.dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        trial: a setting that was run.
        error: its distance from the limit, in the scale of the scene; infinite if it failed.
    """

    trial: Trial
    error: float


@dataclasses.dataclass(frozen=True)
class Tuning:
    """What was found.

    Attributes:
        asked: the largest error allowed.
        limit: what the errors are distances from; None if no three grids could be run.
        rows: everything that was run.
        chosen: the cheapest setting whose error, with what the limit is in doubt by, is at most
            the one asked for; None if there is none.
        notes: what could not be resolved, and what was left out, a line each.
    """

    asked: float
    limit: Limit | None
    rows: tuple[Row, ...]
    chosen: Row | None
    notes: tuple[str, ...]


def tune(trials: Trials, asked: float) -> Tuning:
    """Find the cheapest setting whose motion is within the error `asked` of the limit.

    Raises:
        ValueError: `asked` is out of range, or the scene cannot be run as it is.
    """
    require_error(asked)
    first = trials.run("its own", own(trials.file))
    if first is None or first.x is None:
        why = "would take longer" if first is None else " ".join(first.messages)
        raise ValueError(f"The scene must run as it is, within the time there is, but: {why}")
    if scale(first.x) == 0:
        raise ValueError("Something of the scene must move to be tuned, but nothing does.")
    limit = _climb(trials, asked)
    if limit is None:
        notes = ("no three grids in a row could be run: there is no limit to compare with",)
        return Tuning(asked, None, (), None, notes)
    if limit.doubt < asked:
        _combine(trials, limit, asked)
    rows = _rows(trials, limit)
    chosen = _cheapest(rows, limit, asked)
    return Tuning(asked, limit, rows, chosen, tuple(_notes(trials, limit, rows, chosen, asked)))


def require_error(asked: float) -> None:
    """Raise a `ValueError` unless it can be an error to ask for."""
    if not 0 < asked < 1:
        raise ValueError(f"Argument `error` must be above 0 and below 1 (100 %), but is {asked:g}.")


def on_rung(base: Setting, rung: int) -> Setting:
    """The setting on the grid of a rung, with eight particles in a cell."""
    spacing = float(f"{base.spacing / RATIO**rung:.4g}")
    return dataclasses.replace(base, spacing=spacing, particle_spacing=_EIGHT)


def ladder(file: SceneFile) -> list[tuple[str, Setting]]:
    """The rungs from coarse to fine; the first three are always run."""
    # A time step that was given is one for the grid it was given for.
    base = dataclasses.replace(own(file), dt=None)
    rungs = [
        (f"grid {RATIO**-rung:.3g} times as coarse", on_rung(base, rung))
        for rung in range(_FIRST, _FINEST + 1)
    ]
    return [(what, setting) for what, setting in rungs if _fits(file, setting.spacing)]


def _fits(file: SceneFile, spacing: float) -> bool:
    """Whether the box of the grid has enough cells of a spacing."""
    sides = np.asarray(file.grid.upper) - np.asarray(file.grid.lower)
    return bool(np.all(sides >= _CELLS * spacing))


def choices(base: Setting) -> list[list[tuple[str, Setting]]]:
    """What else can be chosen, one thing at a time: for each its alternatives."""
    schemes = [SplineGradient(), MLS()]
    other = BSpline(5 - base.spline.degree)
    return [
        [("scheme", dataclasses.replace(base, scheme=s)) for s in schemes if s != base.scheme],
        [("spline", dataclasses.replace(base, spline=other))],
        [("particles", dataclasses.replace(base, particle_spacing=p)) for p in _OTHERS],
        [
            ("time step", dataclasses.replace(base, fraction=f))
            for f in _FRACTIONS
            if f != base.fraction
        ],
    ]


def _climb(trials: Trials, asked: float) -> Limit | None:
    """Run finer and finer grids until one of them is good enough."""
    levels, limit = [], None
    for what, setting in ladder(trials.file):
        trial = trials.run(what, setting)
        if trial is None:
            break
        # Where a grid is so coarse that particles are lost, the ladder begins above it.
        levels = [] if trial.x is None else [*levels, trial.x]
        if len(levels) >= 3:
            limit = refined(levels, RATIO)
            if _cheapest(_rows(trials, limit), limit, asked) is not None:
                break
    return limit


def _rows(trials: Trials, limit: Limit) -> tuple[Row, ...]:
    return tuple(Row(t, math.inf if t.x is None else limit.error(t.x)) for t in trials.done)


def _cheapest(rows: tuple[Row, ...], limit: Limit, asked: float) -> Row | None:
    """The one that takes the least time among those within the error; double precision is not."""
    within = [r for r in rows if r.error + limit.doubt <= asked and not r.trial.double]
    return min(within, key=lambda r: r.trial.seconds, default=None)


def _combine(trials: Trials, limit: Limit, asked: float) -> None:
    """Try every other choice alone, and then those that pay together."""
    base = _rough(trials, limit, asked)
    order = min(max(limit.order, 0.5), 2.0)
    if jnp.zeros(()).dtype == jnp.float32:
        trials.run("double precision", base.trial.setting, double=True)
    merged, expected = base.trial.setting, base.error
    for alternatives in choices(base.trial.setting):
        tried = [(s, trials.run(what, s)) for what, s in alternatives]
        rows = [
            (s, Row(t, limit.error(t.x)))
            for s, t in tried
            if t is not None and t.x is not None and set(t.messages) <= set(base.trial.messages)
        ]
        best = min(rows, key=lambda r: _price(r[1], limit, order), default=None)
        if best is None or _price(best[1], limit, order) >= _price(base, limit, order):
            continue
        changed = {
            f.name: getattr(best[0], f.name)
            for f in dataclasses.fields(Setting)
            if getattr(best[0], f.name) != getattr(base.trial.setting, f.name)
        }
        merged = dataclasses.replace(merged, **changed)
        expected *= best[1].error / base.error
    _walk(trials, limit, asked, merged, (expected, order))


def _rough(trials: Trials, limit: Limit, asked: float) -> Row:
    """The coarsest rung that is not too far off; the finest if all are."""
    rungs = [r for r in _rows(trials, limit) if r.trial.what.startswith("grid ")]
    near = [r for r in rungs if r.error <= _ROUGH * asked]
    return max(near, key=lambda r: r.trial.setting.spacing) if near else rungs[-1]


def _price(row: Row, limit: Limit, order: float) -> float:
    """The time that a setting would take on the grid on which its error is a given one."""
    return row.trial.seconds * max(row.error, limit.doubt) ** (_POWER / order)


def _walk(
    trials: Trials, limit: Limit, asked: float, merged: Setting, expected: tuple[float, float]
) -> None:
    """Run a setting on the rung where it should be good enough, and then coarser or finer."""
    start = own(trials.file).spacing

    def spacing(rung: int) -> float:
        """Of the grid of a rung, m."""
        return float(f"{start / RATIO**rung:.4g}")

    rung = round(math.log(start / merged.spacing, RATIO))
    left = _MARGIN * (asked - limit.doubt)
    error, order = expected
    rung += math.ceil(math.log(max(error, 1e-9) / left, RATIO) / order - 1e-9)
    coarsest = next(r for r in range(_COARSEST, 1) if r == 0 or _fits(trials.file, spacing(r)))
    tried: set[int] = set()
    for _ in range(_TRIES):
        rung = min(max(rung, coarsest), _FINEST)
        if rung in tried:
            return
        trial = trials.run("together", dataclasses.replace(merged, spacing=spacing(rung)))
        if trial is None:
            return
        good = trial.x is not None and limit.error(trial.x) + limit.doubt <= asked
        tried.add(rung)
        best = _cheapest(_rows(trials, limit), limit, asked)
        if not good and best is not None and best.trial.seconds <= trial.seconds:
            return
        rung += -1 if good else 1


def _notes(
    trials: Trials, limit: Limit, rows: tuple[Row, ...], chosen: Row | None, asked: float
) -> Iterator[str]:
    """What could not be resolved."""
    before, last = limit.changes
    if not limit.converges:
        yield (
            f"the grids do not converge: the motion changes by {100 * before:.2g} % and then by "
            f"{100 * last:.2g} % (fracture and flow may be different on every grid; walls are "
            f"where their nodes are)"
        )
    if chosen is not None:
        yield from chosen.trial.messages
    elif limit.doubt >= asked:
        yield (
            f"nothing can be said to be within {100 * asked:.3g} %: the limit itself is in doubt "
            f"by {100 * limit.doubt:.2g} %"
        )
    else:
        best = min(rows, key=lambda r: r.error)
        yield (
            f"nothing is within {100 * asked:.3g} %: the nearest is {best.trial.setting}, "
            f"{100 * best.error:.2g} % from a limit that is in doubt by {100 * limit.doubt:.2g} %"
        )
    yield from (f"left out for lack of time: {text}" for text in trials.left_out.values())
