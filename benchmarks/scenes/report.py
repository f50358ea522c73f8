"""The stored results of the scenes: JSON, Markdown, and the gallery."""

import datetime
import json
from pathlib import Path

import jax
import numpy as np
from PIL import Image

from benchmarks.speed.report import cpu
from pgjax.render import load_video, save_image
from pgjax.scenes import Plan, presets, resolve

COMMAND = "python -m benchmarks.scenes"
_MOMENTS = (0, 1 / 3, 1)
_LIMIT = 120.0
_THUMB, _IN_A_ROW = 160, 7


def stored(path: Path) -> list[dict]:
    """The rows of before."""
    return json.loads(path.read_text())["rows"] if path.exists() else []


def law(plan: Plan) -> str:
    """The laws of a scene, each once."""
    names = []
    for material in plan.scene.materials:
        flow = material.plasticity
        plastic = f", {type(flow).__name__}" if flow else ""
        names.append(type(material.elasticity.elastic()).__name__ + plastic)
    return "; ".join(dict.fromkeys(names))


def is_green(row: dict) -> bool:
    """Whether a scene ran in time and moved as it should."""
    return row["seconds"] <= _LIMIT and all(check["holds"] for check in row["checks"])


def line(row: dict) -> str:
    """A row, for the terminal."""
    checks = "; ".join(
        f"{c['what']} {c['value']:.3g} ({c['demand']}{'' if c['holds'] else ', MISSED'})"
        for c in row["checks"]
    )
    return f"{row['scene']}: {row['seconds']:.0f} s, {checks}"


def write(path: Path, rows: list[dict]) -> None:
    """The table, as JSON and as Markdown."""
    machine = {
        "cpu": cpu(),
        "date": datetime.date.today().isoformat(),
        "jax": jax.__version__,
        "command": COMMAND,
    }
    path.write_text(json.dumps({**machine, "rows": rows}, indent=1) + "\n")
    lines = [
        "# Scenes",
        "",
        f"`{COMMAND}`; {machine['cpu']}, JAX {machine['jax']}, {machine['date']}. Each preset as "
        f"`pgjax run` runs it, drawing included, and what is measured of its motion.",
        "",
        "| scene | laws | particles | steps | frames | seconds | measured | demanded | met |",
        "|---|---|---:|---:|---:|---:|---|---|---|",
    ]
    for row in rows:
        head = [row["scene"], row["law"], *(f"{row[k]}" for k in ("particles", "steps", "frames"))]
        cells = [*head, f"{row['seconds']:.0f}"]
        for check in row["checks"]:
            met = "yes" if check["holds"] else "**no**"
            what = f"{check['what']}: {check['value']:.3g}"
            lines.append("| " + " | ".join([*cells, what, check["demand"], met]) + " |")
            cells = [""] * len(cells)
    said = [f"- {row['scene']}: {text}" for row in rows for text in row["warnings"]]
    if said:
        lines += ["", "Warnings of the runs:", "", *said]
    path.with_suffix(".md").write_text("\n".join(lines) + "\n")


def write_strip(path: Path, video: Path) -> None:
    """Three moments of a video side by side."""
    frames = load_video(video).pictures / 255
    strip = np.concatenate([frames[round(m * (len(frames) - 1))] for m in _MOMENTS], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_image(path, strip[::2, ::2] if strip.shape[0] > 480 else strip)


def write_sheet(path: Path, strips: list[Path]) -> None:
    """The middle picture of each strip, all of one height, in rows."""
    thumbs = []
    for strip in strips:
        image = Image.open(strip)
        width = image.width // 3
        middle = image.crop((width, 0, 2 * width, image.height))
        wide = round(width * _THUMB / image.height)
        thumbs.append(np.asarray(middle.resize((wide, _THUMB)))[:, _centred(wide)])
    rows = [thumbs[i : i + _IN_A_ROW] for i in range(0, len(thumbs), _IN_A_ROW)]
    sheet = np.full((len(rows) * _THUMB, _IN_A_ROW * _THUMB, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, thumb in enumerate(row):
            sheet[i * _THUMB : (i + 1) * _THUMB, j * _THUMB : (j + 1) * _THUMB] = thumb
    save_image(path, sheet / 255)


def _centred(wide: int) -> slice:
    """The columns in the middle of a picture that is at least as wide as high."""
    first = (wide - _THUMB) // 2
    return slice(first, first + _THUMB)


def write_gallery(docs: Path, rows: list[dict]) -> None:
    """The page with a picture of each scene."""
    lines = [
        "# Gallery",
        "",
        f"The {len(presets())} scenes of PhysGaussian's supplement, as `pgjax run NAME` makes",
        "them: the first frame, the one after a third of the time, and the last. Every model is",
        "made by a program, so that each scene runs as it is; `--ply` puts a capture of your own",
        "in its place, `--quality paper` takes the published resolution. What is measured of each",
        f"motion is in [the table](../benchmarks/results/scenes_cpu.md). `{COMMAND}` writes both.",
    ]
    for row in rows:
        lines += ["", f"## {row['scene']}", "", *_about(row["scene"]), ""]
        lines += [f"![{row['scene']}](images/gallery/{row['scene']}.png)"]
    (docs / "gallery.md").write_text("\n".join(lines) + "\n")
    pictures = docs / "images" / "gallery"
    write_sheet(pictures / "all.png", [pictures / f"{row['scene']}.png" for row in rows])


def _about(name: str) -> list[str]:
    """What the scene file says of itself: the comment at its top."""
    text = resolve(name).read_text().splitlines()
    end = next(i for i, line in enumerate(text) if not line.startswith("#"))
    return [line.removeprefix("#").strip() for line in text[:end]]
