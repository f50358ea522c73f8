"""The decompositions of 3×3 matrices and the derivatives of isotropic functions."""

import jax
import jax.numpy as jnp
import laws
import numpy as np
import pytest

from pgjax.linalg import cofactor, det, deviator, eigenbasis, isotropic, polar, spectral_map, svd

double = pytest.mark.float64
N = 7143  # of each class: 1e5 in all

# --- V14: accuracy -------------------------------------------------------------------------------

STRETCHES = {
    "rotation": [1, 1, 1],
    "two equal": [1, 1, 2],
    "stretched": [1e3, 1, 1],
    "crushed": [1, 1, 1e-3],
    "condition 1e6": [1e3, 1, 1e-3],
    "rank 2": [1, 0.7, 0],
    "rank 1": [1, 0, 0],
    "zero": [0, 0, 0],
    "inverted": [1.2, 0.9, -0.5],
}


def classes(rng):
    """Name and `(N, 3, 3)` matrices of each of the 14 classes."""
    yield "Gaussian", rng.normal(size=(N, 3, 3))
    for size in (1e-3, 1e-5):
        yield f"I + {size:g}", laws.I3 + size * rng.normal(size=(N, 3, 3))
    for name, stretches in STRETCHES.items():
        yield name, laws.with_stretches(rng, np.tile(np.array(stretches, float), (N, 1)))
    for size in (1e-8, 1e8):
        yield f"scale {size:g}", size * rng.normal(size=(N, 3, 3))


def largest(A):
    return abs(np.asarray(A, np.float64)).max((-2, -1))


def product(*factors):
    """Product of matrices in float64, for every particle."""
    result = np.asarray(factors[0], np.float64)
    for factor in factors[1:]:
        result = result @ np.asarray(factor, np.float64)
    return result


def transposed(A):
    return np.swapaxes(np.asarray(A), 1, 2)


def diagonal(w):
    return np.asarray(w, np.float64)[:, :, None] * laws.I3


def errors(kind, F):
    """Reconstruction relative to the largest entry, deviation from orthogonality and det."""
    if kind == "svd":
        U, sigma, V = DECOMPOSE[kind](F)
        rebuilt, turns = product(U, diagonal(sigma), transposed(V)), (U, V)
        magnitude = np.asarray(abs(sigma))
        assert (np.diff(magnitude, axis=1) <= 1e-5 * magnitude[:, :1]).all()
        assert (np.asarray(sigma)[:, :2] >= -1e-6 * magnitude[:, :1]).all()
    elif kind == "polar":
        R, S = DECOMPOSE[kind](F)
        rebuilt, turns = product(R, S), (R,)
        assert (np.asarray(S) == transposed(S)).all()
    else:
        w, Q = DECOMPOSE[kind](F)
        rebuilt, turns = product(Q, diagonal(w), transposed(Q)), (Q,)
        assert (np.diff(np.asarray(w), axis=1) <= 0).all()
    size = largest(F)
    rebuilding = (largest(rebuilt - np.asarray(F)) / np.where(size > 0, size, 1)).max()
    turning = max(largest(product(transposed(Q), Q) - laws.I3).max() for Q in turns)
    sign = max(abs(np.linalg.det(np.asarray(Q, np.float64)) - 1).max() for Q in turns)
    return rebuilding, turning, sign


DECOMPOSE = {f.__name__: jax.jit(jax.vmap(f)) for f in (svd, polar, eigenbasis)}


@pytest.mark.parametrize("kind", DECOMPOSE)
@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=double)])
def test_decomposition_of_every_class_is_accurate(kind, dtype, measure, holds):
    """H03, H04: of any rank, with any coincidence of singular values, of any size."""
    worst = np.zeros(3)
    for _, F in classes(np.random.default_rng(0)):
        if kind == "eigenbasis":
            F = F + F.swapaxes(1, 2)
        worst = np.maximum(worst, errors(kind, jnp.asarray(F.astype(dtype))))
    demand = 2e-6 if dtype == np.float32 else 5e-15
    what = f"{kind} of 1e5 matrices, {np.dtype(dtype).name}: "
    measure("V14", what + "reconstruction", worst[0], below=demand)
    measure("V14", what + "orthogonality", worst[1], below=demand)
    if kind != "eigenbasis":  # whose basis may be a reflection
        measure("V14", what + "|det − 1|", worst[2], below=demand)
    holds("H04", precision=np.dtype(dtype).name)


def test_decompositions_agree_with_lapack():
    F = np.random.default_rng(1).normal(size=(500, 3, 3))
    sigma = np.linalg.svd(F)[1]
    sigma[:, 2] *= np.sign(np.linalg.det(F))
    tolerance = 30 * float(jnp.finfo(jnp.zeros(()).dtype).eps)
    np.testing.assert_allclose(DECOMPOSE["svd"](jnp.asarray(F))[1], sigma, atol=10 * tolerance)
    w = np.linalg.eigvalsh(F + F.swapaxes(1, 2))[:, ::-1]
    ours = DECOMPOSE["eigenbasis"](jnp.asarray(F + F.swapaxes(1, 2)))[0]
    np.testing.assert_allclose(ours, w, atol=10 * tolerance)


def test_determinant_cofactor_and_deviator():
    F = np.random.default_rng(2).normal(size=(50, 3, 3))
    F[0] = np.diag([1.0, 0, 0])
    adjugate = jax.vmap(cofactor)(jnp.asarray(F)).swapaxes(1, 2)
    tolerance = 30 * float(jnp.finfo(jnp.zeros(()).dtype).eps)
    J = np.linalg.det(F)
    np.testing.assert_allclose(jax.vmap(det)(jnp.asarray(F)), J, atol=tolerance)
    np.testing.assert_allclose(F @ np.asarray(adjugate), J[:, None, None] * laws.I3, atol=tolerance)
    traces = np.trace(np.asarray(jax.vmap(deviator)(jnp.asarray(F))), axis1=1, axis2=2)
    np.testing.assert_allclose(traces, 0, atol=tolerance)


