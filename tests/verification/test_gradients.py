"""Level 6: derivatives of the step and of a rollout (G1–G5).

Where a particle changes its branch, its cell or its contact, the motion has a kink and no
derivative; so central differences count only where the record at θ + δ and θ − δ is the same.
"""

import functools

import equinox as eqx
import impact
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pgjax
import pgjax.models as pm
from pgjax.boundary import HalfSpace, Separating

pytestmark = pytest.mark.float64

# Relative steps of the central differences, and those of the Taylor test.
STEP_SIZES = (3e-6, 1e-6, 3e-7)
TAYLOR_SIZES = tuple(2.0**-k for k in range(9, 18))

simulated = jax.jit(impact.simulated)
recorded = jax.jit(impact.recorded)


@jax.jit
def forward_mode(p, tangent, dt):
    """Derivative of the losses of every frame along a direction, `(FRAMES, blocks)`."""
    return jax.jvp(lambda p: impact.simulated(p, dt), (p,), (tangent,))[1]


@jax.jit
def reverse_mode(p, dt):
    """Gradient of the sum of the losses, averaged over the frames."""
    return jax.grad(lambda p: impact.simulated(p, dt).mean(axis=0).sum())(p)


@functools.cache
def base():
    """The parameters and the time step of the impact."""
    p = impact.parameters()
    return p, pgjax.stable_dt(impact.scene(p), fraction=0.4)


def directions(p):
    """Tangents: each changes one parameter of every block, by 100 % of its value."""
    zero = jax.tree.map(jnp.zeros_like, p)
    for name in ("E", "nu", "density", "v0", "gravity"):
        yield name, zero | {name: p[name]}
    yield "x0", zero | {"x0": jnp.full_like(p["x0"], impact.H)}
    for position in range(max(len(own) for own in impact.BLOCKS.values())):
        tangent = dict(zero)
        for block, own in impact.BLOCKS.items():
            if len(own) > position:
                name = list(own)[position]
                tangent[block] = zero[block] | {name: p[block][name]}
        yield f"plastic {position}", tangent


def label(direction, block):
    """Name of the parameter of a block that a direction changes; None if it has none."""
    if not direction.startswith("plastic"):
        return direction
    names = list(impact.BLOCKS[block])
    position = int(direction[-1])
    return names[position] if position < len(names) else None


def shifted(p, tangent, size):
    return jax.tree.map(lambda a, t: a + size * t, p, tangent)


def flips(record, other, steps=impact.STEPS):
    """Per block, how many decisions of the first steps differ between two records."""
    return sum(
        np.sum(np.asarray(record[k][:steps] != other[k][:steps]), axis=(0, 2)) for k in record
    )


def central_differences(p, tangent, dt):
    """Per block, the difference at the largest step without a flip (else NaN), and the flips."""
    result = np.full(impact.COUNT, np.nan)
    seen = []
    for size in STEP_SIZES:
        (plus, at_plus), (minus, at_minus) = (
            recorded(shifted(p, tangent, s), dt, impact.STEPS) for s in (size, -size)
        )
        difference = np.asarray(plus - minus).mean(axis=0) / (2 * size)
        seen.append(flips(at_plus, at_minus))
        result = np.where(np.isnan(result) & (seen[-1] == 0), difference, result)
        if not np.isnan(result).any():
            break
    return result, seen


def test_the_impact_is_one(measure):
    """The run has free flight, contact, sliding, sticking, flow, and never two blocks meeting."""
    p, dt = base()
    losses, record = recorded(p, dt, impact.STEPS)
    contact, branch = np.asarray(record["contact"]), np.asarray(record["branch"])
    for b, name in enumerate(impact.BLOCKS):
        for state in (1, 2, 3):
            assert (contact[:, b] == state).any(), f"{name}: contact state {state} never occurs"
        assert (branch[:, b] == 0).any()
        assert (branch[:, b] == 1).any() == bool(impact.BLOCKS[name])
    assert (branch[:, list(impact.BLOCKS).index("sand")] == 2).any()
    cells = np.asarray(record["cell"]).reshape(impact.STEPS, impact.COUNT, -1, 2)[..., 0]
    # Stencils are three nodes wide: blocks whose first nodes are four apart share none.
    assert (cells[:, 1:].min(axis=2) - cells[:, :-1].max(axis=2)).min() >= 4
    difference = np.abs(losses - simulated(p, dt)).max() / np.abs(losses).max()
    measure("V44", "500 steps: loop of step against simulate", difference, below=1e-13)


def test_derivatives_of_an_impact(measure, capsys):
    """G3: 500 steps; forward mode = reverse mode = central differences, every parameter."""
    p, dt = base()
    gradient = reverse_mode(p, dt)
    counted = 0
    for direction, tangent in directions(p):
        forward = np.asarray(forward_mode(p, tangent, dt)).mean(axis=0)
        reverse = sum(jax.tree.leaves(jax.tree.map(lambda g, t: (g * t).sum(), gradient, tangent)))
        error = abs(forward.sum() - reverse) / np.abs(forward).sum()
        measure("G3", f"JVP = VJP, {direction}, all blocks", error, below=1e-10)
        difference, seen = central_differences(p, tangent, dt)
        with capsys.disabled():
            print(f"\nG3 {direction}: flips per block {[s.tolist() for s in seen]}", end="")
        for b, block in enumerate(impact.BLOCKS):
            name = label(direction, block)
            if name is None:
                assert forward[b] == 0
                continue
            own = gradient[block][name] if name in impact.BLOCKS[block] else None
            if own is None and direction != "gravity":
                own = gradient[name][b]
            if own is not None:
                along = (
                    own * tangent[block][name]
                    if block in tangent and name in tangent[block]
                    else (own * tangent[name][b]).sum()
                )
                error = abs(along - forward[b]) / abs(forward[b])
                measure("G3", f"JVP = VJP, {name} of {block}", error, below=1e-10)
            if not np.isnan(difference[b]):
                counted += 1
                error = abs(difference[b] - forward[b]) / abs(forward[b])
                measure("G3", f"central difference, {name} of {block}", error, below=1e-6)
    measure("G3", "derivatives compared without a flip", counted, above=60)
