"""One image in all codes: the pictures are compared, then everything is timed in turns."""

import contextlib
import dataclasses
import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.render.cases import QUANTITIES, Case
from benchmarks.speed.processes import Process, Refused
from benchmarks.speed.table import note

MODULE = "benchmarks.render.worker"
OWN, PEER = "pgjax", "PyTorch"
# Of colours between 0 and 1, for all but one in a thousand; single precision gives up to 1e-5.
BOUND = 1e-4
# Seconds of a pass of the peer above which it is left out, or its first call is the only one.
TOO_LONG, LONG = 60.0, 10.0


@dataclasses.dataclass
class Record:
    """Numbers of one image; those by code and quantity are `values[code][quantity]`.

    Attributes:
        scene: a name of `cases.SCENES`.
        size: rows and columns of the image.
        threads: number of threads.
        gaussians: how many there are.
        pairs_per_pixel: pairs of a Gaussian and a pixel in the tiles of 8² pixels it touches.
        milliseconds: medians.
        rounds: number of times each median is of.
        peak: bytes by which the process grows at most in one call, its result included.
        temporary: bytes of XLA's temporary arrays, without what the kernels allocate.
        compilation: seconds.
        off: differences between the codes.
        left_out: passes of the peer that take too long or fail, and why.
    """

    scene: str
    size: int
    threads: int
    gaussians: int
    pairs_per_pixel: float
    milliseconds: dict[str, dict[str, float]]
    rounds: dict[str, dict[str, int]]
    peak: dict[str, dict[str, float]]
    temporary: dict[str, float]
    compilation: dict[str, float]
    off: dict[str, float]
    left_out: dict[str, str]

    def ratio(self, quantity: str) -> float | None:
        """Time of the peer over that of pgjax."""
        peer = self.milliseconds.get(PEER, {}).get(quantity)
        return None if peer is None else peer / self.milliseconds[OWN][quantity]


def measure(case: Case, threads: int, peer: bool, rounds: int, clock: str, pictures: str) -> Record:
    """All numbers of one image; `clock` is one of `worker.CLOCKS`."""
    # Times of compiling are those without a cache of programs.
    environment = {"JAX_COMPILATION_CACHE_DIR": None}
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        own = stack.enter_context(Process(threads, environment, MODULE))
        own.ask("prepare", code="pgjax", **dataclasses.asdict(case))
        compiled = {
            quantity: own.ask("compile", quantity=quantity, clock=clock) for quantity in QUANTITIES
        }
        running = {OWN: own}
        first = {OWN: {q: _first(own, OWN, q, clock, folder) for q in QUANTITIES}}
        off, left_out = {}, {}
        if peer:
            own.ask("export", file=str(folder / "scene.npz"))
            running[PEER] = stack.enter_context(Process(threads, environment, MODULE))
            first[PEER], off, left_out = _try_peer(running[PEER], clock, folder)
        seconds = _rounds(running, first, clock, rounds)
        facts = own.ask("facts")
        if pictures:
            own.ask("picture", folder=pictures)
    return Record(
        scene=case.scene,
        size=case.size,
        threads=threads,
        gaussians=facts["gaussians"],
        pairs_per_pixel=facts["pairs per pixel"],
        milliseconds=_each(seconds, lambda times: 1e3 * statistics.median(times)),
        rounds=_each(seconds, len),
        peak={
            code: {q: found["peak"] for q, found in runs.items() if "peak" in found}
            for code, runs in first.items()
        },
        temporary={q: found["temporary"] for q, found in compiled.items()},
        compilation={q: found["compilation"] for q, found in compiled.items()},
        off=off,
        left_out=left_out,
    )


def _each(values: dict[str, dict[str, list[float]]], function: Any) -> dict[str, dict[str, Any]]:
    return {c: {q: function(times) for q, times in runs.items()} for c, runs in values.items()}


def _first(
    process: Process, code: str, quantity: str, clock: str, folder: Path
) -> dict[str, float]:
    """The first calls of a compiled program, whose result is kept in a file."""
    file = str(folder / f"{code}_{quantity}.npz")
    return process.ask("first_run", quantity=quantity, clock=clock, file=file, repeat=LONG)


def _try_peer(
    process: Process, clock: str, folder: Path
) -> tuple[dict, dict[str, float], dict[str, str]]:
    """First calls of what is worth timing, differences from pgjax, and what is left out."""
    found: dict[str, dict[str, float]] = {}
    off: dict[str, float] = {}
    left_out: dict[str, str] = {}
    try:
        process.ask("prepare", code="torch", file=str(folder / "scene.npz"))
    except Refused as error:
        return {}, {}, dict.fromkeys(QUANTITIES, str(error))
    for quantity in QUANTITIES:
        try:
            run = _first(process, PEER, quantity, clock, folder)
        except Refused as error:
            left_out[quantity] = str(error)
            continue
        off |= differences(quantity, folder)
        if quantity == "forward" and not off["image, 99.9 %"] <= BOUND:
            return {}, off, dict.fromkeys(QUANTITIES, "the picture is another one")
        if run["seconds"] > TOO_LONG:
            left_out[quantity] = f"one pass takes {run['seconds']:.0f} s"
        else:
            found[quantity] = run
    if process.process.poll() is not None:
        # It has not survived one of them, for want of memory.
        found, left_out = {}, dict.fromkeys(QUANTITIES, "its process is gone") | left_out
    return found, off, left_out


def differences(quantity: str, folder: Path) -> dict[str, float]:
    """Of the results in the two files: by pixel, or of derivatives relative in the 2-norm."""
    with (
        np.load(folder / f"{OWN}_{quantity}.npz") as own,
        np.load(folder / f"{PEER}_{quantity}.npz") as peer,
    ):
        if quantity == "forward":
            far = np.abs(own[quantity] - peer[quantity])
            return {
                "image, most": float(far.max()),
                "image, 99.9 %": float(np.quantile(far, 0.999)),
            }
        names = [name for name in own.files if name not in ("forward", "value")]
        parts = [np.linalg.norm(own[n] - peer[n]) / np.linalg.norm(own[n]) for n in names]
        return {quantity: float(max(parts))}


def _rounds(
    running: dict[str, Process],
    first: dict[str, dict[str, dict[str, float]]],
    clock: str,
    rounds: int,
) -> dict[str, dict[str, list[float]]]:
    """Seconds of every round; in each, quantity by quantity, the codes take turns."""
    slow = {q for q, run in first.get(PEER, {}).items() if run["seconds"] > LONG}
    times: dict[str, dict[str, list[float]]] = {c: {q: [] for q in first[c]} for c in first}
    for quantity in slow:
        times[PEER][quantity] = [first[PEER][quantity]["seconds"]]
    for _ in range(rounds):
        for quantity in QUANTITIES:
            for code, runs in first.items():
                if quantity in runs and not (code == PEER and quantity in slow):
                    seconds = running[code].ask("seconds", quantity=quantity, clock=clock)
                    times[code][quantity].append(seconds)
    return times


def tell(record: Record) -> None:
    """Say what was found."""
    text = f"{record.scene}, {record.size}², {record.threads} thread(s):"
    for code, runs in record.milliseconds.items():
        text += f" {code} " + ", ".join(f"{q} {ms:.4g} ms" for q, ms in runs.items()) + ";"
    note(text)
    for quantity, reason in record.left_out.items():
        note(f"{record.scene}, {record.size}²: {PEER}, {quantity}, left out: {reason}")
