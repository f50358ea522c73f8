"""The documentation site builds without a warning."""

import os
import pathlib
import subprocess
import sys

import pytest

pytest.importorskip("material", reason="needs the extra `docs`")
pytest.importorskip("mkdocs_jupyter", reason="needs the extra `docs`")

ROOT = pathlib.Path(__file__).parent.parent


def test_the_site_builds_strictly(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path)]
    # No advertisement of other programs among the warnings.
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    api = (tmp_path / "docs" / "api" / "index.html").read_text()
    for name in ("pgjax.simulate.simulate", "pgjax.models.DruckerPrager", "pgjax.boundary.Box"):
        assert f'id="{name}"' in api, name
    notebooks = list((ROOT / "notebooks").glob("*.ipynb"))
    built = [tmp_path / "notebooks" / path.stem / "index.html" for path in notebooks]
    assert all(path.exists() for path in built)
