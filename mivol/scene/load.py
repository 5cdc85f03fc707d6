"""Load a scene from XML, a dict or an existing object, with the list of read files and a hash of the contents.

Conventions. :func:`load_scene` is the only entry. Overrides are Mitsuba's ``-D name=value``; an unused override is an error.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from mivol.back_end import check_variant
from mivol.display import text_html, with_short_repr
from mivol.errors import MivolError
from mivol.scene.description import (
    NOT_UTF8,
    describe_error,
    find_named_files,
    format_override,
    hash_description,
    hash_object,
    parse_dict,
    parse_file,
    resolve_beside,
)
from mivol.scene.explain import explain_scene
from mivol.threads import set_thread_count

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
        raise MivolError(f"there is no scene file {path}; give the path of a Mitsuba XML file.")
    with resolve_beside(path):
        state = parse_file(path, overrides)
        files = tuple(dict.fromkeys([*(Path(str(f)) for f in state.files), *find_named_files(state)]))
        digest, obstacle = _try_hash(lambda: hash_description(state))
    try:
        # Not parallel: only one thread of a process may use Dr.Jit.
        with ensure_two_threads():
            scene = mi.load_file(str(path), parallel=False, **overrides)
    except RuntimeError as error:
        raise MivolError(f"{path} cannot be loaded: {describe_error(error)}") from error
    return LoadedScene(_check_scene(scene, path), path.stem, "file", files, digest, obstacle)


def _load_dict(source: dict) -> LoadedScene:
    state = parse_dict(source)
    files = tuple(dict.fromkeys(find_named_files(state)))
    digest, obstacle = _try_hash(lambda: hash_description(state))
    try:
        with ensure_two_threads():
            scene = mi.load_dict(source, parallel=False)
    except RuntimeError as error:
        raise MivolError(f"the scene dict cannot be loaded: {describe_error(error)}") from error
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
