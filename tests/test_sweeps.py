"""Sweeps: the same as single runs, whatever the grouping; failures are rows; nothing is lost."""

import csv
import json
import os
import pathlib
import socket
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from jax.core import Tracer
from test_docs import run_blocks

import pgjax
from pgjax import boundary, models, sampling
from pgjax.sweeps import sweep
from pgjax.sweeps.layout import laid_out
from pgjax.sweeps.members import combined
from pgjax.sweeps.need import needs
from pgjax.timestep import stable_dt, substeps_for

GRID = pgjax.Grid((0, 0), (12, 10), 1 / 10)
X, VOLUMES = sampling.block((0.4, 0.2), (0.8, 0.6), spacing=1 / 20)
FLOOR = boundary.Box((-9, 0.15), (9, 9), boundary.Separating(0.3))
FRAME = 0.02


def build(values):
    """A block thrown on the floor; to the right as fast as it is told."""
    jelly = models.Material(models.NeoHookean(values["E"], values.get("nu", 0.3)))
    scene = pgjax.Scene(GRID, jelly, VOLUMES, gravity=(0, -9.81), boundaries=[FLOOR])
    aside = jnp.asarray(values.get("aside", 0.0))
    v = jnp.stack([aside, -jnp.ones_like(aside)])
    return scene, pgjax.initial_state(scene, X, v)


def where(scene, start, trajectory):
    del scene, start
    return {"height": jnp.mean(trajectory.final.x[:, 1]), "x": trajectory.final.x}


def swept(vary, **more):
    given = {"frames": 4, "frame_dt": FRAME, "measure": where, "at_once": 3}
    return sweep(build, vary, **(given | more))


VARY = {"E": [1e4, 1e5], "nu": [0.1, 0.3, 0.5, 0.2]}


@pytest.fixture(scope="module")
def table():
    """Eight members, of which two cannot be simulated, in groups of three."""
    return swept(VARY)


def test_each_member_is_the_run_alone(table):
    assert table.shape == (2, 4)
    assert len(table) == 8
    for k in np.flatnonzero(table.ok):
        scene, state = build({"E": table["E"][k], "nu": table["nu"][k]})
        steps = int(table["substeps"][k])
        alone = pgjax.simulate(scene, state, dt=FRAME / steps, frames=4, substeps=steps)
        np.testing.assert_allclose(table["x"][k], alone.final.x, rtol=0, atol=_rounding())
        np.testing.assert_allclose(table["dt"][k] * steps, FRAME, rtol=1e-12)
        # Never longer than what the member alone would take.
        assert steps >= substeps_for(FRAME, stable_dt(scene, state)) - 1
    assert np.all(table.on_grid("nu") == VARY["nu"])
    assert np.all(table.on_grid("E") == np.asarray(VARY["E"])[:, None])


def _rounding():
    return 1e-12 if jnp.zeros(()).dtype == jnp.float64 else 1e-5


def test_a_member_that_cannot_be_simulated_is_a_row(table):
    failed = table["nu"] == 0.5
    assert np.array_equal(~table.ok, failed)
    for k in np.flatnonzero(failed):
        assert table["status"][k] == "failed"
        assert "`nu` must be below 0.5, but is 0.5" in table["message"][k]
        assert np.isnan(table["height"][k])
        assert np.isnan(table["substeps"][k])
    assert table.summary() == "8 members: 6 ok, 2 failed"
    assert table.reasons() == [("Argument `nu` must be below 0.5, but is 0.5.", 2)]


@pytest.mark.slow
def test_the_grouping_does_not_matter_at_one_time_step(table):
    dt = float(np.nanmin(table["dt"]))
    vary = {"E": [1e4, 1e5], "nu": [0.1, 0.3]}
    one, three, all_at_once = (swept(vary, dt=dt, at_once=n) for n in (1, 3, 4))
    for other in (one, all_at_once):
        assert np.array_equal(three["substeps"], other["substeps"])
        np.testing.assert_allclose(three["x"], other["x"], rtol=0, atol=_rounding())


