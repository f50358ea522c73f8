"""Level 6: derivatives of the step and of a rollout (G1–G5).

Where a particle changes its branch, its cell or its contact, the motion has a kink and no
derivative; so differences count only where the record of both rollouts is the same.
"""

import functools

import impact
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax

pytestmark = pytest.mark.float64

# Relative steps of the central differences, and those of the Taylor test.
STEP_SIZES = (1e-6, 3e-7)
TAYLOR_SIZES = tuple(2.0**-k for k in range(10, 21))

recorded = jax.jit(impact.recorded)


WEIGHTS = np.random.default_rng(1).standard_normal((impact.FRAMES, *impact.POSITIONS.shape))


@jax.jit
def forward_mode(p, tangents, dt):
    """Derivatives of the motion, `(directions, frames, blocks, particles, 2)`."""

    def along(tangent):
        return jax.jvp(lambda p: impact.simulated(p, dt), (p,), (tangent,))[1]

    return jax.vmap(along)(tangents)


@jax.jit
def reverse_mode(p, dt):
    """Gradient of a loss, `Σ weights · displacement` over all frames."""
    return jax.grad(lambda p: jnp.sum(WEIGHTS * impact.simulated(p, dt)))(p)


@jax.jit
def single_precision(p, tangents, dt):
    """The derivatives in float32, and the record of their rollout."""

    def along(tangent):
        (_, record), (derivative, _) = jax.jvp(
            lambda p: impact.recorded(p, dt, impact.STEPS, jnp.float32), (p,), (tangent,)
        )
        return derivative, record

    return jax.vmap(along, out_axes=(0, None))(tangents)


@functools.cache
def base():
    """The parameters and the time step of the impact."""
    p = impact.parameters()
    return p, pgjax.stable_dt(impact.scene(p), fraction=0.4)


def directions(p):
    """Tangents by name: one parameter of every block that has it, by 100 % of its value."""
    zero = jax.tree.map(jnp.zeros_like, p)
    tangents = {name: zero | {name: p[name]} for name in ("E", "nu", "density", "v0", "gravity")}
    tangents["x0"] = zero | {"x0": jnp.full_like(p["x0"], impact.H)}
    # The first plastic parameter of each block in one tangent, the second in another, and so on.
    for position in range(max(len(own) for own in impact.BLOCKS.values())):
        tangent, names = dict(zero), []
        for block, own in impact.BLOCKS.items():
            for name in list(own)[position : position + 1]:
                tangent[block] = zero[block] | {name: p[block][name]}
                names.append(name)
        tangents[", ".join(dict.fromkeys(names))] = tangent
    return tangents


def stacked(tangents):
    return jax.tree.map(lambda *a: jnp.stack(a), *tangents.values())


@functools.cache
def derivatives():
    """By the name of its direction, the derivative of the motion, and the direction."""
    p, dt = base()
    tangents = directions(p)
    motions = np.asarray(forward_mode(p, stacked(tangents), dt))
    return {name: (motions[k], tangents[name]) for k, name in enumerate(tangents)}


def shifted(p, tangent, size):
    return jax.tree.map(lambda a, t: a + size * t, p, tangent)


def flips(record, other, steps=impact.STEPS):
    """Per block, how many decisions of the first steps differ between two records."""
    return sum(
        np.sum(np.asarray(record[k][:steps] != other[k][:steps]), axis=(0, 2)) for k in record
    )


def central_differences(p, tangent, dt):
    """Per block the difference at the largest step without a flip (else NaN), and all flips."""
    result, seen = np.full((impact.FRAMES, *impact.POSITIONS.shape), np.nan), []
    for size in STEP_SIZES:
        (plus, at_plus), (minus, at_minus) = (
            recorded(shifted(p, tangent, s), dt, impact.STEPS) for s in (size, -size)
        )
        seen.append(flips(at_plus, at_minus))
        usable = np.isnan(result) & (seen[-1] == 0)[:, None, None]
        result = np.where(usable, np.asarray(plus - minus) / (2 * size), result)
        if not np.isnan(result).any():
            break
    return result, seen


def by_block(a):
    """Norm of a motion of the particles (frames, blocks, particles, 2), per block."""
    return np.sqrt(np.sum(np.square(np.asarray(a, np.float64)), axis=(0, 2, 3)))


def along(gradient, tangent):
    """Directional derivative of each block from the gradient, and that of gravity."""
    product = jax.tree.map(lambda g, t: np.asarray(g * t), gradient, tangent)
    gravity = product.pop("gravity").sum()
    own = [sum(product.pop(block, {}).values()) for block in impact.BLOCKS]
    return sum(a.reshape(impact.COUNT, -1).sum(axis=1) for a in product.values()) + own, gravity


