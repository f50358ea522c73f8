"""Case files: from recorded pictures or tracks to a report and a fitted scene file."""

import tomllib

import equinox as eqx
import imageio.v3 as imageio
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
from pgjax import cli
from pgjax.cases import prepare, read_case
from pgjax.cases.unknowns import Unknown, place
from pgjax.inverse import Parameter, Pictures
from pgjax.render import save_image, save_video
from pgjax.scenes import SceneError, plan, read_scene

SCENE = """
[model]
procedural = "ficus"
size = 0.3
position = [0.5, 0.5, 0.22]
velocity = [0.0, 0.0, -1.0]
opacity_above = 0.5
surroundings = false
[model.region]
lower = [-1.0, -1.0, -0.1]
upper = [1.0, 1.0, 0.28]

[grid]
lower = [0.0, 0.0, 0.0]
upper = [1.0, 1.0, 1.0]
spacing = 0.0625
scheme = "mls"

[time]
frames = 6
fps = 50

[forces]
gravity = [0.0, 0.0, -9.81]

[camera]
width = 48
height = 48
radius = 1.1
background = [0.2, 0.2, 0.2]

[[material]]
law = "fixed-corotated"
E = 2e4
nu = 0.3
density = 400

[[boundary]]
type = "half-space"
point = [0.0, 0.0, 0.2]
normal = [0.0, 0.0, 1.0]
friction = 0.4
"""

