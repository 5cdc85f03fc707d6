"""The bench of choices: pairs of fits differ in the choice alone, and each is judged as it was fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from ball_photos import camera
from PIL import Image

from mivol.bench.studies import gaussian_choices, points
from mivol.bench.studies.gaussian_fits import Fitted, psnr_of
from mivol.errors import MivolError
from mivol.optim.gaussians.gaussian_plan import PRESETS, GaussianPlan
from mivol.optim.gaussians.gaussian_start import make_start_cloud
from mivol.photos import Photo, Photos
from mivol.photos.transforms import write_transforms
from mivol.points import Gaussians
from mivol.splatting import Splatter, to_tensors

WHITE = np.ones(3, np.float32)


def ball(count: int = 80) -> Gaussians:
    """Opaque Gaussians of many colours."""
    cloud = Gaussians(**make_start_cloud(np.random.default_rng(2).uniform(-0.5, 0.5, (count, 3)), [], 0))
    cloud.opacity_logits[:] = 3
    cloud.harmonics[:, 0] = np.sin(5 * cloud.means)
    return cloud


def test_a_cloud_is_judged_with_the_filter_that_it_was_fitted_with(variant_rgb: str) -> None:
    """Gaussians of a twentieth of a pixel keep their light with the mip filter, and their opacity without: pictures differ."""
    cloud = replace(ball(), log_scales=np.full((80, 3), np.log(2e-3), np.float32))
    seen = np.array(Splatter(32, 32, 0, compensated=True).forward(to_tensors(cloud), camera(0, 32), derivatives=False)[0])
    view = Photo("0", seen[..., :3] + 1 - seen[..., 3:], None, None, camera(0, 32), WHITE)
    assert psnr_of(cloud, [view], replace(PRESETS["tiny"], mip=True)) > 50
    assert psnr_of(cloud, [view], PRESETS["tiny"]) < 40


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Ten views of 32 x 32 pixels: with alpha, two of them the test split; without alpha, every other one half as bright."""
    mi.set_variant("llvm_ad_rgb")
    splatter, cloud, found = Splatter(32, 32, 0), to_tensors(ball()), {}
    for name, alpha in (("alpha", True), ("exposed", False)):
        folder, cameras = tmp_path_factory.mktemp(name), {}
        for k in range(10):
            seen = np.clip(np.array(splatter.forward(cloud, camera(k, 32), derivatives=False)[0]), 0, 1)
            rgb = seen[..., :3] / np.maximum(seen[..., 3:], 1e-3) if alpha else seen[..., :3] * (1.0, 0.5)[k % 2]
            pixels = np.concatenate([rgb, seen[..., 3:]], axis=-1) if alpha else rgb
            Image.fromarray(np.rint(255 * np.clip(pixels, 0, 1)).astype(np.uint8)).save(folder / f"view_{k}.png")
            cameras[f"view_{k}.png"] = camera(k, 32)
        write_transforms(folder / "transforms.json", cameras, ["view_3.png", "view_8.png"] if alpha else [])
        found[name] = folder
    return found


def test_fits_with_and_without_mip_differ_in_nothing_else(
    variant_rgb: str, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each cloud is judged at every size by the plan that it was fitted by."""
    plans, judged = [], []

    def fitted(photos: Photos, plan: GaussianPlan, seed: int) -> SimpleNamespace:
        plans.append((plan, seed, len(photos.views)))
        return SimpleNamespace(cloud=vars(ball()))

    def psnr(cloud: Gaussians, views: Sequence[Photo], plan: GaussianPlan) -> float:
        judged.append((plan.mip, views[0].camera.size, len(views)))
        return 30.0 + plan.mip

    monkeypatch.setattr(gaussian_choices, "fitted", fitted)
    monkeypatch.setattr(gaussian_choices, "psnr_of", psnr)
    found = gaussian_choices.mip_gain(folders["alpha"], Fitted("tiny", 0.1, 0.5, (3,)), (0.5, 1.0))
    (without, *rest), (with_, *same) = plans
    assert rest == same == [3, 8]
    assert with_ == replace(without, mip=True) and without.steps == found["steps"] == 50
    assert judged == [(mip, (side, side), 2) for mip in (False, True) for side in (16, 32)]
    assert found == {
        "steps": 50,
        "fitted_at": 16,
        "views": 2,
        "without": {"16": 30.0, "32": 30.0},
        "with": {"16": 31.0, "32": 31.0},
    }


@pytest.mark.slow
def test_gains_are_found_where_photographs_differ(variant_rgb: str, folders: dict[str, Path]) -> None:
    """Every other photograph is half as bright as its neighbour: their gains differ by a quarter at least after 200 steps (by a
    factor of 2 in the end), and there are none where they were not asked for."""
    found = gaussian_choices.exposure_gain(folders["exposed"], Fitted("tiny", 0.4, 1.0, (0,)), 5)
    assert found["without"]["gains"] == [1, 1]
    low, high = found["with"]["gains"]
    assert high > 1.25 * low
    assert found["pixels"] == [32, 32] and found["fitted"] + found["judged"] == 10 and found["steps"] == 200
    for name in ("without", "with"):
        assert found[name]["psnr_colour_fitted"] > found[name]["psnr"] > 5


def test_data_that_is_not_here_is_named(tmp_path: Path) -> None:
    for gain, more in ((gaussian_choices.mip_gain, (1.0,)), (gaussian_choices.exposure_gain, 8)):
        with pytest.raises(MivolError, match="set MIVOL_DATA"):
            gain(tmp_path / "nothing", Fitted("tiny", 1.0, 1.0, (0,)), more)


def test_what_the_bench_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The chair at three sizes and the fox, with fewer steps where the bench is quick; no figure has a bar."""
    monkeypatch.setattr(points, "mip_gain", lambda folder, asked, at: {"asked": (folder.name, asked.effort, at)})
    monkeypatch.setattr(points, "exposure_gain", lambda folder, asked, every: {"asked": (folder.name, asked.effort, every)})
    mip, exposure = points.measure_mip(points.QUICK), points.measure_exposure(points.FULL)
    assert mip == {"asked": ("chair", pytest.approx(0.5 * 0.02), (0.125, 0.25, 1.0))}
    assert exposure == {"asked": ("fox", 0.5, 8)}
    assert points.compare("mip", mip) == points.compare("exposure", exposure) == []
