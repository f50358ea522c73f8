"""Puts the site together: README, pages, notebooks and results, as they lie in the project.

Links between them are those of the project, so that they work on a forge and in the site alike.
"""

import ast
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
# What of the project the pages link to.
PARTS = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "LICENSE",
    "docs/*.md",
    "docs/images/**/*",
    "examples/*",
    "benchmarks/*/README.md",
    "benchmarks/results/*",
    "notebooks/*.md",
    "notebooks/*.ipynb",
    "pgjax/scenes/presets/*.toml",
    "tests/verification/*.py",
    "tests/*.py",
)


def on_config(config: Any) -> Any:
    """Gather the parts in a folder of their own, and list notebooks and results."""
    folder = Path(tempfile.mkdtemp(prefix="pgjax-site-"))
    config.extra["gathered"] = folder
    for pattern in PARTS:
        for source in ROOT.glob(pattern):
            if source.is_file():
                target = folder / source.relative_to(ROOT)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)
    config.docs_dir = str(folder)
    config.nav += [
        {"Notebooks": [f"notebooks/{p.name}" for p in sorted(ROOT.glob("notebooks/*.ipynb"))]},
        {
            "Measured": [
                f"benchmarks/results/{p.name}" for p in sorted(ROOT.glob("benchmarks/results/*.md"))
            ]
        },
    ]
    return config


def on_page_markdown(markdown: str, **_: Any) -> str:
    """`::: pgjax.models.*` stands for everything that the package offers, one after the other."""

    def all_of(match: re.Match) -> str:
        return "\n".join(f"::: {match[1]}.{name}" for name in _offered(match[1]))

    return re.sub(r"^::: ([\w.]+)\.\*$", all_of, markdown, flags=re.MULTILINE)


def _offered(package: str) -> list[str]:
    """Names that an `__init__.py` imports as themselves, of a module those without underscore."""
    path = ROOT / package.replace(".", "/")
    module = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    body = ast.parse(module.read_text()).body
    if path.is_dir():
        imported = (a for n in body if isinstance(n, ast.ImportFrom) for a in n.names)
        return [alias.name for alias in imported if alias.asname == alias.name]
    defined = (n.name for n in body if isinstance(n, ast.FunctionDef | ast.ClassDef))
    return [name for name in defined if not name.startswith("_")]


def on_post_build(config: Any) -> None:
    """Take the folder away."""
    shutil.rmtree(config.extra["gathered"], ignore_errors=True)
