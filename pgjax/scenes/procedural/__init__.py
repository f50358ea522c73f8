"""Scenes made by a program instead of a camera: Gaussians that are also particles of a solid.

Every body is filled throughout its volume, so that its Gaussians can be simulated as they are.
Lengths are in metres and z points up.
"""

from collections.abc import Callable

from pgjax.render.gaussians import Gaussians
from pgjax.scenes.procedural.animals import fox, wolf
from pgjax.scenes.procedural.ficus import ficus
from pgjax.scenes.procedural.food import bread, cake, jam, toast
from pgjax.scenes.procedural.metal import can, plane
from pgjax.scenes.procedural.rooms import ruins, sofa_suite
from pgjax.scenes.procedural.things import materials, microphone, vasedeck

MODELS: dict[str, Callable[[int, float], Gaussians]] = {
    "ficus": ficus,
    "bread": bread,
    "toast": toast,
    "jam": jam,
    "cake": cake,
    "can": can,
    "fox": fox,
    "plane": plane,
    "wolf": wolf,
    "ruins": ruins,
    "vasedeck": vasedeck,
    "materials": materials,
    "microphone": microphone,
    "sofa-suite": sofa_suite,
}
"""The models by name: functions of a seed and of the detail, 2 for Gaussians half as far apart."""
