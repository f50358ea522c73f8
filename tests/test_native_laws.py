"""Native laws and return mappings against the plain functions, which have the derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax.models as pm
from pgjax import native
from pgjax.models import elasticity
from pgjax.models.material import cast

PRECISIONS = [
    pytest.param(jnp.float32, 4e-6, id="f32"),
    pytest.param(jnp.float64, 4e-14, id="f64", marks=pytest.mark.float64),
]
MU, LAM = 3e4, 5e4
MOIST = pm.DruckerPrager(20.0, cohesion=0.02, volume_correction=True)


pytestmark = pytest.mark.skipif(
    not native.available(), reason="no native kernels: no C++ compiler, or PGJAX_NATIVE=0"
)


def matrices(dtype):
    """`H = F − I`: at rest, small, large, nearly flat, inverted, with equal stretches."""
    rng = np.random.default_rng(3)
    H = [scale * rng.normal(size=(60, 3, 3)) for scale in (1e-6, 1e-3, 0.1, 0.6)]
    turns = np.linalg.qr(rng.normal(size=(40, 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    stretches = np.array([[1, 1, 1], [2, 2, 0.5], [1.3, 0.2, 0.1], [3, 1, 2e-3], [1, 0.9, -0.4]])
    F = turns[:20] @ (np.tile(stretches, (4, 1))[:, :, None] * turns[20:])
    return jnp.asarray(np.concatenate([np.zeros((5, 3, 3)), *H, F - np.eye(3)]), dtype)


def largest(value, expected, scale):
    """Largest difference, in units of `scale` per particle."""
    difference = np.abs(np.asarray(value, float) - np.asarray(expected, float))
    return np.max(difference.reshape(len(difference), -1) / np.asarray(scale, float)[:, None])


def size_of(H):
    """Magnitude of a stress over its modulus: of the strain, or of F if that is large."""
    return np.maximum(np.abs(H).max((1, 2)), 1e-30) * (1 + np.abs(H).max((1, 2)))


@pytest.mark.parametrize(("dtype", "tolerance"), PRECISIONS)
@pytest.mark.parametrize("name", ["neo_hookean", "fixed_corotated", "stvk_hencky"])
def test_stress(name, dtype, tolerance):
    H = matrices(dtype)
    moduli = jnp.full(len(H), MU, dtype), jnp.full(len(H), LAM, dtype)
    kernel = getattr(elasticity, f"_{name}")
    plain = getattr(elasticity, f"_{name}_stress")
    compiled = jax.jit(jax.vmap(kernel)).lower(H, *moduli).as_text()
    assert f"pgjax_{name}_" in compiled  # A call of the native kernel, not the plain function.
    tau, change, *rest = jax.vmap(kernel)(H, *moduli)
    expected = jax.vmap(plain)(H, *moduli)
    size = np.asarray(size_of(np.asarray(H)))
    if name == "stvk_hencky":
        # The logarithm of a small stretch carries its relative error, ~ 1/stretch of that of F.
        size = size / np.clip(np.abs(np.asarray(expected[2])), 1e-4, 1)
        assert largest(rest[0], expected[2], np.abs(np.asarray(H)).max((1, 2)) + 1) < tolerance
    assert largest(tau, expected[0], MU * size) < 10 * tolerance
    assert largest(change, expected[1], size * (1 + np.abs(H).max((1, 2)))) < tolerance


@pytest.mark.parametrize(("dtype", "tolerance"), PRECISIONS)
@pytest.mark.parametrize(
    ("flow", "history"),
    [
        pytest.param(pm.VonMises(1e3), None, id="metal"),
        pytest.param(pm.VonMises(1e3, hardening=0.3), 0.0, id="hardening-fresh"),
        pytest.param(pm.VonMises(1e3, hardening=0.3), 0.03, id="hardening-used"),
        pytest.param(pm.VonMises(np.inf), None, id="rigid"),
        pytest.param(pm.DruckerPrager(30.0), None, id="sand"),
        pytest.param(MOIST, 0.0, id="moist-fresh"),
        pytest.param(MOIST, 0.03, id="moist-used"),
    ],
)
def test_return_map(flow, history, dtype, tolerance):
    H = matrices(dtype)
    flow, law = cast((flow, pm.StVKHencky(1e5, 0.3)), dtype)
    before = None if history is None else jnp.asarray(history, dtype)
    run = jax.vmap(lambda H: flow.return_map(H, before, law, jnp.zeros((), dtype)))
    text = jax.jit(run).lower(H).as_text()
    assert "pgjax_von_mises_" in text or "pgjax_drucker_prager_" in text
    mapped, after = run(H)
    # The derivative rules run the plain function.
    expected, expected_after = jax.jvp(run, (H,), (H,))[0]
    stretch = np.linalg.svd(np.asarray(H, float) + np.eye(3), compute_uv=False)
    condition = stretch[:, 0] / np.maximum(stretch[:, 2], 1e-3)
    assert largest(mapped, expected, 10 * condition) < tolerance
    if history is not None:
        assert largest(after, expected_after, 10 * condition) < tolerance
    # What does not flow keeps its bits.
    if isinstance(flow, pm.VonMises) and np.isinf(float(flow.yield_stress)):
        np.testing.assert_array_equal(mapped, H)


@pytest.mark.float64
def test_derivatives_are_those_of_the_plain_law():
    H = matrices(jnp.float64)[:200]
    law = pm.FixedCorotated(1e5, 0.3)

    def stress(H):
        return jax.vmap(lambda H: law.kirchhoff(H, H))(H)

    rng = np.random.default_rng(5)
    dH, bar = (jnp.asarray(rng.normal(size=H.shape)) for _ in range(2))
    tangent = jax.jvp(stress, (H,), (dH,))[1]
    (cotangent,) = jax.vjp(stress, H)[1](bar)
    np.testing.assert_allclose(jnp.vdot(bar, tangent), jnp.vdot(cotangent, dH), rtol=1e-12)
    step = 1e-6
    numeric = (stress(H + step * dH) - stress(H - step * dH)) / (2 * step)
    np.testing.assert_allclose(
        tangent, numeric, rtol=1e-6, atol=2e-6 * float(np.abs(numeric).max())
    )


def test_batches_of_one_and_of_none():
    law = cast(pm.NeoHookean(1e5, 0.3), jnp.float32)
    H = matrices(jnp.float32)[5:9]
    stress = lambda H: law.kirchhoff(H, H)  # noqa: E731
    nested = jax.vmap(jax.vmap(stress))(H.reshape(2, 2, 3, 3)).reshape(4, 3, 3)
    np.testing.assert_array_equal(nested, jax.vmap(stress)(H))
    np.testing.assert_array_equal(stress(H[0]), nested[0])
    assert jax.vmap(stress)(H[:0]).shape == (0, 3, 3)
