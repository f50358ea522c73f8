"""The nodes of a scene's grid lie on what its material rests on."""

import numpy as np
import pytest
from scene_files import DROP, GRID, JELLY, MODEL, ball, changed, write

from pgjax import Grid
from pgjax.boundary import Box, Collider, Cuboid, HalfSpace, Offset, Sphere, Steady
from pgjax.render import save_ply
from pgjax.scenes import plan, read_scene
from pgjax.scenes.floor import on_floor
from pgjax.scenes.settings import applied, own
from pgjax.scenes.trial import tried

DOWN = (0.0, 0.0, -9.81)
UP = (0.0, 0.0, 1.0)


def grid(**changes):
    given = {"origin": (-0.5, -0.5, -0.2), "shape": (10, 10, 10), "h": 0.1}
    return Grid(**given | changes)


@pytest.mark.parametrize(
    ("wall", "gravity", "axis", "level"),
    [
        (Collider(HalfSpace((0.0, 0, -0.05), UP)), DOWN, 2, -0.05),
        (Collider(HalfSpace((0.0, 0, 0.43), (0.0, 0, -2))), (0.0, 0, 1.62), 2, 0.43),
        (Collider(Offset(HalfSpace((0.0, 0, 0), UP), -0.06)), DOWN, 2, -0.06),
        (Collider(Cuboid((0.0, 0, 0), (0.3, 0.3, 0.077))), DOWN, 2, 0.077),
        (Collider(Offset(Cuboid((0.0, 0, 0), (0.3, 0.3, 0.1)), -0.03)), DOWN, 2, 0.07),
        (Box((-0.5, -0.5, -0.13), (0.5, 0.5, 0.8)), DOWN, 2, -0.13),
        (Box((-0.5, -0.5, -0.2), (0.33, 0.5, 0.8)), (9.81, 0.0, 0.0), 0, 0.33),
    ],
)
def test_nodes_are_on_a_floor(wall, gravity, axis, level):
    """The box of the grid holds all that it held; the outermost node in the wall is at its face."""
    before = grid()
    after, note = on_floor(before, [wall], gravity)
    origin, h = np.asarray(after.origin, np.float64), float(after.h)
    cells = (level - origin[axis]) / h
    np.testing.assert_allclose(cells, round(cells), atol=1e-5)
    moved = np.asarray(before.origin, np.float64) - origin
    assert 0 < moved[axis] < h
    np.testing.assert_array_equal(np.delete(moved, axis), 0)
    assert after.shape == tuple(n + (i == axis) for i, n in enumerate(before.shape))
    assert f"{-1e3 * moved[axis]:.3g} mm along {'xyz'[axis]}" in note
    assert on_floor(after, [wall], gravity) == (after, None)


@pytest.mark.parametrize(
    ("wall", "gravity", "changes"),
    [
        (Collider(HalfSpace((0.0, 0, -0.1), UP)), DOWN, {}),
        (Collider(HalfSpace((0.0, 0, -0.097), UP)), DOWN, {}),
        (Collider(HalfSpace((0.0, 0, -0.05), UP)), (0.0, 0, 0), {}),
        (Collider(HalfSpace((0.0, 0, -0.05), UP)), (1.0, 0, -9.81), {}),
        (Collider(HalfSpace((0.0, 0, -0.05), UP)), DOWN, {"periodic": (False, False, True)}),
        (Collider(HalfSpace((0.0, 0, -0.05), (0.0, 0, -1))), DOWN, {}),
        (Collider(HalfSpace((0.0, 0, -0.05), (0.1, 0, 1))), DOWN, {}),
        (Collider(HalfSpace((0.0, 0, -0.05), UP), motion=Steady((0.0, 0, 1))), DOWN, {}),
        (Collider(Cuboid((0.0, 0, 0), (0.3, 0.3, 0.15), (0.1, 0, 0))), DOWN, {}),
        (Collider(Sphere((0.0, 0, -0.05), 0.2)), DOWN, {}),
        (Collider(HalfSpace((0.0, 0, -0.85), UP)), DOWN, {}),
    ],
)
def test_a_grid_without_a_floor_between_its_nodes_stays(wall, gravity, changes):
    before = grid(**changes)
    assert on_floor(before, [wall], gravity) == (before, None)


def test_the_first_floor_counts():
    walls = [
        Collider(HalfSpace((0.0, 0, 0), (1.0, 0, 0))),
        Collider(HalfSpace((0.0, 0, -0.05), UP)),
        Box((-0.5, -0.5, -0.18), (0.5, 0.5, 0.8)),
    ]
    _, note = on_floor(grid(), walls, DOWN)
    assert note == "grid moved by -50 mm along z: its nodes are on boundary 2"


def test_a_plan_says_that_its_grid_was_moved(tmp_path):
    save_ply(tmp_path / "ball.ply", ball())
    wall = '[[boundary]]\ntype = "half-space"\npoint = [0, 0, -0.05]\nnormal = [0, 0, 1]\n'
    gravity = "[forces]\ngravity = [0, 0, -9.81]\n"
    made = plan(read_scene(write(tmp_path, MODEL, GRID, gravity, JELLY, wall)))
    assert "grid moved by -50 mm along z: its nodes are on boundary 1" in made.notes
    np.testing.assert_allclose(made.scene.grid.origin[2], -0.25, atol=1e-6)


def test_what_lands_does_so_at_the_same_height_on_every_grid(tmp_path):
    """A ball is dropped on a floor with a gap: the height of its centre, 0.2 s later.

    It was 0.3 mm apart where nodes are on the floor; 10 mm with the grid as it is in the file,
    8 mm without a gap.
    """
    save_ply(tmp_path / "drop.ply", ball(600))
    path = tmp_path / "drop.toml"
    text = changed(DROP, ("point = [0, 0, -0.1]", "point = [0, 0, -0.05]\ngap = 0.6"))
    path.write_text(changed(text, ("frames = 3", "frames = 5")))
    file = read_scene(path)
    base = own(file)
    heights = []
    for spacing in (0.0661, 0.05):
        setting = type(base)(spacing, 0.5, base.spline, base.scheme, base.fraction)
        x = tried(plan(applied(file, setting)), setting, "landing", False).x
        heights.append(x[-1, :, 2].mean())
    assert abs(heights[0] - heights[1]) < 2e-3
