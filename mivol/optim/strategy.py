"""A named choice with its settings: the form that losses, priors, schedules, events and optimisers share.

Conventions. A strategy is a frozen msgspec struct; its ``name`` is the tag under which a TOML file asks for it; each
setting has its unit, domain and meaning on one line, ``Annotated[float, setting("unit", "meaning", gt=0)]``, from which the
checks and ``mivol optimize --help`` come. Tables of strategies are plain dicts, made by :func:`make_table`.
"""

from __future__ import annotations

import difflib
from typing import Any, ClassVar, TypeVar, Union

import msgspec

from mivol.errors import MivolError

S = TypeVar("S")


def setting(unit: str, meaning: str, **domain: float) -> msgspec.Meta:
    """Unit, meaning and domain (``gt``, ``ge``, ``lt``, ``le``, ``min_length``, ``max_length``) of one setting."""
    return msgspec.Meta(description=meaning, extra={"unit": unit}, **domain)


class Strategy(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="name"):
    """Base of all named choices; ``cites`` are keys of ``mivol.cite.CITATIONS``."""

    cites: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def label(cls) -> str:
        """The name by which files and command lines ask for this strategy."""
        return cls.__struct_config__.tag


def make_table(*strategies: type[S]) -> dict[str, type[S]]:
    """Strategies by name; two of one name are a mistake of the program."""
    named = {strategy.label(): strategy for strategy in strategies}
    if len(named) != len(strategies):
        raise AssertionError("two strategies of one table share a name")
    return named


def union_type(strategies: dict[str, type[S]]) -> Any:
    """The type of a setting that is any strategy of a table."""
    return Union[tuple(strategies.values())]  # noqa: UP007  (the members are known only at run time)


def suggest_name(word: str, known: list[str]) -> str:
    """The way out of a misspelt word: the nearest known one, or all of them."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    return f'did you mean "{close[0]}"?' if close else "known are: " + ", ".join(sorted(known)) + "."


def choose(strategies: dict[str, type[S]], name: str, what: str, **settings: Any) -> S:
    """The strategy of that name with checked settings.

    Args:
        strategies: one of the tables (``LOSSES``, ``PRIORS``, ...).
        name: key of the table.
        what: what is being chosen, for the message ("loss").
        settings: fields of the strategy.

    Raises:
        MivolError: unknown name (the nearest is offered), unknown setting or a value outside its domain.
    """
    if name not in strategies:
        raise MivolError(f'unknown {what} "{name}": {suggest_name(name, list(strategies))}')
    try:
        return msgspec.convert({**settings, "name": name}, strategies[name])
    except msgspec.ValidationError as error:
        raise MivolError(f'{what} "{name}": {error}.') from None
