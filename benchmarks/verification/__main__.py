"""Run the verification cases and write what they measured: `python -m benchmarks.verification`.

Further arguments go to pytest, e.g. `python -m benchmarks.verification -k V24 -n 1`.
"""

import datetime
import json
import pathlib
import platform
import subprocess
import sys

import jax

from benchmarks.verification.plots import draw

ROOT = pathlib.Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
COMMAND = "python -m benchmarks.verification"


def table(rows: list[dict]) -> str:
    """The rows as a Markdown table."""
    lines = ["| case | quantity | value | demand | ok |", "|---|---|---|---|---|"]
    for row in rows:
        quantity = row["quantity"].replace("|", "\\|")
        ok = "yes" if row["ok"] else "**no**"
        lines.append(
            f"| {row['case']} | {quantity} | {row['value']:.3g} | {row['demand']} | {ok} |"
        )
    return "\n".join(lines) + "\n"


def report(rows: list[dict], command: str, picture: str | None) -> str:
    """The table under what is needed to repeat it, and the curves if there are any."""
    drawn = f"![Errors over the spacing of the grid]({picture}.png)\n\n" if picture else ""
    met = sum(row["ok"] for row in rows)
    return (
        "# Verification\n\n"
        f"{met} of {len(rows)} demands met. Written by `{command}` on {datetime.date.today()} with "
        f"JAX {jax.__version__}, Python {platform.python_version()}, {platform.machine()} "
        f"{jax.default_backend()}.\n\n" + drawn + table(rows)
    )


def main(arguments: list[str]) -> int:
    """Run pytest, slow cases included, and write the results beside each other."""
    RESULTS.mkdir(exist_ok=True)
    measured = RESULTS / "verification_core.json"
    measured.unlink(missing_ok=True)
    others = ("timestep", "oracle_step", "linalg", "rollout")
    cases = ["tests/verification", *(f"tests/test_{name}.py" for name in others)]
    options = ["-m", "", "--measured", str(measured), *arguments]
    code = subprocess.call([sys.executable, "-m", "pytest", *cases, *options], cwd=ROOT)
    if measured.exists():
        kept = json.loads(measured.read_text())
        rows, curves = kept["measured"], kept["curve"]
        text = report(rows, " ".join([COMMAND, *arguments]), measured.stem if curves else None)
        measured.with_suffix(".md").write_text(text)
        if curves:
            draw(curves, measured.with_suffix(".png"))
        print(f"Wrote {measured.with_suffix('.md').relative_to(ROOT)}: {len(rows)} measurements.")
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
