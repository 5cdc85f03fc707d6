"""Load a scene from XML, a dict or an existing object, with the list of read files and a hash of the contents.

The description of a scene is made before Mitsuba builds the scene: parsed objects, the files named by them, and the hash. The
hash covers visible contents (shapes, media, textures, emitters, sensors, the contents of every named file), not the method:
integrators and samplers are left out, so more samples keep a reference valid.

Conventions. :func:`load_scene` is the only entry. Overrides are Mitsuba's ``-D name=value``; an unused override is an error.
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

from mivol.back_end import check_variant
from mivol.display import text_html, with_short_repr
from mivol.errors import MivolError
from mivol.scene.explain import explain_scene
from mivol.scene_graph import traverse
from mivol.threads import set_thread_count

MAX_REASON_LENGTH = 700
"""Characters quoted of a message of Mitsuba: lists of plugins and parameters are shorter."""

NOT_UTF8 = "it names things in bytes that are not UTF-8; correct them"
"""The fault of a file whose quotation by Mitsuba is not UTF-8."""

TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)+(?:(?:[\w.]+\.)?MivolError: )?")
"""A traceback in a text, up to the raised message and without the name of mivol's own error."""

# Header formats with voxels in a second file, and the key of the line with the name of the second file.
DATA_FILE_KEYS = {".mhd": "ElementDataFile", ".nhdr": "data file"}


def format_override(value: Any) -> str:
    """Format a value as an override of an XML parameter."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def describe_error(error: Exception) -> str:
    """Format an error of Mitsuba as one line, without the source position, shortened for long files.

    For an error in a Python plugin Mitsuba quotes the whole traceback; only the message at the end is kept. Python 3.11.2
    loses a message that is not UTF-8 (later versions raise UnicodeDecodeError).
    """
    text = TRACEBACK.sub("", re.sub(r"^\s*\[[\w.]+:\d+\]\s*", "", str(error)))
    text = " ".join(text.split()) or NOT_UTF8
    return text if len(text) <= MAX_REASON_LENGTH else f"{text[:MAX_REASON_LENGTH]} ..."


def quote_at_end(error: Exception) -> str:
    """The words of an error of Mitsuba as the end of a sentence."""
    said = describe_error(error)
    return said if said.endswith(".") else f"{said.rstrip('!')}."


@contextmanager
def resolve_beside(path: Path) -> Iterator[None]:
    """Search for files beside the XML inside a ``with`` block, and drop the XML's ``<path>`` elements afterwards."""
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(path.parent.resolve()))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def parse_file(path: Path, overrides: dict[str, str]) -> Any:
    """Parse a Mitsuba XML file, with overrides and references resolved.

    Raises:
        MivolError: an override that the file does not use, or what Mitsuba refuses.
    """
    import mitsuba.parser as parser

    config = parser.ParserConfig(mi.variant())
    try:
        state = parser.parse_file(config, str(path), **overrides)
    except RuntimeError as error:
        if "unused parameters" in str(error):
            raise MivolError(_describe_unused_override(path, overrides, str(error))) from None
        raise MivolError(f"{path} cannot be read: {quote_at_end(error)}") from error
    return _resolve(parser, config, state, path)


def parse_dict(source: dict) -> Any:
    """Parse a scene dict, with references resolved.

    Raises:
        MivolError: a refusal of Mitsuba.
    """
    import mitsuba.parser as parser

    config = parser.ParserConfig(mi.variant())
    try:
        state = parser.parse_dict(config, source)
    except RuntimeError as error:
        raise MivolError(f"the scene dict cannot be read: {quote_at_end(error)}") from error
    return _resolve(parser, config, state, "the scene dict")


def _resolve(parser: Any, config: Any, state: Any, origin: Any) -> Any:
    try:
        parser.transform_upgrade(config, state)
        parser.transform_resolve(config, state)
    except RuntimeError as error:
        raise MivolError(f"{origin} cannot be read: {quote_at_end(error)}") from error
    return state


