"""Which tests guard a line: the tests that run it, the most specific first.

A recording of the suite (:mod:`mutation.recorder`) tells which lines each test runs, and how long the test takes. Lines that
only an import runs, and slow tests, are not in it: :data:`OF_IMPORTS` and the names of test files stand for them.
"""

from __future__ import annotations

import ast
import os
import pickle
import re
import subprocess
import sys
from array import array
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from mutation.faults import Fault

__all__ = ["Guards", "RunTest", "group_entries", "is_of_import", "lines_of", "list_unrun", "read_recording", "record_suite"]

FIRST, ALL = 60.0, 360.0
"""Recorded time of the tests in the first round, and in the first two rounds together [s]."""

OF_IMPORTS = ("tests/test_docs.py::test_reference_is_what_the_code_says",)
"""Tests of what imports compute: default arguments, settings and tables stand on the pages of the reference."""


OF_SAMPLES = "tests/conformance/test_drawn_pictures.py"
"""Slow tests that compare single samples of renders. A fault that changes noise but no mean is seen by no other test."""

SAMPLING = ("mivol/transport/", "mivol/scene/", "mivol/phase/", "mivol/plugins/")
"""Where code of renders stands."""


@dataclass(frozen=True)
class RunTest:
    """A test of the recording.

    Attributes:
        name: its node id.
        seconds: its time.
        size: lines of the package that it runs.
        passed: whether it was green.
    """

    name: str
    seconds: float
    size: int
    passed: bool = True

    @property
    def function(self) -> str:
        """Node id without the parameters."""
        return self.name.partition("[")[0]


@dataclass
class Guards:
    """Tests by line.

    Attributes:
        tests: the tests of the recording.
        runners: indices into ``tests`` by (file of the package, line).
        listed: the tests of the entries of tests/mutations, by file of the package.
        test_files: text of each test file.
        slow: whether slow tests count.
        seconds: recorded time of the tests in the first two rounds [s].
    """

    tests: list[RunTest] = field(default_factory=list)
    runners: dict[tuple[str, int], Iterable[int]] = field(default_factory=dict)
    listed: dict[str, list[str]] = field(default_factory=dict)
    test_files: Mapping[str, str] = field(default_factory=dict)
    slow: bool = False
    seconds: float = ALL

    def find_runners(self, fault: Fault, source: str) -> list[RunTest]:
        """The tests that run the statement of a fault: tests in files called like the module first, then the most specific.

        The most specific test runs the fewest lines. One variant of each test comes before the further variants of all tests.
        """
        lines = lines_of(source, fault.line)
        found = {k for line in lines for k in self.runners.get((fault.file, line), ())}
        chosen = sorted(
            (self.tests[k] for k in found), key=lambda t: (not is_named_like(t.name, fault.file), t.size, t.seconds)
        )
        variants: Counter[str] = Counter()
        ranks = {}
        for test in chosen:
            ranks[test.name] = variants[test.function]
            variants[test.function] += 1
        return sorted(chosen, key=lambda t: ranks[t.name] > 0)

    def rounds(self, fault: Fault, source: str) -> list[list[str]]:
        """Names of tests for a fault, round by round; a round may be empty.

        1. the tests of the entries of its file, and tests that run its line, ``FIRST`` seconds of them or ``seconds`` if fewer;
           ``OF_IMPORTS`` for a line that an import runs;
        2. more tests that run its line, up to ``seconds``;
        3. if slow tests count, those in files called like the module. If no recorded test runs the line, all tests of these
           files, because the recording sees no other processes;
        4. ``OF_SAMPLES`` for code of renders that a recorded test runs.
        """
        runners = self.find_runners(fault, source)
        first, rest = split_by_time(runners, min(FIRST, self.seconds))
        second = split_by_time(rest, self.seconds - FIRST)[0] if self.seconds > FIRST else []
        of_import = OF_IMPORTS if is_of_import(source, fault.line) else ()
        one = list(dict.fromkeys([*self.listed.get(fault.file, []), *of_import, *(test.name for test in first)]))
        two = [test.name for test in second if test.name not in one]
        files = self.find_test_files(fault.file, is_unrun=not runners) if self.slow or not runners else []
        which = "not slow" if not self.slow else "slow" if runners else "slow or not slow"
        samples = ["-m", "slow", OF_SAMPLES] if runners and fault.file.startswith(SAMPLING) else []
        return [one, two, ["-m", which, *files] if files else [], samples]

    def find_test_files(self, file: str, is_unrun: bool) -> list[str]:
        """Files with slow tests that are called like a module; for an unrun line any such file, or those that import it."""
        texts = {name: text for name, text in self.test_files.items() if is_unrun or "mark.slow" in text}
        module = file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        parent, _, name = module.rpartition(".")
        imported = re.compile(rf"(from {re.escape(module)} import|from {re.escape(parent)} import .*\b{name}\b)")
        called = [test for test in texts if is_named_like(test, file)]
        return called or [test for test, text in texts.items() if is_unrun and imported.search(text)]


