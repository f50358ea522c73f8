"""The code in the documentation runs, and says what it claims."""

import pathlib
import re

import jax.numpy as jnp
import numpy as np
import pytest

ROOT = pathlib.Path(__file__).parent.parent


def run_blocks(path):
    """Run the Python blocks of a page one after the other; returns their names."""
    names = {"__name__": "docs"}
    blocks = re.findall(r"```python\n(.*?)```", path.read_text(), flags=re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, str(path), "exec"), names)
    return names


def test_readme():
    names = run_blocks(ROOT / "README.md")
    step = 1.0
    ahead, behind = (names["final_height"](2e4 + s) for s in (step, -step))
    np.testing.assert_allclose(names["slope"], (ahead - behind) / (2 * step), rtol=0.02)
    # A stiffer block stands higher under its weight.
    assert names["heights"].shape == (4,)
    assert float(names["height"]) > 0.1


def test_extend():
    names = run_blocks(ROOT / "docs" / "extend.md")
    assert all(jnp.isfinite(slope) for slope in names["slopes"])
    assert all(slope != 0 for slope in names["slopes"])


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        "docs/conventions.md",
        "docs/design.md",
        "docs/scene-files.md",
        "docs/viewer.md",
    ],
)
def test_links(page):
    path = ROOT / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        assert (path.parent / target).exists(), f"{page} links to {target}"
