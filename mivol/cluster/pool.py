"""Work on the workers of a Dask cluster: checks, inputs sent once, repeated work of lost workers, and counts.

Conventions. The owner of a run asks for work unit by unit, and few units are under way. A unit goes to a free worker, and
the result depends on the unit only. The pool holds one :class:`~mivol.cluster.workplace.Workplace` for each worker: calls go
there without Dask's queue of tasks, which would add 10 ms to each. A lost worker gives its units back; a new worker joins after
the same checks. All methods belong to the owner's main thread; the network has a thread of its own inside of Dask.
"""

from __future__ import annotations

import contextlib
import importlib.util
import queue
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from mivol.cluster.address import BATCH_SYSTEMS, ClusterSettings
from mivol.cluster.workplace import Facts, Failure, Workplace, find_facts
from mivol.errors import MivolError, WorkersLost
from mivol.report.record import Table

if TYPE_CHECKING:
    from distributed import Client

MOST_LOSSES = 3
"""Workers that a unit may lose: otherwise work that kills workers would go on for ever."""

SECONDS_BETWEEN_LOOKS = 1.0
"""Interval between two looks at the list of workers, while a worker with work has been silent for as long."""

SECONDS_WITHOUT_LOOK = 5.0
"""Interval between two looks for new workers while all workers answer."""

SECONDS_WITHOUT_WORKERS = 60.0
"""Time to wait for a worker after the last was lost; a batch system may take longer."""

SHARE_OF_MEMORY = 0.5
"""Largest share of a worker's memory that inputs may take."""

