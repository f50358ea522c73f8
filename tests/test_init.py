"""A capture that nobody has described yet: which way is up, what is the object, and does it run."""

import tomllib

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pgjax.cli import main
from pgjax.render import Gaussians, load_capture, load_ply, save_ply
from pgjax.scenes import plan, read_scene
from pgjax.scenes.choices import chosen
from pgjax.scenes.draft import draft
from pgjax.scenes.draft_text import ground_in_words, up_in_words
from pgjax.scenes.inspect import inspect
from pgjax.scenes.regions import BoxRegion, CylinderRegion

DOWN = Rotation.from_euler("x", 90, degrees=True)  # z up becomes y down
GROUND, RADIUS, FLOOR = 0.3, 0.4, 1.5


def discs(x, normal, size):
    """Flat Gaussians across a normal: means, factors."""
    helper = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], axis=2)
    return x, axes * np.array([size, size, size / 8])


def parts(*, ball=1500, floor=1500, floaters=30, hover=0.0, seed=0):
    """A ball of discs that stands on a floor, and floaters far around: z up, ground at GROUND."""
    rng = np.random.default_rng(seed)
    n = rng.normal(size=(ball, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    center = np.array([0.1, -0.2, GROUND + RADIUS + hover])
    level = rng.uniform(-FLOOR, FLOOR, (floor, 3))
    level[:, 2] = GROUND + 0.004 * rng.normal(size=floor)
    up = np.tile([0.0, 0, 1], (floor, 1))
    far = rng.uniform(-1, 1, (floaters, 3)) * [30, 30, 15] + [0, 0, 15]
    pieces = [
        discs(center + RADIUS * n, n, 0.02),
        discs(level, up, 0.06),
        discs(far, np.tile([1.0, 0, 0], (floaters, 1)), 0.5),
    ]
    x, factors = (np.concatenate(a) for a in zip(*pieces, strict=True))
    return x, factors, np.arange(len(x)) < ball


def capture(turn=DOWN, **options):
    """The same as Gaussians, turned; and which of them are the ball."""
    x, factors, ball = parts(**options)
    R = turn.as_matrix()
    n = len(x)
    gaussians = Gaussians(
        jnp.asarray(x @ R.T, jnp.float32),
        jnp.asarray(R @ factors, jnp.float32),
        jnp.full(n, 0.9, jnp.float32),
        jnp.zeros((n, 1, 3), jnp.float32),
        jnp.broadcast_to(jnp.eye(3, dtype=jnp.float32), (n, 3, 3)),
    )
    return gaussians, ball


def up_of(turn):
    return turn.apply([0.0, 0, 1])


TURNS = {
    "y down": DOWN,
    "z up": Rotation.identity(),
    "x up": Rotation.from_euler("y", 90, degrees=True),
    "z down": Rotation.from_euler("x", 180, degrees=True),
    "y down, tilted": Rotation.from_euler("z", 20, degrees=True) * DOWN,
    "y down, tilted twice": Rotation.from_euler("xz", [15, -12], degrees=True) * DOWN,
}


@pytest.mark.parametrize(
    "turn",
    [
        pytest.param(turn, id=name, marks=() if "tilted" in name else pytest.mark.slow)
        for name, turn in TURNS.items()
    ],
)
def test_up_ground_and_object_are_found(turn):
    gaussians, ball = capture(turn)
    found = inspect(gaussians)
    assert found.ground is not None
    angle = np.degrees(np.arccos(min(found.up @ up_of(turn), 1)))
    assert angle < 1
    assert found.ground.height == pytest.approx(GROUND, abs=0.01)
    # The floaters do not widen the box: the diagonal of the floor bounds what a turn makes of it.
    assert np.all(found.upper - found.lower < 2 * FLOOR * 1.8)
    assert found.floaters >= 25
    # All of the ball but what lies in the layer of the ground, and hardly anything else.
    assert np.count_nonzero(found.moves & ball) > 0.93 * ball.sum()
    assert np.count_nonzero(found.moves & ~ball) < 0.03 * ball.sum()
    assert found.clearance < 0.05
    assert found.pieces == 1
    # Level captures have boxes, tilted ones upright cylinders.
    level = np.abs(up_of(turn)).max() > 1 - 1e-9
    assert isinstance(found.region, BoxRegion if level else CylinderRegion)
    assert not level or sorted(np.abs(found.up)) == [0, 0, 1]


def test_what_hovers_has_its_height_over_the_ground():
    found = inspect(capture(hover=0.25)[0])
    assert found.clearance == pytest.approx(0.25, abs=0.02)


@pytest.mark.slow
def test_what_stands_on_the_ground_has_its_floor_where_it_was_cut_off():
    for hover in (0, 0.25):
        gaussians, _ = capture(hover=hover)
        choices, moving = chosen(inspect(gaussians), gaussians)
        assert choices.hover == pytest.approx(hover / (2 * RADIUS), abs=0.04)
        assert choices.floor == (0 if hover else choices.hover)
        assert float(moving.means[:, 2].min()) == pytest.approx(0, abs=1e-5)


def test_without_a_ground_the_usual_direction_is_guessed_and_said_to_be():
    gaussians, ball = capture(floor=0, floaters=0)
    found = inspect(gaussians)
    assert found.ground is None
    assert found.region is None
    assert found.moves.sum() == ball.sum()
    assert found.up.tolist() == [0, -1, 0]
    assert "-y (guessed: no ground plane found)" in up_in_words(found)
    assert "guessed" in ground_in_words(found)


@pytest.fixture(scope="module")
def drafted(tmp_path_factory):
    """A folder with a capture, a scene file drafted for it in another one, and what was printed."""
    folder = tmp_path_factory.mktemp("init")
    (folder / "scenes").mkdir()
    save_ply(folder / "ball one.ply", capture(ball=600, floor=400, hover=0.1)[0])
    out = folder / "scenes" / "ball.toml"
    assert main(["init", str(folder / "ball one.ply"), "--out", str(out)]) == 0
    return out


def test_the_file_says_what_was_chosen_and_is_planned(drafted):
    text = drafted.read_text()
    content = tomllib.loads(text)
    assert content["model"]["ply"] == "../ball one.ply"
    assert content["model"]["up"] == [0, -1, 0]
    assert content["model"]["fill"] == {}
    assert content["model"]["position"][2] == pytest.approx(0.1 / (2 * RADIUS), abs=0.03)
    for said in ("ground plane under", "particles in all", "on two cores", "closed bodies"):
        assert said in text
    planned = plan(read_scene(drafted))
    x = np.asarray(planned.state.x)
    assert np.ptp(x, axis=0).max() == pytest.approx(1, abs=0.1)
    assert x[:, 2].min() == pytest.approx(content["model"]["position"][2], abs=0.05)
    still = np.asarray(planned.still.means)
    near = still[np.all(np.abs(still[:, :2]) < 1.5, axis=1)]
    assert np.median(near[:, 2]) == pytest.approx(0, abs=0.02)


def test_the_same_capture_gives_the_same_file(drafted):
    assert draft(drafted.parent.parent / "ball one.ply", drafted).text == drafted.read_text()


@pytest.mark.slow
def test_the_file_runs(drafted, tmp_path):
    small = drafted.with_name("small.toml")
    small.write_text(drafted.read_text().replace("fov = 40", "fov = 40\nwidth = 48\nheight = 48"))
    out = tmp_path / "out"
    assert main(["run", str(small), "--frames", "2", "--out", str(out)]) == 0
    assert (out / "video.mp4").is_file()


@pytest.mark.parametrize("name", ["Sand", "Soft metal", "Jam"])
def test_the_other_materials_of_the_file_can_be_taken(drafted, name):
    before, _, after = drafted.read_text().partition(f"# {name}")
    block, gap, rest = after.partition("\n#\n") if name != "Jam" else after.partition("\n\n")
    lines = [line.removeprefix("# ") for line in block.splitlines()[1:]]
    before = before.replace('[[material]]\nlaw = "fixed-corotated"\nE = 1e5\nnu = 0.3\n', "")
    before = before.replace("density = 400\n", "", 1)
    other = drafted.with_name("other.toml")
    other.write_text("\n".join([before, *lines, gap, rest]))
    (material,) = plan(read_scene(other)).scene.materials
    assert material.plasticity is not None


def test_nothing_is_overwritten(drafted, capsys):
    before = drafted.read_bytes()
    model = drafted.parent.parent / "ball one.ply"
    assert main(["init", str(model), "--out", str(drafted)]) == 1
    assert "Argument `--out` must name a file that is not there yet" in capsys.readouterr().err
    assert drafted.read_bytes() == before


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("scene.txt", "Argument `--out` must end with .toml, but is 'scene.txt'"),
        ("nowhere/scene.toml", "Argument `--out` must lie in an existing folder"),
    ],
)
def test_outputs_that_cannot_be_are_refused(tmp_path, capsys, out, message):
    assert main(["init", "a.ply", "--out", str(tmp_path / out)]) == 1
    assert message in capsys.readouterr().err


