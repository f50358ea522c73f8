"""Reading the cameras of a capture: `cameras.json`, `transforms.json`, COLMAP's sparse models."""

import contextlib
import json
import math
import os
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgjax._files import is_file, is_folder, read_text
from pgjax.render.camera import Camera
from pgjax.render.colmap import Lens, read_model

_CURE = "Undistort the images with COLMAP (`colmap image_undistorter`) and use its cameras."
_DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "distortion_params")
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
# Bytes; 10 000 cameras take half of it.
_LARGEST_JSON = 16 << 20
_LARGEST_SIZE = 2**31 - 1  # pixels
# Of a value of any length a message shows as much as fits into a line.
_SHORT = reprlib.Repr()
_SHORT.maxstring = 80
# OpenGL axes (x right, y up, z back) from OpenCV axes (x right, y down, z forward).
_OPENGL = np.diag([1.0, -1.0, -1.0])


def load_cameras(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Read the cameras of a capture, by the names of their images, in the order of the file.

    - 3D Gaussian Splatting's `cameras.json`: `rotation` (camera to world), `position`, `fx`, `fy`,
      `width`, `height`, `img_name`; the principal point is the centre of the image.
    - `transforms.json` of NeRF, instant-ngp and nerfstudio: `transform_matrix` (camera to world,
      OpenGL axes), `fl_x` or `camera_angle_x`, `w`, `h`, and, if they differ from the defaults,
      `fl_y` or `camera_angle_y` (as x), `cx`, `cy` (the centre). What a frame gives overrides what
      the file gives. Poses are taken as they stand, with the file's `applied_transform`.
    - a folder with a sparse model of COLMAP: `cameras` and `images`, both `.bin` or both `.txt`.

    Args:
        path: the `.json` file or the folder.

    Raises:
        ValueError: something is missing, incomplete or of the wrong shape, a rotation is none, or a
            lens has distortion (which is never ignored).

    Reference: COLMAP documentation, "Output Format"; nerfstudio documentation, "Data conventions".
    """
    file = Path(path)
    if is_folder(file):
        pairs = _colmap(file)
    elif is_file(file):
        content = _json(file)
        if isinstance(content, list):
            pairs = _inria(file, content)
        elif isinstance(content, dict) and "frames" in content:
            pairs = _transforms(file, content)
        else:
            raise ValueError(
                f"The file {file} must be a list of cameras (cameras.json) or have the key "
                "`frames` (transforms.json)."
            )
    else:
        raise ValueError(f"There is no file or folder {file}.")
    cameras: dict[str, Camera] = {}
    for name, camera in pairs:
        if name in cameras:
            raise ValueError(f"The file {file} has two cameras of the name {name!r}.")
        cameras[name] = camera
    if not cameras:
        raise ValueError(f"The file {file} holds no cameras.")
    return cameras


# What the formats share


def _camera(
    file: Path,
    name: str,
    rotation: np.ndarray,
    translation: np.ndarray,
    intrinsics: Sequence[float],
    size: Sequence[float],
) -> Camera:
    """The camera `x_camera = R x_world + t`; what is wrong with it is said with file and name."""
    fx, fy, cx, cy = intrinsics
    with _naming(file, name):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, translation
        width, height = _whole("width", size[0]), _whole("height", size[1])
        return Camera(matrix, fx, fy, cx, cy, width, height)


@contextlib.contextmanager
def _naming(file: Path, name: str) -> Iterator[None]:
    """Put file and camera in front of the message of an error."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"The file {file} has a wrong camera {name!r}: {error}") from None


def _whole(name: str, value: float) -> int:
    if not abs(value) <= _LARGEST_SIZE or value != int(value):
        rule = f"be a whole number, at most {_LARGEST_SIZE}"
        raise ValueError(f"Argument `{name}` must {rule}, but is {_SHORT.repr(value)}.")
    return int(value)


def _require_pinhole(
    file: Path, name: str, model: str, coefficients: Mapping[str, float], fisheye: bool = False
) -> None:
    """Refuse a lens that a pinhole camera cannot stand for."""
    if fisheye:
        raise ValueError(
            f"The file {file} has the camera {name!r} of the model {model}, which is not a pinhole "
            f"even where its coefficients are zero. {_CURE}"
        )
    bent = {key: value for key, value in coefficients.items() if value != 0}
    if bent:
        listed = ", ".join(f"{key} = {value}" for key, value in bent.items())
        raise ValueError(
            f"The file {file} has the camera {name!r} of the model {model} with lens distortion "
            f"({listed}), which is not drawn. {_CURE}"
        )


# cameras.json and transforms.json


def _json(file: Path) -> Any:
    try:
        return json.loads(read_text(file, _LARGEST_JSON))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"The file {file} is not valid JSON: {error}.") from None


