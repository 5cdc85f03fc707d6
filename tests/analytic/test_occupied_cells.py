"""The walk through occupied cells: where it says that a ray is in a cell."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from radiance_rays import rays_of

from mivol.fields.spherical import SphericalGrid
from mivol.transport.line_integrals.radiance_field import cells_of
from mivol.transport.traversal.lattice import clip
from mivol.transport.traversal.occupied_cells import march

pytestmark = pytest.mark.usefixtures("variant_rgb")


def test_fractions_across_a_ray_along_an_axis_are_those_of_its_start():
    """To the bit: none is turned round to be counted along the ray, as 1 - (1 - frac) would round it."""
    field = SphericalGrid.from_dense(np.ones((5, 5, 5), np.float32), np.zeros((5, 5, 5, 1, 3)), np.eye(4))
    n = 64
    o = np.stack([np.full(n, -1.0), *np.random.default_rng(1).uniform(0.1, 0.9, (2, n))], axis=-1)
    rays, cells = rays_of(o, [1.0, 0.0, 0.0]), cells_of(field)
    segment = clip(cells, rays.o, rays.d, 0, rays.t_max)
    seen, _, _ = march(cells, segment, lambda _, here, on: mi.Vector3f(here.points[0]), mi.Vector3f(0))
    start = np.array(segment.frac)
    assert np.array_equal(np.array(seen)[1:], start[1:])
    # The test is no test where the rounding is none.
    assert np.any(1 - (1 - start[1:]) != start[1:])
