"""Exposures of photographs by their common points: known gains, and whether fits have gains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from capture_photos import cameras
from photo_sets import write_colmap
from PIL import Image

from mivol import config
from mivol.experiments.field_fit import explain_gains, keep_gains
from mivol.experiments.gaussian_fit import make_gaussian_plan, start_gaussians
from mivol.optim.photographs.radiance_plan import PRESETS
from mivol.photos import Photo, load_photos
from mivol.photos.exposures import DIFFER, FEWEST, measure_exposures

POINTS = np.random.default_rng(2).uniform(-0.2, 0.2, (50, 3))
"""Points in view of all cameras."""


def photograph(gains: np.ndarray) -> list[Photo]:
    """Even photographs of brightness 0.4 times a gain, with own points. Two cameras are close together at each place."""
    views = []
    for k, (camera, gain) in enumerate(zip(np.repeat(cameras(len(gains) // 2), 2), gains, strict=True)):
        pose = camera.to_world.copy()
        pose[:3, 3] *= 1 + 0.01 * (k % 2)
        image = np.full((camera.size[1], camera.size[0], 3), 0.4 * gain, np.float32)
        own = np.random.default_rng(k).uniform(-0.2, 0.2, (60, 3))
        views.append(
            Photo(f"{k}", image, None, None, replace(camera, to_world=pose), np.zeros(3), np.concatenate([POINTS, own]))
        )
    return views


def test_known_gains_are_found_and_those_of_pairs_are_predicted() -> None:
    """The spread is that of the logarithms. Gains of the places differ; in a pair both are equal, or opposite."""
    steps = np.exp(0.1 * np.array([1.0, -1, 1, -1, 2, -2, 0.5, -0.5]))
    opposite = np.ravel(np.column_stack([steps, 1 / steps]))
    for gains, differ in ((np.repeat(steps, 2), False), (opposite, True), (np.ones(16), False)):
        found = measure_exposures(photograph(gains))
        assert found.spread == pytest.approx(np.log(gains).std(), abs=1e-6)
        assert found.differ == differ and (found.unpredicted >= DIFFER) == differ


def test_bad_pixels_do_not_count() -> None:
    """Most points of a photograph are too bright, dark or masked: it has no gain. Of few such photographs nothing is said."""
    views = photograph(np.ones(8))
    dark = replace(views[0], image=np.full_like(views[0].image, 0.01), mask=None)
    masked = replace(views[1], image=np.full_like(views[1].image, 0.9), mask=np.zeros(views[1].image.shape[:2], bool))
    few = replace(views[2], image=np.full_like(views[2].image, 0.9), points=POINTS[: FEWEST - 1])
    found = measure_exposures([dark, masked, few, *views[3:]])
    assert found.spread == found.unpredicted == 0
    assert measure_exposures([dark, masked, few, dark, *views[3:6]]) is None
    assert measure_exposures([replace(view, points=None) for view in views]) is None


@pytest.mark.parametrize(("setting", "has_gains"), [({}, True), ({"exposure": False}, False)])
def test_gaussians_have_gains_if_exposures_differ(variant_rgb: str, tmp_path: Path, setting: dict, has_gains: bool) -> None:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (60, 3))
    folder = write_colmap(tmp_path / "set", "SIMPLE_PINHOLE", n=6, points=points, tracks=[(1, 2, 3, 4, 5, 6)] * len(points))
    for k, file in enumerate(sorted((folder / "images").iterdir())):
        Image.new("RGB", (64, 48), (60 + 40 * (k % 2),) * 3).save(file)
    chosen = config.from_dict({"title": "x", "photos": {"path": str(folder)}, "gaussians": {"preset": "tiny", **setting}})
    start = start_gaussians(chosen, load_photos(folder), make_gaussian_plan(chosen))
    assert start.plan.exposure == has_gains
    reasons = [line.reason for line in start.lines if "gains" in line.choice]
    facts = "points differ in brightness by 26% between photographs, and by 51% from the prediction by the nearest photographs"
    assert reasons == [facts] * has_gains


@pytest.mark.parametrize(("turns", "kept"), [(-1.0, True), (1.0, False)], ids=["differ", "predicted"])
def test_grids_keep_gains_if_exposures_differ(turns: float, kept: bool) -> None:
    """Pairs of opposite gains, which neighbours do not predict, and of equal gains. Without gains nothing is measured."""
    steps = 0.1 * np.array([1.0, -1, 1, -1, 2, -2, 0.5, -0.5])
    photos = SimpleNamespace(views=photograph(np.exp(np.ravel(np.column_stack([steps, turns * steps])))))
    plan = PRESETS["capture"]
    assert keep_gains(plan, photos) == (replace(plan, agree=0.0) if kept else plan)
    line = explain_gains(keep_gains(plan, photos))[0]
    assert ("common points differ" in line.reason) == kept != ("if the photographs differ" in line.choice)
    without = replace(plan, exposure=False)
    assert keep_gains(without, photos) == without and explain_gains(without) == []
