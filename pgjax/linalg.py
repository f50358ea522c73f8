"""3×3 algebra of one particle: the only SVD, polar and eigen-decomposition in the package.

Singular vectors and eigenvectors have no derivative where singular values coincide, and every
scene starts there (F = I). So none is ever differentiated. What a constitutive law needs is an
isotropic *function*, and that is smooth: `spectral_map` (of a symmetric matrix) and `isotropic`
(of a general one) carry the exact derivative by divided differences (Daleckii and Krein 1965),
forward and reverse.
"""

import functools
import math
import operator
from collections.abc import Callable

import jax
import jax.numpy as jnp

from pgjax._safe import safe_divide
from pgjax._types import Array, Bool, Float, Matrix3, Scalar, Vector3
from pgjax.native import varying
from pgjax.native.particles import per_particle

# Cyclic Jacobi converges quadratically: errors after these are at rounding level.
_SWEEPS = {"float32": 4, "float64": 6}
_PAIRS = ((0, 1, 2), (0, 2, 1), (1, 2, 0))


def _sweeps(dtype: jnp.dtype) -> int:
    return _SWEEPS[jnp.dtype(dtype).name]


def _rotation(diagonal_gap: Scalar, off: Scalar) -> tuple[Scalar, Scalar]:
    """Cosine and sine of the Jacobi rotation that annihilates `off` (Golub and Van Loan 8.5)."""
    root = jnp.sqrt(diagonal_gap * diagonal_gap + 4 * off * off)
    sign = jnp.where(diagonal_gap < 0, -1, 1).astype(off.dtype)
    t = safe_divide(2 * sign * off, jnp.abs(diagonal_gap) + root)
    c = jax.lax.rsqrt(1 + t * t)
    return c, t * c


def _jacobi_sweep(_: Array, carry: tuple[Matrix3, Matrix3]) -> tuple[Matrix3, Matrix3]:
    """One cyclic Jacobi sweep: annihilate each off-diagonal entry of A, turning the basis Q."""
    A, Q = carry
    a = [[A[min(i, j), max(i, j)] for j in range(3)] for i in range(3)]
    q = [[Q[i, j] for j in range(3)] for i in range(3)]
    for i, j, k in _PAIRS:
        off = a[i][j]
        c, s = _rotation(a[j][j] - a[i][i], off)
        a[i][i], a[j][j] = a[i][i] - (s / c) * off, a[j][j] + (s / c) * off
        a[i][j] = a[j][i] = jnp.zeros((), A.dtype)
        ki, kj = a[k][i], a[k][j]
        a[k][i] = a[i][k] = c * ki - s * kj
        a[k][j] = a[j][k] = s * ki + c * kj
        for row in q:
            row[i], row[j] = c * row[i] - s * row[j], s * row[i] + c * row[j]
    return (
        jnp.stack([jnp.stack(row) for row in a]),
        jnp.stack([jnp.stack(row) for row in q]),
    )


def eigenbasis(A: Matrix3) -> tuple[Vector3, Matrix3]:
    """Eigenvalues, largest first, and eigenvectors (columns) of a symmetric matrix.

    Cyclic Jacobi, in scalars, so that `vmap` turns it into vector instructions; on a CPU by a
    native kernel. The result carries **no derivative**: pass it to `spectral_map`, which has the
    exact one.

    Returns:
        `w (3,)` and `Q (3, 3)` with `A = Q diag(w) Qᵀ`, error about 1e-6 (float32) or
        1e-15 (float64) of the largest eigenvalue. `Q` may be a reflection.
    """
    w, Q = _eigenbasis_call(jax.lax.stop_gradient(A))
    return w, Q


def _eigenbasis(A: Matrix3) -> tuple[Vector3, Matrix3]:
    """The same in plain JAX."""
    scale = jnp.max(jnp.abs(A))
    scale = jnp.where(scale > 0, scale, 1)
    # A loop, not unrolled: unrolled, XLA's fusion recomputes earlier sweeps many times over.
    start = varying(A / scale, jnp.eye(3, dtype=A.dtype))
    diagonalised, basis = jax.lax.fori_loop(0, _sweeps(A.dtype), _jacobi_sweep, start)
    w = [diagonalised[i, i] for i in range(3)]
    q = [[basis[i, j] for j in range(3)] for i in range(3)]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        swap = w[i] < w[j]
        w[i], w[j] = jnp.where(swap, w[j], w[i]), jnp.where(swap, w[i], w[j])
        for row in q:
            row[i], row[j] = jnp.where(swap, row[j], row[i]), jnp.where(swap, row[i], row[j])
    return jnp.stack(w) * scale, jnp.stack([jnp.stack(row) for row in q])


