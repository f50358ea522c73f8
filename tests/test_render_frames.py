"""Many cameras, many frames: batches, and memory that does not grow with the length."""

import dataclasses
import gc
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from render_scenes import floats, hard_scene, looking

from pgjax.render import CameraPath, VideoWriter, deform, render, save_video, stack_cameras

DOUBLE = jax.config.jax_enable_x64
TIGHT = 1e-12 if DOUBLE else 2e-5
CAMERAS = [looking(45, 33, focal) for focal in (40.0, 50.0, 60.0)]


def test_a_stack_of_cameras_draws_what_each_draws():
    scene = hard_scene(0)
    images = jax.vmap(lambda camera: render(scene, camera))(stack_cameras(CAMERAS))
    assert images.rgb.shape == (3, 33, 45, 3)
    for i, camera in enumerate(CAMERAS):
        np.testing.assert_allclose(images.rgb[i], render(scene, camera).rgb, rtol=TIGHT, atol=TIGHT)
    mapped = jax.vmap(render, in_axes=(None, 0))(scene, stack_cameras(CAMERAS))
    np.testing.assert_allclose(mapped.rgb, images.rgb, rtol=TIGHT, atol=TIGHT)


def test_a_path_gives_the_cameras_of_a_batch():
    scene, path = hard_scene(0), CameraPath([0.0, 1.0, 2.0], CAMERAS)
    times = floats([0.0, 0.4, 1.0, 1.7])
    images = jax.jit(jax.vmap(lambda t: render(scene, path.at(t)).rgb))(times)
    for image, t in zip(images, times, strict=True):
        expected = render(scene, path.at(t)).rgb
        np.testing.assert_allclose(image, expected, atol=1e-9 if DOUBLE else 1e-3)


def frame_loss(scene, velocity, t):
    """Of the picture at time t of a scene that moves and shears evenly."""
    n = len(scene)
    F = jnp.eye(3, dtype=t.dtype).at[0, 1].set(t * velocity[0])
    moved = deform(scene, scene.means + t * velocity[None], jnp.broadcast_to(F, (n, 3, 3)))
    return jnp.sum(render(moved, CAMERAS[0]).rgb ** 2)


def total(scene, velocity, times, checkpoint):
    loss = jax.checkpoint(frame_loss) if checkpoint else frame_loss

    def add(so_far, t):
        return so_far + loss(scene, velocity, t), None

    return jax.lax.scan(add, jnp.zeros((), times.dtype), times)[0]


@pytest.mark.slow
def test_frames_in_a_loop_are_the_frames_one_by_one():
    scene, velocity, times = hard_scene(0), floats([0.1, -0.2, 0.3]), floats([0.0, 0.3, 0.6])
    losses = jax.jit(lambda v: jax.lax.map(lambda t: frame_loss(scene, v, t), times))(velocity)
    expected = [frame_loss(scene, velocity, t) for t in times]
    np.testing.assert_allclose(losses, expected, rtol=1e-10 if DOUBLE else 1e-4)
    slope = jax.jit(jax.grad(total, argnums=1), static_argnums=3)(scene, velocity, times, True)
    plain = sum(jax.grad(frame_loss, argnums=1)(scene, velocity, t) for t in times)
    np.testing.assert_allclose(slope, plain, rtol=1e-8 if DOUBLE else 1e-2)


@pytest.mark.slow
def test_a_checkpoint_bounds_what_reverse_mode_remembers():
    scene, velocity = hard_scene(0), floats([0.1, -0.2, 0.3])

    def memory(frames, checkpoint):
        gradient = jax.jit(jax.grad(total, argnums=1), static_argnums=3)
        times = jnp.linspace(0, 1, frames, dtype=velocity.dtype)
        compiled = gradient.lower(scene, velocity, times, checkpoint).compile()
        return compiled.memory_analysis().temp_size_in_bytes

    short, long = memory(4, True), memory(64, True)
    # A frame leaves no more behind than its time.
    assert long - short < 60 * 100
    assert memory(64, False) > 10 * long or memory(64, False) - memory(4, False) > 100 * 60


def drawn(count, scene):
    for i in range(count):
        moved = dataclasses.replace(scene, means=scene.means + 0.001 * i)
        yield np.asarray(render(moved, CAMERAS[0]).rgb)


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_a_video_is_written_in_the_memory_of_a_few_frames(tmp_path, name):
    """Neither host memory nor arrays of JAX grow with the number of frames."""
    scene = hard_scene(0)
    save_video(tmp_path / name, drawn(2, scene), fps=25)

    def peak(count):
        gc.collect()
        tracemalloc.start()
        save_video(tmp_path / name, drawn(count, scene), fps=25)
        highest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return highest

    frame = 33 * 45 * 3 * 8
    assert peak(80) - peak(8) < 4 * frame
    with VideoWriter(tmp_path / name, fps=25) as video:
        alive = []
        for image in drawn(30, scene):
            video.add(image)
            alive.append(len(jax.live_arrays()))
    assert alive[-1] <= alive[2] + 2
