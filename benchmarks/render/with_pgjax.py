"""The image, one tangent and the gradient in pgjax, compiled ahead."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.render import scenes
from benchmarks.render.cases import Case
from benchmarks.render.scenes import BACKGROUND
from benchmarks.render.worker import CLOCKS
from pgjax import native
from pgjax.render import Gaussians, render, save_image
from pgjax.render.tiles import TileGrid

Arrays = dict[str, jax.Array]
PARTS = ("means", "factors", "opacities", "sh")


def kernels() -> str:
    """Which kernels are used, "native" or "plain JAX"; native ones are built and loaded now."""
    if not native.available():
        return "plain JAX"
    return "plain JAX" if native.library("raster", "float32") is None else "native"


class Renderer:
    """Three programs, each a function of the same arrays."""

    def __init__(self, **case: Any):
        self.kernels = kernels()
        self.case = Case(**case)
        gaussians, self.camera = scenes.view(self.case)
        self.gaussians = gaussians
        self.weights, self.direction = map(jnp.asarray, scenes.directions(gaussians, self.camera))
        self.parts = {part: getattr(gaussians, part) for part in PARTS}
        self.programs: dict[str, Any] = {}

    def facts(self) -> dict[str, float]:
        """Number of Gaussians, and of pairs of a Gaussian and a pixel of a tile it touches."""
        pairs = int(render(self.gaussians, self.camera).pairs)
        # The native kernels have tiles of 8² pixels at any size.
        tile = TileGrid.of(self.case.size, self.case.size).tile if self.kernels != "native" else 8
        return {
            "gaussians": len(self.gaussians),
            "pairs per pixel": pairs * tile**2 / self.case.size**2,
        }

    def export(self, file: str) -> None:
        """Everything another code needs to draw the same."""
        camera = self.camera
        np.savez(
            file,
            **{name: np.asarray(value) for name, value in self.parts.items()},
            world_to_camera=np.asarray(camera.world_to_camera),
            intrinsics=np.array(
                [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32
            ),
            near=float(camera.near),
            size=self.case.size,
            weights=np.asarray(self.weights),
            direction=np.asarray(self.direction),
        )

    def compile(self, quantity: str, clock: str) -> dict[str, float]:
        """Seconds until a program is there; bytes that XLA's own temporary arrays will take."""
        function, operands = self._function(quantity)
        started = CLOCKS[clock]()
        program = jax.jit(function).lower(*operands).compile()
        seconds = CLOCKS[clock]() - started
        self.programs[quantity] = program, operands
        memory = program.memory_analysis()
        return {"compilation": seconds, "temporary": memory.temp_size_in_bytes}

    def _function(self, quantity: str) -> tuple[Any, tuple]:
        """A function, and what it is called with; it returns arrays by name."""
        camera = self.camera

        def image(parts: Arrays, frames: jax.Array) -> jax.Array:
            gaussians = Gaussians(**parts, frames=frames)
            return render(gaussians, camera, background=BACKGROUND).rgb

        def forward(parts: Arrays, frames: jax.Array) -> Arrays:
            return {"forward": image(parts, frames)}

        def tangent(parts: Arrays, frames: jax.Array, direction: jax.Array) -> Arrays:
            def moved(means: jax.Array) -> jax.Array:
                return image(parts | {"means": means}, frames)

            value, tangent = jax.jvp(moved, (parts["means"],), (direction,))
            return {"forward": value, "tangent": tangent}

        def gradient(parts: Arrays, frames: jax.Array, weights: jax.Array) -> Arrays:
            def loss(parts: Arrays) -> jax.Array:
                return jnp.sum(weights * image(parts, frames))

            value, found = jax.value_and_grad(loss)(parts)
            return found | {"value": value}

        scene = self.parts, self.gaussians.frames
        return {
            "forward": (forward, scene),
            "tangent": (tangent, (*scene, self.direction)),
            "gradient": (gradient, (*scene, self.weights)),
        }[quantity]

    def run(self, quantity: str) -> Arrays:
        """Once, to the end."""
        program, operands = self.programs[quantity]
        return jax.block_until_ready(program(*operands))

    def save(self, result: dict[str, jax.Array], file: str) -> None:
        """The result in numbers."""
        np.savez(file, **{name: np.asarray(value) for name, value in result.items()})

    def picture(self, folder: str) -> None:
        """The image as a file."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        name = f"{self.case.scene}_{self.case.size}.png"
        image = render(self.gaussians, self.camera, background=BACKGROUND)
        save_image(Path(folder) / name, image.rgb)
