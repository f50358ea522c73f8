"""Signed distances sampled from a triangle mesh or from points, with libigl.

libigl (https://libigl.github.io) is an optional dependency: `pip install "pgjax[mesh]"`.
"""

import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pgjax._files import is_file
from pgjax._types import positive, require
from pgjax.boundary.shapes import SampledSDF

# Nodes of the lattice: 10⁷ distances to a mesh take about a minute.
_MOST_NODES = 10_000_000
_MARGIN = 3  # nodes around the body
# In a process of its own: a damaged file makes libigl's readers end theirs, or ask for any memory
# or time.
_READER = """
import os, sys, igl, numpy
try:
    import resource
    for limit, most in zip((resource.RLIMIT_AS, resource.RLIMIT_CPU), sys.argv[3:]):
        resource.setrlimit(limit, (int(most),) * 2)
except ImportError:
    pass
vertices, faces = igl.read_triangle_mesh(sys.argv[1])
with open(sys.argv[2] + ".part", "wb") as file:
    numpy.savez(file, vertices=vertices, faces=faces)
os.replace(sys.argv[2] + ".part", sys.argv[2])
"""
# Bytes and seconds of it, and how many bytes of the file give one more of each.
_READER_LIMITS = ((2 << 30, 0.01), (5, 1 << 18))


def sample_mesh(
    mesh: str | os.PathLike[str] | tuple[Any, Any],
    *,
    spacing: float,
    scale: float = 1.0,
    turn: Any = (0.0, 0.0, 0.0),
) -> SampledSDF:
    """The signed distance to a closed triangle mesh.

    Inside and outside are told apart by the generalized winding number (Barill et al. 2018), which
    bears small holes, doubled faces and pieces that cut each other; faces have to be oriented
    alike, as the usual files have them.

    Args:
        mesh: a file (.obj, .off, .stl, .ply), or vertices `(n, 3)` and triangles `(m, 3)`.
        spacing: distance of the nodes, m; about that of the simulation's grid or half of it.
        scale: multiplies the vertices, e.g. 1e-3 for a file in millimetres.
        turn: rotation vector about the origin of the vertices, rad, `(3,)`.

    Raises:
        ValueError: no such file, not a mesh, or too many nodes.
        RuntimeError: libigl is not installed.
    """
    require("spacing", spacing, "be positive and finite (m)", positive)
    require("scale", scale, "be positive and finite", positive)
    turn = np.asarray(turn, np.float64)
    if turn.shape != (3,):
        raise ValueError(f"Argument `turn` must have shape (3,), but has shape {turn.shape}.")
    require("turn", turn, "be finite (rad)", np.isfinite)
    vertices, faces = _read(mesh) if isinstance(mesh, str | os.PathLike) else _arrays(*mesh)
    placed = scale * Rotation.from_rotvec(turn).apply(vertices)
    return _sampled(placed, faces, float(spacing), 0.0)


def sample_points(
    points: Any, *, spacing: float, radius: float, thickness: float | None = None
) -> SampledSDF:
    """The signed distance to a body that is given by points: particles, or centres of Gaussians.

    Balls of `radius` around the points are joined, which closes gaps narrower than twice that, and
    the surface is then moved back inwards until it lies `thickness` outside the outermost points
    (a morphological closing). A surface of points without an inside becomes a wall, twice
    `thickness` thick; fill it first (`pgjax.filling.fill`) if it bounds a solid.

    Args:
        points: `(n, 3)`, m.
        spacing: distance of the nodes, m.
        radius: of the balls, m, at least `spacing`; above half the widest gap to be closed.
        thickness: in [0, radius], m; half of `radius` if None.

    Raises:
        ValueError: bad input, or too many nodes.
        RuntimeError: libigl is not installed.
    """
    x = np.asarray(points, np.float64)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) == 0:
        raise ValueError(
            f"Argument `points` must have shape (n, 3) with n ≥ 1, but has shape {x.shape}."
        )
    require("points", x, "be finite", np.isfinite)
    require("spacing", spacing, "be positive and finite (m)", positive)
    least = f"be at least `spacing` = {spacing} and finite (m)"
    require("radius", radius, least, lambda a: (a >= spacing) & np.isfinite(a))
    thickness = radius / 2 if thickness is None else thickness
    inside = f"be in [0, `radius` = {radius}] (m)"
    require("thickness", thickness, inside, lambda a: (a >= 0) & (a <= radius))
    vertices, faces = _joined_balls(x, float(spacing), float(radius))
    return _sampled(vertices, faces, float(spacing), float(radius - thickness))


