"""What this process may use of the machine: cores and memory, with the limits that containers and schedulers set.

Conventions. Memory is in bytes. Limits come from the affinity mask, from the control group (versions 1 and 2) and from
the system; the smallest one holds.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

from mivol.errors import MivolError

__all__ = ["available_memory", "check_fits", "cores"]

_CGROUP = Path("/sys/fs/cgroup")


def _number(path: Path) -> float:
    """The number in a file of the system; infinity where there is none, or no limit."""
    try:
        return float(path.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return math.inf


def _quota() -> float:
    """How many cores the control group grants."""
    try:
        quota, period = (_CGROUP / "cpu.max").read_text().split()
        return math.inf if quota == "max" else float(quota) / float(period)
    except (OSError, ValueError):
        quota = _number(_CGROUP / "cpu/cpu.cfs_quota_us")
        return math.inf if quota < 0 else quota / _number(_CGROUP / "cpu/cpu.cfs_period_us")


def cores() -> int:
    """Cores that this process may use; Dr.Jit by itself knows the affinity mask, but not the control group's quota."""
    mask = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _quota()
    return max(1, min(mask, math.ceil(quota) if math.isfinite(quota) else mask))


def available_memory() -> int | None:
    """Bytes that this process can still take without swapping, None where the system does not tell.

    The smaller of the system's ``MemAvailable`` and what the control group leaves. Page cache that the group counts as
    its own, and would give back, is not deducted.
    """
    meminfo = Path("/proc/meminfo")
    if not meminfo.exists():
        return None
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    system = float(fields["MemAvailable"].split()[0]) * 1024
    second = _left_in_group("memory.max", "memory.current", "memory.stat")
    first = _left_in_group("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat")
    return int(min(system, second, first))


def check_fits(needed: float, what: str, way_out: str) -> None:
    """Refuse what takes more memory than is left, before any of it is taken.

    Args:
        needed: bytes.
        what: subject of the sentence: what takes them.
        way_out: what to do instead.

    Raises:
        MivolError: with what is needed, what is free and the way out.
    """
    free = available_memory()
    if free is not None and needed > free:
        raise MivolError(f"{what} takes {needed / 2**30:,.1f} GiB and {free / 2**30:,.1f} GiB are free: {way_out}.")


def _left_in_group(limit: str, usage: str, stat: str) -> float:
    ceiling = _number(_CGROUP / limit)
    if math.isinf(ceiling):
        return math.inf
    try:
        pairs = dict(line.split() for line in (_CGROUP / stat).read_text().splitlines())
    except OSError:
        pairs = {}
    cache = float(pairs.get("total_inactive_file", pairs.get("inactive_file", 0)))
    return max(0.0, ceiling - (_number(_CGROUP / usage) - cache))
