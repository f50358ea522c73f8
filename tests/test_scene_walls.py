"""Walls of scene files and what acts on their particles, against what Python would make."""

import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scene_files import GRID, JELLY, MODEL, planned, write

from pgjax import simulate
from pgjax.boundary import (
    Box,
    Capsule,
    Collider,
    Complement,
    Cuboid,
    Cylinder,
    HalfSpace,
    KeyFrames,
    Offset,
    ParticleForce,
    ParticleImpulse,
    ParticleMotion,
    Separating,
    Slip,
    Sphere,
    Steady,
    Sticky,
    Wind,
    release_times,
)
from pgjax.render import Gaussians, save_ply
from pgjax.scenes import SceneError, read_scene
from pgjax.scenes.walls import Site

DEGREE = np.pi / 180
PLANE = HalfSpace((0.0, 0, -0.1), (0.0, 0, 1))
BALL = Sphere((0.0, 0, -0.1), 0.2)
WALLS = {
    'type = "box"\nlower = [-1, -1, -1]\nupper = [1, 1, 1]': Box((-1.0, -1, -1), (1.0, 1, 1)),
    'type = "box"\nlower = [-1, -1, -1]\nupper = [1, 1, 1]\ncontact = "slip"': Box(
        (-1.0, -1, -1), (1.0, 1, 1), Slip()
    ),
    'type = "half-space"\npoint = [0, 0, -0.1]\nnormal = [0, 0, 1]': Collider(PLANE),
    'type = "half-space"\npoint = [0, 0, -0.1]\nnormal = [0, 0, 1]\ngap = 0.6': Collider(
        Offset(PLANE, -0.06)
    ),
    'type = "half-space"\npoint = [0, 0, -0.1]\nnormal = [0, 0, 1]\nfriction = 0.4': Collider(
        PLANE, Separating(0.4)
    ),
    'type = "half-space"\npoint = [0, 0, -0.1]\nnormal = [0, 0, 1]\ncontact = "sticky"\n'
    "start = 0.5\nend = 2": Collider(PLANE, Sticky(), start=0.5, end=2.0),
    'type = "half-space"\npoint = [0, 0, -0.1]\nnormal = [0, 0, 1]\n'
    "surface_velocity = [1, 0, 0]": Collider(PLANE, surface_velocity=(1.0, 0, 0)),
    'type = "sphere"\ncenter = [0, 0, -0.1]\nradius = 0.2': Collider(BALL),
    'type = "sphere"\ncenter = [0, 0, -0.1]\nradius = 0.2\ninside = true': Collider(
        Complement(BALL)
    ),
    'type = "sphere"\ncenter = [0, 0, -0.1]\nradius = 0.2\ninside = true\ngap = 1': Collider(
        Offset(Complement(BALL), -0.1)
    ),
    'type = "cuboid"\ncenter = [0, 0, 0]\nhalf_size = [1, 2, 3]': Collider(
        Cuboid((0.0, 0, 0), (1.0, 2, 3))
    ),
    'type = "cuboid"\ncenter = [0, 0, 0]\nhalf_size = [1, 2, 3]\nrotation = 30': Collider(
        Cuboid((0.0, 0, 0), (1.0, 2, 3), (0.0, 0, 30 * DEGREE))
    ),
    'type = "cuboid"\ncenter = [0, 0, 0]\nhalf_size = [1, 2, 3]\n'
    "rotation = [{ axis = [3, 0, 0], angle = 30 }]": Collider(
        Cuboid((0.0, 0, 0), (1.0, 2, 3), (30 * DEGREE, 0.0, 0))
    ),
    'type = "cylinder"\nfrom = [0, 0, 0]\nto = [0, 1, 0]\nradius = 0.2\ninside = true': Collider(
        Complement(Cylinder((0.0, 0, 0), (0.0, 1, 0), 0.2))
    ),
    'type = "capsule"\nfrom = [0, 0, 0]\nto = [0, 1, 0]\nradius = 0.2': Collider(
        Capsule((0.0, 0, 0), (0.0, 1, 0), 0.2)
    ),
    'type = "velocity"\ncenter = [0, 0, 0]\nhalf_size = [1, 2, 3]\nvelocity = [1, 0, 0]\n'
    "start = 0.5\nend = 1": Collider(
        Cuboid((0.0, 0, 0), (1.0, 2, 3)),
        Sticky(),
        Steady((1.0, 0, 0), start=0.5),
        start=0.5,
        end=1.0,
    ),
}
MOTIONS = {
    "motion = { velocity = [0.1, 0, 0] }": Steady((0.1, 0, 0), (0.0, 0, 0), (0.0, 0, -0.1)),
    "motion = { angular_velocity = [0, 0, 90], pivot = [1, 0, 0], start = 1, end = 2 }": Steady(
        (0.0, 0, 0), (0.0, 0, np.pi / 2), (1.0, 0, 0), 1.0, 2.0
    ),
    "motion = { keyframes = [{ time = 0 }, { time = 1, shift = [0, 0, 0.2] }, "
    "{ time = 3, turn = [0, 0, 180] }] }": KeyFrames(
        (0.0, 1, 3),
        ((0.0, 0, 0), (0.0, 0, 0.2), (0.0, 0, 0.2)),
        ((0.0, 0, 0), (0.0, 0, 0), (0.0, 0, np.pi)),
        (0.0, 0, -0.1),
    ),
}


