"""One thread of a process uses Dr.Jit, and other work runs in fresh processes: two threads lose gradients silently.

Reason. Dr.Jit 1.5 keeps one copy of a small scatter target for each pool thread (reduction mode ``Expand``), and counts all
Python threads as the same pool thread. Two Python threads then add to one copy without atomics. Up to a third of a gradient was
missing in a test, without an error. A forked child has no pool threads at all. Therefore every function that renders or
differentiates calls :func:`check_one_thread` first, and child processes are started by :func:`run_child` and
:func:`follow_program`. :func:`map_arrays` and :class:`CallsAhead` start threads that compute with NumPy and write files. No
other module of mivol starts threads or processes; ``mivol.cluster`` lets Dask start workers, each a fresh process with one
thread for Dr.Jit.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from .errors import MivolError

_owner: threading.Thread | None = None
_pid = os.getpid()


def check_one_thread() -> None:
    """Make the calling thread the owner of Dr.Jit, or refuse.

    The first caller becomes the owner. After the end of its thread the next caller becomes the owner.

    Raises:
        MivolError: another live thread of this process owns Dr.Jit, or this process was forked after the import of mivol.
    """
    global _owner
    if os.getpid() != _pid:
        raise MivolError(
            f"process {os.getpid()} was forked from process {_pid} after the import of mivol, and Dr.Jit's worker threads do "
            "not survive a fork: start workers with multiprocessing.get_context('spawn')."
        )
    caller = threading.current_thread()
    if _owner is None or not _owner.is_alive():
        _owner = caller
    if _owner is not caller:
        raise MivolError(
            f"thread {caller.name!r} wants to use Dr.Jit, but thread {_owner.name!r} of this process already uses it, and two "
            f"threads lose gradients silently: hand the work to {_owner.name!r} (by a queue of NumPy arrays), or to a process "
            "of its own."
        )


def is_script_import() -> bool:
    """Whether this process is a child that still imports the script of its parent, and so can start no process."""
    return getattr(multiprocessing.current_process(), "_inheriting", False)


@contextmanager
def lend_ownership() -> Iterator[None]:
    """Make the calling thread the owner of Dr.Jit while the former owner waits for the caller.

    PyTorch differentiates on threads of its own, and its calling thread waits for them. Kernels launched by the former owner
    must have finished (``dr.sync_thread``).
    """
    global _owner
    before, _owner = _owner, threading.current_thread()
    try:
        yield
    finally:
        _owner = before


def set_thread_count(count: int) -> None:
    """Set the number of Dr.Jit threads after all running kernels have ended.

    Changing the size of the pool under running kernels crashed a process once, in a run of the tests.
    """
    import drjit as dr  # loads LLVM, so mivol.llvm chooses the library first

    dr.sync_thread()
    dr.set_thread_count(count)


Item = TypeVar("Item")
Result = TypeVar("Result")


def map_arrays(work: Callable[[Item], Result], items: Sequence[Item], count: int) -> list[Result]:
    """Apply a function to items in several threads, and return the results in the order of the items.

    Args:
        work: computes with NumPy alone, which lets other threads run meanwhile; it must not touch Dr.Jit.
        items: pieces of the work.
        count: largest number of threads; 1 works in the calling thread.
    """
    if min(count, len(items)) < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(min(count, len(items))) as pool:
        return list(pool.map(work, items))


MAX_AHEAD = 2
"""Most calls that wait in :class:`CallsAhead`: each may hold an image."""


class CallsAhead:
    """Calls in a thread of their own, one after another, while the caller goes on: an image is written while the next is
    rendered."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1)
        self._waiting: list[Future] = []

    def submit(self, work: Callable[..., Result], *args: Any) -> Future[Result]:
        """Begin ``work(*args)`` after the earlier calls; waits for the oldest call if ``MAX_AHEAD`` calls are waiting.

        Args:
            work: computes with NumPy alone; it must not touch Dr.Jit.
            args: its arguments, which nobody changes meanwhile.

        Raises:
            Exception: of an earlier call.
        """
        while len(self._waiting) >= MAX_AHEAD:
            self._waiting.pop(0).result()
        self._waiting.append(self._pool.submit(work, *args))
        return self._waiting[-1]


def run_program(*command: str, timeout: float) -> str:
    """What a program prints; empty without the program, after a failure, or after ``timeout`` [s]."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=timeout, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout


def run_child(
    code: str, *args: str, timeout: float = 120.0, env: Mapping[str, str] | None = None, isolated: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run Python code in a fresh interpreter (never forked) and wait for its end.

    The working directory is not on the path of the child, so a user's file with the name of a module does no harm.

    Args:
        code: code for ``python -c``.
        args: ``sys.argv[1:]`` of the child.
        timeout: time limit [s]; afterwards the child is killed.
        env: whole environment of the child; None: the environment of this process.
        isolated: leave out site-packages and user settings (25 ms instead of 100 ms).

    Returns:
        The finished process; ``returncode`` is minus the number of the signal if a signal killed the child.

    Raises:
        subprocess.TimeoutExpired: the child did not end within ``timeout``.
    """
    command = [sys.executable, *(["-I", "-S"] if isolated else ["-P"]), "-c", code, *args]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=timeout,
        env=env,
        stdin=subprocess.DEVNULL,
        check=False,
    )


def follow_program(program: Path, *args: str, errors: Path) -> Iterator[str]:
    """Run a Python file in a fresh interpreter, and yield the lines of its standard output as they come.

    The program ends with the iteration: leaving the iterator early, or an interrupt, kills it.

    Args:
        program: file of the program.
        args: its arguments.
        errors: file for its error output.
    """
    with errors.open("w", encoding="utf-8") as stream:
        child = subprocess.Popen(
            [sys.executable, "-P", str(program), *args], stdout=subprocess.PIPE, stderr=stream, text=True, encoding="utf-8"
        )
        try:
            yield from child.stdout
        finally:
            child.kill()
            child.stdout.close()
            child.wait()
