"""The verbs over a cluster: flags, progress of all workers in one line, and calls of :mod:`mivol.cluster`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from mivol.errors import MivolError
from mivol.optim.interrupt import InterruptGuard

if TYPE_CHECKING:
    from mivol.cluster.pool import Pool
    from mivol.config import Experiment
    from mivol.experiments.fit_kind import Distribution
    from mivol.experiments.render import Passes
    from mivol.scene.load import LoadedScene
    from mivol.validate.reference import Complete


def say(line: str) -> None:
    """Print a line on the error output."""
    print(line, file=sys.stderr, flush=True)


@contextmanager
def open_workers(where: str, variant: str, threads: int) -> Iterator[Pool]:
    """The workers of ``--cluster``; Ctrl-C while they start ends the command, and lost workers are told at the end.

    Raises:
        MivolError: as :func:`mivol.cluster.connection.open_pool`.
    """
    from mivol.cluster.connection import open_pool

    with InterruptGuard() as stop:
        opened = open_pool(where, variant, threads, say, stop.check)
        pool = opened.__enter__()
    try:
        yield pool
    finally:
        for line in pool.describe_losses():
            say(f"cluster: {line}")
        opened.__exit__(None, None, None)


SECONDS_BETWEEN_LINES = 30.0
"""Interval between two lines about the progress, if the error output is no terminal."""


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """A line on the terminal that each call replaces, at most five times a second; elsewhere a line now and then."""
    console, drawn = Console(stderr=True), -SECONDS_BETWEEN_LINES

    def show(line: str) -> None:
        nonlocal drawn
        if time.monotonic() - drawn < (0.2 if console.is_terminal else SECONDS_BETWEEN_LINES):
            return
        drawn = time.monotonic()
        if not console.is_terminal:
            say(f"cluster: {line}")
            return
        text = Text(line)
        text.truncate(max(10, console.width - 1), overflow="ellipsis")
        console.file.write(f"\r\x1b[K{text.plain}")
        console.file.flush()

    try:
        yield show
    finally:
        if console.is_terminal and drawn > 0:
            console.file.write("\r\x1b[K")
            console.file.flush()


@contextmanager
def complete_references(arguments: argparse.Namespace, loaded: LoadedScene) -> Iterator[Complete]:
    """The function that renders references on the workers of ``--cluster``, or in this process."""
    if arguments.cluster is None:
        from mivol.validate.reference import complete_in_turn

        yield complete_in_turn
        return
    from mivol.cluster.packages import SceneSource, share_scene
    from mivol.cluster.reference import ReferencePage, complete_on

    with open_workers(arguments.cluster, arguments.mode, arguments.threads) as pool, status_line() as show:
        page = ReferencePage(pool, arguments.output, f"References of {arguments.scene.name}", say)
        page = page if arguments.sensor == "all" else lambda rows, is_running: None
        yield complete_on(pool, share_scene(pool, scene_source(arguments, SceneSource), loaded), show, page)


@contextmanager
def render_passes(arguments: argparse.Namespace, loaded: LoadedScene) -> Iterator[Passes | None]:
    """The function that renders passes of an image on the workers of ``--cluster``; None without the flag."""
    if arguments.cluster is None:
        yield None
        return
    from mivol.cluster.packages import SceneSource, share_scene
    from mivol.cluster.reference import passes_on

    with open_workers(arguments.cluster, arguments.mode, arguments.threads) as pool, status_line() as show:
        scene = share_scene(pool, scene_source(arguments, SceneSource), loaded)
        yield passes_on(pool, scene, arguments.sensor, arguments.integrator, show)


def check_alone(arguments: argparse.Namespace) -> None:
    """Refuse ``--cluster`` for an image of a field or of points.

    Raises:
        MivolError: the flag is given.
    """
    if arguments.cluster is not None:
        raise MivolError(f"{arguments.scene}: --cluster renders scenes (.xml); a field or points take seconds: leave it out.")


@contextmanager
def validate_on_workers(arguments: argparse.Namespace, loaded: LoadedScene, depth: int | None) -> Iterator[dict[str, Any]]:
    """Keywords of :func:`mivol.experiments.validation.validate_scene` for the workers of ``--cluster``; none without it."""
    if arguments.cluster is None:
        yield {}
        return
    from mivol.cluster.packages import SceneSource, share_scene
    from mivol.cluster.reference import complete_on, passes_on
    from mivol.scene.explain import describe_light

    integrator = {"type": "mivol", **describe_light(loaded.scene, depth)}
    with open_workers(arguments.cluster, arguments.mode, arguments.threads) as pool, status_line() as show:
        scene = share_scene(pool, scene_source(arguments, SceneSource), loaded)
        passes = passes_on(pool, scene, arguments.sensor, integrator, show)
        yield {"complete": complete_on(pool, scene, show), "make_passes": lambda *own: passes}


def scene_source(arguments: argparse.Namespace, make: Callable[..., Any]) -> Any:
    """The scene file of the flags as workers load it."""
    from mivol.cli import parse_defines

    folders = tuple(Path(folder) for folder in filter(None, arguments.a.split(";")))
    return make(arguments.scene, parse_defines(arguments.define), folders)


@contextmanager
def distribute_fit(arguments: argparse.Namespace, settings: Experiment) -> Iterator[Distribution | None]:
    """What computes the gradients of a fit on the workers of ``--cluster``; None without the flag."""
    if arguments.cluster is None:
        yield None
        return
    from mivol.back_end import choose_back_end
    from mivol.cluster.distribution import ClusterDistribution

    choose_back_end(settings.variant, settings.threads)
    with open_workers(arguments.cluster, settings.variant, settings.threads) as pool, status_line() as show:
        yield ClusterDistribution(pool, show)


def sweep(arguments: argparse.Namespace) -> int:
    """Run ``mivol sweep``, in turn or on the workers of ``--cluster``; return the exit code."""
    from mivol.back_end import choose_back_end
    from mivol.cli.progress import TerminalProgress
    from mivol.experiments.sweep import plan_sweep, run_in_turn, run_sweep

    found = plan_sweep(arguments.experiment, arguments.over, arguments.set, arguments.output, arguments.command)
    progress = TerminalProgress()
    if arguments.cluster is None:
        page, refused = run_sweep(found, run_in_turn(progress), progress.say)
    else:
        from mivol.cluster.sweep import run_on

        first = found.runs[0].settings
        choose_back_end(first.variant)
        with open_workers(arguments.cluster, first.variant, first.threads) as pool, status_line() as show:
            page, refused = run_sweep(found, run_on(pool, show), progress.say)
    print(page)
    if refused:
        say(f"mivol: {refused} of {len(found.runs)} runs were refused; the page says why.")
    return int(refused > 0)
