"""The cheapest setting within an error: refinement, the search, and what is written."""

import math
import re
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from scene_files import DROP, GRID, JELLY, MODEL, ball, changed, sphere, write

import pgjax.scenes.trial
from pgjax import cli
from pgjax.render import save_ply
from pgjax.scenes import SceneError, plan, read_scene
from pgjax.scenes.edit import edited
from pgjax.scenes.refinement import largest, refined, scale
from pgjax.scenes.settings import applied, changes, own
from pgjax.scenes.trial import Trial, Trials
from pgjax.scenes.tune import RATIO, tune
from pgjax.splines import BSpline
from pgjax.transfer import MLS


def motion(n=50, frames=4, seed=0):
    """Gaussians that drift apart, `(f, n, 3)`."""
    rng = np.random.default_rng(seed)
    start, speed = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    return start + 0.1 * np.arange(frames + 1)[:, None, None] * speed


def noise(seed, like):
    """Something else in every frame but the first, of size 1."""
    found = np.random.default_rng(seed).normal(size=like.shape) / 3**0.5
    found[0] = 0
    return found


@pytest.mark.parametrize("order", [0.6, 1.0, 2.0])
def test_the_limit_of_a_power_of_the_spacing_is_exact(order):
    x, error = motion(), noise(1, motion())
    levels = [x + 0.03 * RATIO ** (-order * level) * error for level in range(4)]
    limit = refined(levels, RATIO)
    np.testing.assert_allclose(limit.x, x, atol=1e-9)
    np.testing.assert_allclose(limit.order, order, rtol=1e-6)
    assert limit.converges
    # Nothing speaks against it but that it might be of first order: a quarter is kept in doubt.
    left = largest(levels[-1] - x) / scale(x)
    if_first = left * (RATIO**order - 1) / (RATIO - 1)
    np.testing.assert_allclose(limit.doubt, max(0.25 * left, abs(if_first - left)), rtol=1e-3)
    expected = largest(levels[0] - x) / scale(x)
    np.testing.assert_allclose(limit.error(levels[0]), expected, rtol=1e-3)


def test_what_the_levels_do_not_share_is_in_doubt():
    """The true limit is within the doubt, also where part of the change is noise."""
    x, error = motion(), noise(1, motion())
    for seed in range(5):
        levels = [
            x + 0.03 * RATIO**-j * error + 0.002 * RATIO**-j * noise(10 * seed + j, x)
            for j in range(3)
        ]
        limit = refined(levels, RATIO)
        assert largest(limit.x - x) / scale(x) < 1.5 * limit.doubt
        assert 0.001 < limit.doubt < 0.1


def test_levels_that_do_not_converge_are_said_to():
    """Noise of one size on every grid: the limit is not known better than five times that."""
    levels = [motion() + 0.03 * noise(j, motion()) for j in range(3)]
    limit = refined(levels, RATIO)
    assert not limit.converges
    assert limit.doubt > 0.03 / scale(motion())
    assert refined([motion()] * 3, RATIO).doubt == 0


def test_two_grids_that_agree_by_chance_are_not_trusted():
    """As a floor between nodes does it: 7 % off, then 4 % and 3.9 % off in another direction."""
    x, error, other = motion(), noise(1, motion()), noise(2, motion())
    levels = [x + scale(x) * e for e in (0.07 * error, -0.04 * other, -0.039 * other)]
    limit = refined(levels, RATIO)
    assert limit.order > 2
    assert limit.changes[1] < 0.002
    assert limit.error(x) < limit.doubt


def test_scale_is_the_displacement_but_not_more_than_the_size():
    start = noise(0, np.zeros((2, 400, 3)))[1]
    size = np.sqrt(np.mean(np.sum((start - start.mean(0)) ** 2, axis=1)))
    for shift, expected in ((0.01, 0.01), (20.0, size)):
        x = np.stack([start, start + np.array([0, 0, -shift])])
        np.testing.assert_allclose(scale(x), expected, rtol=1e-6)


