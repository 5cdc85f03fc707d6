"""Tabulated phase functions: values, sampling, moments, files, and tables that are refused."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from phase_angles import EPS, U, as64, lanes, turns

from mivol.phase.table import Table
from mivol.phase.tabulated import Lookup

pytestmark = pytest.mark.usefixtures("variant_rgb")


COSINES = np.array([-1, -0.93, -0.2, -0.15, 0.4, 0.999, 0.99999, 0.9999999, 1.0])


VALUES = np.array([0.3, 0.0, 0.0, 1.0, 1.0, 2.0, 40.0, 300.0, 1000.0])


def lookup(table: Table) -> tuple[Lookup, mi.Float, mi.Float, mi.Float]:
    nodes = Lookup.of(table)
    return nodes, *nodes.normalise(mi.Float(table.values.astype(np.float32)))


def test_values_between_irregular_nodes():
    nodes, values, integral, _ = lookup(Table(COSINES, VALUES))
    turn, m, p = turns()
    got = as64(nodes.eval(turn, values, integral))
    want = np.interp(p - 1, COSINES, VALUES)
    near = m < 1
    want[near] = np.interp(-m[near], COSINES - 1, VALUES)  # 1 - c of the peak is not lost
    total = 2 * np.pi * np.trapezoid(VALUES, COSINES)
    # The place in a segment is rounded by eps/2 of 1 - c (of 1 + c behind): 1.01 segments at most in the peak, 17 in the narrow
    # one from -0.2 to -0.15. Values follow by as much of the larger end.
    after = np.clip(np.searchsorted(COSINES, p - 1), 1, len(COSINES) - 1)
    larger = np.maximum(VALUES[after - 1], VALUES[after])
    assert np.all(np.abs(got * total - want) <= 17 * EPS * larger)


def test_samples_of_a_table_invert_its_distribution():
    nodes, values, integral, cumulative = lookup(Table(COSINES, VALUES))
    turn = nodes.sample(*lanes(U), values, integral, cumulative)
    m = as64(turn.below_one)
    assert np.all(m >= 0)
    assert np.all(np.diff(m) <= 0)
    # Both are rounded once as sums of a node and an offset of 2 at most.
    assert np.max(np.abs(m + as64(turn.above_minus_one) - 2)) <= 4 * EPS
    # Above each sample: whole segments and a trapezoid, from 1 downwards, so that the peak is judged by its own size.
    d, f = (1 - COSINES)[::-1], VALUES[::-1] / np.trapezoid(VALUES, COSINES)
    sums = np.concatenate([[0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(d))])
    i = np.clip(np.searchsorted(d, m, side="right") - 1, 0, len(d) - 2)
    here = np.interp(m, d, f)
    above = sums[i] + (f[i] + here) / 2 * (m - d[i])
    # The cumulative sums are rounded to eps/2 of 1, and so is u's place between two of them; the rest is a few of those.
    assert np.max(np.abs(above - (1 - U))) <= 4 * EPS
    # No sample where the function is 0: between -0.93 and -0.2.
    assert not np.any((m > 1.2001) & (m < 1.9299))


def test_table_of_a_stock_size():
    """Equally spaced values are those of tabphase: (0.5, 1, 1.5) is (2 + c) / (8 pi)."""
    nodes, values, integral, _ = lookup(Table.regular([0.5, 1.0, 1.5]))
    turn, m, p = turns()
    assert np.max(np.abs(as64(nodes.eval(turn, values, integral)) * 8 * np.pi - (2 + (p - m) / 2))) <= 8 * EPS
