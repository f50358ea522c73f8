"""`pgjax sweep`: keys of a scene file, values of parameters, files, messages and pictures."""

import csv

import numpy as np
import pytest
from scene_files import DROP, ball, write

import pgjax
from pgjax import cli
from pgjax.render import save_image, save_ply
from pgjax.render.media import load_image
from pgjax.scenes import SceneError, plan, read_scene
from pgjax.scenes.schema import TimePart
from pgjax.sweeps import Table
from pgjax.sweeps.keys import full_key, known_keys, varied
from pgjax.sweeps.mosaic import tiled
from pgjax.sweeps.study import study


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene file with two materials."""
    folder = tmp_path_factory.mktemp("scene")
    save_ply(folder / "drop.ply", ball())
    return write(folder, DROP)


@pytest.fixture(scope="module")
def drop(scene):
    return plan(read_scene(scene))


def test_short_keys(drop):
    for name, key in (
        ("yield_stress", "material.2.plasticity.yield_stress"),
        ("2.E", "material.2.E"),
        ("material.1.nu", "material.1.nu"),
        ("friction", "boundary.friction"),
        ("boundary.1.friction", "boundary.1.friction"),
        ("velocity", "model.velocity"),
        ("gravity", "forces.gravity"),
    ):
        assert full_key(name, drop) == key
    assert "material.2.density" in known_keys(drop)
    # A wall without friction has none to vary.
    assert not any(key.startswith("boundary.2") for key in known_keys(drop))


def test_values(drop):
    found = varied("friction=0:0.6:4", drop)
    np.testing.assert_allclose(found.values, [0, 0.2, 0.4, 0.6])
    np.testing.assert_allclose(varied("yield_stress=1e2:1e4:3:log", drop).values, [1e2, 1e3, 1e4])
    np.testing.assert_allclose(varied("2.nu=.1,.3,.45", drop).values, [0.1, 0.3, 0.45])
    velocities = varied("velocity=0,0,-1; 1,0,-2", drop).values
    np.testing.assert_allclose(velocities, [[0, 0, -1], [1, 0, -2]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("E=1e4", "must say which of material.1.E, material.2.E is meant"),
        ("yield_stres=1", r"must name one of .* \(did you mean `yield_stress`\?\)"),
        ("material.1.nuu=1", "did you mean `nu`"),
        ("walls.1.friction=1", "must begin with material"),
        ("friction", "must be KEY=FIRST:LAST:COUNT"),
        ("friction=", "must be KEY=FIRST:LAST:COUNT"),
        ("friction=a", "could not convert string to float"),
        ("friction=0.1,nan", "a value is not finite"),
        ("friction=0:1", "a range has two ends and a count"),
        ("friction=0:1:0", "the count is from 1"),
        ("friction=0:1:3:log", "the ends of a logarithmic range are positive"),
        ("velocity=1,2", "vectors of 3 numbers"),
        ("velocity=1,2,3;4", "for a vector"),
    ],
)
def test_bad_values(drop, text, message):
    with pytest.raises(SceneError, match=message):
        varied(text, drop)


def test_values_out_of_their_range_are_errors_of_members(drop):
    """Values are put into a scene that is built already: they are looked at all the same."""
    texts = ["friction=-0.1,0.2", "2.density=0,500", "yield_stress=-1,100"]
    made = study(drop, read_scene_time(), texts, trajectories=False)
    need = made.layout(at_once=None, memory=None).need
    assert np.flatnonzero(need.substeps).tolist() == [7]
    assert "`friction` must be at least 0" in need.errors[3]
    assert "`density` must be positive" in need.errors[5]
    assert "`yield_stress` must be at least 0" in need.errors[6]
    with pytest.raises(SceneError, match=r"once, but material\.2\.E is there twice"):
        study(drop, read_scene_time(), ["2.E=1e4", "material.2.E=1e5"], trajectories=False)


def read_scene_time():
    return TimePart(frames=3, fps=25.0, dt=None, fraction=0.5, allow_unstable=False)


def test_the_command(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["sweep", str(scene), "--vary", "2.E=2e4,4e4", "--vary", "2.nu=0.3,0.5"]
    assert cli.main([*command, "--frames", "2", "--dry-run"]) == 0
    told = capsys.readouterr().out
    assert "4, of which 2 cannot be simulated" in told
    assert "out/drop-sweep: sweep.csv, sweep.png, pictures/" in told
    assert not (tmp_path / "out").exists()

    assert cli.main([*command, "--frames", "2", "--save-trajectory"]) == 0
    told = capsys.readouterr().out
    assert "4 members: 2 ok, 2 failed" in told
    assert "2 of them: Argument `nu` must be below 0.5, but is 0.5." in told
    folder = tmp_path / "out" / "drop-sweep"
    names = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert names == {
        "sweep.csv",
        "sweep.png",
        *(f"pictures/0000{i}.png" for i in (0, 2)),
        *(f"trajectories/0000{i}.npz" for i in (0, 2)),
    }
    # The member with the scene's own values moves as the scene does.
    with np.load(folder / "trajectories" / "00000.npz") as kept:
        saved = dict(kept)
    own = plan(read_scene(scene), frames=2)
    with (folder / "sweep.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    steps = int(rows[0]["substeps"])
    assert steps >= own.substeps
    alone = pgjax.simulate(own.scene, own.state, dt=1 / own.fps / steps, frames=2, substeps=steps)
    rounding = 1e-12 if saved["x"].dtype == np.float64 else 1e-5
    np.testing.assert_allclose(saved["x"], alone.saved.x, rtol=0, atol=rounding)
    np.testing.assert_allclose(saved["t"], [0, 0.04, 0.08], rtol=1e-5)
    assert list(saved) == ["t", "x", "v", "F"]
    assert load_image(folder / "pictures" / "00002.png").shape == (48, 64, 3)
    assert load_image(folder / "sweep.png").shape[0] > 150


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--resume"], "`--out` must be given with `--resume`"),
        (["--share", "3/2", "--out", "o"], "must be I/N with 1 ≤ I ≤ N, but is '3/2'"),
        (["--frames", "0"], "`--frames` must be at least 1"),
        (["--memory", "1e-6"], "`memory` must be at least"),
        (["--out", "."], "must be a new or an empty folder"),
    ],
)
def test_the_command_refuses(scene, tmp_path, monkeypatch, capsys, more, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").touch()
    assert cli.main(["sweep", str(scene), "--vary", "2.E=2e4", *more]) == 1
    assert message in capsys.readouterr().err


def test_the_mosaic_has_a_place_for_each_member(tmp_path):
    """Small pictures in their order; red frames and grey fields for those that failed."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for i in range(5):
        save_image(pictures / f"{i:05d}.png", np.full((20, 30, 3), i / 8))
    columns = {
        "E": np.repeat([1.0, 2.0], 3),
        "nu": np.tile([0.1, 0.2, 0.3], 2),
        "status": np.asarray(["ok", "ok", "failed", "ok", "ok", "failed"]),
    }
    tiles = tiled(Table(columns, {}, ("E", "nu"), (2, 3)), pictures, 2, 3)
    assert tiles.shape == (40, 90, 3)
    centres = tiles[10::20, 15::30, 0]
    np.testing.assert_allclose(centres[:, :2], [[0, 1 / 8], [3 / 8, 4 / 8]], atol=0.01)
    np.testing.assert_allclose(centres[:, 2], [2 / 8, 0.85], atol=0.01)
    assert tiles[0, 60, 0] > 2 * tiles[0, 60, 1]
