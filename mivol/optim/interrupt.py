"""Ctrl-C and SIGTERM stop a run at the next safe point, and end a command with one sentence.

Conventions. In a run, the first signal is recorded, and :meth:`InterruptGuard.check` raises between kernels, before state
changes. The second signal raises at once. Kernels take at most seconds (``samples_per_pass``), as does the wait. A signal
ignored from the start of the process (Ctrl-C of a background job of a script) stays ignored.

Outside a run, the handler of a command raises KeyboardInterrupt. A callback from C++ (a render, a film) may turn the interrupt
into another error, with or without the interrupt as the cause. Therefore the handler also records the signal, and every later
error counts as a consequence of the signal.
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


# -- End of a command ------------------------------------------------------------------------------------------------------


class Signals:
    """Records signals, and raises KeyboardInterrupt.

    A signal ignored at the start of the process stays ignored, for example Ctrl-C for a background job of a script.

    Attributes:
        came: whether a signal has come.
    """

    def __init__(self) -> None:
        self.came = False
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._note)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        raise KeyboardInterrupt

    def are_behind(self, error: BaseException) -> bool:
        """Whether a signal caused an error: a signal has come, or a KeyboardInterrupt is among the error's reasons."""
        reason: BaseException | None = error
        while reason is not None and not self.came:
            if isinstance(reason, KeyboardInterrupt):
                return True
            reason = reason.__cause__ or reason.__context__
        return self.came
