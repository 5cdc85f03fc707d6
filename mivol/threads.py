"""One thread of a process uses Dr.Jit, and helpers are fresh processes: two threads silently lose gradients.

Why. Dr.Jit 1.5 keeps one copy of a small scatter target for each pool thread (its reduction mode ``Expand``) and takes
every Python thread for the same one, so two of them add into one copy without atomics: up to a third of a gradient was
seen to go missing, with no error raised. A forked child has no pool threads at all. So code that renders, walks or
differentiates calls :func:`check_one_thread` first, and code that needs another process starts it with
:func:`run_child`; nothing else in mivol starts threads or processes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from .errors import MivolError

__all__ = ["check_one_thread", "owner_waits", "run_child", "set_thread_count"]

_owner: threading.Thread | None = None
_pid = os.getpid()


def check_one_thread() -> None:
    """Make the calling thread the one that uses Dr.Jit, or refuse.

    The first caller becomes the owner; once its thread has ended, the next caller does.

    Raises:
        MivolError: another live thread of this process owns Dr.Jit, or this process is a fork of one in which mivol
            was imported.
    """
    global _owner
    if os.getpid() != _pid:
        raise MivolError(
            f"process {os.getpid()} was forked from process {_pid}, which had loaded mivol: Dr.Jit's worker threads do "
            "not survive a fork; start workers with multiprocessing.get_context('spawn')."
        )
    caller = threading.current_thread()
    if _owner is None or not _owner.is_alive():
        _owner = caller
    if _owner is not caller:
        raise MivolError(
            f"thread {caller.name!r} wants to use Dr.Jit, but thread {_owner.name!r} of this process does already, and "
            f"two of them lose gradients silently: hand the work to {_owner.name!r} (a queue of NumPy arrays), or to a "
            "process of its own."
        )


@contextmanager
def owner_waits() -> Iterator[None]:
    """The thread that uses Dr.Jit waits for the calling one, as it does for PyTorch's, which differentiate on a GPU: for a
    while the caller is the one. What the owner launched has to be done (``dr.sync_thread``)."""
    global _owner
    before, _owner = _owner, threading.current_thread()
    try:
        yield
    finally:
        _owner = before


def set_thread_count(count: int) -> None:
    """Give Dr.Jit so many threads, once the kernels that still run have ended.

    A pool whose size changes under running kernels has crashed a process (seen once, in a run of the tests).
    """
    import drjit as dr  # loads LLVM, which mivol.llvm has to choose before

    dr.sync_thread()
    dr.set_thread_count(count)


def run_child(
    code: str, *args: str, timeout: float = 120.0, env: Mapping[str, str] | None = None, isolated: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run Python code in a fresh interpreter (started anew, never forked) and wait for it.

    The working directory is not on the child's path: a file of the user's that is called like a module does not matter.

    Args:
        code: what ``python -c`` is given.
        args: become ``sys.argv[1:]`` there.
        timeout: seconds after which the child is killed.
        env: its whole environment; by default this process's own.
        isolated: leave out site-packages and the user's settings (25 ms instead of 100).

    Returns:
        The finished process; ``returncode`` is minus the signal's number where a signal killed it.

    Raises:
        subprocess.TimeoutExpired: the child did not end within ``timeout``.
    """
    command = [sys.executable, *(["-I", "-S"] if isolated else ["-P"]), "-c", code, *args]
    return subprocess.run(
        command, capture_output=True, text=True, errors="replace", timeout=timeout, env=env, stdin=subprocess.DEVNULL,
        check=False,
    )
