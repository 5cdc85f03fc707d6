"""The list of mutations still fits the code: every entry applies, its test exists, and every module has one.

scripts/mutate.py applies them and demands red; that takes minutes, this takes none.
"""

from __future__ import annotations

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


def load_mutate() -> ModuleType:
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("mutate", ROOT / "scripts" / "mutate.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutate"] = module
    spec.loader.exec_module(module)
    return module


mutate = load_mutate()
ENTRIES = mutate.load_entries()


def has_logic(path: Path) -> bool:
    """Whether a module defines a function that does more than name a protocol."""
    functions = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)]
    bodies = [[s for s in f.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))] for f in functions]
    return any(bodies)


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda e: f"{e.area}: {e.file}")
def test_entry_applies(entry: mutate.Mutation) -> None:
    after = mutate.broken(entry, ROOT)
    assert after != (ROOT / entry.file).read_text()
    if entry.file.endswith(".py"):
        ast.parse(after, entry.file)
    path, _, name = entry.test.partition("::")
    functions = [n.name for n in ast.walk(ast.parse((ROOT / path).read_text())) if isinstance(n, ast.FunctionDef)]
    assert name.split("::")[-1].partition("[")[0] in functions


def test_every_module_has_a_mutation() -> None:
    """At least one entry for each module with logic, and 20 in all."""
    modules = {str(path.relative_to(ROOT)) for path in (ROOT / "mivol").rglob("*.py") if has_logic(path)}
    assert sorted(modules - {entry.file for entry in ENTRIES}) == []
    assert len(ENTRIES) >= 20


def test_a_text_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1\ny = 1\n")
    with pytest.raises(ValueError, match="2 times"):
        mutate.broken(mutate.Mutation("area", "a.py", "= 1", "= 2", "t"), tmp_path)


def test_verdicts() -> None:
    """A test that passes, or that never ran, has noticed nothing."""
    assert mutate.verdict(1, "1 failed, 2 passed") == (True, "red")
    assert mutate.verdict(None, "")[0]
    assert mutate.verdict(-6, "")[0]
    assert not mutate.verdict(0, "3 passed")[0]
    assert not mutate.verdict(2, "error during collection")[0]
    assert not mutate.verdict(1, "1 error in 0.1 s")[0]


def test_the_runner_tells_red_from_green(tmp_path: Path) -> None:
    """A test that sees a mutation and one that does not, in a checkout of two files."""
    (tmp_path / "doubling.py").write_text("def double(x):\n    return 2 * x\n")
    (tmp_path / "test_doubling.py").write_text(
        "from doubling import double\n"
        "def test_sees(): assert double(3) == 6\n"
        "def test_blind(): assert double(0) == 0\n"
    )
    seen: dict[str, str] = {}
    for name, expected in (("test_sees", (True, "red")), ("test_blind", (False, "STILL GREEN"))):
        entry = mutate.Mutation("area", "doubling.py", "2 * x", "3 * x", f"test_doubling.py::{name}")
        assert mutate.judge(tmp_path, entry, seen, 60.0) == expected
    assert (tmp_path / "doubling.py").read_text() == "def double(x):\n    return 2 * x\n"
