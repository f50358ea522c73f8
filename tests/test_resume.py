"""Runs that are stopped go on as if they had not been; what a run would do is said before."""

import contextlib
import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene_files import DROP, changed, write

import pgjax
import pgjax.models as pm
from pgjax import cli
from pgjax.render import Gaussians, save_ply
from pgjax.result import SimulationError
from pgjax.scenes import plan, read_scene, summary
from pgjax.scenes import run as run_to_video
from pgjax.scenes.record import unfinished
from pgjax.scenes.summary import needed_memory
from pgjax.storage import digest

RUN = sys.modules["pgjax.scenes.run"]
RECORD = sys.modules["pgjax.scenes.record"]

SCENE = changed(
    DROP,
    ("size = 0.5", "size = 0.5\nup = [0, 0, 1]"),
    ("frames = 3", "frames = 6"),
    ("yield_stress = 200", "yield_stress = 200, hardening = 0.1"),
)


def captured(seed=0, n=80):
    """A ball of Gaussians."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3))
    means *= 0.4 * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(means, axis=1, keepdims=True)
    scales = np.exp(rng.normal(-3, 0.3, (n, 3)))
    parts = (means, rng.normal(size=(n, 4)), scales, np.full(n, 0.9), rng.normal(size=(n, 1, 3)))
    return Gaussians.from_scales(*(jnp.asarray(a) for a in parts))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    save_ply(folder / "drop.ply", captured())
    (folder / "drop.toml").write_text(SCENE)
    return folder


def planned(folder, *changes, frames=None):
    """The plan of the scene, with some of its text changed."""
    path = write(folder, changed(SCENE, *changes), name="changed.toml")
    return plan(read_scene(path), frames=frames)


EVERYTHING = {"ply_frames": True, "trajectory_frames": True}


@pytest.fixture(scope="module")
def whole(folder):
    """The folder of a run that was never stopped."""
    run_to_video(planned(folder), folder / "whole", **EVERYTHING)
    return folder / "whole"


def contents(folder):
    """Every file by its name, the times in `run.json` left out."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            files[str(path.relative_to(folder))] = path.read_bytes()
    record = json.loads(files["run.json"])
    assert record.pop("seconds") > 0
    return files | {"run.json": record}


def assert_same_run(folder, whole):
    got, expected = contents(folder), contents(whole)
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        assert got[name] == value, name


class Stopped(Exception):
    """What stops a run in a test where nothing can be cleaned up: as if it were killed."""


FULL = OSError(28, "No space left on device")


def stop(monkeypatch, name, count, error):
    """Make a function that the run calls fail at its call number `count`."""
    homes = [module for module in (RUN, RECORD) if hasattr(module, name)]
    original, calls = getattr(homes[0], name), []

    def failing(*args, **kwargs):
        calls.append(name)
        if len(calls) == count:
            raise error
        return original(*args, **kwargs)

    for module in homes:
        monkeypatch.setattr(module, name, failing)


def test_a_run_leaves_nothing_but_its_results(whole):
    names = set(contents(whole))
    frames = [f"{i:05d}" for i in range(7)]
    assert names == {
        *("video.mp4", "first.png", "last.png", "run.json"),
        *(f"ply/{i}.ply" for i in frames),
        *(f"trajectory/{i}.npz" for i in frames),
    }


def test_trajectory_frames_hold_the_particles(folder, whole):
    p = planned(folder)
    rolled = pgjax.simulate(p.scene, p.state, dt=p.dt, frames=1, substeps=p.substeps)
    with np.load(whole / "trajectory" / "00001.npz") as frame:
        assert set(frame) == {"t", "x", "v", "F"}
        for name in ("x", "v", "F"):
            np.testing.assert_array_equal(frame[name], getattr(rolled.saved, name)[1])
        np.testing.assert_allclose(frame["t"], 1 / 25, rtol=1e-6)


# Each place where a run can be stopped: which function it calls, and which call.
PLACES = [
    ("save_image", 1),
    ("save_image", 4),
    ("save_ply", 3),
    ("save_arrays", 5),
    ("save_state", 1),
    ("save_state", 3),
    ("write_json", 2),
    ("save_video", 1),
    ("advance", 6),
]


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), FULL, Stopped()], ids=lambda e: type(e).__name__
)
@pytest.mark.parametrize(("name", "count"), PLACES)
def test_going_on_is_as_never_stopped(folder, whole, tmp_path, monkeypatch, name, count, error):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(RUN, "_PATIENCE", 0)
        stop(patch, name, count, error)
        with pytest.raises(type(error)):
            run_to_video(planned(folder), out, **EVERYTHING)
    record = unfinished(out)
    assert record is not None
    assert record.frame < 6 or name == "save_video"
    frames = []
    run_to_video(planned(folder), out, resume=True, progress=lambda f, n: frames.append((f, n)))
    assert frames == [(f, 6) for f in range(max(record.frame, 1), 7)]
    assert_same_run(out, whole)


