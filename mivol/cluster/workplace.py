"""The part of mivol inside a worker: facts about the worker, stored inputs, and the work itself, piece by piece.

Conventions. A workplace is an actor of Dask. Its methods run one after another on the only thread of the process that uses
Dr.Jit. ``async`` methods run at the same time on the network thread, and never touch Dr.Jit. Arguments and results
are NumPy arrays and plain Python; no object of Mitsuba leaves the process.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import socket
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import drjit
import mitsuba
import numpy as np

import mivol
from mivol import llvm, machine
from mivol.back_end import set_threads, set_variant
from mivol.doctor import FAULT, diagnose, format_findings
from mivol.errors import MivolError
from mivol.threads import check_one_thread

VECTORS = re.compile(r"sse4_2|avx\w*|fma|f16c|asimd\w*|sve\w*")
"""CPU features that change how a compiled kernel rounds."""


@cache
def hash_code() -> str:
    """Hash of mivol's own source files: 16 hexadecimal digits."""
    folder, digest = Path(mivol.__file__).parent, hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def find_cpu_features() -> str:
    """Architecture and vector features of this CPU."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.machine()
    line = next((line for line in text.splitlines() if line.startswith(("flags", "Features"))), "")
    found = sorted({word for word in line.split() if VECTORS.fullmatch(word)})
    return " ".join([platform.machine(), *found])


class Facts(NamedTuple):
    """Facts of a process; results depend on those of ``software`` and on ``cpu``.

    Attributes:
        host, pid: where the process runs.
        software: version by name; "mivol code" is the hash of mivol's files.
        cpu: architecture and vector features.
        cores: cores of the process.
        memory: free memory [bytes]; 0 if unknown.
        dask_threads: threads of the Dask worker; 1 outside of a worker.
        fault: why the variant does not work there; empty if it works.
        doctor: lines of ``mivol doctor`` about faults there.
    """

    host: str
    pid: int
    software: dict[str, str]
    cpu: str
    cores: int
    memory: int
    dask_threads: int = 1
    fault: str = ""
    doctor: tuple[str, ...] = ()


def find_facts(dask_threads: int = 1, fault: str = "") -> Facts:
    """Facts of this process; with a fault, also what ``mivol doctor`` finds here."""
    software = {
        "mivol": mivol.__version__, "mivol code": hash_code(), "Mitsuba": mitsuba.__version__, "Dr.Jit": drjit.__version__,
        "NumPy": np.__version__, "Python": ".".join(map(str, sys.version_info[:2])),
        "LLVM": ".".join(map(str, llvm.loaded_version() or ())) or "none",
    }  # fmt: skip
    memory = machine.available_memory() or 0
    cores = machine.count_cores()
    found = tuple(format_findings([one for one in diagnose() if one.state == FAULT])) if fault else ()
    return Facts(socket.gethostname(), os.getpid(), software, find_cpu_features(), cores, memory, dask_threads, fault, found)


class Failure(NamedTuple):
    """The error of a piece of work, as a value: errors that Dask raises are those of the connection."""

    error: Exception


class Workplace:
    """State of a worker between two pieces of work.

    Attributes:
        kept: inputs by content hash, and what was made of them.
        says: newest progress of the present work, in a line.
        is_stopped: whether the owner asked the present work to stop.
    """

    def __init__(self) -> None:
        self.kept: dict[str, Any] = {}
        self.says, self.is_stopped = "", False

    def begin(self, variant: str, threads: int) -> Facts:
        """Activate the variant, and return the facts of the process; a variant that does not work is one of the facts."""
        from distributed import get_worker

        fault = ""
        try:
            check_one_thread()
            llvm.check_backend(variant)
            set_variant(variant)
            set_threads(threads or machine.count_cores())
        except MivolError as error:
            fault = str(error).partition("\n")[0]
        return find_facts(get_worker().state.nthreads, fault)

    def keep(self, digest: str, value: Any) -> None:
        """Keep an input."""
        self.kept[digest] = value

    def forget(self, digest: str) -> None:
        """Drop an input."""
        self.kept.pop(digest, None)

    def made(self, key: str, make: Callable[[], Any]) -> Any:
        """Return what was made for a key, and make it at the first call."""
        if key not in self.kept:
            self.kept[key] = make()
        return self.kept[key]

    def work(self, function: Callable[..., Any], *args: Any) -> Any:
        """Return ``function(self, *args)``, or its error as a :class:`Failure`."""
        self.says, self.is_stopped = "", False
        try:
            return function(self, *args)
        except Exception as error:
            return Failure(error)

    async def progress(self) -> str:
        """Progress of the present work."""
        return self.says

    async def stop(self) -> None:
        """Ask the present work to stop at its next safe point."""
        self.is_stopped = True
