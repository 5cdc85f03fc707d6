"""Ctrl-C and SIGTERM stop a run at the next safe point.

Conventions. The first signal is recorded, and :meth:`InterruptGuard.check` raises between kernels, before state changes. The
second signal raises at once. Kernels take at most seconds (``samples_per_pass``), as does the wait. A signal ignored from the
start of the process (Ctrl-C of a background job of a script) stays ignored.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType


class Interrupted(KeyboardInterrupt):
    """The run was interrupted at a safe point."""


class InterruptGuard:
    """Context manager that records signals; outside the main thread without effect.

    Attributes:
        is_requested: whether a signal has arrived.
    """

    signals = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.is_requested = False
        self._previous: dict[int, object] = {}

    def __enter__(self) -> InterruptGuard:
        if threading.current_thread() is threading.main_thread():
            handled = [number for number in self.signals if signal.getsignal(number) is not signal.SIG_IGN]
            self._previous = {number: signal.signal(number, self._note) for number in handled}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.is_requested:
            raise KeyboardInterrupt
        self.is_requested = True

    def check(self) -> None:
        """Stop here if a signal has arrived.

        Raises:
            Interrupted: a signal has arrived.
        """
        if self.is_requested:
            raise Interrupted