def _require_entries(file: Path, entries: Any) -> None:
    """Refuse what is not a list of JSON objects."""
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"The file {file} must hold a list of objects, one per camera.")


def _text(file: Path, entry: Mapping[str, Any], key: str, number: int) -> str:
    if not isinstance(entry.get(key), str):
        raise ValueError(f"The file {file} has no text under the key `{key}` of entry {number}.")
    return entry[key]


def _array(entry: Mapping[str, Any], key: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """The finite numbers under a key, in one of the shapes."""
    if key not in entry:
        raise ValueError(f"The key `{key}` is missing.")
    try:
        array = np.asarray(entry[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"The key `{key}` must hold numbers, but holds {_SHORT.repr(entry[key])}."
        ) from None
    if array.shape not in shapes:
        rule = " or ".join(str(shape) for shape in shapes)
        raise ValueError(f"The key `{key}` must have shape {rule}, but has {array.shape}.")
    if not np.isfinite(array).all():
        raise ValueError(f"The key `{key}` must be finite, but is {_SHORT.repr(entry[key])}.")
    return array


def _number(entry: Mapping[str, Any], key: str) -> float:
    return float(_array(entry, key, ()))


def _inria(file: Path, entries: Any) -> Iterator[tuple[str, Camera]]:
    """The cameras of a `cameras.json`: `x_world = R x_camera + position`."""
    _require_entries(file, entries)
    for number, entry in enumerate(entries):
        name = _text(file, entry, "img_name", number)
        with _naming(file, name):
            rotation, position = _array(entry, "rotation", (3, 3)), _array(entry, "position", (3,))
            fx, fy, width, height = (_number(entry, key) for key in ("fx", "fy", "width", "height"))
        yield (
            name,
            _camera(
                file,
                name,
                rotation.T,
                -rotation.T @ position,
                (fx, fy, width / 2, height / 2),
                (width, height),
            ),
        )


def _transforms(file: Path, content: Mapping[str, Any]) -> Iterator[tuple[str, Camera]]:
    """The cameras of a `transforms.json`: `x_world = R G x_camera + position`, G OpenGL axes."""
    frames = content["frames"]
    _require_entries(file, frames)
    shared = {key: value for key, value in content.items() if key != "frames"}
    for number, frame in enumerate(frames):
        name = _text(file, frame, "file_path", number)
        _require_undistorted(file, name, {**shared, **frame})
        with _naming(file, name):
            pose = _array(frame, "transform_matrix", (4, 4), (3, 4))
            if len(pose) == 4 and not np.allclose(pose[3], [0, 0, 0, 1]):
                raise ValueError(
                    f"The key `transform_matrix` must end with 0 0 0 1, not {pose[3]}."
                )
            rotation = (pose[:3, :3] @ _OPENGL).T
            size = _image_size({**shared, **frame})
            intrinsics = _nerf_intrinsics(shared, frame, size)
        yield name, _camera(file, name, rotation, -rotation @ pose[:3, 3], intrinsics, size)


def _require_undistorted(file: Path, name: str, entry: Mapping[str, Any]) -> None:
    model = str(entry.get("camera_model", "OPENCV"))
    coefficients: dict[str, float] = {}
    for key in set(_DISTORTION_KEYS) & set(entry):
        with _naming(file, name):
            values = _array(entry, key, (), *((n,) for n in range(13)))
        for i, value in enumerate(np.atleast_1d(values)):
            coefficients[f"{key}[{i}]" if values.ndim else key] = float(value)
    other = model not in _PINHOLES or bool(entry.get("is_fisheye", False))
    _require_pinhole(file, name, model, dict(sorted(coefficients.items())), fisheye=other)


def _image_size(entry: Mapping[str, Any]) -> tuple[float, float]:
    if "w" not in entry or "h" not in entry:
        raise ValueError(
            "The keys `w` and `h` are missing. Add the width and height of the images to the file."
        )
    return _number(entry, "w"), _number(entry, "h")


def _nerf_intrinsics(
    shared: Mapping[str, Any], frame: Mapping[str, Any], size: tuple[float, float]
) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy, each from the frame or else from the file."""
    width, height = size
    fx = _focal(frame, "x", width) or _focal(shared, "x", width)
    if fx is None:
        raise ValueError("The keys `fl_x` and `camera_angle_x` are both missing.")
    # A frame that gives only x means square pixels, whatever the file says of y.
    fy = _focal(frame, "y", height) or _focal(frame, "x", width) or _focal(shared, "y", height)
    both = {"cx": width / 2, "cy": height / 2, **shared, **frame}
    return fx, fx if fy is None else fy, _number(both, "cx"), _number(both, "cy")


def _focal(entry: Mapping[str, Any], axis: str, pixels: float) -> float | None:
    """Focal length in pixels, from itself or the opening angle: `(w/2) / tan(angle/2)`."""
    length, angle = f"fl_{axis}", f"camera_angle_{axis}"
    if length in entry:
        value = _number(entry, length)
        if value <= 0:
            raise ValueError(f"The key `{length}` must be positive, but is {value}.")
        return value
    if angle in entry:
        value = _number(entry, angle)
        if not 0 < value < math.pi:
            raise ValueError(f"The key `{angle}` must be between 0 and π radians, but is {value}.")
        return pixels / 2 / math.tan(value / 2)
    return None


# COLMAP


def _colmap(folder: Path) -> Iterator[tuple[str, Camera]]:
    """The cameras of a sparse model: `x_camera = R(q) x_world + t`."""
    lenses, shots, file = read_model(folder)
    for shot in shots:
        if shot.camera not in lenses:
            raise ValueError(
                f"The file {file} has the image {shot.name!r} of the camera {shot.camera}, which "
                "the file of the cameras lacks."
            )
        lens = lenses[shot.camera]
        _require_undistorted_lens(file.with_stem("cameras"), shot.camera, lens)
        with _naming(file, shot.name):
            rotation = _rotation(shot.quaternion)
        focals = (lens.parameters[0], lens.parameters[lens.model.focals - 1])
        center = lens.parameters[lens.model.focals : lens.model.focals + 2]
        size = (lens.width, lens.height)
        yield (
            shot.name,
            _camera(
                file, shot.name, rotation, np.asarray(shot.translation), (*focals, *center), size
            ),
        )


def _require_undistorted_lens(file: Path, number: int, lens: Lens) -> None:
    values = lens.parameters[lens.model.focals + 2 :]
    coefficients = dict(zip(lens.model.coefficients, values, strict=True))
    _require_pinhole(file, str(number), lens.model.name, coefficients, lens.model.fisheye)


def _rotation(quaternion: Sequence[float]) -> np.ndarray:
    """R of a quaternion wxyz of length 1 (to 1e-3: text files round)."""
    length = math.hypot(*quaternion)
    if not abs(length - 1) < 1e-3:
        raise ValueError(f"Its quaternion must have length 1, but has {length:.6g}.")
    w, x, y, z = (a / length for a in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
