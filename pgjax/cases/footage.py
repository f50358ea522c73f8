"""Recorded pictures and tracks: reading them, and finding what is missing or does not fit."""

import dataclasses
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from pgjax._files import is_folder, require_memory
from pgjax.render import load_image, load_video
from pgjax.result import SimulationWarning
from pgjax.scenes import SceneError
from pgjax.scenes.reader import Table, naming

# Bytes for a pixel of pictures: as bytes and in single precision.
_IN_MEMORY = 15
# No track shrinks further than this, if it is larger than so many bytes.
_REAL_RATIO, _SMALL = 100, 64 << 20


@dataclasses.dataclass(frozen=True)
class Footage:
    """Pictures of some frames.

    Attributes:
        label: for messages.
        numbers: of the frames, ascending, 0 for the initial state, `(n,)`.
        pictures: `(n, height, width, 3)`, in [0, 1].
    """

    label: str
    numbers: np.ndarray
    pictures: np.ndarray


def footage(t: Table, frame_rate: float, first: int, last: int, size: tuple[int, int]) -> Footage:
    """The pictures of a table with `video` or `frames`.

    Args:
        t: the table.
        frame_rate: of the case, 1/s; that of a video has to agree.
        first: number of the picture that shows the initial state, from 0.
        last: number of the last frame that is wanted.
        size: width and height of the camera, which the pictures must have.
    """
    video, folder = t.path("video", None), t.path("frames", None)
    if (video is None) == (folder is None):
        raise t.error("video", "be given, or `frames`, but not both")
    if video is not None:
        found = _from_video(t, t.existing_path("video"), frame_rate, first, last, size)
    else:
        found = _from_folder(t, t.existing_path("frames"), first, last, size)
    if not len(found.numbers):
        raise SceneError(f"{t.name}: there is no picture from number {first} on.")
    _tell_missing(t, found.numbers, last)
    return found


def _tell_missing(t: Table, numbers: np.ndarray, last: int) -> None:
    """Warn of frames that are not there."""
    missing = np.setdiff1d(np.arange(last + 1), numbers).tolist()
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (", …" if len(missing) > 8 else "")
        warnings.warn(
            f"{t.name}: {len(missing)} of {last + 1} frames are missing and left out: {shown}.",
            SimulationWarning,
            stacklevel=2,
        )


def _from_video(
    t: Table, path: Path, frame_rate: float, first: int, last: int, size: tuple[int, int]
) -> Footage:
    with naming(t.name):
        require_memory(path, _IN_MEMORY * (first + last + 1) * size[0] * size[1])
        film = load_video(path, first + last + 1, size)
    if abs(film.rate - frame_rate) > 1e-2 * frame_rate:
        raise SceneError(
            f"{t.name}: `video` must have the `frame_rate` of the case, {frame_rate:g} per second, "
            f"but {path.name} has {film.rate:g}."
        )
    numbers = film.numbers - first
    kept = (numbers >= 0) & (numbers <= last)
    return Footage(t.name, numbers[kept], film.pictures[kept].astype(np.float32) / 255)


def _from_folder(t: Table, folder: Path, first: int, last: int, size: tuple[int, int]) -> Footage:
    """Pictures whose names end with their numbers."""
    numbered = {}
    if not is_folder(folder):
        raise t.error("frames", "name a folder")
    for path in sorted(folder.iterdir()):
        match = re.search(r"([0-9]+)\.png$", path.name, flags=re.IGNORECASE)
        if match is None:
            continue
        number = int(match.group(1)) - first
        if number in numbered:
            raise SceneError(f"{t.name}: {numbered[number].name} and {path.name} have one number.")
        numbered[number] = path
    wanted = [number for number in sorted(numbered) if 0 <= number <= last]
    with naming(t.name):
        require_memory(folder, _IN_MEMORY * len(wanted) * size[0] * size[1])
        pictures = [_colours(load_image(numbered[number], size)) for number in wanted]
    stacked = np.stack(pictures) if pictures else np.zeros((0, 1, 1, 3), np.float32)
    return Footage(t.name, np.asarray(wanted, int), stacked)


def _colours(picture: np.ndarray) -> np.ndarray:
    """Red, green and blue of a picture, which may be grey or have an opacity."""
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    if picture.ndim != 3 or picture.shape[2] < 3:
        raise ValueError(f"a picture must be of grey or of colours, but has {picture.shape}")
    return picture[..., :3].astype(np.float32)


@dataclasses.dataclass(frozen=True)
class Track:
    """Positions of known particles.

    Attributes:
        numbers: of the frames, ascending, `(n,)`.
        x: m, `(n, k, 3)`; NaN where a particle was not seen.
        particles: which k particles.
    """

    numbers: np.ndarray
    x: np.ndarray
    particles: np.ndarray


def track(t: Table, count: int, last: int) -> Track:
    """A track from its file.

    Args:
        t: the table; its `file` is an .npz with `x` and, where they are not 0, 1, …, `particles`
            and `frames`.
        count: number of particles of the scene.
        last: number of the last frame that is wanted.
    """
    path = t.existing_path("file")
    try:
        arrays = _tracked(path)
    except Exception as error:  # Whatever is wrong with the file.
        raise t.error("file", f"be an .npz file ({type(error).__name__}: {error})") from error
    x: np.ndarray = arrays.get("x", np.zeros(0))
    if x.ndim != 3 or x.shape[2] != 3 or x.size == 0 or x.dtype.kind not in "fiu":
        found = ", ".join(f"{n} {a.shape} {a.dtype}" for n, a in arrays.items())
        raise t.error("file", f"hold numbers x of shape (frames, particles, 3) (it has {found})")
    numbers: np.ndarray = arrays.get("frames", np.arange(len(x)))
    particles: np.ndarray = arrays.get("particles", np.arange(x.shape[1]))
    if len(numbers.ravel()) != len(x) or len(particles.ravel()) != x.shape[1]:
        raise t.error(
            "file",
            f"hold one of `frames` per frame and of `particles` per particle of x {x.shape} (it "
            f"has {numbers.size} and {particles.size})",
        )
    numbers, particles = _whole(t, "frames", numbers), _whole(t, "particles", particles)
    if particles.max() >= count:
        raise t.error("file", f"hold numbers of `particles` from 0 to {count - 1}")
    _tell_missing(t, np.append(numbers, 0), min(int(numbers.max()), last))
    return Track(numbers, x, particles)


def _tracked(path: Path) -> dict[str, Any]:
    """The arrays of a track; what else the file holds is left alone, and no bomb is unpacked."""
    with path.open("rb") as stream, np.load(stream) as data:
        names = [name for name in ("x", "frames", "particles") if name in data.files]
        for name in names:
            info = data.zip.getinfo(f"{name}.npy")
            if info.file_size > max(_SMALL, _REAL_RATIO * info.compress_size):
                raise ValueError(f"{name} would take {info.file_size} bytes")
            require_memory(path, 2 * info.file_size)
        return {name: data[name] for name in names}


def _whole(t: Table, name: str, values: np.ndarray) -> np.ndarray:
    """Whole numbers from 0 on."""
    real = values.ndim == 1 and values.dtype.kind in "iuf"
    if not real or not ((values >= 0) & (values < 2**31) & (values % 1 == 0)).all():
        raise t.error("file", f"hold a list of whole numbers `{name}`, from 0 on")
    return values.astype(int)
