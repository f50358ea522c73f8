"""The renderer under the transformations of JAX, natively and in plain JAX."""

import dataclasses
import functools
import hashlib
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import floats, hard_scene, looking

from pgjax import native
from pgjax.render import RULE_3DGS, Camera, Rule, render
from pgjax.render.compositing import default_capacity
from pgjax.render.primitive import adjoint_p, composite_p, tangent_p
from pgjax.render.reference import render_reference

DOUBLE = jax.config.jax_enable_x64
TIGHT = 1e-12 if DOUBLE else 1e-4
RULES = [RULE_3DGS, Rule(alpha_max=0.999, stop=0, smooth=True)]
needs_compiler = pytest.mark.skipif(native.compiler() is None, reason="no C++ compiler")


def assert_equal(actual, expected, tolerance=TIGHT):
    actual, expected = jax.tree.leaves(actual), jax.tree.leaves(expected)
    for a, b in zip(actual, expected, strict=True):
        scale = max(float(np.max(np.abs(b), initial=0)), 1e-30)
        np.testing.assert_allclose(np.asarray(a) / scale, np.asarray(b) / scale, atol=tolerance)


def cameras(n):
    """A few cameras as one record with a leading axis."""
    angles = np.linspace(-0.2, 0.2, n)
    each = [
        Camera.look_at(
            [3 * np.sin(a), 0, 0], [0, 0, 3], up=[0, -1, 0], focal=45, width=45, height=33
        )
        for a in angles
    ]
    return each, jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def shown(image):
    return {"rgb": image.rgb, "alpha": image.alpha, "depth_acc": image.depth_acc}


def operands(rule, channels=4, seed=0):
    """Of the primitive: limits, shape, values, key of splats that are hard to draw."""
    rng = np.random.default_rng(seed)
    n = 200
    center = rng.uniform([-10, -10], [55, 43], (n, 2))
    yy, det = np.exp(rng.uniform(-1, 5, n)), np.exp(rng.uniform(-2, 6, n))
    xy = rng.normal(size=n) * yy
    opacity = rng.choice([0, 0.002, 0.3, 0.9, 1.0], n)
    shape = np.stack([*center.T, xy / yy, yy / (2 * det), 1 / (2 * yy), opacity], axis=-1)
    # What no projection makes, but must do no harm.
    shape[range(6), range(6)] = [np.nan, np.inf, -np.inf, np.nan, np.inf, np.nan]
    shape[6, 3], shape[7, 4], shape[8, :2] = -1.0, 0.0, [1e30, -1e30]
    key = rng.integers(0, 50, n).astype(float)
    key[9] = np.nan
    limits = [rule.alpha_max, rule.alpha_min, rule.stop, float(rule.smooth)]
    return tuple(map(floats, (limits, shape, rng.normal(size=(n, channels)), key)))


@needs_compiler
@pytest.mark.parametrize(
    ("rule", "channels", "chosen"),
    [
        pytest.param(RULES[0], 4, slice(1, None, 3), id="3dgs, some"),
        pytest.param(RULES[0], 4, slice(None), id="3dgs", marks=pytest.mark.slow),
        pytest.param(RULES[1], 7, slice(None), id="smooth", marks=pytest.mark.slow),
    ],
)
def test_native_and_plain_agree(monkeypatch, rule, channels, chosen):
    """Image, tangent and adjoint; single, batched, and with shared and own operands."""
    scene = [a[None] for a in operands(rule, channels)]
    rng = np.random.default_rng(1)

    def drawn(batch, *shape):
        return floats(rng.normal(size=(batch, *shape)))

    static = {"width": 45, "height": 33, "capacity": default_capacity(200, 45, 33)}
    several = [scene[0], jnp.concatenate([scene[1], 1.1 * scene[1]]), scene[2], scene[3]]
    cases = [
        (composite_p, scene),
        (composite_p, several),
        (tangent_p, [*scene, drawn(1, 200, 6), drawn(1, 200, channels)]),
        (tangent_p, [*scene, drawn(3, 200, 6), drawn(3, 200, channels)]),
        (tangent_p, [*scene, drawn(3, 200, 6), drawn(1, 200, channels)]),
        (tangent_p, [*several, drawn(2, 200, 6), drawn(1, 200, channels)]),
        (adjoint_p, [*scene, drawn(2, 33, 45, channels), drawn(2, 33, 45)]),
        (adjoint_p, [*several, drawn(1, 33, 45, channels), drawn(2, 33, 45)]),
    ]
    results = {}
    for switch in ("0", "1"):
        monkeypatch.setenv("PGJAX_NATIVE", switch)
        jax.clear_caches()
        results[switch] = [
            jax.jit(functools.partial(primitive.bind, **static))(*given)[:2]
            for primitive, given in cases[chosen]
        ]
    for native_result, plain_result in zip(results["1"], results["0"], strict=True):
        for leaf in native_result:
            assert np.all(np.isfinite(leaf))
        assert_equal(native_result, plain_result, 1e-10 if DOUBLE else 2e-3)
    jax.clear_caches()


