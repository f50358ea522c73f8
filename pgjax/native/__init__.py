"""Kernels in C++ for CPUs, called by XLA: compiled on first use, kept in a cache.

The cache is `$PGJAX_CACHE_DIR`, else `$XDG_CACHE_HOME/pgjax`, else `~/.cache/pgjax`. A library is
found by what it was made from (sources, options, compiler, jaxlib, CPU) and loaded only if its
contents are those that were written, so one from another machine or version is never used.
Without a compiler, or with `PGJAX_NATIVE=0`, everything runs in plain JAX.
"""

import ctypes
import dataclasses
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import threading
import warnings
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.sharding import NamedSharding, PartitionSpec

from pgjax._types import Array

# What each source holds.
HANDLERS = {
    "exchange": ("send", "velocities", "velocities_tangent", "receive"),
    "exchange_tangent": ("send_tangent", "receive_tangent"),
    "exchange_pull": ("send_pull", "velocities_pull", "receive_pull"),
    "transfer": ("scatter", "scatter_tangent", "gather", "gather_tangent", "pull"),
    "eigen": ("eigenbasis", "svd"),
    "laws": ("neo_hookean", "fixed_corotated", "stvk_hencky", "von_mises", "drucker_prager"),
    "raster": ("composite", "composite_tangent", "composite_adjoint"),
}
_OPTIONS = ("-std=c++17", "-O3", "-march=native", "-fno-math-errno", "-fPIC", "-shared")
_COMPILERS = ("c++", "g++", "clang++")
_HERE = Path(__file__).parent
_lock = threading.Lock()


class NativeWarning(UserWarning):
    """The native kernels cannot be used; results are the same, only slower."""


@dataclasses.dataclass(frozen=True)
class Library:
    """A loaded library: which targets XLA knows its handlers by, and where it lies."""

    path: Path
    targets: dict[str, str]


def library(source: str, dtype: str, dimension: int = 3) -> Library | None:
    """The kernels of a source ("transfer", "eigen") for "float32" or "float64"; None without."""
    if not enabled() or dtype not in ("float32", "float64"):
        return None
    with _lock:
        return _library(source, dtype, dimension)


def enabled() -> bool:
    """Whether native kernels are wanted: unless `PGJAX_NATIVE=0`."""
    return os.environ.get("PGJAX_NATIVE", "1") != "0"


def available() -> bool:
    """Whether they will be used: wanted, on a CPU, and there is a compiler (not yet tried)."""
    return enabled() and compiler() is not None and jax.default_backend() == "cpu"


def cache_folder() -> Path:
    """Where compiled libraries are kept."""
    if own := os.environ.get("PGJAX_CACHE_DIR"):
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "pgjax"


@functools.cache
def compiler() -> str | None:
    """The C++ compiler: `$CXX`, or the first of c++, g++, clang++ that is installed."""
    for name in (os.environ.get("CXX"), *_COMPILERS):
        if name and (found := shutil.which(name)):
            return found
    return None


@functools.cache
def _library(source: str, dtype: str, dimension: int) -> Library | None:
    found = compiler()
    if found is None:
        _warn("no C++ compiler was found (install g++ or clang++, or set CXX)")
        return None
    options = (*_OPTIONS, f"-DPGJAX_D={dimension}")
    if dtype == "float64":
        options = (*options, "-DPGJAX_DOUBLE")
    try:
        key = _key(found, options, source)
        path = _built(found, options, source, key)
        loaded = ctypes.CDLL(str(path))
        handlers = {name: getattr(loaded, f"pgjax_{name}") for name in HANDLERS[source]}
    except (OSError, RuntimeError, AttributeError, subprocess.SubprocessError) as error:
        detail = getattr(error, "stderr", None) or str(error)
        lines = [line for line in detail.splitlines() if "error" in line] or [detail]
        _warn(
            f"building or loading them with {found} in the folder PGJAX_CACHE_DIR failed: "
            f"{' '.join(lines)[:500]}"
        )
        return None
    # The key is part of the name: a program that JAX kept in its cache never meets a kernel other
    # than its own.
    targets = {name: f"pgjax_{name}_{dtype}_{dimension}d_{key[:12]}" for name in handlers}
    for name, handler in handlers.items():
        jax.ffi.register_ffi_target(targets[name], jax.ffi.pycapsule(handler), platform="cpu")
    return Library(path, targets)


