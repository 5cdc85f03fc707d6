"""What a user sets of an integrator: how long a path may be, and how scattered light is found."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings:
    """How long a path may be, and how scattered light is found.

    ``max_depth`` (-1: no limit), roulette from ``rr_depth`` on, ``hide_emitters``; ``deterministic``: by quadrature, with
    ``shadows`` that are ``exact`` or looked up in a ``grid``; drawn light has ``exact`` or ``estimated`` shadows, or (``auto``)
    what the plan chooses.
    """

    max_depth: int = 6
    rr_depth: int = 5
    hide_emitters: bool = False
    deterministic: bool = False
    shadows: str = "auto"