def test_groups_have_members_of_like_needs():
    members = combined({"E": [1e5, 1e3, 1e4, 3e5, 3e3]})
    layout = _layout(members.values, at_once=2)
    groups = [group.tolist() for group in layout.groups()]
    assert groups == [[3, 0], [2, 4], [1]]
    need = layout.need.substeps
    # c ~ sqrt(E).
    np.testing.assert_allclose(need[3] / need[1], np.sqrt(300), rtol=0.2)


def _layout(vary, **more):
    given = dict.fromkeys(("dt", "at_once", "memory", "devices"))
    given |= {"frames": 2, "frame_dt": FRAME, "measure": where, "save": lambda state: state.x}
    return laid_out(build, vary, **(given | {"fraction": 0.5, "allow_unstable": False} | more))


def test_the_need_of_a_member_is_that_of_stable_dt():
    members = combined([{"E": 1e4, "aside": 0.0}, {"E": 1e3, "aside": 30.0}])
    found = needs(build, members, FRAME, dt=None, fraction=0.5, allow_unstable=False)
    for k, steps in enumerate(found.substeps):
        alone = substeps_for(FRAME, stable_dt(*build(members.some(k))))
        assert abs(steps - alone) <= 1
    # The second is limited by its speed.
    assert found.substeps[1] > found.substeps[0]


def test_members_that_fail_on_the_way_harm_nobody():
    """One leaves the grid, one is too fast for the time step; the third is as it is alone."""
    vary = [{"E": 1e4, "aside": a} for a in (0.0, 9.0, -25.0)]
    found = swept(vary, dt=FRAME / 24)
    assert list(found["status"]) == ["ok", "failed", "failed"]
    assert "OUT_OF_DOMAIN" in found["message"][1]
    assert "left the grid" in found["message"][1]
    alone = swept(vary[:1], dt=FRAME / 24, at_once=1)
    np.testing.assert_allclose(found["x"][0], alone["x"][0], rtol=0, atol=_rounding())


def test_a_step_above_the_bound_is_an_error_of_its_member():
    vary, dt = {"E": [1e4, 1e6]}, FRAME / 8
    found = swept(vary, dt=dt, frames=1)
    assert list(found["status"]) == ["ok", "failed"]
    assert "`dt` must be at most" in found["message"][1]
    assert "but is 0.0025 s" in found["message"][1]
    both = swept(vary, dt=dt, frames=1, allow_unstable=True)
    assert both["status"][1] != "ok"
    assert "DT_ABOVE_BOUND" in both["message"][1]


def test_an_interrupted_sweep_goes_on(table, tmp_path):
    class Enough(Exception):
        pass

    kept = []

    def keep(member, arrays):
        kept.append(member)
        np.save(tmp_path / f"{member}.npy", arrays["x"])

    def stop(done, members):
        assert members == 6
        if done == 3:
            raise Enough

    folder = tmp_path / "out"
    with pytest.raises(Enough):
        swept(VARY, folder=folder, keep=keep, progress=stop)
    first = list(kept)
    with pytest.raises(ValueError, match="holds an unfinished sweep, which goes on with `resume`"):
        swept(VARY, folder=folder)
    with pytest.raises(ValueError, match=r"these differ: `steps` .* `vary`"):
        swept({"E": [1e4, 1e5], "nu": [0.1, 0.3, 0.5, 0.25]}, folder=folder, resume=True)
    done = swept(VARY, folder=folder, keep=keep, resume=True, at_once=None)
    # Nothing is run twice, and the result has the same bits.
    assert sorted(kept) == np.flatnonzero(table.ok).tolist()
    assert set(first).isdisjoint(kept[3:])
    assert np.array_equal(done["height"], table["height"], equal_nan=True)
    for member in kept:
        assert np.array_equal(np.load(tmp_path / f"{member}.npy"), table["x"][member])
    assert sorted(p.name for p in folder.iterdir()) == ["sweep.csv"]
    with pytest.raises(ValueError, match="is finished"):
        swept(VARY, folder=folder, resume=True)
    with pytest.raises(ValueError, match="must be a new or an empty folder"):
        swept(VARY, folder=folder)


