"""The text of a drafted scene file: each choice with the number it was made by."""

import textwrap
from pathlib import Path

import numpy as np
import tomli_w

from pgjax.scenes.build import Plan
from pgjax.scenes.choices import NEEDLE, Choices
from pgjax.scenes.inspect import OPACITY_ABOVE, Findings
from pgjax.scenes.regions import AbstractRegion, BoxRegion, CylinderRegion

_FRAMES, _FPS, _FOV = 60, 30, 40
# A wall acts that much before its place, in spacings of the grid.
_AHEAD = 0.6

_MATERIALS = """
# Jelly. A stiffer one (E = 1e6) needs about three times as many steps.
[[material]]
law = "fixed-corotated"
E = 1e5
nu = 0.3
density = 400

# Another material: write it in place of the jelly, without the "# ". Set `max_stretch = 1.25` in
# [camera] for sand and jam: what flows far is drawn as grains.
#
# Sand:
# [[material]]
# law = "stvk-hencky"
# E = 5e5
# nu = 0.3
# density = 1600
# plasticity = { type = "drucker-prager", friction_angle = 30 }
#
# Soft metal, which stays bent:
# [[material]]
# law = "stvk-hencky"
# E = 4e5
# nu = 0.3
# density = 500
# plasticity = { type = "von-mises", yield_stress = 8e3 }
#
# Jam:
# [[material]]
# law = "dev-vol-neo-hookean"
# E = 2e5
# nu = 0.4
# density = 1000
# plasticity = { type = "herschel-bulkley", yield_stress = 500, viscosity = 300, h = 0.8 }
"""


def up_in_words(findings: Findings) -> str:
    """Which way is up, and how that is known."""
    ground = findings.ground
    if ground is None:
        return f"{_direction(findings.up)} (guessed: no ground plane found)"
    return (
        f"{_direction(findings.up)} (across a ground plane under {100 * ground.coverage:.0f} % of "
        f"the capture, with {100 * ground.above:.0f} % of the rest above it)"
    )


def ground_in_words(findings: Findings) -> str:
    """Where the ground is."""
    ground = findings.ground
    if ground is None:
        return "none found: a floor is put under the lowest Gaussian (guessed)"
    tilt = f", tilted by {ground.tilt:.3g} degrees" if findings.up.max() not in (0, 1) else ""
    return (
        f"{ground.height:.4g} along {_direction(findings.up)} (capture), a layer of "
        f"{ground.layer:.2g}{tilt}; the object begins {findings.clearance:.3g} above it"
    )


def object_in_words(findings: Findings) -> str:
    """What is simulated."""
    seen = int(np.count_nonzero(findings.opaque))
    count = int(np.count_nonzero(findings.moves))
    if findings.region is None:
        return f"all {count} Gaussians: nothing stands apart from the rest"
    pieces = f"in {findings.pieces} pieces" if findings.pieces > 1 else "in one piece"
    return (
        f"{count} of {seen} Gaussians ({100 * count / seen:.0f} %), {pieces}; the rest is drawn "
        f"and does not move"
    )


def particles_in_words(made: Plan) -> str:
    """How many particles there are, and from what."""
    notes = [note for note in made.notes if not note.startswith("needles")]
    return f"{made.scene.particle_count}" + "".join(f"; {note}" for note in notes)


def _direction(up: np.ndarray) -> str:
    """A direction by the name of an axis, or by its components."""
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        for sign, one in (("", axis), ("-", -axis)):
            if np.array_equal(up, one):
                return sign + name
    return "[" + ", ".join(f"{a:.3g}" for a in up) + "]"


def written(
    ply: str, name: str, findings: Findings, choices: Choices, made: Plan | None, seconds: float
) -> str:
    """The scene file; without the numbers of the plan while there is none."""
    return "\n".join(
        [
            *_head(ply, name, findings),
            *_model(ply, findings, choices, made),
            *_grid(choices, made),
            *_time(made, seconds),
            _MATERIALS,
            *_walls(choices),
            *_camera(choices),
        ]
    )


def _head(ply: str, name: str, findings: Findings) -> list[str]:
    seen = int(np.count_nonzero(findings.opaque))
    box = " to ".join(_list(corner) for corner in (findings.lower, findings.upper))
    return [
        f"# Drafted by `pgjax init` from {_plain(Path(ply).name)}. Each guess is explained beside",
        "# it: change what is wrong, look at it with `pgjax preview`, then `pgjax run` it.",
        "#",
        *_comment(
            f"{findings.total} Gaussians, {seen} of them above the opacity {OPACITY_ABOVE:g}, in "
            f"the box {box} (capture), without {findings.floaters} far outside."
        ),
        _assign("name", _plain(name)),
    ]


