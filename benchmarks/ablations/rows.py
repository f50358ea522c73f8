"""The rows: what a scene does not need, left out and not left out.

Each row is a function of the number of rounds that returns a dict with `what` (the saving),
`scene`, `test` (where equality is tested), `bound` (of the change, 0 for rounding), and what
`compare` measured.
"""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from scipy.spatial import cKDTree

import pgjax
from benchmarks.ablations import bodies, laws
from benchmarks.ablations.measure import Program, change, compare, rollout
from pgjax import boundary, models
from pgjax.models import reference

Row = dict[str, Any]
Setup = tuple[pgjax.Scene, pgjax.State]

# `pgjax.step` is the function of that name.
_STEP = sys.modules["pgjax.step"]
_SECONDS = 0.3


def _row(
    what: str, where: str, test: str, bound: float, without: Setup, saving: Setup, rounds: int
) -> Row:
    """A saving that leaves particles, steps and all else as they are."""
    dt = pgjax.stable_dt(*saving)
    programs = [rollout(*setup, seconds=_SECONDS, dt=dt) for setup in (without, saving)]
    return _finished(what, where, test, bound, saving[1], programs, rounds)


def _finished(
    what: str,
    where: str,
    test: str,
    bound: float,
    start: pgjax.State,
    programs: list[Program],
    rounds: int,
) -> Row:
    measured = compare(*programs, rounds)
    one, other = (program.run() for program in programs)
    off = change(np.asarray(start.x), one, other)
    return {"what": what, "scene": where, "test": test, "bound": bound, "change": off} | measured


_BLOCK = "a block of 13 824 particles thrown at the floor of a box"


def neo_hookean(rounds: int) -> Row:
    """No decomposition where the law needs none."""
    pair = (bodies.thrown(bodies.jelly(law)) for law in (laws.NeoHookeanSVD, models.NeoHookean))
    test = "verification V06, test_models.py"
    return _row("neo-Hookean without a decomposition", _BLOCK, test, 1e-4, *pair, rounds)


def fixed_corotated(rounds: int) -> Row:
    """The root of B instead of an SVD of F."""
    kinds = (reference.FixedCorotatedSVD, models.FixedCorotated)
    pair = (bodies.thrown(bodies.jelly(law)) for law in kinds)
    test = "test_reference_models.py"
    return _row("fixed corotated from B instead of an SVD", _BLOCK, test, 1e-4, *pair, rounds)


def _flow(name: str, printed: models.Material, ours: models.Material, rounds: int) -> Row:
    pair = (bodies.thrown(material) for material in (printed, ours))
    test = "test_reference_models.py"
    return _row(f"{name} from B instead of an SVD", _BLOCK, test, 1e-3, *pair, rounds)


def drucker_prager(rounds: int) -> Row:
    """One symmetric eigenproblem."""
    law = reference.StVKHenckySVD(bodies.E, bodies.NU)
    printed = models.Material(law, reference.DruckerPragerSVD(30.0), bodies.DENSITY)
    return _flow("Drucker-Prager", printed, bodies.sand(), rounds)


def von_mises(rounds: int) -> Row:
    """One symmetric eigenproblem."""
    law = reference.StVKHenckySVD(bodies.E, bodies.NU)
    printed = models.Material(law, reference.VonMisesSVD(5e3), bodies.DENSITY)
    return _flow("von Mises", printed, bodies.metal(), rounds)


def herschel_bulkley(rounds: int) -> Row:
    """One symmetric eigenproblem."""
    law = models.DevVolNeoHookean(bodies.E, bodies.NU)
    pair = (
        models.Material(law, flow(1e3, 50.0), bodies.DENSITY)
        for flow in (reference.HerschelBulkleySVD, models.HerschelBulkley)
    )
    return _flow("Herschel-Bulkley", *pair, rounds)


def no_plasticity(rounds: int) -> Row:
    """Neither return mapping nor total deformation where nothing flows."""
    never = bodies.metal(1e30)
    elastic = models.Material(models.StVKHencky(bodies.E, bodies.NU), density=bodies.DENSITY)
    pair = (bodies.thrown(material) for material in (never, elastic))
    what = "no plasticity compiled in (without: a yield stress that is never reached)"
    return _row(what, _BLOCK, "test_needed.py", 1e-4, *pair, rounds)


