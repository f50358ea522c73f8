"""Flows with a free surface against experiments and theories (V35, V36, V37, V38)."""

import flows
import numpy as np
import pytest

from pgjax.boundary import Slip, Sticky

pytestmark = pytest.mark.float64


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


# --- V35: a column of sand ------------------------------------------------------------------------

# What a prototype measured for φ = 20° and 30°: runout, and the height for 30°, over the width.
SAND = {
    0.5: (0.44, 0.26, 0.48),
    1.0: (1.33, 0.72, 0.91),
    2.0: (3.39, 1.81, 1.23),
    4.0: (5.89, 3.67, 1.60),
}


def experiment(aspect):
    """Runout over the width in a channel (Lube et al. 2005; Lajeunesse et al. 2005).

    From memory, not checked: fits of low and of high columns, which meet at an aspect of 4.
    """
    return min(1.2 * aspect, 1.9 * aspect ** (2 / 3))


@pytest.mark.parametrize("aspect", [0.5, 1.0, slow(2.0), slow(4.0)])
def test_v35_column_collapse(measure, aspect):
    """φ = 20° and 30°, which act as 24.0° and 34.7° in plane strain, bracket the experiment.

    The table is that of a column 0.2 m wide of sand that remembers the volume it gained at the
    tip: without, the column of aspect 4 and φ = 20° runs 20 % further (see below).
    """
    loose, firm = (flows.collapse(aspect, phi) for phi in (20.0, 30.0))
    for phi, sand, known in ((20, loose, SAND[aspect][0]), (30, firm, SAND[aspect][1])):
        case = f"a = {aspect}, φ = {phi}"
        measure("V35", f"runout/table, {case}", sand.runout / known, within=(0.85, 1.15))
        measure("V35", f"kinetic energy left, {case}", sand.energy, below=1e-4)
        measure("V35", f"lowest particle, cells, {case}", sand.lowest, above=-0.5)
        measure("V35", f"mass lost, {case}", sand.lost, below=0)
    height = firm.height / SAND[aspect][2]
    measure("V35", f"height/table, a = {aspect}, φ = 30", height, within=(0.9, 1.1))
    if aspect >= 1:
        measure("V35", f"runout, a = {aspect}, φ = 20", loose.runout, above=experiment(aspect))
        measure("V35", f"runout, a = {aspect}, φ = 30", firm.runout, below=experiment(aspect))


def test_v35_fails_for_other_sand(measure):
    """Negative controls: a smooth ground, and sand of φ = 40°."""
    known = SAND[1.0][1]
    smooth = flows.collapse(1.0, 30.0, base=Slip())
    measure("V35", "negative control: runout on smooth ground", smooth.runout / known, above=1.3)
    firmer = flows.collapse(1.0, 40.0)
    measure("V35", "negative control: runout for φ = 40°", firmer.runout / known, below=0.75)


@pytest.mark.slow
def test_v35_resolution(measure):
    """Twice as fine, the column of aspect 1 runs further, as the table says: 0.84."""
    fine = flows.collapse(1.0, 30.0, n=32)
    measure("V35", "runout/table, a = 1, φ = 30, 32 cells", fine.runout / 0.84, within=(0.85, 1.15))


@pytest.mark.slow
def test_v35_sand_that_forgets_its_volume_runs_too_far(measure):
    """A limit: what falls freely dilates at the tip, and lands as looser sand than it was.

    It makes no difference to low columns, 20 % to this one, and 20 % at twice the resolution.
    """
    ratio = flows.collapse(4.0, 20.0, correct=False).runout / SAND[4.0][0]
    measure("V35", "limit: runout/table, a = 4, φ = 20, uncorrected", ratio, within=(1.1, 1.3))


# --- V38: a dam that breaks -----------------------------------------------------------------------

# Martin and Moyce (1952), water twice as high as wide: times t √(2g/a) and fronts x/a, as others
# have read them from their figure.
MARTIN_MOYCE = np.array(
    [
        (0.832, 1.217),
        (1.219, 1.474),
        (1.997, 2.292),
        (2.547, 2.995),
        (3.345, 4.134),
        (4.034, 4.944),
        (4.418, 5.881),
        (5.091, 6.980),
        (5.685, 7.945),
        (6.306, 8.966),
    ]
)


def against_experiment(**kwargs):
    """Front of the collapsing column over that of the experiment, at each of its times."""
    t, _, front, _ = flows.dam_break(16, 0.5, 5.0, 3.2, **kwargs)
    return np.interp(MARTIN_MOYCE[:, 0] / 2, t, front) / 0.5 / MARTIN_MOYCE[:, 1]


def test_v38_collapse_of_a_column_of_water(measure):
    """The front, behind which is 99 % of the water; the points themselves scatter by 5 %."""
    ratio = against_experiment()
    measure("V38", "front over experiment, mean", ratio.mean(), within=(0.95, 1.05))
    measure("V38", "front over experiment, smallest", ratio.min(), above=0.9)
    measure("V38", "front over experiment, largest", ratio.max(), below=1.1)


def test_v38_fails_for_treacle(measure):
    """Negative control: at a Reynolds number of 10 the front is slow."""
    late = against_experiment(viscosity=0.1)[5:]
    measure("V38", "negative control: front of a viscous fluid", late.mean(), below=0.85)


def ritter(measure, n):
    width, duration = 6.0, 5.0
    t, front, _, x = flows.dam_break(n, width, 10.5, duration)
    late = t > 3
    speed = np.polyfit(t[late], front[late], 1)[0]
    measure("V38", f"speed of the front over √(gH), n = {n}", speed, within=(1.8, 2.2))
    for place in (-0.5, 0.0, 0.5, 1.0):
        exact = (2 - place) ** 2 / 9
        error = flows.depth(x, width + place * duration, n) - exact
        case = f"x = {place} √(gH) t, n = {n}"
        measure("V38", f"error of depth/H, {case}", error, within=(-0.07, 0.07))


