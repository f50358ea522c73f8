"""Scene files, the plan made from them, the run, and the command line."""

import json
import pathlib
import re

import imageio_ffmpeg
import jax
import numpy as np
import pytest
from scene_files import CAMERA, DROP, GRID, JELLY, MODEL, changed, planned, write

from pgjax import cli
from pgjax.cases import read_case
from pgjax.render import Gaussians, load_ply, save_ply
from pgjax.result import SimulationError
from pgjax.scenes import SceneError, plan, read_scene, resolve
from pgjax.scenes.capture import upright
from pgjax.scenes.run import states

BODY = "region = { lower = [-1, -3, -1], upper = [1, -0.5, 1] }"
SCENE = changed(DROP, ("size = 0.5", f"{BODY}\nsize = 0.5"))


def captured(n=200, seed=0):
    """A ball of Gaussians above a few that stay, y down as in a capture."""
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(n, 3))
    ball *= 0.4 * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    ball[:, 1] -= 1.5
    ground = np.column_stack([rng.uniform(-1, 1, 40), np.full(40, -0.2), rng.uniform(-1, 1, 40)])
    means = np.concatenate([ball, ground])
    count = len(means)
    quaternions = rng.normal(size=(count, 4))
    scales = np.exp(rng.normal(-3, 0.3, (count, 3)))
    sh = rng.normal(size=(count, 4, 3))
    opacities = np.where(np.arange(count) % 50 == 7, 0.01, 0.9)
    return Gaussians.from_scales(
        *(jax.numpy.asarray(a) for a in (means, quaternions, scales, opacities, sh))
    )


@pytest.fixture
def folder(tmp_path):
    save_ply(tmp_path / "drop.ply", captured())
    (tmp_path / "drop.toml").write_text(SCENE)
    return tmp_path


def with_change(folder, old, new):
    """The path of the scene with one line changed."""
    return write(folder, changed(SCENE, (old, new)), name="changed.toml")


def test_plan_places_splits_and_orders(folder):
    p = plan(read_scene(folder / "drop.toml"))
    x = np.asarray(p.state.x)
    # Four of the ball are too transparent, one of the ground as well.
    assert (p.scene.particle_count, len(p.still)) == (196, 39)
    np.testing.assert_allclose(np.ptp(x, axis=0).max(), 0.5, rtol=1e-5)
    np.testing.assert_allclose(x[:, 2].min(), 0, atol=1e-6)
    np.testing.assert_allclose((x.max(0) + x.min(0))[:2], 0, atol=1e-6)
    first, second = p.scene.counts
    assert first + second == 196
    assert np.all(x[:first, 2] <= 0.25)
    assert np.all(x[first:, 2] > 0.25)
    # The frame is an exact number of steps below half the bound.
    np.testing.assert_allclose(p.dt * p.substeps, 1 / 25, rtol=1e-12)
    bound = float(p.scene.elastic_limit(p.scene.rest_sound_speed()))
    assert p.dt <= 0.5 * bound * (1 + 1e-9)
    # Back in the capture's coordinates nothing has moved.
    back = np.asarray(p.to_simulation.inverse().apply(p.moving.means))
    original = np.asarray(load_ply(folder / "drop.ply").means)
    distance = np.abs(back[:, None] - original[None]).max(-1).min(1)
    assert distance.max() < 1e-5


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0, 0, -1), (1, 2, -3)])
def test_upright(up):
    Q = upright(np.asarray(up, float))
    np.testing.assert_allclose(Q @ Q.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(Q), 1)
    np.testing.assert_allclose(Q @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("spacing =", "spacng =", "`spacing` is missing (is `spacng` meant?)"),
        ("friction = 0.3", "frction = 0.3", "(did you mean `friction`?); allowed are type, "),
        ("nu = 0.3", "nu = 0.5", "[[material]] 1: `nu` must be a finite number above -1 and below"),
        ("E = 2e4", "E = -1", "`E` must be a finite number above 0, but is -1"),
        ("E = 2e4", 'E = "soft"', "`E` must be a number"),
        ("E = 2e4\n", "", "`E` is missing"),
        ("fixed-corotated", "fixed-corotatd", "did you mean `fixed-corotated`?"),
        (
            'law = "fixed-corotated"',
            'law = "neo-hookean"\nplasticity = { type = "von-mises", yield_stress = 1 }',
            "`type` must go with law = \"neo-hookean\", as it does with",
        ),
        ("frames = 3", "frames = 2.5", "`frames` must be a whole number"),
        ("normal = [0, 0, 1]", "normal = [0, 0, 0]", "`normal` must not be zero"),
        ("normal = [0, 0, 1]", "normal = [0, 1]", "`normal` must be a list of 3"),
        ('contact = "separating"', 'contact = "sticky"', "`friction` must be left out"),
        ("[[boundary]]", "[boundary]", "`boundary` must be written as [[boundary]]"),
        ("[time]", "[tme]", "`tme` is not a known key"),
        ("upper = [0.5, 0.5, 0.8]", "upper = [0.5, 0.5, -0.1]", "at least 4 spacings above"),
        ('ply = "drop.ply"', 'procedural = "oak"', "must be one of ficus"),
        ('ply = "drop.ply"', 'ply = "drop.ply"\nprocedural = "ficus"', "but not both"),
        ("upper = [1, -0.5, 1]", "upper = [1, -2.9, 1]", "no Gaussian"),
        ("upper = [1, 1, 0.25]", "upper = [1, 1, -0.9]", "owns no particle"),
        ("lower = [-0.5, -0.5, -0.2]", "lower = [-0.5, -0.5, 0.2]", "`x` must lie inside the grid"),
    ],
)  # fmt: skip
def test_mistakes_are_named(folder, old, new, words):
    path = with_change(folder, old, new)
    with pytest.raises(ValueError, match=re.escape(words)):
        plan(read_scene(path))