def test_cameras_in_a_batch():
    scene = hard_scene(0)
    each, stacked = cameras(3)
    together = jax.vmap(lambda camera: render(scene, camera))(stacked)
    for i, camera in enumerate(each):
        assert_equal(
            shown(jax.tree.map(lambda a, i=i: a[i], together)), shown(render(scene, camera))
        )


def test_deformed_scenes_in_a_batch():
    scene = hard_scene(0)
    shifts = floats([0.0, 0.1, 0.2])

    def shifted(t):
        return shown(render(dataclasses.replace(scene, means=scene.means + t), looking(45, 33)))

    together = jax.vmap(shifted)(shifts)
    for i, t in enumerate(shifts):
        assert_equal(jax.tree.map(lambda a, i=i: a[i], together), shifted(t))
    # Batches of batches, and both scene and camera.
    _, stacked = cameras(2)
    both = jax.vmap(
        jax.vmap(
            lambda t, camera: render(dataclasses.replace(scene, means=scene.means + t), camera).rgb,
            in_axes=(0, None),
        ),
        in_axes=(None, 0),
    )(shifts, stacked)
    assert both.shape == (2, 3, 33, 45, 3)
    one = render(
        dataclasses.replace(scene, means=scene.means + shifts[2]),
        jax.tree.map(lambda a: a[1], stacked),
    )
    assert_equal(both[1, 2], one.rgb)


def bend(scene, parameters):
    """A scene as a function of a few parameters."""
    means = scene.means + parameters[0] * jnp.roll(scene.means, 1, axis=1) + parameters[1]
    return dataclasses.replace(
        scene, means=means, factors=scene.factors * parameters[2], sh=scene.sh * parameters[3]
    )


@pytest.mark.slow
def test_jacobians_of_a_few_parameters():
    """By forward mode, one tangent at a time and all at once, and by reverse mode."""
    scene, at = hard_scene(1), floats([0.01, 0.02, 1.0, 1.0])

    def image(parameters):
        made = render(bend(scene, parameters), looking(21, 17))
        return jnp.stack([made.alpha, made.depth_acc, made.rgb[..., 0]])

    forward = jax.jit(jax.jacfwd(image))(at)
    basis = floats(np.eye(4))
    single = [jax.jit(lambda d: jax.jvp(image, (at,), (d,))[1])(direction) for direction in basis]
    assert_equal(forward, jnp.stack(single, axis=-1))

    def pixel(parameters):
        return image(parameters)[:, 8, 8:11]

    reverse = jax.jit(jax.jacrev(pixel))(at)
    assert_equal(reverse, forward[:, 8, 8:11], 1e-11 if DOUBLE else 1e-3)


def test_several_tangents_are_one_call():
    """Their alphas are evaluated once."""
    scene = operands(RULE_3DGS)
    jaxpr = jax.make_jaxpr(
        jax.vmap(lambda d: jax.jvp(lambda values: native_call(scene, values), (scene[2],), (d,))[1])
    )(jnp.ones((5, *scene[2].shape), scene[2].dtype))
    calls = [e for e in jaxpr.eqns if e.primitive is tangent_p]
    assert len(calls) == 1
    assert [v.aval.shape[0] for v in calls[0].invars] == [1, 1, 1, 1, 1, 5]


def native_call(scene, values):
    static = {"width": 45, "height": 33, "capacity": 1000}
    given = [a[None] for a in (scene[0], scene[1], values, scene[3])]
    return composite_p.bind(*given, **static)[0]


def test_gradients_through_frames():
    """A scan of checkpointed frames is the sum of its frames."""
    scene = hard_scene(2)
    shifts = floats(np.linspace(0, 0.2, 4))

    def loss(means, t):
        moved = dataclasses.replace(scene, means=means + t)
        return jnp.sum(render(moved, looking(21, 17)).rgb ** 2)

    @jax.jit
    @jax.grad
    def over_frames(means):
        def frame(total, t):
            return total + jax.checkpoint(loss)(means, t), None

        return jax.lax.scan(frame, jnp.zeros((), means.dtype), shifts)[0]

    gradient = jax.jit(jax.grad(loss))
    expected = sum(gradient(scene.means, t) for t in shifts)
    assert_equal(over_frames(scene.means), expected)


@pytest.mark.parametrize(
    "switch",
    ["1", pytest.param("0", marks=pytest.mark.slow)],
    ids=["native", "plain"],
)
def test_shards_of_a_batch(monkeypatch, switch):
    monkeypatch.setenv("PGJAX_NATIVE", switch)
    jax.clear_caches()
    scene = hard_scene(0)
    axis_types = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((1,), ("i",), axis_types=axis_types)
    along = jax.sharding.PartitionSpec("i")

    def loss(t):
        return jnp.sum(render(bend(scene, t), looking(21, 17)).rgb ** 2)

    def each(ts):
        return jax.vmap(jax.grad(loss))(ts)

    at = floats(np.stack([[0.01, 0.02, 1, 1], [0, 0, 1, 1]]))
    shards = jax.jit(jax.shard_map(each, mesh=mesh, in_specs=along, out_specs=along))
    assert_equal(shards(at), jax.jit(each)(at))
    jax.clear_caches()


