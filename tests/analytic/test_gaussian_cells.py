"""Lists of Gaussians by cell: complete, nearly minimal, and refused beyond the free memory."""

from __future__ import annotations

import numpy as np
import oracle_gaussians as oracle
import pytest
from gaussian_sets import random_gaussians

from mivol.errors import MivolError
from mivol.fields import gaussian_cells
from mivol.fields.gaussian_cells import CellLists, list_gaussians


def lists_of(cloud: oracle.Cloud) -> CellLists:
    return list_gaussians(cloud.means, cloud.whitening(), oracle.REACH)


def cells_of(lists: CellLists, p: np.ndarray) -> np.ndarray:
    """The number of the cell of each point."""
    size = np.array(lists.res[::-1])
    u = (p - lists.to_world[:3, 3]) / np.diag(lists.to_world)[:3]
    assert ((u >= 0) & (u <= 1)).all()
    return np.floor(u * size + 0.5).astype(int) @ np.cumprod([1, *(size[:2] + 1)])


@pytest.mark.parametrize("parts", [1, 50])
def test_a_gaussian_is_listed_wherever_it_reaches(parts: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points on and inside the ellipsoids lie in cells that list the Gaussian, for any size of chunks."""
    cloud = oracle.Cloud.of(random_gaussians(300, 0))
    monkeypatch.setattr(gaussian_cells, "MAX_CHUNK_PAIRS", gaussian_cells.MAX_CHUNK_PAIRS if parts == 1 else 1000)
    lists, rng = lists_of(cloud), np.random.default_rng(1)
    assert min(lists.res) > 3
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
    assert 6 <= listed <= 8 * 3 * max(lists.res) < 0.6 * np.prod(lists.res)


def test_the_largest_sum_is_that_of_the_fullest_cell() -> None:
    lists = lists_of(oracle.Cloud.of(random_gaussians(100, 0)))
    weight = np.random.default_rng(0).uniform(size=100)
    cells = zip(lists.starts[:-1], lists.starts[1:], strict=True)
    assert lists.max_cell_sum(weight) == pytest.approx(max(weight[lists.entries[a:b]].sum() for a, b in cells))


def test_what_cannot_be_listed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MivolError, match="no Gaussians were given; at least one is expected"):
        list_gaussians(np.zeros((0, 3)), np.zeros((0, 3, 3)), oracle.REACH)
    cloud = oracle.Cloud.of(random_gaussians(100, 0))
    monkeypatch.setattr(gaussian_cells, "available_memory", lambda: gaussian_cells.PAIR_BYTES * gaussian_cells.MAX_CHUNK_PAIRS)
    with pytest.raises(MivolError, match=r"100 Gaussians reach into \d+ cells each; .* GiB are free: remove the widest"):
        lists_of(cloud)