def _model(ply: str, findings: Findings, choices: Choices, made: Plan | None) -> list[str]:
    lines = ["", "[model]", _assign("ply", ply)]
    lines += [*_comment(f"Up: {up_in_words(findings)}."), f"up = {_list(findings.up)}"]
    lines += _comment(f"The object: {object_in_words(findings)}.")
    if findings.region is not None:
        lines += [
            "# Coordinates of the capture. Larger or smaller, it takes more or less with it;",
            "# a segmentation goes here as labels.",
            f"region = {_region(findings.region)}",
        ]
    lines += [
        "# Longest side, m. Captures have no units: smaller things move faster.",
        f"size = {choices.size:g}",
        *_comment(
            f"Ground: {ground_in_words(findings)}. It is z = 0 of the simulation; the third "
            f"number is the height of the foot above it."
        ),
        f"position = [0, 0, {choices.hover:g}]",
    ]
    share = 100 * choices.needles
    what = "split, so that they bend" if choices.split else "left whole"
    lines += [
        *_comment(f"{share:.1f} % of the Gaussians are longer than half a cell: {what}."),
        f"{'' if choices.split else '# '}split_longer_than = {NEEDLE:g}",
    ]
    if not choices.fill:
        lines += _comment(
            "No inside to be filled was found. A surface that is open below, where it was cut off "
            "the ground, encloses one if holes of its width are closed: `seal`, in m."
        )
        return [*lines, "# fill = { seal = 0.3 }"]
    notes = () if made is None else made.notes
    found = [note.removeprefix("filling: ") for note in notes if note.startswith("filling: ")]
    lines += _comment(f"The inside is filled with particles: {', '.join(found)}.")
    return [*lines, "fill = {}"]


def _region(region: AbstractRegion) -> str:
    if isinstance(region, BoxRegion):
        return f"{{ lower = {_list(region.lower)}, upper = {_list(region.upper)} }}"
    assert isinstance(region, CylinderRegion)
    return (
        f'{{ shape = "cylinder", start = {_list(region.start)}, end = {_list(region.end)}, '
        f"radius = {region.radius:.4g} }}"
    )


def _grid(choices: Choices, made: Plan | None) -> list[str]:
    lines = ["", "# Where it can move, m: the object, and room beside and above it.", "[grid]"]
    lines += [f"lower = {_list(choices.lower, 3)}", f"upper = {_list(choices.upper, 3)}"]
    if made is not None:
        lines += _comment(
            f"{choices.per_cell:.1f} Gaussians of the object in a cell that holds any; "
            f"{made.scene.particle_count} particles in all. Half the spacing resolves finer "
            f"motion and takes 2 (a surface) to 16 times (a solid) as long."
        )
    lines.append(f"spacing = {choices.spacing:g}")
    lines += _comment("The fastest to an error of some per cent; spline-gradient is the other one.")
    lines.append('scheme = "mls"')
    return lines


def _time(made: Plan | None, seconds: float) -> list[str]:
    lines = ["", "[time]", f"frames = {_FRAMES}", f"fps = {_FPS}"]
    if made is not None:
        lines += _comment(
            f"{made.substeps} steps of {made.dt:.3g} s in a frame, from the stiffness of the "
            f"material and the grid. All frames take about {_seconds(seconds)} on two cores."
        )
    return [*lines, "", "[forces]", "gravity = [0, 0, -9.81]"]


def _seconds(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 100 else f"{seconds / 60:.2g} minutes"


def _walls(choices: Choices) -> list[str]:
    inner = 2 * choices.spacing
    where = f"A wall acts about {_AHEAD:g} spacings before its nodes, hence the gap."
    if choices.floor > 0:
        where = f"The foot was cut off at z = {choices.floor:g}, so the floor is there. {where}"
    return [
        *_comment(f"The ground. {where}"),
        "[[boundary]]",
        'type = "half-space"',
        f"point = [0, 0, {choices.floor:.3g}]",
        "normal = [0, 0, 1]",
        f"gap = {_AHEAD:g}  # spacings of the grid",
        'contact = "separating"',
        "friction = 0.5",
        "",
        "# Walls that keep everything in the grid.",
        "[[boundary]]",
        'type = "box"',
        f"lower = {_list(choices.lower + inner, 3)}",
        f"upper = {_list(choices.upper - inner, 3)}",
        "",
        "# Held, pushed, led: [[particles]], e.g.",
        "# [[particles]]",
        '# type = "hold"',
        f"# region = {{ lower = [-9, -9, -9], upper = [9, 9, "
        f"{choices.hover + 0.1 * choices.half[2]:.3g}] }}",
    ]


def _camera(choices: Choices) -> list[str]:
    top = choices.hover + choices.half[2]
    radius = np.linalg.norm([choices.half[0], choices.half[1], top / 2])
    distance = 1.1 * radius / np.sin(np.radians(_FOV / 2))
    return [
        "",
        "# An orbit around the object, which sees its broad side; z is up.",
        "[camera]",
        f"target = [0, 0, {top / 2:.3g}]",
        f"azimuth = {choices.azimuth:g}",
        "elevation = 12",
        f"radius = {distance:.3g}",
        f"fov = {_FOV}",
        "",
    ]


def _list(values: object, digits: int = 4) -> str:
    return "[" + ", ".join(f"{float(a) + 0.0:.{digits}g}" for a in np.asarray(values)) + "]"


def _comment(text: str) -> list[str]:
    """A text as lines of comment."""
    return textwrap.wrap(
        text, 98, initial_indent="# ", subsequent_indent="# ", break_long_words=False
    )


def _assign(key: str, value: str) -> str:
    return tomli_w.dumps({key: value}).strip()


def _plain(text: str) -> str:
    """A text without what would end a comment or could not be the name of a folder."""
    kept = "".join(c if c.isprintable() and c not in '/\\:"' else "_" for c in text)
    return kept or "scene"
