"""The reference of scene files: every block is read, every key is on the page."""

import ast
import copy
import itertools
import json
import pathlib
import re
import tomllib

import numpy as np
import pytest
from scene_files import ball, sphere

import pgjax.scenes
from pgjax.render import save_ply
from pgjax.scenes import SceneError, plan
from pgjax.scenes.conditions import TYPES as CONDITIONS
from pgjax.scenes.laws import FLOWS, LAWS
from pgjax.scenes.reader import Table
from pgjax.scenes.regions import SHAPES
from pgjax.scenes.schema import scene_from
from pgjax.scenes.walls import CONTACTS
from pgjax.scenes.walls import TYPES as WALLS

PAGE = (pathlib.Path(__file__).parent.parent / "docs" / "scene-files.md").read_text()
BLOCKS = [tomllib.loads(text) for text in re.findall(r"```toml\n(.*?)```", PAGE, flags=re.DOTALL)]
COMPLETE = [block for block in BLOCKS if {"model", "grid", "material"} <= block.keys()]
BASE = {**COMPLETE[0], "boundary": []}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files that the page names."""
    folder = tmp_path_factory.mktemp("page")
    save_ply(folder / "capture.ply", ball())
    save_ply(folder / "robot.ply", sphere())
    np.save(folder / "labels.npy", np.arange(200) % 6)
    for name in ("E.npy", "phase.npy"):
        np.save(folder / name, np.linspace(1e3, 2e3, 200))
    camera = {"rotation": np.eye(3).tolist(), "position": [0, 0, -2], "fx": 50.0, "fy": 50.0}
    cameras = [camera | {"img_name": f"DSC_000{i}", "width": 80, "height": 60} for i in range(2)]
    (folder / "cameras.json").write_text(json.dumps(cameras))
    (folder / "bowl.obj").write_text("")
    return folder


def read(block, folder):
    """A scene of a block, completed with the parts that it lacks."""
    return scene_from(Table("page.toml", BASE | block, folder), "page")


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_every_block_is_read(folder, number):
    assert read(BLOCKS[number], folder).materials


def test_there_are_three_complete_scenes_and_a_short_one():
    assert len(COMPLETE) == 4


@pytest.mark.parametrize("block", COMPLETE, ids=lambda block: block.get("name", "shortest"))
def test_complete_scenes_fit_together(folder, block):
    p = plan(read(block, folder))
    assert p.scene.particle_count >= 200
    assert 0 < p.dt < 0.01


METHODS = {"number", "integer", "boolean", "booleans", "text", "path", "existing_path", "vector"}
METHODS |= {"integers", "choice", "kind", "table", "optional", "tables"}
FUNCTIONS = {"field", "vector_field", "label_field"}


def known_keys():
    """The keys that the readers ask for, from their source."""
    source = pathlib.Path(pgjax.scenes.__file__).parent
    for path in sorted(source.glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            place = 0 if name in METHODS and isinstance(node.func, ast.Attribute) else 1
            if name in METHODS | FUNCTIONS and len(node.args) > place:
                key = node.args[place]
                if isinstance(key, ast.Constant) and isinstance(key.value, str):
                    yield key.value


KEYS = sorted(set(known_keys()))


def test_the_keys_are_found():
    assert {"ply", "E", "nu", "keyframes", "region", "lower", "activation", "file", "h"} <= {*KEYS}
    assert len(KEYS) > 80


@pytest.mark.parametrize("key", KEYS)
def test_every_key_is_on_the_page(key):
    assert re.search(rf"`{key}`|^{key} = |[{{,] {key} = ", PAGE, flags=re.MULTILINE)
    assert f"`{key}`" in PAGE


@pytest.mark.parametrize("name", [*LAWS, *FLOWS, *SHAPES, *WALLS, *CONDITIONS, *CONTACTS])
def test_every_name_is_on_the_page(name):
    assert f'`"{name}"`' in PAGE


def places(value, path=()):
    """The ways to everything in a parsed file."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items:
        yield (*path, key)
        if isinstance(inner, dict | list):
            yield from places(inner, (*path, key))


def changed(value, path, new):
    """A copy with another value in one place."""
    value = copy.deepcopy(value)
    inner = value
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = new
    return value


JUNK = ["x", "", "\0", -1, 0, 1.5, 10**400, float("nan"), float("inf"), True, [], {}, [{}], [[1]]]


def fault(block, folder):
    """What the reader says of a block; nothing if it takes it."""
    try:
        read(block, folder)
    except SceneError as error:
        return str(error)
    return ""


def test_junk_is_read_or_refused_but_never_crashes(folder):
    """Any value of any block replaced: the reader takes it, or names file and place."""
    everywhere = [(block, path) for block in BLOCKS for path in places(block)]
    junk = itertools.cycle(JUNK)
    said = [fault(changed(b, path, next(junk)), folder) for b, path in everywhere]
    refused = [text for text in said if text]
    assert len(refused) > 0.7 * len(said)
    assert all(text.startswith("page.toml") for text in refused)


def test_a_key_too_many_is_refused_everywhere(folder):
    for block in BLOCKS:
        tables = [path for path in places(block) if isinstance(path[-1], str)]
        for path in [(), *(path[:-1] for path in tables)]:
            with pytest.raises(SceneError, match="`zzz` is not a known key"):
                read(changed(block, (*path, "zzz"), 1), folder)
