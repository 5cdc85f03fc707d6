"""The settings of an integrator that a user gives: path length, Russian roulette, quadrature and shadows."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings:
    """How long a path may be, and how scattered light is computed.

    Attributes:
        max_depth: largest path depth, counted as in ``volpath``; -1 for no limit.
        rr_depth: depth from which Russian roulette may end a path.
        hide_emitters: emitters are not seen directly by the camera.
        deterministic: single scattering by quadrature in place of Monte Carlo.
        shadows: with ``deterministic``, ``exact`` or interpolated in a ``grid``; else ``exact`` or ``estimated`` (ratio
            tracking); ``auto`` leaves the choice to the plan.
        media_light: light that media emit is ``drawn`` where paths scatter, or ``met`` by chance; ``auto`` leaves the choice to
            the plan.
    """

    max_depth: int = 6
    rr_depth: int = 5
    hide_emitters: bool = False
    deterministic: bool = False
    shadows: str = "auto"
    media_light: str = "auto"

    @property
    def may_draw_emission(self) -> bool:
        """Whether light that media emit may be drawn where paths scatter."""
        return self.scatterings >= 1 and self.media_light != "met"

    @property
    def scatterings(self) -> float:
        """Largest number of scattering events between an emitter and the camera, on surfaces and in media; may be infinite."""
        return math.inf if self.max_depth < 0 else max(self.max_depth - 1, 0)