_eigenbasis_call = per_particle("eigenbasis", "eigen", _eigenbasis, 2)


@jax.custom_jvp
def _spectral_map(A: Matrix3, Q: Matrix3, values: Vector3, divided: Matrix3) -> Matrix3:
    del A, divided
    return (Q * values[None, :]) @ Q.T


@_spectral_map.defjvp
def _spectral_map_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    A, Q, values, divided = primals
    dA, _, dvalues, _ = tangents
    inner = divided * (Q.T @ dA @ Q) + jnp.diag(dvalues)
    return _spectral_map(A, Q, values, divided), Q @ inner @ Q.T


def spectral_map(A: Matrix3, Q: Matrix3, values: Vector3, divided: Matrix3) -> Matrix3:
    """The isotropic function `f(A) = Q diag(f(w)) Qᵀ` of a symmetric `A = Q diag(w) Qᵀ`.

    `df = Q [K ∘ (Qᵀ dA Q)] Qᵀ` with the divided differences
    `K_ij = (f(w_i) − f(w_j))/(w_i − w_j)`, `K_ii = f′(w_i)` (Daleckii and Krein 1965).

    Args:
        A: symmetric argument; the derivative is taken with respect to it.
        Q: its eigenvectors (`eigenbasis`).
        values: `f(w)`; a derivative with respect to parameters of `f` passes through.
        divided: the matrix `K`, in a form that is accurate for equal eigenvalues.
    """
    return _spectral_map(A, jax.lax.stop_gradient(Q), values, jax.lax.stop_gradient(divided))


def _dot(a: list[Scalar], b: list[Scalar]) -> Scalar:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _order_columns(square: list, g: list, v: list) -> None:
    """Sort the columns of `g` by squared length, largest first, turning `v` along (det V kept)."""
    for i, j in ((0, 1), (0, 2), (1, 2)):
        swap = square[i] < square[j]
        square[i], square[j] = (
            jnp.where(swap, square[j], square[i]),
            jnp.where(swap, square[i], square[j]),
        )
        for m in (g, v):
            m[i], m[j] = (
                [jnp.where(swap, b, a) for a, b in zip(m[i], m[j], strict=True)],
                # A quarter turn, not an exchange: the determinant stays +1.
                [jnp.where(swap, -a, b) for a, b in zip(m[i], m[j], strict=True)],
            )


def _unit_or(a: Vector3, good: Bool[Array, ""], fallback: Vector3) -> Vector3:
    """`a/|a|`, or `fallback` where that is not `good`."""
    return jnp.where(good, a / jnp.sqrt(jnp.sum(jnp.where(good, a * a, 1))), fallback)


def _perpendicular(u: Vector3) -> Vector3:
    """A unit vector perpendicular to the unit vector `u` (Duff et al. 2017)."""
    x, y, z = u
    sign = jnp.where(z < 0, -1, 1).astype(u.dtype)
    a = -1 / (sign + z)
    return jnp.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x])


def _hestenes_sweep(
    _: Array, carry: tuple[Matrix3, Matrix3, Vector3]
) -> tuple[Matrix3, Matrix3, Vector3]:
    """Turn each pair of columns of `G = F V` (stored as rows) until they are perpendicular.

    Returns G, V and the squared lengths of the columns. The lengths belong to the carry because
    what leaves a loop is stored: computed later, XLA repeats them in every kernel that compares
    two of them, rounded differently, and equal columns are exchanged in G but not in V.
    """
    g, v = ([[m[j, i] for i in range(3)] for j in range(3)] for m in carry[:2])
    for i, j, _k in _PAIRS:
        dot = _dot(g[i], g[j])
        gap = _dot(g[j], g[j]) - _dot(g[i], g[i])
        c, s = _rotation(gap, dot)
        for m in (g, v):
            m[i], m[j] = (
                [c * x - s * y for x, y in zip(m[i], m[j], strict=True)],
                [s * x + c * y for x, y in zip(m[i], m[j], strict=True)],
            )
    G, V = (jnp.stack([jnp.stack(column) for column in m]) for m in (g, v))
    return G, V, jnp.stack([_dot(column, column) for column in g])


