"""The viewer: what the browser is given, how time goes by, what is said of mistakes."""

import dataclasses
import importlib.util
import json
import pathlib
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import imageio.v3 as imageio
import jax.numpy as jnp
import numpy as np
import pytest
from scene_files import DROP, ball, changed, write

from pgjax import cli
from pgjax.render import Camera, Gaussians, concatenate, render, save_ply
from pgjax.scenes import SceneError, plan, read_scene
from pgjax.scenes.run import carried, states
from pgjax.view import App, Live, require_viser, show_capture, show_run
from pgjax.view.player import Player
from pgjax.view.reel import Reel
from pgjax.view.server import free_port
from pgjax.view.show import show_plan
from pgjax.view.splats import splats

try:
    require_viser()
    needs_viser = pytest.mark.skipif(False, reason="")
except RuntimeError:
    needs_viser = pytest.mark.skip(reason='viser is not installed (extra "view")')

E_OF_FIRST = ("material", 0, "E")


@pytest.fixture
def folder(tmp_path):
    save_ply(tmp_path / "drop.ply", ball())
    body = "region = { lower = [-1, -1, -1], upper = [1, 0.2, 1] }\n"
    write(tmp_path, changed(DROP, ("size = 0.5", body + "size = 0.5")), name="drop.toml")
    return tmp_path


@pytest.fixture
def live(folder):
    return Live(folder / "drop.toml")


@pytest.fixture
def serve():
    """Makes apps, and closes them at the end."""
    apps = []

    def make(*args, **options):
        apps.append(App(*args, **options))
        return apps[-1]

    yield make
    for app in apps:
        app.close()


def wait(app, until, seconds=120):
    """Tick until something holds."""
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end, app.panel.status
        app.tick()
        time.sleep(0.01)


# --- What is shown --------------------------------------------------------------------------------


def test_splats_have_the_colours_of_the_picture():
    """A single opaque Gaussian in the middle of the picture, seen from its side."""
    one = ball(1)
    gaussian = Gaussians(
        jnp.zeros((1, 3)), 0.3 * one.factors / jnp.abs(one.factors).max(), jnp.ones(1), one.sh / 4,
        one.frames,
    )  # fmt: skip
    camera = Camera.look_at((1, -3, 0.5), (0, 0, 0), up=(0, 0, 1), width=33, height=33, fov_y=0.5)
    picture = np.asarray(render(gaussian, camera, background=(0, 0, 0)).rgb)[16, 16]
    np.testing.assert_allclose(splats(gaussian, camera.position).rgbs[0] / 255, picture, atol=0.02)


def test_what_is_not_finite_is_not_seen():
    gaussians = ball(3)
    broken = Gaussians(
        gaussians.means.at[1, 0].set(jnp.nan), gaussians.factors, gaussians.opacities,
        gaussians.sh, gaussians.frames,
    )  # fmt: skip
    shown = splats(broken, jnp.zeros(3))
    assert [a[0] > 0 for a in shown.opacities] == [True, False, True]
    assert all(np.isfinite(a).all() for a in shown)


@needs_viser
def test_every_frame_is_that_of_the_run(folder, live, serve):
    p = plan(read_scene(folder / "drop.toml"))
    moved = [carried(p, state.x, state.F)[0] for _, state in states(p, p.state, 0)]
    expected = [concatenate([one, p.still]) for one in moved]
    assert len(p.still)
    app = serve(live.show(), live=live)
    wait(app, lambda: app.reel.is_done)
    assert len(app.reel.frames) == 4
    for frame in (2, 0, 3, 1):
        app.seek(frame)
        app.tick()
        shown, gaussians = app.window.shown(), expected[frame]
        np.testing.assert_allclose(shown.centers, gaussians.means, rtol=1e-5, atol=1e-6)
        A = np.asarray(gaussians.covariances)
        # They travel in half precision.
        np.testing.assert_allclose(shown.covariances, A, rtol=1e-3, atol=1e-3 * np.abs(A).max())
        np.testing.assert_allclose(shown.opacities / 255, gaussians.opacities[:, None], atol=0.005)
        assert np.all(shown.rgbs == splats(gaussians, p.camera(0).position).rgbs)
    assert "All frames are there." in app.panel.status


@needs_viser
def test_small_objects_keep_their_shape(tmp_path, serve):
    """In metres, the covariances of these would all be zero in half precision."""
    gaussians = ball(50)
    small = Gaussians(
        1e-3 * gaussians.means, 1e-3 * gaussians.factors, gaussians.opacities, gaussians.sh,
        gaussians.frames,
    )  # fmt: skip
    save_ply(tmp_path / "small.ply", small)
    app = serve(show_capture(tmp_path / "small.ply"))
    wait(app, lambda: app.window.shown_anything)
    A = np.asarray(small.covariances)
    np.testing.assert_allclose(
        app.window.shown().covariances, A, rtol=1e-2, atol=1e-2 * np.abs(A).max()
    )


