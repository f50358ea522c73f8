"""Reading the files `cameras` and `images` of a sparse model of COLMAP, as text or binary.

Reference: COLMAP documentation, "Output Format".
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn


class Model(NamedTuple):
    """A camera model: its parameters are the focal lengths, cx, cy, and the coefficients.

    A fisheye is no pinhole even if all its coefficients are zero: the image radius then grows with
    the angle, not with its tangent.
    """

    name: str
    focals: int
    coefficients: tuple[str, ...] = ()
    fisheye: bool = False


# In the order of COLMAP's numbers.
MODELS = (
    Model("SIMPLE_PINHOLE", 1),
    Model("PINHOLE", 2),
    Model("SIMPLE_RADIAL", 1, ("k",)),
    Model("RADIAL", 1, ("k1", "k2")),
    Model("OPENCV", 2, ("k1", "k2", "p1", "p2")),
    Model("OPENCV_FISHEYE", 2, ("k1", "k2", "k3", "k4"), fisheye=True),
    Model("FULL_OPENCV", 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    Model("FOV", 2, ("omega",)),
    Model("SIMPLE_RADIAL_FISHEYE", 1, ("k",), fisheye=True),
    Model("RADIAL_FISHEYE", 1, ("k1", "k2"), fisheye=True),
    Model(
        "THIN_PRISM_FISHEYE", 2, ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), fisheye=True
    ),
)


class Lens(NamedTuple):
    """A camera without its pose."""

    model: Model
    width: int
    height: int
    parameters: Sequence[float]


class Shot(NamedTuple):
    """An image: `x_camera = R(q) x_world + t`, with the number of its camera."""

    name: str
    camera: int
    quaternion: Sequence[float]
    translation: Sequence[float]


def read_model(folder: Path) -> tuple[dict[int, Lens], list[Shot], Path]:
    """Cameras by number, images in their order, and the file that holds the images.

    Raises:
        ValueError: neither both binary nor both text files are there, or one is wrong.
    """
    for suffix, cameras, images in (
        (".bin", _binary_cameras, _binary_images),
        (".txt", _text_cameras, _text_images),
    ):
        files = folder / f"cameras{suffix}", folder / f"images{suffix}"
        if all(file.is_file() for file in files):
            return _unique(files[0], cameras(files[0])), list(images(files[1])), files[1]
    raise ValueError(
        f"The folder {folder} is not a sparse model of COLMAP: it has neither cameras.bin and "
        "images.bin nor cameras.txt and images.txt (often they are in its sub-folder sparse/0)."
    )


def _unique(file: Path, pairs: Iterator[tuple[int, Lens]]) -> dict[int, Lens]:
    lenses: dict[int, Lens] = {}
    for number, lens in pairs:
        if number in lenses:
            raise ValueError(f"The file {file} has two cameras of the number {number}.")
        lenses[number] = lens
    return lenses


# Binary files, little endian


class _Bytes:
    """What is left to read of a binary file."""

    def __init__(self, file: Path):
        self.file, self.data, self.at = file, file.read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values, of a layout of `struct`."""
        start = self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def skip(self, size: int) -> int:
        """Pass over some bytes; the place where they begin."""
        start = self.at
        if start + size > len(self.data):
            raise ValueError(
                f"The file {self.file} is truncated: {size} bytes are missing or incomplete after "
                f"byte {start} of {len(self.data)}."
            )
        self.at += size
        return start

    def text(self) -> str:
        """The text up to the next zero byte."""
        length = self.data.find(b"\0", self.at) - self.at
        if length < 0:
            raise ValueError(f"The file {self.file} is truncated within a name.")
        start = self.skip(length + 1)
        return self.data[start : start + length].decode("utf-8", errors="replace")

    def finish(self) -> None:
        """Refuse a file that goes on."""
        if self.at < len(self.data):
            raise ValueError(
                f"The file {self.file} goes on after the last entry: it has {len(self.data)} "
                f"bytes, of which {self.at} are described."
            )


def _binary_cameras(file: Path) -> Iterator[tuple[int, Lens]]:
    data = _Bytes(file)
    (count,) = data.take("Q")
    for _ in range(count):
        number, model_number, width, height = data.take("IiQQ")
        if not 0 <= model_number < len(MODELS):
            raise ValueError(
                f"The file {file} has the camera {number} of the unknown model {model_number}."
            )
        model = MODELS[model_number]
        parameters = data.take(f"{_parameters(model)}d")
        yield number, Lens(model, width, height, parameters)
    data.finish()


def _binary_images(file: Path) -> Iterator[Shot]:
    data = _Bytes(file)
    (count,) = data.take("Q")
    for _ in range(count):
        _, *pose, camera = data.take("I7dI")
        name = data.text()
        (points,) = data.take("Q")
        # Two coordinates and the number of the point in space.
        data.skip(24 * points)
        yield Shot(name, camera, pose[:4], pose[4:])
    data.finish()


# Text files


def _text_cameras(file: Path) -> Iterator[tuple[int, Lens]]:
    models = {model.name: model for model in MODELS}
    for line in _lines(file):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 4:
            _refuse(file, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]")
        number, width, height = _numbers(file, line, int, [words[0], *words[2:4]])
        parameters = _numbers(file, line, float, words[4:])
        if words[1] not in models:
            raise ValueError(
                f"The file {file} has the camera {number} of the unknown model {words[1]}."
            )
        model = models[words[1]]
        if len(parameters) != _parameters(model):
            raise ValueError(
                f"The file {file} must have {_parameters(model)} parameters for the camera "
                f"{number} of the model {model.name}, but has {len(parameters)}."
            )
        yield number, Lens(model, width, height, parameters)


def _text_images(file: Path) -> Iterator[Shot]:
    """Each image takes two lines, of which the second (its points) may be empty."""
    lines = _lines(file)
    for line in lines:
        words = line.split(maxsplit=9)
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            _refuse(file, line, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        pose = _numbers(file, line, float, words[1:8])
        (camera,) = _numbers(file, line, int, words[8:9])
        _require_points(file, next(lines, ""))
        yield Shot(words[9].strip(), camera, pose[:4], pose[4:])


def _require_points(file: Path, line: str) -> None:
    """Refuse a line that is not `X Y POINT3D_ID` repeated: were it an image, it would be lost."""
    words = line.split()
    if len(words) % 3 or not all(word.removeprefix("-").isdigit() for word in words[2::3]):
        _refuse(file, line, "POINTS2D[] as (X, Y, POINT3D_ID), or nothing, after each image")


def _lines(file: Path) -> Iterator[str]:
    return iter(file.read_text(encoding="utf-8", errors="replace").splitlines())


def _numbers(file: Path, line: str, kind: Callable[[str], Any], words: list[str]) -> list[Any]:
    try:
        return [kind(word) for word in words]
    except ValueError:
        _refuse(file, line, "numbers where the format has them")


def _refuse(file: Path, line: str, rule: str) -> NoReturn:
    shown = line if len(line) <= 80 else line[:80] + "…"
    raise ValueError(f"The file {file} must have {rule}, but has the line {shown!r}.")


def _parameters(model: Model) -> int:
    return model.focals + 2 + len(model.coefficients)
