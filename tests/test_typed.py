"""A user's script passes ``mypy --strict``: what ``mivol.<name>`` is has types that say something."""

from __future__ import annotations

import ast
import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from syntax import tree_of

import mivol

ROOT = Path(__file__).resolve().parents[1]


def test_type_checkers_see_what_is_public() -> None:
    """Python imports a public name when it is first used; checkers read a list of imports, which must be the same."""
    tree = tree_of(ROOT / "mivol" / "__init__.py")
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    seen = {alias.asname: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == mivol.PUBLIC


def callables(name: str) -> Iterator[tuple[str, object]]:
    """A public function, or the constructor and the public methods of a public class."""
    thing = getattr(mivol, name)
    if not inspect.isclass(thing):
        yield name, thing
        return
    for key in dir(thing):
        found = inspect.getattr_static(thing, key)
        found = getattr(found, "fget", None) or getattr(found, "__func__", found)
        ours = inspect.isfunction(found) and found.__module__.startswith("mivol")
        if ours and (key == "__init__" or not key.startswith("_")):
            yield f"{name}.{key}", found


@pytest.mark.parametrize("name", sorted(mivol.PUBLIC))
def test_public_signatures_say_what_they_take(variant_rgb: str, name: str) -> None:
    """``Any`` says nothing, and lets every mistake pass."""
    for called, thing in callables(name):
        vague = {key: kind for key, kind in getattr(thing, "__annotations__", {}).items() if "Any" in str(kind)}
        assert vague == {}, called


@pytest.mark.slow
def test_scripts_of_the_docs_pass_mypy_strict(tmp_path: Path) -> None:
    """And a mistake in the use of mivol does not: the types are there."""
    wrong = tmp_path / "wrong.py"
    wrong.write_text('import mivol\n\nmivol.optimize("scene.xml")\nmivol.Parameter(3)\nmivol.frog()\n')
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache")]
    # As for users, whose mivol is installed: mypy reports faults of the script only.
    said = {"capture_output": True, "text": True, "timeout": 300, "cwd": tmp_path, "env": {**os.environ, "MYPYPATH": ""}}
    found = {}
    for name, files in (("docs", sorted((ROOT / "docs" / "scripts").glob("*.py"))), ("wrong", [wrong])):
        done = subprocess.run([*command, *map(str, files)], **said)
        assert done.stderr == "", done.stderr
        found[name] = [line for line in done.stdout.splitlines() if ": error: " in line]
    assert found["docs"] == []
    assert [line.split(":")[1] for line in found["wrong"]] == ["3", "4", "5"]
