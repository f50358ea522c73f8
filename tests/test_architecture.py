"""The rules of the house that no linter knows."""

import importlib
import inspect
import pkgutil
import subprocess
import sys

import equinox as eqx

import pgjax

MODULES = [
    importlib.import_module(info.name) for info in pkgutil.walk_packages(pgjax.__path__, "pgjax.")
]


def own_classes():
    for module in MODULES:
        for _, cls in inspect.getmembers(module, inspect.isclass):
            if cls.__module__ == module.__name__:
                yield cls


def test_modules_are_found():
    assert {"pgjax.step", "pgjax.models.elasticity", "pgjax.render.ply"} <= {
        module.__name__ for module in MODULES
    }


def test_records_are_abstract_or_final():
    for cls in own_classes():
        if issubclass(cls, eqx.Module):
            assert cls.__name__.startswith("Abstract") or getattr(cls, "__final__", False), cls


def test_nothing_inherits_from_a_concrete_class():
    for cls in own_classes():
        for base in cls.__mro__[1:]:
            if issubclass(cls, eqx.Module) and base.__module__.startswith("pgjax"):
                assert base.__name__.startswith("Abstract"), f"{cls.__name__} < {base.__name__}"


def test_final_methods_are_not_overridden():
    """A template of an abstract class, marked `@final`, stays as it is."""
    templates = set()
    for cls in own_classes():
        for base in cls.__mro__:
            for name, method in vars(base).items():
                if inspect.isfunction(method) and getattr(method, "__final__", False):
                    templates.add(name)
                    overrides = base is not cls and name in vars(cls)
                    assert not overrides, f"{cls.__name__} overrides {name}"
    assert "return_map" in templates


def test_public_names_are_documented():
    for module in MODULES:
        assert module.__doc__, module.__name__
    for name, value in vars(pgjax).items():
        if inspect.isclass(value) or inspect.isfunction(value):
            assert value.__doc__, name


def test_public_names_have_one_import_path():
    """What the top level offers, no other package's face offers too."""
    faces = [importlib.import_module(f"pgjax.{name}") for name in ("models", "render", "scenes")]
    top = {name for name in vars(pgjax) if not name.startswith("_")}
    for face in faces:
        offered = {
            n for n, v in vars(face).items() if not n.startswith("_") and not inspect.ismodule(v)
        }
        doubled = {n for n in offered & top if not inspect.ismodule(getattr(pgjax, n))}
        assert not doubled, f"{face.__name__} offers {doubled} too"


def test_importing_loads_nothing_that_only_some_need():
    """What takes long to import is loaded where it is used: `import pgjax` stays near a second."""
    heavy = ("matplotlib", "imageio", "optax", "plyfile", "viser", "tqdm", "pgjax.scenes")
    code = f"import sys, pgjax; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