@pytest.mark.float64
def test_an_image_has_the_precision_of_its_gaussians():
    scene = hard_scene(0)
    single = jax.tree.map(lambda a: a.astype(jnp.float32), scene)
    image = render(single, looking(45, 33))
    assert image.rgb.dtype == image.depth.dtype == jnp.float32
    assert_equal(shown(image), shown(render(scene, looking(45, 33))), 2e-2)


def test_features_are_channels_like_any_other():
    scene = hard_scene(0)
    plain = render(scene, looking(45, 33))
    assert plain.features.shape == (33, 45, 0)
    depth = (scene.means @ looking(45, 33).world_to_camera[:3, :3].T)[:, 2:]
    features = jnp.concatenate([depth, jnp.ones_like(depth)], axis=1)
    image = render(scene, looking(45, 33), features=features)
    assert_equal(image.features[..., 0], plain.depth_acc)
    assert_equal(image.features[..., 1], plain.alpha)
    assert_equal(shown(image), shown(plain))
    with pytest.raises(ValueError, match="Argument `features` must have one row for each of 96"):
        render(scene, looking(45, 33), features=features[1:])


def test_the_background_may_be_an_image():
    scene, camera = hard_scene(0), looking(45, 33)
    behind = np.random.default_rng(0).uniform(size=(33, 45, 3))
    image = render(scene, camera, background=floats(behind))
    expected, _, _ = render_reference(scene, camera, background=behind)
    np.testing.assert_allclose(image.rgb, expected, atol=1e-6 if DOUBLE else 2e-2)


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_smooth_cutoff_matches_its_definition(antialiased):
    rule, camera = Rule(smooth=True), looking(45, 33)
    for seed in range(2):
        scene = hard_scene(seed)
        image = render(scene, camera, rule=rule, antialiased=antialiased)
        expected = render_reference(scene, camera, rule=rule, antialiased=antialiased)
        for found, wanted in zip(shown(image).values(), expected, strict=True):
            error = np.abs(found - wanted)
            assert np.quantile(error, 0.999) < (1e-9 if DOUBLE else 1e-3)


def test_broken_gaussians_are_counted_inside_of_jit():
    scene = hard_scene(0)
    means = scene.means.at[60:63, 1].set(jnp.nan)
    image = jax.jit(lambda means: render(dataclasses.replace(scene, means=means), looking(45, 33)))(
        means
    )
    assert image.not_finite == 3
    assert np.all(np.isfinite(image.rgb))


def test_too_small_a_capacity_is_seen(monkeypatch):
    """In plain JAX: NaN in image and derivatives, and how many pairs are needed."""
    scene, camera = hard_scene(0), looking(45, 33)
    whole = render(scene, camera)
    assert np.all(np.isfinite(whole.rgb))
    # Native code takes fewer pairs: those that are not seen.
    needed = int(whole.pairs)
    monkeypatch.setenv("PGJAX_NATIVE", "0")
    jax.clear_caches()

    def loss(means):
        image = render(dataclasses.replace(scene, means=means), camera, capacity=needed - 1)
        return jnp.sum(image.rgb), image

    (_, short), bar = jax.jit(jax.value_and_grad(loss, has_aux=True))(scene.means)
    assert np.all(np.isnan(short.rgb))
    assert needed <= int(short.pairs) < 1.1 * needed
    assert np.any(np.isnan(bar))
    jax.clear_caches()


RUN = """
    import os, sys
    if sys.argv[1] == "1":
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import dataclasses, hashlib
    import jax, jax.numpy as jnp, numpy as np
    from render_scenes import hard_scene, looking
    from pgjax.render import render

    scene = hard_scene(0, 3000)

    def loss(means):
        return jnp.sum(render(dataclasses.replace(scene, means=means), looking(200, 150, 200.)).rgb)

    value, bar = jax.jit(jax.value_and_grad(loss))(scene.means)
    print(hashlib.sha256(np.asarray(value).tobytes() + np.asarray(bar).tobytes()).hexdigest())
"""


@needs_compiler
@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="needs two processors",
)
def test_the_number_of_threads_changes_nothing(tmp_path):
    script = tmp_path / "run.py"
    script.write_text(textwrap.dedent(RUN))
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    digests = [
        subprocess.run(
            [sys.executable, str(script), threads],
            env={
                **os.environ,
                "PYTHONPATH": path,
                "PGJAX_NATIVE": "1",
            },
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "2")
    ]
    assert len(digests[0].strip()) == hashlib.sha256().digest_size * 2
    assert digests[0] == digests[1]
