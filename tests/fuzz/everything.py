"""A scene file with a bit of everything, and the files that go with it."""

import json

import numpy as np
from scene_files import ball

from pgjax.render import save_ply

SCENE = """
name = "all"
[[model]]
name = "one"
ply = "ball.ply"
up = [0, -1, 0]
opacity_above = 0.1
size = 0.5
position = [0, 0, 0.1]
rotation = [{ axis = [0, 0, 1], angle = 30 }]
velocity = [0, 0, -1]
angular_velocity = [0, 0, 10]
split_longer_than = 2.0
surroundings = true
region = { shape = "sphere", center = [0, 0, 0], radius = 0.35 }
[grid]
lower = [-0.8, -0.8, -0.5]
upper = [0.8, 0.8, 1.2]
spacing = 0.1
periodic = [false, false, false]
spline = "quadratic"
scheme = "mls"
[time]
frames = 3
fps = 25
fraction = 0.4
[forces]
gravity = [0, 0, -9.81]
grid_damping = 0.1
shear_damping = 0.0
[[material]]
law = "stvk-hencky"
E = 2e4
nu = 0.3
density = 500
damping_viscosity = 1.0
region = { lower = [-1, -1, -1], upper = [1, 1, 0.25] }
model = "one"
[material.plasticity]
type = "drucker-prager"
friction_angle = 30
cohesion = 1.0
volume_correction = true
[[material]]
law = "fixed-corotated"
E = { file = "values.npy" }
nu = 0.3
density = 1000
model = "one"
active = { direction = [0, 0, 1], activation = 10.0, frequency = 2.0, phase = 20 }
[[boundary]]
type = "half-space"
point = [0, 0, -0.05]
normal = [0, 0, 1]
contact = "separating"
friction = 0.3
[[boundary]]
type = "capsule"
from = [0, 0, 0]
to = [0, 0, 1]
radius = 0.1
inside = false
surface_velocity = [0, 0, 0]
[boundary.motion]
pivot = [0, 0, 0]
keyframes = [{ time = 0 }, { time = 1, shift = [0, 0, 1], turn = [0, 0, 90] }]
[[boundary]]
type = "cuboid"
center = [0, 0, -0.3]
half_size = [0.1, 0.1, 0.1]
rotation = 20
motion = { velocity = [0, 0, 1], angular_velocity = [0, 0, 1] }
start = 0.1
end = 0.2
[[boundary]]
type = "surroundings"
contact = "sticky"
radius = 0.2
spacing = 0.1
thickness = 0.05
[[particles]]
type = "wind"
velocity = [1, 0, 0]
rate = 1.0
quadratic = 0.1
[[particles]]
type = "release"
direction = [0, 0, 1]
layers = 3
end = 1.0
region = { shape = "labels", file = "labels.npy", values = [1] }
model = "one"
[[particles]]
type = "move"
motion = { velocity = [0, 0, 1] }
start = 1.0
region = { shape = "cylinder", start = [0, 0, 0], end = [0, 0, 1], radius = 1 }
[[particles]]
type = "impulse"
momentum = [0, 0, 1]
duration = 0.1
region = { shape = "half-space", point = [0, 0, 0], normal = [0, 0, 1] }
[camera]
width = 64
height = 48
fov = 30
background = [1, 1, 1]
max_stretch = 3
[[camera.keyframes]]
time = 0
azimuth = 0
elevation = 10
radius = 3
[[camera.keyframes]]
time = 1
target = [0, 0, 0.2]
fov = 20
"""


def write_files(folder):
    """The capture, its values, labels and cameras."""
    save_ply(folder / "ball.ply", ball())
    np.save(folder / "values.npy", np.ones(200))
    np.save(folder / "labels.npy", np.arange(200) % 3)
    camera = {
        "img_name": "a",
        "width": 64,
        "height": 48,
        "position": [0, 0, -3],
        "rotation": np.eye(3).tolist(),
        "fx": 50,
        "fy": 50,
    }
    (folder / "cameras.json").write_text(json.dumps([camera, camera | {"img_name": "b"}]))
