"""What mivol refuses, it refuses with one sentence: what was found, what was expected, the way out."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

__all__ = ["MivolError", "reveal_refusals"]


class MivolError(ValueError):
    """An input that mivol cannot use; the message is one sentence for the person who gave it.

    What it quotes may be no text, such as half of a pair of UTF-16 in a name of JSON; that is shown by its number, so that the
    sentence can be printed.
    """

    def __str__(self) -> str:
        return super().__str__().encode("utf-8", "backslashreplace").decode("utf-8")


def reveal_refusals(render: Callable[..., Any]) -> Callable[..., Any]:
    """Let a function that raises a RuntimeError because of a MivolError raise the MivolError.

    ``mi.render`` runs an integrator inside ``dr.custom``, which replaces whatever is raised there by a RuntimeError that says
    no more than "see above": ``except MivolError`` around ``mi.render`` would never catch a refusal. Other errors pass as they
    are.

    Args:
        render: the function; one that reveals refusals already is returned as it is.
    """
    if hasattr(render, "reveals_refusals"):
        return render

    @functools.wraps(render)
    def revealing(*args: Any, **kwargs: Any) -> Any:
        try:
            return render(*args, **kwargs)
        except RuntimeError as error:
            refusal = error.__cause__
            if not isinstance(refusal, MivolError):
                raise
        # Out here the refusal does not get the RuntimeError as its context: each would be the reason of the other, and who
        # follows reasons (as loggers do) would never come to an end.
        raise refusal

    revealing.reveals_refusals = True
    return revealing
