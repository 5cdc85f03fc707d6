"""The command ``mivol`` from its first line on: Ctrl-C while Mitsuba is imported is one sentence too.

This module lies outside the package, since importing anything in the package imports Mitsuba, which takes a second.
"""

from __future__ import annotations

import sys

STOPPED = 130


def main() -> int:
    """Run ``mivol``; its exit code."""
    try:
        from mivol.cli import main as command
    except KeyboardInterrupt:
        print("mivol: stopped before anything was done.", file=sys.stderr)
        return STOPPED
    return command()
