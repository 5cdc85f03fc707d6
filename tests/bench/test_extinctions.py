"""Volumes of the studies: sizes, values, and made-up volumes in place of missing data."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mivol.bench import extinctions
from mivol.bench.extinctions import (
    Extinction,
    as_dense_as_smoke,
    ct_scan,
    fine_smoke,
    les_cloud,
    made_up,
    smoke,
    threads_in_space,
)


def test_volumes_without_data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, variant_rgb: str) -> None:
    """Made-up ones of the same sizes, which say so; what they are made of is the procedural fields' own test."""
    monkeypatch.setattr(extinctions, "DATA", tmp_path)
    constant = lambda kind, shape, seed, peak: np.full((*shape, 1), peak, np.float32)  # noqa: E731
    monkeypatch.setattr(extinctions, "make_procedural", constant)
    assert str(smoke()) == "44x45x53, procedural (no data folder)"
    assert str(les_cloud()) == "32x37x26, procedural (no data folder)"
    result = ct_scan(8)
    assert str(result) == "8x8x8, procedural (quick)"
    assert result.values.dtype == np.float32
    assert result.values.max() == pytest.approx(2, rel=1e-6)


def test_volumes_of_the_data(data_dir: Path, variant_rgb: str) -> None:
    """The tutorial's smoke at optical depths of up to 65 along its voxels; the cloud keeps the optical depth of its height."""
    result = smoke()
    assert str(result) == "44x45x53, Mitsuba tutorial, x 40"
    assert np.max(result.values.sum(axis=1) * 2 / result.values.shape[1]) == pytest.approx(65, rel=0.1)
    assert les_cloud().origin.startswith("LES cloud")


def test_fine_smoke_is_the_smoke(variant_rgb: str) -> None:
    """The same field at other points: its mean, to what interpolation of 45 voxels leaves out at the borders."""
    fine, coarse = fine_smoke(64), smoke()
    assert fine.values.shape == (64, 64, 64)
    assert fine.values.mean() == pytest.approx(coarse.values.mean(), rel=0.03)


def test_threads_leave_space_empty() -> None:
    """A hundredth of the voxels at least, and no more than one more curve fills."""
    result = threads_in_space(48)
    share = np.mean(result.values > 0)
    assert 0.01 <= share < 0.06
    assert result.values.max() == pytest.approx(20)
    # As when the benches were last measured; a few nodes may be rounded otherwise elsewhere.
    assert np.count_nonzero(result.values) == pytest.approx(3670, rel=5e-3)
    assert result.values.sum() == pytest.approx(36372, rel=5e-3)


def test_as_dense_as_the_smoke() -> None:
    """Its largest extinction, and nothing in the outermost voxels."""
    result = as_dense_as_smoke(Extinction(np.arange(125, dtype=np.float32).reshape(5, 5, 5), "a ramp"))
    assert result.values.max() == pytest.approx(smoke().values.max(), rel=1e-6)
    border = np.ones((5, 5, 5), bool)
    border[1:-1, 1:-1, 1:-1] = False
    assert np.all(result.values[border] == 0) and np.all(result.values[~border] > 0)
    assert "as dense as the smoke" in result.origin


def test_a_made_up_volume_has_its_peak() -> None:
    result = made_up((5, 6, 7), 3.0)
    assert result.values.shape == (5, 6, 7)
    assert result.values.max() == pytest.approx(3, rel=1e-6)


def test_every_volume_fills_the_box(variant_rgb: str) -> None:
    """The unit cube's corners go to those of [-1, 1]^3."""
    place = mi.ScalarTransform4f(np.float32(extinctions.TO_WORLD))
    assert np.allclose(np.ravel(place @ mi.ScalarPoint3f(0, 0, 0)), -1)
    assert np.allclose(np.ravel(place @ mi.ScalarPoint3f(1, 1, 1)), 1)