AGAIN = "give the same command again (mivol optimize: with --resume); finished work is kept"
"""Way out after the loss of all workers."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Unit:
    """A piece of work.

    Attributes:
        key: of the caller, returned with the result.
        function: function of a module of mivol; called in the worker with the workplace, then ``args``.
        args: NumPy arrays and plain Python.
        needs: content hashes of inputs (:meth:`Pool.share`) that the worker must hold.
    """

    key: Any
    function: Callable[..., Any]
    args: tuple[Any, ...] = ()
    needs: tuple[str, ...] = ()


@dataclass
class _Worker:
    """A worker after the checks."""

    address: str
    actor: Any
    facts: Facts
    held: set[str] = field(default_factory=set)
    sending: set[str] = field(default_factory=set)
    units: dict[int, Unit] = field(default_factory=dict)
    done: int = 0
    heard: float = field(default_factory=time.monotonic)


class Pool:
    """Workers of a run.

    Attributes:
        workers: workers after their checks, by address.
        failures: reasons why jobs could not be submitted; grows while they start.
        lost: number of lost workers.
        repeated: number of units sent again.
        gone: lost workers.
        sent: bytes of inputs sent, over all workers.
    """

    def __init__(
        self,
        client: Client,
        settings: ClusterSettings,
        variant: str = "llvm_ad_rgb",
        say: Say = print,
        failures: Sequence[str] = (),
    ) -> None:
        self.client, self.settings, self.variant, self.say, self.failures = client, settings, variant, say, failures
        self.workers: dict[str, _Worker] = {}
        self.lost = self.repeated = self.sent = 0
        self.gone: list[_Worker] = []
        self._inputs: dict[str, tuple[Any, int]] = {}
        self._losses: Counter[int] = Counter()
        self._refused: set[str] = set()
        self._joining: dict[str, Any] = {}
        self._news: queue.SimpleQueue[tuple[str, Any, Any]] = queue.SimpleQueue()
        self._looked, self._alone_since, self._numbers = 0.0, time.monotonic(), 0
        self._has_begun, self._joins = False, 0

    # -- Workers -----------------------------------------------------------------------------------------------------

    def begin(self, check: Callable[[], None] = lambda: None) -> None:
        """Wait for the workers, and check all before work begins.

        Args:
            check: called while waiting; may raise.

        Raises:
            MivolError: no worker, or a worker of other software, other CPU features, several threads, or without the variant.
        """
        started = time.monotonic()
        expected = 1 if self.settings.scheduler != "local" else self.settings.workers
        self._look()
        while len(self.workers) < expected or self._joining:
            check()
            self._look()
            waited = time.monotonic() - started
            if not self._joining and len(self.workers) < expected and 0 < self.settings.wait < waited:
                raise MivolError(
                    f"{self.settings.describe()} has no worker after {waited:.0f} s: start workers there "
                    "(dask worker ADDRESS --nthreads 1), or give --cluster local:N."
                )
            if self.failures and not self.workers:
                raise MivolError(f"{self.settings.describe()} could not be submitted ({self.failures[0]}): correct [job].")
            self._take_news(0.05)
        check_equal_workers({address: worker.facts for address, worker in self.workers.items()})
        self._has_begun = True
        threads = ", ".join(sorted({f"{self.settings.threads or w.facts.cores}" for w in self.workers.values()}))
        hosts = len({worker.facts.host for worker in self.workers.values()})
        self.say(
            f"cluster: {len(self.workers)} worker{'s' * (len(self.workers) != 1)} on {hosts} host{'s' * (hosts != 1)}, "
            f"{threads} thread(s) of Dr.Jit each; {self.describe_dashboard()}"
        )

    def describe_dashboard(self) -> str:
        """Where Dask shows the workers, in words: the dashboard, or plain pages if the dashboard's library is missing."""
        link = self.client.dashboard_link
        if importlib.util.find_spec("bokeh") is None:
            return f"Dask's pages: {link.removesuffix('/status')}/info/main/workers.html (dashboard: pip install bokeh)"
        return f"Dask's dashboard: {link}"

    def _look(self) -> None:
        """Compare the scheduler's list of workers with the pool's, from time to time."""
        now, most = time.monotonic(), SECONDS_BETWEEN_LOOKS
        silent = [worker for worker in self.workers.values() if worker.units and now - worker.heard > most]
        is_quiet = self._has_begun and self.workers and not self._joining and not silent
        if now - self._looked < (SECONDS_WITHOUT_LOOK if is_quiet else most):
            return
        self._looked = now
        try:
            present = set(self.client.scheduler_info(n_workers=-1)["workers"])
            is_running = self.client.status == "running"
        except (OSError, RuntimeError, ValueError, KeyError) as error:
            raise self._scheduler_gone() from error
        if not is_running:
            raise self._scheduler_gone()
        for address in set(self.workers) - present:
            self._lose(address)
        for address in set(self._joining) - present:
            del self._joining[address]
        for address in present - set(self.workers) - set(self._joining) - self._refused:
            self._join(address)
        if self.workers or self._joining:
            self._alone_since = time.monotonic()
        elif self._has_begun and self.settings.scheduler not in BATCH_SYSTEMS:
            waited = time.monotonic() - self._alone_since
            if waited > SECONDS_WITHOUT_WORKERS:
                raise WorkersLost(
                    f"the last worker of {self.settings.describe()} was lost and none came for {waited:.0f} s: start workers, "
                    f"then {AGAIN}."
                )

    def _scheduler_gone(self) -> WorkersLost:
        is_named = self.settings.scheduler == "address"
        who = self.settings.describe() if is_named else f"the scheduler of {self.settings.describe()}"
        start = "start a scheduler, then " if is_named else ""
        return WorkersLost(f"{who} does not answer any more: {start}{AGAIN}.")

    def _join(self, address: str) -> None:
        """Begin the checks of a worker."""
        # A worker may have the address of a lost one, whose actor Dask remembers by its key: each attempt has a key of its own.
        self._joins += 1
        key = f"mivol-{id(self)}-{self._joins}"
        future = self.client.submit(Workplace, actor=True, workers=[address], allow_other_workers=False, pure=False, key=key)
        self._joining[address] = future

        async def begin() -> None:
            try:
                with self.client.as_current():
                    actor = await future
                facts = await actor.begin(self.variant, self.settings.threads)
            except Exception as error:
                self._news.put(("unfit", address, error))
            else:
                self._news.put(("joined", address, (actor, facts)))

        self.client.loop.add_callback(begin)

    def _admit(self, address: str, actor: Any, facts: Facts) -> None:
        """Take a checked worker into the pool; after the beginning, an unequal worker is left out."""
        self._joining.pop(address, None)
        if facts.doctor:
            self.say("\n".join([f"mivol doctor on {facts.host} ({address}):", *facts.doctor]))
        try:
            check_worker(address, facts)
            if self._has_begun:
                check_equal_workers({w.address: w.facts for w in self.workers.values()} | {address: facts})
        except MivolError as error:
            if not self._has_begun:
                raise
            self._refused.add(address)
            self.say(f"cluster: left out a worker that came later: {error}")
            return
        self.workers[address] = _Worker(address, actor, facts)

    def _refuse(self, address: str, error: Exception) -> None:
        """Refuse a worker that could not begin; a worker lost in the meantime is forgotten."""
        if self._joining.pop(address, None) is None or is_loss(error):
            return
        reason = f"{type(error).__name__}: {error}".rstrip(": ")
        fault = MivolError(
            f"worker {address} cannot load mivol {find_facts().software['mivol']} ({reason}): install the same mivol there "
            '(pip install "mivol[cluster]"), and run mivol doctor on it.'
        )
        if not self._has_begun:
            raise fault
        self._refused.add(address)
        self.say(f"cluster: left out a worker that came later: {fault}")

    def _lose(self, address: str) -> None:
        """Forget a lost worker, and take the units back."""
        worker = self.workers.pop(address)
        worker.actor = None
        self.gone.append(worker)
        self.lost += 1
        for number, unit in worker.units.items():
            self._losses[number] += 1
            if self._losses[number] >= MOST_LOSSES:
                raise WorkersLost(
                    f"{describe_unit(unit)} ended {MOST_LOSSES} workers, the last on {worker.facts.host}: their memory may be "
                    "too small, or LLVM aborts; run mivol doctor there, and take fewer workers a machine."
                )
            self.repeated += 1
            self._news.put(("again", number, unit))
        self.say(f"cluster: lost a worker on {worker.facts.host}, and sent {len(worker.units)} piece(s) of work again")

    # -- Inputs ------------------------------------------------------------------------------------------------------

    def share(self, digest: str, value: Any, size: int) -> str:
        """Register an input of units, sent to each worker at most once.

        Args:
            digest: content hash of the input.
            value: NumPy arrays and plain Python.
            size: bytes to send.

        Returns:
            ``digest``.

        Raises:
            MivolError: inputs larger than half of the memory of a worker.
        """
        self._inputs[digest] = (value, size)
        self.check_room()
        return digest

    def check_room(self, size: int = 0) -> None:
        """Refuse arrays that would fill a worker.

        Args:
            size: bytes of arrays that go to each worker beside the registered inputs.

        Raises:
            MivolError: the sum is larger than half of the memory of a worker.
        """
        total = size + sum(size for _, size in self._inputs.values())
        beside = Counter(worker.facts.host for worker in self.workers.values())
        for worker in self.workers.values():
            room = SHARE_OF_MEMORY * worker.facts.memory / beside[worker.facts.host]
            if worker.facts.memory and total > room:
                raise MivolError(
                    f"the inputs take {total / 2**30:,.1f} GiB in each worker, and half of the memory of a worker on "
                    f"{worker.facts.host} is {room / 2**30:,.1f} GiB: start fewer workers a machine, or give smaller inputs."
                )

    def forget(self, digest: str) -> None:
        """Remove an input here and in the workers; no unit under way may need it."""
        del self._inputs[digest]

        async def drop(worker: _Worker) -> None:
            with contextlib.suppress(Exception):
                await worker.actor.forget(digest)

        for worker in self.workers.values():
            if digest in worker.held:
                worker.held.discard(digest)
                self.client.loop.add_callback(drop, worker)

    # -- Work --------------------------------------------------------------------------------------------------------

    def run(self, units: Iterable[Unit | None], ahead: int = 2, check: Callable[[], None] = lambda: None) -> Iterator[tuple]:
        """Yield (key, result) of finished units.

        Args:
            units: drawn only when a worker is free; None means no unit before the next result.
            ahead: units of a worker at a time; 2 hide the time of the network.
            check: called while waiting; may raise, and the units under way are then given up.

        Raises:
            MivolError: a refusal of the work.
            WorkersLost: work that loses several workers, no worker any more, or a lost scheduler.
        """
        source, again, is_empty = iter(units), [], False
        waiting: dict[int, Unit] = {}
        self._drop_work()
        while True:
            is_idle = False
            while (worker := self._free_worker(ahead)) and not is_idle:
                number, unit = again.pop(0) if again else (self._numbers, None if is_empty else next(source, StopIteration))
                is_empty = is_empty or unit is StopIteration
                is_idle = unit is None or unit is StopIteration
                if not is_idle:
                    self._numbers = max(self._numbers, number + 1)
                    waiting[number] = unit
                    self._send(worker, number, unit)
            if is_empty and not waiting:
                return
            check()
            self._look()
            for kind, number, content in self._take_news(0.25):
                if kind == "again" and number in waiting:
                    again.append((number, content))
                elif kind == "done" and number in waiting:
                    unit = waiting.pop(number)
                    if isinstance(content, Failure):
                        raise content.error
                    yield unit.key, content

    def _drop_work(self) -> None:
        """Forget the units of an earlier call that was given up."""
        for worker in self.workers.values():
            worker.units.clear()
        while not self._news.empty():
            kind, name, content = self._news.get()
            if kind in ("joined", "unfit"):
                self._take(kind, name, content)

    def _free_worker(self, ahead: int) -> _Worker | None:
        """The worker with the fewest units, if it has less than ``ahead``, and no input on its way."""
        free = [worker for worker in self.workers.values() if len(worker.units) < ahead and not worker.sending]
        return min(free, key=lambda worker: len(worker.units), default=None)

    def _send(self, worker: _Worker, number: int, unit: Unit) -> None:
        """Send a unit, after the inputs that the worker lacks."""
        actor, missing = worker.actor, [digest for digest in unit.needs if digest not in worker.held]
        worker.heard = worker.heard if worker.units else time.monotonic()
        worker.units[number] = unit
        worker.sending |= set(missing)

        async def work() -> None:
            try:
                for digest in missing:
                    await actor.keep(digest, self._inputs[digest][0])
                    worker.held.add(digest)
                    self.sent += self._inputs[digest][1]
                worker.sending.clear()
                result = await actor.work(unit.function, *unit.args)
            except Exception as error:
                if is_loss(error):
                    return  # the list of workers tells of it
                result = Failure(error)
            self._news.put(("done", number, (worker.address, result)))

        self.client.loop.add_callback(work)

    def _take_news(self, timeout: float) -> list[tuple[str, Any, Any]]:
        """Wait for news, and return those of units."""
        found = []
        with contextlib.suppress(queue.Empty):
            news = self._news.get(timeout=timeout)
            while True:
                kind, name, content = news
                if kind == "done":
                    address, content = content
                    if address in self.workers:
                        self.workers[address].units.pop(name, None)
                        self.workers[address].done += 1
                        self.workers[address].heard = time.monotonic()
                    elif isinstance(content, Failure):
                        kind = "lost"  # an error of a lost worker, whose unit goes to another
                self._take(kind, name, content)
                found.append((kind, name, content))
                news = self._news.get_nowait()
        return found

    def _take(self, kind: str, name: str, content: Any) -> None:
        """Take news of workers."""
        if kind == "joined":
            self._admit(name, *content)
        elif kind == "unfit":
            self._refuse(name, content)

    # -- Telling -----------------------------------------------------------------------------------------------------

    def describe(self) -> str:
        """Number of workers in words, with losses and repeated work."""
        count = len(self.workers)
        lost = f", {self.lost} lost, {self.repeated} repeated" if self.lost else ""
        return f"{count} worker{'s' * (count != 1)}{lost}"

    def collect_progress(self, timeout: float) -> dict[Any, str]:
        """Newest progress of the work under way, by the key of the unit; workers that do not answer in time are left out."""
        busy = [worker for worker in self.workers.values() if worker.units]
        answers: queue.SimpleQueue[tuple[Any, str]] = queue.SimpleQueue()

        async def ask(worker: _Worker, key: Any) -> None:
            with contextlib.suppress(Exception):
                answers.put((key, await worker.actor.progress()))

        for worker in busy:
            self.client.loop.add_callback(ask, worker, next(iter(worker.units.values())).key)
        found, end = {}, time.monotonic() + timeout
        with contextlib.suppress(queue.Empty):
            while len(found) < len(busy) and (left := end - time.monotonic()) > 0:
                key, line = answers.get(timeout=left)
                found[key] = line
        return found

    def stop_work(self) -> None:
        """Ask all workers to stop at the next safe point."""

        async def ask(worker: _Worker) -> None:
            with contextlib.suppress(Exception):
                await worker.actor.stop()

        for worker in self.workers.values():
            self.client.loop.add_callback(ask, worker)

    def tabulate(self) -> Table:
        """Table of all workers of the run, for a page."""
        present = [(worker, "") for worker in self.workers.values()]
        rows = [
            (worker.facts.host, f"{worker.facts.pid}", f"{worker.done}", state)
            for worker, state in [*present, *((worker, "lost") for worker in self.gone)]
        ]
        title = f"Workers of the cluster: {self.describe()}"
        return Table(title=title, head=("host", "process", "finished pieces of work", ""), rows=tuple(rows))

    def describe_losses(self) -> list[str]:
        """A sentence about lost workers and repeated work, for the record; none without a loss."""
        if not self.lost:
            return []
        return [f"{self.lost} worker(s) of the cluster were lost, and {self.repeated} piece(s) of work were done again."]


