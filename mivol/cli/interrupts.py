"""Ctrl-C and SIGTERM end a command with one sentence at any moment.

Conventions. The handler raises KeyboardInterrupt. A callback from C++ (a render, a film) may turn the interrupt into another
error, with or without the interrupt as the cause. Therefore the handler also records the signal, and every later error counts
as a consequence of the signal.
"""

from __future__ import annotations

import signal
from types import FrameType


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
