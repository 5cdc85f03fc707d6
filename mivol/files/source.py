"""The bytes of a file, and what they must add up to.

Every reader takes its bytes from here, so that a missing, empty, truncated or damaged file is refused in the same words
everywhere: what was found, what was expected, the way out.
"""

from __future__ import annotations

import bz2
import difflib
import lzma
import os
import re
import sys
import textwrap
import warnings
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from mivol.errors import MivolError

T = TypeVar("T")

#: Characters of what was found that a refusal quotes; line ends in it become blanks.
LONGEST_QUOTE = 300

#: codec name -> constructor of a decompressor with ``decompress(data, max_length)``, ``eof`` and ``unused_data``.
CODECS: dict[str, Callable[[], object]] = {
    "zlib": lambda: zlib.decompressobj(zlib.MAX_WBITS),
    "gzip": lambda: zlib.decompressobj(zlib.MAX_WBITS | 16),
    "bzip2": bz2.BZ2Decompressor,
    "lzma": lzma.LZMADecompressor,
}


def refusal(subject: object, found: str, expected: str, way_out: str) -> MivolError:
    """The one sentence that refuses an input (``subject``: file or parameter): found, expected, the way out."""
    found = textwrap.shorten(found, LONGEST_QUOTE, placeholder=" ...")
    return MivolError(f"{subject}: found {found}, expected {expected}; {way_out}.")


#: the way out of a reader that a folder was given to.
RAW_SLICES = "name a file in it (a stack of raw slices is read by read_slices)"


def check_file(path: str | os.PathLike, in_a_folder: str = RAW_SLICES) -> Path:
    """The path, if it names a file that holds at least one byte.

    Args:
        path: what is looked for.
        in_a_folder: the way out where a folder is there.

    Raises:
        MivolError: nothing is there (the nearest name in the folder is offered), a folder is there, or an empty file.
    """
    path = Path(path)
    try:
        is_folder = path.is_dir()
    except OSError as error:  # a name that no file can have: headers name other files
        raise refusal(path.name[:LONGEST_QUOTE], f"a name that is none ({error.strerror})", "a file's", "correct it") from None
    if is_folder:
        raise refusal(path, "a folder", "a file", in_a_folder)
    if not path.is_file():
        raise refusal(path, "nothing there", "an existing file", _nearest(path))
    if path.stat().st_size == 0:
        raise refusal(path, "an empty file", "data", "copy or write it again")
    return path


def numbered_files(header: Path, pattern: str, numbers: range, most: int) -> list[Path]:
    """Files beside a header whose names hold a number, as ``slice%03d.raw`` of 0, 1, ...; each of them is there.

    Args:
        header: the file that names them.
        pattern: a name with one ``%d``, ``%3d`` or ``%03d``.
        numbers: what is put there.
        most: how many there may be, since each holds at least one number of ``most``.

    Raises:
        MivolError: another pattern, no number, more than ``most``, a file that is not there.
    """
    if not re.fullmatch(r"[^%]*%\d{0,2}d[^%]*", pattern):
        raise refusal(header, f"the pattern {pattern!r} of files", "a name with one %d or %03d", "correct the header")
    if not numbers or numbers[most:]:
        found = f"files numbered from {numbers.start} to {numbers.stop} in steps of {numbers.step}"
        raise refusal(header, found, f"1 to {most} files", "correct the header")
    return [check_file(header.parent / (pattern % number)) for number in numbers]


def read_bytes(path: str | os.PathLike) -> bytes:
    """All bytes of an existing, non-empty file.

    Raises:
        MivolError: as :func:`check_file`, or the file may not be read.
    """
    path = check_file(path)
    try:
        return path.read_bytes()
    except PermissionError as error:
        raise refusal(path, "no permission to read it", "a readable file", "change its permissions") from error


def select_by_suffix(path: Path, table: Mapping[str, T]) -> T:
    """What a table of suffixes has for a file.

    Raises:
        MivolError: a suffix that it does not have.
    """
    if path.suffix.lower() not in table:
        raise refusal(path, f"the suffix {path.suffix!r}", f"one of {', '.join(table)}", "convert the file or correct its name")
    return table[path.suffix.lower()]


def parse_elements(data: bytes, dtype: np.dtype | str, count: int, path: object, *, offset: int = 0) -> np.ndarray:
    """The ``count`` numbers that fill ``data`` from byte ``offset`` to its end, exactly.

    Args:
        data: the bytes of the file or of one decompressed block.
        dtype: NumPy type with its byte order.
        count: how many numbers the header promises.
        path: named in the refusal.
        offset: first byte of the numbers.

    Returns:
        A read-only view (count,) of ``data``.

    Raises:
        MivolError: fewer or more bytes than promised.
    """
    dtype = np.dtype(dtype)
    held, promised = len(data) - offset, count * dtype.itemsize
    if held != promised:
        fault = "truncated" if held < promised else "longer than its header says"
        raise refusal(
            path,
            f"{max(held, 0)} bytes of data",
            f"{promised} ({count} numbers of {dtype.itemsize} bytes, from the header)",
            f"the file is {fault}: copy it again or correct the header",
        )
    return np.frombuffer(data, dtype, count, offset)