@needs_viser
def test_the_camera_and_the_background_are_those_of_the_scene(folder, serve):
    path = folder / "drop.toml"
    path.write_text(path.read_text() + "azimuth = 20\nfov = 30\nbackground = [0.2, 0.4, 0.6]\n")
    live = Live(path)
    show = live.show()
    app = serve(show, live=live)
    wait(app, lambda: app.window.shown_anything)
    first = app.window.camera
    np.testing.assert_allclose(first.position, show.camera.position, atol=1e-5)
    np.testing.assert_allclose(first.fov, np.radians(30), rtol=1e-5)
    assert tuple(first.up) == (0, 0, 1)
    pixels, depths = show.camera.project(jnp.asarray(first.look_at)[None])
    np.testing.assert_allclose(pixels[0], (32, 24), atol=1e-2)
    assert float(depths[0]) > 0
    assert show.background == (0.2, 0.4, 0.6)


# --- Time -----------------------------------------------------------------------------------------


def test_playing_waits_for_frames_that_are_still_made():
    player = Player(10.0)
    player.advance(0.25, 0, is_done=False)
    assert player.frame == 0
    player.advance(0.25, 9, is_done=False)
    assert player.frame == 2
    player.advance(0.05, 9, is_done=False)
    assert player.frame == 3
    player.advance(5.0, 9, is_done=False)
    assert player.frame == 8
    player.advance(0.1, 9, is_done=True)
    assert player.frame == 0


def test_without_loop_playing_ends_and_begins_again():
    player = Player(10.0)
    player.loops = False
    player.advance(5.0, 4, is_done=True)
    assert (player.frame, player.is_playing) == (3, False)
    player.toggle(4, is_done=True)
    assert (player.frame, player.is_playing) == (0, True)
    player.seek(7, 4)
    assert (player.frame, player.is_playing) == (3, False)
    player.advance(1.0, 4, is_done=True)
    assert player.frame == 3


@needs_viser
def test_play_advances_what_is_shown(live, serve):
    app = serve(live.show(), live=live)
    wait(app, lambda: app.reel.is_done)
    app.seek(0)
    app.tick()
    before = app.window.shown().centers
    app.toggle()
    wait(app, lambda: app.player.frame == 2)
    assert app.window.shown().centers[:100, 2].mean() < before[:100, 2].mean()


# --- Values ---------------------------------------------------------------------------------------


def test_the_numbers_of_the_materials_can_be_changed(live):
    assert live.texts == {
        ("material", 0, "E"): "20000",
        ("material", 0, "nu"): "0.3",
        ("material", 0, "density"): "1000",
        ("material", 1, "E"): "20000",
        ("material", 1, "nu"): "0.3",
        ("material", 1, "density"): "500",
        ("material", 1, "plasticity", "yield_stress"): "200",
    }
    show = live.show({E_OF_FIRST: "4e4", ("material", 1, "plasticity", "yield_stress"): "100"})
    said = [text for name, text in show.facts if name == "material"]
    assert "E 4e+04" in said[0]
    assert "E 2e+04" in said[1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("-1", "drop.toml [[material]] 1: `E` must be a finite number above 0, but is -1."),
        ("soft", "drop.toml [[material]] 1: `E` must be a number, but is 'soft'."),
        ("", "`E` must be a number"),
        ("1e5\nnu = 2", "`E` must be a number"),
        ("inf", "`E` must be a finite number"),
    ],
)
def test_bad_values_are_named(live, text, words):
    with pytest.raises(SceneError) as caught:
        live.show({E_OF_FIRST: text})
    assert words in str(caught.value)


@needs_viser
def test_bad_values_are_said_in_the_panel_and_good_ones_start_again(live, serve):
    app = serve(live.show(), live=live)
    wait(app, lambda: app.reel.is_done)
    first = app.reel
    app.panel.write({E_OF_FIRST: "-1"})
    app.restart()
    assert "`E` must be a finite number above 0, but is -1." in app.panel.complaint
    assert app.reel is first
    app.panel.write({E_OF_FIRST: "1e4"})
    app.restart()
    assert app.panel.complaint == ""
    wait(app, lambda: app.reel.is_done and app.window.shown_anything)
    assert app.reel is not first
    last = [reel.frames[-1].moving.centers for reel in (first, app.reel)]
    assert not np.array_equal(*last)


def test_failures_of_the_simulation_are_told_by_name(folder):
    path = write(
        folder,
        changed(
            (folder / "drop.toml").read_text(), ("-0.1]", "-9]"), ("frames = 3", "frames = 30")
        ),
    )
    reel = Reel(show_plan(plan(read_scene(path))))
    reel._thread.join(120)
    assert 5 < len(reel.frames) < 30
    assert f"**Stopped at frame {len(reel.frames) - 1} of 30.**" in reel.status()
    assert "OUT_OF_DOMAIN from step" in reel.status()


