"""Recorded pictures and tracks: reading them, and finding what is missing or does not fit."""

import dataclasses
import re
import warnings
from pathlib import Path

import numpy as np

from pgjax.render import load_image, load_video
from pgjax.result import SimulationWarning
from pgjax.scenes import SceneError
from pgjax.scenes.reader import Table, naming


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


def footage(t: Table, frame_rate: float, first: int, last: int) -> Footage:
    """The pictures of a table with `video` or `frames`.

    Args:
        t: the table.
        frame_rate: of the case, 1/s; that of a video has to agree.
        first: number of the picture that shows the initial state, from 0.
        last: number of the last frame that is wanted.
    """
    video, folder = t.path("video", None), t.path("frames", None)
    if (video is None) == (folder is None):
        raise t.error("video", "be given, or `frames`, but not both")
    if video is not None:
        found = _from_video(t, t.existing_path("video"), frame_rate, first, last)
    else:
        found = _from_folder(t, t.existing_path("frames"), first, last)
    if not len(found.numbers):
        raise SceneError(f"{t.name}: there is no picture from number {first} on.")
    _tell_missing(t, found.numbers, last)
    return found


def _tell_missing(t: Table, numbers: np.ndarray, last: int) -> None:
    """Warn of frames that are not there."""
    missing = sorted(set(range(last + 1)) - set(numbers.tolist()))
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (", …" if len(missing) > 8 else "")
        warnings.warn(
            f"{t.name}: {len(missing)} of {last + 1} frames are missing and left out: {shown}.",
            SimulationWarning,
            stacklevel=2,
        )


def _from_video(t: Table, path: Path, frame_rate: float, first: int, last: int) -> Footage:
    with naming(t.name):
        film = load_video(path, first + last + 1)
    if abs(film.rate - frame_rate) > 1e-2 * frame_rate:
        raise SceneError(
            f"{t.name}: `video` must have the `frame_rate` of the case, {frame_rate:g} per second, "
            f"but {path.name} has {film.rate:g}."
        )
    numbers = film.numbers - first
    kept = (numbers >= 0) & (numbers <= last)
    return Footage(t.name, numbers[kept], film.pictures[kept].astype(np.float32) / 255)


def _from_folder(t: Table, folder: Path, first: int, last: int) -> Footage:
    """Pictures whose names end with their numbers."""
    numbered = {}
    for path in sorted(folder.iterdir()):
        match = re.search(r"(\d+)\.png$", path.name, flags=re.IGNORECASE)
        if match is None:
            continue
        number = int(match.group(1)) - first
        if number in numbered:
            raise SceneError(f"{t.name}: {numbered[number].name} and {path.name} have one number.")
        numbered[number] = path
    wanted = [number for number in sorted(numbered) if 0 <= number <= last]
    pictures = []
    for number in wanted:
        picture = load_image(numbered[number])
        if picture.ndim == 2:
            picture = np.repeat(picture[..., None], 3, axis=2)
        picture = picture[..., :3]
        if pictures and picture.shape != pictures[0].shape:
            raise SceneError(
                f"{t.name}: all pictures must have one size, but {numbered[number].name} has "
                f"{picture.shape[1]} × {picture.shape[0]} pixels and {numbered[wanted[0]].name} "
                f"{pictures[0].shape[1]} × {pictures[0].shape[0]}."
            )
        pictures.append(picture.astype(np.float32))
    stacked = np.stack(pictures) if pictures else np.zeros((0, 1, 1, 3), np.float32)
    return Footage(t.name, np.asarray(wanted, int), stacked)


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
        with np.load(path) as data:
            arrays = {name: data[name] for name in data.files}
    except Exception as error:  # Whatever is wrong with the file.
        raise t.error("file", f"be an .npz file ({type(error).__name__}: {error})") from error
    if "x" not in arrays or arrays["x"].ndim != 3 or arrays["x"].shape[2] != 3:
        found = ", ".join(f"{n} {a.shape}" for n, a in arrays.items())
        raise t.error("file", f"hold an array x of shape (frames, particles, 3) (it has {found})")
    x = arrays["x"]
    numbers = arrays.get("frames", np.arange(len(x)))
    particles = arrays.get("particles", np.arange(x.shape[1]))
    if len(numbers) != len(x) or len(particles) != x.shape[1]:
        raise t.error(
            "file",
            f"hold one of `frames` per frame and of `particles` per particle of x {x.shape} (it "
            f"has {len(numbers)} and {len(particles)})",
        )
    if np.max(particles) >= count or np.min(particles) < 0:
        raise t.error("file", f"hold numbers of `particles` from 0 to {count - 1}")
    _tell_missing(t, np.append(numbers, 0), min(int(np.max(numbers)), last))
    return Track(np.asarray(numbers, int), x, np.asarray(particles, int))