def parse_numbers(text: bytes | str, count: int, path: object) -> np.ndarray:
    """The ``count`` numbers written in ``text``, separated by white space or commas, as float64 (count,).

    Raises:
        MivolError: something that is not a number, or another count.
    """
    if isinstance(text, bytes):
        text = text.decode("ascii", errors="replace")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.fromstring(text.replace(",", " "), dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise refusal(path, "text that is not a number among the values", "numbers only", "write it again") from error
    if values.size != count:
        fault = "truncated" if values.size < count else "longer than its header says"
        raise refusal(path, f"{values.size} numbers", f"{count} (from the header)", f"the file is {fault}: write it again")
    return values


def parse_integers(text: str, count: int, path: object, name: str) -> list[int]:
    """The ``count`` whole numbers in ``text``, separated by white space.

    Args:
        text: the value of a header's field.
        count: how many there must be.
        path: the file, named in the refusal.
        name: the field, named in the refusal.

    Raises:
        MivolError: something else, or another count.
    """
    words = text.split()
    if len(words) != count or not all(re.fullmatch(r"[+-]?\d{1,18}", word, re.ASCII) for word in words):
        raise refusal(path, f"'{name} = {text.strip()}'", f"whole numbers ({count})", "correct the header")
    return [int(word) for word in words]


def parse_reals(text: str, count: int, path: object, name: str) -> np.ndarray:
    """The ``count`` numbers in ``text``, separated by white space or commas, as float64 (count,).

    As :func:`parse_numbers`, for a field of a header: arguments and refusal as :func:`parse_integers`.
    """
    try:
        return parse_numbers(text, count, path)
    except MivolError as error:
        raise refusal(path, f"'{name} = {text.strip()}'", f"numbers ({count})", "correct the header") from error


def decompress(data: bytes, codec: str, limit: int, path: object) -> bytes:
    """Decompress all of ``data``, never to more than ``limit`` bytes (the header's promise bounds the memory).

    Concatenated streams (several gzip members) are joined; zero padding after the last one is skipped.

    Args:
        data: compressed bytes.
        codec: a key of :data:`CODECS`.
        limit: the most bytes that the header allows.
        path: named in the refusal.

    Raises:
        MivolError: damaged, truncated, or longer than ``limit``.
    """
    limit = min(limit, sys.maxsize - 1)
    pieces, total, rest = [], 0, data
    while rest:
        stream = CODECS[codec]()
        try:
            piece = stream.decompress(rest, limit + 1 - total)
        except (zlib.error, OSError, EOFError, lzma.LZMAError) as error:
            raise refusal(path, f"damaged {codec} data ({error})", "a sound stream", "copy the file again") from error
        pieces.append(piece)
        total += len(piece)
        if total > limit:
            raise refusal(
                path,
                f"more than {limit} bytes after decompression",
                f"at most {limit} (from the header)",
                "correct the header",
            )
        if not stream.eof:
            raise refusal(path, f"a {codec} stream that breaks off", "its end", "the file is truncated: copy it again")
        rest = stream.unused_data.lstrip(b"\0")
    return b"".join(pieces)


def select_dataset(path: object, dataset: str | None, names: Sequence[str]) -> str:
    """Which of several arrays to read: the one asked for, or the only one.

    Raises:
        MivolError: the name is not there (the nearest is offered), or none was given where there are several.
    """
    listed = ", ".join(map(repr, names)) or "none"
    if dataset is None:
        if len(names) == 1:
            return names[0]
        raise refusal(path, f"{len(names)} arrays ({listed})", "one", "name the one you want with dataset=")
    if dataset not in names:
        near = difflib.get_close_matches(dataset, names, 1)
        way_out = f"did you mean {near[0]!r}" if near else "choose one of those"
        raise refusal(path, f"no array {dataset!r} (there: {listed})", "an array of that name", way_out)
    return dataset


def refuse_dataset(path: object, dataset: str | None) -> None:
    """Refuse a dataset name where the format holds one unnamed array.

    Raises:
        MivolError: ``dataset`` is not None.
    """
    if dataset is not None:
        raise refusal(path, f"dataset={dataset!r} for a file with one unnamed array", "no dataset", "leave it out")


def _nearest(path: Path) -> str:
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist either"
    names = (entry.name for entry in path.parent.iterdir())
    near = difflib.get_close_matches(path.name, names, 1)
    return f"did you mean {near[0]}" if near else "check the spelling and the folder"


def read_columns(path: str | os.PathLike, count: int) -> np.ndarray:
    """Read a table of ``count`` columns, float64 (rows, count).

    Raises:
        MivolError: no such file, a line of another length, text that is no number, a number that is not finite, no line.
    """
    path = check_file(path)
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#") or (not rows and words[0][0].isalpha() and words[0] not in ("nan", "inf")):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            raise refusal(path, f"{line.strip()!r} in line {number}", "numbers", "write it again") from None
        if len(row) != count or not np.isfinite(row).all():
            raise refusal(path, f"{line.strip()!r} in line {number}", f"{count} finite numbers", "complete it")
        rows.append(row)
    if not rows:
        raise refusal(path, "no line of numbers", f"{count} a line", "write it again")
    return np.array(rows)
