"""From where a scene is seen: cameras as functions of time, in simulation coordinates."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pgjax.render import Camera, CameraPath, Similarity, interpolate
from pgjax.scenes.regions import Triple

_UP = (0.0, 0.0, 1.0)
# Looks per interval between two key frames at which a path is checked, and the smallest sine of
# the angle between view and vertical.
_CHECKS, _STEEPEST = 64, 1e-3


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
class OrbitPath:
    """A camera that moves from orbit to orbit: smoothly in their angles, radii and targets."""

    times: tuple[float, ...]
    keys: tuple[Orbit, ...]

    def at(self, seconds: float, to_simulation: Similarity) -> Camera:
        """The camera in simulation coordinates.

        The elevation e is interpolated as `asinh(tan e)`, which has no bounds, and radius and
        `tan(fov/2)` by their logarithms: none of them leaves its range.
        """
        rows = [(*_free(key), *key.target) for key in self.keys]
        azimuth, y, radius, opening, *target = _curve(self.times, rows, seconds)
        here = dataclasses.replace(
            self.keys[0],
            target=tuple(target),
            azimuth=azimuth,
            elevation=math.degrees(math.atan(math.sinh(y))),
            radius=math.exp(radius),
            fov=_opened(opening),
        )
        return here.at(0.0, to_simulation)


def _free(key: Orbit) -> tuple[float, float, float, float]:
    """What an orbit is interpolated by: four numbers of any size."""
    rise = math.asinh(math.tan(math.radians(key.elevation)))
    return key.azimuth, rise, math.log(key.radius), _opening(key.fov)


class Look(NamedTuple):
    """Where an eye is and what it looks at, m, and its vertical opening angle, degrees."""

    eye: Triple
    target: Triple
    fov: float


@dataclasses.dataclass(frozen=True)
class LookPath:
    """An eye and what it looks at, both on smooth curves; z is up in the picture."""

    times: tuple[float, ...]
    keys: tuple[Look, ...]
    width: int
    height: int

    def at(self, seconds: float, to_simulation: Similarity) -> Camera:
        """The camera in simulation coordinates; it never rolls."""
        del to_simulation
        *places, opening = _curve(self.times, self._rows(), seconds)
        return Camera.look_at(
            places[:3],
            places[3:],
            up=_UP,
            fov_y=math.radians(_opened(opening)),
            width=self.width,
            height=self.height,
        )

    def _rows(self) -> list[tuple[float, ...]]:
        return [(*key.eye, *key.target, _opening(key.fov)) for key in self.keys]

    def require_level(self) -> None:
        """Raise a `ValueError` if the eye meets its target or looks straight up or down."""
        share = np.arange(_CHECKS) / _CHECKS
        starts, gaps = np.asarray(self.times[:-1]), np.diff(self.times)
        seconds = np.append((starts[:, None] + share * gaps[:, None]).ravel(), self.times[-1])
        rows = jnp.asarray(self._rows(), _dtype())
        curve = jax.vmap(lambda t: interpolate(self.times, rows, t))
        places = np.asarray(curve(jnp.asarray(seconds, _dtype())), np.float64)
        view = places[:, 3:6] - places[:, :3]
        steep = np.hypot(view[:, 0], view[:, 1]) <= _STEEPEST * np.linalg.norm(view, axis=1)
        if steep.any():
            raise ValueError(
                f"the camera must not look straight up or down or meet its target on its way, but "
                f"does at {seconds[int(np.argmax(steep))]:.3g} s: move the key frames around it."
            )


@dataclasses.dataclass(frozen=True)
class ShotPath:
    """A camera that moves through those of the capture, in the coordinates of the model."""

    path: CameraPath

    def at(self, seconds: float, to_simulation: Similarity) -> Camera:
        """The camera in simulation coordinates."""
        return seen_from(self.path.at(seconds), to_simulation)


View = Orbit | Shot | OrbitPath | LookPath | ShotPath


def _opening(fov: float) -> float:
    """`log(tan(fov/2))`: minus the logarithm of the focal length in half images."""
    return math.log(math.tan(math.radians(fov) / 2))


def _opened(opening: float) -> float:
    return math.degrees(2 * math.atan(math.exp(opening)))


def _curve(times: tuple[float, ...], rows: list[tuple[float, ...]], seconds: float) -> list[float]:
    """The smooth curve through rows of numbers."""
    found = interpolate(times, jnp.asarray(rows, _dtype()), seconds)
    return np.asarray(found, np.float64).tolist()


def _dtype() -> np.dtype:
    return jnp.zeros(()).dtype


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
