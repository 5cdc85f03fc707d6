"""What is public says what it is: names exist, functions have types and a docstring, dependencies are declared."""

from __future__ import annotations

import ast
import importlib
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from syntax import tree_of

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "mivol"
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name != "__main__.py")
IMPORTED_AS = {
    "pillow": "pil",
    "scikit-image": "skimage",
    "flip-evaluator": "flip_evaluator",
    "imageio-ffmpeg": "imageio_ffmpeg",
    "pillow-heif": "pillow_heif",
}
Function = ast.FunctionDef | ast.AsyncFunctionDef


def name_of(path: Path) -> str:
    """The dotted name of a module."""
    return ".".join(["mivol", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")


def public(tree: ast.Module) -> Iterator[ast.ClassDef | Function]:
    """Public classes and functions at the top of a module, and the public methods of those classes."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | Function) and not node.name.startswith("_"):
            yield node
            if isinstance(node, ast.ClassDef):
                yield from (n for n in node.body if isinstance(n, Function) and not n.name.startswith("_"))


def untyped(function: Function) -> list[str]:
    """Parameters, and the result, that have no annotation."""
    spec = function.args
    args = [*spec.posonlyargs, *spec.args, *spec.kwonlyargs, *filter(None, (spec.vararg, spec.kwarg))]
    missing = [arg.arg for arg in args if arg.annotation is None and arg.arg not in ("self", "cls")]
    return missing + ([] if function.returns is not None else ["return"])


@cache
def said_in(room: Path) -> set[str]:
    """Names of the methods that some class in a folder documents: a protocol says it once, also for inner folders."""
    trees = [tree_of(path) for path in room.glob("*.py")]
    classes = [node for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)]
    return {n.name for node in classes for n in node.body if isinstance(n, Function) and ast.get_docstring(n)}


def unsaid(path: Path) -> list[str]:
    """What a module leaves without a docstring or a type. Methods of the Mitsuba shells are excused: their names and arguments
    are Mitsuba's."""
    said = set().union(*(said_in(folder) for folder in path.parents if PACKAGE in folder.parents))
    tree = tree_of(path)
    shell = path.parent.name == "plugins"
    faults = [] if ast.get_docstring(tree) or not tree.body else ["no docstring"]
    for node in public(tree):
        if shell and not isinstance(node, ast.ClassDef):
            continue
        if not ast.get_docstring(node) and not (node not in tree.body and node.name in said):
            faults.append(f"line {node.lineno}: {node.name} has no docstring")
        if isinstance(node, Function) and (missing := untyped(node)):
            faults.append(f"line {node.lineno}: {node.name} has no type for {', '.join(missing)}")
    return faults


def test_docstrings_and_types() -> None:
    assert {name_of(path): faults for path in MODULES if (faults := unsaid(path))} == {}


def test_all_is_true() -> None:
    modules = [importlib.import_module(name_of(path)) for path in MODULES if path.parent.name != "plugins"]
    listed = {module.__name__: getattr(module, "__all__", []) for module in modules}
    missing = {m.__name__: [n for n in listed[m.__name__] if not hasattr(m, n)] for m in modules}
    assert {name: names for name, names in missing.items() if names} == {}
    assert [name for name, names in listed.items() if len(names) != len(set(names))] == []


OUTSIDE = sorted(path for folder in ("scripts", "scenes") for path in (ROOT / folder).rglob("*.py"))
"""What uses the package from outside, and is run by slow tests only."""


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: str(path.relative_to(ROOT)))
def test_scripts_and_scenes_import_what_is_there(variant_rgb: str, path: Path) -> None:
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mivol":
            module = importlib.import_module(node.module)
            for alias in node.names:
                assert hasattr(module, alias.name) or importlib.import_module(f"{node.module}.{alias.name}")


def test_third_party_imports_are_declared() -> None:
    """Whoever installs the wheel gets what the modules import; torch and dask_jobqueue are the user's own."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = project["dependencies"] + [line for extra in project["optional-dependencies"].values() for line in extra]
    declared = {re.match(r"[A-Za-z0-9_-]+", line)[0].lower() for line in lines}
    declared = {IMPORTED_AS.get(name, name) for name in declared} | {"drjit"}  # mitsuba pins drjit itself
    imported = set()
    for path in MODULES:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add((node.module or "").split(".")[0])
    users_own = {"mivol", "torch", "dask_jobqueue"}
    unknown = {name.lower() for name in imported} - set(sys.stdlib_module_names) - declared - users_own
    assert unknown == set()


def test_entry_points_exist() -> None:
    """Mitsuba 3.10 imports the module named in the group ``mitsuba``; pip makes a command of each script."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    importlib.import_module(project["entry-points"]["mitsuba"]["mivol"])
    module, function = project["scripts"]["mivol"].split(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_faults_are_seen() -> None:
    """The check itself, on a function that it must refuse."""
    tree = ast.parse("def f(a, b: int, *, c): ...\nclass A:\n    def g(self) -> None: ...\n    def _h(self): ...\n")
    assert [node.name for node in public(tree)] == ["f", "A", "g"]
    assert [untyped(node) for node in public(tree) if isinstance(node, Function)] == [["a", "c", "return"], []]
