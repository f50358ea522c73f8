"""The camera of a scene file: on an orbit, on a path, or one of those of the capture."""

import dataclasses
from collections.abc import Callable

from pgjax.render import Camera, CameraPath, load_cameras
from pgjax.scenes.model import ModelPart
from pgjax.scenes.reader import REQUIRED, SceneError, Table, naming, nearest
from pgjax.scenes.regions import Triple
from pgjax.scenes.views import Look, LookPath, Orbit, OrbitPath, Shot, ShotPath, View

_LARGEST_IMAGE = 16384
# Degrees, excluded.
_ELEVATIONS = {"above": -90, "below": 90}
_OPENINGS = {"above": 0, "below": 170}


@dataclasses.dataclass(frozen=True)
class CameraPart:
    """From where the scene is seen, and how the Gaussians are drawn."""

    view: View
    background: Triple
    max_stretch: float


def camera(t: Table, model: ModelPart) -> CameraPart:
    """The camera from its table; an orbit's defaults follow place and size of the model."""
    view = _shot(t) if t.has("file") else _orbit(t, model)
    background = t.vector("background", (1.0, 1.0, 1.0), at_least=0)
    if max(background) > 1:
        raise t.error("background", "be a list of 3 numbers from 0 to 1")
    return CameraPart(
        view=view,
        background=background,
        max_stretch=t.number("max_stretch", 4.0, at_least=1),
    )


def _orbit(t: Table, model: ModelPart) -> Orbit | OrbitPath | LookPath:
    t.path("file", None)
    (x, y, z), size = model.position, model.size
    orbit = Orbit(
        target=t.vector("target", (x, y, z + 0.4 * size)),
        azimuth=t.number("azimuth", -60.0),
        elevation=t.number("elevation", 12.0, **_ELEVATIONS),
        radius=t.number("radius", 2.4 * size, above=0),
        turn=t.number("turn", 0.0),
        fov=t.number("fov", 40.0, **_OPENINGS),
        width=t.integer("width", 480, at_least=16, at_most=_LARGEST_IMAGE),
        height=t.integer("height", 480, at_least=16, at_most=_LARGEST_IMAGE),
    )
    keys = t.tables("keyframes")
    if not t.has("keyframes"):
        return orbit
    if t.has("turn"):
        raise t.error("turn", "be left out where there are `keyframes`")
    return (
        _looks(t, keys, orbit) if any(key.has("eye") for key in keys) else _orbits(t, keys, orbit)
    )


def _orbits(t: Table, keys: list[Table], first: Orbit) -> OrbitPath:
    """Key frames on spheres; what is left out stays as in the key frame before."""
    orbits = [first]

    def read(key: Table) -> None:
        """Add the orbit of a key frame."""
        before = orbits[-1]
        orbits.append(
            dataclasses.replace(
                before,
                target=key.vector("target", before.target),
                azimuth=key.number("azimuth", before.azimuth),
                elevation=key.number("elevation", before.elevation, **_ELEVATIONS),
                radius=key.number("radius", before.radius, above=0),
                fov=key.number("fov", before.fov, **_OPENINGS),
            )
        )

    return OrbitPath(_key_times(t, keys, read), tuple(orbits[1:]))


def _looks(t: Table, keys: list[Table], base: Orbit) -> LookPath:
    """Key frames of an eye and of what it looks at."""
    for name in ("azimuth", "elevation", "radius"):
        for table in (t, *keys):
            if table.has(name):
                raise table.error(name, "be left out where key frames have an `eye`")
    looks: list[Look] = []

    def read(key: Table) -> None:
        """Add the eye of a key frame."""
        eye, target, fov = looks[-1] if looks else (REQUIRED, base.target, base.fov)
        look = Look(
            key.vector("eye", eye),
            key.vector("target", target),
            key.number("fov", fov, **_OPENINGS),
        )
        if look.eye == look.target:
            raise key.error("eye", f"differ from `target` = {list(look.target)}")
        looks.append(look)

    times = _key_times(t, keys, read)
    path = LookPath(times, tuple(looks), base.width, base.height)
    with naming(t.name):
        path.require_level()
    return path


def _key_times(t: Table, keys: list[Table], read: Callable[[Table], None]) -> tuple[float, ...]:
    """The times of the key frames, s, of which `read` takes the rest one after the other."""
    times: list[float] = []
    for key in keys:
        time = key.number("time")
        if times and time <= times[-1]:
            raise key.error("time", f"be after that of the key frame before, {times[-1]:g} s")
        times.append(time)
        key.read(read)
    if len(times) < 2:
        raise t.error("keyframes", "hold at least two key frames")
    return tuple(times)


def _shot(t: Table) -> Shot | ShotPath:
    cameras = load_cameras(t.existing_path("file"))
    if not t.has("keyframes"):
        one = _one_of(t, cameras)
        shot = Shot(_resized(one, _width(t, one)))
        t.tables("keyframes")
        return shot
    keys = t.tables("keyframes")
    for name in ("index", "name"):
        if t.has(name):
            raise t.error(name, "be left out where there are `keyframes`")
    found: list[Camera] = []
    times = _key_times(t, keys, lambda key: found.append(_one_of(key, cameras)))
    width = _width(t, found[0])
    with naming(t.name):
        return ShotPath(CameraPath(times, [_resized(camera, width) for camera in found]))


def _width(t: Table, camera: Camera) -> int:
    width = t.integer("width", camera.width, at_least=16, at_most=_LARGEST_IMAGE)
    height = _height(camera, width)
    if max(width, height) > _LARGEST_IMAGE:
        rule = f"make a picture of at most {_LARGEST_IMAGE} x {_LARGEST_IMAGE}"
        raise SceneError(f"{t.name}: `width` must {rule}, but it is {width} x {height}.")
    return width


def _one_of(t: Table, cameras: dict[str, Camera]) -> Camera:
    """The camera of a file that `index` or `name` says, or the first."""
    index, name = t.integer("index", None, at_least=0), t.text("name", None)
    if name is not None:
        if index is not None:
            raise t.error("index", "be left out where `name` is given")
        if name not in cameras:
            raise t.error("name", f"be one of the file's {len(cameras)}{nearest(name, cameras)}")
        return cameras[name]
    index = index or 0
    if index >= len(cameras):
        raise t.error("index", f"be below {len(cameras)}, the number of cameras in the file")
    return list(cameras.values())[index]


def _height(camera: Camera, width: int) -> int:
    """The height that goes with another width."""
    return max(1, round(camera.height * width / camera.width))


def _resized(camera: Camera, width: int) -> Camera:
    """The same view in an image of another width; the height follows."""
    height = _height(camera, width)
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