TEXT = """# A scene.
name = "drop"
[model] # of a ball
ply = "ball.ply" # here
split_longer_than = 0.5
fill = { seal = 0.3 } # hollow

[grid]
lower = [-0.5, -0.5, -0.2]
upper = [0.5, 0.5, 0.8]
# Half of it resolves more.
spacing = 0.1   # m
# The end.

[time]
dt = 1e-3 # s
frames = 3
"""


def test_edited_text_keeps_all_else():
    made = edited(
        TEXT,
        {
            ("grid", 0, "spacing"): 0.05,
            ("grid", 0, "particle_spacing"): 0.5,
            ("grid", 0, "spline"): "cubic",
            ("time", 0, "dt"): None,
            ("time", 0, "fraction"): 0.9,
            ("model", 0, "split_longer_than"): 1.0,
            ("model", 0, "fill.spacing"): 0.05,
        },
        "drop.toml",
    )
    read, before = tomllib.loads(made), tomllib.loads(TEXT)
    grid = {"spacing": 0.05, "particle_spacing": 0.5, "spline": "cubic"}
    assert read["grid"] == before["grid"] | grid
    assert read["time"] == {"frames": 3, "fraction": 0.9}
    assert read["model"]["fill"] == {"seal": 0.3, "spacing": 0.05}
    assert "# dt = 1e-3 # s\n" in made
    kept = [line for line in TEXT.splitlines() if not re.match(r"(spacing|split|fill|dt)", line)]
    assert [line for line in made.splitlines() if line in kept] == kept
    for comment in ("# A scene.", "# of a ball", "# here", "# hollow", "# Half of", "# m", "# The"):
        assert comment in made


@pytest.mark.parametrize(
    ("text", "place", "value", "expected"),
    [
        ("[grid]\nspacing = 1\n", ("time", 0, "fraction"), 0.9, "\n[time]\nfraction = 0.9\n"),
        ("[model]\nfill = {}\n", ("model", 0, "fill.spacing"), 0.1, "fill = { spacing = 0.1 }"),
        ("[model.fill]\nseal = 1\n", ("model", 0, "fill.spacing"), 0.1, "seal = 1\nspacing = 0.1"),
        ("[model]\nfill.seal = 1\n", ("model", 0, "fill.spacing"), 0.1, "fill.spacing = 0.1"),
        (
            '[[model]]\nname = "a"\n\n[[model]]\nname = "b"\n',
            ("model", 1, "split_longer_than"),
            2.0,
            'name = "b"\nsplit_longer_than = 2.0',
        ),
        ("[grid]\n[time]\n", ("grid", 0, "scheme"), "mls", '[grid]\nscheme = "mls"\n[time]'),
    ],
)
def test_edited_in_all_ways_to_write_it(text, place, value, expected):
    assert expected in edited(text, {place: value}, "scene.toml")


@pytest.mark.parametrize("text", ["grid = { spacing = 1 }\n", "grid.spacing = 1\n"])
def test_what_cannot_be_edited_is_said(text):
    with pytest.raises(SceneError, match=r"by hand: \[grid\] spacing = 0.5"):
        edited(text, {("grid", 0, "spacing"): 0.5}, "scene.toml")


def test_the_gaussians_stay_when_the_grid_changes(tmp_path):
    """What the file has in spacings of the grid is rescaled; written, it reads as it was run."""
    save_ply(tmp_path / "ball.ply", sphere())
    model = MODEL + "split_longer_than = 0.3\nfill = { seal = 0.1 }\n"
    path = write(tmp_path, model, GRID, JELLY)
    file = read_scene(path)
    setting = own(file)
    other = type(setting)(0.05, 0.5, BSpline(3), MLS(), 0.9)
    before, after = plan(file), plan(applied(file, other))
    np.testing.assert_array_equal(after.moving.means, before.moving.means)
    path.write_text(edited(path.read_text(), changes(file, other), path.name))
    written = read_scene(path)
    assert own(written) == other
    again = plan(written)
    np.testing.assert_array_equal(again.moving.means, before.moving.means)
    np.testing.assert_array_equal(again.state.x, after.state.x)


FINE = changed(DROP, ("spacing = 0.1", "spacing = 0.02"))
SMOOTH = noise(7, motion())


