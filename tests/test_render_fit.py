"""Gaussians fitted to a picture, from a random start."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from render_scenes import floats, looking

from pgjax.render import Gaussians, render

SIZE = 48


def picture():
    """A disc and a square over a gradient, with soft edges."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE
    disc = 1 / (1 + np.exp(60 * (np.hypot(x - 0.35, y - 0.4) - 0.22)))
    square = 1 / (1 + np.exp(60 * (np.maximum(np.abs(x - 0.7), np.abs(y - 0.65)) - 0.17)))
    image = np.stack([0.2 + 0.3 * x, 0.3 + 0.2 * y, 0.5 + 0 * x], axis=-1)
    for mask, colour in ((disc, [0.9, 0.2, 0.1]), (square, [0.1, 0.8, 0.3])):
        image += mask[..., None] * (np.array(colour) - image)
    return floats(image)


def gaussians_of(p):
    return Gaussians.from_scales(
        p["means"], p["quaternions"], jnp.exp(p["scales"]), jax.nn.sigmoid(p["logits"]), p["sh"]
    )


def test_a_fit_from_a_random_start_converges():
    n, rng = 300, np.random.default_rng(0)
    start = {
        "means": rng.uniform([-0.5, -0.5, 0.9], [0.5, 0.5, 1.1], (n, 3)),
        "quaternions": rng.normal(size=(n, 4)),
        "scales": np.full((n, 3), np.log(0.04)),
        "logits": np.zeros(n),
        "sh": 0.3 * rng.normal(size=(n, 1, 3)),
    }
    target, camera = picture(), looking(SIZE, SIZE, focal=float(SIZE))
    optimiser = optax.adam(optax.exponential_decay(2e-2, 300, 0.1))

    def loss(p):
        return jnp.mean((render(gaussians_of(p), camera).rgb - target) ** 2)

    def step(carry, _):
        p, state = carry
        value, gradient = jax.value_and_grad(loss)(p)
        change, state = optimiser.update(gradient, state, p)
        return (optax.apply_updates(p, change), state), value

    @jax.jit
    def fit(p):
        return jax.lax.scan(step, (p, optimiser.init(p)), length=300)

    # optax mixes its integers and floating-point numbers.
    with jax.numpy_dtype_promotion("standard"):
        (fitted, _), losses = fit(jax.tree.map(floats, start))
    assert losses[0] > 1e-2
    # 40 dB.
    assert loss(fitted) < 1e-4
    assert np.all(np.isfinite(losses))
