"""A measured slice: the rotation axis is in the middle, and predictions of held-out views judge it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mivol.bench.studies.tomography.slices import MeasuredSlice, centre_axis, load_tooth
from mivol.tomography.filtered import filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.projector import Projector


def test_readings_are_moved_to_the_middle() -> None:
    """A parabola about column 3.3 of 11: cubic interpolation finds it about the middle one of 7, but where it meets the end of
    the readings, whose mirrors it takes for their continuation."""
    column = 3.3
    values = np.tile((np.arange(41.0) - 15 - column) ** 2, (2, 3, 1))
    result = centre_axis(values, 15 + column, 3)
    assert result.shape == (2, 3, 2 * 18 + 1)
    # What the ends do falls by the root of 3 less 2, 0.27, a column: 400 units of slope are 1e-8 after 20 columns.
    np.testing.assert_allclose(result[0, 0, 16:21], (np.arange(5.0) - 2) ** 2, atol=1e-5)
    weights = centre_axis(np.arange(41.0)[None, None], 15 + column, 0)
    assert np.array_equal(weights[0, 0], np.arange(37.0))


def test_the_error_is_what_a_prediction_misses_over_the_noise(variant_rgb: str) -> None:
    """Two deviations in each pixel that counts; one without a weight does not."""
    grid = VoxelGrid((1, 5, 5))
    held_out = Projector(ParallelBeam(np.array([0.3, 1.1]), (1, 7)), grid)
    x = np.random.default_rng(0).uniform(size=(1, 5, 5)).astype(np.float32)
    certain = np.full((2, 1, 7), 16.0)
    certain[1, 0, 3] = 0
    image = held_out @ x + 2 / 4
    image[1, 0, 3] = 1e3
    scan = MeasuredSlice(None, grid, None, None, None, held_out=held_out, measured=image, certainty=certain)
    assert scan.error(x.ravel()) == pytest.approx(2, rel=1e-5)


@pytest.mark.slow
def test_the_load_tooth(variant_rgb: str, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every tenth view is kept back; none sees the object it was given mirrored, turned or moved."""
    monkeypatch.setenv("MIVOL_DATA", str(data_dir))
    scan = load_tooth()
    assert scan.y.shape[0] + scan.measured.shape[0] == 181 and scan.measured.shape[0] == 18
    assert scan.y.shape[2] % 2 == 1 and scan.grid.shape == (1, 381, 381)
    assert not set(scan.beam.angles) & set(scan.held_out.geometry.angles)
    result = filtered_backprojection(Projector(scan.beam, scan.grid), scan.y)
    error = scan.error(result)
    others = [scan.error(a) for a in (result[:, ::-1], result[:, :, ::-1], np.roll(result, 1, axis=2), 0 * result)]
    # By the scene's page conjugate gradients with a prior predict to 1.49 times the noise; the bare filter does not reach that.
    assert 1.49 < error < min(others)
