"""Damaged scene files: whatever is in them, they are read, or refused with a `SceneError`."""

import tomllib

import everything
import pytest
import tomli_w
from hypothesis import given
from mutations import TOML_ONLY, cheaply, damaged, damaged_bytes, fuzz, refused
from scene_files import DROP, changed

from pgjax.scenes import SceneError, plan, read_scene

TREE = tomllib.loads(everything.SCENE)
SMALL = tomllib.loads(changed(DROP, ("drop.ply", "ball.ply")))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    everything.write_files(folder)
    return folder


def reread(folder, content):
    """Read a scene of this content; the files in the folder stay as they are."""
    path = folder / "scene.toml"
    path.write_bytes(content)
    before = sorted(p.name for p in folder.iterdir())
    try:
        return read_scene(path)
    finally:
        assert sorted(p.name for p in folder.iterdir()) == before


def test_the_whole_is_valid(folder):
    made = plan(reread(folder, everything.SCENE.encode()))
    assert made.scene.particle_count > 100
    assert len(made.scene.boundaries) == 4
    assert len(made.scene.particle_conditions) == 4


@fuzz(120)
@given(content=damaged(TREE, TOML_ONLY))
def test_damaged_values(folder, content):
    with refused(SceneError):
        reread(folder, tomli_w.dumps(content).encode())


@fuzz(100)
@given(content=damaged_bytes(everything.SCENE.encode()))
def test_damaged_text(folder, content):
    with refused(SceneError):
        reread(folder, content)


@fuzz(40)
@given(content=damaged(SMALL))
def test_damaged_plans(folder, content):
    """What is read is planned or refused, and its cameras are there: nothing is simulated."""
    with refused(SceneError):
        made = plan(reread(folder, tomli_w.dumps(content).encode()))
        for frame in (0, made.frames):
            made.camera(frame)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # Out of reach of the numbers of the simulation, which the reader's are not.
        ("fps = 25", "fps = 1e-320", "A frame of inf s must take fewer than 2.31 steps"),
        ("fps = 25", "fps = 25\ndt = 1e-300", "fewer than 2.31 steps"),
        ("fps = 25", "fps = 25\nfraction = 1e-300", "fewer than 2.31 steps"),
        ("frames = 3", "frames = 2147483647", "`frames` must be at most 178956970 of 12 steps"),
        ("size = 0.5", "size = 0.5\nvelocity = [1e30, 0, 0]", "a particle too fast"),
        ("density = 1000", "density = 1e-40", "too light"),
        ("width = 64", "width = 64\nradius = 1e-300\ntarget = [1, 1, 1]", "`target` must differ"),
        ("width = 64", "width = 64\nbackground = [1e9, 0, 0]", "`background` must .* from 0 to 1"),
        ('ply = "ball.ply"', f'ply = "{"x" * 5000}"', "must name a file, but there is no …xxx"),
        ('ply = "ball.ply"', r'ply = "a\u0000b"', r"must name a file, but there is no '.*a\\x00b'"),
        ('ply = "ball.ply"', 'ply = "/dev/zero"', "must name a file"),
    ],
)  # fmt: skip
def test_found_by_fuzzing(folder, old, new, words):
    text = changed(DROP, ("drop.ply", "ball.ply"), (old, new))
    with pytest.raises(SceneError, match=words):
        plan(reread(folder, text.encode()))


@pytest.mark.parametrize(
    "change",
    [
        "up = [1e-200, 0, 0]",
        "up = [1e200, 1e200, 0]",
        "rotation = [{ axis = [1e-200, 0, 0], angle = 3 }]",
        "rotation = 1e308",
        "region = { shape = 'cylinder', start = [0, 0, 0], end = [0, 1e-170, 0], radius = 9 }",
    ],
)
def test_directions_of_any_length(folder, change):
    """Their squares are 0 or infinite."""
    text = changed(DROP, ("drop.ply", "ball.ply"), ("size = 0.5", f"size = 0.5\n{change}"))
    if "region" in change:
        with pytest.raises(SceneError, match="none of them in the region"):
            plan(reread(folder, text.encode()))
        return
    assert plan(reread(folder, text.encode())).scene.particle_count == 200


@pytest.mark.parametrize(
    "name", ["../../etc", "/tmp/elsewhere", "a/b", r"a\b", "", ".", "..", "a\0b", "a\nb", "é" * 101]
)
def test_a_name_leads_to_no_other_folder(folder, name):
    """It is the name of the output folder."""
    content = tomli_w.dumps(SMALL | {"name": name}).encode()
    with pytest.raises(SceneError, match=r"`name` must name a folder, without slashes"):
        reread(folder, content)


def test_the_name_of_a_file_leads_to_no_other_folder(folder):
    content = {key: value for key, value in SMALL.items() if key != "name"}
    (folder / "...toml").write_text(tomli_w.dumps(content))
    with pytest.raises(SceneError, match=r"`name` must name a folder.*but is '\.\.'"):
        read_scene(folder / "...toml")
    (folder / "...toml").unlink()


REPEATED = tomli_w.dumps(SMALL) + "".join(f"\n[[particles]]\nx{i} = 1" for i in range(5000))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = " + b"[" * 100_000, "is not a TOML file: maximum recursion depth"),
        (b"a" + b".a" * 100_000 + b" = 1", "a key of more than 100 parts"),
        (b"[a" + b".a" * 100_000 + b"]", "a key of more than 100 parts"),
        (b"a = " + b"9" * 100_000, "is not a TOML file: Exceeds the limit"),
        (b"a = '\xff\xfe'", "is not a TOML file: 'utf-8' codec can't decode"),
        (b"name = '" + b"x" * (1 << 20) + b"'", "it is larger than 1 MiB"),
        (b"".join(b"namx%d = 1\n" % i for i in range(40_000)), "`model` is missing"),
        (REPEATED.encode(), r"\[\[particles\]\] 1: `type` is missing"),
        (b"\0" * 100, "is not a TOML file"),
    ],
    ids=lambda value: value[:12].decode(errors="replace") if isinstance(value, bytes) else "",
)
def test_files_made_to_take_long_are_refused_at_once(folder, content, words):
    with cheaply(), pytest.raises(SceneError, match=words):
        reread(folder, content)


def test_a_hint_is_looked_for_among_short_names_only(folder):
    """The search takes the square of the length."""
    name = "ab" * 100_000
    text = changed(
        DROP,
        ("drop.ply", "ball.ply"),
        ("size = 0.5", f'size = 0.5\nname = "{name}"'),
        ("E = 2e4", f'E = 2e4\nmodel = "{name[1:]}"'),
    )
    with cheaply(), pytest.raises(SceneError, match="`model` must be the `name` of a model"):
        reread(folder, text.encode())