def _igl() -> ModuleType:
    try:
        import igl  # An optional dependency, and 14 MB.
    except ImportError as error:
        raise RuntimeError(
            'Sampling a mesh or points needs libigl: pip install "pgjax[mesh]".'
        ) from error
    return igl


def _read(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    file = Path(path)
    if not is_file(file):
        raise ValueError(f"The mesh {file} does not exist.")
    _igl()
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "mesh.npz"
        size = file.stat().st_size
        limits = [str(least + int(size / step)) for least, step in _READER_LIMITS]
        arguments = [str(file.absolute()), str(found), *limits]
        command = [sys.executable, "-P", "-c", _READER, *arguments]
        subprocess.run(command, capture_output=True, check=False)
        if not found.is_file():
            raise ValueError(f"The file {file} cannot be read as a triangle mesh.")
        with np.load(found) as arrays:
            return _arrays(arrays["vertices"], arrays["faces"], f"The file {file}")


def _arrays(
    vertices: Any, faces: Any, what: str = "Argument `mesh`"
) -> tuple[np.ndarray, np.ndarray]:
    V = np.ascontiguousarray(vertices, np.float64)
    F = np.ascontiguousarray(faces, np.int64)
    if V.ndim != 2 or V.shape[1:] != (3,) or F.ndim != 2 or F.shape[1:] != (3,) or len(F) == 0:
        raise ValueError(
            f"{what} must hold vertices (n, 3) and triangles (m, 3), but holds arrays of shape "
            f"{V.shape} and {F.shape}."
        )
    if not np.isfinite(V).all():
        raise ValueError(f"{what} must hold finite vertices, but {_bad(V)} are not.")
    if F.min() < 0 or F.max() >= len(V):
        raise ValueError(
            f"{what} must refer to vertices 0 to {len(V) - 1}, but has indices from {F.min()} to "
            f"{F.max()}."
        )
    return V, F


def _bad(V: np.ndarray) -> int:
    return int(np.count_nonzero(~np.isfinite(V).all(axis=1)))


def _lattice(
    lower: np.ndarray, upper: np.ndarray, spacing: float
) -> tuple[np.ndarray, tuple[int, ...]]:
    """First node and number of nodes of a lattice around a box; refused if it is too large."""
    counts = np.ceil((upper - lower) / spacing) + 2 * _MARGIN + 1
    if not math.prod(counts) <= _MOST_NODES:
        coarser = 1.05 * spacing * (math.prod(counts) / _MOST_NODES) ** (1 / 3)
        raise ValueError(
            f"Argument `spacing` must be about {coarser:.3g} or more for a body that extends over "
            f"{upper - lower} m (at most {_MOST_NODES} nodes), but is {spacing}."
        )
    middle = (lower + upper) / 2
    return middle - (counts - 1) / 2 * spacing, tuple(int(n) for n in counts)


def _nodes(origin: np.ndarray, shape: tuple[int, ...], spacing: float) -> np.ndarray:
    """Places of the nodes `(product, 3)`, the last direction running fastest."""
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _sampled(vertices: np.ndarray, faces: np.ndarray, spacing: float, inwards: float) -> SampledSDF:
    """Distances to a mesh on a lattice around it, its surface moved inwards."""
    igl = _igl()
    used = vertices[np.unique(faces)]
    origin, shape = _lattice(used.min(axis=0), used.max(axis=0), spacing)
    nodes = _nodes(origin, shape, spacing)
    by_winding_number = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    signed, _, nearest, _ = igl.signed_distance(nodes, vertices, faces, sign_type=by_winding_number)
    # The winding number scales the distance where it is not quite 0 or 1: its sign alone counts.
    values = np.copysign(np.linalg.norm(nodes - nearest, axis=1), signed)
    if not (values < 0).any():
        raise ValueError(
            f"Argument `mesh` must enclose at least one node of a lattice with `spacing` = "
            f"{spacing}, but encloses none: it is open, or thinner than that."
        )
    return SampledSDF(origin, spacing, values.reshape(shape) + inwards)


def _joined_balls(x: np.ndarray, spacing: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """The surface of the union of balls as a mesh (marching cubes on the exact distance)."""
    # Half the spacing: the mesh is then right to a fraction of the wanted resolution.
    fine = spacing / 2
    origin, shape = _lattice(x.min(axis=0) - radius, x.max(axis=0) + radius, fine)
    nodes = _nodes(origin, shape, fine)
    distance = KDTree(x).query(nodes, workers=-1)[0]
    # libigl counts the first direction fastest: the same lattice with the axes reversed.
    nx, ny, nz = shape
    vertices, faces, _ = _igl().marching_cubes(distance, nodes, nz, ny, nx, radius)
    return vertices, faces
