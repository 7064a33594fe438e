"""What is declared is what is used: dependencies and imports, data files and the lists of them."""

import ast
import re
import sys
import tomllib
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from fgtutor import __main__ as cli

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
SOURCES = sorted((ROOT / "fgtutor").rglob("*.py"))
INSTALLED = packages_distributions()
COURSE = {"course"}
"""Folders of fgtutor that may need the extra `lab`."""
UNSEEN = {
    "tensorboard": "torch.utils.tensorboard",
    "onnxscript": "torch.onnx.export",
    "ray": 'import_module("ray")',
    "ipykernel": 'kernel_name="python3"',
    "jupyterlab": "$(BIN)/jupyter lab",
}
"""Packages that another one loads, or a command starts, and the words that make it do so."""


def declared(extra: str | None = None) -> set[str]:
    """Return the names of the packages that fgtutor, or one of its extras, asks for."""
    project = PROJECT["project"]
    lines = project["optional-dependencies"][extra] if extra else project["dependencies"]
    return {canonicalize_name(Requirement(line).name) for line in lines}


@cache
def imported(path: Path) -> set[str]:
    """Return the packages of others that a file imports, wherever in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add((node.module or "").split(".")[0])
    return names - sys.stdlib_module_names - {"fgtutor"}


def distributions(names: set[str]) -> set[str]:
    """Return what has to be installed so that packages can be imported."""
    known, asked = INSTALLED, declared().union(*map(declared, EXTRAS))
    # A package may be a name for parts, as mujoco is for mujoco-core: its own name goes first.
    return {
        name if name in asked else canonicalize_name(known.get(name, [name])[0]) for name in names
    }


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_file_imports_is_declared(path):
    course = path.relative_to(ROOT / "fgtutor").parts[0] in COURSE
    assert distributions(imported(path)) <= declared() | (declared("lab") if course else set())


@pytest.mark.parametrize("extra", [None, "lab", "cluster"])
def test_what_is_declared_is_used(extra):
    text = "".join(path.read_text() for path in [*SOURCES, ROOT / "Makefile"])
    unseen = {name for name, words in UNSEEN.items() if words in text}
    used = distributions(set().union(*map(imported, SOURCES))) | unseen
    assert declared(extra) <= used


@pytest.mark.parametrize(
    "line",
    [
        "notebooks --names 01",
        "notebooks --check",
        "exercises",
        "exercises --check",
        "grade solutions/ex06.ipynb",
        pytest.param(
            "sweep --robot toy --terrains steps --out sweep --ray local", marks=pytest.mark.slow
        ),
        "evaluate matrix --robot toy --trials 1 --ray local",
    ],
)
def test_a_command_without_its_extra_says_what_to_install(line, monkeypatch, capsys, tmp_path):
    for name in ("IPython", "ipykernel", "jupytext", "nbclient", "nbformat", "traitlets", "ray"):
        monkeypatch.setitem(sys.modules, name, None)
    for folder in ("notebooks", "solutions"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    assert cli.main(line.split()) == cli.USAGE
    *bar, message = capsys.readouterr().err.replace("\r", "\n").splitlines()
    assert all("0%" in line or not line.strip() for line in bar)
    assert "not installed" in message and "pip install" in message


def test_every_file_of_the_package_is_in_the_wheel():
    """Setuptools takes the Python files by itself, and of the others those that match a pattern."""
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["fgtutor"]
    package = ROOT / "fgtutor"
    packed = {path for pattern in patterns for path in package.glob(pattern)}
    there = {path for path in package.rglob("*") if path.is_file() and path.suffix != ".py"}
    there = {path for path in there if path.suffix != ".pyc" and not path.name.startswith(".")}
    assert there <= packed and packed


def test_the_lock_has_no_package_that_nothing_asks_for_by_mistake():
    """A name in the lock that pyproject once asked for, and no longer does."""
    lock = (ROOT / "constraints.txt").read_text()
    pins = set(re.findall(r"^([a-z0-9-]+)==", lock, re.MULTILINE))
    asked = declared().union(*map(declared, EXTRAS))
    assert asked <= pins and "imageio" not in pins
