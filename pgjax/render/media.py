"""Images and videos on disk."""

import os
import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, NamedTuple, cast, final

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
from jax.typing import ArrayLike

from pgjax._files import is_file, replacing, require_memory, with_suffix
from pgjax._types import require

# Bytes for a pixel: three numbers in double precision.
_IN_MEMORY = 24
# Options of the encoder. Colours of .mp4 follow BT.709 and say so, else players guess by the size.
_ENCODINGS = {
    ".mp4": [
        *("-vf", "scale=out_color_matrix=bt709", "-c:v", "libx264", "-crf", "18"),
        *("-pix_fmt", "yuv420p", "-movflags", "+faststart"),
        *("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"),
    ],
    # A palette for each frame: one for all would need the whole video in memory.
    ".gif": [
        *(
            "-filter_complex",
            "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1",
        ),
    ],
}


def save_image(path: str | os.PathLike[str], rgb: ArrayLike) -> None:
    """Write a PNG. Values below 0 or above 1 are clipped.

    Args:
        path: a name that ends with .png, in an existing folder.
        rgb: an image of shape (height, width, 3), floating, in [0, 1].
    """
    target = with_suffix(path, (".png",))
    pixels = _bytes("rgb", rgb)
    encoded: Any = imageio.imwrite("<bytes>", pixels, extension=".png")
    # By ourselves: on a full disk the writer would fail once more when it is forgotten.
    with replacing(target) as temporary:
        temporary.write_bytes(encoded)


def load_image(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> np.ndarray:
    """An image file as `save_image` takes it: shape (height, width, 3), floating, in [0, 1].

    What was read and is written again has the same pixels.

    Args:
        path: the file.
        size: width and height of the camera that saw it, compared before anything is unpacked.

    Raises:
        ValueError: the file is no image, or one of another size.
    """
    file = Path(path)
    if not is_file(file):
        raise ValueError(f"There is no file {file}.")
    try:
        with file.open("rb") as stream:
            height, width = imageio.improps(stream, extension=file.suffix).shape[:2]
            if size is not None and (width, height) != size:
                raise ValueError(f"it {_as_the_camera(size, (width, height))}")
            require_memory(file, _IN_MEMORY * width * height)
        # The reader has closed the first one.
        with file.open("rb") as stream:
            pixels = np.asarray(imageio.imread(stream, extension=file.suffix))
    except Exception as error:  # Whatever is wrong with the file.
        raise ValueError(f"The file {file} cannot be used as a picture: {error}.") from error
    largest = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    return pixels.astype(np.float64) / largest


def _as_the_camera(wanted: tuple[int, int], found: tuple[int, int]) -> str:
    """The rule that pictures have the size of their camera."""
    return (
        f"must have {wanted[0]} × {wanted[1]} pixels, the `width` and `height` of its camera, but "
        f"has {found[0]} × {found[1]}"
    )


class Film(NamedTuple):
    """A video that was read.

    Attributes:
        rate: frames per second.
        numbers: of the frames by their times, from 0: one that was dropped is missing, `(n,)`.
        pictures: `(n, height, width, 3)`, uint8.
    """

    rate: float
    numbers: np.ndarray
    pictures: np.ndarray


def load_video(
    path: str | os.PathLike[str], most: int | None = None, size: tuple[int, int] | None = None
) -> Film:
    """Read a video, its first `most` frames or all.

    Args:
        path: the file.
        most: how many frames are read; all if None.
        size: width and height of the camera that saw it, compared before anything is unpacked.

    Raises:
        ValueError: the file is not a video, cannot be decoded, or has another size.
    """
    file = Path(path)
    if not is_file(file):
        raise ValueError(f"Argument `path` must name a file, but there is no {file}.")
    limit = [] if most is None else ["-frames:v", str(most)]
    # Its header has size and rate in numbers, `YUV4MPEG2 W640 H480 F25:1 …`.
    header = _decoded(file, ["-frames:v", "1", "-pix_fmt", "yuv420p", "-f", "yuv4mpegpipe"])
    width, height, rate = _facts(file, header)
    if size is not None and (width, height) != size:
        raise ValueError(f"The file {file} {_as_the_camera(size, (width, height))}.")
    # As they are stored: ffmpeg would fill a gap with copies.
    each = ["-fps_mode", "passthrough"]
    raw = _decoded(file, [*limit, *each, "-f", "rawvideo", "-pix_fmt", "rgb24"])
    if len(raw) % (3 * width * height):
        raise ValueError(f"The file {file} must have frames of one size, but has others.")
    pictures = np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)
    seconds = _times(_decoded(file, [*limit, *each, "-f", "framecrc"]).decode("ascii", "replace"))
    return Film(rate, np.round((seconds - seconds[0]) * rate).astype(int), pictures)


def _facts(file: Path, header: bytes) -> tuple[int, int, float]:
    """Width, height and frames per second from the first line of a YUV4MPEG2."""
    words = header.partition(b"\n")[0].decode("ascii", "replace").split()
    facts = {word[:1]: word[1:] for word in words[1:]}
    try:
        number, _, by = facts["F"].partition(":")
        return int(facts["W"]), int(facts["H"]), int(number) / int(by)
    except (KeyError, ValueError, ZeroDivisionError):
        raise ValueError(f"The file {file} does not say its size and frame rate.") from None


