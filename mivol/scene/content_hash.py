"""A hash of everything that a scene shows.

Conventions. The hash covers what is seen (shapes, media, textures, emitters, sensors, the contents of every file they name),
not how it is computed: integrators and samplers are left out, so that asking for more samples keeps a reference valid.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.scene.parsing import as_text, check_variant, file_of, parse_dict, parse_file, resolving_beside, with_companion

__all__ = ["content_hash", "hash_object", "hash_state"]

# Kinds of objects that say how an image is computed, not what is in it.
METHODS = ("Integrator", "Sampler")


def content_hash(source: str | os.PathLike | Mapping | mi.Object, overrides: Mapping[str, Any] | None = None) -> str:
    """SHA-256 of what a scene, or a part of one such as a sensor's dict, shows; nothing is rendered.

    For XML and dicts: class, parameters and order of every object with overrides and references resolved, and the
    contents (not the names) of every file. For an object already made: class names, settings as Mitsuba prints them
    (6 digits) and the full contents of ``mitsuba.traverse``. The same scene has another hash in each of these forms.

    Raises:
        MivolError: something in it has contents that cannot be read, or it cannot be parsed.
    """
    check_variant()
    if isinstance(source, mi.Object):
        return hash_object(source)
    if isinstance(source, Mapping):
        return hash_state(parse_dict(dict(source)))
    overrides = {key: as_text(value) for key, value in (overrides or {}).items()}
    with resolving_beside(Path(source)):
        return hash_state(parse_file(Path(source), overrides))


def hash_state(state: Any) -> str:
    """Hash the tree of parsed objects from the root; an object met again is named by the number of its first visit."""
    h = hashlib.sha256(b"mivol scene 1")
    visited: dict[int, int] = {}

    def visit(index: int) -> None:
        if index in visited:
            h.update(f"(again {visited[index]})".encode())
            return
        visited[index] = len(visited)
        node = state.nodes[index]
        h.update(f"({_kind(node)} {node.props.plugin_name()} {node.props.id()}".encode())
        for key in node.props.keys():  # noqa: SIM118  (Properties is not iterable)
            value = node.props[key]
            if not isinstance(value, mi.Properties.ResolvedReference):
                h.update(f" {_stable(key)}=".encode())
                _update(h, value, key)
            elif _kind(state.nodes[value.index()]) not in METHODS:
                h.update(f" {_stable(key)}=".encode())
                visit(value.index())
        h.update(b")")

    visit(0)
    return h.hexdigest()


def _kind(node: Any) -> str:
    return str(node.type).rpartition(".")[2]


def _stable(key: str) -> str:
    """A key without the counters and addresses that Mitsuba puts into the names of unnamed objects."""
    return re.sub(r"^_arg_\d+$", "_arg", re.sub(r"\bobject_\d+", "object", key))


def _update(h: Any, value: Any, key: str) -> None:
    """Feed one value, with its type, to the hash."""
    path = file_of(key, value)
    if path is not None:
        for part in with_companion(path):
            with part.open("rb") as file:
                h.update(hashlib.file_digest(file, "sha256").digest())
    elif value is None or isinstance(value, bool | int | float | str):
        h.update(repr(value).encode())
    elif hasattr(value, "wavelengths"):
        _update_array(h, value.wavelengths, key)
        _update_array(h, value.values, key)
    elif isinstance(value, mi.Bitmap):
        h.update(f"{value.pixel_format()} {value.srgb_gamma()}".encode())
        _update_array(h, np.array(value), key)
    elif isinstance(value, mi.VolumeGrid):
        _update_array(h, np.array(value), key)
    elif isinstance(value, mi.Object):
        h.update(hash_object(value).encode())
    else:
        _update_array(h, getattr(value, "matrix", value), key)


def _update_array(h: Any, value: Any, key: str) -> None:
    try:
        array = np.ascontiguousarray(np.array(value))
    except (TypeError, ValueError, RuntimeError):
        array = np.array(None)
    if array.dtype.hasobject:
        raise MivolError(
            f'"{key}" of the scene is a {type(value).__name__}, whose contents cannot be hashed; '
            "give numbers, a tensor, a bitmap or a file."
        )
    h.update(f"{array.dtype.str}{array.shape}".encode())
    h.update(array.tobytes())


def hash_object(thing: mi.Object) -> str:
    """Hash an object already made: what Mitsuba prints of it, and every value that can be traversed."""
    h = hashlib.sha256(b"mivol object 1")
    h.update(_settings(thing).encode())
    params = mi.traverse(thing)
    for key in sorted(params.keys(), key=_stable):
        h.update(_stable(key).encode())
        _update(h, params[key], key)
    return h.hexdigest()


def _settings(thing: mi.Object) -> str:
    """The object's printed form without integrators, samplers and addresses."""
    text = str(thing)
    for match in reversed(list(re.finditer(r"\b\w*(Sampler|Integrator)\[", text))):
        text = text[: match.start()] + text[_closing(text, match.end()) :]
    return re.sub(r"0x[0-9a-f]+|object_\d+", "", text)


def _closing(text: str, start: int) -> int:
    """Position after the bracket that closes the one before ``start``."""
    depth = 1
    for match in re.finditer(r"[\[\]]", text[start:]):
        depth += 1 if match[0] == "[" else -1
        if depth == 0:
            return start + match.end()
    return len(text)