def test_an_error_in_the_background_is_told(tmp_path):
    save_ply(tmp_path / "drop.ply", ball())
    (tmp_path / "ply").mkdir()
    for i in range(2):
        save_ply(tmp_path / "ply" / f"{i:05d}.ply", ball())
    (tmp_path / "ply" / "00001.ply").write_text("ply\nnothing")
    (tmp_path / "run.json").write_text(json.dumps({"fps": 12}))
    reel = Reel(show_run(tmp_path, "z"))
    reel._thread.join(60)
    assert (len(reel.frames), reel.show.fps, reel.show.up) == (1, 12.0, (0.0, 0.0, 1.0))
    assert "**Stopped after frame 0.**" in reel.status()
    assert "00001.ply" in reel.status()


# --- The command ----------------------------------------------------------------------------------


@needs_viser
def test_the_page_is_served_and_its_port_is_freed(live):
    port = free_port("127.0.0.1", None)
    app = App(live.show(), live=live, port=port)
    with urllib.request.urlopen(app.url, timeout=10) as page:
        assert b"<html" in page.read()
    with pytest.raises(ValueError, match=f"port that is free, but {port} is not"):
        free_port("127.0.0.1", port)
    app.close()
    assert free_port("127.0.0.1", port) == port
    assert app.reel.is_done
    assert not any(t.name == "pgjax view" for t in threading.enumerate())


@needs_viser
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for a child there")
def test_ctrl_c_ends_it(folder):
    import signal

    save_ply(folder / "capture.ply", ball())
    # What a shell runs in the background ignores the signal unless it says otherwise.
    heeded = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"import signal, sys; {heeded}; from pgjax import cli; sys.exit(cli.main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "view", str(folder / "capture.ply"), "--no-open"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    line = next(line for line in process.stdout if line.startswith("viewer"))
    url = line.split()[1]
    with urllib.request.urlopen(url, timeout=10) as page:
        assert page.status == 200
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    # Another program may take the port meanwhile; nobody of ours listens on it.
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(url, timeout=10)


def test_without_viser_it_says_how_to_install_it(folder, monkeypatch, capsys):
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert cli.main(["view", str(folder / "drop.toml")]) == 1
    assert capsys.readouterr().err == (
        'pgjax: The viewer needs viser, which is not installed: pip install "pgjax[view]".\n'
    )


def test_pgjax_does_not_import_viser():
    code = "import sys, pgjax, pgjax.scenes, pgjax.view; sys.exit('viser' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@needs_viser
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["drop.toml", "--port", "0"], "Argument `--port` must be from 1 to 65535, but is 0."),
        (["drop.toml", "--host", "no.such.host.invalid"], "Argument `--host` must be a name or an"),
        (["drop.toml", "--frames", "0"], "Argument `--frames` must be at least 1, but is 0."),
        (["drop.toml", "--up", "z"], "`--up` must be left out where the target is a scene, but is"),
        (["drop.ply", "--frames", "3"], "`--frames` must be left out unless the target is a scene"),
        (["drp.toml"], "does not exist (did you mean `drop.toml`?)"),
        (["fics"], "There is no preset `fics`"),
        (["."], "must be a folder of a run with frames in `ply/`, but . has none."),
        (["notes.txt"], "The file notes.txt is of no known format"),
    ],
)
def test_mistakes_of_the_command_are_named(folder, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(folder)
    (folder / "notes.txt").write_text("what is this")
    assert cli.main(["view", *arguments, "--no-open"]) == 1
    assert words in capsys.readouterr().err


# --- In a browser ---------------------------------------------------------------------------------

PRESS_PAUSE = """
for (const b of document.querySelectorAll('button')) if (b.textContent == 'Pause') b.click()
"""


@needs_viser
@pytest.mark.skipif(
    importlib.util.find_spec("PySide6") is None, reason="PySide6, the browser, is not installed"
)
def test_a_browser_draws_the_picture_of_the_renderer(tmp_path, serve):
    large = ball()
    gaussians = Gaussians(
        large.means, 0.2 * large.factors, large.opacities, large.sh,
        large.frames,
    )  # fmt: skip
    (tmp_path / "ply").mkdir()
    for i in range(3):
        save_ply(tmp_path / "ply" / f"{i:05d}.ply", gaussians)
    show = show_run(tmp_path)
    app = serve(show)
    browser = pathlib.Path(__file__).parent / "browser.py"
    command = [sys.executable, str(browser), app.url, str(tmp_path / "seen.png"), PRESS_PAUSE]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait(app, lambda: process.poll() is not None)
    assert process.returncode == 0
    assert not app.player.is_playing
    seen = np.asarray(imageio.imread(tmp_path / "seen.png"), float)[:, :, :3] / 255
    height, width, _ = seen.shape
    fy = float(show.camera.fy) * height / show.camera.height
    camera = dataclasses.replace(
        show.camera, width=width, height=height, fx=fy, fy=fy, cx=width / 2, cy=height / 2
    )
    expected = np.clip(np.asarray(render(gaussians, camera, background=(1, 1, 1)).rgb), 0, 1)
    # The panel is on the right.
    middle = slice(height // 4, -height // 4), slice(width // 3, width * 2 // 3)
    assert expected[middle].std() > 0.1
    # 0.006 is measured: the browser clips colours before it blends them.
    assert np.abs(seen - expected)[middle].mean() < 0.02
