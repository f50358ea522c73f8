"""Rotations of a scene file: degrees about z, or turns about axes one after the other."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from pgjax.scenes.reader import Table
from pgjax.scenes.regions import Triple, unit


def rotation(t: Table, key: str = "rotation") -> np.ndarray:
    """The rotation matrix `(3, 3)` of a number or of a list of `{ axis, angle }`."""
    if not t.is_a(key, list):
        return _about((0.0, 0.0, 1.0), t.number(key, 0.0))
    turned = np.eye(3)
    for turn in t.tables(key):
        turned = turn.read(_turn) @ turned
    return turned


def radians(degrees: Triple) -> Triple:
    """Three angles."""
    x, y, z = degrees
    return math.radians(x), math.radians(y), math.radians(z)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Axis times angle, radians."""
    return Rotation.from_matrix(matrix).as_rotvec()


def _turn(t: Table) -> np.ndarray:
    axis = t.vector("axis")
    if not any(axis):
        raise t.error("axis", "not be zero")
    return _about(axis, t.number("angle"))


def _about(axis: Triple, degrees: float) -> np.ndarray:
    # Whole turns are left out: of a huge angle nothing but their rounding would be left.
    angle = math.radians(math.fmod(degrees, 360))
    return Rotation.from_rotvec(angle * unit(axis)).as_matrix()
