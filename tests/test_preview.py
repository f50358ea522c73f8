"""A scene in one picture before it runs: what is said to be drawn is there."""

import matplotlib.image
import numpy as np
import pytest
from scene_files import CAMERA, GRID, JELLY, MODEL, TWO_MATERIALS, ball, planned, sphere, write

from pgjax.cli import main
from pgjax.render import save_ply
from pgjax.scenes.marks import domain, marks
from pgjax.scenes.preview import figure

SMALL = CAMERA.replace("64", "32").replace("48", "24")
FORCES = """
[forces]
gravity = [0, 0, -9.81]
"""
WALLS = """
[[boundary]]
type = "half-space"
point = [0, 0, -0.1]
normal = [0, 0, 1]
[[boundary]]
type = "box"
lower = [-0.4, -0.4, -0.15]
upper = [0.4, 0.4, 0.7]
contact = "slip"
[[boundary]]
type = "sphere"
center = [0.3, 0, 0.5]
radius = 0.1
contact = "sticky"
[[boundary]]
type = "cylinder"
from = [0, -1, 0.3]
to = [0, 1, 0.3]
radius = 0.45
inside = true
[[boundary]]
type = "capsule"
from = [-0.3, -0.1, 0.6]
to = [-0.3, 0.1, 0.6]
radius = 0.05
motion = { velocity = [1, 0, 0] }
[[boundary]]
type = "sphere"
center = [5, 0, 0]
radius = 0.1
"""
CONDITIONS = """
[[particles]]
type = "hold"
region = { lower = [-1, -1, -1], upper = [1, 1, 0.1] }
[[particles]]
type = "move"
motion = { velocity = [0, 0, 2] }
region = { lower = [-1, -1, 0.4], upper = [1, 1, 1] }
[[particles]]
type = "impulse"
momentum = [0, 3, 0]
[[particles]]
type = "wind"
velocity = [2, 0, 0]
rate = 1
"""


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """The plan of a scene with something of everything, and what is to be drawn of it."""
    folder = tmp_path_factory.mktemp("preview")
    model = MODEL + "velocity = [0, 0, 3]\nregion = { lower = [-2, -2, -2], upper = [0.3, 2, 2] }\n"
    parts = (model, GRID, FORCES, TWO_MATERIALS, WALLS, CONDITIONS, SMALL + "turn = 400\n")
    plan = planned(folder, *parts)
    return plan, {mark.label: mark for mark in marks(plan)}


def test_each_part_of_a_scene_has_its_mark(full):
    plan, found = full
    count = plan.scene.particle_count
    held, led = (int(c.mask.sum()) for c in plan.scene.particle_conditions[:2])
    assert set(found) == {
        f"not simulated, only drawn: {200 - count}",
        "boundary 1: half-space, separating",
        "boundary 2: box, slip",
        "boundary 3: sphere, sticky",
        "boundary 4: inside of a cylinder, separating",
        "boundary 5: capsule, separating",
        "boundary 6: sphere, separating, not in the grid",
        f"material 1: FixedCorotated, {plan.scene.counts[0]} particles",
        f"material 2: StVKHencky + VonMises, {plan.scene.counts[1]} particles",
        f"held: {held} particles",
        f"led: {led} particles",
        "way of what moves",
        "impulse 3 N s",
        "wind 2 m/s",
        "velocity at the start, up to 3 m/s",
        "grid, cells of 0.1 m",
        "gravity 9.81 m/s²",
        "camera",
        "way of the camera",
    }


def test_walls_are_drawn_where_they_are(full):
    plan, found = full
    floor = found["boundary 1: half-space, separating"].data
    np.testing.assert_allclose(floor[:, 2], -0.1, atol=1e-5)
    lower, upper = domain(plan)
    assert np.ptp(floor[:, 0]) > 0.9 * (upper - lower)[0]
    ball = found["boundary 3: sphere, sticky"].data - [0.3, 0, 0.5]
    np.testing.assert_allclose(np.linalg.norm(ball, axis=1), 0.1, atol=1e-5)
    assert len(ball) > 50
    box = found["boundary 2: box, slip"].data
    np.testing.assert_allclose(box.min(axis=(0, 1)), [-0.4, -0.4, -0.15], atol=1e-6)
    np.testing.assert_allclose(box.max(axis=(0, 1)), [0.4, 0.4, 0.7], atol=1e-6)
    assert len(box) == 12
    drum = found["boundary 4: inside of a cylinder, separating"].data
    round_it = np.hypot(drum[:, 0], drum[:, 2] - 0.3)
    np.testing.assert_allclose(round_it, 0.45, atol=1e-5)
    # Thinner than the lattice walls are looked for on.
    assert len(found["boundary 5: capsule, separating"].data) > 10