@pytest.mark.parametrize("options", [[], ["--dry-run"]], ids=["run", "dry run"])
def test_a_time_step_above_the_limit_is_refused_before_a_folder_is_begun(folder, options, capsys):
    limit = float(plan(read_scene(folder / "drop.toml")).scene.rest_limit())
    path = with_change(folder, "fps = 25", f"fps = 25\ndt = {1.001 * limit}")
    assert cli.main(["run", str(path), "--out", str(folder / "out"), *options]) == 1
    assert capsys.readouterr().err == (
        f"pgjax: changed.toml [time]: `dt` must be at most {limit:.4g} s, the largest stable time "
        f"step at rest, but is {1.001 * limit:g}.\n"
    )
    assert not (folder / "out").exists()
    p = plan(read_scene(with_change(folder, "fps = 25", f"fps = 25\ndt = {limit}")))
    assert 0.9 * limit < p.dt <= limit * (1 + 1e-6)


def test_files_that_are_not_there(folder, capsys):
    with pytest.raises(SceneError, match="does not exist"):
        read_scene(folder / "nowhere.toml")
    with pytest.raises(SceneError, match="no preset `fics`"):
        resolve("fics")
    (folder / "bad.toml").write_text("a = = 3")
    assert cli.main(["run", str(folder / "bad.toml")]) == 1
    assert "is not a TOML file" in capsys.readouterr().err


def frame_count(video):
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
    return frames


def test_run_writes_video_pictures_and_plys(folder, capsys):
    out = folder / "out"
    assert cli.main(["run", str(folder / "drop.toml"), "--out", str(out), "--save-ply"]) == 0
    assert "196 particles, 39 Gaussians that do not move" in capsys.readouterr().out
    # The rest frame is drawn, too.
    assert frame_count(out / "video.mp4") == 4
    assert (out / "first.png").is_file()
    assert (out / "last.png").is_file()
    record = json.loads((out / "run.json").read_text())
    assert record["frames"] == 3
    frames = [load_ply(out / "ply" / f"{i:05d}.ply") for i in range(4)]
    assert all(len(f) == 235 for f in frames)
    heights = [-float(np.asarray(f.means)[:196, 1].mean()) for f in frames]
    # Free fall from rest in the capture's units, where y is down: ½ g t² / scale.
    fallen = 0.5 * 9.81 * (2 / 25) ** 2 * np.ptp(np.asarray(frames[0].means)[:196], axis=0).max()
    np.testing.assert_allclose(heights[0] - heights[2], fallen / 0.5, rtol=0.05)
    np.testing.assert_allclose(frames[0].means[196:], frames[3].means[196:], atol=1e-6)
    # Again into the same folder: refused, and nothing is touched.
    before = (out / "video.mp4").read_bytes()
    assert cli.main(["run", str(folder / "drop.toml"), "--out", str(out)]) == 1
    assert "so that nothing is overwritten" in capsys.readouterr().err
    assert (out / "video.mp4").read_bytes() == before


