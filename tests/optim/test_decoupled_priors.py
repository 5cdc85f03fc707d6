"""Priors that act apart from the gradient: they move values down their slopes, and make nothing new."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from ball_photos import CUBE

from mivol.fields.spherical_grid import SphericalGrid, is_covered_by_inner
from mivol.optim.priors import Neighbours, Rows, Smoothness, decay_view_dependence, smooth, sparsify


def smoothed(values: mi.Float, field: SphericalGrid, amount: float, share: float = 1.0, first: int = 7) -> None:
    """Smooth a density: a step down a slope of 1 is ``amount`` long."""
    smooth(values, Rows(1, Neighbours.from_field(field), amount, 1.0, first), 1.0, share)


def test_priors_move_values_down_their_slopes(variant_rgb: str) -> None:
    rng = np.random.default_rng(0)
    density, sh = rng.normal(size=(4, 5, 6)).astype(np.float32), rng.normal(size=(4, 5, 6, 4, 3)).astype(np.float32)
    field = SphericalGrid.from_dense(density, sh, CUBE)
    amount = 0.05

    def variation(v: np.ndarray) -> float:
        steps = [np.diff(v, axis=a, append=np.take(v, [-1], axis=a)) for a in (0, 1, 2)]
        return float(np.sum(np.sqrt((6 * amount) ** 2 + sum(s * s for s in steps))))

    moved = mi.Float(field.density)
    smoothed(moved, field, amount)
    way = rng.normal(size=density.shape)
    v = density.astype(np.float64)
    expected = -amount * (variation(v + 1e-6 * way) - variation(v - 1e-6 * way)) / 2e-6
    assert np.sum((np.array(moved).reshape(v.shape) - v) * way) == pytest.approx(expected, rel=1e-4)

    moved = sparsify(field.density, 0.01, 0.5)
    cauchy = lambda v: np.sum(np.log(1 + 2 * np.maximum(0.5 * v, 0) ** 2))  # noqa: E731
    expected = -0.01 * (cauchy(v + 1e-6 * way) - cauchy(v - 1e-6 * way)) / 2e-6 / 0.5**2
    assert np.sum((np.array(moved).reshape(v.shape) - v) * way) == pytest.approx(expected, rel=1e-4)
    assert (np.array(sparsify(field.density, 100.0, 0.5)) <= np.maximum(density.reshape(-1), 0)).all()
    assert np.array(sparsify(field.density, 100.0, 0.5))[density.reshape(-1) > 0] == pytest.approx(0, abs=1e-6)

    decayed = np.array(decay_view_dependence(field.harmonics, field.width, 0.25))
    kept = decayed.reshape(*density.shape, -1)[..., :12].reshape(sh.shape)
    np.testing.assert_array_equal(kept[..., 0, :], sh[..., 0, :])
    np.testing.assert_allclose(kept[..., 1:, :], 0.75 * sh[..., 1:, :], rtol=1e-6)


def test_smoothing_a_sparse_field_is_smoothing_what_is_stored(variant_rgb: str) -> None:
    """Terms are those of the nodes that are stored; what is not stored beyond them is vacuum, before them it has no term."""
    rng = np.random.default_rng(2)
    density, keep, amount = rng.normal(size=(4, 5, 6)).astype(np.float32), rng.random((4, 5, 6)) < 0.6, 0.05
    field = SphericalGrid.from_dense(density, np.zeros((4, 5, 6, 1, 3)), CUBE, keep)
    dense = np.where(keep, density, 0.0)  # the vacuum of a ReLU

    def variation(v: np.ndarray) -> float:
        steps = [np.diff(v, axis=a, append=np.take(v, [-1], axis=a)) for a in (0, 1, 2)]
        return float(np.sum(np.sqrt((6 * amount) ** 2 + sum(s * s for s in steps))[keep]))

    moved = mi.Float(field.density)
    smoothed(moved, field, amount)
    way = rng.normal(size=density.shape) * keep
    expected = -amount * (variation(dense + 1e-6 * way) - variation(dense - 1e-6 * way)) / 2e-6
    # As above: central differences in float64, values moved in float32.
    assert np.sum((np.array(moved)[:-1] - density[keep]) * way[keep]) == pytest.approx(expected, rel=1e-4)


def test_smoothing_however_strong_makes_nothing_new(variant_rgb: str) -> None:
    """What was between the smallest and the largest value stays there, and the vacuum around stays empty."""
    rng = np.random.default_rng(1)
    density = rng.normal(size=(6, 6, 6)).astype(np.float32)
    keep = np.zeros(density.shape, bool)
    keep[1:5, 1:5, 1:5] = True
    field = SphericalGrid.from_dense(density, np.zeros((6, 6, 6, 1, 3)), CUBE, keep)
    values, before = mi.Float(field.density), np.array(field.density)
    for start in range(40):
        smoothed(values, field, 1e3, 0.5, start)
        after = np.array(values)
        # Rounding of a sum of seven terms.
        assert before.min() - 1e-6 <= after.min() and after.max() <= before.max() + 1e-6
        assert after[-1] == before[-1]
    assert np.ptp(after) < 0.2 * np.ptp(before)


def test_smoothing_every_few_steps_looks_at_all_their_shares(variant_rgb: str) -> None:
    """A row is moved as far by one look at four shares as by a look at one; between two looks nothing moves."""
    density = np.random.default_rng(3).normal(size=(4, 4, 8)).astype(np.float32)
    field = SphericalGrid.from_dense(density, np.zeros((4, 4, 8, 1, 3)), CUBE)
    around = Neighbours.from_field(field)
    often, seldom = Smoothness(share=1 / 8), Smoothness(share=1 / 8, every=4)
    looks = [Rows(1, around, 0.05, 1.0, first, 8) for first in (7, 23, 39, 55)]
    moved = np.array(seldom.apply(field.density, looks[0]))
    shares = [np.array(often.apply(field.density, look)) for look in looks]
    expected = density.reshape(-1) + sum(share - density.reshape(-1) for share in shares)
    # Each row is in one share; sums of float32 numbers of order 1.
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-6)
    assert np.count_nonzero(moved != density.reshape(-1)) > 0.9 * len(moved) / 2
    resting = Rows(1, around, 0.05, 1.0, 7, 9)
    np.testing.assert_array_equal(np.array(seldom.apply(field.density, resting)), density.reshape(-1))


def test_what_is_covered_is_no_neighbour(variant_rgb: str) -> None:
    """An outer level ends at the inner box: the differences across it are 0, and no level is beside another in memory only."""
    n = 8
    grids = []
    for level in range(2):
        place = CUBE * 2.0**level
        place[3, 3] = 1
        grids.append(SphericalGrid.from_dense(np.full((n, n, n), 2.0 + 2 * level), np.zeros((n, n, n, 1, 3)), place))
    field = SphericalGrid.from_levels(grids)
    covered = np.array(is_covered_by_inner(dr.arange(mi.UInt32, field.node_count), field.res))
    field = field.select_nodes(~covered)
    moved = mi.Float(field.density)
    smoothed(moved, field, 0.05)
    # Constants in each level have no variation: nothing moves, not even beside the vacuum that is not stored.
    np.testing.assert_array_equal(np.array(moved)[:-1], np.array(field.density)[:-1])
    assert covered.sum() == 2**3
