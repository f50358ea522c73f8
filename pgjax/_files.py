"""Writing a file so that it is there complete, or not at all."""

import contextlib
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
