"""Images and videos: what is written is what was given, and failures leave nothing behind."""

import subprocess

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest

from pgjax.render import VideoWriter, save_image, save_video
from pgjax.render.media import load_image


def frames(count=4, shape=(35, 51)):
    """A bright bar that moves over a coloured ground."""
    for i in range(count):
        frame = np.full((*shape, 3), [0.8, 0.3, 0.1])
        frame[:, 10 * i : 10 * i + 10] = [0.1, 0.6, 0.9]
        yield frame


def decoded(path, height, width):
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(path)]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, check=True, capture_output=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3) / 255


def test_png_holds_the_clipped_image(tmp_path):
    image = np.linspace(-0.2, 1.2, 7 * 5 * 3).reshape(7, 5, 3)
    save_image(tmp_path / "a.png", image)
    stored = imageio.imread(tmp_path / "a.png")
    np.testing.assert_allclose(stored / 255, np.clip(image, 0, 1), atol=0.5 / 255 + 1e-9)


def test_an_image_read_and_written_again_is_the_same(tmp_path):
    save_image(tmp_path / "a.png", np.arange(256 * 3).reshape(16, 16, 3) / 767)
    image = load_image(tmp_path / "a.png")
    assert image.shape == (16, 16, 3)
    assert image.max() == 1
    save_image(tmp_path / "b.png", image)
    assert (tmp_path / "b.png").read_bytes() == (tmp_path / "a.png").read_bytes()


def test_mp4_keeps_frames_and_colours_and_pads_odd_sizes(tmp_path):
    save_video(tmp_path / "a.mp4", frames(), fps=12.5)
    stored = decoded(tmp_path / "a.mp4", 36, 52)
    assert len(stored) == 4
    for ours, given in zip(stored, frames(), strict=True):
        assert np.abs(ours[:35, :51] - given).mean() < 0.03
        # The added row and column repeat their neighbours.
        assert np.abs(ours[35] - ours[34]).mean() < 0.03
        assert np.abs(ours[:, 51] - ours[:, 50]).mean() < 0.03


def test_gif_keeps_frames_sizes_and_rate(tmp_path):
    save_video(tmp_path / "a.gif", frames(), fps=20)
    stored = imageio.imread(tmp_path / "a.gif", index=None, mode="RGB") / 255
    assert stored.shape == (4, 35, 51, 3)
    assert imageio.immeta(tmp_path / "a.gif")["duration"] == 50
    for ours, given in zip(stored, frames(), strict=True):
        assert np.abs(ours - given).mean() < 0.02


def failing_frames():
    yield from frames(2)
    raise RuntimeError("the simulation diverged")


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (lambda: [], ValueError, "must have at least one frame"),
        (failing_frames, RuntimeError, "the simulation diverged"),
        (lambda: [np.zeros((8, 8, 3)), np.zeros((8, 6, 3))], ValueError, "shape .* of the first"),
        (lambda: [np.full((8, 8, 3), np.nan)], ValueError, "must be finite, but 64 pixels are not"),
        (lambda: [np.zeros((8, 8))], ValueError, "must have shape \\(height, width, 3\\)"),
        (lambda: [np.zeros((8, 8, 3), np.uint8)], ValueError, "must be floating in \\[0, 1\\]"),
    ],
)
def test_a_failed_video_leaves_the_old_file_and_no_other(tmp_path, given, error, message):
    (tmp_path / "a.mp4").write_text("before")
    with pytest.raises(error, match=message):
        save_video(tmp_path / "a.mp4", given(), fps=10)
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_text() == "before"


def test_an_encoder_that_fails_is_reported(tmp_path):
    with pytest.raises(RuntimeError, match=r"Encoding .*a\.gif failed: .+"):
        # The format stores sizes in 16 bits.
        save_video(tmp_path / "a.gif", [np.zeros((1, 70_000, 3))], fps=10)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "fps", "message"),
    [
        ("a.avi", 10, "`path` must end with .mp4 or .gif, but is 'a.avi'"),
        ("missing/a.mp4", 10, "`path` must lie in an existing folder"),
        ("a.mp4", 0, "`fps` must be positive"),
    ],
)
def test_bad_video_arguments_are_refused_at_once(tmp_path, name, fps, message):
    with pytest.raises(ValueError, match=message):
        VideoWriter(tmp_path / name, fps=fps)


def test_frames_outside_the_block_are_refused(tmp_path):
    video = VideoWriter(tmp_path / "a.mp4", fps=10)
    with pytest.raises(ValueError, match="only inside its `with` block"):
        video.add(np.zeros((8, 8, 3)))


def test_bad_image_names_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"`path` must end with \.png"):
        save_image(tmp_path / "a.jpg", np.zeros((8, 8, 3)))
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match="is a folder"):
        save_image(tmp_path / "folder.png", np.zeros((8, 8, 3)))
