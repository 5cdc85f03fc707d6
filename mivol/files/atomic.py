"""Write files so that neither a crash nor a second process leaves them incomplete.

Conventions. A temporary file in the folder of the destination is written, synced and renamed over the destination: a rename is
atomic only within one file system. The temporary is hidden, ends in ``.part`` and is removed after every error, Ctrl-C
included. A symbolic link stays: its target is replaced. :func:`lock_folder` keeps a second process out of a folder.
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

#: error number of the system -> (found, way out).
DISK_FAULTS: dict[int, tuple[str, str]] = {
    errno.ENOSPC: ("no space left on the disk", "free some space or write elsewhere"),
    errno.EDQUOT: ("the disk quota used up", "free some space or write elsewhere"),
    errno.EFBIG: ("a file larger than the limit of the system", "raise the limit (ulimit -f) or write elsewhere"),
    errno.EROFS: ("a read-only file system", "write elsewhere"),
    errno.EACCES: ("no permission to write", "change the permissions of the folder or write elsewhere"),
    errno.EPERM: ("no permission to write", "change the permissions of the folder or write elsewhere"),
    errno.ENAMETOOLONG: ("a file name that is too long", "choose a shorter name"),
    errno.EIO: ("an input/output error of the disk", "write to another disk"),
}


@contextlib.contextmanager
def disk_faults(path: str | os.PathLike, expected: str, left: str = "") -> Iterator[None]:
    """Turn errors of the system during a write into one sentence.

    Args:
        path: written file, the subject of the sentence.
        expected: what the disk should have had.
        left: state of the file after the error, appended to the way out.

    Raises:
        MivolError: an error of :data:`DISK_FAULTS`; other errors pass unchanged.
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
    """Yield a temporary path, and rename it to ``path`` after the body has ended without an error.

    Args:
        path: destination in an existing folder.

    Yields:
        A new path in the same folder, which the body must create.

    Raises:
        MivolError: a folder as destination, a missing folder, or an error of the system (full disk, quota, permission ...).
            An earlier file at ``path`` stays unchanged, and the temporary is removed.
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
            temporary.unlink()


def write_whole(path: str | os.PathLike, writer: Callable[[BinaryIO], object]) -> None:
    """Write a file through ``writer``, whole or not at all (:func:`whole_file`).

    Args:
        path: destination in an existing folder.
        writer: function called once with a seekable binary file.

    Raises:
        MivolError: errors of :func:`whole_file`; errors of ``writer`` pass unchanged.

    Example:
        >>> write_whole("run.json", lambda file: file.write(b"{}"))
    """
    with whole_file(path) as temporary, temporary.open("wb") as file:
        writer(file)


def write_whole_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write ``data`` to ``path``, whole or not at all (:func:`write_whole`)."""
    write_whole(path, lambda file: file.write(data))


def write_whole_text(path: str | os.PathLike, text: str) -> None:
    """Write ``text`` to ``path`` as UTF-8, whole or not at all (:func:`write_whole`)."""
    write_whole_bytes(path, text.encode("utf-8"))


_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{8}\.part")


def remove_temporaries(folder: Path) -> list[Path]:
    """Remove the temporaries of killed processes below a folder in which no other process writes.

    Returns:
        Removed files.
    """
    stale = [path for path in folder.rglob(".*.part") if _TEMPORARY.fullmatch(path.name) and path.is_file()]
    for path in stale:
        path.unlink(missing_ok=True)
    return stale


def check_destination(path: str | os.PathLike) -> None:
    """Refuse an impossible destination before the work for its content starts.

    Raises:
        MivolError: a folder as destination, a missing folder, or a folder without write permission.
    """
    target = _destination(Path(path))
    if not os.access(target.parent, os.W_OK):
        found, way_out = DISK_FAULTS[errno.EACCES]
        raise MivolError(f"{path}: found {found}, expected a folder to write into; {way_out}.")


def _destination(path: Path) -> Path:
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise MivolError(f"{path}: found a folder or device, expected a file to write; add a file name.")
    if not target.parent.is_dir():
        raise MivolError(f"{path}: found no folder {target.parent}, expected an existing folder; create it first.")
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


# -- Locks --------------------------------------------------------------------------------------------------------

LOCK = ".lock"
"""Locked file on Windows, which cannot lock folders."""


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a folder for this process on Linux, macOS and Windows. The system unlocks the folder when the process ends.

    A file system without locks (some network disks) gives no protection and no refusal.

    Raises:
        MivolError: another process holds the lock.
    """
    handle = os.open(folder, os.O_RDONLY) if os.name == "posix" else os.open(folder / LOCK, os.O_RDWR | os.O_CREAT)
    try:
        _lock(handle, folder.name)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, name: str) -> None:
    try:
        if os.name == "posix":
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            import msvcrt

            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
    except OSError as error:
        # If another process holds the lock, flock raises EWOULDBLOCK and msvcrt raises EACCES.
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise MivolError(f'another run uses the folder "{name}"; wait for its end, or choose another folder.') from None
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP):
            raise
