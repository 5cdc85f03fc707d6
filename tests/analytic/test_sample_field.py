"""A field known at points becomes a grid: densities, colours, and what is left out."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
from refusals import assert_refused
from sampled_fields import CUBE, Cloud, Slab

from mivol.fields.resampling import OPAQUE, sample_field
from mivol.fields.sampled_field import Region

RES = (6, 8, 10)


def region(low: int = 0, high: int = 9) -> Region:
    """Cells of a map of 8 nodes an edge, occupied from ``low`` to ``high`` along x."""
    mask = np.zeros((9, 9, 9), np.uint8)
    mask[:, :, low:high] = 1
    return Region((8, 8, 8), CUBE, mi.UInt8(mask.ravel()), 0.1)


def test_a_constant_slab_fills_its_voxels(variant_rgb: str) -> None:
    """Voxels are 0.2 long in x: the slab from -0.6 to 0.4 fills the nodes 2 to 6, and its colour is the first harmonic."""
    density, sh = sample_field(replace(Slab(1.5, -0.6, 0.4), region=region()), RES, CUBE).to_dense()
    expected = np.zeros(RES)
    expected[:, :, 2:7] = 1.5
    np.testing.assert_allclose(density, expected, atol=1e-6)
    first = np.array([0.2, 0.5, 0.9]) - 0.5
    np.testing.assert_allclose(sh[:, :, 2:7, 0], np.broadcast_to(first * 3.5449077, (6, 8, 5, 3)), atol=1e-6)
    np.testing.assert_allclose(sh[..., 1:, :], 0, atol=1e-6)


def test_colours_that_depend_on_the_direction_are_projected(variant_rgb: str) -> None:
    """Green is 0.5 + 0.3 d_y: the harmonic -0.4886 y. Red is 0.5 + 0.5 x at the centre of mass of a voxel."""
    density, sh = sample_field(replace(Cloud(3.0), region=region()), RES, CUBE, degree=1).to_dense()
    stored = density > 0.05
    np.testing.assert_allclose(sh[..., 1, 1][stored], -0.3 / 0.48860251, rtol=1e-5)
    x = (np.arange(10) + 0.5) / 5 - 1
    red = sh[..., 0, 0] / 3.5449077
    # The centre of mass lies at most half the distance of the outer points, 0.05, from the middle.
    assert np.abs(red - 0.5 * x)[stored].max() < 0.5 * 0.0501


def test_unoccupied_cells_are_left_out_and_opaque_voxels_are_capped(variant_rgb: str) -> None:
    """Cell i of the map lies from x = (i - 1/2) / 4 - 1: cells 4 and further begin at -0.125."""
    density, _ = sample_field(replace(Slab(1e6), region=region(4)), RES, CUBE).to_dense()
    edge = (8 / (6 * 8 * 10)) ** (1 / 3)
    assert not density[:, :, :4].any()
    np.testing.assert_allclose(density[:, :, 5:], OPAQUE / edge, rtol=1e-6)
    assert_refused("no matter in the box", sample_field, replace(Slab(0.0), region=region()), RES, CUBE)