def test_the_table_on_disk_is_exact(table, tmp_path):
    table.to_csv(tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    for name in ("E", "nu", "height", "dt"):
        values = np.asarray([float(row[name]) for row in rows], table[name].dtype)
        assert np.array_equal(values, table[name], equal_nan=True)
    assert rows[2]["message"] == "Argument `nu` must be below 0.5, but is 0.5."
    assert rows[0]["substeps"] == str(int(table["substeps"][0]))
    assert list(rows[0]) == list(table.columns)
    assert table.rows[1]["E"] == 1e4
    with pytest.raises(KeyError, match="There is no column 'hight', but E, nu, height"):
        table["hight"]


def test_vectors_have_a_column_for_each_number(tmp_path):
    members = combined({"v": [(0, -1), (0, -2)], "E": [1e4]})
    assert members.shape == (2, 1)
    assert members.values["v"].shape == (2, 2)

    def thrown(values):
        scene, _ = build(values)
        return scene, pgjax.initial_state(scene, X, values["v"])

    found = sweep(thrown, {"v": [(0, -1), (0, -2)], "E": [1e4]}, frames=1, frame_dt=FRAME)
    found.to_csv(tmp_path / "t.csv")
    header, first, *_ = (tmp_path / "t.csv").read_text().splitlines()
    assert header.startswith("v.x,v.y,E,mean_height,lowest,highest,extent_x,extent_y,largest_disp")
    assert first.startswith("0,-1,10000,")
    # What is thrown faster has more energy.
    assert found["kinetic_energy"][1] > 2 * found["kinetic_energy"][0]
    assert np.all(found["at_rest"] == 0)
    assert np.all(found["plastic_part"] == 0)


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({}, "at least one parameter"),
        ([], "at least one dict"),
        ({"E": []}, "a sequence of finite numbers"),
        ({"E": [1e4, float("nan")]}, "a sequence of finite numbers"),
        ({"E": 1e4}, "a sequence of finite numbers"),
        ({"E": ["stiff"]}, "a sequence of finite numbers"),
        ([{"E": 1e4}, {"nu": 0.3}], "member 1 is"),
        ("E", "a dict of values by name"),
        ({name: range(2000) for name in "abc"}, "2000 x 2000 x 2000 values"),
    ],
)
def test_what_is_varied_is_checked(vary, message):
    with pytest.raises(ValueError, match=message):
        combined(vary)


def test_arguments_are_checked(tmp_path):
    for more, message in (
        ({"frames": 0}, "`frames` must be a whole number"),
        ({"at_once": 0}, "`at_once` must be a whole number"),
        ({"frame_dt": 0.0}, "`frame_dt` must be positive"),
        ({"memory": -1.0}, "`memory` must be positive"),
        ({"memory": 10.0, "at_once": None}, "`memory` must be at least"),
        ({"share": (0, 2)}, "`folder` must be given"),
        ({"share": (2, 2), "folder": tmp_path}, "0 ≤ i < n"),
        ({"resume": True, "folder": tmp_path}, "holds none"),
    ):
        with pytest.raises(ValueError, match=message):
            swept({"E": [1e4]}, **more)


def test_memory_bounds_the_groups():
    vary = {"E": np.geomspace(1e4, 2e4, 12)}
    one = _layout(vary).bytes_per_member
    # Frames that are saved count.
    assert one > 3 * X.size * jnp.zeros(()).dtype.itemsize
    for fit in (1, 3):
        assert _layout(vary, memory=(fit + 0.5) * one).lanes <= fit