@pytest.mark.slow
def test_impact_has_every_state(measure):
    """Free flight, contact, sliding, sticking, flow, tip; the blocks never meet."""
    p, dt = base()
    moved, record = recorded(p, dt, impact.STEPS)
    contact, branch = np.asarray(record["contact"]), np.asarray(record["branch"])
    for b, name in enumerate(impact.BLOCKS):
        for state in (1, 2, 3):
            assert (contact[:, b] == state).any(), f"{name}: contact state {state} never occurs"
        assert (branch[:, b] == 0).any()
        assert (branch[:, b] == 1).any() == bool(impact.BLOCKS[name])
    assert (branch[:, list(impact.BLOCKS).index("sand")] == 2).any()
    cells = np.asarray(record["cell"]).reshape(impact.STEPS, impact.COUNT, -1, 2)[..., 0]
    # Stencils are three nodes wide: blocks whose first nodes are three apart share none.
    assert (cells[:, 1:].min(axis=2) - cells[:, :-1].max(axis=2)).min() >= 3
    error = np.max(np.abs(moved - jax.jit(impact.simulated)(p, dt))) / np.max(np.abs(moved))
    measure("V44", "500 steps, nine laws: loop of step = simulate", error, below=1e-13)


@pytest.mark.slow
def test_forward_reverse_and_differences_agree(measure, capsys):
    """G3 over an impact of 500 steps, for every parameter of every law."""
    p, dt = base()
    gradient = reverse_mode(p, dt)
    counted, possible = 0, 0
    for name, (forward, tangent) in derivatives().items():
        depends = by_block(forward) > 0
        of_loss = np.sum(WEIGHTS * forward, axis=(0, 2, 3))
        reverse, by_gravity = along(gradient, tangent)
        if name == "gravity":
            error = abs(by_gravity - of_loss.sum()) / abs(of_loss.sum())
        else:
            assert (reverse[~depends] == 0).all()
            error = np.max(np.abs(reverse - of_loss)[depends] / np.abs(of_loss)[depends])
        measure("G3", f"500 steps, JVP = VJP: {name}", error, below=1e-10)
        difference, seen = central_differences(p, tangent, dt)
        error = by_block(difference - forward)[depends] / by_block(forward)[depends]
        measure("G3", f"500 steps, AD = differences: {name}", np.nanmax(error), below=1e-6)
        counted, possible = counted + np.sum(~np.isnan(error)), possible + len(error)
        with capsys.disabled():
            for size, per_block in zip(STEP_SIZES, seen, strict=False):
                print(f"\nflips of ±{size:g} in {name}, per block: {per_block.tolist()}", end="")
    # Six parameters of nine blocks, and eleven plastic ones.
    assert possible == 6 * impact.COUNT + sum(len(own) for own in impact.BLOCKS.values())
    measure("G3", "part of the derivatives without a flip", counted / possible, above=0.95)


@pytest.mark.slow
def test_taylor_remainder(measure):
    """G2 over 50 steps: `|x(θ + s d) − x(θ) − s x′d|` falls as s²."""
    p, dt = base()
    steps = impact.SUBSTEPS
    start, record = recorded(p, dt, steps)
    counted, possible = 0, 0
    for name, (motion, tangent) in derivatives().items():
        slope, remainder, orders = motion[:1], [], []
        for size in TAYLOR_SIZES:
            moved, at_moved = recorded(shifted(p, tangent, size), dt, steps)
            error = by_block(moved[:1] - start[:1] - size * slope)
            # Only above rounding, and where nothing was decided differently.
            usable = (flips(record, at_moved, steps) == 0) & (error > 3e-13)
            remainder.append(np.where(usable, error, np.nan))
        for b in np.flatnonzero(by_block(slope)):
            series = np.asarray(remainder)[:, b]
            pairs = np.flatnonzero(~np.isnan(series[:-1] + series[1:]))
            orders.extend(np.log2(series[k] / series[k + 1]) for k in pairs[-1:])
            possible += 1
        counted += len(orders)
        furthest = max(orders, key=lambda order: abs(order - 2))
        measure("G2", f"order of the Taylor remainder: {name}", furthest, within=(1.9, 2.1))
    measure("G2", "part of the remainders without a flip", counted / possible, above=0.95)


@pytest.mark.slow
def test_single_precision_derivatives(measure):
    """G3: float32 against float64, for each block the frames before its first flip."""
    p, dt = base()
    _, record = recorded(p, dt, impact.STEPS)
    singles, at_single = single_precision(p, stacked(directions(p)), dt)
    assert singles.dtype == jnp.float32
    singles = np.asarray(singles, np.float64)
    ends = impact.SUBSTEPS * np.arange(1, impact.FRAMES + 1)
    same = np.array([flips(record, at_single, end) == 0 for end in ends])
    measure("G3", "part of the float32 frames without a flip", same.mean(), above=0.5)
    for single, (name, (exact, _)) in zip(singles, derivatives().items(), strict=True):
        gap, size = (by_block(a * same[:, :, None, None]) for a in (single - exact, exact))
        error = gap[size > 0] / size[size > 0]
        measure("G3", f"500 steps, float32 = float64: {name}", np.max(error), below=1e-3)
