"""How far computed motions are from the one that they approach as the grid is refined."""

import dataclasses
from collections.abc import Sequence

import numpy as np

# Orders that a scheme of second order can have; what is observed beyond them is not believed.
_LOWEST, _HIGHEST = 0.5, 2.0
# What is left in doubt of an extrapolation at least.
_SAFETY = 0.25
# Changes from level to level that have less in common do not approach anything.
_COHERENT = 0.5


@dataclasses.dataclass(frozen=True)
class Limit:
    """What refinement leads to.

    Attributes:
        x: the motion at the limit, m, `(f, n, 3)`.
        doubt: how far the true limit may be from it, in the scale of the scene.
        order: that was observed, of the spacing of the grid; infinite where the last two agree.
        changes: from level to level, the last two, in the scale of the scene.
        converges: whether the last change was smaller than the one before, and in its direction.
        scale: what errors are relative to, m.
    """

    x: np.ndarray
    doubt: float
    order: float
    changes: tuple[float, float]
    converges: bool
    scale: float

    def error(self, x: np.ndarray) -> float:
        """How far a motion is from the limit, in the scale of the scene."""
        return largest(x - self.x) / self.scale


def scale(x: np.ndarray) -> float:
    """What a viewer judges errors by, m: how far the Gaussians move, or how large they all are.

    The largest over the frames of the root mean square of the displacement, but not more than
    that of the distance from the centre at the start: what flies ten lengths is not allowed ten
    times the error.
    """
    center = x[0] - x[0].mean(axis=0)
    return min(largest(x - x[0]), largest(center[None]))


def largest(change: np.ndarray) -> float:
    """The largest over the frames of the root mean square over the Gaussians, m."""
    return float(np.sqrt(np.max(np.mean(np.sum(change.astype(np.float64) ** 2, axis=2), axis=1))))


def refined(levels: Sequence[np.ndarray], ratio: float) -> Limit:
    """The limit of motions on finer and finer grids, from the last three.

    With the changes `Δ₁ = x₁ − x₀`, `Δ₂ = x₂ − x₁` and `q = |Δ₂|/|Δ₁| = ratio^(−p)`, the order p
    bounded to between 1/2 and 2, it is `x₂ + e(p)` with `e(p) = Δ₂ q/(1 − q)`. It is in doubt by
    the largest of: `|Δ₂ − q Δ₁| q/(1 − q)`, what the changes do not have in common; a quarter of
    e(p), after P. J. Roache's grid convergence index, 1994; and its distance from e(1), since walls
    and free surfaces are of first order, whatever three grids show; it is all of e(p) where the
    order is below 1/2. Where the changes do not approach anything the limit is x₂, and the doubt
    is e(p) or the larger change: that the last two agree may be by chance.

    Args:
        levels: at least three motions `(f, n, 3)`, coarse to fine, of the same Gaussians.
        ratio: of the spacings of neighbouring levels, above 1.
    """
    x0, x1, x2 = (x.astype(np.float64) for x in levels[-3:])
    first, second = x1 - x0, x2 - x1
    d1, d2 = largest(first), largest(second)
    size = scale(x2)
    if d2 == 0:
        return Limit(x2, 0.0, np.inf, (d1 / size, 0.0), True, size)
    order = float(np.log(max(d1, 1e-300) / d2) / np.log(ratio))
    q = ratio ** -float(np.clip(order, _LOWEST, _HIGHEST))
    norms = float(np.linalg.norm(first) * np.linalg.norm(second))
    coherence = float(np.sum(first * second)) / norms if norms > 0 else 0.0
    ahead, ahead_of_first_order = q / (1 - q), 1 / (ratio - 1)
    x, doubt = x2, max(ahead * d2, d1)
    if order > 0 and coherence > _COHERENT:
        x = x2 + ahead * second
        least = (
            max(_SAFETY * ahead, abs(ahead - ahead_of_first_order)) if order > _LOWEST else ahead
        )
        doubt = max(ahead * largest(second - q * first), least * d2)
    changes = (d1 / size, d2 / size)
    return Limit(x, doubt / size, order, changes, order > 0 and coherence > 0, size)
