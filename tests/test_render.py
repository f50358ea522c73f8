"""The rasteriser against renders of another renderer, and against its plain reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import floats, hard_scene, looking

from pgjax.render import (
    RULE_3DGS,
    RULE_EXACT,
    RULE_GSPLAT15,
    Camera,
    Gaussians,
    Rule,
    compositing,
    deform,
    rasterize,
    render,
    tiles,
)
from pgjax.render.reference import render_reference

DOUBLE = jax.config.jax_enable_x64
RULES = {
    "head_inria": RULE_3DGS,
    "gsplat15": RULE_GSPLAT15,
    "nostop99": Rule(stop=0),
    "nostop": RULE_EXACT,
}


def assert_close(actual, expected, *, tight=1e-6, scale=1.0):
    """The tolerances of the reference data: its inputs are float32, and the cutoff is a jump."""
    error = np.abs(np.asarray(actual) - expected) / scale
    pixels = error.reshape(*error.shape[:2], -1).max(axis=-1)
    if DOUBLE:
        assert np.quantile(pixels, 0.999) < tight
        assert pixels.max() < 20 * tight
    else:
        assert np.quantile(pixels, 0.999) < 1e-4
        assert np.count_nonzero(pixels > 1e-3) <= 20


@pytest.mark.parametrize("name", ["playbot8k", "playbot8k_aa"])
def test_matches_the_reference_renders(reference_data, name):
    data = np.load(reference_data / "renders" / f"{name}.npz")
    parts = ("means", "quats", "scales", "opacities", "sh")
    gaussians = Gaussians.from_scales(*(floats(data[part]) for part in parts))
    (fx, _, cx), (_, fy, cy), _ = data["K"].tolist()
    camera = Camera(floats(data["viewmat"]), fx, fy, cx, cy, 200, 200)
    for suffix, rule in RULES.items():
        image = render(
            gaussians,
            camera,
            background=data["background"],
            rule=rule,
            antialiased=bool(data["antialiased"]),
        )
        assert_close(image.rgb, data[f"image_{suffix}"])
        assert_close(image.alpha, data[f"alpha_{suffix}"])
        if suffix == "gsplat15":
            # The depths are near 4, and accumulate what the cutoff drops with that weight.
            assert_close(image.depth_acc, data["depth_acc"], tight=2e-5, scale=4)
            seen = data["alpha_gsplat15"] > 0.01
            expected = data["depth_acc"] / np.where(seen, data["alpha_gsplat15"], 1)
            np.testing.assert_allclose(image.depth[seen], expected[seen], rtol=1e-3)


def assert_matches_oracle(gaussians, camera, **options):
    image = render(gaussians, camera, **options)
    rgb, alpha, depth_acc = render_reference(gaussians, camera, **options)
    assert_close(image.rgb, rgb, tight=1e-8)
    assert_close(image.alpha, alpha, tight=1e-8)
    assert_close(image.depth_acc, depth_acc, tight=1e-8)
    expected = np.where(alpha > 1e-3, depth_acc / np.where(alpha > 1e-3, alpha, 1), image.depth)
    np.testing.assert_allclose(image.depth, expected, rtol=1e-9 if DOUBLE else 2e-2)
    return image


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("rule", [RULE_3DGS, RULE_EXACT])
def test_hard_scenes_match_the_oracle(rule, antialiased):
    for seed in range(3):
        assert_matches_oracle(
            hard_scene(seed),
            looking(45, 33),
            background=(0.2, 0.5, 1),
            rule=rule,
            antialiased=antialiased,
        )


def test_large_images_match_the_oracle():
    # 16×16 tiles, and a principal point outside the middle.
    camera = Camera(floats(np.eye(4)), 300.0, 280.0, 150.0, 12.0, 417, 18)
    assert_matches_oracle(hard_scene(7), camera)


@pytest.mark.slow
def test_runs_longer_than_an_item_and_a_batch_change_nothing(monkeypatch):
    """In plain JAX, whose lists are cut into pieces."""
    scene, camera = hard_scene(3), looking(45, 33)
    expected = render(scene, camera)
    monkeypatch.setenv("PGJAX_NATIVE", "0")
    monkeypatch.setattr(compositing, "_PIXELS", 8 * 64)
    monkeypatch.setattr(compositing, "_ITEM", 4)
    jax.clear_caches()
    eps = float(jnp.finfo(expected.rgb.dtype).eps)
    np.testing.assert_allclose(render(scene, camera).rgb, expected.rgb, atol=100 * eps)
    jax.clear_caches()


def test_thousands_of_gaussians_on_one_pixel():
    n, opacity = 40_000, 0.004
    means = floats(np.tile([0.0, 0, 2], (n, 1)))
    ones = floats(np.ones((n, 3)))
    scene = Gaussians.from_scales(
        means, floats(np.tile([1.0, 0, 0, 0], (n, 1))), ones, ones[:, 0] * opacity, ones[:, None]
    )
    image = render(scene, looking(8, 8, focal=20000.0), rule=RULE_EXACT)
    np.testing.assert_allclose(image.alpha, 1 - (1 - opacity) ** n, rtol=1e-4)
    np.testing.assert_allclose(image.depth, 2, rtol=1e-4)


def test_nothing_in_view_is_the_background():
    scene = hard_scene(0)
    for empty in (scene[:0], scene[:8]):
        image = render(empty, looking(45, 33), background=(0.25, 0.5, 0.75))
        np.testing.assert_array_equal(image.rgb, np.broadcast_to([0.25, 0.5, 0.75], (33, 45, 3)))
        assert not np.any(image.alpha)
        assert not np.any(image.depth)


def test_gaussians_that_are_not_finite_are_counted_and_left_out():
    scene = hard_scene(0)
    broken = jax.tree.map(jnp.array, scene)
    object.__setattr__(broken, "means", scene.means.at[60, 1].set(jnp.nan))
    object.__setattr__(broken, "factors", scene.factors.at[61, 0, 0].set(jnp.inf))
    with pytest.warns(UserWarning, match="2 of 96 Gaussians are not finite"):
        image = render(broken, looking(45, 33))
    kept = np.ones(96, dtype=bool)
    kept[60:62] = False
    np.testing.assert_array_equal(image.rgb, render(scene[kept], looking(45, 33)).rgb)


def test_new_positions_views_and_rules_do_not_recompile():
    scene = hard_scene(0)
    render(scene, looking(45, 33))
    compiled = rasterize._render._cache_size()
    F = jnp.broadcast_to(jnp.eye(3, dtype=scene.means.dtype) * 1.1, scene.factors.shape)
    render(deform(scene, scene.means + 0.1, F), looking(45, 33, focal=50.0), rule=RULE_GSPLAT15)
    assert compiled == rasterize._render._cache_size()


def test_tiles_are_complete_and_tight():
    rng = np.random.default_rng(1)
    n, grid = 200, tiles.TileGrid(8, 7, 5)
    center = rng.uniform([-20, -20], [76, 60], (n, 2))
    L = np.exp(rng.uniform(0, 3, (n, 2, 1))) * rng.normal(size=(n, 2, 2))
    A = L @ L.transpose(0, 2, 1) + 0.3 * np.eye(2)
    reach = rng.uniform(0.01, 5.5, n)
    yy = A[:, 1, 1]
    form = [A[:, 0, 1] / yy, yy / (2 * np.linalg.det(A)), 1 / (2 * yy), np.ones(n)]
    shape, reach = floats(np.stack([*center.T, *form], axis=-1)), floats(reach)
    needed = int(tiles.count_pairs(shape, reach, grid))
    number, splat = (np.asarray(a) for a in tiles.list_pairs(shape, reach, grid, needed + 8))
    assert np.all(np.diff(number) >= 0)
    listed = set(zip(splat[splat < n], number[splat < n], strict=True))
    y, x = np.mgrid[: grid.rows * 8, : grid.columns * 8] + 0.5
    d = np.stack([x, y], axis=-1) - center[:, None, None]
    sigma = 0.5 * np.einsum("nhwi,nij,nhwj->nhw", d, np.linalg.inv(A), d)
    inside = (sigma <= np.asarray(reach)[:, None, None]).reshape(n, grid.rows, 8, grid.columns, 8)
    touched = np.argwhere(inside.any(axis=(2, 4)).reshape(n, grid.count))
    assert len(touched) > 900
    assert {tuple(pair) for pair in touched} <= listed
    # The rest are ellipses that pass between pixel centres.
    assert len(listed) < 1.05 * len(touched)
    assert len(listed) <= needed


@pytest.mark.parametrize(
    "options",
    [{"alpha_max": 1.0}, {"alpha_min": 0}, {"stop": 1}, {"smooth": True, "alpha_min": 0.6}],
)
def test_rules_are_checked(options):
    name = next(iter(options))
    with pytest.raises(ValueError, match=f"Argument `{name}` must"):
        Rule(**options)


def test_background_is_checked():
    with pytest.raises(ValueError, match="Argument `background` must be three numbers"):
        render(hard_scene(0), looking(45, 33), background=(1, 1))