def at_one_place(n):
    gaussians, _ = capture(ball=n, floor=0, floaters=0)
    means = jnp.broadcast_to(gaussians.means[:1], gaussians.means.shape)
    return Gaussians(means, gaussians.factors, gaussians.opacities, gaussians.sh, gaussians.frames)


@pytest.mark.parametrize(
    ("gaussians", "message"),
    [
        (capture(ball=3, floor=0, floaters=0)[0], "must hold at least 16 Gaussians above"),
        (at_one_place(50), "must not have all its Gaussians at one place"),
    ],
)
def test_captures_with_too_little_in_them_are_refused(tmp_path, capsys, gaussians, message):
    save_ply(tmp_path / "a.ply", gaussians)
    out = tmp_path / "a.toml"
    assert main(["init", str(tmp_path / "a.ply"), "--out", str(out)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert "a.ply" in error
    assert not out.exists()


def test_files_that_are_no_captures_are_refused(tmp_path, capsys):
    (tmp_path / "a.ply").write_bytes(b"ply\nnothing")
    for name in ("a.ply", "missing.ply"):
        assert main(["init", str(tmp_path / name), "--out", str(tmp_path / "a.toml")]) == 1
        assert name in capsys.readouterr().err
    assert not (tmp_path / "a.toml").exists()


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_captures_of_any_size(scale):
    gaussians, ball = capture()
    other = Gaussians(
        scale * gaussians.means,
        scale * gaussians.factors,
        gaussians.opacities,
        gaussians.sh,
        gaussians.frames,
    )
    found = inspect(other)
    assert found.ground is not None
    assert found.ground.height == pytest.approx(scale * GROUND, abs=0.01 * scale)
    assert np.count_nonzero(found.moves & ball) > 0.93 * ball.sum()


@pytest.mark.parametrize("name", ["playbot_1873.ply", "playbot_8406.ply", "playbot_31000.ply"])
def test_a_captured_robot_hovers_over_grass(reference_data, name):
    found = inspect(load_capture(reference_data / "splats" / name).gaussians)
    assert found.ground is not None
    assert found.up.tolist() == [0, -1, 0]
    assert found.ground.height == pytest.approx(0.02, abs=0.02)
    # By hand: everything below y = -0.18 belongs to the ground.
    assert found.foot == pytest.approx(0.19, abs=0.03)


def test_a_captured_guitar_stands_on_nothing(reference_data):
    capture = load_capture(reference_data / "splats" / "guitar.compressed.ply")
    found = inspect(capture.gaussians)
    assert found.ground is None
    assert found.region is None


def test_a_captured_statue_stands_on_its_pedestal(reference_data):
    found = inspect(load_ply(reference_data / "splats" / "angel_71359.ply"))
    assert found.ground is not None
    assert found.up.tolist() == [0, -1, 0]
    # By hand: the top of the pedestal is at y = 0.03.
    assert found.ground.height == pytest.approx(-0.03, abs=0.03)
    assert 0.5 < found.moves.sum() / found.total < 0.9