def is_loss(error: Exception) -> bool:
    """Whether an error of Dask tells of a lost worker: of its connection, or of the actor that it held."""
    is_actor = isinstance(error, RuntimeError) and str(error).startswith("Worker holding Actor was lost")
    return isinstance(error, OSError) or is_actor or type(error).__name__ in ("KilledWorker", "FutureCancelledError")


def describe_unit(unit: Unit) -> str:
    """Name of a unit in a sentence."""
    return f"work {unit.key} ({unit.function.__name__})"


# -- Checks ------------------------------------------------------------------------------------------------------------------


def check_worker(address: str, facts: Facts, own: Facts | None = None) -> None:
    """Refuse a worker of other software than this process, with several threads, or without the variant.

    Raises:
        MivolError: with the worker, the finding and the expectation.
    """
    place = f"worker {address} on {facts.host}"
    own = own or find_facts()
    if facts.fault:
        raise MivolError(f"{place} cannot render: {facts.fault.rstrip('.')}; follow mivol doctor there, or stop this worker.")
    for name, expected in own.software.items():
        if facts.software.get(name) != expected:
            raise MivolError(
                f"{place} has {name} {facts.software.get(name, 'none')}, and this process {expected}: results would depend on "
                "the worker, so install the same versions there."
            )
    if facts.dask_threads != 1:
        raise MivolError(
            f"{place} has {facts.dask_threads} threads of Dask, and two threads lose gradients silently: start it with "
            "dask worker --nthreads 1; Dr.Jit still uses all of its cores."
        )


def check_equal_workers(workers: dict[str, Facts]) -> None:
    """Refuse workers whose CPUs have different vector features, because compiled kernels round differently.

    Raises:
        MivolError: with a worker of the smaller group.
    """
    counts = Counter(facts.cpu for facts in workers.values())
    if len(counts) < 2:
        return
    usual = counts.most_common(1)[0][0]
    address, odd = next((address, facts) for address, facts in workers.items() if facts.cpu != usual)
    lacking = " ".join(sorted(set(usual.split()) ^ set(odd.cpu.split())))
    raise MivolError(
        f"worker {address} on {odd.host} has other CPU features than {counts[usual]} other worker(s), namely in {lacking}: "
        "results would depend on the worker, so start all workers on equal nodes (SLURM: --constraint)."
    )