def _times(listing: str) -> np.ndarray:
    """Times of the frames in a listing of ffmpeg's `framecrc`, s."""
    lines = listing.splitlines()
    base = next(line.split()[-1] for line in lines if line.startswith("#tb 0:"))
    numerator, _, denominator = base.partition("/")
    stamps = [int(line.split(",")[2]) for line in lines if line and not line.startswith("#")]
    return np.asarray(stamps) * int(numerator) / int(denominator)


def _decoded(file: Path, options: list[str]) -> bytes:
    """What ffmpeg makes of a video."""
    # A playlist may name what it likes: nothing is fetched from elsewhere.
    local = ["-protocol_whitelist", "file,pipe"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *local, "-i", str(file)]
    done = subprocess.run(
        [*command, "-map", "0:v:0", *options, "-"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
    )
    if done.returncode or not done.stdout:
        reason = done.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise ValueError(f"The file {file} is not a video that ffmpeg can read: {''.join(reason)}.")
    return done.stdout


def save_video(
    path: str | os.PathLike[str], frames: Iterable[ArrayLike], *, fps: float | int
) -> None:
    """Write frames as .mp4 or .gif; an iterator of frames is written as it is produced."""
    with VideoWriter(path, fps=fps) as video:
        for frame in frames:
            video.add(frame)


@final
class VideoWriter:
    """Writes a video frame by frame: `with VideoWriter(path, fps=24) as video: video.add(rgb)`.

    Frames go to the encoder as they are added, into a temporary file that becomes `path` when the
    block ends without an error. An .mp4 (H.264) needs even sizes: an odd one gains a copy of its
    last row or column.

    Args:
        path: a name that ends with .mp4 or .gif, in an existing folder.
        fps: frames per second. A .gif counts in hundredths of a second and is rounded to them.
    """

    def __init__(self, path: str | os.PathLike[str], *, fps: float | int):
        self._path = with_suffix(path, tuple(_ENCODINGS))
        require("fps", fps, "be positive and finite", lambda a: (a > 0) & np.isfinite(a))
        self._fps = float(fps)
        self._shape: tuple[int, ...] | None = None
        self._encoder: subprocess.Popen | None = None
        self._messages: Any = None
        self._temporary: Path | None = None
        self._stack = ExitStack()

    def __enter__(self) -> "VideoWriter":
        self._temporary = self._stack.enter_context(replacing(self._path))
        self._messages = self._stack.enter_context(tempfile.TemporaryFile())
        return self

    def add(self, rgb: ArrayLike) -> None:
        """Append an image of shape (height, width, 3), floating, in [0, 1] (else clipped)."""
        if self._temporary is None:
            raise ValueError("Frames can be added to a `VideoWriter` only inside its `with` block.")
        pixels = _bytes("rgb", rgb)
        if self._shape is not None and pixels.shape != self._shape:
            raise ValueError(
                f"Argument `rgb` must have the shape {self._shape} of the first frame, "
                f"but has {pixels.shape}."
            )
        self._shape = pixels.shape
        if self._path.suffix.lower() == ".mp4":
            odd = [(0, size % 2) for size in pixels.shape[:2]]
            pixels = np.pad(pixels, [*odd, (0, 0)], mode="edge")
        if self._encoder is None:
            self._encoder = self._start(pixels.shape[1], pixels.shape[0])
        try:
            cast(IO[bytes], self._encoder.stdin).write(pixels.tobytes())
        except OSError as error:
            raise RuntimeError(f"Encoding {self._path} failed: {self._log()}") from error

    def _start(self, width: int, height: int) -> subprocess.Popen:
        """The encoder, reading raw frames from a pipe."""
        command = [
            *(imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y"),
            *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"),
            *("-r", f"{self._fps:.6f}", "-i", "-", *_ENCODINGS[self._path.suffix.lower()]),
            str(self._temporary),
        ]
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._messages,
            # Ctrl-C is for us: the encoder is stopped in order.
            start_new_session=True,
        )

    def _log(self) -> str:
        self._messages.seek(0)
        return self._messages.read().decode(errors="replace").strip()

    def __exit__(self, *error: Any) -> None:
        # Whatever is raised inside makes `replacing` delete the temporary file.
        with self._stack:
            self._temporary = None
            encoder, self._encoder = self._encoder, None
            if encoder is not None:
                encoder.communicate()
            if error[0] is not None:
                raise error[1]
            if encoder is None:
                raise ValueError(
                    f"The video {self._path} must have at least one frame, but has none."
                )
            if encoder.returncode:
                raise RuntimeError(f"Encoding {self._path} failed: {self._log()}")


def _bytes(name: str, rgb: ArrayLike) -> np.ndarray:
    """A floating image in [0, 1] as 8-bit numbers."""
    image = np.asarray(rgb)
    if image.ndim != 3 or image.shape[-1] != 3 or 0 in image.shape:
        raise ValueError(
            f"Argument `{name}` must have shape (height, width, 3), but has {image.shape}."
        )
    if not np.issubdtype(image.dtype, np.floating):
        raise ValueError(f"Argument `{name}` must be floating in [0, 1], but is {image.dtype}.")
    broken = np.count_nonzero(~np.isfinite(image).all(axis=-1))
    if broken:
        raise ValueError(f"Argument `{name}` must be finite, but {broken} pixels are not.")
    return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
