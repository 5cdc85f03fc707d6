"""Gaussians as a field: rows of any placement, bounds, and what is cut or refused."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from gaussian_sets import random_gaussians

from mivol.errors import MivolError
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, MIN_RELATIVE_SCALE, GaussianField
from mivol.fields.gaussian_line import ROW_SIZE, SCALE_COLUMN

pytestmark = pytest.mark.usefixtures("variant_rgb")


def rows_of(field: GaussianField, scale: float = 1.0) -> np.ndarray:
    return np.array(field.rows(mi.Float(scale)), np.float64).reshape(-1, ROW_SIZE)


def test_rows_hold_what_a_placed_gaussian_is() -> None:
    """W maps the world to standard deviations: a shear and a mirroring of the cloud are in it."""
    gaussians, place = random_gaussians(5, 0), np.array([[2, 0.5, 0, 1], [0, -1, 0.3, 2], [0.1, 0, 3, 0], [0, 0, 0, 1.0]])
    cloud, rows = oracle.Cloud.of(gaussians), rows_of(GaussianField.from_gaussians(gaussians, place), 2.5)
    p = np.random.default_rng(0).normal(size=(7, 3))
    world = p @ place[:3, :3].T + place[:3, 3]
    ours = np.einsum("nij,pnj->pni", rows[:, :9].reshape(-1, 3, 3), world[:, None] - rows[:, 9:12])
    truth = np.einsum("nij,pnj->pni", cloud.whitening(), p[:, None] - cloud.means)
    np.testing.assert_allclose(ours, truth, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(rows[:, 12], 1 / (1 + np.exp(-cloud.opacity_logits)), rtol=1e-6)
    np.testing.assert_array_equal(rows[:, SCALE_COLUMN], 2.5)


def test_a_value_is_at_most_the_bound_and_reaches_it_at_a_mean() -> None:
    """Of one Gaussian, at its mean along the shortest axis; of many, nowhere above."""
    one = random_gaussians(1, 0)
    field, cloud = GaussianField.from_gaussians(one, np.eye(4)), oracle.Cloud.of(one)
    shortest = cloud.whitening()[0][np.argmin(cloud.log_scales[0])]
    w = mi.Vector3f(*(shortest / np.linalg.norm(shortest)).tolist())
    (value,) = field.eval(mi.Point3f(*cloud.means[0].tolist()), w, mi.Bool(True))
    assert float(value[0]) == pytest.approx(field.bound()[0], rel=1e-5)
    many = random_gaussians(200, 0)
    field, rng = GaussianField.from_gaussians(many, np.eye(4)), np.random.default_rng(0)
    p, w = many.means.repeat(20, axis=0), rng.normal(size=(4000, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    (value,) = field.eval(mi.Point3f(p.T.astype(np.float32)), mi.Vector3f(w.T.astype(np.float32)), dr.full(mi.Bool, True, 4000))
    truth = oracle.extinction(oracle.Cloud.of(many), p.astype(np.float64), w).sum(axis=1)
    np.testing.assert_allclose(np.array(value), truth, rtol=1e-4, atol=1e-4)
    assert truth.max() <= field.bound()[0] < 30 * truth.max()


def test_extremes_are_cut_and_stay_finite() -> None:
    """Opacities of 0 and 1, infinite logits, scales of nothing: numbers and derivatives are finite, and one may be 0."""
    given = random_gaussians(4, 0)
    given.opacity_logits[:] = [np.inf, -np.inf, 50, -50]
    given.log_scales[0] = [-60, -1, -1]
    field = GaussianField.from_gaussians(given, np.eye(4))
    for tensor in field.tensors.values():
        dr.enable_grad(tensor)
    rows = field.rows(mi.Float(1))
    dr.backward(dr.sum(rows))
    assert np.isfinite(np.array(rows)).all()
    for name in EXTINCTION_PARAMETERS:
        assert np.isfinite(np.array(dr.grad(field.tensors[name]))).all(), name
    np.testing.assert_allclose(rows_of(field)[:, 12], [0.999, 0, 0.999, 0], atol=1e-6)
    edge = np.diag(field.to_world)[:3].max()
    longest = np.linalg.norm(rows_of(field)[0, :9].reshape(3, 3), axis=1).max()
    assert longest == pytest.approx(1 / (MIN_RELATIVE_SCALE * edge), rel=0.01)


def test_an_update_lists_them_anew_and_bad_numbers_are_refused_by_index() -> None:
    gaussians = random_gaussians(3, 0)
    field = GaussianField.from_gaussians(gaussians, np.eye(4))
    before = field.to_world.copy()
    field.tensors["means"] = mi.TensorXf(gaussians.means + 10)
    field.refresh()
    np.testing.assert_allclose(field.to_world[:3, 3], before[:3, 3] + 10, rtol=1e-5)
    field.tensors["means"] = mi.TensorXf(np.where(np.arange(3)[:, None] == 2, np.nan, gaussians.means).astype(np.float32))
    with pytest.raises(MivolError, match=r"Gaussians of a medium: found means .* in Gaussian 2 \(the first of 1\)"):
        field.refresh()
    with pytest.raises(MivolError, match="to_world is degenerate"):
        GaussianField.from_gaussians(gaussians, np.diag([1.0, 0, 1, 1]))
