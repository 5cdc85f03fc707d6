"""Checkpoints: files from which a run continues without a difference.

Conventions. The file is a ``.npz`` archive, written whole, with the arrays of the optimizer and the problem, and a JSON text
``about`` with the next iteration, the history and the fingerprint (all settings with an effect on the result, and the scene's
hash, by dotted key). A file with another fingerprint is refused; only the number of iterations may grow. No pickles.
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
"""Fingerprint keys besides settings: digests of input data."""

REQUIRED_KEYS = ("fingerprint",)
"""Keys of every checkpoint."""

GROWABLE_SETTINGS = ("fit.iterations", "solve.iterations")
"""Settings with larger values allowed on resuming: the run continues from the old end."""


@dataclass(frozen=True)
class CheckpointFile:
    """The checkpoint file of a run.

    Attributes:
        path: the file.
        fingerprint: inputs of the result by name; JSON values.
        resume: whether the run continues from this file.
    """

    path: Path
    fingerprint: dict[str, object]
    resume: bool = False

    def write(self, arrays: dict[str, np.ndarray], about: dict[str, object]) -> None:
        """Write a checkpoint of this run; raises as :func:`write`."""
        write(self.path, arrays, {**about, "fingerprint": self.fingerprint})

    def read(self) -> tuple[dict[str, np.ndarray], dict[str, object]]:
        """Arrays and ``about`` of the checkpoint; raises as :func:`read`."""
        return read(self.path, self.fingerprint)


def write(path: Path, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all.

    Raises:
        MivolError: the file cannot be written, as on a full disk.
    """
    text = np.array(json.dumps(about))
    write_whole(path, lambda file: np.savez(file, **{ABOUT: text}, **arrays))


def read(path: Path, fingerprint: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and ``about`` of a checkpoint of this run.

    Raises:
        MivolError: the file is missing, is no checkpoint, or belongs to another scene or other settings.
    """
    arrays, about = _load(path)
    check_same(path, about["fingerprint"], fingerprint)
    return arrays, about


def check_settings(path: Path, settings: dict[str, Any]) -> None:
    """Check the settings of a checkpoint, before the run reads its data or changes its folder.

    Raises:
        MivolError: the file is missing, is no checkpoint, or has other settings.
    """
    saved = read_settings(path)
    check_same(path, {key: value for key, value in saved.items() if key not in DIGESTS}, settings)


def read_settings(path: Path) -> dict[str, Any]:
    """The settings of a checkpoint by dotted key, with the digests of its data; raises as :func:`_load`."""
    return _load(path)[1]["fingerprint"]


def _load(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and ``about`` of a checkpoint.

    Raises:
        MivolError: the file is missing or is no checkpoint.
    """
    try:
        arrays = read_archive(path)
        about = json.loads(str(arrays.pop(ABOUT)))
        missing = [key for key in REQUIRED_KEYS if key not in about]
    except FileNotFoundError:
        raise MivolError(f"found no checkpoint {path} to resume from: run without --resume first.") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise MivolError(f"{path} is not a whole checkpoint of mivol ({error}): run without --resume.") from error
    if missing:
        raise MivolError(f"{path} is not a whole checkpoint of mivol (no {missing[0]}): run without --resume.")
    return arrays, about


def _find_kind(settings: dict[str, Any]) -> str:
    """The model of a fit, by its settings: ``field.kind``, or the first table of another experiment."""
    tables = {key.split(".")[0] for key in settings}
    return settings.get("field.kind") or next((word for word in ("gaussians", "scan", "scene") if word in tables), "unknown")


def check_same(path: Path, saved: dict[str, Any], current: dict[str, Any]) -> None:
    """Check that a checkpoint belongs to this run; the message names the kinds, or the first different setting.

    Raises:
        MivolError: another run, with both values.
    """
    current = json.loads(json.dumps(current))
    kinds = [_find_kind(settings) for settings in (saved, current)]
    if kinds[0] != kinds[1]:
        raise MivolError(
            f"{path} is the checkpoint of a fit of the kind {kinds[0]}, and the kind {kinds[1]} is expected here: "
            "restore the kind, or run without --resume."
        )
    for key in sorted({*saved, *current}):
        # None: the number of iterations is left to the kind of fit.
        if key in GROWABLE_SETTINGS and (saved.get(key) or 0) <= (current.get(key) or 0):
            continue
        if saved.get(key) != current.get(key):
            raise MivolError(
                f"{path} belongs to another run: {key} is {saved.get(key)!r} there and {current.get(key)!r} here; "
                "restore the setting, or run without --resume."
            )
