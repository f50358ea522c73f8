"""Run the verification cases and write what they measured: `python -m benchmarks.verification`.

Further arguments go to pytest, e.g. `python -m benchmarks.verification -k V24 -n 1`.
"""

import datetime
import json
import os
import pathlib
import platform
import subprocess
import sys
import tempfile

import jax

from benchmarks.verification.plots import draw

ROOT = pathlib.Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
COMMAND = "python -m benchmarks.verification"
# Where the tests are that keep the outcome of a hard case.
ELSEWHERE = ("failures", "linalg", "model_limits", "rollout", "timestep")
HARD = ["tests/hard", *(f"tests/test_{name}.py" for name in ELSEWHERE)]


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


def matrix(hard: list[dict]) -> str:
    """What held in the hard cases, by case, material and precision, as a Markdown table."""
    precisions = sorted({row["precision"] for row in hard})
    outcomes: dict[tuple[str, str, str], list[list[str]]] = {}
    for row in hard:
        key = row["case"], row["what"], row["material"]
        cells = outcomes.setdefault(key, [[] for _ in precisions])
        cell = cells[precisions.index(row["precision"])]
        if row["outcome"] not in cell:
            cell.append(row["outcome"])
    # Materials with the same outcome share a line.
    lines: dict[tuple[str, ...], list[str]] = {}
    for (case, what, material), cells in outcomes.items():
        lines.setdefault((case, what, *("; ".join(c) for c in cells)), []).append(material)
    table = [
        "| case | what is demanded | material | " + " | ".join(precisions) + " |",
        "|---|---|---|" + "---|" * len(precisions),
    ]
    for (case, what, *cells), materials in sorted(lines.items()):
        named = ", ".join(m for m in dict.fromkeys(materials) if m != "any")
        what = what.replace("|", "\\|")
        table.append(f"| {case} | {what} | {named} | {' | '.join(cells)} |")
    return "\n".join(table) + "\n"


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


def pytest(
    cases: list[str], arguments: list[str], *, marked: str = "", float32: bool = False
) -> tuple[int, dict]:
    """Run tests, slow ones included: the exit status, and what they kept."""
    with tempfile.TemporaryDirectory() as folder:
        kept = pathlib.Path(folder) / "kept.json"
        options = ["-m", marked, "--measured", str(kept), *arguments]
        env = {**os.environ, "PGJAX_TEST_FLOAT32": str(int(float32))}
        command = [sys.executable, "-m", "pytest", *cases, *options]
        code = subprocess.call(command, cwd=ROOT, env=env)
        return code, json.loads(kept.read_text()) if kept.exists() else {}


def verify(arguments: list[str]) -> int:
    """The verification cases: `verification_core.json`, `.md` and `.png`."""
    others = ("timestep", "oracle_step", "linalg", "rollout")
    cases = ["tests/verification", *(f"tests/test_{name}.py" for name in others)]
    code, kept = pytest(cases, arguments)
    rows, curves = kept.get("measured", []), kept.get("curve", [])
    if rows:
        path = RESULTS / "verification_core.json"
        path.write_text(json.dumps({"measured": rows, "curve": curves}, indent=1) + "\n")
        text = report(rows, " ".join([COMMAND, *arguments]), path.stem if curves else None)
        path.with_suffix(".md").write_text(text)
        if curves:
            draw(curves, path.with_suffix(".png"))
        print(f"Wrote {path.with_suffix('.md').relative_to(ROOT)}: {len(rows)} measurements.")
    return code


def verify_hard_cases(arguments: list[str]) -> int:
    """The hard cases in both precisions: `verification_hard.json` and `.md`."""
    codes, rows = [], []
    for float32 in (False, True):
        code, kept = pytest(HARD, arguments, marked="hard", float32=float32)
        codes.append(code)
        rows += kept.get("hard", [])
    if rows:
        path = RESULTS / "verification_hard.json"
        path.write_text(json.dumps(rows, indent=1) + "\n")
        command = " ".join([COMMAND, *arguments])
        about = f"# Hard cases\n\nWritten by `{command}` on {datetime.date.today()}.\n\n"
        path.with_suffix(".md").write_text(about + matrix(rows))
        print(f"Wrote {path.with_suffix('.md').relative_to(ROOT)}: {len(rows)} outcomes.")
    return max(codes)


def main(arguments: list[str]) -> int:
    """Both, and what they measured beside each other."""
    RESULTS.mkdir(exist_ok=True)
    return max(verify(arguments), verify_hard_cases(arguments))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