def test_states_are_kept_rarely_where_that_takes_long(folder, whole, tmp_path, monkeypatch):
    """What was drawn since the last state is drawn again, and is the same."""
    monkeypatch.setattr(RUN, "_PATIENCE", 1e9)
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        stop(patch, "save_image", 5, Stopped())
        with pytest.raises(Stopped):
            run_to_video(planned(folder), out, **EVERYTHING)
    assert unfinished(out).frame == 0
    assert (out / "ply" / "00003.ply").is_file()
    run_to_video(planned(folder), out, resume=True)
    assert_same_run(out, whole)


def test_ctrl_c_leaves_a_video_of_the_frames_so_far(folder, whole, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        # Ctrl-C keeps the last frame, however long ago a state was kept.
        patch.setattr(RUN, "_PATIENCE", 1e9)
        stop(patch, "save_image", 5, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run_to_video(planned(folder), out, **EVERYTHING)
    assert unfinished(out).frame == 3
    record = json.loads((out / "run.json").read_text())
    assert (record["frames"], record["finished"]) == (3, False)
    assert (out / "video.mp4").stat().st_size > 0
    assert (out / "last.png").read_bytes() == (out / "resume/frames/00003.png").read_bytes()
    assert (out / "first.png").read_bytes() == (whole / "first.png").read_bytes()
    # Stopped again while going on.
    with monkeypatch.context() as patch:
        stop(patch, "save_image", 2, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            run_to_video(planned(folder), out, resume=True)
    assert unfinished(out).frame == 4
    assert json.loads((out / "run.json").read_text())["frames"] == 4
    run_to_video(planned(folder), out, resume=True)
    assert_same_run(out, whole)


def test_a_longer_run_goes_on_from_a_shorter_one(folder, whole, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        stop(patch, "save_video", 1, Stopped())
        with pytest.raises(Stopped):
            run_to_video(planned(folder, frames=4), out, **EVERYTHING)
    assert unfinished(out).frames == 4
    with pytest.raises(ValueError, match=r"`frames` must be at least 4, .* but is 3"):
        run_to_video(planned(folder, frames=3), out, resume=True)
    run_to_video(planned(folder), out, resume=True)
    assert_same_run(out, whole)


def test_a_lost_particle_stops_a_resumed_run_as_it_stopped_the_first(folder, tmp_path):
    lost = planned(folder, ("point = [0, 0, -0.1]", "point = [0, 0, -9]"), frames=30)
    out = tmp_path / "out"
    with pytest.raises(SimulationError, match=r"Stopped at frame \d+: OUT_OF_DOMAIN") as first:
        run_to_video(lost, out)
    before = contents(out)
    assert before["run.json"]["finished"] is False
    with pytest.raises(SimulationError) as second:
        run_to_video(lost, out, resume=True)
    assert str(second.value) == str(first.value)
    after = contents(out)
    for name in ("video.mp4", "first.png", "last.png", "run.json"):
        assert after[name] == before[name]


# --- What cannot be gone on with -----------------------------------------------------------------


@pytest.fixture
def half(folder, tmp_path, monkeypatch):
    """The folder of a run that was killed after frame 2."""
    with monkeypatch.context() as patch:
        patch.setattr(RUN, "_PATIENCE", 0)
        stop(patch, "save_image", 4, Stopped())
        with pytest.raises(Stopped):
            run_to_video(planned(folder), tmp_path / "half", trajectory_frames=True)
    return tmp_path / "half"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("density = 500", "density = 50"), ["`dt` (0.0", "`scene.materials` ("]),
        (("friction = 0.3", "friction = 0.4"), ["`scene.boundaries` ("]),
        (("fps = 25", "fps = 20"), ["`fps` (25.0 then, 20.0 now)", "`substeps` ("]),
        (("width = 64", "width = 80"), ["`view."]),
        (("size = 0.5", "size = 0.45"), ["`moving` (", "`state` (", "`to_simulation` ("]),
        (('name = "drop"', 'name = "drip"'), ["`name` (drop then, drip now)"]),
    ],
)
def test_another_scene_is_refused_and_what_differs_named(folder, half, change, words):
    before = contents_of_resume(half)
    with pytest.raises(ValueError, match="but these differ: ") as error:
        run_to_video(planned(folder, change), half, resume=True)
    for word in words:
        assert word in str(error.value)
    assert contents_of_resume(half) == before


def contents_of_resume(folder):
    return {p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_comment_may_change(folder, half):
    run_to_video(planned(folder, ("[grid]", "# The same.\n[grid]")), half, resume=True)
    assert not (half / "resume").exists()


def test_another_model_or_version_is_refused(folder, half, monkeypatch):
    save_ply(folder / "other.ply", captured(seed=1))
    other = planned(folder, ('ply = "drop.ply"', 'ply = "other.ply"'))
    with pytest.raises(ValueError, match=r"differ: .*`moving` \(\w{12} then, \w{12} now\)"):
        run_to_video(other, half, resume=True)
    version = RECORD.metadata.version
    monkeypatch.setattr(
        RECORD.metadata, "version", lambda name: "9.9" if name == "jax" else version(name)
    )
    with pytest.raises(ValueError, match=r"differ: `jax` \([\d.]+ then, 9\.9 now\)"):
        run_to_video(planned(folder), half, resume=True)


def test_files_of_each_frame_can_be_left_out_but_not_begun(folder, half):
    with pytest.raises(ValueError, match=r"`ply_frames` must be False, .* but is True"):
        run_to_video(planned(folder), half, resume=True, ply_frames=True)
    run_to_video(planned(folder), half, resume=True)
    assert len(list((half / "trajectory").iterdir())) == 7


@pytest.mark.parametrize("name", ["resume/frames/00001.png", "trajectory/00002.npz"])
def test_a_missing_frame_is_named(folder, half, name):
    (half / name).unlink()
    with pytest.raises(ValueError, match=f"{name} is missing or broken"):
        run_to_video(planned(folder), half, resume=True)


def test_half_written_files_are_never_taken_for_whole(folder, half):
    picture = half / "resume/frames/00002.png"
    raw = picture.read_bytes()
    picture.write_bytes(raw[:-3])
    with pytest.raises(ValueError, match=r"00002\.png is missing or broken"):
        run_to_video(planned(folder), half, resume=True)
    picture.write_bytes(raw)
    state = half / "resume/state-00002.npz"
    raw = state.read_bytes()
    state.write_bytes(raw[:-30])
    with pytest.raises(ValueError, match=r"state-00002\.npz must be a complete \.npz"):
        run_to_video(planned(folder), half, resume=True)
    state.write_bytes(raw)
    # What the writers had begun when the run was killed.
    for name in (".video", "resume/.state-00003", "resume/frames/.00003", "trajectory/.00003"):
        (half / f"{name}-0123456789ab.tmp").write_bytes(b"half")
    run_to_video(planned(folder), half, resume=True)
    assert not [p for p in half.rglob("*") if p.name.startswith(".")]


def test_a_state_of_another_frame_is_refused(folder, half):
    record = json.loads((half / "resume/run.json").read_text())
    record["frame"] = 1
    (half / "resume/run.json").write_text(json.dumps(record))
    os.replace(half / "resume/state-00002.npz", half / "resume/state-00001.npz")
    with pytest.raises(ValueError, match=r"must hold the state after \d+ steps, but holds the one"):
        run_to_video(planned(folder), half, resume=True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is broken: Expecting"),
        ("[]", "is not of version 1"),
        ('{"version": 2}', "is not of version 1"),
        ('{"version": 1}', "`fingerprint` is None"),
        ('{"version": 1, "fingerprint": {}, "frames": true}', "`frames` is True"),
        ("[" * 100_000, "is broken: "),
    ],
)
def test_a_broken_record_is_named(folder, half, text, words):
    (half / "resume/run.json").write_text(text)
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        run_to_video(planned(folder), half, resume=True)
    assert str(error.value).startswith(f"The file {half}/resume/run.json must be the record of")


def test_nothing_to_go_on_with(folder, whole, tmp_path):
    p = planned(folder)
    for where, words in (
        (tmp_path / "nowhere", "there is no folder"),
        (tmp_path, "holds none"),
        (whole, "is finished"),
    ):
        with pytest.raises(ValueError, match=f"of an unfinished run, but .*{words}"):
            run_to_video(p, where, resume=True)
    assert not (tmp_path / "nowhere").exists()


def test_the_digest_sees_every_bit():
    array = np.arange(4.0)
    seen = {
        digest(value)
        for value in (
            array,
            array.astype(np.float32),
            array.reshape(2, 2),
            np.nextafter(array, 9),
            [array, array],
            (array[:2], array[2:], array),
            {"a": array},
            pm.NeoHookean(1e4, 0.3),
            pm.NeoHookean(1e4, 0.31),
            pm.FixedCorotated(1e4, 0.3),
            digest,
            captured,
            None,
            "None ",
        )
    }
    assert len(seen) == 14
    assert digest(pm.NeoHookean(1e4, 0.3)) == digest(pm.NeoHookean(1e4, 0.3))


# --- The command line ----------------------------------------------------------------------------


def test_the_message_says_how_to_go_on(folder, whole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = str(folder / "drop.toml")
    with monkeypatch.context() as patch:
        stop(patch, "save_image", 3, KeyboardInterrupt())
        arguments = ["run", scene, "--save-ply", "--save-trajectory", "--out", "my out"]
        assert cli.main(arguments) == 130
    command = f"pgjax run {scene} --out 'my out' --resume"
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == f"pgjax: interrupted; go on with: {command}"
    # The folder holds something now.
    assert cli.main(["run", scene, "--out", "my out"]) == 1
    assert "It holds an unfinished run, which goes on with `--resume`" in capsys.readouterr().err
    with monkeypatch.context() as patch:
        stop(patch, "save_image", 2, FULL)
        assert cli.main(["run", scene, "--out", "my out", "--resume"]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert error == f"pgjax: [Errno 28] No space left on device; go on with: {command}"
    assert cli.main(["run", scene, "--out", "my out", "--resume"]) == 0
    assert_same_run(tmp_path / "my out", whole)
    assert cli.main(["run", scene, "--out", "my out", "--resume"]) == 1
    assert "the one in my out is finished" in capsys.readouterr().err


def test_the_number_of_frames_and_the_folder_are_remembered(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = str(folder / "drop.toml")
    assert cli.main(["run", scene, "--resume"]) == 1
    assert f"there is no folder {os.path.join('out', 'drop')}" in capsys.readouterr().err
    for _ in range(2):
        with monkeypatch.context() as patch:
            stop(patch, "save_image", 2, KeyboardInterrupt())
            assert cli.main(["run", scene, "--frames", "2"]) == 130
    assert cli.main(["run", scene, "--resume"]) == 1
    assert "must say which run to resume: out/drop, out/drop-2" in capsys.readouterr().err
    assert cli.main(["run", scene, "--out", "out/drop", "--resume"]) == 0
    assert json.loads((tmp_path / "out/drop/run.json").read_text())["frames"] == 2
    assert cli.main(["run", scene, "--resume", "--frames", "3"]) == 0
    assert json.loads((tmp_path / "out/drop-2/run.json").read_text())["frames"] == 3


# Ctrl-C is heard even where a shell ignores it, and a frame takes long enough to stop in it.
PROGRAM = """
import signal, sys, time
import pgjax.cli, pgjax.scenes
signal.signal(signal.SIGINT, signal.default_int_handler)
run = sys.modules["pgjax.scenes.run"]
paint = run._Painter.paint
run._Painter.paint = lambda *arguments: (time.sleep(0.3), paint(*arguments))[1]
sys.exit(pgjax.cli.main(sys.argv[1:]))
"""


@contextlib.contextmanager
def started(folder, out):
    """The command in a process of its own, once its run is at frame 1, and what it says."""
    arguments = ["run", str(folder / "drop.toml"), "--save-ply", "--save-trajectory"]
    environment = os.environ | {"JAX_ENABLE_X64": str(int(jax.config.jax_enable_x64))}
    # A pipe that nobody reads would stop a process that says much.
    with (out.parent / "stderr").open("w+") as said:
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *arguments, "--out", str(out)],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=said,
        )
        try:
            wait_for_frame(process, out, 1)
            yield process, said
        finally:
            process.kill()
            process.wait()


def wait_for_frame(process, out, frame):
    for _ in range(6000):
        record = unfinished(out)
        if record is not None and record.frame >= frame:
            return
        assert process.poll() is None, (out.parent / "stderr").read_text()
        time.sleep(0.02)
    raise AssertionError("the run did not come to its first frames")


@pytest.mark.slow
def test_a_killed_process(folder, whole, tmp_path):
    with started(folder, tmp_path / "out") as (process, _):
        process.kill()
        assert process.wait() == -signal.SIGKILL
    assert unfinished(tmp_path / "out").frame >= 1
    assert cli.main(["run", str(folder / "drop.toml"), "--out", f"{tmp_path}/out", "--resume"]) == 0
    assert_same_run(tmp_path / "out", whole)


def test_ctrl_c(folder, whole, tmp_path):
    with started(folder, tmp_path / "out") as (process, said):
        process.send_signal(signal.SIGINT)
        status = process.wait(timeout=120)
        said.seek(0)
        error = said.read()
    assert status == 130, error
    last = error.splitlines()[-1]
    assert last.startswith("pgjax: interrupted; go on with: pgjax run ")
    assert last.endswith("--resume")
    assert "Traceback" not in error
    assert cli.main(["run", str(folder / "drop.toml"), "--out", f"{tmp_path}/out", "--resume"]) == 0
    assert_same_run(tmp_path / "out", whole)


# --- Before a run --------------------------------------------------------------------------------


def test_a_dry_run_says_what_would_be_and_writes_nothing(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["run", str(folder / "drop.toml"), "--dry-run", "--save-ply", "--save-trajectory"]
    assert cli.main(arguments) == 0
    printed = capsys.readouterr().out
    p = planned(folder)
    for words in (
        summary(p),
        f"steps      {6 * p.substeps} in all; the largest stable one at rest is ",
        "memory     about ",
        "compiles   stress: FixedCorotated, StVKHencky",
        "compiles   plasticity: VonMises, with a history",
        "compiles   transfers: quadratic spline, 27 nodes for each particle, SplineGradient",
        "compiles   boundaries: Collider (HalfSpace, Separating)",
        "compiles   particle conditions: none",
        "compiles   no periodic direction",
        "writes     out/drop: video.mp4, first.png, last.png, run.json",
        "writes     ply/00000.ply to ply/00006.ply: 7 files of about ",
        "writes     trajectory/00000.npz to trajectory/00006.npz: 7 files of about ",
    ):
        assert words in printed
    assert not list(tmp_path.iterdir())


def test_sizes_of_files_are_foretold(folder, whole, capsys):
    arguments = ["run", str(folder / "drop.toml"), "--dry-run", "--save-ply", "--save-trajectory"]
    cli.main(arguments)
    printed = capsys.readouterr().out
    for kind, name in (("ply", "ply/00001.ply"), ("npz", "trajectory/00001.npz")):
        told = float(re.search(rf"{kind}: 7 files of about ([\d.]+) kB", printed)[1])
        # A header comes on top.
        assert told == pytest.approx((whole / name).stat().st_size / 1e3, rel=0.35)


def test_a_dry_run_of_a_resumed_one(folder, half, capsys):
    scene, before = str(folder / "drop.toml"), contents_of_resume(half)
    assert cli.main(["run", scene, "--out", str(half), "--resume", "--dry-run"]) == 0
    printed = capsys.readouterr().out
    assert "resumes    after frame 2 of 6" in printed
    assert "trajectory/00006.npz" in printed
    assert "ply/" not in printed
    assert cli.main(["run", scene, "--out", str(half), "--dry-run"]) == 1
    assert "goes on with `--resume`" in capsys.readouterr().err
    assert contents_of_resume(half) == before


def test_notes_are_printed(folder):
    noted = dataclasses.replace(planned(folder), notes=("12 needles were split", "and filled"))
    assert summary(noted).endswith("note       12 needles were split\nnote       and filled")


JELLY = pm.Material(pm.NeoHookean(1e5, 0.3), density=1000.0)
METAL = pm.Material(pm.StVKHencky(1e5, 0.3), pm.VonMises(50.0, hardening=0.1), density=1000.0)


@pytest.mark.parametrize(
    ("d", "n", "cells", "degree", "material", "scheme"),
    [
        (3, 4000, 24, 2, JELLY, pgjax.MLS()),
        (3, 4000, 24, 2, METAL, pgjax.SplineGradient()),
        (3, 4000, 24, 3, METAL, pgjax.SplineGradient()),
        (3, 500, 48, 2, JELLY, pgjax.SplineGradient()),
        (2, 4000, 32, 2, METAL, pgjax.SplineGradient()),
        (2, 500, 128, 3, JELLY, pgjax.MLS()),
    ],
)
def test_memory_is_foretold_within_a_factor_of_two(d, n, cells, degree, material, scheme):
    grid = pgjax.Grid([0.0] * d, (cells,) * d, 0.1)
    spline = pgjax.BSpline(degree)
    scene = pgjax.Scene(grid, material, np.full(n, 1e-3), spline=spline, scheme=scheme)
    x = 1 + np.random.default_rng(0).random((n, d))
    state = pgjax.initial_state(scene, x)

    def frame(scene, state):
        return pgjax.simulate(
            scene, state, dt=1e-4, frames=1, substeps=20, save=lambda _: None, throw=False
        ).final

    needed = jax.jit(frame).lower(scene, state).compile().memory_analysis()
    truth = needed.argument_size_in_bytes + needed.output_size_in_bytes + needed.temp_size_in_bytes
    assert 0.5 < sum(needed_memory(scene, state)) / truth < 2
