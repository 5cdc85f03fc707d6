"""Which tests guard a line: the tests that run it, the shortest first.

A recording of the suite (:mod:`mutation.recorder`) tells which tests run the lines of drawn faults, and how long they take.
Lines that only an import runs, and slow tests, are not in it: :data:`OF_IMPORTS` and the names of test files stand for them.
"""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path

from mutation.faults import Fault

__all__ = [
    "Guards", "RunTest", "group_entries", "is_of_import", "read_faults", "read_recording", "record_suite", "write_faults",
]  # fmt: skip

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
        passed: whether it was green.
    """

    name: str
    seconds: float
    passed: bool = True

    @property
    def function(self) -> str:
        """Node id without the parameters."""
        return self.name.partition("[")[0]


@dataclass
class Guards:
    """Tests by fault.

    Attributes:
        tests: the tests of the recording.
        runners: those that run the line of a fault.
        listed: the tests of the entries of tests/mutations, by file of the package.
        test_files: text of each test file.
        slow: whether slow tests count.
        seconds: recorded time of the tests in the first two rounds [s].
    """

    tests: list[RunTest] = field(default_factory=list)
    runners: Mapping[Fault, Sequence[RunTest]] = field(default_factory=dict)
    listed: dict[str, list[str]] = field(default_factory=dict)
    test_files: Mapping[str, str] = field(default_factory=dict)
    slow: bool = False
    seconds: float = ALL

    def find_runners(self, fault: Fault, of_import: bool = False) -> list[RunTest]:
        """The tests that run the statement of a fault: tests in files called like the module first, then the shortest.

        One variant of each test comes before the further variants of all tests. A line of an import, such as a table of
        numbers, is also read by tests that call no function of its module: all tests in files called like the module stand
        for them.
        """
        runners = set(self.runners.get(fault, ()))
        named = {test for test in self.tests if is_named_like(test.name, fault.file)} if of_import else set()
        chosen = sorted(runners | named, key=lambda t: (not is_named_like(t.name, fault.file), t.seconds, t.name))
        variants: Counter[str] = Counter()
        ranks = {}
        for test in chosen:
            ranks[test.name] = variants[test.function]
            variants[test.function] += 1
        return sorted(chosen, key=lambda t: ranks[t.name] > 0)

    def rounds(self, fault: Fault, source: str) -> list[list[str]]:
        """Names of tests for a fault, round by round; a round may be empty.

        1. tests that run its line, ``FIRST`` seconds of them or ``seconds`` if fewer; ``OF_IMPORTS`` for a line that an import
           runs; the tests of the entries of its file;
        2. more tests that run its line, up to ``seconds``;
        3. if slow tests count, those in files called like the module. If no recorded test runs the line, all tests of these
           files, because the recording sees no other processes;
        4. ``OF_SAMPLES`` for code of renders that a recorded test runs.
        """
        is_import = is_of_import(source, fault.line)
        runners = self.find_runners(fault, is_import)
        first, rest = split_by_time(runners, min(FIRST, self.seconds))
        second = split_by_time(rest, self.seconds - FIRST)[0] if self.seconds > FIRST else []
        one = list(dict.fromkeys([*(test.name for test in first), *OF_IMPORTS * is_import, *self.listed.get(fault.file, [])]))
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


def is_of_import(source: str, line: int) -> bool:
    """Whether an import runs this line: it is outside functions, or in the head of one."""
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    return not any(f.body[0].lineno <= line <= f.end_lineno for f in functions)


def write_faults(folder: Path, faults: Iterable[Fault]) -> None:
    """Put faults into a folder, which a recording then fills."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "faults.json").write_text(json.dumps([astuple(fault) for fault in faults], indent=1))


def read_faults(folder: Path) -> list[Fault]:
    """The faults of a folder of :func:`write_faults`."""
    return [Fault(*fields) for fields in json.loads((folder / "faults.json").read_text())]


def record_suite(copy: Path, jobs: int, folder: Path, slow: bool = False) -> None:
    """Run the default suite of a checkout under the recorder, or the slow tests as well.

    Args:
        folder: of :func:`write_faults`.

    Raises:
        RuntimeError: pytest wrote no recording.
    """
    env = dict(os.environ, PYTHONPATH=f"{copy}{os.pathsep}{copy / 'scripts'}", PYTHONDONTWRITEBYTECODE="1")
    env["MIVOL_FAULTS"] = str(folder)
    env.pop("PYTEST_XDIST_WORKER_COUNT", None)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "mutation.recorder"]
    command += ["-n", str(jobs), "--dist", "worksteal"] if jobs > 1 else ["-p", "no:xdist"]
    command += ["-m", "slow or not slow"] if slow else []
    done = subprocess.run(command, cwd=copy, env=env, capture_output=True, text=True, errors="replace", check=False)
    if not any(folder.glob("part*.json")):
        raise RuntimeError(f"pytest ends with {done.returncode} and wrote no recording:\n{(done.stdout + done.stderr)[-2000:]}")


def read_recording(
    folder: Path, listed: dict[str, list[str]], test_files: Mapping[str, str] | None = None, slow: bool = False
) -> Guards:
    """The guards of a folder to which each process of tests wrote a part. The rest as in :class:`Guards`."""
    faults, tests = read_faults(folder), []
    runners: dict[Fault, list[RunTest]] = {fault: [] for fault in faults}
    for part in sorted(folder.glob("part*.json")):
        for name, seconds, passed, indices in json.loads(part.read_text()):
            tests.append(RunTest(name, seconds, passed))
            for k in indices:
                runners[faults[k]].append(tests[-1])
    return Guards(tests, runners, listed, test_files or {}, slow)


def group_entries(entries: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Tests by file of the package, from (file, test) pairs."""
    listed: dict[str, list[str]] = {}
    for file, test in entries:
        if test not in listed.setdefault(file, []):
            listed[file].append(test)
    return listed
