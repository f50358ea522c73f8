"""The native kernels: built, cached, refused where they are not whole, done without."""

import os
import shutil
import stat
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pgjax import linalg, native

HERE = Path(__file__).parent
needs_compiler = pytest.mark.skipif(native.compiler() is None, reason="no C++ compiler")


@pytest.mark.float64
@needs_compiler
@pytest.mark.parametrize("name", ["check", pytest.param("check_exchange", marks=pytest.mark.slow)])
def test_kernels_outside_of_jax(tmp_path, name):
    """Equal bit by bit with 1, 2, 3 and 8 threads; particles outside and NaN take no part."""
    program = tmp_path / name
    sources = [f"-I{HERE.parent / 'pgjax' / 'native'}", str(HERE / "native" / f"{name}.cc")]
    options = ["-std=c++17", "-O0", "-march=native", "-pthread"]
    subprocess.run([native.compiler(), *options, *sources, "-o", str(program)], check=True)
    run = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert run.stdout == "equal\n"


@needs_compiler
def test_eigenbasis_of_both(monkeypatch):
    """Native and plain: random, equal, opposite and extreme eigenvalues, any batch; NaN stays."""
    monkeypatch.setenv("PGJAX_NATIVE", "1")
    jax.clear_caches()
    assert native.library("eigen", jnp.zeros(()).dtype.name) is not None
    rng = np.random.default_rng(0)
    A = rng.normal(size=(5, 7, 3, 3))
    A[0, :3] = np.eye(3), np.zeros((3, 3)), np.diag([1, -1, 1])
    A[1] *= 1e-18
    A[2] *= 1e18
    A = jnp.asarray(A + np.swapaxes(A, -1, -2), jnp.zeros(()).dtype)
    # The inner vmap along the first axis: a batch axis that has to be moved.
    w, Q = jax.jit(jax.vmap(jax.vmap(linalg.eigenbasis), in_axes=1, out_axes=1))(A)
    plain, _ = jax.jit(jax.vmap(jax.vmap(linalg._eigenbasis)))(A)
    size = jnp.max(jnp.abs(A), axis=(-1, -2))
    eps = float(jnp.finfo(A.dtype).eps)
    assert jnp.all(jnp.abs(w - plain) <= 16 * eps * size[..., None])
    back = jnp.einsum("abij,abj,abkj->abik", Q, w, Q)
    assert jnp.all(jnp.abs(back - A) <= 32 * eps * size[..., None, None])
    assert jnp.all(jnp.isnan(jax.jit(linalg.eigenbasis)(jnp.full((3, 3), jnp.nan))[0]))


@needs_compiler
def test_svd_of_both(monkeypatch):
    """Native and plain: any rank and sign, equal values, extreme sizes; U and V are rotations."""
    monkeypatch.setenv("PGJAX_NATIVE", "1")
    jax.clear_caches()
    dtype = jnp.zeros(()).dtype
    rng = np.random.default_rng(1)
    F = rng.normal(size=(200, 3, 3))
    F[:4] = np.eye(3), np.zeros((3, 3)), np.diag([1, 1, -1]), np.outer([1, 2, 3], [3, 0, 1])
    F[4:8, :, 2] = 0
    F[8:12] *= 1e-18
    F[12:16] *= 1e18
    F = jnp.asarray(F, dtype)
    compiled = jax.jit(jax.vmap(linalg.svd))
    assert "pgjax_svd_" in compiled.lower(F).as_text()
    U, sigma, V = compiled(F)
    plain = jax.jit(jax.vmap(linalg._svd))(F)[1]
    size, eps = jnp.max(jnp.abs(F), axis=(-1, -2)), float(jnp.finfo(dtype).eps)
    assert jnp.all(jnp.abs(sigma - plain) <= 16 * eps * size[:, None])
    back = jnp.einsum("pij,pj,pkj->pik", U, sigma, V)
    assert jnp.all(jnp.abs(back - F) <= 32 * eps * size[:, None, None])
    for R in (U, V):
        np.testing.assert_allclose(
            R @ jnp.swapaxes(R, 1, 2), np.tile(np.eye(3), (200, 1, 1)), atol=32 * eps
        )
        np.testing.assert_allclose(jnp.linalg.det(R), 1, atol=32 * eps)


def test_without_jit():
    """`jax.disable_jit` is how users look into a step."""
    with jax.disable_jit():
        w, _ = linalg.eigenbasis(jnp.diag(jnp.asarray([1.0, 3.0, 2.0])))
    assert np.allclose(w, [3, 2, 1])


