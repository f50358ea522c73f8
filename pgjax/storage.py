"""States and trajectories on disk: `.npz` files that are there complete, or not at all.

A file holds one array for each leaf, under a readable name (`v`, `history.0`, `status.first`),
uncompressed, and a line that says what it is and of which version. `numpy.load` reads it, too.
Nothing is ever pickled.
"""

import contextlib
import dataclasses
import functools
import hashlib
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._archive import FORMAT, NUMBERS, VERSION, Entry, Found, opened
from pgjax._files import replacing, with_suffix
from pgjax._types import concrete
from pgjax.scene import Scene, initial_state
from pgjax.simulate import Trajectory
from pgjax.state import State


def save_state(path: str | os.PathLike[str], state: State) -> None:
    """Write a state, every field exactly as it is, the step counter and the status included.

    Args:
        path: a name that ends with .npz, in an existing folder. What was there is replaced once
            the new file is complete.
        state: one state (`trajectory.final`, say), not a batch and not one being traced.

    Raises:
        ValueError: the path cannot be written, or the state is a batch or is being traced.
    """
    arrays = _leaves("state", state)
    if arrays["v"].ndim != 2:
        raise ValueError(
            f"Argument `state` must be one state with velocities of shape (p, d), but is a batch "
            f"with velocities of shape {arrays['v'].shape}: save each member."
        )
    _write(path, "state", arrays)


def load_state(path: str | os.PathLike[str], scene: Scene) -> State:
    """Read a state that `save_state` wrote, for the scene it belongs to.

    `simulate` goes on from it as if it had never stopped; on the CPU the result is the same to
    the last bit. What belongs to the scene (materials, volumes, walls) is not in the file.

    Args:
        path: the file.
        scene: the scene of the state: number of particles, dimension, what its materials
            remember and the origin of its grid are compared before any large array is read.

    Raises:
        ValueError: the file is missing, damaged, of another version or another scene, or in
            double precision where that is switched off.
    """
    with opened(path, "state") as found:
        like = _matching(found, scene)
        _require_origin(found, scene, np.dtype(like.origin.dtype))
        leaves = [jnp.asarray(found.read(name)) for name in _entries(like)]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def save_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write the times, what was saved of each frame, and the status of a rollout.

    The names are `t`, `status.first`, `status.count` and those of the leaves of
    `trajectory.saved`: `x`, `v`, `F` by default, the path to the leaf for any other tree
    (`energy.kinetic`, `0`), `saved` where it is one array. A leaf whose name is taken gets
    `saved.` before it. The final state is not in the file: see `save_state`.

    Args:
        path: a name that ends with .npz, in an existing folder.
        trajectory: one rollout, not a batch and not one being traced.

    Raises:
        ValueError: the path cannot be written, the trajectory is a batch or is being traced, or
            what was saved are not numbers.
    """
    arrays = _leaves("trajectory", {"t": trajectory.t, "status": trajectory.status})
    if arrays["t"].ndim != 1:
        raise ValueError(
            f"Argument `trajectory` must be one rollout with times of shape (frames + 1,), but is "
            f"a batch with times of shape {arrays['t'].shape}: save each member."
        )
    for name, array in _leaves("trajectory", trajectory.saved, "saved").items():
        free = name if name not in arrays and name != FORMAT else f"saved.{name}"
        if free in arrays:
            raise ValueError(
                f"Argument `trajectory` must have saved values with different names, but two are "
                f"called `{name}`."
            )
        arrays[free] = array
    _write(path, "trajectory", arrays)


def load_trajectory(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Read what `save_trajectory` wrote: an array for each name, on the host.

    Raises:
        ValueError: the file is missing, damaged, of another version, or not a trajectory.
    """
    with opened(path, "trajectory") as found:
        if "t" not in found.entries or len(found.entries["t"].shape) != 1:
            raise found.refused("have times `t`, one for each frame", "has none")
        frames = found.entries["t"].shape
        for name, entry in found.entries.items():
            if not name.startswith("status.") and entry.shape[:1] != frames:
                raise found.refused(
                    f"have {frames[0]} entries of `{name}`, as many as of `t`",
                    f"has the shape {entry.shape} there",
                )
        return {name: found.read(name) for name in found.entries}


def save_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays of numbers as `.npz`, uncompressed; the file appears complete or not at all."""
    with (
        durably_replacing(with_suffix(path, (".npz",))) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive,
    ):
        for name, array in arrays.items():
            # The length is not known before: without this a member ends at 2 GiB.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)


@contextlib.contextmanager
def durably_replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path, renamed to `path` on success, when all of it has reached the disk."""
    with replacing(path) as temporary:
        yield temporary
        flush(temporary)
    flush(Path(path).parent)


def flush(path: Path) -> None:
    """Wait until a file, or the list of files of a folder, has reached the disk."""
    if path.is_file():
        with path.open("r+b") as stream:
            os.fsync(stream.fileno())
        return
    # Not every system and file system can do this for a folder; those need not.
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def digest(value: Any) -> str:
    """A hash of all that a value is made of, the same in every process.

    Arrays count with dtype, shape and every bit, records field by field. A function counts by its
    name; what it remembers of its surroundings is not seen.
    """
    total = hashlib.sha256()
    for part in _content(value):
        total.update(part)
    return total.hexdigest()


