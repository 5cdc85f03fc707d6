"""Tables of numbers as text: rows of as many columns, separated by white space or commas.

Conventions. Lines that begin with ``#`` and a first line of names are left out.
"""

from __future__ import annotations

import os

import numpy as np

from mivol.files.source import existing_file, refusal


def read_columns(path: str | os.PathLike, count: int) -> np.ndarray:
    """Read a table of ``count`` columns, float64 (rows, count).

    Raises:
        MivolError: no such file, a line of another length, text that is no number, a number that is not finite, no line.
    """
    path = existing_file(path)
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
