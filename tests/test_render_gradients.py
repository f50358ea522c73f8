"""Derivatives of images: against another renderer, finite differences, each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import floats, hard_scene, looking, smooth_scene

from pgjax.render import RULE_3DGS, RULE_EXACT, Camera, Gaussians, Rule, rasterize, render
from pgjax.render.compositing import default_capacity
from pgjax.render.projection import project

DOUBLE = jax.config.jax_enable_x64
SMOOTH = Rule(alpha_max=0.999, stop=0, smooth=True)
# Practically without a cutoff: no alpha in these scenes is near it and counts.
WITHOUT_CUTOFF = Rule(alpha_max=0.999, alpha_min=1e-14, stop=0)


def norm(tree):
    return np.sqrt(
        sum(np.sum(np.square(np.asarray(leaf, float))) for leaf in jax.tree.leaves(tree))
    )


def weights(seed, image):
    """One random number for each of the image's."""
    rng = np.random.default_rng(seed)
    return {
        name: floats(rng.normal(size=getattr(image, name).shape))
        for name in ("rgb", "alpha", "depth", "depth_acc", "features")
    }


def weighted(image, W):
    return sum(jnp.sum(w * getattr(image, name)) for name, w in W.items())


@pytest.mark.parametrize(("name", "rule"), [("head", RULE_3DGS), ("nostop_aa", RULE_EXACT)])
def test_matches_the_reference_gradients(reference_data, name, rule):
    data = np.load(reference_data / "renders" / f"playbot1k9_gradients_{name}.npz")
    variances, axes = np.linalg.eigh(data["covars"])
    factors = axes * np.sqrt(np.maximum(variances, 0))[:, None]
    frames = np.broadcast_to(np.eye(3), factors.shape)
    parts = (data["means"], factors, data["opacities"], data["sh"], frames)
    gaussians = Gaussians(*map(floats, parts))
    (fx, _, cx), (_, fy, cy), _ = data["K"].tolist()
    camera = Camera(floats(data["viewmat"]), fx, fy, cx, cy, 96, 96)
    antialiased = bool(data["antialiased"])

    @jax.jit
    def gradients(gaussians):
        def loss(gaussians):
            image = render(
                gaussians,
                camera,
                background=data["background"],
                rule=rule,
                antialiased=antialiased,
            )
            W = {"rgb": "W_rgb", "alpha": "W_alpha", "depth_acc": "W_depth"}
            return weighted(image, {key: floats(data[value]) for key, value in W.items()})

        return jax.grad(loss)(gaussians)

    found = gradients(gaussians)
    expected = {
        "means": data["g_means"],
        "opacities": data["g_opacities"],
        "sh": data["g_sh"],
        "factors": 2 * data["g_covars_sym"] @ factors,
    }
    tolerance = (1e-7 if antialiased else 1e-9) if DOUBLE else (5e-3 if antialiased else 1e-4)
    for part, value in expected.items():
        assert norm(getattr(found, part) - value) < tolerance * norm(value), part


def parameters(seed, scene=smooth_scene):
    """Everything an image depends on, and a direction in which to move it all."""
    rng = np.random.default_rng(seed + 100)
    gaussians = scene(seed)
    point = {
        "means": gaussians.means,
        "factors": gaussians.factors,
        "opacities": gaussians.opacities,
        "sh": gaussians.sh,
        "pose": looking(45, 33).world_to_camera[:3],
        "background": floats(rng.uniform(size=(33, 45, 3))),
        "features": floats(rng.normal(size=(len(gaussians), 2))),
    }
    direction = {name: floats(rng.normal(size=value.shape)) for name, value in point.items()}
    direction["factors"] = direction["factors"] * gaussians.factors
    return gaussians, point, direction


def frozen(gaussians, point, rule, antialiased=False):
    """The image as a function of the parameters, in the order in depth that it has at `point`."""
    constants = rasterize.constants_of(rule, gaussians.means.dtype)

    def splats(p):
        parts = {name: p[name] for name in ("means", "factors", "opacities", "sh")}
        moved = dataclasses.replace(gaussians, **parts)
        last = floats([[0, 0, 0, 1]])
        camera = looking(45, 33)
        camera = dataclasses.replace(camera, world_to_camera=jnp.concatenate([p["pose"], last]))
        return project(moved, camera, constants[4], antialiased=antialiased), camera

    key = splats(point)[0].depth

    def image(p):
        drawn, camera = splats(p)
        capacity = default_capacity(len(gaussians), 45, 33)
        return rasterize.draw(
            drawn, key, camera, p["background"], p["features"], constants[:4], capacity
        )

    return image


@pytest.mark.float64
@pytest.mark.parametrize(
    ("rule", "antialiased"),
    [
        pytest.param(SMOOTH, True, id="smooth, antialiased"),
        pytest.param(SMOOTH, False, id="smooth", marks=pytest.mark.slow),
        pytest.param(WITHOUT_CUTOFF, True, id="no cutoff, antialiased", marks=pytest.mark.slow),
        pytest.param(WITHOUT_CUTOFF, False, id="no cutoff", marks=pytest.mark.slow),
    ],
)
def test_derivatives_match_finite_differences(rule, antialiased):
    for seed in range(2):
        gaussians, point, direction = parameters(seed)
        image = frozen(gaussians, point, rule, antialiased)
        W = weights(seed, jax.eval_shape(image, point))
        loss = jax.jit(lambda p, image=image, W=W: weighted(image(p), W))
        tangent = jax.jit(lambda d, loss=loss, point=point: jax.jvp(loss, (point,), (d,))[1])
        gradient = jax.jit(jax.grad(loss))(point)
        for name, change in direction.items():
            alone = {key: jnp.zeros_like(value) for key, value in point.items()} | {name: change}

            def along(t, alone=alone, loss=loss, point=point):
                return float(loss(jax.tree.map(lambda a, b: a + t * b, point, alone)))

            h = 1e-6
            steps = [(along(s * h) - along(-s * h)) / (2 * s * h) for s in (1, 2)]
            expected = (4 * steps[0] - steps[1]) / 3
            forward = float(tangent(alone))
            reverse = float(jnp.sum(gradient[name] * change))
            size = float(norm(gradient[name]) * norm(change))
            assert abs(forward - reverse) <= 1e-12 * size, name
            assert abs(forward - expected) <= 2e-6 * abs(expected) + 1e-7 * size, name