@pytest.mark.slow
def test_v38_dam_break(measure):
    """Ritter: the front runs at `2 √(gH)`, the depth is `H (2 − x/(√(gH) t))²/9`.

    That is theory of shallow water: the front starts from rest, and reaches this speed to 10 %
    after 3 √(H/g). The depth is that at 5 √(H/g); it lags behind by 0.05 H at either resolution.
    """
    ritter(measure, 16)


@pytest.mark.slow
def test_v38_dam_break_twice_as_fine(measure):
    ritter(measure, 32)


# --- V36: a metal bar hits a wall -----------------------------------------------------------------


@pytest.mark.parametrize("n", [4, slow(8)])
def test_v36_taylor_bar(measure, n):
    """Length of a bar of rigid, perfectly plastic copper after it has hit a wall at 190 m/s.

    In the theories of Taylor (17.65 mm) and of Hawkyard (17.37 mm) the foot grows away from the
    wall. The formula of Wilkins and Guinan, `L/L₀ = exp(−ρ v²/(2Y))`, is the length if it stayed a
    thin plate on the wall, and so a lower bound (16.02 mm); with their front at 0.12 L₀ (from
    memory, not checked) it is 17.14 mm. The 16.2 mm of the experiment (from memory, too) are of
    copper that hardens: they are no measure of this law.
    """
    slug = flows.taylor_bar(n)
    for name, strain in (("Taylor", flows.momentum_strain), ("Hawkyard", flows.energy_strain)):
        ratio = slug.length / flows.rigid_plastic(strain)
        measure("V36", f"length over that of {name}, R = {n} cells", ratio, within=(0.9, 1.1))
    thin = np.exp(-flows.DENSITY * flows.SPEED**2 / (2 * flows.YIELD))
    bounds = (thin, 1.1 * (0.88 * thin + 0.12))
    measure("V36", f"length over L₀, R = {n} cells", slug.length, within=bounds)
    measure("V36", f"change of volume, R = {n} cells", abs(slug.volume), below=0.01)
    measure("V36", f"rebound over v, R = {n} cells", slug.rebound, within=(0.0, 0.1))
    measure("V36", f"radius of the foot over R, R = {n} cells", slug.foot, above=1.5)


def test_v36_fails_without_yield(measure):
    """Negative control: an elastic bar rebounds as long as it was."""
    slug = flows.taylor_bar(3, None)
    ratio = slug.length / flows.rigid_plastic(flows.momentum_strain)
    measure("V36", "negative control: length, elastic bar", ratio, above=1.3)
    measure("V36", "negative control: rebound, elastic bar", slug.rebound, above=0.5)


# --- V37: paste slumps ----------------------------------------------------------------------------


def pashias(T):
    """`s/H = 1 − 2T (1 − log 2T)`, `T = τ_y/(ρ g H)`: Tresca's column, on smooth ground."""
    return flows.column_theory(2 * T)


def shear_yield(T):
    """σ_Y/(ρ g H) of paste that yields in shear at `T = σ_Y/(√3 ρ g H)`."""
    return 3**0.5 * T


@pytest.mark.slow
@pytest.mark.parametrize(("T", "n"), [(0.2, 4), slow(0.1, 6), slow(0.2, 8), slow(0.3, 8)])
def test_v37_slump(measure, T, n):
    """A cylinder as high as wide on rough ground, against the theory of Pashias et al. (1996).

    The theory leaves the ground smooth, and has Tresca's yield stress 2 τ_y under a weight, where
    von Mises's is √3 τ_y. The two errors nearly cancel; without friction the second is 20 to 40 %
    of the slump, as `test_v37_smooth_ground` shows. At T = 0.3 it is less than a tenth of the
    height and needs a finer grid: with 4 cells in the radius it is 29 % less, with 6 14 %, with 8
    8 %.
    """
    ratio = flows.slump(n, shear_yield(T), Sticky()) / pashias(T)
    measure("V37", f"slump over theory, T = {T}, R = {n} cells", ratio, within=(0.85, 1.15))


@pytest.mark.slow
def test_v37_stands(measure):
    """From T = 0.5 on the cylinder stands, but for 1 % of elastic settlement."""
    slump = flows.slump(4, shear_yield(0.5), Sticky())
    measure("V37", "slump in cells, T = 0.5, R = 4 cells", slump * 8, within=(-1.0, 1.0))


@pytest.mark.parametrize(("T", "n"), [slow(0.2, 4), slow(0.1, 4), slow(0.3, 6)])
def test_v37_smooth_ground(measure, T, n):
    """On smooth ground the same argument holds with σ_Y in place of 2 τ_y, which is 15 % less."""
    slump = flows.slump(n, shear_yield(T), Slip())
    ratio = slump / flows.column_theory(shear_yield(T))
    measure("V37", f"slump, smooth ground, T = {T}, R = {n} cells", ratio, within=(0.85, 1.15))
    if T >= 0.2:
        # Negative control: the formula for rough ground and Tresca.
        wrong = slump / pashias(T)
        measure("V37", f"negative control: smooth ground, T = {T}", wrong, above=1.15)


@pytest.mark.slow
def test_v37_fails_for_another_yield_stress(measure):
    """Negative control: τ_y taken for σ_Y."""
    ratio = flows.slump(4, 0.2, Sticky()) / pashias(0.2)
    measure("V37", "negative control: slump, yield stress without √3", ratio, above=1.3)
