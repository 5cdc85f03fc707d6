"""What a reconstruction leaves in its folder, from numbers that are made up: which view stands where, and the results."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mivol.experiments.scan_outputs import write_outputs
from mivol.files import read_exr, read_volume
from mivol.tomography.geometry import ParallelBeam, VoxelGrid

GRID = VoxelGrid((2, 3, 4), (0.5, 0.25, 0.75))


def written(
    folder: Path, y: np.ndarray, held_out: np.ndarray, truth: np.ndarray | None, is_noise_known: bool = False
) -> SimpleNamespace:
    """The record of a run whose volume is 0, 1, 2, ... and projects to half of what was measured."""
    record = SimpleNamespace(volumes=[], images=[], results={})
    run = SimpleNamespace(path=folder, record=record, write_curves=lambda: None)
    run.make = lambda *names: [(folder / name).mkdir() for name in names]

    class Half:
        grid, n_views = GRID, len(y)

        def __matmul__(self, x: np.ndarray) -> np.ndarray:
            return 0.5 * y

    weights = np.full(y.shape, 4.0)
    weights[..., 0] = 0 if is_noise_known else 4.0
    beam = ParallelBeam(np.arange(len(y)) / len(y), y.shape[1:])
    data = SimpleNamespace(y=y, weights=weights, truth=truth, is_noise_known=is_noise_known, geometry=beam)
    write_outputs(run, Half(), GRID, data, held_out, np.arange(24.0, dtype=np.float32).reshape(GRID.shape))
    return record


def test_outputs_of_a_scan(tmp_path: Path) -> None:
    """Six views of 4 x 5 pixels, of which all but the first are held out: the first four of these are shown, upright."""
    y = np.arange(120.0, dtype=np.float32).reshape(6, 4, 5)
    held_out = np.arange(1, 6)
    record = written(tmp_path, y, held_out, np.arange(24.0).reshape(GRID.shape))
    *views, side, plan = record.images
    assert [(image.path, image.role) for image in (side, plan)] == [
        ("scanner_side.png", "picture"),
        ("scanner_plan.png", "picture"),
    ]
    shown = [(image.view, image.role, image.held_out) for image in views]
    names = [("sinogram", False), *((f"view {k}", True) for k in (1, 2, 3, 4))]
    assert shown == [(name, role, kept) for name, kept in names for role in ("render", "reference")]
    for name, expected in (("sinogram", y[:, 2]), ("view_3", y[3, ::-1])):
        channels, _ = read_exr(tmp_path / "views" / f"{name}.exr")
        np.testing.assert_array_equal(channels["reference.Y"], expected)
        np.testing.assert_array_equal(channels["Y"], 0.5 * expected)
    assert {image.caption for image in views} == {"row 3 of 4", ""}
    assert all(volume.profiles for volume in record.volumes)
    # A residual of half of what was measured, over a noise of 1/2.
    assert record.results == {
        "views": 1.0,
        "nrmse": 0.0,
        "held_out_rms_of_residual_over_noise": pytest.approx(np.sqrt(np.mean(y[1:] ** 2)), rel=1e-6),
    }
    assert [(volume.role, volume.size) for volume in record.volumes] == [
        (role, tuple(float(edge) for edge in GRID.extent)) for role in ("reconstruction", "truth")
    ]
    assert read_volume(tmp_path / "volumes/reconstruction.vol").values.ravel().tolist() == list(range(24))


def test_a_single_row_is_the_sinogram(tmp_path: Path) -> None:
    """Views of one row are shown as the sinogram alone; without a truth or views held out nothing is said of them."""
    record = written(tmp_path, np.ones((4, 1, 5), np.float32), np.arange(0), None)
    assert {image.view for image in record.images if image.role != "picture"} == {"sinogram"}
    assert record.results == {"views": 4.0}
    assert [volume.role for volume in record.volumes] == ["reconstruction"]
    (tmp_path / "held out").mkdir()
    record = written(tmp_path / "held out", np.ones((4, 1, 5), np.float32), np.arange(1), None)
    assert {image.view for image in record.images if image.role != "picture"} == {"sinogram"}


def test_noise_that_is_known_stands_beside_the_lines(tmp_path: Path) -> None:
    """A weight of 4 is a noise of 1/2, and one of 0 has no bound."""
    record = written(tmp_path, np.ones((4, 1, 5), np.float32), np.arange(0), None, is_noise_known=True)
    (noise,) = (image for image in record.images if image.role == "standard error")
    channels, _ = read_exr(tmp_path / noise.path)
    np.testing.assert_array_equal(channels[noise.layer], [[np.inf, 0.5, 0.5, 0.5, 0.5]] * 4)
