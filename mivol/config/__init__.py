"""The settings of an experiment, as a TOML file gives them: read, checked, changed by the command line, and written down.

Conventions. The physics stays in Mitsuba's XML. The TOML file names the parameters, the views and the method. An unknown key
is an error that offers the nearest valid key. The command line (``--set a.b=c``) overrides the file. Paths are relative to the
TOML file. ``run.json`` keeps the settings of :func:`list_all_settings`.

The modules ``scenes``, ``scans`` and ``photos`` define the settings of each kind of experiment, with unit, domain and meaning
on a line each.
"""

from __future__ import annotations

import re
import textwrap
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from mivol.config.photos import (
    FieldExperiment,
    GaussianExperiment,
    HashExperiment,
    NerfExperiment,
    OctreeExperiment,
    OctreeSettings,
    PhotoExperiment,
    ShowSettings,
)
from mivol.config.scans import (
    Cone,
    Detector,
    Ellipsoids,
    Known,
    Matrices,
    Measured,
    Nikon,
    OfData,
    Parallel,
    ReadingSettings,
    ScanExperiment,
    SolveSettings,
    Stack,
    ViewTable,
    is_circle,
)
from mivol.config.scenes import Files, Rendered, SceneExperiment, Sought, Truth
from mivol.errors import MivolError
from mivol.optim.strategy import suggest_name
from mivol.schema import AUTO, Section, check_keys, explain_error

__all__ = [
    "AUTO", "CAPTURE", "Cone", "Detector", "EXPERIMENTS", "Ellipsoids", "Experiment", "FIELD_KINDS", "FieldExperiment",
    "Files", "GaussianExperiment", "HashExperiment", "KINDS", "Known", "MODELS", "Matrices", "Measured", "NOT_RESULT",
    "NerfExperiment", "Nikon", "OctreeExperiment", "OctreeSettings", "OfData", "Parallel", "PhotoExperiment", "ReadingSettings",
    "Rendered", "ScanExperiment", "SceneExperiment", "Section", "ShowSettings", "SolveSettings", "Sought", "Stack", "ViewTable",
    "Truth", "apply_change", "flatten_settings", "from_dict", "is_circle", "load", "of_photographs", "list_all_settings",
]  # fmt: skip

DEEP_KEY = re.compile(r"(?<![\w\"'.-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){100}")
"""A key of a hundred names separated by dots. The time of tomllib grows with the square of this number: a file of 200 kB
takes a minute."""

LONGEST_SENTENCE = 600
"""Characters of an error message, which quotes values of any length."""

Experiment = SceneExperiment | ScanExperiment | PhotoExperiment
"""An experiment of any kind."""

KINDS: dict[str, type[Section]] = {
    "scene": SceneExperiment,
    "scan": ScanExperiment,
    "gaussians": GaussianExperiment,
    "photos": FieldExperiment,
}
"""Kinds of experiments by a table of the file; the first present table decides."""

FIELD_KINDS: dict[str, type[Section]] = {
    "grid": FieldExperiment,
    "hash": HashExperiment,
    "nerf": NerfExperiment,
    "octree": OctreeExperiment,
}
"""Kinds of fits with a table ``[photos]``, by the setting ``field.kind``."""

EXPERIMENTS = (
    SceneExperiment,
    ScanExperiment,
    FieldExperiment,
    HashExperiment,
    NerfExperiment,
    OctreeExperiment,
    GaussianExperiment,
)
"""Settings of all kinds of experiments."""

CAPTURE = {"photos": {"largest": 240, "box": "middle"}, "show": {"views": 64}}
"""Defaults of a file with ``field.preset = "capture"``: photograph size resolved by the grids, nested boxes, views."""

NOT_RESULT = ("output", "threads", "title", "checkpoint_every", "keep_state", "show")
"""Settings without effect on result and checkpoint."""


