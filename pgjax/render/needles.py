"""Long Gaussians: how many there are, and splitting them so that they can follow a bend.

One Gaussian moves with one deformation gradient. A needle that is longer than what the motion is
smooth over sticks out of a bent body; a chain of shorter ones follows it.
"""

from dataclasses import dataclass
from typing import final

import jax.numpy as jnp
import numpy as np

from pgjax._types import require
from pgjax.render.gaussians import Gaussians

_QUANTILES = (0.5, 0.9, 0.99, 1.0)
_NEEDLE = 10.0
# Distance of the children in their own standard deviations: the sum of many ripples by 1.4 %.
_PITCH = 2.0
_LONG, _SHORT = 2.9, 3.0  # the row's half-length, in the parent's standard deviations
_WIDER = 1.05  # bounds the factor by which the widths are scaled
_SWEEPS = 12  # the opacities are then settled to 1e-4


@final
@dataclass(frozen=True)
class AxisReport:
    """How elongated a set of Gaussians is.

    Attributes:
        count: number of Gaussians with finite factors.
        broken: number of those whose factors are not finite.
        ratios: quantiles 50, 90, 99 and 100 % of longest/middle standard deviation.
        needles: number with that ratio above 10.
        spacing: distance of the particles, in the units of the Gaussians.
        long: number with the longest standard deviation above `spacing`.
    """

    count: int
    broken: int
    ratios: tuple[float, float, float, float]
    needles: int
    spacing: float
    long: int

    def __str__(self) -> str:
        half, ninety, ninety_nine, largest = self.ratios
        return (
            f"{self.count} Gaussians ({self.broken} not finite), longest/middle axis "
            f"{half:.3g} (median), {ninety:.3g} (90 %), {ninety_nine:.3g} (99 %), {largest:.3g} "
            f"(largest); {self.needles} above {_NEEDLE:.0f}; "
            f"{self.long} longer than {self.spacing:.3g}"
        )


def measure_axes(gaussians: Gaussians, spacing: float) -> AxisReport:
    """Count needles, and Gaussians whose longest standard deviation exceeds `spacing`.

    A middle axis of length zero gives an infinite ratio, a Gaussian of size zero the ratio 1.
    """
    require("spacing", spacing, "be positive and finite", lambda a: (a > 0) & np.isfinite(a))
    factors = np.asarray(gaussians.factors, np.float64)
    finite = np.all(np.isfinite(factors), axis=(1, 2))
    sigma = np.linalg.svd(factors[finite], compute_uv=False)
    longest, middle = sigma[:, 0], sigma[:, 1]
    ratio = np.divide(longest, middle, out=np.full(len(sigma), np.inf), where=middle > 0)
    ratio[longest == 0] = 1
    # `lower` picks a member, so that an infinite ratio does not spread by interpolation.
    quantiles = np.quantile(ratio, _QUANTILES, method="lower") if len(ratio) else np.ones(4)
    half, ninety, ninety_nine, largest = (float(q) for q in quantiles)
    return AxisReport(
        count=len(sigma),
        broken=int(np.count_nonzero(~finite)),
        ratios=(half, ninety, ninety_nine, largest),
        needles=int(np.count_nonzero(ratio > _NEEDLE)),
        spacing=float(spacing),
        long=int(np.count_nonzero(longest > spacing)),
    )


