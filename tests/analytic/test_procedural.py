"""Procedural volumes: where their points lie, and that resolution changes no object."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.errors import MivolError
from mivol.fields.procedural import PROCEDURAL, inside, make_procedural


def test_procedural_points_are_voxel_centres(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recipe that returns one of its coordinates: x along the last axis, z along the first, centres at (i + 1/2) / n."""
    for axis, name in enumerate("xyz"):
        monkeypatch.setitem(PROCEDURAL, name, lambda p, rng, axis=axis: p[..., axis])
        values = make_procedural(name, (2, 3, 4), seed=0, peak=2.0)[..., 0]
        n = (4, 3, 2)[axis]
        line = np.moveaxis(values, 2 - axis, 0)[:, 0, 0]
        assert np.allclose(line, 2 * (np.arange(n) + 0.5) / n)


def test_procedural_volumes_are_the_same_object_at_every_resolution() -> None:
    """Fine voxels averaged over coarse ones against coarse voxels: they differ by the curvature inside a voxel only; with
    two axes exchanged they would differ by the object's own contrast. And another seed is another object."""
    coarse = make_procedural("tangle", (8, 10, 12), seed=1, peak=2.0)[..., 0]
    fine = make_procedural("tangle", (24, 30, 36), seed=1, peak=2.0)[..., 0]
    mean = fine.reshape(8, 3, 10, 3, 12, 3).mean(axis=(1, 3, 5))
    assert np.corrcoef(mean.ravel(), coarse.ravel())[0, 1] > 0.9
    assert np.corrcoef(make_procedural("tangle", (8, 10, 12), seed=2, peak=2.0).ravel(), coarse.ravel())[0, 1] < 0.8
    assert fine.max() <= 2.0
    assert fine.min() >= 0.0


def test_a_seed_is_the_same_object_on_every_machine() -> None:
    """Mean, spread, largest value and three voxels, as recorded; elementary functions differ by 1e-15 between machines."""
    values = make_procedural("tangle", (9, 10, 11), seed=5, peak=2.0)[..., 0]
    found = [values.mean(), values.std(), values.max(), values[4, 5, 6], values[2, 7, 3], values[6, 3, 8]]
    np.testing.assert_allclose(found, [0.08407, 0.23891, 1.84418, 1.44317, 0.5357, 0.00068], atol=1e-5)
    with pytest.raises(MivolError, match='"tangel": known are tangle'):
        make_procedural("tangel", (2, 2, 2), seed=0, peak=1.0)


def test_an_object_ends_before_its_box() -> None:
    """1 up to 0.42 of the middle, 0 from 0.48 on, a ramp between, along every axis."""
    for axis in range(3):
        points = np.full((5, 3), 0.5)
        points[:, axis] += [-0.42, 0.45, 0.48, -0.5, 0.1]
        np.testing.assert_allclose(inside(points), [1, 0.5, 0, 0, 1], atol=1e-12)
