"""A user's script passes ``mypy --strict``: what ``mivol.<name>`` is has types that say something."""

from __future__ import annotations

import ast
import inspect
import os
import subprocess
import sys
import typing
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import scipy.sparse.linalg
from syntax import tree_of

import mivol

ROOT = Path(__file__).resolve().parents[1]
USER_SCRIPT = Path(__file__).with_name("user_script.py")


def test_type_checkers_see_what_is_public() -> None:
    """Python imports a public name when it is first used; checkers read a list of imports, which must be the same."""
    tree = tree_of(ROOT / "mivol" / "__init__.py")
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    seen = {alias.asname: node.module for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == mivol.PUBLIC


def callables(name: str, thing: object) -> Iterator[tuple[str, object]]:
    """A public function, or the constructor and the public methods of a public class."""
    if not inspect.isclass(thing):
        yield name, thing
        return
    for key in dir(thing):
        found = inspect.getattr_static(thing, key)
        found = getattr(found, "fget", None) or getattr(found, "__func__", found)
        ours = inspect.isfunction(found) and found.__module__.startswith("mivol")
        if ours and (key == "__init__" or not key.startswith("_")):
            yield f"{name}.{key}", found


OPTIONAL = {"scipy": SimpleNamespace(sparse=scipy.sparse), "torch": SimpleNamespace(Tensor=type("Tensor", (), {}))}
"""Names of modules that public methods import when they are called."""


def parts(kind: object) -> Iterator[object]:
    """A type, and the types that it is made of."""
    yield kind
    for inner in typing.get_args(kind):
        for part in inner if isinstance(inner, list) else [inner]:
            yield from parts(part)


def reached(names: Iterable[str]) -> dict[str, object]:
    """What a user of these names holds by and by, by place: their parts, those of what they take and give, and so on."""
    found: dict[str, object] = {}
    ahead, seen = [(name, getattr(mivol, name)) for name in names], set()
    while ahead:
        name, thing = ahead.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        for place, called in [*callables(name, thing), *[(name, thing)][: inspect.isclass(thing)]]:
            hints = {key: kind for key, kind in typing.get_type_hints(called, localns=OPTIONAL).items() if key[0] != "_"}
            found |= {f"{place}: {key}": kind for key, kind in hints.items()}
            held = (part for kind in hints.values() for part in parts(kind) if inspect.isclass(part))
            ahead += [(kind.__qualname__, kind) for kind in held if kind.__module__.startswith("mivol")]
    return found


def vague(kind: object) -> bool:
    """Whether a type says nothing of what it holds: ``Any``, or a container that does not say of what."""
    return any(part is Any or part in (dict, list, set, tuple) or part is Callable for part in parts(kind))


def test_public_signatures_say_what_they_take(variant_rgb: str) -> None:
    """``Any`` says nothing, and lets every mistake pass; so it stands in nothing that public calls take or give, nor in what
    that has."""
    kinds = reached(mivol.PUBLIC)
    assert {place: kind for place, kind in kinds.items() if vague(kind)} == {}
    # From `optimize` by way of the fit to its checkpoint: the walk does not end at the first signature.
    assert {"optimize: return", "Fit: checkpoint", "CheckpointFile: fingerprint", "VolumeData: meta"} <= set(kinds)


def test_a_user_script_names_all_that_is_public() -> None:
    """What mypy reads of a user leaves nothing out."""
    attributes = {node.attr for node in ast.walk(tree_of(USER_SCRIPT)) if isinstance(node, ast.Attribute)}
    assert set(mivol.__all__) - attributes == set()


@pytest.mark.slow
def test_scripts_of_the_docs_pass_mypy_strict(tmp_path: Path) -> None:
    """And a mistake in the use of mivol does not: the types are there."""
    wrong = tmp_path / "wrong.py"
    wrong.write_text('import mivol\n\nmivol.optimize("scene.xml")\nmivol.Parameter(3)\nmivol.frog()\n')
    command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache")]
    # As for users, whose mivol is installed: mypy reports faults of the script only.
    said = {"capture_output": True, "text": True, "timeout": 300, "cwd": tmp_path, "env": {**os.environ, "MYPYPATH": ""}}
    found = {}
    scripts = [*sorted((ROOT / "docs" / "scripts").glob("*.py")), ROOT / "scripts" / "biased_gradients.py", USER_SCRIPT]
    for name, files in (("right", scripts), ("wrong", [wrong])):
        done = subprocess.run([*command, *map(str, files)], **said)
        assert done.stderr == "", done.stderr
        found[name] = [line for line in done.stdout.splitlines() if ": error: " in line]
    assert found["right"] == []
    assert [line.split(":")[1] for line in found["wrong"]] == ["3", "4", "5"]