def split_long(
    gaussians: Gaussians, longest: float, *, max_gaussians: int = 4_000_000
) -> tuple[Gaussians, np.ndarray]:
    """Replace each Gaussian longer than `longest` by a row of shorter ones along its longest axis.

    Of a Gaussian with longest standard deviation L along the unit vector u the children lie at
    `x + L t_j u`, and have there the standard deviation `L s ≤ longest`, with t and s from
    `_row`. Weighted with their opacity they keep its mean and covariance exactly. Seen across u
    they cover as much as it at each place along u; where it is nearly opaque they are somewhat
    wider and less opaque than it. Seen along u they overlap and cover more, because the opacity of
    a Gaussian is the same from all sides: by 10 % at 40° from across for a needle of 10 : 1, and
    twice as much at 80°. Gaussians that are not finite are left as they are.

    Args:
        gaussians: what to split; the others are returned unchanged, in the same order.
        longest: bound of the standard deviations, in the units of the Gaussians.
        max_gaussians: most Gaussians to return.

    Returns:
        The Gaussians, and for each of them the index of the one it comes from.

    Raises:
        ValueError: `longest` is not positive, or asks for more than `max_gaussians`.
    """
    require("longest", longest, "be positive and finite", lambda a: (a > 0) & np.isfinite(a))
    factors = np.asarray(gaussians.factors, np.float64)
    opacities = np.asarray(gaussians.opacities, np.float64)
    finite = np.all(np.isfinite(factors), axis=(1, 2)) & np.isfinite(opacities)
    U, sigma, Vt = np.linalg.svd(np.where(finite[:, None, None], factors, 0))
    ratio = sigma[:, 0] / longest
    needed = np.where(ratio > 1, _children(np.maximum(ratio, 1)), 1)
    if needed.sum() > max_gaussians:
        raise ValueError(
            f"Argument `longest` must give at most `max_gaussians` = {max_gaussians} Gaussians, "
            f"but {longest} gives {needed.sum():.3g} from {len(gaussians)}: raise `longest`, or "
            f"leave out the longest ones."
        )
    counts = needed.astype(np.int64)
    parent = np.repeat(np.arange(len(gaussians)), counts)
    first = np.cumsum(counts) - counts
    place, width, opacity = np.zeros(len(parent)), np.ones(len(parent)), opacities[parent]
    for k in np.unique(counts[counts > 1]):
        whose = np.flatnonzero(counts == k)
        rows = first[whose, None] + np.arange(k)
        place[rows], width[rows], opacity[rows] = _row(opacities[whose], int(k))
    split = counts[parent] > 1
    p = parent[split]
    axis = sigma[p, 0, None] * U[p, :, 0]
    shift = place[split, None] * axis
    change = (width[split] - 1)[:, None, None] * axis[:, :, None] * Vt[p, 0][:, None, :]
    dtype = gaussians.means.dtype
    whole = gaussians[parent]
    return (
        Gaussians(
            whole.means.at[split].add(jnp.asarray(shift, dtype)),
            whole.factors.at[split].add(jnp.asarray(change, dtype)),
            whole.opacities.at[split].set(jnp.asarray(opacity[split], dtype)),
            whole.sh,
            whole.frames,
        ),
        parent,
    )


def _width(k: np.ndarray | int) -> np.ndarray | float:
    """Standard deviation of each of k children in a row of half-length `_LONG − _SHORT/k`."""
    return (_LONG - _SHORT / k) * 2 / (k * _PITCH)


def _children(ratio: np.ndarray) -> np.ndarray:
    """Smallest k ≥ 3 with `_WIDER · _width(k) ≤ 1/ratio`, as floats (it may be huge).

    Two children would leave a dent in the middle. With `a = 1/(_WIDER · ratio)` it is the larger
    root of `a k² − 2 (_LONG/_PITCH) k + 2 _SHORT/_PITCH = 0`.
    """
    a = 1 / (_WIDER * ratio)
    b = _LONG / _PITCH
    root = (b + np.sqrt(np.maximum(b * b - 2 * a * _SHORT / _PITCH, 0))) / a
    return np.maximum(np.ceil(root - 1e-9), 3)


def _row(opacity: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, widths and opacities `(m, k)` of k children of m Gaussians of unit length.

    The opacities o_j are found such that at each child's place t_i the row covers as much of the
    cross-section v as the parent does,

        Σ_v 1 − Π_j (1 − o_j q_v exp(−(t_i − t_j)²/2s²)) = Σ_v o q_v exp(−t_i²/2),  q = exp(−v²/2),

    and then places and widths are scaled by one factor so that `Σ o_j t_j²/Σ o_j + s² = 1`.
    """
    s = _width(k)
    t = _PITCH * s * (np.arange(k) - (k - 1) / 2)
    section = np.exp(-(np.linspace(0, 3, 13) ** 2) / 2)
    wanted = opacity[:, None] * np.exp(-(t**2) / 2) * section.sum()
    child = np.minimum(wanted / section.sum(), 1)
    for _ in range(_SWEEPS):
        covered = np.zeros_like(child)
        for q in section:
            passed = np.ones_like(child)
            for m in range(-2, 3):  # the next but one is dimmed to 3e-4, others to nothing
                there = np.zeros_like(child)
                there[:, max(-m, 0) : k - max(m, 0)] = child[:, max(m, 0) : k - max(-m, 0)]
                passed *= 1 - q * np.exp(-((m * _PITCH) ** 2) / 2) * there
            covered += 1 - passed
        child = np.minimum(child * wanted / np.maximum(covered, 1e-300), 1)
    child = (child + child[:, ::-1]) / 2
    total = np.maximum(child.sum(axis=1), 1e-300)
    scale = 1 / np.sqrt((child * t**2).sum(axis=1) / total + s * s)
    return scale[:, None] * t, np.broadcast_to(scale[:, None] * s, child.shape), child
