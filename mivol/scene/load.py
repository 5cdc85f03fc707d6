"""A scene from XML, a dict or an object already made, and a hash of everything that it shows.

Conventions. :func:`load_scene` is the only way in: overrides are Mitsuba's ``-D name=value``, and an unused one is an
error. The hash covers what is seen (shapes, media, textures, emitters, sensors, the contents of every file they name),
not how it is computed: integrators and samplers are left out, so that asking for more samples keeps a reference valid.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError

__all__ = ["VARIANTS", "LoadedScene", "SceneSource", "check_variant", "content_hash", "find_sensor", "load_scene"]

SceneSource = str | os.PathLike | Mapping

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")

# Header formats whose voxels lie in a second file: the key of the line that names it.
DETACHED = {".mhd": "ElementDataFile", ".nhdr": "data file"}


@dataclass(frozen=True)
class LoadedScene:
    """A scene, and where it came from.

    Attributes:
        scene: the Mitsuba scene.
        name: short name for files and titles.
        kind: "file", "dict" or "object".
        files: every file that was read: the XML, its includes, meshes, textures, volumes.
    """

    scene: mi.Scene
    name: str
    kind: str
    files: tuple[Path, ...] = ()
    _digest: str | None = field(default=None, repr=False)
    _obstacle: str = field(default="", repr=False)

    @property
    def content_hash(self) -> str:
        """SHA-256 of what the scene shows, as 64 hexadecimal digits, taken when it was loaded.

        Raises:
            MivolError: something in the scene has contents that cannot be read.
        """
        if self._digest is None:
            raise MivolError(self._obstacle)
        return self._digest


@contextmanager
def two_threads() -> Iterator[None]:
    """Let Mitsuba read files: it hands an EXR to a second thread of the pool, and waits for ever where there is none.

    That is so in a process pinned to one CPU, and where one thread was asked for.
    """
    single = mi.variant().startswith("llvm") and dr.thread_count() == 1
    if single:
        dr.set_thread_count(2)
    try:
        yield
    finally:
        if single:
            dr.set_thread_count(1)


def check_variant() -> str:
    """The active variant's name.

    Raises:
        MivolError: none is active, or one in which mivol does not render.
    """
    variant = mi.variant()
    if variant is None:
        raise MivolError('no Mitsuba variant is active; call mitsuba.set_variant("llvm_ad_rgb") first.')
    if variant not in VARIANTS:
        raise MivolError(f'the variant "{variant}" is active; mivol works in {", ".join(VARIANTS)}.')
    return variant


def find_sensor(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """A sensor of the scene by its number, or the one that is given.

    Raises:
        MivolError: the scene has none of that number.
    """
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if not 0 <= sensor < len(sensors):
        raise MivolError(f"the scene has no sensor {sensor}, only {len(sensors)} of them; count from 0, or add one.")
    return sensors[sensor]


def load_scene(source: SceneSource | mi.Scene, overrides: Mapping[str, Any] | None = None) -> LoadedScene:
    """Load a scene.

    Args:
        source: path of a Mitsuba XML file, a dict as for ``mitsuba.load_dict``, or a scene already made.
        overrides: values of the XML's ``$name`` parameters (``-D name=value``).

    Raises:
        MivolError: no usable variant, no such file, an unused override, overrides for something that is not XML, or a
            scene that Mitsuba refuses (with Mitsuba's own reason).

    Example:
        >>> loaded = load_scene("scenes/smoke/scene.xml", {"res": 32})
        >>> image = mi.render(loaded.scene, spp=16)
    """
    check_variant()
    overrides = {key: _as_text(value) for key, value in (overrides or {}).items()}
    if isinstance(source, str | os.PathLike):
        return _load_file(Path(source), overrides)
    if overrides:
        name = next(iter(overrides))
        raise MivolError(f'override "{name}" was given, but only XML files have parameters; change the scene itself.')
    if isinstance(source, Mapping):
        return _load_dict(dict(source))
    if isinstance(source, mi.Scene):
        digest, obstacle = _try_hash(lambda: _hash_object(source))
        return LoadedScene(source, "scene", "object", (), digest, obstacle)
    raise MivolError(f"a scene is a path, a dict or a mitsuba.Scene, not {type(source).__name__}.")


def content_hash(source: SceneSource | mi.Object, overrides: Mapping[str, Any] | None = None) -> str:
    """SHA-256 of what a scene, or a part of one such as a sensor's dict, shows; nothing is rendered.

    For XML and dicts: class, parameters and order of every object with overrides and references resolved, and the
    contents (not the names) of every file. For an object already made: class names, settings as Mitsuba prints them
    (6 digits) and the full contents of ``mitsuba.traverse``. The same scene has another hash in each of these forms.

    Raises:
        MivolError: something in it has contents that cannot be read, or it cannot be parsed.
    """
    check_variant()
    if isinstance(source, mi.Object):
        return _hash_object(source)
    if isinstance(source, Mapping):
        return _hash_state(_parse_dict(dict(source)))
    overrides = {key: _as_text(value) for key, value in (overrides or {}).items()}
    with _resolving_beside(Path(source)):
        return _hash_state(_parse_file(Path(source), overrides))


# -- Loading --------------------------------------------------------------------------------------


def _as_text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _load_file(path: Path, overrides: dict[str, str]) -> LoadedScene:
    if not path.is_file():
        raise MivolError(f"there is no scene file {path}; give the path of a Mitsuba XML file.")
    with _resolving_beside(path):
        state = _parse_file(path, overrides)
        files = tuple(dict.fromkeys([*(Path(str(f)) for f in state.files), *_named_files(state)]))
        digest, obstacle = _try_hash(lambda: _hash_state(state))
    try:
        # One thread of a process uses Dr.Jit: not parallel.
        with two_threads():
            scene = mi.load_file(str(path), parallel=False, **overrides)
    except RuntimeError as error:
        raise MivolError(f"{path} cannot be loaded: {_reason(error)}") from error
    return LoadedScene(_check_is_scene(scene, path), path.stem, "file", files, digest, obstacle)


def _load_dict(source: dict) -> LoadedScene:
    state = _parse_dict(source)
    files = tuple(dict.fromkeys(_named_files(state)))
    digest, obstacle = _try_hash(lambda: _hash_state(state))
    try:
        with two_threads():
            scene = mi.load_dict(source, parallel=False)
    except RuntimeError as error:
        raise MivolError(f"the scene dict cannot be loaded: {_reason(error)}") from error
    return LoadedScene(_check_is_scene(scene, "the dict"), "scene", "dict", files, digest, obstacle)


def _check_is_scene(thing: Any, origin: Any) -> mi.Scene:
    if not isinstance(thing, mi.Scene):
        kind = type(thing).__name__
        raise MivolError(f"{origin} describes a {kind}, not a scene; its outermost element must be a scene.")
    return thing


def _reason(error: Exception) -> str:
    """Mitsuba's message without its source position, in one line."""
    return " ".join(re.sub(r"^\s*\[[\w.]+:\d+\]\s*", "", str(error)).split())


def _try_hash(make: Callable[[], str]) -> tuple[str | None, str]:
    """The hash, or why there is none: a scene without one can still be rendered."""
    try:
        return make(), ""
    except MivolError as error:
        return None, str(error)


# -- Parsing --------------------------------------------------------------------------------------


@contextmanager
def _resolving_beside(path: Path) -> Iterator[None]:
    """Look for files beside the XML, and forget its ``<path>`` elements afterwards."""
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(path.parent.resolve()))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def _parse_file(path: Path, overrides: dict[str, str]) -> Any:
    import mitsuba.parser as parser

    config = parser.ParserConfig(mi.variant())
    try:
        state = parser.parse_file(config, str(path), **overrides)
    except RuntimeError as error:
        if "unused parameters" in str(error):
            raise MivolError(_unused(path, overrides, str(error))) from None
        raise MivolError(f"{path} cannot be read: {_reason(error)}") from error
    return _resolve(parser, config, state, path)


