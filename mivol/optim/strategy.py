"""Named choices with checked settings: the common form of losses, priors, schedules, events and optimizers.

Conventions. A strategy is a frozen msgspec struct. Its ``name`` is the tag for TOML files. Each setting has its unit, domain
and meaning on one line, ``Annotated[float, setting("unit", "meaning", gt=0)]``. The checks and ``mivol optimize --settings``
are made from these lines. Tables of strategies are plain dicts from :func:`make_table`.
"""

from __future__ import annotations

import difflib
from typing import Any, ClassVar, TypeVar, Union

import msgspec

from mivol.errors import MivolError

S = TypeVar("S")


def setting(unit: str, meaning: str, **domain: float) -> msgspec.Meta:
    """Unit, meaning and domain (``gt``, ``ge``, ``lt``, ``le``, ``min_length``, ``max_length``) of a setting."""
    return msgspec.Meta(description=meaning, extra={"unit": unit}, **domain)


class Strategy(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="name"):
    """Base of named choices; ``cites`` are keys of ``mivol.cite.CITATIONS``."""

    cites: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def label(cls) -> str:
        """Name of the strategy in files and on the command line."""
        return cls.__struct_config__.tag


def make_table(*strategies: type[S]) -> dict[str, type[S]]:
    """Strategies by name; equal names are a programming error."""
    named = {strategy.label(): strategy for strategy in strategies}
    if len(named) != len(strategies):
        raise AssertionError("two strategies of one table share a name")
    return named


def union_type(strategies: dict[str, type[S]]) -> Any:
    """The type of a setting with the strategies of a table as values."""
    return Union[tuple(strategies.values())]  # noqa: UP007  (the members are known only at run time)


def suggest_name(word: str, known: list[str]) -> str:
    """A hint for a misspelt word: the nearest known word, or all known words."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    return f'did you mean "{close[0]}"?' if close else "known are: " + ", ".join(sorted(known)) + "."


def choose(strategies: dict[str, type[S]], name: str, kind: str, **settings: Any) -> S:
    """The strategy of a name, with checked settings.

    Args:
        strategies: a table (``LOSSES``, ``PRIORS``, ...).
        name: key of the table.
        kind: kind of strategy for the message ("loss").
        settings: fields of the strategy.

    Raises:
        MivolError: unknown name (the message offers the nearest), unknown setting, or a value outside the domain.
    """
    if name not in strategies:
        raise MivolError(f'unknown {kind} "{name}": {suggest_name(name, list(strategies))}')
    try:
        return msgspec.convert({**settings, "name": name}, strategies[name])
    except msgspec.ValidationError as error:
        raise MivolError(f'{kind} "{name}": {error}.') from None


def check_strategy(given: S) -> S:
    """Return a strategy that was made in Python, where msgspec checks no values.

    Raises:
        MivolError: a class in place of an object, or a value outside the domain.
    """
    if isinstance(given, type):
        raise MivolError(f"found the class {given.__name__}, expected an object: write {given.__name__}(...).")
    kind = type(given)
    try:
        msgspec.convert({**msgspec.structs.asdict(given), "name": kind.label()}, kind)
    except msgspec.ValidationError as error:
        raise MivolError(f"{kind.__name__}: {error}.") from None
    return given