def _describe_unused_override(path: Path, overrides: dict[str, str], message: str) -> str:
    name = next((key for key in overrides if f"${key}=" in message), next(iter(overrides)))
    names = sorted(_parameter_names(path))
    close = difflib.get_close_matches(name, names, n=1)
    way_out = f'did you mean "{close[0]}"?' if close else "its parameters are: " + (", ".join(names) or "none") + "."
    return f'override "{name}" is not used by {path.name}; {way_out}'


def _parameter_names(path: Path) -> set[str]:
    """Names of the parameters used by an XML file and its includes."""
    text = path.read_text(encoding="utf-8", errors="replace")
    names = set(re.findall(r"\$\{?(\w+)", text)) | set(re.findall(r"<default[^>]*?name\s*=\s*[\"'](\w+)", text))
    for included in re.findall(r"<include[^>]*?filename\s*=\s*[\"']([^\"']+)", text):
        found = Path(str(mi.file_resolver().resolve(included)))
        names |= _parameter_names(found) if found.is_file() and found != path else set()
    return names


def find_named_files(state: Any) -> Iterator[Path]:
    """Find the files named by parsed objects, each with its data file."""
    for node in state.nodes:
        for key in node.props.keys():  # noqa: SIM118  (Properties is not iterable)
            found = find_named_file(key, node.props[key])
            if found:
                yield from list_data_files(found)


def find_named_file(key: str, value: Any) -> Path | None:
    """Find the file named by a setting; None without an existing file."""
    if not (isinstance(value, str) and key.endswith("filename")):
        return None
    path = Path(str(mi.file_resolver().resolve(value)))
    return path if path.is_file() else None


def list_data_files(path: Path) -> Iterator[Path]:
    """List a file, and the file of its voxels if the header names another file."""
    yield path
    key = DATA_FILE_KEYS.get(path.suffix.lower())
    if key:
        match = re.search(rf"(?im)^\s*{key}\s*[:=]\s*(\S+)\s*$".encode(), path.read_bytes())
        beside = path.parent / match[1].decode() if match else None
        if beside and beside.is_file():
            yield beside


# Kinds of objects that define the method of a render, not its contents.
UNHASHED_KINDS = ("Integrator", "Sampler")


def content_hash(source: str | os.PathLike | Mapping | mi.Object, overrides: Mapping[str, Any] | None = None) -> str:
    """SHA-256 of the contents of a scene or of a part, such as a sensor's dict; nothing is rendered.

    For XML and dicts the hash covers class, parameters and order of every object, with overrides and references resolved, and
    the contents (not the names) of every file. For an existing object the hash covers class names, settings as printed by
    Mitsuba (6 digits) and the full contents of ``mi.traverse``. The same scene has different hashes in the three forms.

    Raises:
        MivolError: unreadable contents, or a source that cannot be parsed.
    """
    check_variant()
    if isinstance(source, mi.Object):
        return hash_object(source)
    if isinstance(source, Mapping):
        return hash_description(parse_dict(dict(source)))
    overrides = {key: format_override(value) for key, value in (overrides or {}).items()}
    with resolve_beside(Path(source)):
        return hash_description(parse_file(Path(source), overrides))


def hash_description(state: Any) -> str:
    """Hash the tree of parsed objects from the root; a repeated object is named by the number of its first visit."""
    h = hashlib.sha256(b"mivol scene 1")
    visited: dict[int, int] = {}

    def visit(index: int) -> None:
        if index in visited:
            h.update(f"(again {visited[index]})".encode())
            return
        visited[index] = len(visited)
        node = state.nodes[index]
        h.update(f"({_node_kind(node)} {node.props.plugin_name()} {node.props.id()}".encode())
        for key in node.props.keys():  # noqa: SIM118  (Properties is not iterable)
            value = node.props[key]
            if not isinstance(value, mi.Properties.ResolvedReference):
                h.update(f" {_stable_key(key)}=".encode())
                _hash_value(h, value, key)
            elif _node_kind(state.nodes[value.index()]) not in UNHASHED_KINDS:
                h.update(f" {_stable_key(key)}=".encode())
                visit(value.index())
        h.update(b")")

    visit(0)
    return h.hexdigest()


