"""Break a line of the package at random, run the tests that guard it, and tell whether one of them noticed.

A fault is killed if a test that is green on the untouched checkout is red twice, or does not end, on the broken checkout.
"""

from __future__ import annotations

import os
import queue
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

from mutation.faults import Fault
from mutation.guards import Guards

__all__ = ["Checkout", "Verdict", "change_source", "judge_all", "judge_fault", "report", "run_pytest"]

GREEN, NOTHING_COLLECTED = 0, 5
"""Exit codes of pytest that tell no fault; others do where the untouched copy has none of them."""

CULPRIT = re.compile(r"^(?:FAILED|ERROR) (\S+?\.py(?:::\w+)*(?:\[.*?\])?)(?= - |$)", re.MULTILINE)
UNFINISHED = re.compile(r"^Timeout \(", re.MULTILINE)


@dataclass(frozen=True)
class Verdict:
    """What became of a fault: killed by a test (its name, "" where it is not known), or not."""

    fault: Fault
    killed: bool
    test: str
    seconds: float


@dataclass
class Checkout:
    """A copy of the checkout that may be broken, and an untouched one to hold a red test against.

    Attributes:
        broken, untouched: their folders.
        limit: seconds that one test may take before it counts as one that does not end.
        green: what is known of tests of the untouched copy; shared by all who judge.
        lock: of ``green``.
    """

    broken: Path
    untouched: Path
    limit: float
    green: dict[str, bool] = field(default_factory=dict)
    lock: Lock = field(default_factory=Lock)

    def is_green(self, *tests: str) -> bool:
        """Whether tests pass on the untouched copy; of whole files, whether they can be read."""
        key = " ".join(tests)
        with self.lock:
            if key not in self.green:
                reads = [] if all("::" in test for test in tests) else ["--collect-only"]
                self.green[key] = run_pytest(self.untouched, [*reads, *tests], self.limit)[0] == GREEN
            return self.green[key]


def run_pytest(copy: Path, arguments: Sequence[str], limit: float) -> tuple[int, str]:
    """The exit code of pytest in a copy of the checkout, up to the first red test, and its output."""
    # Plugins, which no test needs in one process, would take as long to load as all else.
    env = dict(os.environ, PYTHONPATH=str(copy), PYTEST_DISABLE_PLUGIN_AUTOLOAD="1")
    # Bytecode goes with the copy. Each process without it compiles the package and the tests, which takes 1 to 4 s.
    env |= {"PYTHONPYCACHEPREFIX": str(copy.parent / "bytecode"), "PYTHONDONTWRITEBYTECODE": ""}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-rfE", "-p", "no:cacheprovider"]
    # The clock runs for one test at a time and ends the process from a thread of its own, whatever a kernel does.
    command += ["-o", f"faulthandler_timeout={limit}", "-o", "faulthandler_exit_on_timeout=true"]
    if all("::" in argument for argument in arguments):
        command += ["-m", "slow or not slow"]  # named tests are run, slow or not
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:  # hundreds of tests are too long for a command line
        file.write("\n".join(arguments))
        file.flush()
        command += [f"@{file.name}"]
        done = subprocess.run(command, cwd=copy, env=env, capture_output=True, text=True, errors="replace", check=False)
    return done.returncode, done.stdout + done.stderr


def change_source(file: Path, text: str) -> None:
    """Write a source file two seconds younger than it was: of bytecode, Python compares the second and the size only."""
    younger = file.stat().st_mtime + 2
    file.write_text(text)
    os.utime(file, (younger, younger))


def judge_fault(checkout: Checkout, fault: Fault, guards: Guards) -> Verdict:
    """Break the copy, run the tests of the line round by round until one is red, mend the copy."""
    start, file = time.perf_counter(), checkout.broken / fault.file
    whole = file.read_text()
    change_source(file, fault.apply(whole))
    try:
        for tests in guards.rounds(fault, whole):
            killed, test = _red(checkout, tests) if tests else (False, "")
            if killed:
                return Verdict(fault, True, test, time.perf_counter() - start)
        return Verdict(fault, False, "", time.perf_counter() - start)
    finally:
        change_source(file, whole)


def _red(checkout: Checkout, tests: Sequence[str]) -> tuple[bool, str]:
    """Whether the broken copy turns a test red that is green otherwise; and which.

    Raises:
        RuntimeError: the tests cannot be run without the fault either.
    """
    excused: list[str] = []
    while True:
        code, output = run_pytest(checkout.broken, [*tests, *(f"--deselect={test}" for test in excused)], checkout.limit)
        if code in (GREEN, NOTHING_COLLECTED):
            return False, ""
        if UNFINISHED.search(output):
            return True, "a test that does not end"
        named = CULPRIT.search(output)
        culprits = [named[1]] if named else tests
        # Red by chance, or by the load of the machine, is not red twice.
        if checkout.is_green(*culprits) and run_pytest(checkout.broken, culprits, checkout.limit)[0] != GREEN:
            return True, named[1] if named else f"pytest, which ends with {code}"
        if not named or named[1] in excused:
            raise RuntimeError(f"pytest ends with {code} without the fault, too:\n{output[-2000:]}")
        excused.append(named[1])


def judge_all(faults: Sequence[Fault], guards: Guards, checkouts: Sequence[Checkout]) -> Iterator[Verdict]:
    """The verdicts as they come, as many at a time as there are copies to break."""
    free: queue.Queue[Checkout] = queue.Queue()
    for checkout in checkouts:
        free.put(checkout)

    def judge(fault: Fault) -> Verdict:
        checkout = free.get()
        try:
            return judge_fault(checkout, fault, guards)
        finally:
            free.put(checkout)

    with ThreadPoolExecutor(len(checkouts)) as pool:
        for done in as_completed([pool.submit(judge, fault) for fault in faults]):
            yield done.result()


def report(verdicts: Iterator[Verdict], count: int, say: Callable[[str], None]) -> list[Verdict]:
    """Say each verdict, the share that was killed and the survivors; return all."""
    found = []
    for verdict in verdicts:
        found.append(verdict)
        how = f"killed  [{verdict.test}]" if verdict.killed else "SURVIVED"
        say(f"{len(found):3d} of {count}  {verdict.seconds:6.1f} s  {verdict.fault}  {how}")
    alive = sorted(v.fault for v in found if not v.killed)
    say(f"{count - len(alive)} of {count} faults were killed ({100 * (count - len(alive)) / count:.0f} %)")
    for fault in alive:
        say(f"survived: {fault}")
    return found
