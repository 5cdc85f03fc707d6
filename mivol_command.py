"""The command ``mivol`` from its first line on: Ctrl-C during the import of Mitsuba is one sentence too.

This module lies outside the package, because any import from the package imports Mitsuba, which takes a second. Dr.Jit's import
turns an interrupt into another error, so a handler records the signal.
"""

from __future__ import annotations

import signal
import sys
from types import FrameType

STOPPED = 130


def main() -> int:
    """Run ``mivol``; return its exit code."""
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, note)
    try:
        from mivol.cli import main as command
    except BaseException:
        if not came:
            raise
    if came:
        print("mivol: stopped before anything was done.", file=sys.stderr)
        return STOPPED
    return command()
