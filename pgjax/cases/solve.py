"""From a case file to a fit, a report and the fitted scene file."""

import dataclasses
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w

from pgjax._files import replacing
from pgjax.cases.footage import Footage, footage, track
from pgjax.cases.report import Comparison, write_report
from pgjax.cases.schema import CaseFile, fitted_content
from pgjax.cases.unknowns import Building, place
from pgjax.inverse import Fit, Pictures, Positions, Problem, fit
from pgjax.inverse.observations import AbstractObservation
from pgjax.render import Camera
from pgjax.result import SimulationWarning
from pgjax.scenes import Plan, SceneError, plan
from pgjax.scenes.camera import CameraPart
from pgjax.scenes.reader import naming
from pgjax.scenes.regions import Triple
from pgjax.scenes.views import Orbit, Shot
from pgjax.timestep import substeps_for

# The first pictures are those of the scene at rest up to this: root mean square over the pixels in
# which either shows something.
_ALIKE = 0.15


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A case, ready to be solved.

    Attributes:
        case: the file.
        plan: the scene at the numbers of its file.
        problem: of the frames that are fitted.
        whole: of all frames that are compared.
        footage: of each view; empty for a track.
        notes: what a reader of the report has to know.
    """

    case: CaseFile
    plan: Plan
    problem: Problem
    whole: Problem
    footage: tuple[Footage, ...]
    notes: tuple[str, ...]


def prepare(case: CaseFile) -> Prepared:
    """Load scene and data and see that they fit together, before anything is fitted.

    Raises:
        SceneError: they do not.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SimulationWarning)
        made = plan(case.scene)
        if case.track is not None:
            observations, films = _of_track(case, made), ()
        else:
            seen = [part or made.view for _, part in case.views]
            cameras = [
                _camera(case, made, part, t.name)
                for part, (t, _) in zip(seen, case.views, strict=True)
            ]
            films = tuple(
                footage(t, case.frame_rate, case.first, case.frames, (camera.width, camera.height))
                for camera, (t, _) in zip(cameras, case.views, strict=True)
            )
            observations = [
                _of_view(case, made, film, camera, part.background)
                for film, camera, part in zip(films, cameras, seen, strict=True)
            ]
    for t, _ in case.views:
        t.close()
    if case.track is not None:
        case.track.close()
    places = tuple((u.key, place(u, made)) for u in case.unknowns)
    whole = Problem(
        {u.key: u.parameter for u in case.unknowns},
        Building(made.scene, made.state, places),
        observations,
        frame_dt=1 / case.frame_rate,
        frames=case.frames,
        substeps=_given_steps(case),
        fraction=case.scene.time.fraction,
    )
    # The keys stand in the scene file as they are written.
    fitted_content(case, {u.key: u.parameter.start for u in case.unknowns}, whole.dt)
    notes = [str(w.message) for w in caught] + _first_look(case, whole, films)
    problem = whole.until(case.fit_frames).coarser(case.coarser)
    return Prepared(case, made, problem, whole, films, tuple(notes))


def _camera(case: CaseFile, made: Plan, part: CameraPart, label: str) -> Camera:
    """The camera of a view, which has to stand still."""
    with naming(label):
        first = part.view.at(0.0, made.to_simulation)
    still = isinstance(part.view, Shot) or (isinstance(part.view, Orbit) and not part.view.turn)
    for frame in range(1, 1 if still else case.frames + 1):
        other = part.view.at(frame / case.frame_rate, made.to_simulation)
        pairs = zip(jax.tree.leaves(first), jax.tree.leaves(other), strict=True)
        if not all(np.array_equal(a, b) for a, b in pairs):
            raise SceneError(f"{label}: the camera must stand still, but moves between frames.")
    return first


def _of_view(
    case: CaseFile, made: Plan, film: Footage, camera: Camera, background: Triple
) -> AbstractObservation:
    data = film.pictures if case.channel == "rgb" else film.pictures.mean(axis=-1)
    return Pictures(
        made.moving,
        camera,
        data,
        channel=case.channel,
        background=background,
        frames=film.numbers.tolist(),
        sigma=case.noise,
        still=made.still if len(made.still) else None,
        carry=made.carriage,
    )


def _of_track(case: CaseFile, made: Plan) -> list[AbstractObservation]:
    assert case.track is not None
    found = track(case.track, made.scene.particle_count, case.frames)
    kept = found.numbers <= case.frames
    if not kept.any():
        raise case.track.error("file", f"hold frames up to {case.frames}, the last one")
    with naming(case.track.name):
        return [
            Positions(
                found.x[kept],
                frames=found.numbers[kept].tolist(),
                particles=found.particles,
                sigma=case.noise,
            )
        ]


def _given_steps(case: CaseFile) -> int | None:
    """Steps per frame of the scene's own time step, if it has one."""
    dt = case.scene.time.dt
    return None if dt is None else substeps_for(1 / case.frame_rate, dt)


def _first_look(case: CaseFile, problem: Problem, films: tuple[Footage, ...]) -> list[str]:
    """Whether the first picture of each view looks like the scene at rest."""
    notes = []
    _, state = problem.build(problem.space.values(problem.space.start))
    for film, observation in zip(films, problem.observations, strict=bool(films)):
        if film.numbers[0] != 0:
            continue
        assert isinstance(observation, Pictures)
        seen, data = np.asarray(observation.see(state)), np.asarray(observation.data[0])
        rgb = case.channel == "rgb"
        behind = np.asarray(observation.background) if rgb else 0.0
        drawn = (np.abs(seen - behind) > _ALIKE / 2) | (np.abs(data - behind) > _ALIKE / 2)
        drawn = drawn.any(axis=-1) if rgb else drawn
        if not drawn.any():
            continue
        off = float(np.sqrt(np.mean((seen - data)[drawn] ** 2)))
        if off > _ALIKE:
            notes.append(
                f"{film.label}: the first picture does not look like the scene at rest (root mean "
                f"square difference {off:.2f}): is it another camera, or another model?"
            )
    return notes


def solve(
    prepared: Prepared, out: Path, *, report: Callable[[str], None] | None = None
) -> tuple[Fit, Path]:
    """Fit, and write `report.md`, its pictures and `fitted.toml` into a folder.

    Returns:
        The fit and the path of the report.
    """
    case = prepared.case
    settings = case.solver
    found = fit(
        prepared.problem,
        stages=settings.stages,
        starts=settings.starts,
        trials=settings.trials,
        tolerance=settings.tolerance,
        report=report,
    )
    out.mkdir(parents=True, exist_ok=True)
    dt = prepared.problem.dt
    content = fitted_content(case, found.values, dt)
    with replacing(out / "fitted.toml") as temporary:
        temporary.write_bytes(tomli_w.dumps(content).encode())
    comparisons, told = _compared(prepared, found)
    return found, write_report(out, case, found, dt, comparisons, (*prepared.notes, *told))


def _compared(prepared: Prepared, found: Fit) -> tuple[list[Comparison], list[str]]:
    """What every observation shows of all frames, beside what is predicted; and what happened."""
    whole = prepared.whole
    u = jnp.asarray(whole.space.vector({n: found.values[n] for n in whole.space.free}))
    saved, status = whole.see(u.astype(jnp.zeros(()).dtype))
    made = []
    for seen, o in zip(saved, whole.observations, strict=True):
        frames = np.asarray(o.frames)
        made.append(
            Comparison(
                frames, np.asarray(o.data), np.asarray(seen)[frames], isinstance(o, Pictures)
            )
        )
    return made, status.messages() if whole.last > found.problem.last else []
