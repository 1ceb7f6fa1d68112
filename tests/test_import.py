"""`import implicam` is cheap, shows all that is public, and no module does anything when it is imported.

Each import happens in a fresh process: this one has imported everything already. How long one takes:
benchmarks/import_time.py.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import implicam
from implicam import errors

HEAVY = (
    "torch", "gpytorch", "cv2", "matplotlib", "plotly", "starlette", "uvicorn", "websockets", "joblib",
    "distributed", "pyarrow", "PIL", "yaml", "rich", "typer", "sqlite3", "scipy.stats", "scipy.optimize",
)  # fmt: skip


def fresh(code: str, folder: Path) -> str:
    """What a new Python process prints when it runs this code in this folder."""
    source = Path(implicam.__file__).parents[1]
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(source)},
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_nothing_heavy_is_imported(tmp_path: Path) -> None:
    """Nor any method; and asking what there is imports nothing either."""
    code = f"""
import sys, implicam
assert "ForwardGP" in dir(implicam)
print([name for name in {HEAVY!r} if name in sys.modules], [name for name in sys.modules if "implicam." in name])"""
    assert fresh(code, tmp_path) == "[] []\n"


def test_data_need_numpy_and_scipy_only(tmp_path: Path) -> None:
    """So does the fit of the default method, but for the threads (threadpoolctl)."""
    heavy = [name for name in HEAVY if not name.startswith("scipy")]
    code = f"""
import sys, implicam as ic
rig = ic.simulated("stereo", points=20, seed=1)
ic.ForwardGP().fit(rig).measure(rig.observations)
print([name for name in {heavy!r} if name in sys.modules])"""
    assert fresh(code, tmp_path) == "[]\n"


def test_every_public_name_is_there() -> None:
    for name in implicam.__all__:
        assert getattr(implicam, name) is getattr(sys.modules[implicam._HOMES[name]], name)
    public_errors = {name for name, value in vars(errors).items() if isinstance(value, type) and name.endswith("Error")}
    assert public_errors <= set(implicam.__all__) <= set(dir(implicam))
    assert isinstance(implicam.__version__, str)
    with pytest.raises(AttributeError, match="has no attribute 'ForwadGP'"):
        implicam.ForwadGP  # noqa: B018


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse(Path(implicam.__file__).read_text())
    seen = {
        alias.asname: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("implicam.")
        for alias in node.names
        if alias.name == alias.asname
    }
    assert seen == implicam._HOMES


@pytest.mark.slow
def test_a_name_is_the_same_whatever_was_imported_before(tmp_path: Path) -> None:
    """A module of the same name would take its place once it is imported."""
    code = """
import pkgutil, types, importlib, implicam
for module in pkgutil.iter_modules(implicam.__path__):
    assert module.name not in implicam.__all__, module.name
    importlib.import_module(f"implicam.{module.name}")
    assert getattr(implicam, module.name).__name__ == f"implicam.{module.name}"
print([name for name in implicam.__all__ if isinstance(getattr(implicam, name), types.ModuleType)])"""
    assert fresh(code, tmp_path) == "[]\n"


def test_a_module_is_found_without_its_own_import(tmp_path: Path) -> None:
    assert fresh("import implicam; print(implicam.geometry.Pose.__name__)", tmp_path) == "Pose\n"


@pytest.mark.slow
def test_importing_every_module_starts_nothing(tmp_path: Path) -> None:
    """No command, no thread, no process, no file, no word on the screen, nothing of the process changed."""
    code = """
import importlib, multiprocessing, os, pkgutil, signal, sys, threading
import implicam
def state():
    mask = os.umask(0); os.umask(mask)
    handlers = [signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM, signal.SIGCHLD, signal.SIGPIPE)]
    return mask, os.getcwd(), threading.active_count(), multiprocessing.active_children(), handlers, sys.excepthook
before = state()
names = [module.name for module in pkgutil.walk_packages(implicam.__path__, "implicam.")]
for name in names:
    importlib.import_module(name)
assert state() == before, (before, state())
assert "implicam.__main__" in names and "implicam.calibrators.forward_gp.fit" in names, names
assert len(names) == len(set(names))
print(len(names), os.listdir("."))"""
    walked, files = fresh(code, tmp_path).split(maxsplit=1)
    package = Path(implicam.__file__).parent
    modules = [path for path in package.rglob("*.py") if "__pycache__" not in path.parts]
    assert int(walked) == len(modules) - 1  # all but the package itself
    assert files == "[]\n"
