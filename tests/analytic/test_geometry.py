"""Scan geometries by name: that of TIGRE's tests, at any resolution."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.tomography.geometry import cone_beam_of_tigre


@pytest.mark.parametrize("n", [256, 64])
def test_the_cone_beam_of_tigre(n: int) -> None:
    """A detector of 409.6 mm and a cube of 256 mm, whatever the number of pixels and voxels."""
    beam, grid = cone_beam_of_tigre(n, 5)
    np.testing.assert_allclose(beam.angles, np.array([0, 0.5, 1, 1.5, 2]) * np.pi)
    assert beam.detector == (n, n) and grid.shape == (n, n, n)
    assert (beam.source_to_axis, beam.source_to_detector) == (1000, 1536)
    np.testing.assert_allclose(n * np.array(beam.pitch), 409.6)
    np.testing.assert_allclose(n * np.array(grid.voxel_size), 256)
    assert len(cone_beam_of_tigre()[0].angles) == 100 and cone_beam_of_tigre()[1].shape == (256,) * 3
