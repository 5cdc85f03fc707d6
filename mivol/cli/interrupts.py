"""Ctrl-C and SIGTERM end a command with one sentence, wherever they strike.

Conventions. The handler raises KeyboardInterrupt. A call back from C++ (a render, a film) may make another error of it, with
the interrupt as its reason, or with none: so it is also noted that a signal has come, and whatever error follows is its doing.
"""

from __future__ import annotations

import signal
from types import FrameType


class Signals:
    """Notes that a signal has come, and raises KeyboardInterrupt.

    A signal that this process was started to ignore (Ctrl-C, for one that a script put into the background) stays ignored.

    Attributes:
        came: whether one has come.
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
        """Whether an error is the doing of a signal: one has come, or a KeyboardInterrupt is among the error's reasons."""
        reason: BaseException | None = error
        while reason is not None and not self.came:
            if isinstance(reason, KeyboardInterrupt):
                return True
            reason = reason.__cause__ or reason.__context__
        return self.came