def _content(value: Any) -> Iterator[bytes]:
    if isinstance(value, jax.Array | np.ndarray):
        array = np.ascontiguousarray(value)
        yield f"{array.dtype.str} {array.shape} ".encode()
        yield array.tobytes()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield f"{type(value).__qualname__} ".encode()
        for field in dataclasses.fields(value):
            yield f"{field.name} ".encode()
            yield from _content(getattr(value, field.name, None))
    elif isinstance(value, list | tuple):
        yield f"{len(value)} values ".encode()
        for item in value:
            yield from _content(item)
    elif isinstance(value, Mapping):
        yield from _content(list(value.items()))
    elif isinstance(value, functools.partial):
        yield from _content((value.func, value.args, value.keywords))
    elif callable(value):
        yield f"{getattr(value, '__module__', '')} {getattr(value, '__qualname__', '')} ".encode()
    else:
        yield f"{value!r} ".encode()


def _write(path: str | os.PathLike[str], kind: str, arrays: Mapping[str, np.ndarray]) -> None:
    save_arrays(path, {FORMAT: np.asarray(f"pgjax {kind} {VERSION}"), **arrays})


def _leaves(argument: str, tree: Any, alone: str = "") -> dict[str, np.ndarray]:
    """The leaves of a tree on the host, named by the way to them; `alone` names a single array."""
    arrays: dict[str, np.ndarray] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        name = _name(path) or alone
        if name in arrays:
            raise ValueError(
                f"Argument `{argument}` must have values with different names, but two are called "
                f"`{name}`."
            )
        arrays[name] = _numbers(argument, name, leaf)
    return arrays


def _name(path: Any) -> str:
    """`history.0` for `.history[0]`; what a name in the file may not hold becomes `_`."""
    words = jax.tree_util.keystr(path, simple=True, separator=".")
    return re.sub(r"[^\w.+-]", "_", words)


def _numbers(argument: str, name: str, leaf: Any) -> np.ndarray:
    known = None if _is_key(leaf) else concrete(leaf)
    if known is None and not _is_key(leaf):
        raise ValueError(
            f"Argument `{argument}` must hold numbers, but `{name}` is being traced: save it "
            f"outside of `jit`, `grad` and `vmap`."
        )
    if known is None or known.dtype.kind not in NUMBERS:
        raise ValueError(
            f"Argument `{argument}` must hold arrays of numbers, but `{name}` is "
            f"{getattr(leaf, 'dtype', type(leaf).__name__)}: convert it first."
        )
    return known


def _is_key(leaf: Any) -> bool:
    """Whether it is an array of random keys, which numpy does not know."""
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _matching(found: Found, scene: Scene) -> State:
    """Shapes and types of a state of the scene; raises unless the file has just these."""
    velocity = found.entries.get("v")
    if velocity is None or len(velocity.shape) != 2:
        raise found.refused("have velocities `v` of shape (p, d)", "has none")
    _require_precision(found, velocity.dtype)
    n, d = velocity.shape
    if d != scene.grid.dimension:
        raise found.refused(
            f"be of a scene in {scene.grid.dimension} dimensions", f"is of one in {d}"
        )
    if n != scene.particle_count:
        raise found.refused(f"hold the {scene.particle_count} particles of the scene", f"holds {n}")
    like = _like(scene, velocity.dtype)
    expected = _entries(like)
    _require_names(found, expected)
    for name, entry in expected.items():
        if found.entries[name] != entry:
            raise found.refused(
                f"have `{name}` of shape {entry.shape} and type {entry.dtype} for this scene",
                f"has {found.entries[name].shape} and {found.entries[name].dtype}",
            )
    return like


def _entries(like: State) -> dict[str, Entry]:
    """The arrays of a state by name, in the order of its leaves."""
    return {
        _name(path): Entry(leaf.shape, np.dtype(leaf.dtype))
        for path, leaf in jax.tree_util.tree_leaves_with_path(like)
    }


def _require_precision(found: Found, dtype: np.dtype) -> None:
    if dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise found.refused("be in float32 or float64", f"is in {dtype}")
    if dtype == np.float64 and jnp.zeros(()).dtype != np.float64:
        raise found.refused(
            "be in float32 unless double precision is switched on "
            '(`jax.config.update("jax_enable_x64", True)`)',
            "is in float64",
        )


def _require_names(found: Found, expected: Mapping[str, Entry]) -> None:
    missing, extra = expected.keys() - found.entries.keys(), found.entries.keys() - expected.keys()
    if not missing and not extra:
        return
    faults = [f"lacks {_listed(missing)}"] if missing else []
    faults += [f"has {_listed(extra)}"] if extra else []
    hint = ""
    if "H" in missing | extra:
        hint = " (the total `H` is kept where a material flows, and there only)"
    elif any(name.startswith("history.") for name in missing | extra):
        hint = " (`history` is what a material remembers, by the number of the material)"
    raise found.refused("be of a scene with the same materials", " and ".join(faults) + hint)


def _require_origin(found: Found, scene: Scene, dtype: np.dtype) -> None:
    """Positions are relative to the origin: with another one they would be somewhere else."""
    origin = concrete(scene.grid.origin)
    if origin is None:
        raise ValueError("Argument `scene` must not be traced: load outside of `jit`.")
    stored = found.read("origin")
    if not np.array_equal(stored, origin.astype(dtype)):
        raise found.refused(f"be of a grid with the origin {origin}", f"is of one with {stored}")


def _like(scene: Scene, dtype: np.dtype) -> State:
    """A state of the scene, shapes and types only."""
    x = jax.ShapeDtypeStruct((scene.particle_count, scene.grid.dimension), dtype)
    return eqx.filter_eval_shape(lambda scene, x: initial_state(scene, x, dtype=dtype), scene, x)


def _listed(names: Any) -> str:
    return ", ".join(f"`{name}`" for name in sorted(names))
