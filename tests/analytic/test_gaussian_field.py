"""Gaussians as a field: rows of any placement, bounds, and what is cut or refused."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import oracle_gaussians as oracle
import pytest
from gaussian_sets import random_gaussians
from refusals import assert_refused

from mivol.errors import MivolError
from mivol.fields import gaussian_field
from mivol.fields.gaussian_field import EXTINCTION_PARAMETERS, MIN_RELATIVE_SCALE, CellLists, GaussianField, list_gaussians
from mivol.fields.gaussian_line import ROW_SIZE, SCALE_COLUMN


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
    assert GaussianField.channels == 1 and rows.shape[1] == ROW_SIZE  # one extinction, whatever the colours


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
    assert_refused(r"Gaussians of a medium: found means .* in Gaussian 2 \(the first of 1\)", field.refresh)
    assert_refused("to_world is degenerate", GaussianField.from_gaussians, gaussians, np.diag([1.0, 0, 1, 1]))


def lists_of(cloud: oracle.Cloud) -> CellLists:
    return list_gaussians(cloud.means, cloud.whitening(), oracle.REACH)


def cells_of(lists: CellLists, p: np.ndarray) -> np.ndarray:
    """The number of the cell of each point."""
    assert all(((x >= axis[0]) & (x <= axis[-1])).all() for axis, x in zip(lists.planes, p.T, strict=True))
    index = [np.searchsorted(axis, x, side="right") - 1 for axis, x in zip(lists.planes, p.T, strict=True)]
    return np.stack(index, axis=1) @ np.cumprod([1, *(len(axis) - 1 for axis in lists.planes[:2])])


@pytest.mark.parametrize("parts", [1, 50])
def test_a_gaussian_is_listed_wherever_it_reaches(parts: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points on and inside the ellipsoids lie in cells that list the Gaussian, for any size of chunks."""
    cloud = oracle.Cloud.of(random_gaussians(300, 0))
    monkeypatch.setattr(gaussian_field, "MAX_CHUNK_PAIRS", gaussian_field.MAX_CHUNK_PAIRS if parts == 1 else 1000)
    lists, rng = lists_of(cloud), np.random.default_rng(1)
    assert min(len(axis) for axis in lists.planes) > 4
    whitening = cloud.whitening()
    for index in range(300):
        u = rng.normal(size=(50, 3))
        u *= oracle.REACH * rng.uniform(0.5, 1, (50, 1)).round(1) / np.linalg.norm(u, axis=1, keepdims=True)
        for cell in cells_of(lists, cloud.means[index] + u @ np.linalg.inv(whitening[index]).T):
            assert index in lists.entries[lists.starts[cell] : lists.starts[cell + 1]]


def test_a_thin_gaussian_across_the_box_is_in_few_cells() -> None:
    """A needle from corner to corner crosses about 3 n cells of a cube of n^3 cells, with neighbours; its box holds n^3."""
    cloud = oracle.Cloud.of(random_gaussians(400, 0))
    cloud.means[0], cloud.log_scales[0] = 0, np.log([0.4, 1e-4, 1e-4])
    axis, along = np.array([1.0, 0, 0]), np.ones(3) / np.sqrt(3)
    cloud.quaternions[0] = [1 + axis @ along, *np.cross(axis, along)]
    lists = lists_of(cloud)
    listed = int((lists.entries == 0).sum())
    sizes = [len(axis) - 1 for axis in lists.planes]
    assert 6 <= listed <= 8 * 3 * max(sizes) < 0.6 * np.prod(sizes)


def test_the_largest_sum_is_that_of_the_fullest_cell() -> None:
    lists = lists_of(oracle.Cloud.of(random_gaussians(100, 0)))
    weight = np.random.default_rng(0).uniform(size=100)
    cells = zip(lists.starts[:-1], lists.starts[1:], strict=True)
    assert lists.max_cell_sum(weight) == pytest.approx(max(weight[lists.entries[a:b]].sum() for a, b in cells))
    first = CellLists([np.zeros(2)] * 3, np.uint32([0, 2, 3]), np.uint32([0, 1, 1]))  # the first cell is the fullest
    assert first.max_cell_sum(np.array([1.0, 2.0])) == 3


def test_lists_stay_short_where_a_few_are_far_away() -> None:
    """As in fits of photographs, where Gaussians of the sky stand 50 times as far as the others: equal cells would put all
    others into one cell."""
    given = random_gaussians(2000, 0)
    given.means[:100] *= 50
    given.log_scales[:] -= 2
    lists = lists_of(oracle.Cloud.of(given))
    assert np.diff(lists.starts).max() < 0.1 * 2000


def test_wide_gaussians_get_fewer_cells() -> None:
    """Of 2000 cells, each of these would reach into most."""
    given = random_gaussians(2000, 0)
    given.log_scales[:] = np.log(0.3)
    assert len(lists_of(oracle.Cloud.of(given)).entries) <= gaussian_field.MAX_REACHED * 2000


def test_means_in_one_place_make_thin_cells_no_thinner_than_a_step() -> None:
    """Planes stay apart, and a flat cloud has one cell across."""
    given = random_gaussians(1000, 0)
    given.means[:500] = 0.1 + 1e-6 * given.means[:500]
    lists = lists_of(oracle.Cloud.of(given))
    assert all((np.diff(axis) > 0.9 * (axis[-1] - axis[0]) / gaussian_field.STEPS).all() for axis in lists.planes)
    given.means[:, 2] = 0
    given.log_scales[:, 2] = -20
    assert len(lists_of(oracle.Cloud.of(given)).planes[2]) <= 3


def test_what_cannot_be_listed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MivolError, match="no Gaussians were given; at least one is expected"):
        list_gaussians(np.zeros((0, 3)), np.zeros((0, 3, 3)), oracle.REACH)
    cloud = oracle.Cloud.of(random_gaussians(100, 0))
    monkeypatch.setattr("mivol.machine.available_memory", lambda: gaussian_field.PAIR_BYTES * gaussian_field.MAX_CHUNK_PAIRS)
    assert_refused(r"100 Gaussians, which reach into \d+ cells each, .* GiB are free: remove the widest", lists_of, cloud)
