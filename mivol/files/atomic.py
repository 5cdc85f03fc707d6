"""A file is on disk whole or not at all: written beside its place, synced, then renamed over it.

Conventions. The temporary lies in the same folder as the destination (a rename is atomic only within one file system),
is hidden and ends in ``.part``; it is removed whatever goes wrong, Ctrl-C included. A symbolic link is followed, so the
file it points to is replaced and the link stays.

Here: :func:`whole_file` (for writers that want a path), :func:`write_whole` (for writers that want a binary file),
:func:`write_whole_bytes`, :func:`write_whole_text`; :func:`remove_temporaries` cleans up after killed processes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mivol.errors import MivolError

#: What the operating system said -> (what was found, the way out).
DISK_FAULTS: dict[int, tuple[str, str]] = {
    errno.ENOSPC: ("no space left on the disk", "free some space or write elsewhere"),
    errno.EDQUOT: ("the disk quota used up", "free some space or write elsewhere"),
    errno.EFBIG: ("a file larger than the system allows here", "raise the limit (ulimit -f) or write elsewhere"),
    errno.EROFS: ("a read-only file system", "write elsewhere"),
    errno.EACCES: ("no permission to write there", "change the folder's permissions or write elsewhere"),
    errno.EPERM: ("no permission to write there", "change the folder's permissions or write elsewhere"),
    errno.ENAMETOOLONG: ("a file name that is too long", "choose a shorter one"),
    errno.EIO: ("an input/output error of the disk", "write to another disk"),
}


@contextlib.contextmanager
def disk_faults(path: str | os.PathLike, expected: str, left: str = "") -> Iterator[None]:
    """Say in a sentence what the system refuses while something is written.

    Args:
        path: what is written; first in the sentence.
        expected: what the disk should have had.
        left: what is left of it, after the way out.

    Raises:
        MivolError: for what :data:`DISK_FAULTS` knows; other errors pass.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FAULTS:
            raise
        found, way_out = DISK_FAULTS[error.errno]
        raise MivolError(f"{path}: found {found} while writing, expected {expected}; {way_out}{left}.") from error


@contextlib.contextmanager
def whole_file(path: str | os.PathLike) -> Iterator[Path]:
    """Give a temporary path to write to; on leaving without an error it takes the place of ``path``.

    Args:
        path: the destination; its folder must exist.

    Yields:
        A path in the same folder that does not exist yet; the body must create it.

    Raises:
        MivolError: the destination is a folder, its folder is missing, or the system refused the write (disk full,
            quota, permission ...); what was at ``path`` before is untouched and the temporary is gone.
    """
    target = _destination(Path(path))
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    try:
        with disk_faults(path, "room for the whole file", " (nothing was left half-written)"):
            yield temporary
            _sync(temporary)
            temporary.replace(target)
            _sync_folder(target.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_whole(path: str | os.PathLike, writer: Callable[[BinaryIO], object]) -> None:
    """Write a file through ``writer``, never half: see :func:`whole_file`.

    Args:
        path: the destination; its folder must exist.
        writer: called once with a binary file, open for writing and seekable.

    Raises:
        MivolError: as :func:`whole_file`; whatever ``writer`` raises is passed on.

    Example:
        >>> write_whole("run.json", lambda file: file.write(b"{}"))
    """
    with whole_file(path) as temporary, temporary.open("wb") as file:
        writer(file)


def write_whole_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write ``data`` to ``path``, never half: see :func:`write_whole`."""
    write_whole(path, lambda file: file.write(data))


def write_whole_text(path: str | os.PathLike, text: str) -> None:
    """Write ``text`` to ``path`` as UTF-8, never half: see :func:`write_whole`."""
    write_whole_bytes(path, text.encode("utf-8"))


_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{8}\.part")


def remove_temporaries(folder: Path) -> list[Path]:
    """Remove the temporaries of killed processes from a folder and the folders in it; call it where nobody else writes.

    Returns:
        What was removed.
    """
    stale = [path for path in folder.rglob(".*.part") if _TEMPORARY.fullmatch(path.name) and path.is_file()]
    for path in stale:
        path.unlink(missing_ok=True)
    return stale


def check_destination(path: str | os.PathLike) -> None:
    """Refuse a file name that nothing can be written to, before there is anything to write.

    Raises:
        MivolError: the name is that of a folder, its folder is missing, or nothing may be written there.
    """
    target = _destination(Path(path))
    if not os.access(target.parent, os.W_OK):
        found, way_out = DISK_FAULTS[errno.EACCES]
        raise MivolError(f"{path}: found {found}, expected a folder to write into; {way_out}.")


def _destination(path: Path) -> Path:
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise MivolError(f"{path}: found a folder or device, expected the name of a file to write; add a file name.")
    if not target.parent.is_dir():
        raise MivolError(f"{path}: found no folder {target.parent}, expected one to write into; create it first.")
    return target


def _sync(path: Path) -> None:
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


LOCK = ".lock"
"""What is locked on Windows, where folders cannot be."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
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
