"""Refusals: one sentence each, with the found input, the expected input and a way out."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any


class MivolError(ValueError):
    """An unusable input; the message is one sentence for the user.

    The message may quote invalid text, such as half of a UTF-16 pair from a name in JSON. Such characters are shown by number,
    to keep the message printable.
    """

    def __str__(self) -> str:
        return super().__str__().encode("utf-8", "backslashreplace").decode("utf-8")


class MivolWarning(RuntimeWarning):
    """A doubt about a usable input, in one sentence for the user; the command ``mivol`` prints it without a line of code."""


class WorkersLost(MivolError):
    """The workers of a cluster cannot go on. A fit has not taken the step under way, and keeps its state in a checkpoint."""


def reveal_refusals(render: Callable[..., Any]) -> Callable[..., Any]:
    """Make a render function raise the MivolError behind a RuntimeError.

    ``mi.render`` runs an integrator inside ``dr.custom``, and ``dr.custom`` replaces every exception by a RuntimeError with the
    text "see above". So ``except MivolError`` around ``mi.render`` would never catch a refusal. Other errors pass unchanged.

    Args:
        render: the function; returned unchanged if already wrapped.
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
        # Raised outside of the except block, the refusal does not get the RuntimeError as its context. Otherwise each would be
        # the cause of the other, and a logger following causes would never end.
        try:
            raise refusal
        finally:
            # The traceback holds this frame; a frame that holds the refusal would close a cycle around the scene.
            del refusal

    revealing.reveals_refusals = True
    return revealing