def test_two_elastic_materials_move(tmp_path):
    lower = "region = { lower = [-1, -1, -1], upper = [1, 1, 0.2] }"
    p = planned(tmp_path, MODEL, GRID, JELLY, lower, JELLY, CAMERA, frames=1)
    assert len(p.scene.materials) == 2
    (_, before), (_, after) = states(p, p.state, 0)
    assert int(after.step) == int(before.step) + p.substeps


def test_leaving_the_grid_keeps_what_was_computed(folder, capsys):
    path = with_change(folder, "point = [0, 0, -0.1]", "point = [0, 0, -9]")
    path.write_text(path.read_text().replace("frames = 3", "frames = 30"))
    out = folder / "lost"
    assert cli.main(["run", str(path), "--out", str(out)]) == 1
    error = capsys.readouterr().err
    assert "OUT_OF_DOMAIN from step" in error
    assert "Enlarge the grid" in error
    record = json.loads((out / "run.json").read_text())
    assert 5 < record["frames"] < 30
    assert record["status"]["OUT_OF_DOMAIN"]["count"] > 0
    assert frame_count(out / "video.mp4") == record["frames"] + 1


def test_errors_of_a_rollout_are_runtime_errors():
    assert issubclass(SimulationError, RuntimeError)


def test_info(capsys):
    assert cli.main(["info"]) == 0
    printed = capsys.readouterr().out
    for word in ("pgjax", "jaxlib", "devices", "cpu", "ficus"):
        assert word in printed


@pytest.mark.parametrize("arguments", [[], ["fly"], ["run", "ficus", "--frames", "x"]])
def test_usage_errors(arguments, capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(arguments)
    assert exit_.value.code == 2
    assert "usage:" in capsys.readouterr().err


def test_zero_frames_is_an_error(capsys):
    assert cli.main(["run", "ficus", "--frames", "0"]) == 1
    assert "`--frames` must be at least 1" in capsys.readouterr().err


@pytest.mark.parametrize("path", sorted(pathlib.Path("examples").glob("*.toml")), ids=str)
def test_examples_are_valid(path):
    assert read_scene(path).materials


@pytest.mark.parametrize("path", sorted(pathlib.Path("examples/fit").glob("*.toml")), ids=str)
def test_example_cases_are_valid(path, tmp_path):
    (tmp_path / "frames").mkdir()
    assert read_case(path, tmp_path / "frames").unknowns


FINE = """
[quality.fine]
grid.spacing = 0.05
time = { frames = 7 }
"""


def test_a_quality_changes_what_it_says_and_nothing_else(folder):
    path = folder / "drop.toml"
    path.write_text(path.read_text() + FINE)
    plain, fine = read_scene(path), read_scene(path, "fine")
    assert (plain.grid.spacing, fine.grid.spacing) == (0.1, 0.05)
    assert (plain.time.frames, fine.time.frames) == (3, 7)
    assert plain.time.fps == fine.time.fps
    assert plain.grid.lower == fine.grid.lower
    assert plain.models[0].size == fine.models[0].size


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FINE.replace("fine", "paper"), "`quality` must be one of the scene file's, which has pap"),
        ("", "`quality` must be one of the scene file's, which has none, but is 'fine'"),
        ("[quality]\nfine = 1", r"\[quality.fine\]: `fine` is not a known key"),
        ("[quality.fine]\ngrd.spacing = 1", r"`grd` is not a known key \(did you mean `grid`\?\)"),
        ("[quality.other]\ngrid.spacin = 1", r"\[quality.other\] \[grid\]: `spacin` is not"),
        (
            "[quality.other]\ngrid.spacing = -1",
            r"\[grid\]: `spacing` must be a finite number above",
        ),
    ],
)
def test_a_quality_that_cannot_be_is_named(folder, text, message):
    path = folder / "drop.toml"
    path.write_text(path.read_text() + text)
    with pytest.raises(SceneError, match=message):
        read_scene(path, "fine")