@pytest.mark.float64
def test_two_processes_with_two_devices_each_do_the_same(tmp_path):
    """Simulated devices, a group on each; hosts of `jax.distributed` that share a folder."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    code = tmp_path / "shared.py"
    code.write_text(SHARED)
    environment = {
        **os.environ,
        "JAX_ENABLE_X64": "1",
        "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
        "PYTHONPATH": str(pathlib.Path(__file__).parent),
    }
    out = tmp_path / "out"
    processes = [
        subprocess.Popen(
            [sys.executable, str(code), address, index, str(out)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for index in "01"
    ]
    told = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], told
    found = [json.loads(text.splitlines()[-1]) for text, _ in told]
    assert [one["devices"] for one in found] == [2, 2]
    # Who ends last has all of them, and has written the table.
    assert min(one["pending"] for one in found) == 0
    alone = swept(VARY, **ONE_BY_ONE)
    with (out / "sweep.csv").open(encoding="utf-8", newline="") as file:
        heights = [float(row["height"]) for row in csv.DictReader(file)]
    np.testing.assert_allclose(heights, alone["height"], rtol=0, atol=1e-12)


ONE_BY_ONE = {"dt": FRAME / 8, "at_once": 1}
SHARED = """
import json, sys
import jax
address, index, out = sys.argv[1:]
jax.distributed.initialize(address, 2, int(index))
from test_sweeps import ONE_BY_ONE, VARY, swept
table = swept(VARY, folder=out, **ONE_BY_ONE)
print(json.dumps({"devices": len(jax.local_devices()), "pending": table.pending}))
"""


def test_a_sweep_of_which_nothing_can_be_simulated_has_its_table(tmp_path):
    found = swept({"E": [-1.0, 0.0]}, folder=tmp_path / "out")
    assert not found.ok.any()
    first, second = found["message"]
    assert "`E` must be positive and finite (Pa), but is -1.0" in first
    assert "but is 0.0" in second
    assert len((tmp_path / "out" / "sweep.csv").read_text().splitlines()) == 3


def test_the_page():
    names = run_blocks(pathlib.Path(__file__).parent.parent / "docs" / "sweeps.md")
    assert names["heights"].shape == (3, 4)
    assert names["table"].ok.all()
    # What yields more flows more, and ends lower.
    assert np.all(np.diff(names["table"].on_grid("plastic_part"), axis=1) <= 0)
    thrown = names["thrown"]
    assert list(thrown.ok) == [True, True, False]
    assert thrown["rebound"][0] > thrown["rebound"][1]
    assert thrown["speeds"].shape == (3, 11)
    assert "`E` must be positive" in thrown["message"][2]


def test_shares_without_jax_distributed(table, tmp_path):
    """One after the other, as jobs of an array: the last one writes the table."""
    first = swept(VARY, folder=tmp_path / "out", share=(1, 2))
    assert first.pending == 3
    assert not (tmp_path / "out" / "sweep.csv").exists()
    assert np.array_equal(first["height"][first.ok], table["height"][first.ok])
    last = swept(VARY, folder=tmp_path / "out", share=(0, 2))
    assert last.pending == 0
    assert np.array_equal(last["height"], table["height"], equal_nan=True)
    assert (tmp_path / "out" / "sweep.csv").exists()


def test_few_scenes_are_built_to_find_those_that_cannot_be():
    built = []

    def counted(values):
        if jnp.ndim(values["E"]) == 0 and not isinstance(values["E"], Tracer):
            built.append(float(values["E"]))
        return build(values)

    # Ends that are refused, also for the sake of another parameter; what lies between is not asked.
    stiffness = [-2.0, 0.0, *np.linspace(1e4, 2e4, 50)]
    members = combined({"E": stiffness, "nu": [0.5, 0.3, 0.2]})
    found = needs(counted, members, FRAME, dt=None, fraction=0.5, allow_unstable=False)
    unusable = (members.values["E"] <= 0) | (members.values["nu"] == 0.5)
    assert np.array_equal(found.substeps == 0, unusable)
    assert sorted(found.errors) == np.flatnonzero(unusable).tolist()
    assert "`E` must be positive" in found.errors[1]
    assert "`nu` must be below 0.5" in found.errors[6]
    assert set(built) >= {-2.0, 0.0, 1e4, 2e4}
    assert len(built) < len(members) / 2
