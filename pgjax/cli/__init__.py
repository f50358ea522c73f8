"""The command line: one module for each command of `pgjax`."""

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from pgjax.cli import convert, fit, info, init, preview, run, sweep, tune, view

_COMMANDS = (init, preview, run, convert, view, fit, sweep, tune, info)


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
    for command in _COMMANDS:
        command.add_to(commands)
    return parser


def _use_compilation_cache() -> None:
    """Keep compiled programs between runs, unless JAX was told where already."""
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(base / "pgjax" / "xla"))


def _print_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Warnings as one line for a person, not as a line of source."""
    del category, filename, lineno, file, line
    print(f"warning: {message}", file=sys.stderr)
