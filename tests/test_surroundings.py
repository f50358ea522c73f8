"""Moving Gaussians among still ones that were projected once: the same picture, by depth."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import floats, hard_scene, looking

from pgjax.render import (
    RULE_3DGS,
    RULE_EXACT,
    Gaussians,
    Rule,
    concatenate,
    prepare_surroundings,
    render,
    surroundings,
)

DOUBLE = jax.config.jax_enable_x64
TIGHT = 1e-12 if DOUBLE else 2e-5
CAMERA = looking(45, 33)
BACKGROUND = (0.2, 0.5, 1.0)


def halves():
    """Moving and still Gaussians that lie in front of, behind, between and on each other."""
    scene = hard_scene(0)
    return scene[::3], concatenate([scene[1::3], scene[2::3]])


def flat(gaussians):
    """With the harmonics of degree 0 alone."""
    return dataclasses.replace(gaussians, sh=gaussians.sh[:, :1])


def assert_same(image, expected):
    for name in ("rgb", "alpha", "depth", "depth_acc", "features"):
        np.testing.assert_allclose(
            getattr(image, name), getattr(expected, name), rtol=TIGHT, atol=TIGHT
        )
    assert image.not_finite == expected.not_finite
    assert image.pairs == expected.pairs


@pytest.mark.parametrize(
    ("native", "rule", "antialiased"),
    [
        ("1", RULE_3DGS, False),
        pytest.param("1", RULE_EXACT, True, marks=pytest.mark.slow),
        pytest.param("1", Rule(smooth=True), False, marks=pytest.mark.slow),
        pytest.param("0", RULE_3DGS, True, marks=pytest.mark.slow),
    ],
)
def test_the_picture_is_that_of_all_together(monkeypatch, rule, antialiased, native):
    monkeypatch.setenv("PGJAX_NATIVE", native)
    jax.clear_caches()
    moving, still = halves()
    rng = np.random.default_rng(0)
    own, theirs = floats(rng.normal(size=(32, 2))), floats(rng.normal(size=(64, 2)))
    options = {"rule": rule, "antialiased": antialiased}
    around = prepare_surroundings(still, CAMERA, features=theirs, **options)
    for shift in (0.0, 0.4):
        moved = dataclasses.replace(moving, means=moving.means + shift)
        image = around.render(moved, background=BACKGROUND, features=own)
        features = jnp.concatenate([own, theirs])
        together = concatenate([moved, still])
        expected = render(together, CAMERA, background=BACKGROUND, features=features, **options)
        assert_same(image, expected)
    jax.clear_caches()


def test_what_moves_is_seen_in_front_between_and_behind():
    """Three opaque discs, of which the red one moves along the view."""

    def discs(depths, colors):
        n = len(depths)
        means = floats([[0, 0, z] for z in depths])
        sh = (floats(colors)[:, None] - 0.5) / 0.28209479177387814
        turns = floats(np.tile([1.0, 0, 0, 0], (n, 1)))
        scales = floats(np.tile([0.5, 0.5, 1e-3], (n, 1)))
        return Gaussians.from_scales(means, turns, scales, floats(np.full(n, 0.5)), sh)

    green, blue = [0.0, 1, 0], [0.0, 0, 1]
    around = prepare_surroundings(discs([2.0, 4.0], [green, blue]), looking(9, 9))
    weights = {1.0: (0.5, 0.25, 0.125), 3.0: (0.25, 0.5, 0.125), 5.0: (0.125, 0.5, 0.25)}
    for depth, expected in weights.items():
        image = around.render(discs([depth], [[1.0, 0, 0]]))
        np.testing.assert_allclose(image.rgb[4, 4], expected, atol=1e-4)


@pytest.mark.parametrize(("ours", "theirs"), [(flat, lambda g: g), (lambda g: g, flat)])
def test_degrees_may_differ(ours, theirs):
    moving, still = (part(g) for part, g in zip((ours, theirs), halves(), strict=True))
    image = prepare_surroundings(still, CAMERA).render(moving)
    assert_same(image, render(concatenate([moving, still]), CAMERA))


@pytest.mark.float64
def test_there_may_be_none_of_either():
    moving, still = halves()
    assert_same(prepare_surroundings(still[:0], CAMERA).render(moving), render(moving, CAMERA))
    assert_same(prepare_surroundings(still, CAMERA).render(moving[:0]), render(still, CAMERA))


def loss(image):
    target = jnp.linspace(0, 1, image.rgb.size, dtype=image.rgb.dtype).reshape(image.rgb.shape)
    return jnp.sum((image.rgb - target) ** 2) + jnp.sum(image.depth)


@pytest.mark.slow
@pytest.mark.float64
def test_derivatives_are_those_of_all_together():
    """Of what moves, of what stands still where it is prepared inside, and forward as reverse."""
    moving, still = halves()

    def among(moving, still):
        return loss(prepare_surroundings(still, CAMERA).render(moving))

    def together(moving, still):
        return loss(render(concatenate([moving, still]), CAMERA))

    found = jax.jit(jax.grad(among, argnums=(0, 1)))(moving, still)
    expected = jax.jit(jax.grad(together, argnums=(0, 1)))(moving, still)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        scale = max(float(jnp.abs(b).max()), 1.0)
        np.testing.assert_allclose(a / scale, b / scale, atol=1e-10 if DOUBLE else 1e-3)
    around = prepare_surroundings(still, CAMERA)
    alone = jax.grad(lambda means: loss(around.render(dataclasses.replace(moving, means=means))))
    bar = alone(moving.means)
    scale = float(jnp.abs(found[0].means).max())
    np.testing.assert_allclose(bar / scale, found[0].means / scale, atol=1e-10 if DOUBLE else 1e-3)
    rng = np.random.default_rng(0)
    step = floats(rng.normal(size=moving.means.shape))
    _, slope = jax.jvp(
        lambda means: loss(around.render(dataclasses.replace(moving, means=means))),
        (moving.means,),
        (step,),
    )
    np.testing.assert_allclose(slope, jnp.vdot(bar, step), rtol=1e-9 if DOUBLE else 1e-2)


def test_frames_do_not_recompile():
    moving, still = halves()
    around = prepare_surroundings(still, CAMERA)
    around.render(moving)
    compiled = surroundings._render_among._cache_size()
    around.render(dataclasses.replace(moving, means=moving.means + 0.1))
    prepare_surroundings(still, looking(45, 33, focal=50.0), rule=RULE_EXACT).render(moving)
    assert surroundings._render_among._cache_size() == compiled


def test_what_is_not_finite_is_counted_on_both_sides():
    moving, still = halves()
    broken = dataclasses.replace(still, means=still.means.at[3, 0].set(jnp.nan))
    around = prepare_surroundings(broken, CAMERA)
    with pytest.warns(UserWarning, match="2 of 96 Gaussians are not finite"):
        image = around.render(dataclasses.replace(moving, means=moving.means.at[0].set(jnp.inf)))
    assert image.not_finite == 2


def test_what_does_not_fit_is_refused():
    moving, still = halves()
    around = prepare_surroundings(still, CAMERA, features=still.means[:, :2])
    with pytest.raises(ValueError, match="`features` must have 2 columns like the features of the"):
        around.render(moving)
    with pytest.raises(ValueError, match="`features` must have one row for each of 32 Gaussians"):
        around.render(moving, features=still.means[:, :2])
    with pytest.raises(ValueError, match="`background` must be three numbers or an image"):
        around.render(moving, background=jnp.zeros((3, 3, 3)), features=moving.means[:, :2])
    other = jnp.float16
    wrong = jax.tree.map(lambda leaf: leaf.astype(other), moving)
    with pytest.raises(ValueError, match="`moving` must have the precision float"):
        around.render(wrong, features=moving.means[:, :2])
