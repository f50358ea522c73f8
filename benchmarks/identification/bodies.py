"""Bodies, their Gaussians and the cameras around them: procedural, alike at every spacing."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import pgjax
from pgjax import sampling
from pgjax.render import Camera, Gaussians

# Rotation of the body against the axes of the grid.
_TURN = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))


@dataclasses.dataclass(frozen=True)
class Resolution:
    """How a case is discretised.

    Attributes:
        cells: of the grid, per metre.
        seed: of the jitter of the particles; a lattice if None.
        steps: factor of the steps per frame.
        spline: degree.
    """

    cells: float
    seed: int | None = None
    steps: int = 1
    spline: int = 2

    @property
    def h(self) -> float:
        """Grid spacing, m."""
        return 1 / self.cells

    def finer(self) -> "Resolution":
        """What the data of the tier "cross" are made with: nothing is discretised alike."""
        return dataclasses.replace(self, cells=1.5 * self.cells, seed=7, steps=2)

    def jittered(self, x: np.ndarray) -> np.ndarray:
        """Particles moved by up to a quarter of their distance."""
        if self.seed is None:
            return x
        rng = np.random.default_rng(self.seed)
        return x + rng.uniform(-0.25, 0.25, x.shape) * self.h / 2

    def grid(self, lower, upper, above: float = 0.0) -> pgjax.Grid:
        """A grid that covers a box and two cells around it; last, a node lies `above` 0."""
        lower = np.floor(np.asarray(lower) * self.cells - 2).astype(int)
        upper = np.ceil(np.asarray(upper) * self.cells + 2).astype(int)
        origin = lower * self.h
        origin[-1] += above
        return pgjax.Grid(tuple(origin), tuple(int(n) for n in upper - lower), self.h)


def tilted_block(size, center, resolution: Resolution) -> tuple[np.ndarray, np.ndarray]:
    """A block that stands on none of its sides: positions and volumes, two particles per cell."""
    half = np.asarray(size) / 2
    x, volumes = sampling.block(-half, half, resolution.h / 2)
    return np.asarray(center) + resolution.jittered(x) @ np.asarray(_TURN).T, volumes


def ball(center, radius: float, resolution: Resolution) -> tuple[np.ndarray, np.ndarray]:
    """A ball: positions and volumes."""
    x, volumes = sampling.ball(center, radius, resolution.h / 2)
    return resolution.jittered(x), volumes


def painted(x: np.ndarray, spacing: float) -> Gaussians:
    """Round Gaussians whose colour is a smooth pattern of where they are."""
    n = len(x)
    waves = np.array([[37.0, 13.0, -21.0], [-17.0, 41.0, 11.0], [9.0, -23.0, 43.0]])
    colour = 0.5 + 0.4 * np.sin(x @ waves.T + np.array([0.3, 1.1, 2.3]))
    sh = (colour - 0.5) * np.sqrt(4 * np.pi)
    dtype = jnp.zeros(()).dtype
    return Gaussians.from_scales(
        jnp.asarray(x, dtype),
        jnp.broadcast_to(jnp.asarray([1.0, 0, 0, 0], dtype), (n, 4)),
        jnp.full((n, 3), 0.6 * spacing, dtype),
        jnp.full((n,), 0.9, dtype),
        jnp.asarray(sh[:, None, :], dtype),
    )


def cameras(center, radius: float, count: int, pixels: int) -> list[Camera]:
    """Cameras on a ring of changing height around a point."""
    return [
        Camera.orbit(
            tuple(float(c) for c in center),
            up=(0.0, 0.0, 1.0),
            azimuth=2 * np.pi * (k + 0.35) / count,
            elevation=np.deg2rad((15, 35, 5)[k % 3]),
            radius=radius,
            width=pixels,
            height=pixels,
            fov_y=np.deg2rad(35),
        )
        for k in range(count)
    ]
