"""Workers of this machine for tests: how many take part, and one that is killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mivol.cluster.address import ClusterSettings
from mivol.cluster.pool import Pool


@contextmanager
def some_workers(client: object, count: int, said: list[str] | None = None) -> Iterator[Pool]:
    """A pool of the first workers only."""
    settings = ClusterSettings(scheduler="address", address="tcp://127.0.0.1:1", threads=1, wait=60.0)
    pool = Pool(client, settings, say=(said if said is not None else []).append)
    present = sorted(client.scheduler_info(n_workers=-1)["workers"])
    pool._refused |= set(present[count:])
    while len(pool.workers) < count:
        pool.begin()
    yield pool


def kill_worker(pool: Pool) -> None:
    """Kill the first worker of a pool, at once."""
    os.kill(next(iter(pool.workers.values())).facts.pid, signal.SIGKILL)


def kill_once(pool: Pool) -> Callable[[str], None]:
    """A display that kills a worker when it is first called."""
    killed: list[int] = []

    def show(line: str) -> None:
        if not killed:
            killed.append(1)
            kill_worker(pool)

    return show