CASE = """
scene = "scene.toml"
fit_frames = 5
noise = 0.02
{extra}

[[unknown]]
key = "material.E"
start = {start}
lower = 5e3
upper = 5e4
log = true
unit = "Pa"

[[unknown]]
key = "model.velocity"
start = [0.1, 0.0, -0.9]
lower = -3
upper = 3
unit = "m/s"

[solver]
trials = 8
tolerance = 1e-3
stage = [{{ frames = 2, free = ["model.velocity"], coarser = 4 }}]

{data}
"""
VIEW = '[[view]]\nframes = "film"\n'


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A scene, and its frames as pictures, video and track."""
    folder = tmp_path_factory.mktemp("case")
    (folder / "scene.toml").write_text(SCENE)
    made = plan(read_scene(folder / "scene.toml"))
    trajectory = pgjax.simulate(
        made.scene, made.state, dt=made.dt, frames=made.frames, substeps=made.substeps
    )
    (folder / "film").mkdir()
    blank = np.zeros((1, 48, 48, 3))
    camera = made.camera(0)
    sight = Pictures(made.moving, camera, blank, background=made.view.background, still=made.still)
    pictures = []
    for frame in range(made.frames + 1):
        state = trajectory.final
        at = trajectory.saved.x[frame] - made.scene.grid.origin.astype(state.dtype)[None]
        H = trajectory.saved.F[frame] - jnp.eye(3, dtype=state.dtype)[None]
        state = eqx.tree_at(lambda s: (s.position, s.He), state, (at, H))
        pictures.append(np.asarray(sight.see(state), np.float64))
        save_image(folder / "film" / f"f{frame:03}.png", pictures[-1])
    save_video(folder / "film.mp4", pictures, fps=50)
    np.savez(folder / "track.npz", x=np.asarray(trajectory.saved.x))
    return folder


def write(folder, name="case.toml", *, start=1e4, data=VIEW, extra=""):
    path = folder / name
    path.write_text(CASE.format(start=start, data=data, extra=extra))
    return path


@pytest.mark.slow
@pytest.mark.float64
def test_fit_from_pictures(recorded, tmp_path, capsys):
    """From a folder of pictures to a report, and a scene file that runs."""
    case = write(recorded)
    out = tmp_path / "out"
    assert cli.main(["fit", str(case), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "material.E" in printed
    report = (out / "report.md").read_text()
    assert "frames 6 to 6, which were not fitted" in report
    assert "| `material.E` |" in report
    sheet = imageio.imread(out / "view-1.png")
    assert sheet.shape == (3 * 50, 6 * 50, 3)
    course = imageio.imread(out / "convergence.png")
    # Something is drawn.
    assert np.mean(course[..., :3].min(axis=-1) < 250) > 0.02
    fitted = tomllib.loads((out / "fitted.toml").read_text())
    assert fitted["time"]["dt"] == prepare(read_case(case)).problem.dt
    np.testing.assert_allclose(np.log10(fitted["material"][0]["E"] / 2e4), 0, atol=0.03)
    np.testing.assert_allclose(fitted["model"]["velocity"], [0, 0, -1], atol=0.03)
    planned = plan(read_scene(out / "fitted.toml"))
    np.testing.assert_allclose(planned.scene.materials[0].elasticity.E, fitted["material"][0]["E"])
    # Nothing is overwritten.
    assert cli.main(["fit", str(case), "--out", str(out)]) == 1


@pytest.mark.slow
@pytest.mark.float64
def test_fit_from_a_track(recorded, tmp_path):
    case = write(recorded, "track.toml", data='[track]\nfile = "track.npz"\n')
    assert cli.main(["fit", str(case), "--out", str(tmp_path / "out")]) == 0
    fitted = tomllib.loads((tmp_path / "out" / "fitted.toml").read_text())
    np.testing.assert_allclose(fitted["material"][0]["E"], 2e4, rtol=1e-2)


def test_every_unknown_finds_its_place(recorded):
    """What a key names is what changes."""
    made = plan(read_scene(recorded / "scene.toml"))

    def put(key, value):
        at = place(Unknown(key, Parameter(value), key), made)
        return at, at.put(made.scene, made.state, jnp.asarray(value, made.state.dtype))

    at, (scene, _) = put("material.1.nu", 0.1)
    np.testing.assert_allclose(at.now, 0.3)
    np.testing.assert_allclose(scene.materials[0].elasticity.nu, 0.1)
    _, (scene, _) = put("boundary.1.friction", 0.7)
    np.testing.assert_allclose(scene.boundaries[0].contact.friction, 0.7)
    _, (scene, _) = put("forces.gravity", (1.0, 2.0, 3.0))
    np.testing.assert_allclose(scene.gravity, [1, 2, 3])
    _, (_, state) = put("model.velocity", (1.0, 2.0, 3.0))
    np.testing.assert_allclose(state.v, np.broadcast_to([1, 2, 3], state.v.shape), rtol=1e-6)
    spun = SCENE.replace("opacity_above", "angular_velocity = [10.0, -20.0, 30.0]\nopacity_above")
    (recorded / "spun.toml").write_text(spun)
    expected = plan(read_scene(recorded / "spun.toml")).state
    _, (_, state) = put("model.angular_velocity", (10.0, -20.0, 30.0))
    np.testing.assert_allclose(state.v, expected.v, atol=1e-6)
    np.testing.assert_allclose(state.C, expected.C, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("material.E", "material.G"), "end with one of E, density, nu"),
        (("material.E", "metal.E"), "begin with material"),
        (("material.E", "material.plasticity.E"), "end with one of"),
        (("model.velocity", "model.2.velocity"), "count the .*model.* tables from 1 to 1"),
        (("material.E", "material.2.E"), "count the .*material.* tables from 1 to 1"),
        (("start = 10000.0", "start = [1.0, 2.0, 3.0]"), "`start` must"),
        (("fit_frames = 5", "fit_frames = 9"), "`fit_frames` must be a whole number"),
        (("fit_frames = 5", "frame_rate = 0"), "`frame_rate` must be"),
        (("trials", "trails"), "`trails` is not a known key"),
        (("upper = 5e4\n", ""), "`upper` of parameter 'material.E' must be given"),
        (('frames = "film"', 'video = "film.mp4"\nframes = "film"'), "not both"),
        (('frames = "film"', 'frames = "filn"'), "there is no"),
    ],
)
def test_bad_cases(recorded, change, message):
    path = write(recorded, "bad.toml")
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change))
    with pytest.raises(ValueError, match=message):
        prepare(read_case(path))


def test_bad_data(recorded, tmp_path):
    """Another frame rate, another size, a missing frame, another camera."""
    video = '[[view]]\nvideo = "film.mp4"\n'
    slow = write(recorded, "slow.toml", data=video, extra="frame_rate = 25.0")
    with pytest.raises(SceneError, match="has 50"):
        prepare(read_case(slow))
    whole = prepare(read_case(write(recorded, "video.toml", data=video)))
    assert len(whole.footage[0].numbers) == 7
    assert not whole.notes
    wide = VIEW + "[view.camera]\nwidth = 64\nheight = 48\nradius = 1.1\n"
    with pytest.raises(SceneError, match=r"64 × 48 pixels, the .* of its camera, but has 48 × 48"):
        prepare(read_case(write(recorded, "wide.toml", data=wide)))
    gap = tmp_path / "gap"
    gap.mkdir()
    for path in (recorded / "film").iterdir():
        if path.name != "f002.png":
            (gap / path.name).write_bytes(path.read_bytes())
    told = prepare(read_case(write(recorded), data=gap))
    assert any("1 of 7 frames are missing and left out: 2" in note for note in told.notes)
    assert told.problem.observations[0].frames == (0, 1, 3, 4, 5)
    elsewhere = VIEW + "[view.camera]\nwidth = 48\nheight = 48\nradius = 0.35\n"
    told = prepare(read_case(write(recorded, "elsewhere.toml", data=elsewhere)))
    assert any("does not look like the scene at rest" in note for note in told.notes)
