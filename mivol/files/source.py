"""Checked bytes and numbers of a file, for all readers.

A missing, empty, truncated or damaged file is refused in the same words everywhere: found, expected, way out.
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

#: Longest quotation of an input in a refusal [character]; line ends become blanks.
LONGEST_QUOTE = 300

#: codec name -> constructor of a decompressor with ``decompress(data, max_length)``, ``eof`` and ``unused_data``.
CODECS: dict[str, Callable[[], object]] = {
    "zlib": lambda: zlib.decompressobj(zlib.MAX_WBITS),
    "gzip": lambda: zlib.decompressobj(zlib.MAX_WBITS | 16),
    "bzip2": bz2.BZ2Decompressor,
    "lzma": lzma.LZMADecompressor,
}


def refusal(subject: object, found: str, expected: str, way_out: str) -> MivolError:
    """Return the error that refuses an input in one sentence.

    Args:
        subject: file or parameter.
        found: actual content, shortened to ``LONGEST_QUOTE`` characters.
        expected: valid content.
        way_out: advice for the user, without a full stop; or a question, with its mark.
    """
    found = textwrap.shorten(found, LONGEST_QUOTE, placeholder=" ...")
    end = "" if way_out.endswith("?") else "."
    return MivolError(f"{subject}: found {found}, expected {expected}; {way_out}{end}")


# -- Files --------------------------------------------------------------------------------------------------------

#: advice of a reader that got a folder.
RAW_SLICES = "name a file in it (read_slices reads a stack of raw slices)"


def check_file(path: str | os.PathLike, in_a_folder: str = RAW_SLICES) -> Path:
    """Return the path of an existing file with at least one byte.

    Args:
        path: path of the file.
        in_a_folder: advice for the path of a folder.

    Raises:
        MivolError: no file (with the most similar name of the folder), a folder, or an empty file.
    """
    path = Path(path)
    try:
        is_folder = path.is_dir()
    except OSError as error:  # an impossible file name, from the header of another file
        name = path.name[:LONGEST_QUOTE]
        raise refusal(name, f"an invalid name ({error.strerror})", "the name of a file", "correct it") from None
    if is_folder:
        raise refusal(path, "a folder", "a file", in_a_folder)
    if not path.is_file():
        raise refusal(path, "nothing there", "an existing file", _suggest_name(path))
    if path.stat().st_size == 0:
        raise refusal(path, "an empty file", "data", "copy or write the file again")
    return path


def _suggest_name(path: Path) -> str:
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist either"
    near = difflib.get_close_matches(path.name, (entry.name for entry in path.parent.iterdir()), 1)
    return f"did you mean {near[0]}?" if near else "check the spelling and the folder"


def read_bytes(path: str | os.PathLike) -> bytes:
    """Read all bytes of an existing, non-empty file.

    Raises:
        MivolError: errors of :func:`check_file`, or no permission.
    """
    path = check_file(path)
    try:
        return path.read_bytes()
    except PermissionError as error:
        raise refusal(path, "no permission to read it", "a readable file", "change its permissions") from error


def select_by_suffix(path: Path, table: Mapping[str, T]) -> T:
    """Return the entry of a table for the suffix of a file.

    Raises:
        MivolError: an unknown suffix.
    """
    if path.suffix.lower() not in table:
        raise refusal(path, f"the suffix {path.suffix!r}", f"one of {', '.join(table)}", "convert the file or correct its name")
    return table[path.suffix.lower()]


def read_data_files(
    header: Path, value: str, listed: Sequence[str], count: int, unpack: Callable[[bytes, int, Path], np.ndarray]
) -> np.ndarray:
    """Read the numbers of a volume from the data files named in its header.

    Args:
        header: file that names the data files; they lie in its folder.
        value: a file name, ``LIST``, or a pattern with first number, last number and step (``slice%03d.raw 0 9 1``).
        listed: lines after the header, the names of a ``LIST``.
        count: number of values in all files, shared equally.
        unpack: function from bytes, count and file to numbers.

    Returns:
        Numbers (count,).

    Raises:
        MivolError: an invalid pattern, a missing file, or a number of files that does not divide ``count``.
    """
    words = value.split()
    if words and words[0].upper() == "LIST":
        names = [line.strip() for line in listed if line.strip()]
    elif len(words) in (4, 5) and "%" in words[0]:
        names = _numbered_names(header, words, count)
    else:
        names = [value]
    if not names or not names[0]:
        raise refusal(header, "no data file", "at least one name", "correct the header")
    if count % len(names):
        raise refusal(header, f"{len(names)} data files", f"a divisor of {count} numbers", "correct the header")
    files = [check_file(header.parent / name) for name in names]
    return np.concatenate([unpack(read_bytes(file), count // len(files), file) for file in files])


def _numbered_names(header: Path, words: Sequence[str], most: int) -> list[str]:
    """The names of a pattern with one ``%d``, ``%3d`` or ``%03d``: at most ``most``, since a file holds at least one number."""
    if not re.fullmatch(r"[^%]*%\d{0,2}d[^%]*", words[0]):
        raise refusal(header, f"the pattern {words[0]!r} of files", "a name with one %d or %03d", "correct the header")
    try:
        first, last, step = (int(word) for word in words[1:4])
        numbers = range(first, last + (1 if step > 0 else -1), step)
    except ValueError as error:
        raise refusal(header, f"the files {' '.join(words)!r}", "pattern, first, last, step", "correct the header") from error
    if not numbers or numbers[most:]:
        found = f"files numbered from {numbers.start} to {numbers.stop} in steps of {numbers.step}"
        raise refusal(header, found, f"1 to {most} files", "correct the header")
    return [words[0] % number for number in numbers]


def decompress(data: bytes, codec: str, limit: int, path: object) -> bytes:
    """Decompress data to at most ``limit`` bytes, which bounds the memory by the promise of the header.

    Concatenated streams (several gzip members) are joined; zero padding after the last stream is skipped.

    Args:
        data: compressed bytes.
        codec: key of :data:`CODECS`.
        limit: largest size according to the header [byte].
        path: subject of refusals.

    Raises:
        MivolError: damaged, truncated or too long data.
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
            found, expected = f"more than {limit} bytes after decompression", f"at most {limit} (from the header)"
            raise refusal(path, found, expected, "correct the header")
        if not stream.eof:
            raise refusal(path, f"a {codec} stream that breaks off", "its end", "the file is truncated: copy it again")
        if not stream.unused_data and len(pieces) == 1:
            return piece
        rest = stream.unused_data.lstrip(b"\0")
    return b"".join(pieces)


