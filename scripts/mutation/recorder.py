"""A plugin of pytest that records which tests run the lines of drawn faults, how long each test takes, and whether it passes.

Run it as ``pytest -p mutation.recorder`` with the folder ``scripts`` on the path of Python. The environment variable
``MIVOL_FAULTS`` names the folder in which ``scripts/mutate.py --random N --faults FOLDER`` put the faults. Each process of
tests writes its part of the recording there. Files without a fault are imported as they are, and run at full speed.
"""

from __future__ import annotations

import ast
import builtins
import json
import linecache
import os
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any

from mutation.guards import is_of_import, read_faults

import pytest


class Recorder:
    """Notes which faults' lines each test runs.

    Attributes:
        folder: where the recording is written.
        tests: name, seconds, whether it passed, and indices of faults of each test, in the order of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.tests: list[tuple[str, float, bool, list[int]]] = []
        self._faults: set[int] = set()
        self._passed = True
        self._of_fixtures: defaultdict[str, set[int]] = defaultdict(set)

    def note(self, fault: int) -> None:
        """The line of this fault runs now."""
        self._faults.add(fault)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """The lines of a fixture that several tests share count for each of these tests."""
        if fixturedef.scope == "function":
            return (yield)
        before, self._faults = self._faults, set()
        try:
            return (yield)
        finally:
            self._of_fixtures[fixturedef.argname] |= self._faults
            self._faults |= before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Record one test."""
        self._faults, self._passed = set(), True
        start = time.perf_counter()
        try:
            return (yield)
        finally:
            faults = self._faults.union(*(self._of_fixtures[name] for name in getattr(item, "fixturenames", ())))
            self.tests.append((item.nodeid, time.perf_counter() - start, self._passed, sorted(faults)))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note whether a part of a test is red."""
        self._passed &= not report.failed

    def pytest_sessionfinish(self) -> None:
        """Write the recording, each worker of pytest-xdist a part of it."""
        if self.tests:
            (self.folder / f"part{os.environ.get('PYTEST_XDIST_WORKER', '')}.json").write_text(json.dumps(self.tests))


def insert_probes(source: str, lines: Mapping[int, int]) -> str:
    """Source that calls ``note_fault(k)`` before the statement of line ``lines[k]``.

    Defaults of arguments, attributes of classes and constants of files are computed by an import. The functions inside their
    function, class or file call it then.
    """
    tree = ast.parse(source)
    found = {k: _find_statements(tree, line, is_of_import(source, line)) for k, line in lines.items()}
    for k, statement in [(k, statement) for k, statements in found.items() for statement in statements]:
        for block in [block for node in ast.walk(tree) for block in vars(node).values() if isinstance(block, list)]:
            if statement in block:
                block.insert(block.index(statement), ast.parse(f"note_fault({k})").body[0])
    return ast.unparse(tree)


def _find_statements(tree: ast.Module, line: int, of_import: bool) -> list[ast.stmt]:
    around = [n for n in ast.walk(tree) if isinstance(n, ast.stmt) and n.lineno <= line <= n.end_lineno]
    if not of_import:
        return around[-1:]
    owner = next((n for n in reversed(around) if isinstance(n, ast.FunctionDef | ast.ClassDef)), tree)
    functions = [n for n in ast.walk(owner) if isinstance(n, ast.FunctionDef)]
    # After the docstring, if another statement follows it.
    return [f.body[ast.get_docstring(f) is not None and len(f.body) > 1] for f in functions]


def load_with_probes(lines: Mapping[str, Mapping[int, int]]) -> None:
    """From now on, import these files with the probes of their lines. Neither reads nor writes their bytecode."""
    get_code = SourceFileLoader.get_code

    def get_code_with_probes(loader: SourceFileLoader, name: str) -> CodeType | None:
        if loader.path not in lines:
            return get_code(loader, name)
        text = insert_probes(Path(loader.path).read_text(), lines[loader.path])
        # Dr.Jit compiles functions with symbolic loops anew, from the source that it finds here.
        linecache.cache[loader.path] = len(text), None, text.splitlines(keepends=True), loader.path
        return compile(text, loader.path, "exec", dont_inherit=True)

    SourceFileLoader.get_code = get_code_with_probes


def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Begin, before conftest.py imports the package."""
    recorder = Recorder(Path(os.environ["MIVOL_FAULTS"]))
    early_config.pluginmanager.register(recorder)
    builtins.note_fault = recorder.note
    lines: defaultdict[str, dict[int, int]] = defaultdict(dict)
    for k, fault in enumerate(read_faults(recorder.folder)):
        lines[str(early_config.rootpath / fault.file)][k] = fault.line
    load_with_probes(lines)
