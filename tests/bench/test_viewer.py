"""The study of the live view, in small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mivol.bench.studies import viewer
from mivol.files import read_volume
from mivol.points import read_gaussians


@pytest.mark.parametrize("name", ["balls.ply", "field.npz", "volume.nrrd"])
def test_pictures_are_drawn_and_timed(variant_rgb: str, name: str) -> None:
    answer = viewer.measure_pictures(name, viewer.ViewerSize.quick())
    assert answer["clock"] > 0 and 48 <= answer["width"] <= 64 and name in viewer.table("", answer)[0]


def test_the_cameras_look_at_what_is_drawn(tmp_path: Path) -> None:
    """They turn about (0.5, 0.5, 0.5), the middle of the Gaussians and of the volume."""
    size = viewer.ViewerSize.quick()
    balls = read_gaussians(viewer.write_subject(tmp_path / "balls.ply", size))
    assert np.abs(balls.means - 0.5).max() <= 0.35 + 1e-6
    volume = read_volume(viewer.write_subject(tmp_path / "volume.nrrd", size))
    np.testing.assert_array_equal(volume.to_world, np.eye(4))
