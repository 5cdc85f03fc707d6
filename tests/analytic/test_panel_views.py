"""Detectors that are placed view by view."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.tomography.geometry import ConeBeam
from mivol.tomography.panel_views import PanelViews

GOOD = np.array([0, -5, 0, 0, 5, 0, 0.5, 0, 0, 0, 0, 0.25], float)


def test_rays_and_panels_are_those_of_a_cone_beam() -> None:
    """A circular scanner with every offset, written as a table: the same rays, to the rounding of float64."""
    beam = ConeBeam(np.array([0.2, 1.9]), (5, 4), 7.0, 11.0, (0.3, 0.4), axis_offset=0.6, detector_offset=(-0.2, 0.7))
    panels = beam.panels()
    middle = panels.corner + 1.5 * panels.along_u + 2.0 * panels.along_v
    table = PanelViews(np.hstack([panels.source, middle, panels.along_u, panels.along_v]), (5, 4))
    assert table.shape == beam.shape
    for found, expected in zip(table.rays([1, 0]), beam.rays([1, 0]), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-14)
    np.testing.assert_allclose(table.panels().corner, panels.corner, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"columns": 11}, r"shape \(1, 11\), expected \(views, 12\)"),
        ({"at": {3: np.nan}}, "not finite in view 0"),
        ({"at": {11: 0.0}}, "without area in view 0"),
        ({"at": {1: 5.0}}, "source in the detector's plane in view 0"),
    ],
)
def test_tables_that_place_no_detector_are_refused(change: dict, sentence: str) -> None:
    row = GOOD[: change.get("columns", 12)].copy()
    for column, value in change.get("at", {}).items():
        row[column] = value
    with pytest.raises(MivolError, match=sentence):
        PanelViews(row[None], (3, 3))
