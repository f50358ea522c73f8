"""`pgjax info`: versions, devices and what will be used."""

import argparse
import os
import platform
import warnings
from importlib import metadata
from typing import Any

# jaxlib builds that compile float scatter-add on a GPU to a compare-and-swap loop.
_SLOW_SCATTER = ("0.10.2", "0.11.0")


def add_to(commands: Any) -> None:
    """Add the command to the parser's."""
    info = commands.add_parser("info", help="print versions, devices and what will be used")
    info.set_defaults(command=_info)


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
    print(f"native     {_native()}")
    print(f"cache      {os.environ['JAX_COMPILATION_CACHE_DIR']}")
    print(f"presets    {', '.join(presets())}")
    version = metadata.version("jaxlib")
    if version in _SLOW_SCATTER and any(d.platform == "gpu" for d in devices):
        print(
            f"warning    jaxlib {version} compiles scatter-add on GPUs to a slow loop; set "
            "XLA_FLAGS=--xla_backend_extra_options=-nvptx-allow-ftz-atomics"
        )
    return 0


def _native() -> str:
    """Which kernels a CPU will run; compiles them if they are not there yet."""
    import jax.numpy as jnp

    from pgjax import native

    if not native.enabled():
        return "no (PGJAX_NATIVE=0)"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        library = native.library("transfer", jnp.zeros(()).dtype.name)
    if library is None:
        return "no: " + "; ".join(str(w.message) for w in caught)
    return f"{library.path} ({native.compiler()})"
