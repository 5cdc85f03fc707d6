"""Cores and memory available to this process, within the limits of containers and schedulers.

Conventions. Memory is in bytes. Limits come from the affinity mask, the control group (versions 1 and 2) and the system; the
smallest limit holds.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mivol.errors import MivolError
from mivol.threads import run_program

_CGROUP = Path("/sys/fs/cgroup")


def _read_number(path: Path) -> float:
    """Read a number from a system file; infinity without a file or without a limit."""
    try:
        return float(path.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return math.inf


def _group_cores() -> float:
    """Number of cores granted by the control group."""
    try:
        quota, period = (_CGROUP / "cpu.max").read_text().split()
        return math.inf if quota == "max" else float(quota) / float(period)
    except (OSError, ValueError):
        quota = _read_number(_CGROUP / "cpu/cpu.cfs_quota_us")
        return math.inf if quota < 0 else quota / _read_number(_CGROUP / "cpu/cpu.cfs_period_us")


def count_cores() -> int:
    """Count the cores of this process. Dr.Jit itself respects the affinity mask but not the quota of the control group."""
    mask = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _group_cores()
    return max(1, min(mask, math.ceil(quota) if math.isfinite(quota) else mask))


def available_memory() -> int | None:
    """Memory left to this process without swapping [bytes]; None if the system does not report memory.

    The smaller of ``MemAvailable`` of the system and the rest of the control group. Reclaimable page cache of the group counts
    as free.
    """
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        return None
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    system = float(fields["MemAvailable"].split()[0]) * 1024
    second = _group_memory("memory.max", "memory.current", "memory.stat")
    first = _group_memory("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat")
    return int(min(system, second, first))


@dataclass(frozen=True)
class Gpu:
    """An NVIDIA GPU.

    Attributes:
        name: name of the card.
        driver: version of the driver.
        total, used: memory of the card, and memory in use by all processes [bytes].
        load: share of time in which kernels ran, over the last second or less [1].
    """

    name: str
    driver: str
    total: int
    used: int
    load: float

    @property
    def free(self) -> int:
        """Memory that no process uses [bytes]."""
        return self.total - self.used


GPU_FIELDS = "name,driver_version,memory.total,memory.used,utilization.gpu"
"""Columns asked of ``nvidia-smi``; memory in MiB, the load in percent."""


def list_gpus() -> list[Gpu]:
    """The NVIDIA GPUs in the order of ``nvidia-smi``, also those hidden by ``CUDA_VISIBLE_DEVICES``.

    Empty without ``nvidia-smi``. A number that the driver does not tell counts as 0.
    """
    told = run_program("nvidia-smi", f"--query-gpu={GPU_FIELDS}", "--format=csv,noheader,nounits", timeout=20)
    rows = [[field.strip() for field in line.split(",")] for line in told.splitlines() if line.strip()]
    return [_read_gpu(row) for row in rows if len(row) == len(GPU_FIELDS.split(","))]


def _read_gpu(row: list[str]) -> Gpu:
    total, used, load = (float(field) if re.fullmatch(r"[0-9.]+", field) else 0.0 for field in row[2:])
    return Gpu(row[0], row[1], int(total * 2**20), int(used * 2**20), load / 100)


def find_used_gpu(gpus: list[Gpu]) -> Gpu | None:
    """The GPU that Dr.Jit uses: the first that ``CUDA_VISIBLE_DEVICES`` shows; None if it cannot be told."""
    first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0].strip()
    return gpus[int(first)] if first.isdecimal() and int(first) < len(gpus) else None


def peak_memory() -> int | None:
    """Largest memory of this process so far [bytes]; None if the system does not report it."""
    status = Path("/proc/self/status")
    if status.is_file() and (peak := re.search(r"VmHWM:\s*(\d+) kB", status.read_text())):
        # The counter of getrusage begins with the memory of the parent.
        return 1024 * int(peak[1])
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def check_memory(needed: float, what: str, way_out: str | Callable[[float], str], limit: float | None = None) -> None:
    """Refuse a task with more memory than available, before its start.

    Args:
        needed: memory of the task [bytes].
        what: subject of the sentence, for instance "a fit of 256^3 voxels".
        way_out: advice in the imperative, or a function of the free memory [bytes] that returns the advice.
        limit: memory to count as free [bytes]; None: :func:`available_memory`.

    Raises:
        MivolError: the task needs more than the free memory.
    """
    free = available_memory() if limit is None else limit
    if free is not None and needed > free:
        advice = way_out if isinstance(way_out, str) else way_out(free)
        raise MivolError(f"{what} needs {needed / 2**30:,.1f} GiB of memory and {free / 2**30:,.1f} GiB are free: {advice}.")


def _group_memory(limit: str, usage: str, stat: str) -> float:
    """Memory left in the control group [bytes], from the names of its files."""
    ceiling = _read_number(_CGROUP / limit)
    if math.isinf(ceiling):
        return math.inf
    try:
        pairs = dict(line.split() for line in (_CGROUP / stat).read_text().splitlines())
    except OSError:
        pairs = {}
    cache = float(pairs.get("total_inactive_file", pairs.get("inactive_file", 0)))
    return max(0.0, ceiling - (_read_number(_CGROUP / usage) - cache))
