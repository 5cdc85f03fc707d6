"""Cone beams that are given by projection matrices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mivol import config
from mivol.errors import MivolError
from mivol.experiments import projections
from mivol.tomography.geometry import ConeBeam
from mivol.tomography.panel_views import PanelViews, panels_from_matrices

BEAM = ConeBeam(np.array([0.2, 1.9, 4.0]), (5, 4), 7.0, 11.0, (0.3, 0.4), axis_offset=0.6, detector_offset=(-0.2, 0.7))


def matrices_of(beam: ConeBeam) -> np.ndarray:
    """(views, 3, 4) by way of the camera: intrinsics in pixels, times rotation and translation."""
    found = []
    for angle in beam.angles:
        u, w = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
        source = -beam.axis_offset * u - beam.source_to_axis * w
        turned = np.stack([u, [0.0, 0.0, 1.0], w])
        f_v, f_u = beam.source_to_detector / np.array(beam.pitch)
        # Where the central ray meets the detector, in pixels from the middle of the first.
        c_u = (beam.detector[1] - 1) / 2 - beam.detector_offset[1] / beam.pitch[1]
        c_v = (beam.detector[0] - 1) / 2 - beam.detector_offset[0] / beam.pitch[0]
        inner = np.array([[f_u, 0.0, c_u], [0.0, f_v, c_v], [0.0, 0.0, 1.0]])
        found.append(inner @ np.hstack([turned, -(turned @ source)[:, None]]))
    return np.array(found)


def table_of(beam: ConeBeam) -> PanelViews:
    panels = beam.panels()
    rows, columns = beam.detector
    middle = panels.corner + (columns - 1) / 2 * panels.along_u + (rows - 1) / 2 * panels.along_v
    return PanelViews(np.hstack([panels.source, middle, panels.along_u, panels.along_v]), beam.detector)


@pytest.mark.parametrize("factor", [1.0, -3e4])
def test_rays_are_those_of_the_equal_table(factor: float) -> None:
    """Inverting a matrix whose condition is about 100 leaves 1e-14 of the lengths of 10 or so."""
    found = panels_from_matrices(factor * matrices_of(BEAM), BEAM.detector)
    for ours, theirs in zip(found.rays([2, 0]), table_of(BEAM).rays([2, 0]), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_pixels_may_be_counted_from_elsewhere() -> None:
    """From the first pixel's corner, and from 1 on."""
    moved = np.array([[1.0, 0.0, 1.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]) @ matrices_of(BEAM)
    found = panels_from_matrices(moved, BEAM.detector, first_pixel=(1.5, 0.5))
    np.testing.assert_allclose(found.rays()[1], table_of(BEAM).rays()[1], atol=1e-12)


def test_the_half_of_a_line_that_is_meant_is_told_by_what_is_seen() -> None:
    """A source between the origin and the object: rays run to the object, and the origin is behind them."""
    beyond = 2 * table_of(BEAM).table[0, :3]
    found = panels_from_matrices(matrices_of(BEAM)[:1], BEAM.detector, seen=beyond)
    np.testing.assert_allclose(found.rays()[1], -table_of(BEAM).rays([0])[1], atol=1e-12)


@pytest.mark.parametrize(
    ("at", "value", "sentence"),
    [
        ((1, 0, 0), np.nan, "not finite in the projection matrix of view 1"),
        ((2, 2, slice(0, 3)), 0.0, "singular left half in the projection matrix of view 2"),
        ((slice(1, 3), slice(None), slice(None)), 0.0, "singular left half in the projection matrix of view 1"),
        ((1, 2, 3), 0.0, r"\(0.0, 0.0, 0.0\) beside the source in the projection matrix of view 1"),
    ],
)
def test_matrices_without_a_source_are_refused(at: tuple, value: float, sentence: str) -> None:
    matrices = matrices_of(BEAM)
    matrices[at] = value
    with pytest.raises(MivolError, match=sentence):
        panels_from_matrices(matrices, BEAM.detector)


def test_matrices_of_another_shape_are_refused() -> None:
    with pytest.raises(MivolError, match=r"shape \(3, 12\), expected \(views, 3, 4\)"):
        panels_from_matrices(np.ones((3, 12)), (2, 2))


def test_a_file_of_matrices_is_the_beam_of_a_scan(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "matrices.txt", matrices_of(BEAM).reshape(-1, 12))
    chosen = config.from_dict(
        {
            "title": "matrices",
            "scan": {"beam": "matrices", "file": "matrices.txt", "detector": [5, 4]},
            "data": {"source": "shepp_logan"},
            "grid": {"shape": [2, 2, 2]},
        }
    )
    found = projections.make_geometry(chosen, tmp_path)
    np.testing.assert_allclose(found.rays()[1], table_of(BEAM).rays()[1], atol=1e-12)
