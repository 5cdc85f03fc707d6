"""A volume from all sides: rays through it add up what is in it, and it turns about its upright axis."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mivol.experiments.film import film_of_volume
from mivol.experiments.run_folder import RunFolder
from mivol.report.page import write_page
from mivol.report.record import RunRecord, write_record
from mivol.report.video import FEWEST_LAYERS, volume_frames

SIDE = 16


def one_voxel(z: int, y: int, x: int) -> np.ndarray:
    values = np.zeros((SIDE, SIDE, SIDE, 1), np.float32)
    values[z, y, x] = 3.0
    return values


def brightest(frame: np.ndarray) -> tuple[float, float]:
    """(row, column) of the mean of the light, in parts of the picture, 0 at its top left corner."""
    grey = frame[..., 0].astype(float)
    rows, columns = np.indices(grey.shape) + 0.5
    return (grey * rows).sum() / grey.sum() / grey.shape[0], (grey * columns).sum() / grey.sum() / grey.shape[1]


@pytest.mark.parametrize("upright", ["y", "z"])
def test_a_voxel_goes_around(upright: str) -> None:
    """Off the axis by 5.5 and 0.5 voxels it swings by 5.5 to either side, and its row stays: 3 of 16 layers are above it.

    Pictures are 23 = ceil(16 sqrt(2)) rays wide. Places are read to a tenth of a voxel: 8 bits, 8 pixels a ray.
    """
    low, middle = SIDE - 4, SIDE // 2
    values = one_voxel(low, middle, middle + 5) if upright == "z" else one_voxel(middle, low, middle + 5)
    frames, _ = volume_frames(values, (1.0, 1.0, 1.0), upright, count=8)
    places = np.array([brightest(frame) for frame in frames])
    np.testing.assert_allclose(places[:, 0], 3.5 / SIDE, atol=0.1 / SIDE)
    rays = math.ceil(SIDE * math.sqrt(2))
    seen = (places[:, 1] - 0.5) * rays
    assert np.ptp(seen) == pytest.approx(2 * 5.5, abs=0.2)
    np.testing.assert_allclose(seen[:4], -seen[4:], atol=0.1)


def test_white_is_the_longest_way_through_a_box() -> None:
    """A box of ones, 1 x 2 x 4: its longest horizontal way is sqrt(5) where z is upright, less up to a voxel at either end."""
    values = np.ones((64, 32, 16, 1), np.float32)
    frames, white = volume_frames(values, (1.0, 2.0, 4.0), "z", count=64)
    assert math.sqrt(5) - 2 / 16 < white < math.sqrt(5) + 0.01
    height, width = frames[0].shape[:2]
    assert height / width == pytest.approx(4 / (math.ceil(16 * math.sqrt(5)) / 16), rel=0.01)


def test_what_shows_nothing_is_left_out() -> None:
    flat = np.ones((FEWEST_LAYERS - 1, 20, 20, 1))
    assert volume_frames(flat, (1, 1, 1), "z") == ([], 0.0)
    assert volume_frames(np.zeros((20, 20, 20, 1)), (1, 1, 1), "z") == ([], 0.0)


def test_large_volumes_are_projected_by_means() -> None:
    """200 voxels along z are 67 means of three, the last of two: the integral across is the same."""
    values = np.ones((200, 8, 8, 1), np.float32)
    _, white = volume_frames(values, (1.0, 1.0, 1.0), "z", count=1)
    assert white == pytest.approx(volume_frames(values[:50], (1.0, 1.0, 1.0), "z", count=1)[1], rel=1e-6)


def test_the_film_stands_on_the_page(tmp_path) -> None:
    record = RunRecord.new("a volume")
    run = RunFolder(tmp_path, record)
    record.images += film_of_volume(run, one_voxel(4, 5, 6), (1.0, 1.0, 1.0), "z", "sigma_t")
    write_record(record, tmp_path)
    page = write_page(tmp_path).read_text()
    assert "data:image/webp;base64" in page
    assert "(sigma_t times length)" in page