def pretended(monkeypatch, law, chaos=0.0):
    """Runs in which the error of a setting is `law(setting) -> (error, seconds)`."""
    X = motion()

    def prepared(_, __, frames):
        steps = SimpleNamespace(particle_count=1000)
        return SimpleNamespace(scene=steps, substeps=10, frames=frames)

    def tried(_, setting, what, double):
        error, seconds = law(setting)
        other = chaos * noise(abs(hash(str(setting))) % 1000, X)
        x = X + scale(X) * (error * SMOOTH / largest(SMOOTH) + other)
        return Trial(what, setting, double, 1000, 10, seconds, x, ())

    monkeypatch.setattr(pgjax.scenes.trial, "prepared", prepared)
    monkeypatch.setattr(pgjax.scenes.trial, "tried", tried)


def first_order(setting):
    """1 % at the scene's own spacing; the cubic spline halves it, for twice the time."""
    h = setting.spacing / 0.02
    error, seconds = 0.01 * h, h**-4
    if setting.spline.degree == 3:
        error, seconds = 0.5 * error, 2 * seconds
    if setting.fraction > 0.5:
        seconds *= 0.5 / setting.fraction
    if setting.particle_spacing is not None:
        seconds *= (0.5 / setting.particle_spacing) ** 3
        error *= 1 + max(setting.particle_spacing - 0.5, 0) * 10
    return error, seconds


@pytest.fixture
def file(tmp_path):
    save_ply(tmp_path / "drop.ply", ball())
    path = tmp_path / "drop.toml"
    path.write_text(FINE)
    return read_scene(path)


@pytest.mark.parametrize("asked", [0.04, 0.02, 0.005])
def test_the_cheapest_setting_is_found(monkeypatch, file, asked):
    pretended(monkeypatch, first_order)
    found = tune(Trials(file, frames=4), asked)
    assert found.chosen is not None
    setting = found.chosen.trial.setting
    # Twice as fine is sixteen times as dear: the cubic spline pays, a longer step always.
    assert setting.spline.degree == 3
    assert setting.fraction == 0.9
    error, _ = first_order(setting)
    assert error <= asked
    # The next grid would not have been good enough, or nothing coarser is tried.
    assert error * RATIO > 0.99 * asked or setting.spacing > 3.9 * 0.02
    np.testing.assert_allclose(found.chosen.error, error, rtol=1e-2)
    assert not found.notes


def test_chaos_is_said_and_nothing_is_chosen(monkeypatch, file):
    pretended(monkeypatch, first_order, chaos=0.1)
    found = tune(Trials(file, frames=4), 0.02)
    assert found.chosen is None
    assert any("do not converge" in note for note in found.notes)
    assert any("nothing can be said to be within 2 %" in note for note in found.notes)


def test_a_lost_particle_starts_the_ladder_anew(monkeypatch, file):
    pretended(monkeypatch, first_order)
    sound = pgjax.scenes.trial.tried

    def tried(made, setting, what, double):
        trial = sound(made, setting, what, double)
        lost = setting.spacing > 0.03
        return Trial(what, setting, double, 1000, 10, 1.0, None, ("gone",)) if lost else trial

    monkeypatch.setattr(pgjax.scenes.trial, "tried", tried)
    found = tune(Trials(file, frames=4), 0.02)
    assert found.chosen is not None
    assert found.chosen.trial.setting.spacing < 0.03
    assert math.inf in [row.error for row in found.rows]


def test_the_budget_leaves_out_what_takes_too_long(monkeypatch, file):
    pretended(monkeypatch, first_order)
    trials = Trials(file, frames=4, budget=1e-3)
    with pytest.raises(ValueError, match="would take longer"):
        tune(trials, 0.02)
    assert len(trials.left_out) == 1


