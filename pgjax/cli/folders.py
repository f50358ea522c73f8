"""Where commands write unless they are told: `out/NAME`, and a new one each time."""

from collections.abc import Iterator
from pathlib import Path


def next_folder(name: str) -> Path:
    """`out/NAME`, or `out/NAME-2`, `out/NAME-3` and so on where that is taken."""
    folder = Path("out") / name
    for number, taken in enumerate(folders(name), start=2):
        folder = taken.with_name(f"{name}-{number}")
    return folder


def folders(name: str) -> Iterator[Path]:
    """`out/NAME`, `out/NAME-2` and so on, as far as they hold anything."""
    folder, number = Path("out") / name, 1
    while folder.exists() and any(folder.iterdir()):
        yield folder
        number += 1
        folder = folder.with_name(f"{name}-{number}")