@needs_compiler
def test_a_library_that_lacks_a_kernel_is_not_used(monkeypatch):
    monkeypatch.setenv("PGJAX_NATIVE", "1")
    monkeypatch.setitem(native.HANDLERS, "eigen", ("eigenbasis", "svd", "missing"))
    native._warn.cache_clear()
    with pytest.warns(native.NativeWarning, match="pgjax_missing"):
        assert native._library.__wrapped__("eigen", "float32", 3) is None
    native._warn.cache_clear()


@pytest.fixture
def fake_compiler(tmp_path, monkeypatch):
    """A compiler that counts its calls and writes a few bytes."""
    monkeypatch.setenv("PGJAX_CACHE_DIR", str(tmp_path / "cache"))
    script = tmp_path / "fake-c++"
    script.write_text(
        "#!/bin/sh\n"
        f"echo call >> {tmp_path}/calls\n"
        f"if [ -f {tmp_path}/broken ]; then echo 'no space left' >&2; exit 1; fi\n"
        'while [ "$1" != -o ]; do shift; done\n'
        'echo "machine code" > "$2"\n'
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    return script


def calls(compiler):
    path = compiler.parent / "calls"
    return len(path.read_text().splitlines()) if path.exists() else 0


def test_a_library_is_built_once_and_loaded_only_whole(fake_compiler):
    def build():
        return native._built(str(fake_compiler), (), "transfer", "key")

    path = build()
    assert path.read_text() == "machine code\n"
    assert build() == path
    assert calls(fake_compiler) == 1
    # Cut short, changed, or without its seal: built again.
    seal = path.with_suffix(".sha256")
    for spoil in (
        lambda: path.write_text("machine"),
        lambda: path.write_text("other code\n"),
        seal.unlink,
        lambda: seal.write_text(""),
        path.unlink,
    ):
        before = calls(fake_compiler)
        spoil()
        assert build().read_text() == "machine code\n"
        assert calls(fake_compiler) == before + 1
    assert sorted(p.name for p in path.parent.iterdir()) == ["key.sha256", "key.so"]


def test_a_failed_build_leaves_nothing(fake_compiler):
    (fake_compiler.parent / "broken").touch()
    with pytest.raises(subprocess.CalledProcessError) as error:
        native._built(str(fake_compiler), (), "transfer", "key")
    assert "no space left" in error.value.stderr
    assert list((fake_compiler.parent / "cache").iterdir()) == []


@needs_compiler
def test_the_key_names_all_that_the_code_depends_on(monkeypatch, tmp_path):
    found, changed = native.compiler(), tmp_path / "native"
    shutil.copytree(native._HERE, changed)
    (changed / "eigen.h").write_text((changed / "eigen.h").read_text() + "// another line")
    keys = [native._key(found, (level,), "eigen") for level in ("-O3", "-O2")]
    for name, value in (
        ("_cpu", lambda: "another CPU"),
        ("version", lambda package: f"another {package}"),
        ("_HERE", changed),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(native, name, value)
            keys.append(native._key(found, ("-O3",), "eigen"))
    assert len(set(keys)) == len(keys)
    assert native._key(found, ("-O3",), "eigen") == keys[0]


RUN = """
    import warnings
    import jax, numpy as np
    import pgjax
    from pgjax import models, native, sampling

    x, volumes = sampling.block((0.3,) * 3, (0.5,) * 3, 0.02)
    scene = pgjax.Scene(
        pgjax.Grid((0, 0, 0), (16, 16, 16), 1 / 16),
        models.Material(models.NeoHookean(1e5, 0.3)), volumes, gravity=(0, 0, -9.8),
    )
    state = pgjax.initial_state(scene, x, v=(1.0, 0.0, 0.0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for frames in (2, 3):
            end = pgjax.simulate(scene, state, dt=1e-3, frames=frames, substeps=5).final
    print(np.asarray(end.x).astype(float).tobytes().hex())
    print([str(w.message) for w in caught if w.category is native.NativeWarning])
"""


def outcome(tmp_path, **variables):
    """Positions at the end as bytes in hexadecimal, and the list of warnings as text."""
    script = tmp_path / "run.py"
    script.write_text(textwrap.dedent(RUN))
    run = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, "PGJAX_NATIVE": "1", "PGJAX_CACHE_DIR": str(tmp_path), **variables},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    positions, warned = run.stdout.splitlines()
    return positions, warned


def test_without_a_compiler_it_says_so_once(tmp_path):
    """Nothing found, nothing that works, or not wanted: plain JAX, the same to the last bit."""
    wished, silent = outcome(tmp_path, PGJAX_NATIVE="0")
    assert silent == "[]"
    missing, warned = outcome(tmp_path, PATH="", CXX="")
    assert missing == wished
    assert warned.count("several times slower: no C++ compiler was found") == 1
    failing = shutil.which("false")
    broken, warned = outcome(tmp_path, CXX=str(failing))
    assert broken == wished
    assert warned.count(f"building or loading them with {failing}") == 1
