"""A radiance field on other nodes is the same field."""

from __future__ import annotations

import numpy as np
import pytest
from ball_photos import CUBE

from mivol.errors import MivolError
from mivol.fields.resampling import resample_field
from mivol.fields.spherical import SphericalGrid


def test_a_field_on_finer_nodes_is_the_same_field(variant_rgb: str) -> None:
    n = 6
    g = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    sh = np.stack([x + 2 * y - z] * 3, axis=-1)[..., None, :]
    field = SphericalGrid.from_dense(1 - x + y * 3, sh, CUBE)
    keep = np.ones((n, n, n), bool)
    keep[:2] = False
    fine = resample_field(field, (12, 12, 12), CUBE, keep)
    density, found = fine.to_dense()
    g = (np.arange(12) + 0.5) / 12
    z, y, x = np.meshgrid(g, g, g, indexing="ij")
    inner = np.s_[5:-1, 1:-1, 1:-1]
    np.testing.assert_allclose(density[inner], (1 - x + 3 * y)[inner], atol=1e-5)
    np.testing.assert_allclose(found[..., 0, 0][inner], (x + 2 * y - z)[inner], atol=1e-5)
    # Nodes 0 and 1 are not kept: fine nodes up to 2.5 lie between those only.
    assert (density[:3] == 0).all() and (density[3:] != 0).any(axis=(1, 2)).all()
    with pytest.raises(MivolError, match="other axes"):
        resample_field(field, (12, 12, 12), np.array([[0, -1.0, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), keep)
