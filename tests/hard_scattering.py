"""What tests of hard cases of single scattering share: the comparison of pencils with the float64 twin."""

from __future__ import annotations

import oracle_scattering as twins
import scattering_scenes as small
from scattering_scenes import Pencils, mivol

BATCHES = 16


def holds_twin(
    seen: Pencils, m: twins.Medium, emitter: twins.Emitter, spp: int = 2048, level: float = 2e-5, **more: object
) -> None:
    """The twin's radiance within Student's t, and float32 rounding of `level` of the largest."""
    top = twins.radiance([m], [emitter], seen.o, seen.d).max()
    small.assert_twin(seen, [m], [emitter], mivol(), spp, rounding=level * top, **more)
