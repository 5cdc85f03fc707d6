"""A tree of dicts and lists against msgspec structs: the first fault in a sentence, every setting on a line, shared settings.

Conventions. A place in the tree is a dotted key; entries of lists count from 0. If a setting has several possible structs,
their tag tells which. msgspec checks types and domains; this module adds the nearest valid name, and refuses infinite numbers
for settings without an infinite default, except those that a struct names in ``may_be_infinite``.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import msgspec

from mivol.display import to_toml
from mivol.errors import MivolError
from mivol.optim.strategy import setting, suggest_name

LONGEST_KEY = 300
"""Characters of a key in an error message."""


def check_keys(raw: Any, kind: Any, where: str, name: str) -> None:
    """Refuse the first unknown key, unknown name of a choice, or infinite number.

    Args:
        raw: the tree.
        kind: type of the tree in the schema.
        where: dotted key of the tree; "" for the whole file.
        name: beginning of an error message.

    Raises:
        MivolError: with the dotted key, and the nearest valid name.
    """
    struct = find_struct(kind, raw)
    if isinstance(raw, list):
        for number, item in enumerate(raw):
            check_keys(item, entry_kind(kind), f"{where}.{number}", name)
    if struct is None or not isinstance(raw, dict):
        return
    tag = struct.__struct_config__.tag_field
    _check_tag(raw, tag, {s.__struct_config__.tag: s for s in list_structs(kind)}, where, name)
    fields = {field.name: field for field in msgspec.structs.fields(struct)}
    unknown = next((key for key in raw if key not in fields and key != tag), None)
    if unknown is not None:
        dotted = textwrap.shorten(f"{where}.{unknown}".lstrip("."), LONGEST_KEY, placeholder="...")
        raise MivolError(f'{name}: unknown key "{dotted}": {suggest_name(unknown, [*fields, *([tag] if tag else [])])}')
    hints = get_type_hints(struct)
    for key, value in raw.items():
        if key in hints:
            dotted, words = f"{where}.{key}".lstrip("."), list_words(hints[key])
            if isinstance(value, str) and words and value not in words:
                raise MivolError(f'{name}: {dotted} = "{value}" is unknown: {suggest_name(value, list(words))}')
            may_be = _is_infinite(fields[key].default) or key in getattr(struct, "may_be_infinite", ())
            if _is_infinite(value) and not may_be:
                raise MivolError(f"{name}: {dotted} = {value}: expected a finite number.")
            check_keys(value, hints[key], dotted, name)


def _is_infinite(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(map(_is_infinite, value))
    return isinstance(value, float) and math.isinf(value)


def _check_tag(raw: dict[str, Any], tag: str | None, choices: dict[str, type], where: str, name: str) -> None:
    if tag and raw.get(tag) not in choices:
        word = raw.get(tag)
        fault = f'"{where}.{tag}" is missing' if word is None else f'{where}.{tag} = "{word}" is unknown'
        raise MivolError(f"{name}: {fault}: {suggest_name(str(word), list(choices))}")


def list_structs(kind: Any) -> list[type]:
    """Return the structs among the types of a value."""
    if get_origin(kind) is tuple or isinstance(kind, str):
        return []
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return [kind]
    return [struct for part in get_args(kind) for struct in list_structs(part)]


def list_words(kind: Any) -> tuple[str, ...]:
    """Return the words among which a value of this type is chosen; empty for other types."""
    return tuple(str(word) for part in (kind, *get_args(kind)) if get_origin(part) is Literal for word in get_args(part))


def find_struct(kind: Any, raw: Any) -> type | None:
    """Return the struct with the tag of ``raw``; the first possible struct if the tag is missing or unknown."""
    structs = list_structs(kind)
    if not structs or not isinstance(raw, dict):
        return None
    tag = structs[0].__struct_config__.tag_field
    return next((s for s in structs if tag and s.__struct_config__.tag == raw.get(tag)), structs[0])


def entry_kind(kind: Any) -> Any:
    """Return the type of the entries of a list type."""
    if get_origin(kind) is tuple:
        return get_args(kind)[0]
    return next((entry_kind(part) for part in get_args(kind) if get_args(part)), Any)


def explain_error(raw: Any, message: str) -> str:
    """Rewrite a message of msgspec as: key = value: expected."""
    fault, _, place = message.partition(" - at `$")
    steps = re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", place.rstrip("`"))
    dotted = ".".join(word or number for word, number in steps)
    value = raw
    for word, number in steps:
        try:
            value = value[word] if word else value[int(number)]
        except (KeyError, IndexError, TypeError, ValueError):
            value = None
            break
    if fault.startswith("Object missing required field"):
        missing = f"{dotted}.{fault.split('`')[1]}".lstrip(".")
        return f'the key "{missing}" is missing: give it.'
    fault = f"{fault[0].lower()}{fault[1:]}".rstrip(".") + "." * (fault[-1] != "?")
    plain = value is not None and not isinstance(value, dict)
    return f"{dotted or 'the file'}{f' = {value!r}' if plain else ''}: {fault}"


class Setting(NamedTuple):
    """A setting of a file.

    Attributes:
        key: dotted key; an entry of a list has the number 0; names of choices that have the setting stand in brackets.
        default: default as TOML writes it, or "absent"; "" for required settings and tables.
        domain: allowed numbers in words; "" for all.
        unit: unit; "1" for none.
        meaning: meaning in a line.
        choices: words or names of tables to choose from; empty without a choice.
        table: whether the setting is a table with own settings.
    """

    key: str
    default: str
    domain: str
    unit: str
    meaning: str
    choices: tuple[str, ...]
    table: bool


def describe_domain(meta: msgspec.Meta) -> str:
    """Describe the bounds of a number; empty without bounds."""
    if meta.ge is not None and meta.le is not None:
        return f"{meta.ge} to {meta.le}"
    bounds = {"at least": meta.ge, "above": meta.gt, "at most": meta.le, "below": meta.lt}
    return ", ".join(f"{words} {bound}" for words, bound in bounds.items() if bound is not None)


def settings_in(kind: type) -> list[Setting]:
    """Return every setting of a struct, of the tables in the struct and of the entries of lists.

    Settings that are equal in several choices of a table are one setting.
    """
    settings = []
    hints = get_type_hints(kind, include_extras=True)
    for field in msgspec.structs.fields(kind):
        hint, key = hints[field.name], field.name
        described = next(part for part in (hint, *get_args(hint)) if hasattr(part, "__metadata__"))
        meta = described.__metadata__[0]
        inner = getattr(hint, "__origin__", hint) if described is hint else hint
        many = get_origin(inner) is tuple and bool(list_structs(get_args(inner)[0]))
        structs = list_structs(get_args(inner)[0] if many else inner)
        unset = field.default is msgspec.NODEFAULT or structs
        default = "" if unset else "absent" if field.default is None else to_toml(field.default)
        tags = tuple(str(s.__struct_config__.tag) for s in structs if s.__struct_config__.tag is not None)
        choices = tags or tuple(filter(None, list_words(inner)))
        domain = describe_domain(meta)
        settings.append(Setting(key, default, domain, meta.extra["unit"], meta.description, choices, bool(structs)))
        key += ".0" * many
        owners: dict[Setting, list[str]] = {}
        for struct in structs:
            for inner_setting in settings_in(struct):
                owners.setdefault(inner_setting, []).append(struct.__struct_config__.tag)
        for inner_setting, names in owners.items():
            choice = f"[{','.join(names)}]" if names[0] else ""
            settings.append(inner_setting._replace(key=f"{key}{choice}.{inner_setting.key}"))
    return settings


def describe(kind: type) -> list[str]:
    """Return one line per setting with key, default, unit, meaning and domain, for ``mivol optimize --settings``."""
    lines = []
    for key, default, domain, unit, meaning, choices, table in settings_in(kind):
        if not table or choices:
            value = f" = {default}" if default else ""
            one_of = f" ({' | '.join(choices) or domain})" if choices or domain else ""
            lines.append(f"{key}{value}{f' [{unit}]' if unit != '1' else ''}: {meaning}{one_of}")
    return lines


# -- Shared settings ---------------------------------------------------------------------------------------------------

INFINITY = math.inf

AUTO = "auto"
"""Value of settings chosen by mivol."""

Count = Annotated[int, msgspec.Meta(ge=1)]
"""Number of voxels or pixels along an edge."""

Depth = Annotated[int, msgspec.Meta(ge=-1)]
"""Length of the longest path, as Mitsuba's ``volpath`` counts it; -1 for no limit."""

Size = tuple[Count, Count, Count]
Vector = tuple[float, float, float]
Title = Annotated[str, setting("1", "heading of the report; absent: the name of the file", min_length=1)]
Variant = Annotated[str, setting("1", "Mitsuba variant", min_length=1)]
Seed = Annotated[int, setting("1", "root of the fit's random numbers", ge=0)]
Threads = Annotated[int, setting("thread", "threads of the CPU back end; 0: all cores", ge=0)]
Output = Annotated[str, setting("path", "run folder, relative to the working directory", min_length=1)]
HeldOut = Annotated[tuple[int, ...], setting("view", "indices of views that are evaluated but not fitted")]
DetectorSize = Annotated[tuple[Count, Count], setting("pixel", "(rows, columns) of computed projections")]
CheckpointSteps = Annotated[int, setting("step", "steps between two checkpoints", ge=1)]


def check_word(word: str, known: Sequence[str] | dict[str, Any], subject: str) -> None:
    """Refuse an unknown word, and offer the nearest known word.

    Raises:
        ValueError: with the word.
    """
    if word not in known:
        raise ValueError(f'unknown {subject} "{word}": {suggest_name(word, list(known))}'.rstrip("."))


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the file."""