def svd(F: Matrix3) -> tuple[Matrix3, Vector3, Matrix3]:
    """Singular value decomposition `F = U diag(σ) Vᵀ` with U and V *rotations*.

    One-sided (Hestenes) Jacobi on the columns of F. `|σ|` is sorted, largest first; the last
    one has the sign of det F, so an inverted F keeps the most even stretch (Irving et al. 2004).
    Any F, of any rank, gives proper rotations. Carries **no derivative**: use `isotropic`.

    Returns:
        `U (3, 3)`, `σ (3,)`, `V (3, 3)`; reconstruction error about 3e-7 (float32) or
        1e-15 (float64) of the largest singular value.
    """
    U, sigma, V = _svd_call(jax.lax.stop_gradient(F))
    return U, sigma, V


def _svd(F: Matrix3) -> tuple[Matrix3, Vector3, Matrix3]:
    """The same in plain JAX."""
    scale = jnp.max(jnp.abs(F))
    scale = jnp.where(scale > 0, scale, 1)
    A = F / scale
    # A loop, not unrolled: unrolled, XLA's fusion recomputes earlier sweeps many times over.
    start = varying(A.T, jnp.eye(3, dtype=F.dtype), jnp.zeros(3, F.dtype))
    G, V, lengths = jax.lax.fori_loop(0, _sweeps(F.dtype) + 1, _hestenes_sweep, start)
    g, v = ([[m[j, i] for i in range(3)] for j in range(3)] for m in (G, V))
    square = list(lengths)
    _order_columns(square, g, v)
    g1, g2, g3 = (jnp.stack(column) for column in g)
    eps = float(jnp.finfo(F.dtype).eps)
    u1 = _unit_or(g1, square[0] > 0, jnp.zeros(3, F.dtype).at[0].set(1))
    rest = g2 - jnp.sum(u1 * g2) * u1
    u2 = _unit_or(rest, square[1] > eps * eps * square[0], _perpendicular(u1))
    u2 = u2 - jnp.sum(u1 * u2) * u1
    u2 = u2 / jnp.sqrt(jnp.sum(u2 * u2))
    u3 = jnp.cross(u1, u2)
    sigma = jnp.stack([jnp.sum(u1 * g1), jnp.sum(u2 * g2), jnp.sum(u3 * g3)]) * scale
    V = jnp.stack([jnp.stack(column) for column in v], axis=1)
    return jnp.stack([u1, u2, u3], axis=1), sigma, V


_svd_call = per_particle("svd", "eigen", _svd, 2)


@jax.custom_jvp
def _isotropic(F: Matrix3, values: Vector3, frozen: tuple) -> Matrix3:
    del F
    U, V = frozen[0], frozen[1]
    return (U * values[None, :]) @ V.T


@_isotropic.defjvp
def _isotropic_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    F, values, frozen = primals
    dF, dvalues, _ = tangents
    U, V, jacobian, m, q = frozen
    A = U.T @ dF @ V
    diagonal = jacobian @ jnp.diagonal(A) + dvalues
    # Sum and difference first: q is huge where σ_i + σ_j nearly vanishes, as on its diagonal for
    # a singular F, which is therefore selected, not subtracted.
    off = (m * (A + A.T) + q * (A - A.T)) / 2
    inner = jnp.where(jnp.eye(3, dtype=bool), jnp.diag(diagonal), off)
    return _isotropic(F, values, frozen), U @ inner @ V.T


