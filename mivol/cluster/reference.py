"""References and images over the workers of a cluster: batches of views, and passes of samples, as work.

Conventions. A unit is a few batches of one view. The owner adds batches in the order of their numbers, so a reference is the
same to the bit as one of a single process. Workers begin the next views while the last batches of a view are on their way.
Batches beyond the end of a view, which its error decides, are thrown away.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mivol.cluster.packages import decode_sensor, encode_sensor, open_scene
from mivol.cluster.pool import Pool, Unit
from mivol.cluster.workplace import Workplace
from mivol.experiments.render import Passes, choose_integrator, render_in_turn
from mivol.experiments.run_folder import SECONDS_BETWEEN_PAGES
from mivol.optim.interrupt import InterruptGuard
from mivol.report.page import SweepNews, SweepRow, write_sweep_page
from mivol.scene.load import LoadedScene
from mivol.scene.sensors import find_sensor
from mivol.validate.reference import PATHS_PER_PASS, Complete, PreparedReference, ReferenceResult, RenderSetup

LONGEST_UNIT = 8
"""Batches of a unit at most: their images travel together."""

AHEAD = 4
"""Units of a view that may wait for an earlier one, as a multiple of the workers."""

Show = Callable[[str], None]

ShowRows = Callable[[list[SweepRow], bool], None]
"""Receives the views, and whether some are under way."""


def render_batches_in_worker(
    place: Workplace, scene: str, sensor: Any, method: dict[str, Any], pass_spp: int, seed: int, numbers: range
) -> tuple[list[np.ndarray], float]:
    """Render batches in a worker.

    Returns:
        Images (H, W, C), float32 as rendered, and the time of the renders [s].
    """
    loaded = open_scene(place, scene)
    key = f"setup {scene} {sensor} {sorted(method.items())} {pass_spp} {seed}"
    setup = place.made(key, lambda: _make_setup(loaded, sensor, method, pass_spp, seed))
    start = time.monotonic()
    return [setup.batch(number).astype(np.float32) for number in numbers], time.monotonic() - start


def _make_setup(loaded: LoadedScene, sensor: Any, method: dict[str, Any], pass_spp: int, seed: int) -> RenderSetup:
    return replace(RenderSetup.from_scene(loaded, decode_sensor(sensor), method, seed), pass_spp=pass_spp)


@dataclass
class _View:
    """A view under way: batches sent, and images that wait for earlier ones."""

    number: int
    reference: PreparedReference
    sensor: Any
    sent: int = 0
    waiting: dict[int, tuple[np.ndarray, float]] = field(default_factory=dict)

    def next_numbers(self, most: int) -> range:
        """Numbers of the next batches to send; empty if enough are under way."""
        if self.reference.is_reached:
            return range(0)
        length = max(1, min(LONGEST_UNIT, PATHS_PER_PASS["llvm"] // self._paths()))
        if self.sent >= self.reference.run.moments.n + most * length:
            return range(0)
        return range(self.sent, min(self.sent + length, self.reference.count_batches()))

    def _paths(self) -> int:
        rows, columns, _ = self.reference.setup.shape
        return rows * columns * self.reference.setup.pass_spp

    def row(self, status: str) -> SweepRow:
        """The view as a row of a page."""
        reference, kept = self.reference, self.reference.finished
        done = reference.run.moments.n
        samples = done * reference.setup.pass_spp if kept is None else kept.spp
        is_under_way = status != "finished" and kept is None
        progress = f"{done} of {reference.count_batches()} batches" if is_under_way else ""
        shown = status if kept is None else "finished"
        return SweepRow(reference.path.name, {}, shown, progress, {"samples a pixel": float(samples)})

    def take(self, numbers: range, images: list[np.ndarray], seconds: float) -> None:
        """Add images in the order of their numbers; those beyond the goal are dropped."""
        self.waiting |= {n: (image, seconds / len(images)) for n, image in zip(numbers, images, strict=True)}
        while not self.reference.is_reached and (batch := self.waiting.pop(self.reference.run.moments.n, None)) is not None:
            self.reference.add(*batch)


def complete_on(
    pool: Pool, scene: str, show: Show = lambda line: None, page: ShowRows = lambda rows, is_running: None
) -> Complete:
    """Return the function that renders prepared references on workers.

    Args:
        pool: workers.
        scene: content hash of the scene, from :func:`mivol.cluster.packages.share_scene`.
        show: receives the progress of all workers in a line.
        page: receives the views from time to time, and at the end.
    """
    return partial(_complete, pool, scene, show, page)


def _complete(
    pool: Pool, scene: str, show: Show, page: ShowRows, prepared: Iterator[PreparedReference]
) -> Iterator[ReferenceResult]:
    queue = _Queue(pool, scene, iter(prepared))
    try:
        with InterruptGuard() as stop:
            stream = pool.run(queue.units(), check=stop.check)
            while view := queue.first():
                while not view.reference.is_reached:
                    (number, numbers), (images, seconds) = next(stream)
                    queue.take(number, numbers, images, seconds)
                    show(queue.describe())
                    page([*queue.finished, *queue.rows()], True)
                queue.views.remove(view)
                result = view.reference.finish()
                queue.finished.append(view.row("finished"))
                yield result
    finally:
        for view in queue.views:
            view.reference.save()
        page([*queue.finished, *queue.rows("stopped")], False)


class _Queue:
    """Views under way, in order; the next view is prepared when a worker is free for it."""

    def __init__(self, pool: Pool, scene: str, prepared: Iterator[PreparedReference]) -> None:
        self.pool, self.scene, self.prepared = pool, scene, prepared
        self.views: list[_View] = []
        self.finished: list[SweepRow] = []
        self.count, self.is_all = 0, False

    def first(self) -> _View | None:
        """The first unfinished view; None after the last."""
        return self.views[0] if self.views else self._prepare()

    def _prepare(self) -> _View | None:
        reference = next(self.prepared, None)
        if reference is None:
            self.is_all = True
            return None
        sensor = encode_sensor(reference.setup.scene, reference.sensor)
        view = _View(self.count, reference, sensor, sent=reference.run.moments.n)
        self.count += 1
        self.views.append(view)
        return view

    def units(self) -> Iterator[Unit | None]:
        """Units of the first view that needs batches; None if all needed ones are under way."""
        while not (self.is_all and not self.views):
            most = AHEAD * max(1, len(self.pool.workers))
            view, numbers = next(((v, n) for v in self.views if (n := v.next_numbers(most))), (None, range(0)))
            if view is None and not self.is_all and len(self.views) <= most:
                self._prepare()
                continue
            yield None if view is None else self._unit(view, numbers)

    def _unit(self, view: _View, numbers: range) -> Unit:
        view.sent = numbers.stop
        setup = view.reference.setup
        args = (self.scene, view.sensor, view.reference.method, setup.pass_spp, setup.identity["seed"], numbers)
        return Unit((view.number, numbers), render_batches_in_worker, args, (self.scene,))

    def take(self, number: int, numbers: range, images: list[np.ndarray], seconds: float) -> None:
        """Give a result to its view; a finished view needs it no more."""
        view = next((view for view in self.views if view.number == number), None)
        if view is not None:
            view.take(numbers, images, seconds)

    def rows(self, status: str = "running") -> list[SweepRow]:
        """Views under way as rows of a page."""
        return [view.row(status) for view in self.views]

    def describe(self) -> str:
        """Progress in a line."""
        parts = [f"view {v.number}: {v.reference.run.moments.n} of {v.reference.count_batches()}" for v in self.views if v.sent]
        return f"{self.pool.describe()}, batches of {', '.join(parts[:4])}{', ...' * (len(parts) > 4)}"


class ReferencePage:
    """The page ``references.html`` of references under way: views, workers, and repeated work."""

    def __init__(self, pool: Pool, folder: Path, title: str, say: Show = lambda line: None) -> None:
        """Choose the place of the page.

        Args:
            pool: workers.
            folder: of the page.
            title: heading.
            say: receives the path of the page at the end.
        """
        self.pool, self.folder, self.title, self.say, self.written = pool, folder, title, say, 0.0

    def __call__(self, rows: list[SweepRow], is_running: bool) -> None:
        """Write the page, every few seconds and at the end."""
        if is_running and time.monotonic() - self.written < SECONDS_BETWEEN_PAGES:
            return
        self.written = time.monotonic()
        news = SweepNews({}, tuple(self.pool.describe_losses()), self.pool.tabulate(), is_running)
        page = write_sweep_page(self.folder, self.title, (), rows, news, "references.html")
        if not is_running:
            self.say(f"{page}")


# -- Images ------------------------------------------------------------------------------------------------------------------


def render_pass(
    place: Workplace, scene: str, sensor: int, integrator: str | dict[str, Any] | None, seed: int, spp: int
) -> tuple[np.ndarray, float]:
    """Render a pass in a worker.

    Args:
        place: the worker.
        scene: content hash of the scene.
        sensor: number of the sensor.
        integrator: name, or dict of an integrator; None: the scene's.
        seed, spp: seed, and samples per pixel.

    Returns:
        Image, float32, and the time of its render [s].
    """
    loaded = open_scene(place, scene)

    def make() -> mi.Integrator:
        return mi.load_dict(integrator) if isinstance(integrator, dict) else choose_integrator(loaded.scene, integrator)

    used = place.made(f"integrator {scene} {integrator}", make)
    return next(render_in_turn(loaded.scene, find_sensor(loaded.scene, sensor), used)([(seed, spp)]))


def passes_on(
    pool: Pool, scene: str, sensor: int, integrator: str | dict[str, Any] | None, show: Show = lambda line: None
) -> Passes:
    """Return the function that renders passes on workers, and yields them in their order.

    Args:
        pool: workers.
        scene: content hash of the scene.
        sensor: number of the sensor.
        integrator: name, or dict of an integrator; None: the scene's.
        show: receives the progress in a line.
    """

    def render(passes: Sequence[tuple[int, int]]) -> Iterator[tuple[np.ndarray, float]]:
        units = (
            Unit(number, render_pass, (scene, sensor, integrator, seed, spp), (scene,))
            for number, (seed, spp) in enumerate(passes)
        )
        waiting: dict[int, tuple[np.ndarray, float]] = {}
        due = 0
        for number, found in pool.run(units):
            waiting[number] = found
            while due in waiting:
                yield waiting.pop(due)
                due += 1
            show(f"{pool.describe()}, {due} of {len(passes)} passes")

    return render
