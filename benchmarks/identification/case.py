"""What a case consists of, and how its data are made."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

import pgjax
from benchmarks.identification.bodies import Resolution, cameras, painted
from pgjax.inverse import Parameter, Pictures, Positions, Problem, Stage

Build = Callable[[dict], tuple[pgjax.Scene, pgjax.State]]


class Target(NamedTuple):
    """Demanded error of one parameter: `scale` says of what.

    Attributes:
        scale: "log10" (decades), "relative" or "absolute".
        self_error: with the estimator's own discretisation; None if nothing is demanded.
        cross_error: with another one.
    """

    scale: str
    self_error: float | None
    cross_error: float | None

    def error(self, estimate: float, truth: float) -> float:
        """In the unit of the target."""
        if self.scale == "log10":
            return abs(np.log10(estimate / truth))
        return abs(estimate - truth) / (abs(truth) if self.scale == "relative" else 1.0)


@dataclasses.dataclass(frozen=True)
class Case:
    """One row of the table.

    Attributes:
        name: of the case.
        truth: values of the unknowns.
        parameters: the unknowns with their first guesses.
        build: from a resolution to positions of the particles and the function that a `Problem`
            takes.
        resolution: of the estimator.
        frames: number of frames.
        frame_dt: s.
        targets: per unknown; of a vector the largest error of its entries counts.
        views: number of cameras; positions of particles are observed if 0.
        pixels: along an edge of the pictures.
        seen: number of observed particles, spread evenly; all if None.
        watched: centre and distance of the ring of cameras.
        stages: of the fit.
        substeps: per frame, if the case prescribes them.
        trials: of each descent of the fit at most.
        limit: demanded number of iterations, those of the stages included; None if there is none.
        double: whether double precision is needed.
        about: where the case comes from.
    """

    name: str
    truth: Mapping[str, np.ndarray | float]
    parameters: Mapping[str, Parameter]
    build: Callable[[Resolution], tuple[np.ndarray, Build]]
    resolution: Resolution
    frames: int
    frame_dt: float
    targets: Mapping[str, Target]
    views: int = 0
    pixels: int = 200
    seen: int | None = None
    watched: tuple[tuple[float, float, float], float] = ((0.0, 0.0, 0.25), 1.6)
    stages: tuple[Stage, ...] = ()
    substeps: int | None = None
    trials: int = 25
    limit: int | None = None
    double: bool = False
    about: str = ""


def problem(case: Case, tier: str, views: int | None = None) -> Problem:
    """The estimator's problem, with data of the tier "self" or "cross"."""
    x, build = case.build(case.resolution)
    observe = _pictures if case.views else _positions
    made_at = case.resolution if tier == "self" else case.resolution.finer()
    return observe(case, x, build, made_at, views or case.views)


def _positions(case: Case, x: np.ndarray, build: Build, made_at: Resolution, _: int) -> Problem:
    index = _spread(len(x), case.seen)
    data, _ = _motion_of(case, made_at, x[index])
    observation = Positions(data[1:], particles=index, sigma=1e-3)
    return _problem(case, build, observation)


def _pictures(case: Case, x: np.ndarray, build: Build, made_at: Resolution, views: int) -> Problem:
    """The same Gaussians in both tiers: a capture looks as it looks, however it is simulated."""
    center, distance = case.watched
    ring = cameras(center, distance, case.views, case.pixels)[:views]
    size = (case.frames, len(ring), case.pixels, case.pixels, 3)
    gaussians = painted(x, case.resolution.h / 2)
    sight = {"background": (0.2, 0.2, 0.2), "sigma": 0.02}
    blank = Pictures(gaussians, ring, np.zeros(size, np.float32), **sight)
    problem = _problem(case, build, blank)
    _, state = build(problem.space.values(problem.space.start))
    see = jax.jit(lambda state: blank.see(state))
    pictures = []
    for places, F in zip(*_motion_of(case, made_at, x), strict=True):
        at = jnp.asarray(places, state.dtype) - jnp.broadcast_to(state.origin, state.v.shape)
        H = jnp.asarray(F - np.eye(3), state.dtype)
        now = eqx.tree_at(lambda s: (s.position, s.He), state, (at, H))
        if state.H is not None:
            now = eqx.tree_at(lambda s: s.H, now, H)
        pictures.append(np.asarray(see(now)))
    return problem.observing(Pictures(gaussians, ring, np.stack(pictures[1:]), **sight))


def _problem(case: Case, build: Build, observation) -> Problem:
    return Problem(
        case.parameters,
        build,
        observation,
        frame_dt=case.frame_dt,
        substeps=case.substeps,
    )


def _maker(case: Case, build: Build, observation, made_at: Resolution) -> Problem:
    """The problem at the true values, whose steps are as short as the estimator's or shorter."""
    own = _problem(case, case.build(case.resolution)[1], observation)
    at_truth = {
        name: p.replace(start=case.truth[name], prior=None) for name, p in case.parameters.items()
    }
    finer = made_at.cells / case.resolution.cells
    return Problem(
        at_truth,
        build,
        observation,
        frame_dt=case.frame_dt,
        substeps=int(np.ceil(own.substeps * made_at.steps * max(1.0, finer / made_at.steps))),
    )


def _motion_of(
    case: Case, made_at: Resolution, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and F of material points in every frame, from a simulation at the true values."""
    x, build = case.build(made_at)
    blank = Positions(np.zeros((case.frames, len(x), x.shape[1])))
    maker = _maker(case, build, blank, made_at)
    scene, state = maker.build(maker.space.values(maker.space.start))
    trajectory = pgjax.simulate(
        scene,
        state,
        dt=maker.dt,
        frames=maker.frames,
        substeps=maker.substeps,
        allow_unstable=True,
    )
    moved, F = np.asarray(trajectory.saved.x), np.asarray(trajectory.saved.F)
    distance, near = cKDTree(x).query(points)
    if np.max(distance) < 1e-9:
        return moved[:, near], F[:, near]
    # Between particles the motion is that of the four nearest ones, weighted by distance, each
    # carrying the point along with its own F.
    distance, near = cKDTree(x).query(points, k=4)
    weights = 1 / (distance + 1e-9)
    weights /= weights.sum(axis=1, keepdims=True)
    d = x.shape[1]
    arms = points[:, None] - x[near]
    carried = moved[:, near] + np.einsum("fpkij,pkj->fpki", F[:, near][..., :d, :d], arms)
    return (
        np.einsum("pk,fpkd->fpd", weights, carried),
        np.einsum("pk,fpkij->fpij", weights, F[:, near]),
    )


def _spread(count: int, wanted: int | None) -> np.ndarray:
    """Numbers of evenly spread particles."""
    if wanted is None:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, wanted).round().astype(int))