@functools.cache
def _warn(reason: str) -> None:
    """Once, although there are several libraries."""
    warnings.warn(
        f"pgjax runs in plain JAX, several times slower: {reason}. "
        f"Set PGJAX_NATIVE=0 to do so without this message.",
        NativeWarning,
        stacklevel=2,
    )


def _key(found: str, options: tuple[str, ...], source: str) -> str:
    """A digest of everything the machine code depends on."""
    digest = hashlib.sha256()
    made_by = _run_compiler([found, "--version"])
    facts = (*options, version("jaxlib"), platform.machine(), platform.system(), _cpu())
    for fact in (made_by, *facts):
        digest.update(fact.encode() + b"\0")
    for file in (*sorted(_HERE.glob("*.h")), _HERE / f"{source}.cc"):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _cpu() -> str:
    """Model and instruction sets of the CPU, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
    except OSError:
        return platform.processor()
    return "\n".join(line for line in lines if line.startswith(("model name", "flags", "Features")))


def _built(found: str, options: tuple[str, ...], source: str, key: str) -> Path:
    """The library for a key: from the cache if it is whole, else compiled into it."""
    folder = cache_folder()
    path, seal = folder / f"{key}.so", folder / f"{key}.sha256"
    if _whole(path, seal):
        return path
    folder.mkdir(parents=True, exist_ok=True)
    # Built beside its place and moved there whole: other processes may do the same just now.
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        new = Path(scratch) / path.name
        code = str(_HERE / f"{source}.cc")
        command = [found, *options, f"-I{jax.ffi.include_dir()}", code, "-o", str(new)]
        _run_compiler(command)
        mark = Path(scratch) / seal.name
        mark.write_bytes(_contents(new))
        # What another process has put there meanwhile may be in use.
        if not _whole(path, seal):
            os.replace(new, path)
            os.replace(mark, seal)
    return path


def _whole(path: Path, seal: Path) -> bool:
    return path.is_file() and seal.is_file() and seal.read_bytes() == _contents(path)


def _contents(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).hexdigest().encode()


def _run_compiler(command: list[str]) -> str:
    run = subprocess.run(command, capture_output=True, text=True, errors="replace", check=True)
    return run.stdout


def result_type(like: ShapedArray, shape: tuple[int, ...]) -> ShapedArray:
    """The type of a result: that of an operand but for its shape, inside `shard_map` too."""
    spec = PartitionSpec(*(None,) * len(shape))
    return like.update(shape=shape, sharding=NamedSharding(like.sharding.mesh, spec))


def varying(*operands: Array) -> tuple[Array, ...]:
    """Inside `shard_map`, all operands of a primitive made to vary over the same mesh axes."""
    own = [jax.typeof(a).manual_axis_type.varying for a in operands]
    everywhere = frozenset[Any]().union(*own)
    return tuple(
        jax.lax.pcast(a, tuple(everywhere - axes), to="varying") if axes != everywhere else a
        for a, axes in zip(operands, own, strict=True)
    )


def run(primitive: Primitive, *operands: Any, **static: Any) -> Any:
    """Run a primitive outside of `jit`; compiled also where a user has switched that off."""
    with jax.disable_jit(False):
        return _compiled(primitive, tuple(sorted(static.items())))(*operands)


@functools.cache
def _compiled(primitive: Primitive, static: tuple[tuple[str, Any], ...]) -> Callable[..., Any]:
    return jax.jit(functools.partial(primitive.bind, **dict(static)))