def _node_kind(node: Any) -> str:
    return str(node.type).rpartition(".")[2]


def _stable_key(key: str) -> str:
    """A key without Mitsuba's counters and addresses of unnamed objects."""
    return re.sub(r"^_arg_\d+$", "_arg", re.sub(r"\bobject_\d+", "object", key))


def _hash_value(h: Any, value: Any, key: str) -> None:
    """Add a value with its type to the hash."""
    path = find_named_file(key, value)
    if path is not None:
        for part in list_data_files(path):
            with part.open("rb") as file:
                h.update(hashlib.file_digest(file, "sha256").digest())
    elif value is None or isinstance(value, bool | int | float | str):
        h.update(repr(value).encode())
    elif hasattr(value, "wavelengths"):
        _hash_array(h, value.wavelengths, key)
        _hash_array(h, value.values, key)
    elif isinstance(value, mi.Bitmap):
        h.update(f"{value.pixel_format()} {value.srgb_gamma()}".encode())
        _hash_array(h, np.array(value), key)
    elif isinstance(value, mi.VolumeGrid):
        _hash_array(h, np.array(value), key)
    elif isinstance(value, mi.Object):
        h.update(hash_object(value).encode())
    else:
        _hash_array(h, getattr(value, "matrix", value), key)


def _hash_array(h: Any, value: Any, key: str) -> None:
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
    """Hash an existing object: its printed form and every value of ``mi.traverse``."""
    h = hashlib.sha256(b"mivol object 1")
    h.update(_printed_settings(thing).encode())
    params = traverse(thing)
    for key in sorted(params.keys(), key=_stable_key):
        h.update(_stable_key(key).encode())
        _hash_value(h, params[key], key)
    return h.hexdigest()


def _printed_settings(thing: mi.Object) -> str:
    """The printed form of an object, without integrators, samplers and addresses."""
    text = str(thing)
    for match in reversed(list(re.finditer(r"\b\w*(Sampler|Integrator)\[", text))):
        text = text[: match.start()] + text[_find_closing_bracket(text, match.end()) :]
    return re.sub(r"0x[0-9a-f]+|object_\d+", "", text)


def _find_closing_bracket(text: str, start: int) -> int:
    """Position after the bracket that closes the bracket before ``start``."""
    depth = 1
    for match in re.finditer(r"[\[\]]", text[start:]):
        depth += 1 if match[0] == "[" else -1
        if depth == 0:
            return start + match.end()
    return len(text)


# -- Loading -----------------------------------------------------------------------------------------------------------

SceneSource = str | os.PathLike | Mapping


@with_short_repr
@dataclass(frozen=True)
class LoadedScene:
    """A scene with its origin.

    Attributes:
        scene: the Mitsuba scene.
        name: short name for files and titles.
        kind: "file", "dict" or "object".
        files: all files read: the XML, its includes, meshes, textures, volumes.
    """

    scene: mi.Scene
    name: str
    kind: str
    files: tuple[Path, ...] = ()
    _digest: str | None = field(default=None, repr=False)
    _obstacle: str = field(default="", repr=False)

    def _repr_html_(self) -> str:
        """The scene's facts, for notebooks."""
        return text_html(f"{self!r}\n{explain_scene(self.scene).text}")

    @property
    def content_hash(self) -> str:
        """SHA-256 of the scene's contents at loading, as 64 hexadecimal digits.

        Raises:
            MivolError: unreadable contents in the scene.
        """
        if self._digest is None:
            raise MivolError(self._obstacle)
        return self._digest


