"""Procedural volumes: where their points lie, and that resolution changes no object."""

from __future__ import annotations

import numpy as np
import pytest

from mivol.fields.procedural import PROCEDURAL, make_procedural


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
