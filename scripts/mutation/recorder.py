"""A plugin of pytest that records which lines of the package each test runs, how long it takes, and whether it passes.

Run it as ``pytest -p mutation.recorder`` with the folder ``scripts`` on the path of Python; the environment variable
``MIVOL_LINES`` names a folder for the recording, to which each process of tests writes a part.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import time
from array import array
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

Lines = set[tuple[str, int]]
"""(file, line) pairs."""


class Recorder:
    """Traces the functions of one folder.

    Attributes:
        tests: (node id, seconds, number of lines, whether it passed) of each test, in the order of the run.
        runners: indices into ``tests`` by (file, line); files are relative to the checkout.
    """

    def __init__(self, root: str, package: str) -> None:
        self.root, self.folder = root, f"{root}{os.sep}{package}{os.sep}"
        self.tests: list[tuple[str, float, int, bool]] = []
        self.runners: dict[tuple[str, int], array] = {}
        self._lines: Lines = set()
        self._passed = True
        self._of_fixtures: dict[str, Lines] = {}

    def start(self) -> None:
        """Trace this thread and each new one."""
        threading.settrace(self._trace_call)
        sys.settrace(self._trace_call)

    def _trace_call(self, frame: FrameType, event: str, argument: Any) -> Any:
        return self._trace_line if frame.f_code.co_filename.startswith(self.folder) else None

    def _trace_line(self, frame: FrameType, event: str, argument: Any) -> Any:
        self._lines.add((frame.f_code.co_filename, frame.f_lineno))
        return self._trace_line

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """The lines of a fixture that several tests share count for each of these tests."""
        if fixturedef.scope == "function":
            return (yield)
        before, self._lines = self._lines, set()
        try:
            return (yield)
        finally:
            self._of_fixtures.setdefault(fixturedef.argname, set()).update(self._lines)
            self._lines |= before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Record one test."""
        self._lines, self._passed = set(), True
        start = time.perf_counter()
        self.start()
        try:
            return (yield)
        finally:
            sys.settrace(None)
            lines = self._lines.union(*(self._of_fixtures.get(name, ()) for name in getattr(item, "fixturenames", ())))
            for file, line in lines:
                self.runners.setdefault((file[len(self.root) + 1 :], line), array("H")).append(len(self.tests))
            self.tests.append((item.nodeid, time.perf_counter() - start, len(lines), self._passed))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note whether a part of a test is red."""
        self._passed &= not report.failed

    def pytest_sessionfinish(self) -> None:
        """Write the recording, each worker of pytest-xdist a part of it."""
        worker = os.environ.get("PYTEST_XDIST_WORKER", "")
        if self.tests:
            folder = Path(os.environ["MIVOL_LINES"])
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"part{worker}").write_bytes(pickle.dumps((self.tests, self.runners)))


def pytest_configure(config: pytest.Config) -> None:
    """Begin."""
    config.pluginmanager.register(Recorder(str(config.rootpath), os.environ.get("MIVOL_PACKAGE", "mivol")))