def slices(rounds: int) -> Row:
    """Each law for its own particles."""
    kinds = (models.NeoHookean, models.FixedCorotated, models.StVKHencky)
    saving = bodies.thrown(*(bodies.jelly(law) for law in kinds))
    which = laws.with_layers(saving[0], 3)
    everywhere = models.Material(laws.OneOfThree(bodies.E, bodies.NU, which), None, bodies.DENSITY)
    without = bodies.thrown(everywhere)
    what = "a slice for each of three laws (without: all laws everywhere, then `where`)"
    return _row(what, _BLOCK + " in three layers", "test_needed.py", 1e-4, without, saving, rounds)


def mls(rounds: int) -> Row:
    """C is the gradient, and the bound of the time step is larger; both run at half their bound."""
    setups = [
        bodies.thrown(bodies.jelly(), scheme=scheme)
        for scheme in (pgjax.SplineGradient(), pgjax.MLS())
    ]
    programs = [rollout(*s, seconds=_SECONDS, dt=pgjax.stable_dt(*s)) for s in setups]
    what = "MLS instead of the spline gradient, each at half its bound"
    test = "verification V24, V27; errors: work_precision_cpu.md"
    return _finished(what, _BLOCK, test, 5e-2, setups[1][1], programs, rounds)


@contextlib.contextmanager
def _patched(name: str, value: Any) -> Iterator[None]:
    """The step with something of it replaced."""
    before = getattr(_STEP, name)
    setattr(_STEP, name, value)
    jax.clear_caches()
    try:
        yield
    finally:
        setattr(_STEP, name, before)
        jax.clear_caches()


def empty_grid(rounds: int) -> Row:
    """Nodes without mass are not even cleared."""
    setup = bodies.thrown(bodies.jelly(), cells=160)
    dt = pgjax.stable_dt(*setup)
    with _patched("_EMPTY", 1e30):
        without = rollout(*setup, seconds=_SECONDS, dt=dt)
    saving = rollout(*setup, seconds=_SECONDS, dt=dt)
    where = _BLOCK + " of 160³ cells"
    what = "nodes without mass left alone"
    programs = [without, saving]
    return _finished(what, where, "test_empty_grid.py", 0.0, setup[1], programs, rounds)


def tight_grid(rounds: int) -> Row:
    """What a roomy grid costs after all."""
    tight = bodies.thrown(bodies.jelly())
    roomy = bodies.thrown(bodies.jelly(), cells=160, walls=tight[0].boundaries)
    what = "a tight grid of 24³ cells (without: 160³)"
    return _row(what, _BLOCK, "verification V40, V42", 1e-6, roomy, tight, rounds)


def walls(rounds: int) -> Row:
    """Conditions of the grid only where there is mass."""
    room = 60 * bodies.H
    middle = room / 2
    shapes = [
        boundary.HalfSpace((middle, middle, 3 * bodies.H), (0, 0, 1)),
        boundary.HalfSpace((middle, middle, room - 3 * bodies.H), (0, 0, -1)),
        boundary.Sphere((room - 8 * bodies.H,) * 3, 4 * bodies.H),
        boundary.Cuboid((room - 16 * bodies.H,) * 3, (2 * bodies.H,) * 3),
    ]
    colliders = [boundary.Collider(shape, boundary.Separating(0.3)) for shape in shapes]
    setup = bodies.thrown(bodies.jelly(), cells=60, walls=colliders)
    dt = pgjax.stable_dt(*setup)

    def everywhere(*_: Any) -> Any:
        infinite = np.full(3, np.inf, np.float32)
        return boundary.Region(jax.numpy.asarray(-infinite), jax.numpy.asarray(infinite))

    with _patched("region_of", everywhere):
        without = rollout(*setup, seconds=_SECONDS, dt=dt)
    saving = rollout(*setup, seconds=_SECONDS, dt=dt)
    where = _BLOCK + " of 60³ cells, two planes, a ball and a block"
    what = "conditions of the grid where there is mass"
    return _finished(what, where, "test_nodes.py", 0.0, setup[1], [without, saving], rounds)