def load(path: str | Path, changes: Sequence[str] = ()) -> Experiment:
    """Read an experiment from a TOML file.

    Args:
        path: TOML file.
        changes: ``a.b=c`` from the command line; entries of a list by index, ``parameter.0.lr=0.1``.

    Raises:
        MivolError: a missing file, invalid TOML, an unknown key, a wrong type, or a value outside the domain.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        if text.lstrip().startswith("<"):
            raise MivolError(f"{path}: found XML, expected an experiment in TOML; name the scene in its table [scene].")
        if DEEP_KEY.search(text):
            raise RecursionError
        raw = tomllib.loads(text)
    except MivolError:
        raise
    except FileNotFoundError:
        raise MivolError(f"found no file {path}: give the path of an experiment, a scan or photographs.") from None
    except RecursionError:
        raise MivolError(f"{path} nests its values deeper than an experiment does: close its brackets.") from None
    except (ValueError, IsADirectoryError) as error:  # of TOML, of UTF-8, and of numbers of thousands of digits
        raise MivolError(f"{path} is not TOML: {error}.") from None
    for change in changes:
        apply_change(raw, change)
    return from_dict(raw, path.name)


def from_dict(raw: dict[str, Any], name: str = "experiment") -> Experiment:
    """Make an experiment from dicts and lists; the tables determine the kind (``KINDS``).

    Args:
        raw: tables and settings, as in TOML.
        name: beginning of an error message, and the heading of the report if the settings give none.

    Raises:
        MivolError: as :func:`load`.
    """
    kind = _find_kind(raw, name)
    raw = {"title": Path(name).stem} | _with_capture(raw)
    check_keys(raw, kind, "", name)
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        reason = textwrap.shorten(explain_error(raw, str(error)), LONGEST_SENTENCE, placeholder=" ...")
        raise MivolError(f"{name}: {reason}") from None


def _find_kind(raw: dict[str, Any], name: str) -> type[Section]:
    """The kind of an experiment by its tables, and by the kind of its field.

    Raises:
        MivolError: an unknown kind of field.
    """
    kind = next((KINDS[table] for table in KINDS if table in raw), SceneExperiment)
    field = raw.get("field")
    if kind is not FieldExperiment or not isinstance(field, dict) or "kind" not in field:
        return kind
    word = str(field["kind"])
    if word not in FIELD_KINDS:
        raise MivolError(f'{name}: field.kind = "{word}" is unknown: {suggest_name(word, list(FIELD_KINDS))}')
    return FIELD_KINDS[word]


MODELS: dict[str, dict[str, dict[str, str]]] = {
    "gaussians": {"gaussians": {}},
    "grid": {"field": {}},
    "hash": {"field": {"kind": "hash"}},
    "nerf": {"field": {"kind": "nerf"}},
    "octree": {"field": {"kind": "octree"}},
}
"""Table of a model with its first settings, by the word of ``mivol optimize --as``; the first word is the default."""


def of_photographs(
    path: Path, model: str = "gaussians", preset: str | None = None, changes: Sequence[str] = ()
) -> PhotoExperiment:
    """Make the experiment of photographs without a TOML file; the run folder has the name of their folder.

    Args:
        path: folder of photographs, or file of cameras.
        model: key of ``MODELS``.
        preset: preset of that model; by default the preset of an empty file.
        changes: as in :func:`load`.

    Raises:
        MivolError: as :func:`load`.
    """
    chosen = {} if preset is None else {"preset": preset}
    tables = {table: settings | chosen for table, settings in MODELS[model].items()}
    name = (path if path.is_dir() else path.parent).resolve().name
    raw = {"title": name, "output": f"runs/{name}", "photos": {"path": str(path)}, **tables}
    for change in changes:
        apply_change(raw, change)
    return from_dict(raw, str(path))


def _with_capture(raw: dict[str, Any]) -> dict[str, Any]:
    """Add the defaults of ``CAPTURE`` to a file with the preset ``capture``."""
    field = raw.get("field")
    if "photos" not in raw or not isinstance(field, dict) or field.get("preset") != "capture":
        return raw
    tables = {table: raw.get(table, {}) for table in CAPTURE}
    return raw | {name: CAPTURE[name] | table if isinstance(table, dict) else table for name, table in tables.items()}


def list_all_settings(experiment: Experiment) -> dict[str, Any]:
    """Return all settings, defaults included, as dicts and lists."""
    return msgspec.to_builtins(experiment)


def flatten_settings(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return the settings with effect on the result, by dotted key."""
    if isinstance(tree, dict | list | tuple) and len(tree):
        items = tree.items() if isinstance(tree, dict) else enumerate(tree)
        values: dict[str, Any] = {}
        for key, value in items:
            if prefix or key not in NOT_RESULT:
                values |= flatten_settings(value, f"{prefix}.{key}" if prefix else str(key))
        return values
    return {prefix: tree}


# -- Command line ----------------------------------------------------------------------------------------------------------


def apply_change(raw: dict[str, Any], change: str) -> None:
    """Put ``a.b=c`` into ``raw``; a value outside TOML's syntax is a text.

    Raises:
        MivolError: no "=", or a key below a value without parts.
    """
    dotted, equals, text = change.partition("=")
    if not equals or not dotted.strip():
        raise MivolError(f'--set "{change}" is not a change: write key.of.setting=value.')
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except ValueError:
        value = text
    *steps, last = dotted.strip().split(".")
    place: Any = raw
    for step in steps:
        place = place.setdefault(step, {}) if isinstance(place, dict) else _list_entry(place, step, change)
    if isinstance(place, dict):
        place[last] = value
    else:
        _list_entry(place, last, change)
        place[int(last)] = value


def _list_entry(place: Any, step: str, change: str) -> Any:
    if not isinstance(place, list) or not step.isdigit() or int(step) >= len(place):
        raise MivolError(f'--set "{change}": "{step}" does not exist: entries of a list count from 0.')
    return place[int(step)]