def isotropic(function: Callable[[Vector3], Vector3], F: Matrix3) -> Matrix3:
    """The isotropic function `P(F) = U diag(p(σ)) Vᵀ` with its exact derivative.

    `dP = U M Vᵀ`, `A = Uᵀ dF V`, `M_ii = Σ_j ∂p_i/∂σ_j A_jj`,
    `M_ij = [(m + q) A_ij + (m − q) A_ji]/2`, `m = (p_i − p_j)/(σ_i − σ_j)`,
    `q = (p_i + p_j)/(σ_i + σ_j)`; where σ_i and σ_j are close, m is its limit
    `∂p_i/∂σ_i − ∂p_i/∂σ_j`, averaged over i and j. At F = I the derivative is exact too.

    Args:
        function: `σ (3,) -> p (3,)`, symmetric under permutations, finite for any signs.
        F: any 3×3 matrix.
    """
    U, sigma, V = svd(F)
    values = function(sigma)
    jacobian = jax.jacfwd(function)(sigma)
    p = values
    gap = sigma[:, None] - sigma[None, :]
    total = sigma[:, None] + sigma[None, :]
    size = jnp.max(jnp.abs(sigma))
    diagonal = jnp.diagonal(jacobian)
    limit = (diagonal[:, None] + diagonal[None, :] - jacobian - jacobian.T) / 2
    close = jnp.abs(gap) <= float(jnp.finfo(F.dtype).eps) ** (1 / 3) * size
    m = jnp.where(close, limit, (p[:, None] - p[None, :]) / jnp.where(close, 1, gap))
    q = safe_divide(p[:, None] + p[None, :], total)
    frozen = jax.lax.stop_gradient((U, V, jacobian, m, q))
    return _isotropic(F, values, frozen)


def polar(F: Matrix3) -> tuple[Matrix3, Matrix3]:
    """Polar decomposition `F = R S`: R a rotation (det +1, also where det F ≤ 0), S symmetric.

    The derivative of R is exact wherever it exists, `σ_i + σ_j ≠ 0` (Stomakhin et al. 2012).
    """
    R = isotropic(jnp.ones_like, F)
    S = R.T @ F
    return R, (S + S.T) / 2


def det(A: Matrix3) -> Scalar:
    """Determinant of a 3×3 matrix, written out (no LU)."""
    return jnp.sum(A[0] * jnp.cross(A[1], A[2]))


def cofactor(A: Matrix3) -> Matrix3:
    """Cofactor matrix, `det(A) A⁻ᵀ` written without a division: finite for singular A."""
    return jnp.stack([jnp.cross(A[1], A[2]), jnp.cross(A[2], A[0]), jnp.cross(A[0], A[1])])


def volume_change(H: Matrix3) -> Scalar:
    """`J − 1 = tr H + (tr²H − tr H²)/2 + det H`: the invariants, without cancellation."""
    trace = jnp.trace(H)
    second = (trace * trace - jnp.sum(H * H.T)) / 2
    return trace + second + jnp.sum(H[0] * cofactor(H)[0])


def deviator(A: Matrix3) -> Matrix3:
    """`A − tr(A)/3 I`."""
    return A - (jnp.trace(A) / 3) * jnp.eye(3, dtype=A.dtype)


def apply(A: Float[Array, "d d"], x: Float[Array, " d"]) -> Float[Array, " d"]:
    """`A x`, written out: under `vmap` over x XLA makes vector code of it instead of calls."""
    d = x.shape[0]
    rows = [[A[i, j] * x[j] for j in range(d)] for i in range(d)]
    return jnp.stack([functools.reduce(operator.add, row) for row in rows])


def rotation_change(turn: Float[Array, " k"]) -> Array:
    """`R − I` of a rotation vector `(3,)`, or of an angle `(1,)` in two dimensions.

    `R − I = a W + b W²`, `a = sin θ/θ`, `b = (1 − cos θ)/θ²` (Rodrigues): no cancellation for
    small angles, and smooth at 0.
    """
    square = jnp.sum(turn * turn)
    # Below θ² = 1/20 six terms of the series are exact in double precision.
    small = square < 0.05
    angle = jnp.sqrt(jnp.where(small, 1, square))
    a = jnp.where(small, _series(square, 1), jnp.sin(angle) / angle)
    b = jnp.where(small, _series(square, 2), 2 * (jnp.sin(angle / 2) / angle) ** 2)
    zero = jnp.zeros_like(square)
    if turn.shape[0] == 1:
        W = jnp.stack([jnp.stack([zero, -turn[0]]), jnp.stack([turn[0], zero])])
    else:
        x, y, z = turn
        rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
        W = jnp.stack([jnp.stack(row) for row in rows])
    return a * W + b * (W @ W)


def _series(square: Scalar, first: int) -> Scalar:
    """`Σ (−θ²)ᵏ/(2k + first)!`, k < 7: `sin θ/θ` for first = 1, `(1 − cos θ)/θ²` for 2."""
    total = jnp.zeros_like(square)
    for k in reversed(range(7)):
        total = 1 / math.factorial(2 * k + first) - square * total
    return total