def wall(folder, text):
    (part,) = read_scene(write(folder, MODEL, GRID, JELLY, f"[[boundary]]\n{text}")).boundaries
    return part.make(Site(0.1, np.full(3, -1.0), np.ones(3), np.zeros((0, 3))))


@pytest.mark.parametrize("text", WALLS)
def test_walls(tmp_path, text):
    assert eqx.tree_equal(wall(tmp_path, text), WALLS[text], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("text", MOTIONS)
def test_motions_of_walls(tmp_path, text):
    """They turn about the centre of the wall unless a pivot is given."""
    found = wall(tmp_path, 'type = "sphere"\ncenter = [0, 0, -0.1]\nradius = 0.2\n' + text)
    expected = Collider(BALL, motion=MOTIONS[text])
    assert eqx.tree_equal(found, expected, rtol=1e-12, atol=1e-15)


def test_key_frames_as_tables(tmp_path):
    text = (
        'type = "sphere"\ncenter = [0, 0, -0.1]\nradius = 0.2\n'
        "[[boundary.motion.keyframes]]\ntime = 0\n[[boundary.motion.keyframes]]\ntime = 1\n"
    )
    still = KeyFrames((0.0, 1), np.zeros((2, 3)), None, (0.0, 0, -0.1))
    assert eqx.tree_equal(wall(tmp_path, text), Collider(BALL, motion=still))


CUBE = "".join(
    f"v {x} {y} {z}\n" for x in (-500, 500) for y in (-500, 500) for z in (-500, 500)
) + "".join(
    f"f {a} {b} {c}\nf {a} {c} {d}\n"
    for a, b, c, d in [
        (1, 2, 4, 3),
        (5, 7, 8, 6),
        (1, 5, 6, 2),
        (3, 4, 8, 7),
        (1, 3, 7, 5),
        (2, 6, 8, 4),
    ]
)


def test_a_mesh(tmp_path):
    (tmp_path / "cube.obj").write_text(CUBE)
    text = (
        'type = "mesh"\nfile = "cube.obj"\nscale = 1e-3\nposition = [0.2, 0, 0]\nspacing = 0.1\n'
        "motion = { angular_velocity = [0, 0, 90] }"
    )
    found = wall(tmp_path, text)
    for x, distance in [((0.2, 0, 0), -0.5), ((0.9, 0, 0), 0.2), ((0.2, 0, 0.4), -0.1)]:
        np.testing.assert_allclose(found.shape.signed_distance(jnp.asarray(x)), distance, atol=0.03)
    np.testing.assert_allclose(found.motion.pivot, [0.2, 0, 0], atol=1e-6)
    (tmp_path / "cube.obj").write_text("v 0 0 0\n")
    with pytest.raises(SceneError, match=r"\[\[boundary\]\] 1: The file .*cube\.obj"):
        planned(tmp_path, MODEL, GRID, JELLY, '[[boundary]]\ntype = "mesh"\nfile = "cube.obj"')


def test_a_mesh_can_be_turned(tmp_path):
    """About the origin of its file, once it has its size, and before it is put in its place."""
    vertices = [line.split() for line in CUBE.splitlines() if line.startswith("v")]
    faces = [line for line in CUBE.splitlines() if line.startswith("f")]
    # A bar of 2 m along x, from the origin on.
    bar = [f"v {2 * (int(x) + 500)} {y} {z}" for _, x, y, z in vertices]
    (tmp_path / "bar.obj").write_text("\n".join(bar + faces) + "\n")
    text = (
        'type = "mesh"\nfile = "bar.obj"\nscale = 1e-3\nposition = [0.2, 0, 0]\nspacing = 0.1\n'
        "rotation = [{ axis = [0, 0, 1], angle = 90 }, { axis = [1, 0, 0], angle = 90 }]\n"
        "motion = { angular_velocity = [0, 0, 90] }"
    )
    found = wall(tmp_path, text)
    # x became y, and then z.
    for x, distance in [((0.2, 0, 1), -0.5), ((0.2, 0, 2.2), 0.2), ((0.9, 0, 1), 0.2)]:
        np.testing.assert_allclose(found.shape.signed_distance(jnp.asarray(x)), distance, atol=0.03)
    np.testing.assert_allclose(found.motion.pivot, [0.2, 0, 1], atol=1e-6)


UPPER = '\nregion = { shape = "half-space", point = [0, 0, 0.25], normal = [0, 0, 1] }'
LEAD = {
    'type = "hold"': lambda m, _: ParticleMotion(m, Steady((0.0, 0, 0)), -np.inf, np.inf),
    'type = "hold"\nend = 0.5': lambda m, _: ParticleMotion(m, Steady((0.0, 0, 0)), -np.inf, 0.5),
    'type = "velocity"\nvelocity = [1, 0, 0]\nstart = 0\nend = 2': lambda m, _: ParticleMotion(
        m, Steady((1.0, 0, 0)), 0.0, 2.0
    ),
    'type = "move"\nmotion = { angular_velocity = [0, 0, 90] }\nstart = 1': (
        lambda m, x: ParticleMotion(
            m, Steady((0.0, 0, 0), (0.0, 0, np.pi / 2), x[m].mean(axis=0)), 1.0, np.inf
        )
    ),
    'type = "impulse"\nmomentum = [1, 0, 0]': lambda m, _: ParticleImpulse(m, (1.0, 0, 0)),
    'type = "impulse"\nmomentum = [1, 0, 0]\nstart = 1\nduration = 0.5': (
        lambda m, _: ParticleImpulse(m, (1.0, 0, 0), 1.0, 0.5)
    ),
    'type = "force"\nforce = [1, 0, 0]\nend = 3': (
        lambda m, _: ParticleForce(m, (1.0, 0, 0), -np.inf, 3.0)
    ),
    'type = "wind"\nvelocity = [5, 0, 0]\nrate = 2\nquadratic = 0.1\nstart = 1': (
        lambda m, _: Wind((5.0, 0, 0), 2.0, 0.1, m, start=1.0)
    ),
    'type = "release"\ndirection = [1, 0, 0]\nend = 2\nlayers = 4': lambda m, x: ParticleMotion(
        m,
        Steady((0.0, 0, 0)),
        -np.inf,
        np.where(m, _released(m, x, start=0.0, end=2.0, layers=4), np.inf),
    ),
    'type = "release"\ndirection = [1, 0, 0]\nstart = 1\nend = 2': lambda m, x: ParticleMotion(
        m,
        Steady((0.0, 0, 0)),
        -np.inf,
        np.where(m, _released(m, x, start=1.0, end=2.0, layers=None), np.inf),
    ),
}


def _released(mask, x, **times):
    ends = np.zeros(len(mask))
    ends[mask] = release_times(x[mask], (1.0, 0, 0), **times)
    return ends


@pytest.mark.parametrize("region", [UPPER, ""], ids=["upper", "all"])
@pytest.mark.parametrize("text", LEAD)
def test_particles(tmp_path, text, region):
    p = planned(tmp_path, MODEL, GRID, JELLY, f"[[particles]]\n{text}{region}")
    x = np.asarray(p.state.x)
    mask = x[:, 2] >= 0.25 if region else np.ones(len(x), bool)
    (found,) = p.scene.particle_conditions
    expected = LEAD[text](mask, x)
    assert eqx.tree_equal(found, expected, rtol=1e-6, atol=1e-9)


def test_a_scene_with_walls_and_conditions_runs(tmp_path):
    """A ball is held above, released below, in a bowl that shakes, with wind from the side."""
    p = planned(
        tmp_path,
        MODEL,
        GRID,
        JELLY,
        f'[[particles]]\ntype = "release"\ndirection = [0, 0, 1]\nend = 0.02{UPPER}',
        '[[particles]]\ntype = "wind"\nvelocity = [3, 0, 0]\nrate = 5',
        '[[boundary]]\ntype = "sphere"\ncenter = [0, 0, 0.3]\nradius = 0.32\ninside = true',
        "motion = { keyframes = [{ time = 0 }, { time = 1, shift = [0.1, 0, 0] }] }",
        "[forces]\ngravity = [0, 0, -9.81]",
    )
    moved = simulate(p.scene, p.state, dt=p.dt, frames=2, substeps=p.substeps).final
    assert bool(moved.status.ok)
    assert float(np.asarray(moved.x - p.state.x)[:, 0].mean()) > 0.005


def test_every_condition_of_particles_runs(tmp_path):
    """All at once, windows open as they are by default: no NaN, and the first leads."""
    conditions = [f"[[particles]]\n{text}" for text in LEAD if not text.endswith("end = 0.5")]
    lead = '[[particles]]\ntype = "velocity"\nvelocity = [0.5, 0, 0]'
    p = planned(tmp_path, MODEL, GRID, JELLY, lead, *conditions)
    moved = simulate(p.scene, p.state, dt=p.dt, frames=1, substeps=4).final
    assert bool(moved.status.ok)
    way = np.asarray(moved.x - p.state.x)
    # Single precision resolves positions of half a metre to 6e-8.
    np.testing.assert_allclose(way, np.tile([2.0 * p.dt, 0, 0], (len(way), 1)), atol=5e-7)


FAULTS = [
    ('type = "bowl"', "be one of box, half-space, cuboid, sphere, cylinder, capsule, mesh, sur"),
    ('type = "spere"', "did you mean `sphere`?"),
    ('type = "sphere"\ncenter = [0, 0, 0]', "`radius` is missing"),
    ('type = "sphere"\ncenter = [0, 0, 0]\nradius = 0', "`radius` must be a finite number above"),
    (
        'type = "sphere"\ncenter = [0, 0, 0]\nradius = 1\nhalf_size = [1, 1, 1]',
        '`half_size` is not a known key with type = "sphere"; allowed are type, center, radius, '
        "contact, friction, inside, motion, surface_velocity, start, end",
    ),
    (
        'type = "box"\nlower = [0, 0, 0]\nupper = [1, 1, 1]\nmotion = {}',
        '`motion` is not a known key with type = "box"',
    ),
    ('type = "box"\nlower = [0, 0, 0]\nupper = [1, 0, 1]', "`upper` must be above `lower`"),
    ('type = "cuboid"\ncenter = [0, 0, 0]\nhalf_size = [1, 0, 1]', "each a finite number above 0"),
    ('type = "capsule"\nfrom = [0, 0, 0]\nto = [0, 0, 0]\nradius = 1', "`to` must differ from"),
    ('type = "cylinder"\nstart = [0, 0, 0]\nend = [0, 0, 1]\nradius = 1', "`from` is missing"),
    ('type = "half-space"\npoint = [0, 0, 0]\nnormal = [0, 0, 0]', "`normal` must not be zero"),
    (
        'type = "half-space"\npoint = [0, 0, 0]\nnormal = [0, 0, 1]\nstart = 2\nend = 1',
        "`end` must be after `start` = 2 s",
    ),
    (
        'type = "half-space"\npoint = [0, 0, 0]\nnormal = [0, 0, 1]\ncontact = "stick"',
        "be one of sticky, slip, separating (did you mean `sticky`?)",
    ),
    (
        'type = "half-space"\npoint = [0, 0, 0]\nnormal = [0, 0, 1]\ncontact = "slip"\n'
        "friction = 1",
        "`friction` must be left out unless `contact` is separating",
    ),
    (
        'type = "half-space"\npoint = [0, 0, 0]\nnormal = [0, 0, 1]\ngap = -1',
        "`gap` must be a finite number at least 0",
    ),
    (
        'type = "half-space"\npoint = [0, 0, 0]\nnormal = [0, 0, 1]\nfriction = -1',
        "`friction` must be a finite number at least 0",
    ),
    ('type = "mesh"\nfile = "bowl.obj"', "`file` must name a file, but there is no"),
    (
        'type = "sphere"\ncenter = [0, 0, 0]\nradius = 1\nmotion = { velocty = [0, 0, 1] }',
        "[motion]: `velocty` is not a known key (did you mean `velocity`?)",
    ),
    (
        'type = "sphere"\ncenter = [0, 0, 0]\nradius = 1\n'
        "motion = { keyframes = [{ time = 0 }], velocity = [0, 0, 1] }",
        "[motion]: `keyframes` must hold at least two key frames",
    ),
    (
        'type = "sphere"\ncenter = [0, 0, 0]\nradius = 1\n'
        "motion = { keyframes = [{ time = 0 }, { time = 1 }], velocity = [0, 0, 1] }",
        "[motion]: `velocity` is not a known key; allowed are pivot, keyframes",
    ),
    (
        'type = "sphere"\ncenter = [0, 0, 0]\nradius = 1\n'
        "motion = { keyframes = [{ time = 1 }, { time = 1 }] }",
        "[[keyframes]] 2: `time` must be after that of the key frame before, 1 s",
    ),
    (
        'type = "sphere"\ncenter = [0, 0, 0]\nradius = 1\n'
        "motion = { keyframes = [{ time = 1 }, { time = 2, shft = [0, 0, 1] }] }",
        "[[keyframes]] 2: `shft` is not a known key (did you mean `shift`?)",
    ),
    (
        'type = "sphere"\ncenter = [0, 0, 0]\nradius = 1\nmotion = { start = 1, end = 0 }',
        "`end` must be after `start` = 1 s",
    ),
]


@pytest.mark.parametrize(("lines", "words"), FAULTS)
def test_mistakes_in_walls(tmp_path, lines, words):
    with pytest.raises(SceneError, match=re.escape(words)) as error:
        read_scene(write(tmp_path, MODEL, GRID, JELLY, f"[[boundary]]\n{lines}"))
    assert str(error.value).startswith("scene.toml [[boundary]] 1")


WRONG = [
    ('type = "holds"', "be one of hold, move, velocity, impulse, force, release, wind (did you"),
    ('type = "hold"\nend = -inf', "`end` must be a finite number"),
    ('type = "hold"\nvelocity = [0, 0, 0]', '`velocity` is not a known key with type = "hold"'),
    ('type = "move"', "`motion` is missing"),
    ('type = "impulse"\nmomentum = [1, 0, 0]\nduration = -1', "`duration` must be a finite numb"),
    ('type = "impulse"\nforce = [1, 0, 0]', "`momentum` is missing"),
    ('type = "release"\ndirection = [0, 0, 0]\nend = 1', "`direction` must not be zero"),
    ('type = "release"\ndirection = [0, 0, 1]', "`end` is missing"),
    ('type = "release"\ndirection = [0, 0, 1]\nend = 0', "`end` must be after `start` = 0 s"),
    ('type = "release"\ndirection = [0, 0, 1]\nend = 1\nlayers = 1', "whole number, at least 2"),
    ('type = "wind"\nvelocity = [0, 0, 1]', "`rate` must be positive, or `quadratic`"),
    ('type = "wind"\nvelocity = [0, 0, 1]\nrate = -1', "`rate` must be a finite number at least"),
]


@pytest.mark.parametrize(("lines", "words"), WRONG)
def test_mistakes_in_conditions(tmp_path, lines, words):
    with pytest.raises(SceneError, match=re.escape(words)) as error:
        read_scene(write(tmp_path, MODEL, GRID, JELLY, f"[[particles]]\n{lines}"))
    assert str(error.value).startswith("scene.toml [[particles]] 1: ")


def test_a_region_without_particles(tmp_path):
    text = (
        '[[particles]]\ntype = "hold"\n[[particles]]\ntype = "hold"\n'
        'region = { shape = "sphere", center = [9, 0, 0], radius = 1 }'
    )
    with pytest.raises(SceneError, match=r"\[\[particles\]\] 2: no particle is in the region"):
        planned(tmp_path, MODEL, GRID, JELLY, text)


def test_surroundings_are_a_wall(tmp_path):
    """A ball of Gaussians drops on the captured ground below it and comes to rest there."""
    rng = np.random.default_rng(6)
    ball = rng.normal(size=(300, 3))
    ball *= 0.4 * rng.random((300, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1, keepdims=True)
    ground = np.column_stack([rng.uniform(-2, 2, (6000, 2)), np.full(6000, -0.6)])
    means = np.concatenate([ball, ground])
    capture = Gaussians.from_scales(
        *(
            jnp.asarray(a)
            for a in (
                means,
                np.tile([1.0, 0, 0, 0], (len(means), 1)),
                np.full((len(means), 3), 0.03),
                np.full(len(means), 0.9),
                np.zeros((len(means), 1, 3)),
            )
        )
    )
    save_ply(tmp_path / "scene.ply", capture)
    model = """
[model]
ply = "scene.ply"
up = [0, 0, 1]
region = { shape = "sphere", center = [0, 0, 0], radius = 0.5 }
size = 0.8
"""
    grid = """
[grid]
lower = [-0.8, -0.8, -0.6]
upper = [0.8, 0.8, 1]
spacing = 0.1
[forces]
gravity = [0, 0, -9.81]
grid_damping = 8
"""
    wall = '[[boundary]]\ntype = "surroundings"\nradius = 0.15\nthickness = 0.1\nfriction = 0.5\n'
    plan = planned(tmp_path, model, grid, JELLY, wall)
    (collider,) = plan.scene.boundaries
    ground_z = float(np.median(np.asarray(plan.still.means)[:, 2]))
    # The wall reaches `thickness` above the ground, everywhere under the ball.
    for x in rng.uniform(-0.6, 0.6, (20, 2)):
        point = jnp.asarray([*x, ground_z + 0.2])
        np.testing.assert_allclose(collider.shape.signed_distance(point), 0.1, atol=0.02)
    end = simulate(plan.scene, plan.state, dt=plan.dt, frames=1, substeps=round(1.2 / plan.dt))
    lowest = float(jnp.min(end.final.x[:, 2]))
    assert abs(lowest - (ground_z + 0.1)) < 0.1
    assert float(jnp.abs(jnp.mean(end.final.v, axis=0)).max()) < 0.05
    words = "no Gaussian that does not move is in the grid .`surroundings = false` of a model"
    for bare in (model.replace("radius = 0.5", "radius = 50"), model + "surroundings = false\n"):
        with pytest.raises(SceneError, match=words):
            planned(tmp_path, bare, grid, JELLY, wall)
