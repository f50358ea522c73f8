"""One process that runs members one by one, or all in a sweep; requests and answers are JSON.

`python -m benchmarks.sweep.worker THREADS` serves; with a case as JSON in place of the number it
runs one member and ends, as a separate run would.
"""

import json
import sys
import time
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pgjax
from benchmarks.speed.worker import serve
from benchmarks.sweep.case import Case


def _last(scene: Any, start: Any, trajectory: Any) -> dict[str, jax.Array]:
    del scene, start
    return {"x": trajectory.final.x}


def _nothing(state: Any) -> None:
    del state


class Worker:
    """Holds one case."""

    def prepare(self, **case: Any) -> int:
        """Compile the program of one member; the number of devices."""
        self.case = Case(**case)
        self.build, self.dt = self.case.build()
        self.alone = jax.jit(self._alone)
        jax.block_until_ready(self.alone(*self._values()[0]))
        return jax.local_device_count()

    def _values(self) -> list[tuple[jax.Array, jax.Array]]:
        return [(jnp.asarray(m["E"]), jnp.asarray(m["nu"])) for m in self.case.vary]

    def _alone(self, E: jax.Array, nu: jax.Array) -> jax.Array:
        scene, state = self.build({"E": E, "nu": nu})
        return pgjax.simulate(
            scene,
            state,
            dt=self.dt,
            frames=self.case.frames,
            substeps=self.case.substeps,
            save=_nothing,
            throw=False,
        ).final.x

    def one_by_one(self, file: str | None = None, members: int | None = None) -> float:
        """Seconds of the compiled program of one member, called for one after the other."""
        values = self._values()[:members]
        began = time.perf_counter()
        x = [jax.block_until_ready(self.alone(*v)) for v in values]
        seconds = time.perf_counter() - began
        if file is not None:
            np.save(file, np.stack(x))
        return seconds

    def sweep(
        self, file: str | None = None, members: int | None = None, at_once: int | None = None
    ) -> dict[str, float]:
        """Seconds in the compiled program of a sweep, and of the whole call; members in a group."""
        case = self.case
        calls: list[int] = []
        began = time.perf_counter()
        table = pgjax.sweep(
            self.build,
            case.vary[:members],
            frames=case.frames,
            frame_dt=case.substeps * self.dt,
            measure=_last,
            dt=self.dt,
            at_once=at_once,
            progress=lambda done, _: calls.append(done),
        )
        whole = time.perf_counter() - began
        assert table.ok.all(), table.reasons()
        assert np.all(table["substeps"] == case.substeps)
        if file is not None:
            np.save(file, table["x"])
        return {"seconds": float(np.sum(table["seconds"])), "whole": whole, "calls": len(calls)}

    def answer(self, call: str, **arguments: Any) -> Any:
        """The result of one request."""
        return getattr(self, call)(**arguments)


if __name__ == "__main__":
    warnings.simplefilter("ignore", pgjax.SimulationWarning)
    if sys.argv[1].isdecimal():
        serve(int(sys.argv[1]), Worker().answer)
    else:
        worker = Worker()
        worker.prepare(**json.loads(sys.argv[1]))
