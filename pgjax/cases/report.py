"""The report of a fit: Markdown, and pictures of what was observed beside what is predicted."""

import dataclasses
from pathlib import Path

import numpy as np

from pgjax._files import replacing
from pgjax.cases.plots import plot_convergence
from pgjax.cases.schema import CaseFile
from pgjax.inverse import Fit
from pgjax.render import save_image

# Frames of a sheet of pictures, and its gap in pixels.
_SHOWN, _GAP = 6, 2


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What one observation shows, beside what the estimate predicts.

    Attributes:
        frames: their numbers, `(n,)`.
        observed: `(n, …)`.
        predicted: `(n, …)`.
        pictures: whether these are pictures.
    """

    frames: np.ndarray
    observed: np.ndarray
    predicted: np.ndarray
    pictures: bool

    def errors(self) -> np.ndarray:
        """Root mean square difference of each frame, `(n,)`."""
        off = (self.observed - self.predicted).reshape(len(self.frames), -1)
        return np.sqrt(np.nanmean(off**2, axis=1))


def write_report(
    out: Path,
    case: CaseFile,
    found: Fit,
    dt: float,
    comparisons: list[Comparison],
    notes: tuple[str, ...],
) -> Path:
    """Write `report.md` and its pictures; returns its path."""
    lines = [f"# {case.name}", ""]
    lines += _estimates(found, dt)
    lines += _notes([*notes, *found.messages])
    lines += _uncertainty(found)
    lines += _convergence(out, found)
    lines += _prediction(out, case, comparisons)
    path = out / "report.md"
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _estimates(found: Fit, dt: float) -> list[str]:
    lines = [
        "| parameter | estimate | 90 % interval | 95 % interval | unit | verdict |",
        "|---|---:|---|---|---|---|",
    ]
    for name, value, unit in found.rows():
        narrow, wide, verdict = "", "", ""
        if found.uncertainty is not None:
            inner, interval = (found.uncertainty.interval(name, level) for level in (0.9, 0.95))
            narrow = f"{inner.low:.5g} … {inner.high:.5g}"
            wide = f"{interval.low:.5g} … {interval.high:.5g}"
            verdict = interval.verdict + (f": {interval.why}" if interval.why else "")
        lines.append(f"| `{name}` | {value:.6g} | {narrow} | {wide} | {unit} | {verdict} |")
    return [
        *lines,
        "",
        f"{'Converged' if found.converged else 'Stopped'}: {found.reason}. "
        f"{found.iterations} points, {found.simulations} simulations (a tangent counts as one), "
        f"{found.seconds:.0f} s. Time step {dt:.4g} s, the same throughout.",
        "",
    ]


def _notes(notes: list[str]) -> list[str]:
    return ["## To know", "", *(f"- {note}" for note in notes), ""] if notes else []


def _uncertainty(found: Fit) -> list[str]:
    u = found.uncertainty
    if u is None:
        return []
    lines = [
        "## How sure",
        "",
        f"The residual is {u.noise:.3g} times the noise that was given. Intervals follow from it, "
        "and from the scatter between frames where that is more than 2.5 times what independent "
        "noise says; an error of the model that is the same in all frames is not known to them.",
        "",
        "| | scatter between frames | derivative against secant | "
        + " | ".join(f"`{n}`" for n in u.names)
        + " |",
        "|---|---:|---:|" + "---:|" * len(u.names),
    ]
    rows = zip(u.names, u.clustering, u.mismatches, u.correlation, strict=True)
    for name, clustering, mismatch, row in rows:
        cells = " | ".join(f"{c:.2f}" for c in row)
        lines.append(f"| `{name}` | {clustering:.2g} | {mismatch:.1%} | {cells} |")
    lines += ["", "Independent combinations, the best known first:", ""]
    for direction in u.directions():
        parts = " ".join(f"{w:+.2f} `{n}`" for w, n in zip(direction.weights, u.names, strict=True))
        lines.append(f"- {direction.deviation:.3g}: {parts}")
    return [*lines, ""]


def _convergence(out: Path, found: Fit) -> list[str]:
    names = found.problem.names
    drawn = plot_convergence(found, out / "convergence.png")
    lines = [
        "## Convergence",
        "",
        "![convergence](convergence.png)",
        "",
        "Every point that was tried; red ones were rejected, green bands are the 95 % intervals"
        + (f" (the first {len(drawn)} parameters)." if len(drawn) < len(names) else "."),
        "",
        "| s | frames | cost | " + " | ".join(f"`{n}`" for n in names) + " | |",
        "|---:|---:|---:|" + "---:|" * len(names) + "---|",
    ]
    logarithmic = found.problem.space.logarithmic
    for trial in found.trials:
        known = dict(zip(trial.names, trial.u, strict=True))
        cells = " | ".join(
            "" if name not in known else f"{np.exp(known[name]) if log else known[name]:.6g}"
            for name, log in zip(names, logarithmic, strict=True)
        )
        note = "" if trial.taken else f"rejected: {trial.note}"
        lines.append(
            f"| {trial.seconds:.1f} | {trial.frames} | {trial.cost:.6g} | {cells} | {note} |"
        )
    return [*lines, ""]


def _prediction(out: Path, case: CaseFile, comparisons: list[Comparison]) -> list[str]:
    """Errors of every frame; frames beyond the fitted ones are a prediction."""
    unit = "m" if case.track is not None else "of a pixel, 0 to 1"
    lines = ["## Predicted against observed", "", f"Root mean square difference ({unit}):", ""]
    for number, comparison in enumerate(comparisons, start=1):
        errors = comparison.errors()
        beyond = comparison.frames > case.fit_frames
        lines.append(f"- view {number}, fitted frames: {_mean(errors[~beyond])}")
        if beyond.any():
            lines.append(
                f"- view {number}, frames {case.fit_frames + 1} to {comparison.frames[-1]}, which "
                f"were not fitted: {_mean(errors[beyond])}"
            )
        if comparison.pictures:
            name = f"view-{number}.png"
            shown = _sheet(comparison)
            save_image(out / name, shown.image)
            lines += [
                "",
                f"![view {number}]({name})",
                "",
                "Observed, predicted, and their difference around grey, in the frames "
                f"{', '.join(map(str, shown.frames))}"
                + (" (fitted up to " + str(case.fit_frames) + ")." if beyond.any() else "."),
                "",
            ]
    return lines


def _mean(errors: np.ndarray) -> str:
    return f"{np.sqrt(np.mean(errors**2)):.4g}" if len(errors) else "none"


@dataclasses.dataclass(frozen=True)
class _Sheet:
    image: np.ndarray
    frames: list[int]


def _sheet(comparison: Comparison) -> _Sheet:
    """Some frames side by side: observed, predicted, difference."""
    count = len(comparison.frames)
    chosen = np.unique(np.linspace(0, count - 1, min(_SHOWN, count)).round().astype(int))

    def row(pictures: np.ndarray) -> np.ndarray:
        colour = pictures if pictures.ndim == 4 else np.repeat(pictures[..., None], 3, axis=-1)
        padded = np.pad(
            np.nan_to_num(colour), [(0, 0), (0, _GAP), (0, _GAP), (0, 0)], constant_values=1.0
        )
        return np.concatenate(list(padded), axis=1)

    observed, predicted = comparison.observed[chosen], comparison.predicted[chosen]
    difference = 0.5 + 0.5 * (predicted - observed)
    image = np.concatenate([row(observed), row(predicted), row(difference)])
    return _Sheet(np.clip(image, 0, 1), comparison.frames[chosen].tolist())
