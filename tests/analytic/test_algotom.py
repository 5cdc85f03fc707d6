"""One function for the methods of algotom: what a method gets and returns, and ours beside theirs where it is installed."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest
from refusals import assert_refused

import mivol
from mivol.errors import MivolError
from mivol.tomography.geometry import ParallelBeam
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.rings import remove_rings
from mivol.tomography.rotation_axis import find_axis

Y = np.random.default_rng(1).random((7, 3, 5)).astype(np.float32)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package of algotom's names, whose methods tell what they get."""
    modules = {name: ModuleType(name) for name in ("algotom", "algotom.prep", "algotom.prep.removal")}
    modules |= {name: ModuleType(name) for name in ("algotom.prep.correction", "algotom.prep.calculation")}
    removal, calculation = modules["algotom.prep.removal"], modules["algotom.prep.calculation"]

    def remove_all_stripe(sinogram: np.ndarray, snr: float = 3.0) -> np.ndarray:
        return sinogram - sinogram[0] + snr

    def remove_zinger(mat: np.ndarray, threshold: float) -> np.ndarray:
        return mat - threshold * np.arange(len(mat))[:, None]

    def find_center_vo(sino_180: np.ndarray, step: float = 0.25) -> float:
        return float(len(sino_180))

    removal.remove_all_stripe, removal.remove_zinger = remove_all_stripe, remove_zinger
    calculation.find_center_vo, calculation.find_center_360 = find_center_vo, lambda sino, win_width: (win_width, 1.0, 0)
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)


def test_what_a_method_gets(stand_in: None) -> None:
    """Stripes: the sinogram of a row. Zingers: a view with its highest row first. Axes: rows, and half turns of two ends."""
    np.testing.assert_allclose(mivol.run_algotom("remove_all_stripe", Y, snr=2.0), Y - Y[0] + 2.0)
    np.testing.assert_allclose(mivol.run_algotom("remove_zinger", Y, threshold=1.0), Y - np.array([2, 1, 0])[:, None])
    np.testing.assert_array_equal(mivol.run_algotom("find_center_vo", Y), [7, 7, 7])
    np.testing.assert_array_equal(mivol.run_algotom("find_center_360", Y, win_width=4), [4, 4, 4])
    turn = np.arange(8) * np.pi / 4
    np.testing.assert_array_equal(mivol.run_algotom("find_center_vo", np.ones((8, 1, 5)), turn), [5, 5, 5, 5])
    np.testing.assert_array_equal(mivol.run_algotom("find_center_vo", np.ones((4, 1, 5)), turn[:4]), [4])


@pytest.mark.parametrize(
    ("method", "y", "options", "found"),
    [
        ("find_centre", Y, {}, "found the method 'find_centre', expected one of algotom's remove_all_stripe"),
        ("remove_stripe_based_sorting", Y, {}, "found no remove_stripe_based_sorting in algotom.prep.removal"),
        ("remove_all_stripe", Y[0], {}, r"found projections of shape \(3, 5\), expected \(views, rows, cols\)"),
        ("remove_all_stripe", Y, {"size": 3}, "found the option 'size' of remove_all_stripe, expected one of snr"),
        ("find_center_vo", Y, {"angles": np.arange(3)}, r"found angles of shape \(3,\) for 7 views"),
        ("remove_zinger", Y, {"threshold": "a"}, r"algotom's remove_zinger failed on \(3, 5\) values"),
    ],
)
def test_one_sentence(stand_in: None, method: str, y: np.ndarray, options: dict, found: str) -> None:
    assert_refused(found, mivol.run_algotom, method, y, **options)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "algotom", None)
    with pytest.raises(MivolError, match="found no algotom, expected it for remove_zinger: install it by pip install algotom"):
        mivol.run_algotom("remove_zinger", Y, threshold=1.0)


def test_ours_beside_theirs(variant_rgb: str) -> None:
    """Vo's third algorithm is one method in both packages; away from the edges, both take the same medians.

    Their search for the axis resolves a tenth of a column, and ours agrees within half a column with the median of five rows.
    """
    pytest.importorskip("algotom")
    angles = np.arange(120) * np.pi / 120
    y = shepp_logan(half_width=46.0).project(ParallelBeam(angles, (3, 121), 1.0, axis_offset=3.3))
    y += 1e-3 * y.max() * np.random.default_rng(2).normal(size=y.shape)
    theirs = mivol.run_algotom("find_center_vo", y, angles, step=0.1, ncore=1)
    ours = find_axis(y, np.ones_like(y), angles)
    assert abs(ours.column - 63.3) < 5 * ours.uncertainty and abs(np.median(theirs) - ours.column) < 0.5
    sorted_by_them = mivol.run_algotom("remove_stripe_based_sorting", y, size=7)
    sorted_by_us = remove_rings(y, np.ones_like(y), "sort", 7)
    np.testing.assert_allclose(sorted_by_us[..., 3:-3], sorted_by_them[..., 3:-3], atol=1e-6 * y.max())
