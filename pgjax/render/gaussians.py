"""A captured scene as anisotropic Gaussians, and how a deformation carries them along."""

import math
from collections.abc import Sequence
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from pgjax._types import Array, Bool, Float, Scalar, concrete, numbers, require, require_shape
from pgjax.linalg import isotropic, polar, svd
from pgjax.render.harmonics import COUNTS


@final
class Similarity(eqx.Module):
    """The map `x_sim = s Q x + t` from world to simulation coordinates.

    Attributes:
        scale: s > 0.
        rotation: Q, a rotation matrix (orthonormal, det +1). It maps coordinates.
        translation: t, in simulation units.
    """

    scale: Float[Array, ""] = eqx.field(converter=numbers("scale"))
    rotation: Float[Array, "3 3"] = eqx.field(converter=numbers("rotation"))
    translation: Float[Array, "3"] = eqx.field(converter=numbers("translation"))

    def __check_init__(self):
        require("scale", self.scale, "be positive and finite", lambda s: (s > 0) & np.isfinite(s))
        require("translation", self.translation, "be finite", np.isfinite)
        require_rotation("rotation", self.rotation)

    def apply(self, x: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """`s Q x + t` for points x."""
        turned = jnp.einsum("ij,...j->...i", self.rotation, x)
        return self.scale * turned + self.translation.reshape((1,) * (x.ndim - 1) + (3,))

    def inverse(self) -> "Similarity":
        """The map back: `x = Qᵀ (x_sim − t) / s`."""
        back = self.rotation.T
        return Similarity(1 / self.scale, back, -(back @ self.translation) / self.scale)

    def pull_back(self, F: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
        """A deformation gradient of the simulation in world axes: `Qᵀ F Q` (s cancels)."""
        return jnp.einsum("ki,...kl,lj->...ij", self.rotation, F, self.rotation)


def require_rotation(name: str, matrix: Any) -> None:
    """Raise a `ValueError` unless `matrix` is a rotation: orthonormal to 1e-4 with det +1."""
    value = concrete(matrix)
    if value is None:
        return
    require_shape(name, value, (3, 3))
    value = value.astype(np.float64)
    error = np.abs(value @ value.T - np.eye(3)).max()
    det = np.linalg.det(value)
    if not (error < 1e-4 and det > 0):
        raise ValueError(
            f"Argument `{name}` must be a rotation (orthonormal with determinant +1), but its "
            f"departure from orthonormality is {error:.3g} and its determinant is {det:.6g}."
        )


@final
class Gaussians(eqx.Module):
    """n anisotropic Gaussians with opacity and a colour that depends on the viewing direction.

    The covariance is `A = M Mᵀ`, which is positive semi-definite whatever the factor M: a captured
    Gaussian has `M = R diag(scale)`, a deformed one `F M`. The colour seen along the unit vector d
    (from the camera to the Gaussian) is `max(Y(Bᵀ d) · c + 1/2, 0)` with the frame B.

    Attributes:
        means: centres, in the units of the capture.
        factors: M.
        opacities: opacity at the centre, in [0, 1].
        sh: coefficients c of the harmonics, k = 1, 4, 9 or 16 of them for each of red, green, blue.
        frames: B, the rotation that has turned the harmonics since the capture.

    Reference: B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering",
    ACM Transactions on Graphics 42(4), 2023.
    """

    means: Float[Array, "n 3"] = eqx.field(converter=numbers("means"))
    factors: Float[Array, "n 3 3"] = eqx.field(converter=numbers("factors"))
    opacities: Float[Array, " n"] = eqx.field(converter=numbers("opacities"))
    sh: Float[Array, "n k 3"] = eqx.field(converter=numbers("sh"))
    frames: Float[Array, "n 3 3"] = eqx.field(converter=numbers("frames"))

    def __check_init__(self):
        n = len(self.means) if self.means.ndim else 0
        shapes = {"means": (n, 3), "factors": (n, 3, 3), "opacities": (n,), "frames": (n, 3, 3)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                actual = getattr(self, name).shape
                raise ValueError(
                    f"Argument `{name}` must have shape {shape} for {n} means, but has {actual}."
                )
        if self.sh.shape not in {(n, k, 3) for k in COUNTS}:
            raise ValueError(
                f"Argument `sh` must have shape ({n}, k, 3) with k = 1, 4, 9 or 16, "
                f"but has {self.sh.shape}."
            )
        # A NaN is let through here: `render` counts what it cannot draw.
        require("opacities", self.opacities, "be in [0, 1]", lambda o: ~((o < 0) | (o > 1 + 1e-6)))

    @classmethod
    def from_scales(
        cls,
        means: Float[Array, "n 3"],
        quaternions: Float[Array, "n 4"],
        scales: Float[Array, "n 3"],
        opacities: Float[Array, " n"],
        sh: Float[Array, "n k 3"],
    ) -> "Gaussians":
        """Gaussians with `M = R(q) diag(scale)`; quaternions wxyz need not be normalised."""
        factors = _rotation_matrices(quaternions) * scales[:, None, :]
        frames = jnp.broadcast_to(jnp.eye(3, dtype=factors.dtype), factors.shape)
        return cls(means, factors, opacities, sh, frames)

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Any) -> "Gaussians":
        """The Gaussians that a mask, a slice or an array of indices selects."""
        if isinstance(index, int | np.integer):
            raise ValueError(f"Argument `index` must select an array of Gaussians, but is {index}.")
        return jax.tree.map(lambda leaf: leaf[index], self)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def covariances(self) -> Float[Array, "n 3 3"]:
        """`A = M Mᵀ`."""
        return jnp.einsum("nij,nkj->nik", self.factors, self.factors)

    def transformed(self, similarity: Similarity) -> "Gaussians":
        """The same in other coordinates: means `s Q x + t`, factors `s Q M`, frames `Q B`."""
        T = jax.tree.map(lambda leaf: leaf.astype(self.means.dtype), similarity)
        return Gaussians(
            T.apply(self.means),
            T.scale * jnp.einsum("ij,njk->nik", T.rotation, self.factors),
            self.opacities,
            self.sh,
            jnp.einsum("ij,njk->nik", T.rotation, self.frames),
        )


def rotation_of(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The rotation of a quaternion wxyz, which is normalised first."""
    w, x, y, z = quaternion / jnp.sqrt(jnp.sum(quaternion * quaternion))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


_rotation_matrices = jax.jit(jax.vmap(rotation_of))
_polar_rotations = jax.jit(jax.vmap(lambda F: polar(F)[0]))


def deform(gaussians: Gaussians, x: Float[Array, "n 3"], F: Float[Array, "n 3 3"]) -> Gaussians:
    """Move Gaussians to x and deform each by F: `A = F A₀ Fᵀ`, harmonics turned by R of F = R S.

    F is the *total* deformation gradient (plastic strain is seen, too), and x and F are in the axes
    of the Gaussians. A simulation in other axes gives `similarity.inverse().apply(x)` and
    `similarity.pull_back(F)`.

    Args:
        gaussians: the undeformed Gaussians.
        x: where their centres are now.
        F: deformation gradients since the capture. R has det +1 even where det F ≤ 0.

    Reference: T. Xie et al., "PhysGaussian: Physics-Integrated 3D Gaussians for Generative
    Dynamics", CVPR 2024, section 3.
    """
    n = len(gaussians)
    if x.shape != (n, 3) or F.shape != (n, 3, 3):
        raise ValueError(
            f"Arguments `x` and `F` must have shapes ({n}, 3) and ({n}, 3, 3) for {n} Gaussians, "
            f"but have {x.shape} and {F.shape}."
        )
    dtype = gaussians.means.dtype
    F = F.astype(dtype)
    return Gaussians(
        x.astype(dtype),
        jnp.einsum("nij,njk->nik", F, gaussians.factors),
        gaussians.opacities,
        gaussians.sh,
        jnp.einsum("nij,njk->nik", _polar_rotations(F), gaussians.frames),
    )


def bound_stretch(
    F: Float[Array, "n 3 3"], largest: Scalar | float
) -> tuple[Float[Array, "n 3 3"], Bool[Array, " n"]]:
    """F with its principal stretches bounded to `[1/largest, largest]`, and where it was.

    Where a material has flowed far (sand, paste) the total F of a point no longer describes its
    neighbourhood, and a Gaussian drawn with it becomes a veil across the picture. Rotations and
    the signs of the stretches are kept; what is within the bounds is unchanged.

    Args:
        F: deformation gradients.
        largest: at least 1.
    """
    require("largest", largest, "be at least 1", lambda a: a >= 1)
    return _bound_stretch(F, jnp.asarray(largest, F.dtype))


@jax.jit
def _bound_stretch(F: Array, largest: Array) -> tuple[Array, Array]:
    def one(F: Float[Array, "3 3"]) -> tuple[Array, Array]:
        def clip(sigma: Float[Array, "3"]) -> Float[Array, "3"]:
            return jnp.sign(sigma) * jnp.clip(jnp.abs(sigma), 1 / largest, largest)

        _, sigma, _ = svd(F)
        beyond = jnp.any((jnp.abs(sigma) > largest) | (jnp.abs(sigma) < 1 / largest))
        return jnp.where(beyond, isotropic(clip, F), F), beyond

    return jax.vmap(one)(F)


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of several sets; those of a lower degree get zero coefficients above it."""
    if not parts:
        raise ValueError("Argument `parts` must hold at least one set of Gaussians, but is empty.")
    k = max(part.sh.shape[1] for part in parts)
    padded = [
        eqx.tree_at(
            lambda g: g.sh, part, jnp.pad(part.sh, ((0, 0), (0, k - part.sh.shape[1]), (0, 0)))
        )
        for part in parts
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *padded)