def test_nothing_moves(monkeypatch, file):
    pretended(monkeypatch, first_order)
    monkeypatch.setattr(
        pgjax.scenes.trial,
        "tried",
        lambda _, s, w, d: Trial(w, s, d, 1, 1, 1.0, np.zeros((3, 5, 3)), ()),
    )
    with pytest.raises(ValueError, match="must move"):
        tune(Trials(file, frames=4), 0.02)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--error", "0"], "`--error` must be above 0"),
        (["--error", "much"], "as in 2% or 0.02, but is much"),
        (["--frames", "1"], "`--frames` must be at least 2"),
        (["--budget", "-1"], "`--budget` must be above 0"),
        (["--out", "drop.toml"], "must name a file that is not there yet"),
        (["--out", "new.json"], "must end with .toml"),
        (["--out", "elsewhere/new.toml"], "there is no elsewhere"),
        (["--out", "../new.toml"], "must lie in the folder of the scene"),
    ],
)
def test_errors_of_the_command(tmp_path, monkeypatch, capsys, file, arguments, words):
    assert file
    monkeypatch.chdir(tmp_path)
    assert cli.main(["tune", "drop.toml", *arguments]) == 1
    assert words in capsys.readouterr().err


def test_the_command_writes_the_setting(tmp_path, monkeypatch, capsys, file):
    """Into the scene, which is kept as it was; a second time it is not overwritten."""
    assert file
    pretended(monkeypatch, first_order)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["tune", "drop.toml", "--error", "2%"]) == 0
    told = capsys.readouterr().out
    assert (tmp_path / "drop.before-tune.toml").read_text() == FINE
    made = own(read_scene(tmp_path / "drop.toml"))
    assert made.fraction == 0.9
    assert f"chosen     {made}" in told
    assert cli.main(["tune", "drop.toml", "--error", "2%"]) == 1
    assert "must not have been tuned before" in capsys.readouterr().err
    assert cli.main(["tune", "drop.toml", "--error", "0.03", "--out", "other.toml"]) == 0
    assert (tmp_path / "other.toml").exists()


def test_a_preset_becomes_a_file_here(tmp_path, monkeypatch, capsys):
    pretended(monkeypatch, first_order)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["tune", "fox"]) == 0
    assert read_scene(tmp_path / "fox.toml").name == "fox"
    assert cli.main(["tune", "fox"]) == 1
    assert "not there yet" in capsys.readouterr().err


def test_what_is_best_already_is_not_written(tmp_path, monkeypatch, capsys, file):
    def law(setting):
        error, seconds = first_order(setting)
        return error, 1e-3 if setting == own(file) else seconds

    pretended(monkeypatch, law)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["tune", "drop.toml", "--error", "5%"]) == 0
    assert "nothing is written" in capsys.readouterr().out
    assert (tmp_path / "drop.toml").read_text() == FINE
    assert not (tmp_path / "drop.before-tune.toml").exists()


def test_what_would_be_run_is_said(tmp_path, monkeypatch, capsys, file):
    assert file
    monkeypatch.chdir(tmp_path)
    coarse = changed(DROP, ("spacing = 0.1", "spacing = 0.06"))
    (tmp_path / "drop.toml").write_text(coarse)
    assert cli.main(["tune", "drop.toml", "--dry-run"]) == 0
    told = capsys.readouterr().out
    assert told.count("always") == 4
    assert "cubic" in told
    assert "writes     drop.toml" in told
    assert (tmp_path / "drop.toml").read_text() == coarse


@pytest.mark.slow
def test_a_ball_that_falls(tmp_path):
    """All of it: the setting is within the error of a grid finer than any that was looked at."""
    save_ply(tmp_path / "drop.ply", ball(2000))
    path = tmp_path / "drop.toml"
    path.write_text(
        changed(DROP, ("frames = 3", "frames = 8"), ("spacing = 0.1", "spacing = 0.05"))
    )
    trials = Trials(read_scene(path), frames=8)
    found = tune(trials, 0.05)
    assert found.chosen is not None
    base = own(trials.file)
    finest = min(trial.setting.spacing for trial in trials.done)
    fine = trials.run(
        "reference", type(base)(finest / RATIO, 0.5, base.spline, base.scheme, base.fraction)
    )
    assert fine is not None
    assert largest(found.chosen.trial.x - fine.x) / scale(fine.x) < 2 * 0.05
