"""A disk that fills up while a run goes on, for real; what a stranger's run folder may hold."""

import json
import os
import shutil
import subprocess
import sys
import time

import jax
import pytest
from scene_files import DROP, ball, changed

from pgjax import cli
from pgjax.render import save_ply
from pgjax.scenes.record import unfinished

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs limits of processes")

SCENE = changed(DROP, ("frames = 3", "frames = 4"))
# No file of the process, or of the encoder that it starts, may become larger than 500 bytes: from
# the beginning on, or once the run comes to its video.
LIMITED = """
import resource, sys
import pgjax.cli, pgjax.scenes

def limit():
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500))

def save_video(*arguments, **options):
    limit()
    return encode(*arguments, **options)

run = sys.modules["pgjax.scenes.run"]
encode = run.save_video
if sys.argv[1] == "video":
    run.save_video = save_video
else:
    keep = run._Recorder.play
    run._Recorder.play = lambda *arguments: (limit(), keep(*arguments))[1]
sys.exit(pgjax.cli.main(sys.argv[2:]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("disk")
    save_ply(folder / "drop.ply", ball(60))
    (folder / "drop.toml").write_text(SCENE)
    return folder


def arguments(folder, out):
    return ["run", str(folder / "drop.toml"), "--out", str(out)]


@pytest.fixture(scope="module")
def whole(folder):
    """The folder of a run with a disk that is large enough."""
    assert cli.main([*arguments(folder, folder / "whole"), "--save-trajectory"]) == 0
    return folder / "whole"


def contents(folder):
    """Every file by its name, the times in `run.json` left out."""
    files = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    record = json.loads(files["run.json"])
    del record["seconds"]
    return files | {"run.json": record}


def limited(folder, out, fails):
    """The run on a disk that fills up."""
    environment = os.environ | {"JAX_ENABLE_X64": str(int(jax.config.jax_enable_x64))}
    # Programs that were compiled are read, but not kept: half of one would be found later.
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "1e9"
    return subprocess.run(
        [sys.executable, "-c", LIMITED, fails, *arguments(folder, out), "--save-trajectory"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("fails", "frame"), [pytest.param("frames", -1, marks=pytest.mark.slow), ("video", 4)]
)
def test_a_full_disk_keeps_what_is_complete(folder, whole, tmp_path, fails, frame):
    out = tmp_path / "out"
    done = limited(folder, out, fails)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert "go on with: pgjax run" in done.stderr
    assert unfinished(out).frame == frame
    assert not (out / "video.mp4").exists()
    for path in out.rglob("*"):
        assert not path.name.startswith("."), f"{path} was left half written"
    assert cli.main([*arguments(folder, out), "--resume"]) == 0
    assert contents(out) == contents(whole)


# --- Records of strangers ------------------------------------------------------------------------


@pytest.fixture
def begun(folder, tmp_path):
    """The folder of a run that was stopped before its first frame."""
    out = tmp_path / "begun"
    shutil.copytree(folder / "record", out)
    return out


@pytest.fixture(scope="module", autouse=True)
def recorded(folder):
    """A run that could not write its first frame."""
    limited(folder, folder / "record", "frames")
    assert unfinished(folder / "record").frame == -1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": 0}, "`frames` is 0"),
        ({"frames": -5}, "`frames` is -5"),
        ({"frames": 2**31}, "`frames` is 2147483648"),
        ({"frame": 10**30}, "`frame` is 1000000000"),
        ({"frame": -2}, "`frame` is -2"),
        ({"frame": True}, "`frame` is True"),
        ({"seconds": float("nan")}, "`seconds` is nan"),
        ({"seconds": -1.0}, "`seconds` is -1.0"),
        ({"most_bounded": -1}, "`most_bounded` is -1"),
        ({"fingerprint": {"dt": [1]}}, "`fingerprint` is"),
        ({"frame": 3}, "is missing or broken"),
        ({"version": [[]]}, "it is not of version 1"),
    ],
)
def test_a_wrong_record_is_named(folder, begun, change, words, capsys):
    path = begun / "resume" / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    started = time.process_time()
    assert cli.main([*arguments(folder, begun), "--resume"]) == 1
    assert time.process_time() - started < 10
    assert words in capsys.readouterr().err
    assert not (begun / "video.mp4").exists()


@pytest.mark.parametrize("content", [b"", b"{", b"[" * 100_000, b"\xff\xfe", b"null", b"9" * 5000])
def test_a_broken_record_is_named(folder, begun, content, capsys):
    (begun / "resume" / "run.json").write_bytes(content)
    assert cli.main([*arguments(folder, begun), "--resume"]) == 1
    assert "must be the record of an unfinished run, but is broken" in capsys.readouterr().err


def test_a_record_of_a_terabyte_is_not_read(folder, begun, capsys):
    with (begun / "resume" / "run.json").open("r+b") as file:
        file.truncate(1 << 40)
    assert cli.main([*arguments(folder, begun), "--resume"]) == 1
    assert "it is larger than 1 MiB" in capsys.readouterr().err