def test_arrows_and_ways_point_where_things_go(full):
    plan, found = full
    for label, direction in [
        ("impulse 3 N s", [0, 1, 0]),
        ("wind 2 m/s", [1, 0, 0]),
        ("gravity 9.81 m/s²", [0, 0, -1]),
        ("velocity at the start, up to 3 m/s", [0, 0, 1]),
    ]:
        change = found[label].data[:, 1] - found[label].data[:, 0]
        unit = change / np.linalg.norm(change, axis=1, keepdims=True)
        np.testing.assert_allclose(unit, np.tile(direction, (len(unit), 1)), atol=1e-6)
    seconds = plan.frames / plan.fps
    ways = [mark.data[0] for mark in marks(plan) if mark.label == "way of what moves"]
    wall, led = (way[-1] - way[0] for way in ways)
    np.testing.assert_allclose(wall, [seconds, 0, 0], atol=1e-5)
    np.testing.assert_allclose(led, [0, 0, 2 * seconds], atol=1e-5)


def test_marked_particles_are_those_of_the_condition(full):
    _, found = full
    label = next(label for label in found if label.startswith("held"))
    assert found[label].data[:, 2].max() <= 0.1
    assert found[label].marker == "x"
    first, second = (found[label] for label in found if label.startswith("material"))
    assert first.colour != second.colour
    assert first.data[:, 2].max() <= 0.25 <= second.data[:, 2].min()


def test_the_camera_looks_from_where_the_frames_are_drawn(full):
    plan, found = full
    eye = np.asarray(plan.camera(0).position)
    lines = found["camera"].data
    np.testing.assert_allclose(lines[:, 0], np.tile(eye, (4, 1)), atol=1e-5)
    # The middle of the rim lies on the way to the target.
    corners = lines[:, 1].mean(axis=0) - eye
    target = np.array([0, 0, 0.2]) - eye
    cosine = corners @ target / np.linalg.norm(corners) / np.linalg.norm(target)
    assert cosine > 1 - 1e-6
    np.testing.assert_allclose(found["way of the camera"].data[0, 0], eye, atol=1e-5)


def test_the_figure_has_four_views_a_picture_and_a_legend(full):
    plan, found = full
    made = figure(plan)
    titles = [axes.get_title() for axes in made.axes]
    assert titles == [
        f"{plan.name}: the first frame",
        "front (from -y)",
        "side (from +x)",
        "top (from +z)",
        "with the camera",
    ]
    (picture,) = made.axes[0].get_images()
    assert picture.get_array().shape == (24, 32, 3)
    (legend,) = made.legends
    assert {text.get_text() for text in legend.get_texts()} == set(found)
    inside = {label for label, mark in found.items() if not mark.outside}
    for axes, expected in zip(made.axes[1:], (inside, inside, set(found), set(found)), strict=True):
        artists = [*axes.collections, *axes.lines]
        assert {artist.get_label() for artist in artists} >= expected


def test_the_command_writes_a_picture_of_a_scene_in_one_of_its_qualities(tmp_path, capsys):
    save_ply(tmp_path / "other.ply", ball(seed=5))
    quality = "[quality.fine]\ngrid.spacing = 0.05\n"
    path = write(tmp_path, MODEL, GRID, JELLY, SMALL, quality)
    out = tmp_path / "picture.png"
    arguments = ["preview", str(path), "--ply", str(tmp_path / "other.ply"), "--out", str(out)]
    assert main([*arguments, "--quality", "fine"]) == 0
    said = capsys.readouterr().out
    assert "cells of 0.05 m" in said
    assert f"wrote      {out}" in said
    pixels = matplotlib.image.imread(out)
    assert pixels.shape[0] > 500
    assert pixels.shape[1] > 1000
    assert pixels[..., :3].std() > 0.05
    assert [p.name for p in tmp_path.glob("*.png")] == ["picture.png"]


def test_what_cannot_be_drawn_is_said(tmp_path, capsys):
    path = write(tmp_path, MODEL, GRID, JELLY)
    assert main(["preview", str(path), "--out", str(tmp_path / "a.jpg")]) == 1
    assert "must end with .png" in capsys.readouterr().err
    assert main(["preview", str(path), "--out", str(tmp_path / "a.png")]) == 1
    assert "`ply` must name a file" in capsys.readouterr().err
    assert main(["preview", "fikus"]) == 1
    assert "There is no preset `fikus`" in capsys.readouterr().err


def test_surroundings_and_releases_are_drawn(tmp_path):
    pytest.importorskip("igl")
    save_ply(tmp_path / "ball.ply", sphere(600))
    model = MODEL + "region = { lower = [-2, -2, -2], upper = [2, 0.5, 2] }\n"
    more = """
[[boundary]]
type = "surroundings"
[[particles]]
type = "release"
direction = [0, 0, 1]
end = 0.1
"""
    found = {mark.label: mark for mark in marks(planned(tmp_path, model, GRID, JELLY, more))}
    wall = found["boundary 1: sampled surface, separating"].data
    # The part of the sphere that does not move lies below the rest.
    assert len(wall) > 50
    assert wall[:, 2].mean() < 0.05
    count = next(label for label in found if "released one after the other" in label)
    assert count.endswith("particles")
