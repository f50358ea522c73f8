"""The constants of the compositing, in which renderers of Gaussians differ."""

from typing import final

import equinox as eqx


@final
class Rule(eqx.Module):
    """How Gaussians become alphas, and when a ray ends.

    A Gaussian at σ (half the squared Mahalanobis distance) with opacity o has
    `alpha = min(alpha_max, o exp(−σ))`, and is skipped if alpha < alpha_min. Front to back, the ray
    ends *before* the Gaussian that would take the transmittance to `stop` or below.

    Attributes:
        alpha_max: largest alpha of one Gaussian.
        alpha_min: smallest alpha that is drawn.
        stop: transmittance at which a ray ends; 0 for never.
        low_pass: added to the variances in the image, in squared pixels.
        smooth: instead of the jump at alpha_min, multiply alpha by `t² (3 − 2 t)` with
            `t = alpha / alpha_min − 1` between alpha_min and twice that: the image is then a
            continuously differentiable function of what is drawn, up to the order in depth.
    """

    alpha_max: float = eqx.field(default=0.99, static=True, converter=float)
    alpha_min: float = eqx.field(default=1 / 255, static=True, converter=float)
    stop: float = eqx.field(default=1e-4, static=True, converter=float)
    low_pass: float = eqx.field(default=0.3, static=True, converter=float)
    smooth: bool = eqx.field(default=False, static=True, converter=bool)

    def __check_init__(self):
        bounds = {
            "alpha_max": (0 < self.alpha_max < 1, "be between 0 and 1 (excluded)"),
            "alpha_min": (0 < self.alpha_min < 1, "be between 0 and 1 (excluded)"),
            "stop": (0 <= self.stop < 1, "be in [0, 1)"),
            "low_pass": (self.low_pass > 0, "be positive"),
            "smooth": (
                not self.smooth or 2 * self.alpha_min <= self.alpha_max,
                "be False unless alpha_min is at most alpha_max / 2",
            ),
        }
        for name, (holds, rule) in bounds.items():
            if not holds:
                raise ValueError(f"Argument `{name}` must {rule}, but is {getattr(self, name)}.")


RULE_3DGS = Rule()
"""The original: alphas up to 0.99, rays end at a transmittance of 1e-4."""

RULE_GSPLAT15 = Rule(alpha_max=0.999)
"""gsplat 1.5: alphas up to 0.999. The early end can drop an opaque Gaussian here."""

RULE_EXACT = Rule(alpha_max=0.999, stop=0.0)
"""Rays never end early: for gradients, and for measuring."""
