"""How much the bench of radiance fields measures."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["FULL", "QUICK", "STOP", "Size"]

STOP = 1e-4
"""Transmittance at which our rays end; the peer's end at 0."""


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes:
        name: for the JSON.
        resolution: nodes along an edge of the fields.
        side: of pictures whose rays are timed [pixels].
        rounds: warm steps of each.
        steps: of the first stage of a fit.
        chair_steps: of the fit that makes the fitted field.
        fit_resolution, fit_side: nodes and pixels of fits.
        fields: names of those that are measured, in :data:`mivol.bench.radiance_field.fields.FIELDS`.
    """

    name: str = "full"
    resolution: int = 128
    side: int = 256
    rounds: int = 3
    steps: int = 105
    chair_steps: int = 800
    fit_resolution: int = 128
    fit_side: int = 256
    fields: tuple[str, ...] = ("shell", "fog", "fitted")


FULL = Size()
QUICK = Size("quick", 32, 64, 1, 7, 30, 32, 32)