def still(rounds: int) -> Row:
    """What does not move is drawn, not simulated."""
    h, material = bodies.H, bodies.jelly()
    x, volumes = pgjax.sampling.block((4 * h,) * 3, (16 * h,) * 3, spacing=h / 2)
    around, more = pgjax.sampling.block(
        (22 * h, 4 * h, 4 * h), (46 * h, 16 * h, 16 * h), spacing=h / 2
    )
    box = boundary.Box((3 * h,) * 3, (49 * h, 21 * h, 21 * h), boundary.Separating(0.4))

    def scene(places: np.ndarray, sizes: np.ndarray, moving: int) -> Setup:
        rest = boundary.Steady((0.0, 0.0, 0.0))
        held = boundary.ParticleMotion(np.arange(len(places)) >= moving, rest)
        made = pgjax.Scene(
            pgjax.Grid((0, 0, 0), (52, 24, 24), h),
            material,
            sizes,
            gravity=bodies.GRAVITY,
            boundaries=[box],
            particle_conditions=[held] if moving < len(places) else [],
            scheme=pgjax.MLS(),
        )
        v = np.where(np.arange(len(places))[:, None] < moving, np.array([[0.5, 0.0, -2.0]]), 0.0)
        return made, pgjax.initial_state(made, places, v, dtype=np.float32)

    everything = scene(np.concatenate([x, around]), np.concatenate([volumes, more]), len(x))
    saving = scene(x, volumes, len(x))
    dt = pgjax.stable_dt(*saving)
    whole, moving = (rollout(*s, seconds=_SECONDS, dt=dt) for s in (everything, saving))
    without = dataclasses.replace(whole, places=lambda state: np.asarray(state.x)[: len(x)])
    what = "Gaussians that do not move are not simulated (two thirds of them)"
    where = _BLOCK + " beside 27 648 at rest, 6 cells away"
    programs = [without, moving]
    return _finished(what, where, "test_needed.py", 1e-6, saving[1], programs, rounds)


def single(rounds: int) -> Row:
    """`F − I` in single precision."""
    with jax.enable_x64(True):
        setups = [bodies.thrown(bodies.jelly(), dtype=t) for t in (np.float64, np.float32)]
        dt = pgjax.stable_dt(*setups[0])
        programs = [rollout(*s, seconds=_SECONDS, dt=dt) for s in setups]
        what = "single precision with F − I (without: double)"
        test = "verification V43, test_precision.py"
        return _finished(what, _BLOCK, test, 2e-3, setups[1][1], programs, rounds)


def ledger(rounds: int) -> Row:
    """No accounts unless asked for."""
    setup = bodies.thrown(bodies.jelly())
    dt = pgjax.stable_dt(*setup)
    programs = [rollout(*setup, seconds=_SECONDS, dt=dt, ledger=kept) for kept in (True, False)]
    what = "no accounts of energy and momentum unless asked for"
    return _finished(what, _BLOCK, "test_ledger.py", 0.0, setup[1], programs, rounds)


def plane(rounds: int) -> Row:
    """Two dimensions for what is the same along the third."""
    h = 1 / 64

    def setup(d: int) -> Setup:
        low, high = np.full(d, 8 * h), np.full(d, 32 * h)
        shape = [64] * d
        if d == 3:
            low[1], high[1], shape[1] = 0.0, h, 1
        x, volumes = pgjax.sampling.block(low, high, spacing=h / 2)
        up = np.eye(d)[-1]
        floor = boundary.Collider(boundary.HalfSpace(6 * h * up, up), boundary.Slip())
        scene = pgjax.Scene(
            pgjax.Grid(np.zeros(d), shape, h, periodic=[d == 3 and i == 1 for i in range(d)]),
            bodies.jelly(),
            volumes,
            gravity=-9.81 * up,
            boundaries=[floor],
            scheme=pgjax.MLS(),
        )
        v = np.zeros(d)
        v[0], v[-1] = 1.0, -2.0
        return scene, pgjax.initial_state(scene, x, v, dtype=np.float32)

    pair = [setup(d) for d in (3, 2)]
    dt = pgjax.stable_dt(*pair[0])
    slab, flat = (rollout(*s, seconds=0.1, dt=dt) for s in pair)
    # Of each column of the slab one particle, without its coordinate across.
    columns = _columns(np.asarray(pair[0][1].x), np.asarray(pair[1][1].x))
    without = dataclasses.replace(
        slab, places=lambda state: np.asarray(state.x)[columns][:, [0, 2]]
    )
    what = "two dimensions for a planar scene (without: a periodic slab, one cell thick)"
    where = "a square of 2 304 particles that falls on the floor"
    test = "verification V21"
    return _finished(what, where, test, 1e-3, pair[1][1], [without, flat], rounds)


def _columns(slab: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """For each particle of the plane one of the slab above it."""
    return cKDTree(slab[:, [0, 2]]).query(flat)[1]


ROWS: dict[str, Callable[[int], Row]] = {
    row.__name__: row
    for row in (
        neo_hookean,
        fixed_corotated,
        drucker_prager,
        von_mises,
        herschel_bulkley,
        no_plasticity,
        slices,
        mls,
        single,
        empty_grid,
        tight_grid,
        walls,
        still,
        plane,
        ledger,
    )
}
