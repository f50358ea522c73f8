"""The conditions of the grid in a configuration file, as walls."""

from typing import Any

from pgjax.scenes.physgaussian.common import (
    END,
    START,
    Make,
    Pieces,
    Setting,
    Times,
    box_of,
    flag,
    times_of,
)
from pgjax.scenes.reader import Table

# After a cuboid with `reset` ends, the whole grid stays at rest for so many steps.
_REST_STEPS = 15


def bounding_box(t: Table) -> Make:
    """Six walls that the material may leave, three nodes inside the grid."""
    timed = t.has(START) or t.has(END)
    times = times_of(t)

    def make(here: Setting) -> Pieces:
        """Walls behind which the three outer nodes on each side are, whatever the rounding."""
        dx = here.domain / here.n_grid
        low, high = 2.25 * dx, (here.n_grid - 3.25) * dx
        always = times.start <= 0 and times.end >= here.duration
        if here.legacy or always:
            notes = ["acts always, its times are ignored"] if timed and not always else []
            return Pieces([{"type": "box", "lower": 3 * [low], "upper": 3 * [high]}], [], [], notes)
        walls = []
        for axis, (place, side) in ((a, b) for a in range(3) for b in ((low, 1.0), (high, -1.0))):
            point, normal = 3 * [here.domain / 2], 3 * [0.0]
            point[axis], normal[axis] = place, side
            wall = {"type": "half-space", "point": point, "normal": normal}
            walls.append(wall | times.window())
        return Pieces(walls, [], [], ["acts in its times only (the reference ignores them)"])

    return make


def cuboid(t: Table) -> Make:
    """A box of nodes with one velocity, which moves with it."""
    box, velocity = box_of(t), t.vector("velocity")
    times = times_of(t)
    reset = flag(t, "reset")

    def make(here: Setting) -> Pieces:
        """The cuboid, and around its times the whole grid at rest."""
        wall: dict[str, Any] = {"center": list(box.point), "half_size": list(box.size)}
        if any(velocity):
            wall = {"type": "velocity", **wall, "velocity": list(velocity)}
        else:
            wall = {"type": "cuboid", **wall, "contact": "sticky"}
        made = Pieces([wall | times.window()], [], [], [])
        if reset:
            _add_rests(made, here, times)
        return made

    return make


def _add_rests(made: Pieces, here: Setting, times: Times) -> None:
    """The whole grid at rest after the end of a cuboid, and, as a defect, before its start."""
    if times.start > 0:
        was = "until then" if here.legacy else "only after its end (the reference: also before)"
        made.notes.append(f"reset: the whole grid is at rest {was}, start_time = {times.start:g} s")
        if here.legacy:
            made.walls.append(_everything(here) | {"end": times.start})
    if times.end < here.duration:
        made.notes.append(f"reset: the whole grid is at rest for {_REST_STEPS} steps after its end")
        until = times.end + _REST_STEPS * here.substep_dt
        made.walls.append(_everything(here) | {"start": times.end, "end": until})


def _everything(here: Setting) -> dict[str, Any]:
    return {
        "type": "cuboid",
        "center": 3 * [here.domain / 2],
        "half_size": 3 * [here.domain],
        "contact": "sticky",
    }


def surface_collider(t: Table) -> Make:
    """The nodes behind a plane."""
    point, normal = t.vector("point"), t.vector("normal")
    if not any(normal):
        raise t.error("normal", "not be zero")
    surface = t.choice("surface", {name: name for name in _SURFACES})
    friction, times = t.number("friction", 0.0, at_least=0), times_of(t)

    def make(here: Setting) -> Pieces:
        """The half-space with the contact that was asked for."""
        contact, notes = _SURFACES[surface], []
        if surface == "cut":
            notes.append("cut: its slit between z = 0.4 and 0.53 is not honoured; sticky all over")
        elif contact != "sticky" and here.legacy:
            contact = "sticky"
            notes.append(f"{surface}: kept sticky without friction, as the reference computes it")
        elif contact != "sticky":
            if contact == "slip" and friction:
                contact = "separating"
                notes.append("slip: became separating, since only that has friction")
            notes.append(f"{surface}: is {contact} (in the reference every surface is sticky)")
        wall = {"type": "half-space", "point": list(point), "normal": list(normal)}
        wall["contact"] = contact
        if contact == "separating":
            wall["friction"] = friction
        return Pieces([wall | times.window()], [], [], notes)

    return make


_SURFACES = {
    "sticky": "sticky",
    "slip": "slip",
    "separate": "separating",
    "separating": "separating",
    "frictional": "separating",
    "cut": "sticky",
}
