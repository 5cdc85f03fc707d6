"""A tree of dicts and lists against a schema of msgspec structs: the first fault in a sentence, and every setting on a line.

Conventions. A place in the tree is a dotted key; entries of lists are counted from 0. Where a setting may be one of several
structs, their tag says which.
"""

from __future__ import annotations

import re
import textwrap
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec

from mivol.errors import MivolError
from mivol.optim.strategy import setting, suggest_name

__all__ = ["Setting", "check_keys", "describe", "sentence", "settings_in", "structs_in"]


LONGEST_KEY = 300
"""Characters of a key that a refusal quotes."""


def check_keys(raw: Any, kind: Any, where: str, name: str) -> None:
    """Refuse the first key or strategy that the schema does not know, offering the nearest.

    Raises:
        MivolError: with the dotted key.
    """
    struct = struct_of(kind, raw)
    if isinstance(raw, list):
        for number, item in enumerate(raw):
            check_keys(item, entry_kind(kind), f"{where}.{number}", name)
    if struct is None or not isinstance(raw, dict):
        return
    tag = struct.__struct_config__.tag_field
    _check_tag(raw, tag, {s.__struct_config__.tag: s for s in structs_in(kind)}, where, name)
    known = list(struct.__struct_fields__)
    unknown = next((key for key in raw if key not in known and key != tag), None)
    if unknown is not None:
        dotted = textwrap.shorten(f"{where}.{unknown}".lstrip("."), LONGEST_KEY, placeholder="...")
        raise MivolError(f'{name}: unknown key "{dotted}": {suggest_name(unknown, [*known, *([tag] if tag else [])])}')
    hints = get_type_hints(struct)
    for key, value in raw.items():
        if key in hints:
            dotted, words = f"{where}.{key}".lstrip("."), words_in(hints[key])
            if isinstance(value, str) and words and value not in words:
                raise MivolError(f'{name}: {dotted} = "{value}" is unknown: {suggest_name(value, list(words))}')
            check_keys(value, hints[key], dotted, name)


def _check_tag(raw: dict[str, Any], tag: str | None, choices: dict[str, type], where: str, name: str) -> None:
    if tag and raw.get(tag) not in choices:
        found = raw.get(tag)
        what = f'"{where}.{tag}" is missing' if found is None else f'{where}.{tag} = "{found}" is unknown'
        raise MivolError(f"{name}: {what}: {suggest_name(str(found), list(choices))}")


def structs_in(kind: Any) -> list[type]:
    """The structs that a value of this type may be."""
    if get_origin(kind) is tuple or isinstance(kind, str):
        return []
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return [kind]
    return [struct for part in get_args(kind) for struct in structs_in(part)]


def words_in(kind: Any) -> tuple[str, ...]:
    """The words that a value of this type is chosen from; none where it is no choice of words."""
    return tuple(str(word) for part in (kind, *get_args(kind)) if get_origin(part) is Literal for word in get_args(part))


def struct_of(kind: Any, raw: Any) -> type | None:
    """The struct that ``raw`` asks for by its tag; the first possible one where the tag is missing or unknown."""
    structs = structs_in(kind)
    if not structs or not isinstance(raw, dict):
        return None
    tag = structs[0].__struct_config__.tag_field
    return next((s for s in structs if tag and s.__struct_config__.tag == raw.get(tag)), structs[0])


def entry_kind(kind: Any) -> Any:
    """The type of the entries of a list type."""
    if get_origin(kind) is tuple:
        return get_args(kind)[0]
    return next((entry_kind(part) for part in get_args(kind) if get_args(part)), Any)


def sentence(raw: Any, message: str) -> str:
    """msgspec's message as: where = found: expected."""
    what, _, place = message.partition(" - at `$")
    steps = re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", place.rstrip("`"))
    dotted = ".".join(word or number for word, number in steps)
    found = raw
    for word, number in steps:
        try:
            found = found[word] if word else found[int(number)]
        except (KeyError, IndexError, TypeError, ValueError):
            found = None
            break
    if what.startswith("Object missing required field"):
        missing = f"{dotted}.{what.split('`')[1]}".lstrip(".")
        return f'the key "{missing}" is missing: give it.'
    what = f"{what[0].lower()}{what[1:]}".rstrip(".") + "." * (what[-1] != "?")
    plain = found is not None and not isinstance(found, dict)
    return f"{dotted or 'the file'}{f' = {found!r}' if plain else ''}: {what}"


class Setting(NamedTuple):
    """A setting of a file.

    Attributes:
        key: dotted; an entry of a list has the number 0, and a key of one choice only has its name in brackets.
        default: as Python writes it; "" where it must be given, and where the setting is a table.
        unit: "1" for none.
        meaning: in a line.
        choices: words that it is chosen from, or names of tables; none where it is no choice.
        table: its own settings follow.
    """

    key: str
    default: str
    unit: str
    meaning: str
    choices: tuple[str, ...]
    table: bool


def settings_in(kind: type, prefix: str = "") -> list[Setting]:
    """Every setting of a struct, with those of the tables in it and of the entries of its lists."""
    found = []
    hints = get_type_hints(kind, include_extras=True)
    for field in msgspec.structs.fields(kind):
        hint, key = hints[field.name], f"{prefix}{field.name}"
        meta = getattr(hint, "__metadata__", (setting("1", "one of " + ", ".join(map(str, get_args(hint)))),))[0]
        inner = getattr(hint, "__origin__", hint)
        many = get_origin(inner) is tuple and bool(structs_in(get_args(inner)[0]))
        structs = structs_in(get_args(inner)[0] if many else inner)
        default = "" if field.default is msgspec.NODEFAULT or structs else repr(field.default)
        tags = tuple(str(s.__struct_config__.tag) for s in structs if s.__struct_config__.tag is not None)
        choices = tags or tuple(filter(None, words_in(inner)))
        found.append(Setting(key, default, meta.extra["unit"], meta.description, choices, bool(structs)))
        key += ".0" * many
        for struct in structs:
            label = struct.__struct_config__.tag
            found += settings_in(struct, f"{key}[{label}]." if label else f"{key}.")
    return found


def describe(kind: type) -> list[str]:
    """One line per setting: key, default, unit, meaning; for ``mivol optimize --help``."""
    lines = []
    for key, default, unit, meaning, choices, table in settings_in(kind):
        if not table or choices:
            value = f" = {default}" if default else ""
            one_of = f" ({' | '.join(choices)})" if choices else ""
            lines.append(f"{key}{value}{f' [{unit}]' if unit != '1' else ''}: {meaning}{one_of}")
    return lines
