"""Random numbers of several events on one ray: directions share out the square, and the rest is shifted evenly."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mivol.transport.estimators.lighting.emitters import EventSamples
from mivol.transport.traversal.random_numbers import Strata

pytestmark = pytest.mark.usefixtures("variant_rgb")


def samples(strata: Strata | None = None) -> EventSamples:
    u, uv = mi.Float(0.3), mi.Point2f(0.6, 0.9)
    return EventSamples(u, uv, u, uv, u, uv, u, strata)


def test_each_event_draws_directions_from_its_part_of_the_square():
    """Four events: one in each quarter, for emitters and for the phase function alike."""
    parts = [samples().for_event(mi.UInt32(k), 4) for k in range(4)]
    for name in ("emitter", "direction"):
        cells = [tuple(np.floor(2 * np.array(getattr(p, name)).ravel()).astype(int)) for p in parts]
        assert cells == [(0, 0), (1, 0), (0, 1), (1, 1)]


def test_events_of_a_ray_share_the_emitter_and_little_else():
    first, second = (samples().for_event(mi.UInt32(k), 4) for k in range(2))
    assert first.which_emitter[0] == second.which_emitter[0] == np.float32(0.3)
    assert second.component[0] == pytest.approx((0.3 + 0.6180339887) % 1, abs=2.0**-23)
    assert np.array(second.inside).ravel() == pytest.approx([(0.6 + 0.7548776662) % 1, (0.9 + 0.5698402910) % 1], abs=2.0**-22)


def test_a_single_event_has_the_strata_of_its_lane():
    only = samples(Strata(mi.UInt32(3), 2, 2)).for_event(mi.UInt32(0), 1)
    assert np.array(only.direction).ravel() == pytest.approx([0.8, 0.95], abs=2.0**-23)
    assert only.strata is None and only.component[0] == np.float32(0.3)
