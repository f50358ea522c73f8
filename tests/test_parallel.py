"""One scene over eight simulated devices does what it does on one (`parallel_cases.py`)."""

import functools
import json
import os
import pathlib
import re
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest

import pgjax
from pgjax import models, parallel, sampling

pytestmark = pytest.mark.float64
HERE = pathlib.Path(__file__).parent


@functools.cache
def found(*cases, native_kernels=True):
    """What the cases measure, in one process of their own."""
    path = os.pathsep.join([str(HERE), str(HERE.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    if not native_kernels:
        environment["PGJAX_NATIVE"] = "0"
    command = [sys.executable, str(HERE / "parallel_cases.py"), *cases]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-3000:]
    lines = map(json.loads, run.stdout.strip().splitlines())
    return {line.pop("case"): line for line in lines}


def quick(case):
    """What one of the cheap cases measures: they share a process."""
    return found("bar_forward", "overflow")[case]


def slower(case):
    """What one of the others measures: they share another one."""
    return found("laws", "periodic")[case]


def test_a_bar_that_crosses_slabs():
    """Both ways to share it, the slabs looked at every third step only; going on after a frame."""
    check_bar(quick("bar_forward"))


@pytest.mark.slow
def test_the_same_in_plain_jax():
    check_bar(found("bar_forward", native_kernels=False)["bar_forward"])


def check_bar(case):
    assert case["crossed"] > 0.3
    for name in ("shared", "slabs"):
        assert case[name] < 1e-10
        assert case[f"{name} saved"] < 1e-10


@pytest.mark.slow
def test_laws_and_conditions():
    """Three laws, forces and prescribed motion; a particle that leaves is counted once."""
    case = slower("laws")
    assert case["lost"] == 1
    assert case["status"] == 0
    assert case["slabs"] < 1e-10


@pytest.mark.slow
def test_periodic_direction():
    """Around the seam, with derivatives by stiffness and velocity."""
    case = slower("periodic")
    assert case["around"] > 0.05
    assert case["slabs"] < 1e-10
    assert case["slopes"] < 1e-9


@pytest.mark.slow
def test_gradients():
    """Plastic, in both modes, against one device and differences."""
    case = found("bar_gradients")["bar_gradients"]
    for name in ("shared", "slabs"):
        assert case[name] < 1e-9
        assert case[f"{name} forward mode"] < 1e-9
        assert case[f"{name} differences"] < 1e-5


@pytest.mark.slow
def test_accounts():
    """Two more laws, per-particle parameters, bodies that move, all conditions, a ledger."""
    case = found("mixed")["mixed"]
    assert case["lost"] == 1
    for name in ("shared", "slabs"):
        assert case[f"{name} status"] == 0
        assert case[name] < 1e-10


def test_overflow_is_named():
    """Particles without a place are masked and counted, each once; nothing else happens."""
    case = quick("overflow")
    assert case["counted"] == case["masked"] > 0
    assert case["others"] == 0
    assert case["finite"]
    assert "OVERFLOW" in case["message"]
    assert "`capacity`" in case["message"]


@pytest.mark.slow
def test_the_page():
    """The code of `docs/large-scenes.md` runs; its two layouts agree, its links lead somewhere."""
    page = HERE.parent / "docs" / "large-scenes.md"
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
        exec(compile(block, str(page), "exec"), names)
    np.testing.assert_allclose(names["slabs"], names["shared"], rtol=1e-12)
    assert abs(names["slope"]) > 0
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target


TWO = """
import sys, jax
jax.distributed.initialize("localhost:" + sys.argv[2], 2, int(sys.argv[1]))
import pgjax
from pgjax import models, parallel, sampling
grid = pgjax.Grid((0, 0), (16, 8), 1 / 16)
x, volumes = sampling.block((0.3, 0.2), (0.7, 0.4), spacing=1 / 32)
scene = pgjax.Scene(grid, models.Material(models.NeoHookean(1e4, 0.3)), volumes, gravity=(1, -9))
state = pgjax.initial_state(scene, x)
run = dict(dt=1e-4, frames=1, substeps=20, layout=parallel.Slabs())
print(len(jax.devices()), *parallel.simulate(scene, state, **run).saved.x[-1].mean(axis=0))
"""


@pytest.mark.slow
def test_two_processes():
    """Found by JAX's own runtime, each with one device."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    command = [sys.executable, "-c", TWO]
    both = [
        subprocess.Popen([*command, str(i), port], stdout=subprocess.PIPE, text=True)
        for i in range(2)
    ]
    said = [process.communicate(timeout=120)[0].splitlines()[-1] for process in both]
    assert said[0] == said[1]
    devices, x, y = map(float, said[0].split())
    assert devices == 2
    np.testing.assert_allclose([x, y], [0.5 + 2e-6, 0.3 - 18e-6], rtol=0, atol=1e-6)


def scene_and_state():
    grid = pgjax.Grid((0, 0), (16, 8), 1 / 16)
    x, volumes = sampling.block((0.3, 0.2), (0.7, 0.4), spacing=1 / 32)
    scene = pgjax.Scene(grid, models.Material(models.NeoHookean(1e4, 0.3)), volumes)
    return scene, pgjax.initial_state(scene, x)


def share(layout=None, devices=None):
    scene, state = scene_and_state()
    run = {"dt": 1e-4, "frames": 1, "substeps": 1}
    return parallel.simulate(scene, state, devices=devices, layout=layout, **run)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: share(devices=()), "`devices` must hold devices of JAX"),
        (lambda: share(devices=jax.devices()[:1] * 2), "`devices` must name each device once"),
        (lambda: parallel.Slabs(every=0), "`every` must be a whole number ≥ 1"),
        (lambda: parallel.Slabs(margin=-1), "`margin` must be a whole number ≥ 0"),
        (lambda: share(parallel.Slabs(axis=2)), "`axis` must be a direction from 0 to 1"),
        (lambda: share(parallel.Slabs(starts=(3, 8))), "`starts` must hold 0 cells"),
        (lambda: share(parallel.Slabs(capacity=3)), r"`capacity` must be at least \(\d+,\)"),
        (lambda: share(parallel.Slabs(capacity=(500, 500))), "`capacity` must be at least"),
        (lambda: share(parallel.Slabs(margin=7)), "`devices` must be at most 0 for slabs of"),
        (lambda: parallel.simulate(*few(), dt=1e-4, frames=1, substeps=1), "at least 4 particles"),
    ],
)
def test_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def few():
    scene, state = scene_and_state()
    scene = pgjax.Scene(scene.grid, scene.materials, scene.volumes[:3])
    return scene, pgjax.initial_state(scene, state.x[:3])


def test_cuts_hold_equally_many():
    """Slabs are balanced as far as their smallest width allows."""
    scene, state = scene_and_state()
    edges = parallel.Slabs().planned(scene, state, 2).edges
    layers = np.floor(np.asarray(state.position[:, 0]) * 16)
    assert edges[0] == 0
    assert edges[-1] == 16
    assert abs(np.mean(layers < edges[1]) - 0.5) < 0.2
    thin = parallel.Slabs().planned(scene, state, 3).edges
    assert min(np.diff(thin)) >= 5
