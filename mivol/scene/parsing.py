"""Scene files and dicts as trees of parsed objects, before anything of them is made; and the files that they name."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mitsuba as mi

from mivol.errors import MivolError

__all__ = [
    "NO_TEXT",
    "VARIANTS",
    "as_text",
    "check_variant",
    "file_of",
    "named_files",
    "parse_dict",
    "parse_file",
    "reason_of",
    "resolving_beside",
    "with_companion",
]

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")

LONGEST_REASON = 700
"""Characters of a message of Mitsuba's that are quoted: its lists of plugins and parameters are shorter."""

NO_TEXT = "it names things in bytes that are not UTF-8; correct them"
"""What is wrong with a file that Mitsuba quotes in a refusal that is no text."""

TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n)+(?:(?:[\w.]+\.)?MivolError: )?")
"""A traceback in a text, up to what was raised; the name of a refusal of mivol's belongs to it."""

# Header formats whose voxels lie in a second file: the key of the line that names it.
DETACHED = {".mhd": "ElementDataFile", ".nhdr": "data file"}


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


def as_text(value: Any) -> str:
    """A value as an override of an XML parameter."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def reason_of(error: Exception) -> str:
    """Mitsuba's message without its source position, in one line that does not quote all of a long file.

    Of an error of a plugin in Python, mivol's own among them, Mitsuba quotes the traceback: what the plugin says is at its end.
    A message that is no UTF-8 is lost in Python 3.11.2 (later ones raise UnicodeDecodeError in its place).
    """
    text = TRACEBACK.sub("", re.sub(r"^\s*\[[\w.]+:\d+\]\s*", "", str(error)))
    text = " ".join(text.split()) or NO_TEXT
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]} ..."


@contextmanager
def resolving_beside(path: Path) -> Iterator[None]:
    """Look for files beside the XML, and forget its ``<path>`` elements afterwards."""
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
            raise MivolError(_unused(path, overrides, str(error))) from None
        raise MivolError(f"{path} cannot be read: {reason_of(error)}") from error
    return _resolve(parser, config, state, path)


def parse_dict(source: dict) -> Any:
    """Parse a scene dict, with references resolved.

    Raises:
        MivolError: what Mitsuba refuses.
    """
    import mitsuba.parser as parser

    config = parser.ParserConfig(mi.variant())
    try:
        state = parser.parse_dict(config, source)
    except RuntimeError as error:
        raise MivolError(f"the scene dict cannot be read: {reason_of(error)}") from error
    return _resolve(parser, config, state, "the scene dict")


def _resolve(parser: Any, config: Any, state: Any, origin: Any) -> Any:
    try:
        parser.transform_upgrade(config, state)
        parser.transform_resolve(config, state)
    except RuntimeError as error:
        raise MivolError(f"{origin} cannot be read: {reason_of(error)}") from error
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


def named_files(state: Any) -> Iterator[Path]:
    """The files that parsed objects name, each with its companion."""
    for node in state.nodes:
        for key in node.props.keys():  # noqa: SIM118  (Properties is not iterable)
            found = file_of(key, node.props[key])
            if found:
                yield from with_companion(found)


def file_of(key: str, value: Any) -> Path | None:
    """The file that a setting names; None where it names none that is there."""
    if not (isinstance(value, str) and key.endswith("filename")):
        return None
    path = Path(str(mi.file_resolver().resolve(value)))
    return path if path.is_file() else None


def with_companion(path: Path) -> Iterator[Path]:
    """The file, and the one that holds its voxels where its header names another."""
    yield path
    key = DETACHED.get(path.suffix.lower())
    if key:
        match = re.search(rf"(?im)^\s*{key}\s*[:=]\s*(\S+)\s*$".encode(), path.read_bytes())
        beside = path.parent / match[1].decode() if match else None
        if beside and beside.is_file():
            yield beside
