"""The bench's fits: what is judged, and how processor time becomes minutes."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from ball_photos import camera

from mivol.bench.studies.gaussian_fits import Fitted, fit_and_judge, psnr_of
from mivol.errors import MivolError
from mivol.optim.gaussians.gaussian_plan import PRESETS
from mivol.optim.gaussians.gaussian_start import make_start_cloud
from mivol.photos import Photo
from mivol.points import Gaussians
from mivol.splatting import Splatter, to_tensors


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(MivolError, match="set MIVOL_DATA"):
        fit_and_judge(tmp_path / "chair", Fitted("tiny", 1.0, 1.0, (0,)), 1.0, 1.0)


def test_views_of_the_same_gaussians_agree_to_8_bits_and_those_of_others_do_not(variant_rgb: str) -> None:
    """A picture rounded to 8 bits differs from itself by 1/255/sqrt(12) RMS at most: above 58 dB."""
    places = np.random.default_rng(2).uniform(-0.5, 0.5, (80, 3))
    cloud = Gaussians(**make_start_cloud(places, [], 0))
    splatter, white = Splatter(32, 32, 0), np.ones(3, np.float32)
    views = []
    for k in range(2):
        seen = np.array(splatter.forward(to_tensors(cloud), camera(k, 32), derivatives=False)[0])
        image = np.rint(np.clip(seen[..., :3] + 1 - seen[..., 3:], 0, 1) * 255).astype(np.float32) / 255
        views.append(Photo(f"{k}", image, None, None, camera(k, 32), white))
    assert mi.variant() == variant_rgb
    assert psnr_of(cloud, views, PRESETS["tiny"]) > 58
    assert psnr_of(cloud.select(slice(40)), views, PRESETS["tiny"]) < 40