# -- Numbers ------------------------------------------------------------------------------------------------------


def parse_elements(data: bytes, dtype: np.dtype | str, count: int, path: object, *, offset: int = 0) -> np.ndarray:
    """Return the numbers that fill ``data`` exactly from byte ``offset`` to the end.

    Args:
        data: bytes of the file, or of a decompressed block.
        dtype: NumPy type with its byte order.
        count: number of values according to the header.
        path: subject of refusals.
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
    """Return ``count`` numbers separated by white space or commas, as float64 (count,).

    Raises:
        MivolError: other text than numbers, or another count.
    """
    if isinstance(text, bytes):
        text = text.decode("ascii", errors="replace")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = np.fromstring(text.replace(",", " "), dtype=np.float64, sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise refusal(path, "text that is not a number among the values", "numbers only", "write the file again") from error
    if values.size != count:
        fault = "truncated" if values.size < count else "longer than its header says"
        raise refusal(path, f"{values.size} numbers", f"{count} (from the header)", f"the file is {fault}: write it again")
    return values


def parse_integers(text: str, count: int, path: object, name: str) -> list[int]:
    """Return ``count`` integers separated by white space.

    Args:
        text: value of a header field.
        count: expected number of integers.
        path: file, the subject of refusals.
        name: name of the field in refusals.

    Raises:
        MivolError: other text than integers, or another count.
    """
    words = text.split()
    if len(words) != count or not all(re.fullmatch(r"[+-]?\d{1,18}", word, re.ASCII) for word in words):
        raise refusal(path, f"'{name} = {text.strip()}'", f"whole numbers ({count})", "correct the header")
    return [int(word) for word in words]


def parse_reals(text: str, count: int, path: object, name: str) -> np.ndarray:
    """Return the ``count`` numbers of a header field as float64 (count,): :func:`parse_numbers` with the name of the field.

    Raises:
        MivolError: other text than numbers, or another count.
    """
    try:
        return parse_numbers(text, count, path)
    except MivolError as error:
        raise refusal(path, f"'{name} = {text.strip()}'", f"numbers ({count})", "correct the header") from error


def read_columns(path: str | os.PathLike, count: int) -> np.ndarray:
    """Read a text table of ``count`` columns as float64 (rows, count).

    Columns are separated by white space or commas. Lines starting with ``#`` and a first line of names are skipped.

    Raises:
        MivolError: no file, a line of another length, invalid or infinite numbers, or no line.
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
            raise refusal(path, f"{line.strip()!r} in line {number}", "numbers", "correct the line") from None
        if len(row) != count or not np.isfinite(row).all():
            raise refusal(path, f"{line.strip()!r} in line {number}", f"{count} finite numbers", "correct the line")
        rows.append(row)
    if not rows:
        raise refusal(path, "no line of numbers", f"{count} numbers per line", "write the file again")
    return np.array(rows)


# -- Arrays of a file ---------------------------------------------------------------------------------------------


def select_dataset(path: object, dataset: str | None, names: Sequence[str]) -> str:
    """Return the name of the array to read: ``dataset``, or the only array of the file.

    Raises:
        MivolError: an unknown name (with the most similar name), or no name for a file of several arrays.
    """
    listed = ", ".join(map(repr, names)) or "none"
    if dataset is None:
        if len(names) == 1:
            return names[0]
        raise refusal(
            path,
            f"{len(names)} arrays ({listed})",
            "a single array",
            "name one by --dataset, by dataset= in Python, by grid in a scene, or by --set data.data= for a scan",
        )
    if dataset not in names:
        near = difflib.get_close_matches(dataset, names, 1)
        way_out = f"did you mean {near[0]!r}?" if near else "choose another array"
        raise refusal(path, f"no array {dataset!r} (the file has {listed})", "an array of that name", way_out)
    return dataset


def refuse_dataset(path: object, dataset: str | None) -> None:
    """Refuse a dataset name for a format with one unnamed array.

    Raises:
        MivolError: a name is given.
    """
    if dataset is not None:
        raise refusal(path, f"dataset={dataset!r} for a file with one unnamed array", "no dataset", "remove dataset")
