"""Path lengths that a user gives, as numbers of scattering events."""

from __future__ import annotations

import math

import mitsuba as mi
import pytest

from mivol.transport.path.estimators import Settings


@pytest.mark.parametrize(("depth", "scatterings"), [(-1, math.inf), (0, 0), (1, 0), (2, 1), (6, 5)])
def test_scatterings(depth: int, scatterings: float) -> None:
    """Depth 1 is what the camera sees directly, and each event adds 1; no limit is no limit."""
    assert Settings(max_depth=depth).scatterings == scatterings


def test_what_holds_where_nothing_is_said(variant_rgb: str) -> None:
    """The defaults of the integrator's documentation, for a scene file as for a script."""
    assert Settings() == Settings(max_depth=6, rr_depth=5, hide_emitters=False, deterministic=False, shadows="auto")
    assert mi.load_dict({"type": "mivol"}).session.settings == Settings()
