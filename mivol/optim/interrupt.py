"""Ctrl-C and SIGTERM wait for the next safe point, where nothing is half done.

Conventions. The first signal is noted and raised by :meth:`InterruptGuard.check` between kernels, before any state has changed;
the second one acts at once. Kernels are kept to seconds (``samples_per_pass``), and so is the wait. A signal that this
process was started to ignore (Ctrl-C, for one that a script put into the background) stays ignored.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType


class Interrupted(KeyboardInterrupt):
    """The run was asked to stop and did so at a safe point."""


class InterruptGuard:
    """Context manager that turns signals into a question; outside the main thread it only answers."""

    signals = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> InterruptGuard:
        if threading.current_thread() is threading.main_thread():
            heard = [number for number in self.signals if signal.getsignal(number) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._note) for number in heard}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def check(self) -> None:
        """A safe point.

        Raises:
            Interrupted: a signal has come.
        """
        if self.asked:
            raise Interrupted