def _parse_dict(source: dict) -> Any:
    import mitsuba.parser as parser

    config = parser.ParserConfig(mi.variant())
    try:
        state = parser.parse_dict(config, source)
    except RuntimeError as error:
        raise MivolError(f"the scene dict cannot be read: {_reason(error)}") from error
    return _resolve(parser, config, state, "the scene dict")


def _resolve(parser: Any, config: Any, state: Any, origin: Any) -> Any:
    try:
        parser.transform_upgrade(config, state)
        parser.transform_resolve(config, state)
    except RuntimeError as error:
        raise MivolError(f"{origin} cannot be read: {_reason(error)}") from error
    return state


def _unused(path: Path, overrides: dict[str, str], message: str) -> str:
    name = next((key for key in overrides if f"${key}=" in message), next(iter(overrides)))
    names = sorted(_parameter_names(path))
    close = difflib.get_close_matches(name, names, n=1)
    way_out = f'did you mean "{close[0]}"?' if close else "its parameters are: " + (", ".join(names) or "none") + "."
    return f'override "{name}" is not used by {path.name}; {way_out}'


def _parameter_names(path: Path) -> set[str]:
    """Parameters that an XML file and what it includes mention."""
    text = path.read_text(encoding="utf-8", errors="replace")
    names = set(re.findall(r"\$\{?(\w+)", text)) | set(re.findall(r"<default[^>]*?name\s*=\s*[\"'](\w+)", text))
    for included in re.findall(r"<include[^>]*?filename\s*=\s*[\"']([^\"']+)", text):
        found = Path(str(mi.file_resolver().resolve(included)))
        names |= _parameter_names(found) if found.is_file() and found != path else set()
    return names


def _named_files(state: Any) -> Iterator[Path]:
    for node in state.nodes:
        for key in node.props.keys():  # noqa: SIM118  (Properties is not iterable)
            found = _file_of(key, node.props[key])
            if found:
                yield from _with_companion(found)


def _file_of(key: str, value: Any) -> Path | None:
    if not (isinstance(value, str) and key.endswith("filename")):
        return None
    path = Path(str(mi.file_resolver().resolve(value)))
    return path if path.is_file() else None


def _with_companion(path: Path) -> Iterator[Path]:
    """The file, and the one that holds its voxels where its header names another."""
    yield path
    key = DETACHED.get(path.suffix.lower())
    if key:
        match = re.search(rf"(?im)^\s*{key}\s*[:=]\s*(\S+)\s*$".encode(), path.read_bytes())
        beside = path.parent / match[1].decode() if match else None
        if beside and beside.is_file():
            yield beside


# -- Hashing --------------------------------------------------------------------------------------

# Kinds of objects that say how an image is computed, not what is in it.
METHODS = ("Integrator", "Sampler")


def _hash_state(state: Any) -> str:
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
    path = _file_of(key, value)
    if path is not None:
        for part in _with_companion(path):
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
        h.update(_hash_object(value).encode())
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


def _hash_object(thing: mi.Object) -> str:
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
