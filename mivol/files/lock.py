"""One process at a time in a folder, on Linux, macOS and Windows."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mivol.errors import MivolError

__all__ = ["locked"]

LOCK = ".lock"
"""What is locked on Windows, where folders cannot be."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; the system lets go of it however the process ends.

    Where the file system knows no locks (some network disks) nothing is held, and nothing is refused.

    Raises:
        MivolError: another process holds it.
    """
    held = os.open(folder, os.O_RDONLY) if os.name == "posix" else os.open(folder / LOCK, os.O_RDWR | os.O_CREAT)
    try:
        _take(held, folder.name)
        yield
    finally:
        os.close(held)


def _take(held: int, name: str) -> None:
    try:
        if os.name == "posix":
            import fcntl

            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            import msvcrt

            msvcrt.locking(held, msvcrt.LK_NBLCK, 1)
    except OSError as error:
        # EWOULDBLOCK is flock's answer where another process holds it, EACCES that of msvcrt.
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise MivolError(f'another run is at work in "{name}": wait for its end, or choose another folder.') from None
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):
            raise
