"""The code in the documentation runs, and says what it claims."""

import pathlib
import re

import jax.numpy as jnp
import numpy as np
import pytest

ROOT = pathlib.Path(__file__).parent.parent


def run_blocks(path, **given):
    """Run the Python blocks of a page one after the other; returns their names."""
    names = {"__name__": "docs", **given}
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


@pytest.mark.float64
def test_quick_start():
    names = run_blocks(ROOT / "docs" / "quick-start.md")
    assert names["softer"] != names["stiffer"]
    ahead, behind = (names["height"](1e4 + step) for step in (1.0, -1.0))
    np.testing.assert_allclose(names["slope"], (ahead - behind) / 2, rtol=1e-3)


@pytest.mark.float64
def test_gradients_and_memory():
    names = run_blocks(ROOT / "docs" / "gradients-and-memory.md")
    np.testing.assert_allclose(names["along"], names["by_E"], rtol=1e-10)
    assert names["by_every_velocity"].shape == names["state"].v.shape


@pytest.mark.float64
def test_extend():
    names = run_blocks(ROOT / "docs" / "extend.md")
    assert all(jnp.isfinite(slope) for slope in names["slopes"])
    assert all(slope != 0 for slope in names["slopes"])


@pytest.mark.float64
def test_rendering(tmp_path):
    names = run_blocks(ROOT / "docs" / "rendering.md", folder=tmp_path)
    np.testing.assert_allclose(names["image"].rgb, names["same"].rgb, atol=1e-5)
    assert float(jnp.abs(names["slope"]).max()) > 0
    # What is looked at is in the centre.
    pixels, _ = names["centred"].project(jnp.zeros((1, 3), names["means"].dtype))
    np.testing.assert_allclose(pixels, [[32, 24]], atol=1e-3)
    np.testing.assert_allclose(names["film"][0], names["images"].rgb[0], atol=1e-3)
    assert float(jnp.abs(names["pull"]).max()) > 0
    assert (tmp_path / "film.mp4").stat().st_size > 0
    seen = np.asarray(names["seen"])
    assert seen.any()
    assert set(np.unique(names["label_map"])) <= {-1, 0, 1, 2}
    # The camera looks along −x: what moves by +0.02 in x, y and z goes to the right and up.
    flow = np.asarray(names["flow_map"])[seen]
    assert flow[:, 0].min() > 0
    assert flow[:, 1].max() < 0
    lengths = np.linalg.norm(np.asarray(names["normal_map"])[seen], axis=-1)
    np.testing.assert_allclose(lengths, 1, atol=1e-3)


@pytest.mark.float64
def test_identification():
    names = run_blocks(ROOT / "docs" / "identification.md")
    for found in (names["found"], names["staged"]):
        np.testing.assert_allclose(found.values["E"], 2e4, rtol=0.1)
    interval = names["interval"]
    assert interval.low < 2e4 < interval.high
    history = names["trained"].history
    assert names["trained"].cost < 0.5 * history[0].cost


PAGES = ("conventions", "design", "extend", "identification", "rendering", "scene-files", "viewer")


@pytest.mark.parametrize("page", ["README.md", *(f"docs/{page}.md" for page in PAGES)])
def test_links(page):
    path = ROOT / page
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        assert (path.parent / target).exists(), f"{page} links to {target}"


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    links = re.findall(r"\]\(\s*([^)\s]+)\s*\)", text)
    for link in links:
        if link.startswith(("http://", "https://")):
            continue
        file, _, anchor = link.partition("#")
        target = page if not file else page.parent / file
        assert target.exists(), link
        if anchor:
            heads = re.findall(r"^#+ (.*)$", target.read_text(), flags=re.MULTILINE)
            known = {
                re.sub(r"[^\w -]", "", head).strip().lower().replace(" ", "-") for head in heads
            }
            assert anchor in known, link


def test_the_readme_shows_every_page():
    linked = set(re.findall(r"\(docs/([\w-]+\.md)", (ROOT / "README.md").read_text()))
    assert linked == {page.name for page in PAGES[1:]}