# --- Derivatives ---------------------------------------------------------------------------------


def smooth_values(sigma):
    """A symmetric function of three values, with mixed derivatives."""
    return jnp.tanh(sigma) + 0.3 * sigma**2 + 0.2 * jnp.sum(sigma**3)


def spectral_exp(F):
    """`exp` of the symmetric part, with divided differences by `expm1`."""
    A = (F + F.T) / 2
    w, Q = eigenbasis(A)
    gap = w[:, None] - w[None, :]
    quotient = jnp.where(gap == 0, 1, jnp.expm1(gap) / jnp.where(gap == 0, 1, gap))
    return spectral_map(A, Q, jnp.exp(w), jnp.exp(w)[None, :] * quotient)


FUNCTIONS = {
    "isotropic": lambda F: isotropic(smooth_values, F),
    "polar": lambda F: jnp.concatenate(polar(F)),
    "spectral_map": spectral_exp,
}
GAPS = [10.0**-k for k in range(2, 13)]
SPECTRA = {
    "identity": [[1.0, 1, 1]],
    "two equal": [[1, 1, 2], [2, 1, 1], [1.5, 1.5, 0.2]],
    "near equal": [[1 + gap, 1, 1 - gap] for gap in GAPS] + [[2, 1 + gap, 1] for gap in GAPS],
    "inverted": [[1, 1, -0.5], [1.2, 0.9, -0.5], [0.3, 0.2, -0.05]],
    "singular": [[1, 0.7, 0], [1.2, 1.2, 0]],
    "large": [[5, 2, 0.1], [4, 4, 3], [3, 1e-2, 1e-2]],
}


def states():
    """Each spectrum in the axes and turned, `(2 n, 3, 3)`, and the class of each."""
    spectra = np.array([s for group in SPECTRA.values() for s in group])
    kind = [name for name, group in SPECTRA.items() for _ in group]
    straight = np.array([np.diag(s) for s in spectra])
    turned = laws.with_stretches(np.random.default_rng(3), spectra)
    return np.concatenate([straight, turned]), np.array(kind * 2)


def derivative_of(function):
    """Derivatives of a function of many matrices by F: forward and reverse."""

    def both(F):
        return jax.jacfwd(function)(F), jax.jacrev(function)(F)

    return jax.jit(jax.vmap(both))


@pytest.mark.parametrize("name", FUNCTIONS)
@double
def test_derivative_is_that_of_finite_differences_in_both_precisions(name):
    """H01–H06: where singular values coincide, nearly coincide, vanish or are negative."""
    function, (F, kind) = FUNCTIONS[name], states()
    value, derivative = jax.jit(jax.vmap(function)), derivative_of(function)
    forward, reverse = derivative(jnp.asarray(F))
    size = np.maximum(1, abs(np.asarray(forward)).max((1, 2, 3, 4)))
    assert (abs(np.asarray(forward - reverse)).max((1, 2, 3, 4)) / size).max() < 1e-14
    step = 5e-5  # of a difference of fourth order
    for i in range(3):
        for j in range(3):
            E = step * np.eye(9)[3 * i + j].reshape(3, 3)
            a, b, c, d = (np.asarray(value(jnp.asarray(F + s * E))) for s in (1, -1, 2, -2))
            difference = (8 * (a - b) - (c - d)) / (12 * step)
            error = abs(np.asarray(forward[..., i, j]) - difference).max((1, 2)) / size
            assert error.max() < 1e-9
    alone = jax.jit(jax.vmap(jax.jacfwd(function)))
    single = alone(jnp.asarray(F.astype(np.float32)))
    exact, _ = derivative(jnp.asarray(F.astype(np.float32).astype(np.float64)))
    error = abs(np.asarray(single) - np.asarray(exact)).max((1, 2, 3, 4)) / size
    assert error.max() < 1e-5
    assert error[(kind == "identity") | (kind == "two equal")].max() < 1e-6


def test_values_of_a_function_carry_the_derivative_of_its_parameters():
    """d/da of `U (a σ²) Vᵀ` is `U σ² Vᵀ`, and so for a symmetric argument."""
    F = jnp.asarray(laws.deformations()[5])

    def scaled(a, F):
        return isotropic(lambda s: a * s**2, F)

    def spectral(a, F):
        A = F + F.T
        w, Q = eigenbasis(A)
        return spectral_map(A, Q, a * w, a * jnp.ones_like(A))

    for function, base in ((scaled, scaled(jnp.ones(()), F)), (spectral, F + F.T)):
        _, tangent = jax.jvp(lambda a, f=function: f(a, F), (jnp.ones(()),), (jnp.ones(()),))
        np.testing.assert_allclose(tangent, base, atol=1e-5)


def test_derivative_of_a_hencky_stress_at_rest_has_its_shear_part():
    """Differentiating the singular vectors gives NaN here, and masking them 0 instead of ½."""
    eye = jnp.eye(3)

    def log_stretch(F):
        return isotropic(jnp.log, F) @ polar(F)[0].T

    shear = jnp.zeros((3, 3)).at[0, 1].set(1)
    _, tangent = jax.jvp(log_stretch, (eye,), (shear,))
    np.testing.assert_allclose(tangent, (shear + shear.T) / 2, atol=1e-7)
