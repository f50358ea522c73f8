"""The camera of a scene file: on an orbit, or one of those the capture was made with."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np

from pgjax.render import Camera, Similarity, load_cameras
from pgjax.scenes.model import ModelPart
from pgjax.scenes.reader import Table, nearest
from pgjax.scenes.regions import Triple

_LARGEST_IMAGE = 16384


@dataclasses.dataclass(frozen=True)
class Orbit:
    """A camera that looks at a point from a sphere around it; lengths in m, angles in degrees."""

    target: Triple
    azimuth: float
    elevation: float
    radius: float
    turn: float
    fov: float
    width: int
    height: int

    def at(self, seconds: float, to_simulation: Similarity) -> Camera:
        """The camera in simulation coordinates, turned by `turn` degrees a second."""
        del to_simulation
        return Camera.orbit(
            self.target,
            up=(0.0, 0.0, 1.0),
            azimuth=math.radians(self.azimuth + self.turn * seconds),
            elevation=math.radians(self.elevation),
            radius=self.radius,
            fov_y=math.radians(self.fov),
            width=self.width,
            height=self.height,
        )


@dataclasses.dataclass(frozen=True)
class Shot:
    """A camera of the capture, in the coordinates of the model."""

    camera: Camera

    def at(self, seconds: float, to_simulation: Similarity) -> Camera:
        """The camera in simulation coordinates; it stands still."""
        del seconds
        return seen_from(self.camera, to_simulation)


@dataclasses.dataclass(frozen=True)
class CameraPart:
    """From where the scene is seen, and how the Gaussians are drawn."""

    view: Orbit | Shot
    background: Triple
    max_stretch: float


def seen_from(camera: Camera, similarity: Similarity) -> Camera:
    """The camera that sees of the transformed scene what `camera` sees of the scene itself.

    With `x_c = R x + t` and `x_sim = s Q x + τ` it has `s x_c = R Qᵀ x_sim + s t − R Qᵀ τ`:
    all depths, and with them the near plane, are s times as large.
    """
    pose = np.asarray(camera.world_to_camera, np.float64)
    s, Q, shift = (
        np.asarray(a, np.float64)
        for a in (similarity.scale, similarity.rotation, similarity.translation)
    )
    turned = pose[:3, :3] @ Q.T
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = turned, s * pose[:3, 3] - turned @ shift
    dtype = jnp.zeros(()).dtype
    return dataclasses.replace(
        camera, world_to_camera=jnp.asarray(moved, dtype), near=float(s) * camera.near
    )


def camera(t: Table, model: ModelPart) -> CameraPart:
    """The camera from its table; an orbit's defaults follow place and size of the model."""
    view = _shot(t) if t.has("file") else _orbit(t, model)
    return CameraPart(
        view=view,
        background=t.vector("background", (1.0, 1.0, 1.0)),
        max_stretch=t.number("max_stretch", 4.0, at_least=1),
    )


def _orbit(t: Table, model: ModelPart) -> Orbit:
    t.path("file", None)
    (x, y, z), size = model.position, model.size
    return Orbit(
        target=t.vector("target", (x, y, z + 0.4 * size)),
        azimuth=t.number("azimuth", -60.0),
        elevation=t.number("elevation", 12.0, above=-90, below=90),
        radius=t.number("radius", 2.4 * size, above=0),
        turn=t.number("turn", 0.0),
        fov=t.number("fov", 40.0, above=0, below=170),
        width=t.integer("width", 480, at_least=16, at_most=_LARGEST_IMAGE),
        height=t.integer("height", 480, at_least=16, at_most=_LARGEST_IMAGE),
    )


def _shot(t: Table) -> Shot:
    cameras = load_cameras(t.existing_path("file"))
    index, name = t.integer("index", None, at_least=0), t.text("name", None)
    if name is not None:
        if index is not None:
            raise t.error("index", "be left out where `name` is given")
        if name not in cameras:
            raise t.error("name", f"be one of the file's {len(cameras)}{nearest(name, cameras)}")
        found = cameras[name]
    else:
        index = index or 0
        if index >= len(cameras):
            raise t.error("index", f"be below {len(cameras)}, the number of cameras in the file")
        found = list(cameras.values())[index]
    width = t.integer("width", found.width, at_least=16, at_most=_LARGEST_IMAGE)
    return Shot(_resized(found, width))


def _resized(camera: Camera, width: int) -> Camera:
    """The same view in an image of another width; the height follows."""
    height = max(1, round(camera.height * width / camera.width))
    across, down = width / camera.width, height / camera.height
    return dataclasses.replace(
        camera,
        fx=across * camera.fx,
        cx=across * camera.cx,
        fy=down * camera.fy,
        cy=down * camera.cy,
        width=width,
        height=height,
    )
