"""Files: written so that they are there complete or not at all, read without trust in them."""

import contextlib
import math
import os
import uuid
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it on success and deleted on failure.

    The name keeps the suffix, from which writers tell the format. What was at `path` stays as it is
    until the new file is complete.
    """
    target = writable(path)
    temporary = target.with_name(f".{target.stem}-{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def writable(path: str | os.PathLike[str]) -> Path:
    """The path, if it can name a file: its folder exists and it is not a folder itself."""
    target = Path(path)
    if not target.parent.is_dir():
        raise ValueError(
            f"Argument `path` must lie in an existing folder, but there is no {target.parent}."
        )
    if target.is_dir():
        raise ValueError(f"Argument `path` must name a file, but {target} is a folder.")
    return target


def with_suffix(path: str | os.PathLike[str], suffixes: tuple[str, ...]) -> Path:
    """The path, if it is writable and ends with one of the suffixes (in any case)."""
    target = writable(path)
    if target.suffix.lower() not in suffixes:
        raise ValueError(
            f"Argument `path` must end with {' or '.join(suffixes)}, but is {target.name!r}."
        )
    return target


def read_text(file: Path, most: int) -> str:
    """The text of a file in UTF-8; a `ValueError` if it is none or takes more than `most` bytes."""
    with file.open("rb") as stream:
        raw = stream.read(most + 1)
    if len(raw) > most:
        raise ValueError(f"it is larger than {most >> 20} MiB")
    return raw.decode("utf-8")


def require_memory(file: Path, size: int) -> None:
    """Refuse a file whose content, unpacked, takes more bytes than this machine has."""
    if size > memory():
        raise ValueError(
            f"The file {file} is too large: its content takes {size / 2**30:.3g} GiB of memory, "
            f"but there are {memory() / 2**30:.3g}."
        )


def memory() -> float:
    """Bytes of memory of this machine; infinity where the system does not say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return math.inf


def cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def is_file(path: Path) -> bool:
    """Whether there is an ordinary file, no pipe or device; what cannot be a path is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether there is a folder; what cannot be a path is none."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False
