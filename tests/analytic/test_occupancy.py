"""The map of occupied cells: a decayed maximum of sampled densities."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from sampled_fields import CUBE, Slab

from mivol.transport.traversal.occupancy import DECAY, Occupancy, list_cells, pick_index

RES = (6, 5, 4)


def grid(occupancy: Occupancy) -> np.ndarray:
    return np.array(occupancy.values).reshape(7, 6, 5)


def test_a_refresh_finds_the_cells_of_a_slab(variant_rgb: str) -> None:
    """Cell i along x lies between x = (i - 1/2) / 2 - 1 and a voxel of 1/2 further, cut by the box."""
    occupancy = Occupancy.full(RES, CUBE).refreshed(Slab(2.0, low=-0.75, high=0.25).density, 0.3)
    assert np.array_equal(grid(occupancy), np.broadcast_to([0, 2.0, 2.0, 0, 0], (7, 6, 5)).astype(np.float32))
    region = occupancy.region(0.1)
    assert np.array_equal(np.array(region.occupied), (np.array(occupancy.values) > 0).astype(np.uint8))
    assert list_cells(region).count == 2 * 7 * 6


def test_values_decay_and_new_matter_counts_at_once(variant_rgb: str) -> None:
    occupancy = Occupancy.full(RES, CUBE).refreshed(Slab(2.0).density, 0.3)
    later = occupancy.refreshed(Slab(0.0).density, 0.4)
    np.testing.assert_allclose(grid(later), 2 * DECAY, rtol=1e-6)
    assert grid(later.refreshed(Slab(3.0).density, 0.5)).min() == 3


def test_a_partial_refresh_evaluates_a_share(variant_rgb: str) -> None:
    """A quarter of the cells at random, and a quarter among those above 0."""
    asked = []

    def density(p: mi.Point3f) -> mi.Float:
        asked.append(np.array(p).T)
        return dr.full(mi.Float, 5, dr.width(p))

    occupancy = Occupancy.full(RES, CUBE).refreshed(Slab(2.0, low=-0.75, high=0.25).density, 0.3)
    later = occupancy.refreshed(density, 0.6, 0.5)
    points = np.concatenate(asked)
    assert len(points) == 2 * int(210 * 0.25)
    assert np.abs(points).max() <= 1
    among = points[int(210 * 0.25) :, 0]
    assert ((among >= -0.75) & (among <= 0.25)).all()
    assert 0 < np.sum(grid(later) == 5) <= len(points)
    assert np.sum(grid(later) == np.float32(2 * DECAY)) > 0


def test_a_number_rounded_to_1_picks_the_last_cell(variant_rgb: str) -> None:
    """Once in ten million draws: an index beyond the array ended a fit after some hundred steps."""
    assert np.array(pick_index(mi.Float(0, 0.5, 1 - 2.0**-24, 1), 143520)).tolist() == [0, 71760, 143519, 143519]


def test_the_threshold_is_the_mean_if_it_is_low(variant_rgb: str) -> None:
    """0.01 in a step: beyond, thin matter would vanish."""
    occupancy = Occupancy.full(RES, CUBE).refreshed(Slab(2.0, low=-0.75, high=0.25).density, 0.3)
    np.testing.assert_allclose(occupancy.threshold(1e-6), 0.8, rtol=1e-6)
    np.testing.assert_allclose(occupancy.threshold(0.1), 0.1, rtol=1e-12)
