"""An experiment that is to be done, and who is told how it goes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar

from mivol.config import Experiment, PhotoFit, Scan
from mivol.optim.loop import Fit

T = TypeVar("T")


class Watcher(Protocol):
    """Who is told how a run goes: a terminal, a notebook, nobody."""

    def say(self, lines: Sequence[str]) -> None:
        """Sentences about what will be done."""

    def track(self, items: Sequence[T], what: str) -> Iterator[T]:
        """The items one by one, as they are worked on."""

    def watch(self, iterations: int) -> AbstractContextManager[Callable[[Fit], None]]:
        """What is to be called after each iteration of a fit that ends after so many."""


class Nobody:
    """A watcher that tells nobody."""

    def say(self, lines: Sequence[str]) -> None:
        """Nothing is said."""

    def track(self, items: Sequence[T], what: str) -> Iterator[T]:
        """The items, one by one."""
        return iter(items)

    def watch(self, iterations: int) -> AbstractContextManager[Callable[[Fit], None]]:
        """Nothing is drawn."""
        return nullcontext(lambda fit: None)


@dataclass(frozen=True)
class Task:
    """An experiment that is to be done.

    Attributes:
        chosen: all settings.
        base: folder that the paths in them are relative to.
        folder: run folder; made where it is not there.
        resume: continue from the folder's checkpoint.
        watcher: who is told how it goes.
        command: what was typed, for the record; empty where no command was.
    """

    chosen: Experiment | Scan | PhotoFit
    base: Path
    folder: Path
    resume: bool = False
    watcher: Watcher = field(default_factory=Nobody)
    command: str = ""
