"""The command line: `pgjax run` and `pgjax info`."""

import argparse
import os
import platform
import sys
import warnings
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

# jaxlib builds that compile float scatter-add on a GPU to a compare-and-swap loop.
_SLOW_SCATTER = ("0.10.2", "0.11.0")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit status."""
    parser = _parser()
    options = parser.parse_args(arguments)
    _use_compilation_cache()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = _print_warning
            return options.command(options)
    except (ValueError, RuntimeError, OSError) as error:
        print(f"pgjax: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("pgjax: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pgjax", description="Make captured scenes move: material simulation of Gaussians."
    )
    parser.add_argument("--version", action="version", version=f"pgjax {metadata.version('pgjax')}")
    commands = parser.add_subparsers(required=True, metavar="command")

    run = commands.add_parser("run", help="simulate a scene and write a video of it")
    run.add_argument("scene", help="name of a preset, or a scene file (.toml)")
    run.add_argument("--ply", type=Path, help="a captured scene in place of the scene's own model")
    run.add_argument("--frames", type=int, help="number of frames, in place of the scene's own")
    run.add_argument("--out", type=Path, help="output folder, new or empty (default: out/NAME)")
    run.add_argument(
        "--save-ply", action="store_true", help="also write each frame as a .ply for splat viewers"
    )
    run.set_defaults(command=_run)

    info = commands.add_parser("info", help="print versions, devices and what will be used")
    info.set_defaults(command=_info)
    return parser


def _run(options: argparse.Namespace) -> int:
    # Imported here: `pgjax --help` and errors in the arguments should not wait for JAX.
    from tqdm import tqdm

    from pgjax.scenes import plan, read_scene, resolve, run, summary
    from pgjax.scenes.run import require_empty

    if options.frames is not None and options.frames < 1:
        raise ValueError(f"Argument `--frames` must be at least 1, but is {options.frames}.")
    if options.out is not None:
        require_empty(options.out)
    planned = plan(read_scene(resolve(options.scene)), ply=options.ply, frames=options.frames)
    folder = options.out or _next_folder(planned.name)
    print(summary(planned))
    with tqdm(total=planned.frames, unit="frame", file=sys.stderr) as bar:

        def show(frame: int, _: int) -> None:
            bar.update(frame - bar.n)

        video = run(planned, folder, ply_frames=options.save_ply, progress=show)
    print(f"wrote      {video}")
    return 0


def _next_folder(name: str) -> Path:
    """`out/NAME`, or `out/NAME-2`, `out/NAME-3` and so on where that is taken."""
    folder, number = Path("out") / name, 1
    while folder.exists() and any(folder.iterdir()):
        number += 1
        folder = Path("out") / f"{name}-{number}"
    return folder


def _info(options: argparse.Namespace) -> int:
    del options
    import jax
    import jax.numpy as jnp

    from pgjax.scenes import presets

    print(f"pgjax      {metadata.version('pgjax')}")
    print(f"python     {platform.python_version()} on {platform.platform()}")
    for name in ("jax", "jaxlib", "equinox", "optax", "numpy", "plyfile", "imageio-ffmpeg"):
        print(f"{name:10} {metadata.version(name)}")
    devices = jax.devices()
    print(f"devices    {', '.join(f'{d.platform} ({d.device_kind})' for d in devices)}")
    print(f"threads    {os.cpu_count()}")
    double = jnp.zeros(()).dtype == jnp.float64
    print(f"precision  {'double' if double else 'single'} (JAX_ENABLE_X64)")
    print(f"cache      {os.environ['JAX_COMPILATION_CACHE_DIR']}")
    print(f"presets    {', '.join(presets())}")
    version = metadata.version("jaxlib")
    if version in _SLOW_SCATTER and any(d.platform == "gpu" for d in devices):
        print(
            f"warning    jaxlib {version} compiles scatter-add on GPUs to a slow loop; set "
            "XLA_FLAGS=--xla_backend_extra_options=-nvptx-allow-ftz-atomics"
        )
    return 0


def _use_compilation_cache() -> None:
    """Keep compiled programs between runs, unless JAX was told where already."""
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(base / "pgjax" / "xla"))


def _print_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Warnings as one line for a person, not as a line of source."""
    del category, filename, lineno, file, line
    print(f"warning: {message}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
