"""B-splines of degree 2 and 3 on a uniform grid: weights, gradients and their second moment."""

from typing import final

import equinox as eqx
import jax.numpy as jnp

from pgjax._types import Array, Float


@final
class BSpline(eqx.Module):
    """The interpolating spline of the particle–grid transfers.

    Args:
        degree: 2 (quadratic, the default everywhere) or 3 (cubic). Degree 1 is refused: its
            APIC matrix D vanishes at the nodes and its ∇w jumps, so no time step is stable.
    """

    degree: int = eqx.field(default=2, static=True)

    def __check_init__(self):
        if not isinstance(self.degree, int) or self.degree not in (2, 3):
            raise ValueError(f"Argument `degree` must be 2 or 3, but is {self.degree}.")

    @property
    def width(self) -> int:
        """Nodes per direction with a nonzero weight."""
        return self.degree + 1

    @property
    def moment(self) -> float:
        """D/h²: `Σ w (x_i − x_p)(x_i − x_p)ᵀ = D I`, `D = h² (degree + 1)/12`."""
        return (self.degree + 1) / 12

    @property
    def roughness(self) -> float:
        """`g = D max Σ w′²/w`, which enters the stable time step of the ∇w transfer."""
        return {2: 1.5, 3: 1.0456}[self.degree]

    def base(self, xi: Float[Array, " d"]) -> Float[Array, " d"]:
        """First node of the stencil of a particle at `xi` (in cells), as a floating number."""
        return jnp.floor(xi - (self.degree - 1) / 2)

    def weights(
        self, offset: Float[Array, " d"]
    ) -> tuple[Float[Array, "k d"], Float[Array, "k d"]]:
        """Weights and their derivatives per cell at the nodes `0 … degree` of the stencil.

        Args:
            offset: `xi − base`, in [½, 3/2) for degree 2 and [1, 2) for degree 3.
        """
        if self.degree == 2:
            a, b, c = 1.5 - offset, offset - 1, offset - 0.5
            return jnp.stack([a * a / 2, 0.75 - b * b, c * c / 2]), jnp.stack([-a, -2 * b, c])
        # s³/6 and t³/6 cancel in the sums, so that Σ w = s + t = 1 and Σ dw = 0 carry no bias
        # from rounding; written as polynomials they drift in float32 over many steps.
        t = offset - 1
        s = 1 - t
        a, b = s * s * s / 6, t * t * t / 6
        da, db = -s * s / 2, t * t / 2
        w = jnp.stack([a, s - (2 * a - b), t - (2 * b - a), b])
        dw = jnp.stack([da, -1 - (2 * da - db), 1 - (2 * db - da), db])
        return w, dw