@pytest.mark.float64
@pytest.mark.parametrize("rule", [RULE_3DGS, RULE_EXACT, SMOOTH], ids=["3dgs", "exact", "smooth"])
@pytest.mark.parametrize("antialiased", [pytest.param(False, marks=pytest.mark.slow), True])
def test_forward_and_reverse_mode_agree(rule, antialiased):
    """In every output, also where finite differences do not converge."""
    for seed in range(2):
        gaussians, point, direction = parameters(seed, scene=hard_scene)
        image = frozen(gaussians, point, rule, antialiased)

        def outputs(p, image=image):
            made = image(p)
            return {name: getattr(made, name) for name in weights(0, made)}

        shapes = jax.eval_shape(image, point)
        W = weights(seed, shapes)
        tangent = jax.jit(lambda f=outputs, p=point, d=direction: jax.jvp(f, (p,), (d,))[1])()
        gradient = jax.jit(lambda f=outputs, p=point, W=W: jax.vjp(f, p)[1](W)[0])()
        forward = sum(float(jnp.sum(W[name] * tangent[name])) for name in W)
        reverse = sum(float(jnp.sum(direction[name] * gradient[name])) for name in direction)
        assert np.isfinite(forward)
        assert abs(forward - reverse) <= 1e-10 * abs(forward)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_finite(antialiased):
    """Whatever is behind, broken, in the camera, of no size, clamped or not drawn."""
    scene = hard_scene(0)
    means = scene.means.at[60, 1].set(jnp.nan).at[61].set(0.0)
    factors = scene.factors.at[62, 0, 0].set(jnp.inf).at[63:66].set(0.0)
    factors = factors.at[66].set(0.2 * jnp.finfo(factors.dtype).max ** 0.5)
    sh = scene.sh.at[67].set(-10.0).at[68].set(0.0).at[68, 0].set(-0.5 * np.sqrt(4 * np.pi))
    scene = dataclasses.replace(scene, means=means, factors=factors, sh=sh)
    W = weights(0, jax.eval_shape(lambda: render(scene, looking(45, 33))))

    @jax.jit
    def gradient(scene, camera):
        def loss(scene, camera):
            image = render(scene, camera, antialiased=antialiased)
            return weighted(image, W), image.not_finite

        return jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(scene, camera)

    (value, broken), bars = gradient(scene, looking(45, 33))
    assert broken == 3
    assert np.isfinite(value)
    for leaf in jax.tree.leaves(bars):
        assert np.all(np.isfinite(leaf))
    for leaf in jax.tree.leaves(bars[0]):
        assert not np.any(leaf[jnp.asarray([0, 60, 62, 66])])


@pytest.mark.float64
def test_a_clamped_alpha_and_an_empty_pixel_have_no_derivative():
    ones = floats(np.ones((1, 3)))
    scene = Gaussians.from_scales(
        floats([[0, 0, 2]]), floats([[1, 0, 0, 0]]), 0.01 * ones, ones[:, 0], ones[:, None]
    )
    camera = looking(9, 9)

    def depth(opacity, means):
        moved = dataclasses.replace(scene, opacities=opacity, means=means)
        return render(moved, camera).depth

    by_opacity, by_mean = jax.jacrev(depth, argnums=(0, 1))(scene.opacities, scene.means)
    assert not np.any(by_opacity[0, 0])
    assert np.all(np.isfinite(by_opacity))
    # The depth of a single Gaussian is its Z wherever it is seen.
    seen = render(scene, camera).alpha > 0
    np.testing.assert_allclose(by_mean[..., 0, 2], np.where(seen, 1, 0), atol=1e-5)

    def alpha(opacity):
        return render(dataclasses.replace(scene, opacities=opacity), camera).alpha

    rate = jax.jacfwd(alpha)(scene.opacities)[..., 0]
    assert rate[4, 4] == 0
    assert rate[4, 5] > 0.1


@pytest.mark.slow
@pytest.mark.float64
def test_second_derivatives():
    """Through the plain functions."""
    gaussians, point, direction = parameters(0)
    image = frozen(gaussians, point, SMOOTH)
    W = weights(0, jax.eval_shape(image, point))
    gradient = jax.jit(jax.grad(lambda p: weighted(image(p), W)))
    found = jax.jit(lambda p, d: jax.jvp(gradient, (p,), (d,))[1])(point, direction)
    h = 1e-6
    ends = [
        gradient(jax.tree.map(lambda a, b, s=s: a + s * h * b, point, direction)) for s in (1, -1)
    ]
    expected = jax.tree.map(lambda a, b: (a - b) / (2 * h), *ends)
    error = jax.tree.map(lambda a, b: a - b, found, expected)
    assert norm(error) < 1e-5 * norm(expected)
