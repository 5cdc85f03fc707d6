"""Connect a run to the workers named by ``--cluster``, and end processes started for the run.

Conventions. Only :func:`open_pool` imports Dask. A local cluster listens on the loopback address. Schedulers started by mivol
use TLS with temporary certificates, because a worker executes received code.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import ssl
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from mivol import machine
from mivol.cluster.address import BATCH_SYSTEMS, ClusterSettings, parse_cluster
from mivol.cluster.pool import Pool, Say
from mivol.errors import MivolError
from mivol.threads import is_script_import

if TYPE_CHECKING:
    from distributed import Client


def import_distributed() -> Any:
    """Import Dask's scheduler.

    Raises:
        MivolError: it is not installed.
    """
    try:
        import cryptography  # noqa: F401  (temporary certificates)
        import distributed
    except ImportError as error:
        raise MivolError(f'--cluster needs Dask ({error}): pip install "mivol[cluster]".') from None
    for name in [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # the pool tells of lost workers
    return distributed


@contextlib.contextmanager
def open_pool(
    cluster: str | ClusterSettings | Client,
    variant: str = "llvm_ad_rgb",
    threads: int = 0,
    say: Say = print,
    check: Callable[[], None] = lambda: None,
) -> Iterator[Pool]:
    """Connect to the workers of a cluster, check all workers, and close the connection at the end.

    Args:
        cluster: a value of ``--cluster``, settings, or a ``distributed.Client``, which stays open.
        variant: Mitsuba variant of all work.
        threads: threads of Dr.Jit in a worker; 0: the cores of the worker.
        say: receives lines about the workers.
        check: called while waiting; may raise.

    Raises:
        MivolError: Dask is missing, no scheduler answers, or as :meth:`Pool.begin`.
    """
    distributed = import_distributed()
    with contextlib.ExitStack() as stack:
        if isinstance(cluster, distributed.Client):
            settings = ClusterSettings(scheduler="address", address=cluster.scheduler.address, threads=threads, wait=10.0)
            client, failures = cluster, []
        else:
            settings = parse_cluster(cluster, threads) if isinstance(cluster, str) else cluster
            if settings.scheduler == "local" and not settings.threads:
                share = max(1, machine.count_cores() // settings.workers)
                settings = msgspec.structs.replace(settings, threads=share)
            client, failures = stack.enter_context(_connect(distributed, settings))
        pool = Pool(client, settings, variant, say, failures)
        pool.begin(check)
        yield pool


@contextlib.contextmanager
def _connect(distributed: Any, settings: ClusterSettings) -> Iterator[tuple[Client, Sequence[str]]]:
    """A client of the scheduler named in the settings, and failures of jobs; started processes end with the client."""
    with contextlib.ExitStack() as stack:
        if settings.scheduler == "address":
            yield stack.enter_context(_connect_address(distributed, settings)), ()
        elif settings.scheduler == "local":
            yield stack.enter_context(_start_local(distributed, settings)), ()
        else:
            yield stack.enter_context(_start_jobs(distributed, settings))


def _connect_address(distributed: Any, settings: ClusterSettings) -> Client:
    security = None
    if settings.security is not None:
        files = settings.security
        security = distributed.Security(
            tls_ca_file=files.ca, tls_client_cert=files.cert, tls_client_key=files.key, require_encryption=True
        )
    try:
        return distributed.Client(settings.address, timeout=5, security=security, set_as_default=False)
    except ssl.SSLError as error:
        raise MivolError(
            f"[security] names files without certificates and key of TLS ({error.reason}): give the PEM files of the scheduler."
        ) from None
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise MivolError(
            f"no scheduler of Dask answers at {settings.address} ({reason}): start it there (dask scheduler), or correct "
            "--cluster."
        ) from None


DASK = {
    "distributed.comm.timeouts.connect": "120s", "distributed.comm.timeouts.tcp": "300s",
    "distributed.scheduler.worker-ttl": None, "distributed.deploy.lost-worker-timeout": "24h",
    "distributed.worker.profile.enabled": False, "distributed.admin.system-monitor.interval": "2s",
    "distributed.admin.tick.interval": "2s", "distributed.scheduler.work-stealing": False,
    "distributed.scheduler.active-memory-manager.start": False,
}  # fmt: skip
"""Settings of Dask for clusters that mivol starts. A busy machine, or a long compilation in a worker, is no lost worker; and
profiles of Python code take time from workers that compute in kernels. After ``lost-worker-timeout``, Dask ends the supervisor
of a worker that is absent at that moment, although it may be starting another worker after a second loss. Ticks, stealing and
the memory manager took half of the processor time of an idle owner; calls to actors need none of them."""

OWN_GROUP = "import os; os.setpgid(0, 0)"
"""Code at the start of a local worker. Ctrl-C in a terminal reaches the owner's group of processes. In a worker, Mitsuba would
answer it with an unfinished image, and call it finished."""


@contextlib.contextmanager
def _start_local(distributed: Any, settings: ClusterSettings) -> Iterator[Client]:
    """Processes of this machine; their memory is not limited by Dask, since Dr.Jit's cache of memory looks like a leak.

    Raises:
        MivolError: no worker starts, as for a script that opens workers where each worker imports it.
    """
    import dask

    if is_script_import():
        raise SystemExit(1)  # a script opens workers where each worker imports it; the process of the script says so
    security = distributed.Security.temporary()
    with dask.config.set(DASK):
        try:
            cluster = distributed.LocalCluster(
                n_workers=settings.workers, threads_per_worker=1, processes=True, memory_limit=0, host="127.0.0.1",
                dashboard_address="127.0.0.1:0", security=security, silence_logs=logging.CRITICAL + 1, preload=[OWN_GROUP],
            )  # fmt: skip
        except RuntimeError as error:
            raise MivolError(
                f"no worker started on this machine ({str(error).rstrip('.')}): in a script, write "
                'if __name__ == "__main__": before the lines that open workers, because each worker imports the script.'
            ) from None
        with cluster, distributed.Client(cluster, security=security, set_as_default=False, direct_to_workers=True) as client:
            yield client


@contextlib.contextmanager
def _start_jobs(distributed: Any, settings: ClusterSettings) -> Iterator[tuple[Client, list[str]]]:
    """Jobs of a batch system, with a single Dask thread and temporary certificates."""
    try:
        import dask
        import dask_jobqueue
    except ImportError:
        raise MivolError(
            f'scheduler = "{settings.scheduler}" starts workers by dask-jobqueue, which is missing: pip install dask-jobqueue.'
        ) from None
    name = BATCH_SYSTEMS[settings.scheduler]
    job = {"cores": 1, "memory": "4GB", **settings.job}
    folder = Path(job.pop("shared_temp_directory", Path.home() / ".mivol"))
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    extra = [*job.pop("worker_extra_args", []), "--nthreads", "1", "--memory-limit", "0"]
    command = getattr(dask_jobqueue, name).job_cls.submit_command
    if shutil.which(command) is None:
        raise MivolError(
            f'scheduler = "{settings.scheduler}" submits jobs by {command}, which is not on this machine: run mivol on a login '
            "node, or give --cluster local:N."
        )
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(DASK))
        failures = stack.enter_context(_collect_failures())
        try:
            cluster = getattr(dask_jobqueue, name)(
                processes=job.pop("processes", 1), worker_extra_args=extra, security=True,
                shared_temp_directory=str(folder), **job,
            )  # fmt: skip
        except (TypeError, ValueError) as error:
            reason = str(error).partition(". ")[0].partition("\n")[0]
            raise MivolError(f"[job] is refused by dask-jobqueue ({reason}): correct its keywords.") from None
        stack.enter_context(cluster)
        cluster.scale(settings.workers)
        client = stack.enter_context(distributed.Client(cluster, security=cluster.security, set_as_default=False))
        yield client, failures


@contextlib.contextmanager
def _collect_failures() -> Iterator[list[str]]:
    """Collect Dask's messages about jobs without submission, instead of printing them."""
    found: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.exc_info and record.exc_info[1] is not None:
                found.append(" ".join(str(record.exc_info[1]).split()))

    loggers, handler = [logging.getLogger(name) for name in ("tornado.application", "asyncio")], Collector()
    before = [(logger.propagate, logger.handlers[:]) for logger in loggers]
    try:
        for logger in loggers:
            logger.propagate, logger.handlers = False, [handler]
        yield found
    finally:
        for logger, (propagate, handlers) in zip(loggers, before, strict=True):
            logger.propagate, logger.handlers = propagate, handlers