@contextmanager
def ensure_two_threads() -> Iterator[None]:
    """Give Dr.Jit at least two threads while Mitsuba reads files.

    Mitsuba hands an EXR file to another thread of the pool and waits, forever in a process with a single thread.
    """
    single = mi.variant().startswith("llvm") and dr.thread_count() == 1
    if single:
        set_thread_count(2)
    try:
        yield
    finally:
        if single:
            set_thread_count(1)


def load_scene(source: SceneSource | mi.Scene, overrides: Mapping[str, object] | None = None) -> LoadedScene:
    """Load a scene.

    Args:
        source: path of a Mitsuba XML file, a dict as for ``mitsuba.load_dict``, or an existing scene.
        overrides: values of the XML's ``$name`` parameters (``-D name=value``).

    Raises:
        MivolError: no usable variant, a missing file, an unused override, overrides without XML, or a scene refused by Mitsuba
            (with Mitsuba's reason).

    Example:
        >>> loaded = load_scene("scenes/smoke/scene.xml", {"res": 32})
        >>> image = mi.render(loaded.scene, spp=16)
    """
    check_variant()
    overrides = {key: format_override(value) for key, value in (overrides or {}).items()}
    if isinstance(source, str | os.PathLike):
        try:
            return _load_file(Path(source), overrides)
        except UnicodeDecodeError as error:  # of Mitsuba's refusals and settings, which quote the file
            raise MivolError(f"{source} cannot be read: {NOT_UTF8}.") from error
    if overrides:
        name = next(iter(overrides))
        raise MivolError(f'override "{name}" was given, but only XML files have parameters; change the scene itself.')
    if isinstance(source, Mapping):
        return _load_dict(dict(source))
    if isinstance(source, mi.Scene):
        digest, obstacle = _try_hash(lambda: hash_object(source))
        return LoadedScene(source, "scene", "object", (), digest, obstacle)
    way_out = ": give its .scene" if isinstance(source, LoadedScene) else ""
    raise MivolError(f"a scene is a path, a dict or a mitsuba.Scene, not {type(source).__name__}{way_out}.")


# -- Loading --------------------------------------------------------------------------------------


def _load_file(path: Path, overrides: dict[str, str]) -> LoadedScene:
    if not path.is_file():
        expected = "of a Mitsuba XML file" if path.suffix.lower() == ".xml" else "of a scene, a volume, a scan or photographs"
        raise MivolError(f"there is no scene file {path}; give the path {expected}.")
    with resolve_beside(path):
        state = parse_file(path, overrides)
        files = tuple(dict.fromkeys([*(Path(str(f)) for f in state.files), *find_named_files(state)]))
        digest, obstacle = _try_hash(lambda: hash_description(state))
    try:
        # Not parallel: only one thread of a process may use Dr.Jit.
        with ensure_two_threads():
            scene = mi.load_file(str(path), parallel=False, **overrides)
    except RuntimeError as error:
        raise MivolError(f"{path} cannot be loaded: {quote_at_end(error)}") from error
    return LoadedScene(_check_scene(scene, path), path.stem, "file", files, digest, obstacle)


def _load_dict(source: dict) -> LoadedScene:
    state = parse_dict(source)
    files = tuple(dict.fromkeys(find_named_files(state)))
    digest, obstacle = _try_hash(lambda: hash_description(state))
    try:
        with ensure_two_threads():
            scene = mi.load_dict(source, parallel=False)
    except RuntimeError as error:
        raise MivolError(f"the scene dict cannot be loaded: {quote_at_end(error)}") from error
    return LoadedScene(_check_scene(scene, "the dict"), "scene", "dict", files, digest, obstacle)


def _check_scene(thing: Any, origin: Any) -> mi.Scene:
    if not isinstance(thing, mi.Scene):
        kind = type(thing).__name__
        raise MivolError(f"{origin} describes a {kind}, not a scene; its outermost element must be a scene.")
    return thing


def _try_hash(make: Callable[[], str]) -> tuple[str | None, str]:
    """The hash and an empty text, or None and the reason: a scene without a hash can still be rendered."""
    try:
        return make(), ""
    except MivolError as error:
        return None, str(error)
