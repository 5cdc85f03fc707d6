"""A run on disk, from which it continues as if it had not stopped.

Conventions. One ``.npz`` file, written whole: the arrays of the optimiser and the problem, and one JSON text,
``about``, with the next iteration, the history and the fingerprint (every setting that changes the result, and the scene's
hash, by dotted key). A file of another fingerprint is refused; only the number of iterations may grow. No pickles.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mivol.errors import MivolError
from mivol.files.atomic import write_whole
from mivol.files.npy import read_archive

ABOUT = "about"

DIGESTS = ("scene", "references", "photos", "data")
"""Keys of fingerprints that are no settings: digests of what a run reads."""

NEEDED = ("fingerprint",)
"""What every checkpoint says of itself."""

GROWING = ("fit.iterations", "solve.iterations")
"""Settings that a run may be resumed with a larger value of: it goes on from where it ended."""


@dataclass(frozen=True)
class CheckpointFile:
    """Where a run is kept, and what tells it from others.

    Attributes:
        path: the file.
        fingerprint: what the result depends on, by name; JSON values.
        resume: continue from what is there.
    """

    path: Path
    fingerprint: dict[str, object]
    resume: bool = False

    def write(self, arrays: dict[str, np.ndarray], about: dict[str, object]) -> None:
        """Write a checkpoint of this run; refusals as :func:`write`."""
        write(self.path, arrays, {**about, "fingerprint": self.fingerprint})

    def read(self) -> tuple[dict[str, np.ndarray], dict[str, object]]:
        """Arrays and ``about`` of the checkpoint; refusals as :func:`read`."""
        return read(self.path, self.fingerprint)


def write(path: Path, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> None:
    """Write a checkpoint, never half.

    Raises:
        MivolError: the disk is full, or the like.
    """
    text = np.array(json.dumps(about))
    write_whole(path, lambda file: np.savez(file, **{ABOUT: text}, **arrays))


def read(path: Path, fingerprint: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and ``about`` of a checkpoint of this very run.

    Raises:
        MivolError: there is none, it is no checkpoint, or it is one of another scene or other settings.
    """
    arrays, about = _load(path)
    check_same(path, about["fingerprint"], fingerprint)
    return arrays, about


def check_settings(path: Path, settings: dict[str, Any]) -> None:
    """Refuse a checkpoint of other settings, before the run reads its data or touches its folder.

    Raises:
        MivolError: there is none, it is no checkpoint, or it is one of other settings.
    """
    there = _load(path)[1]["fingerprint"]
    check_same(path, {key: value for key, value in there.items() if key not in DIGESTS}, settings)


def _load(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and ``about`` of a checkpoint.

    Raises:
        MivolError: there is none, or it is no checkpoint.
    """
    try:
        arrays = read_archive(path)
        about = json.loads(str(arrays.pop(ABOUT)))
        missing = [key for key in NEEDED if key not in about]
    except FileNotFoundError:
        raise MivolError(f"found no checkpoint {path} to resume from: run without --resume first.") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise MivolError(f"{path} is not a whole checkpoint of mivol ({error}): run without --resume.") from error
    if missing:
        raise MivolError(f"{path} is not a whole checkpoint of mivol (no {missing[0]}): run without --resume.")
    return arrays, about


def check_same(path: Path, there: dict[str, Any], here: dict[str, Any]) -> None:
    """Refuse a checkpoint of another run, naming the first setting that differs.

    Raises:
        MivolError: with both values.
    """
    here = json.loads(json.dumps(here))
    for key in sorted({*there, *here}):
        if key in GROWING and there.get(key, 0) <= here.get(key, 0):
            continue
        if there.get(key) != here.get(key):
            raise MivolError(
                f"{path} belongs to another run: {key} is {there.get(key)!r} there and {here.get(key)!r} here; "
                "restore the setting, or run without --resume."
            )