def split_by_time(tests: Sequence[RunTest], seconds: float) -> tuple[list[RunTest], list[RunTest]]:
    """The first tests up to this time, at least one, and the others."""
    total = 0.0
    for k, test in enumerate(tests):
        total += test.seconds
        if total > seconds and k:
            return list(tests[:k]), list(tests[k:])
    return list(tests), []


def is_named_like(test: str, file: str) -> bool:
    """Whether the file of a test is called like a module; a package is called like its folder."""
    path = Path(file)
    return Path(test.partition("::")[0]).stem.removeprefix("test_") == (
        path.parent.name if path.stem == "__init__" else path.stem
    )


@cache
def lines_of(source: str, line: int) -> range:
    """The lines that run whenever the statement of this line runs.

    A simple statement has its own lines, and a compound statement the lines of its head. The head of a function or a class, and
    a statement outside functions, run during the import; the lines of the function, the class or the file then stand for them.
    """
    tree = ast.parse(source)
    found = range(1, source.count("\n") + 2)
    node: ast.AST | None = tree
    in_function = False
    while node is not None:
        children = [n for n in statements_in(node) if n.lineno <= line <= n.end_lineno]
        node = children[0] if children else None
        if node is None:
            break
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found = range(node.body[0].lineno, node.end_lineno + 1)
            in_function = isinstance(node, ast.FunctionDef) and line >= node.body[0].lineno
        elif in_function:
            body = getattr(node, "body", None)
            last = body[0].lineno - 1 if body and line < body[0].lineno else node.end_lineno
            found = range(node.lineno, max(node.lineno, last) + 1)
    return found


def is_of_import(source: str, line: int) -> bool:
    """Whether an import runs this line: it is outside functions, or in the head of one."""
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    return not any(f.body[0].lineno <= line <= f.end_lineno for f in functions)


def statements_in(node: ast.AST) -> list[ast.stmt]:
    """The statements of the blocks of a node."""
    blocks = [getattr(node, name, []) for name in ("body", "orelse", "finalbody")]
    handlers = [handler.body for handler in getattr(node, "handlers", [])]
    cases = [case.body for case in getattr(node, "cases", [])]
    return [child for block in (*blocks, *handlers, *cases) if isinstance(block, list) for child in block]


def list_unrun(source: str, file: str, runners: Container[tuple[str, int]]) -> tuple[int, list[int]]:
    """How many statements the functions of a module have, and the lines of those that no test runs; docstrings do not count."""
    heads = []
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    for statement in {n for f in functions for n in ast.walk(f) if isinstance(n, ast.stmt) and n is not f}:
        is_text = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
        if is_text or isinstance(statement, ast.Pass | ast.Global | ast.Nonlocal | ast.FunctionDef | ast.ClassDef):
            continue
        body = getattr(statement, "body", None) or getattr(statement, "cases", None)
        last = max(statement.lineno, _first_line(body[0]) - 1) if body else statement.end_lineno
        heads.append(range(statement.lineno, last + 1))
    return len(heads), sorted(head.start for head in heads if not any((file, line) in runners for line in head))


def _first_line(node: ast.stmt | ast.match_case) -> int:
    return node.pattern.lineno if isinstance(node, ast.match_case) else node.lineno


def record_suite(copy: Path, jobs: int, target: Path, slow: bool = False) -> None:
    """Run the default suite of a checkout under the recorder, or the slow tests as well; the recording is a folder of parts.

    Raises:
        RuntimeError: pytest wrote no recording.
    """
    target.mkdir(parents=True, exist_ok=True)
    env = dict(os.environ, PYTHONPATH=f"{copy}{os.pathsep}{copy / 'scripts'}", PYTHONDONTWRITEBYTECODE="1")
    env["MIVOL_LINES"] = str(target)
    env.pop("PYTEST_XDIST_WORKER_COUNT", None)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "mutation.recorder"]
    command += ["-n", str(jobs), "--dist", "worksteal"] if jobs > 1 else ["-p", "no:xdist"]
    command += ["-m", "slow or not slow"] if slow else []
    done = subprocess.run(command, cwd=copy, env=env, capture_output=True, text=True, errors="replace", check=False)
    if not any(target.iterdir()):
        raise RuntimeError(f"pytest ends with {done.returncode} and wrote no recording:\n{(done.stdout + done.stderr)[-2000:]}")


def read_recording(
    path: Path, listed: dict[str, list[str]], test_files: Mapping[str, str] | None = None, slow: bool = False
) -> Guards:
    """The guards of a recording: a folder with a part of each process of tests. The rest as in :class:`Guards`."""
    tests, runners = [], {}
    for part in sorted(path.iterdir()):
        own, lines = pickle.loads(part.read_bytes())
        for place, indices in lines.items():
            runners.setdefault(place, array("H")).extend(k + len(tests) for k in indices)
        tests += own
    return Guards([RunTest(*test) for test in tests], runners, listed, test_files or {}, slow)


def group_entries(entries: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Tests by file of the package, from (file, test) pairs."""
    listed: dict[str, list[str]] = {}
    for file, test in entries:
        if test not in listed.setdefault(file, []):
            listed[file].append(test)
    return listed
