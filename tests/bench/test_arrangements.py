"""What studies arrange before they measure: scenes, clouds, views and settings, as when the published figures were made."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scene_numbers import numbers_of

from mivol.bench.studies import (
    cluster,
    cluster_kills,
    conversions,
    depth,
    media_light,
    points,
    representations,
    sparse,
    steps,
    viewer,
)
from mivol.bench.studies.gradients import tutorial
from mivol.bench.studies.radiance_field import contestants
from mivol.files import read_volume
from mivol.points import read_gaussians


def arrange_clouds(folder: Path) -> list:
    cloud, camera = points.random_cloud(20), points.camera_before(np.ones(3), 2.0, 8)
    scenes = [points.ellipsoid_scene(cloud, camera), *(points.medium_scene(cloud, camera, kind) for kind in (False, True))]
    return [asdict(cloud), *scenes]


def arrange_sparse_fit(folder: Path) -> list:
    views = sparse.views_of(sparse.smoke_puff(16), sparse.SparseSize.quick())
    return [*(view.sensor for view in views), sparse.smoke_puff(16), sparse.cloud_scene({}, 8), sparse.fit_scene({})]


def arrange_photographs_of_kills(folder: Path) -> list:
    cluster_kills.write_experiments(folder)
    images = [np.array(Image.open(path)) / 255.0 for path in sorted((folder / "photographs").glob("*.png"))]
    poses = json.loads((folder / "photographs" / "transforms.json").read_text())
    return [images, [frame["transform_matrix"] for frame in poses["frames"]]]


def arrange_workloads(folder: Path) -> list:
    gradient = {"one": 2.0, "blocks": 6, "owner": 0.5}
    reference = {"rounds": [{"one": 3.0}, {"one": 5.0}, {"one": 9.0}]}
    photographs = {"views": 7, "numbers": 900, "view": 0.25, "owner": 0.125}
    loads = cluster.make_workloads(cluster.ClusterSize(), gradient, reference, photographs)
    return [[load.units, np.log([load.unit_seconds, load.message_bytes]), load.owner_seconds, load.streams] for load in loads]


def arrange_subjects(folder: Path) -> list:
    size = viewer.ViewerSize.quick()
    cloud = read_gaussians(viewer.write_subject(folder / "a.ply", size))
    with np.load(viewer.write_subject(folder / "a.npz", size)) as field:
        arrays = [field[name] for name in sorted(field) if field[name].dtype.kind == "f"]
    return [asdict(cloud), read_volume(viewer.write_subject(folder / "a.nrrd", size)).values, arrays]


def arrange_settings(folder: Path) -> list:
    fits = representations.list_smoke_fits(2.0).values()
    models = [representations.list_settings(representations.RepresentationSize(), has_alpha) for has_alpha in (False, True)]
    return [[[fit.sigma_t, fit.rates] for fit in fits], models, conversions.list_sources(conversions.ConversionSize())]


def arrange_tiny_fits(folder: Path) -> list:
    photos = [[photo.image, photo.alpha, photo.camera.to_world] for photo in steps._photograph_cloud()]
    return [steps._draw_places(9, 1), photos]


ARRANGEMENTS: dict[str, tuple[Callable[[Path], object], float]] = {
    "clouds of Gaussians": (arrange_clouds, -16.337897),
    "sparse fit": (arrange_sparse_fit, 12.957139),
    "photographs of kills": (arrange_photographs_of_kills, 5.7412125),
    "workloads": (arrange_workloads, 6371.2385),
    "subjects of the viewer": (arrange_subjects, 26.5633),
    "settings": (arrange_settings, -38.660892),
    "tiny fits": (arrange_tiny_fits, -16.166854),
    "cubes": (lambda folder: [depth.make_cube(*kind, 0.5, 2.0) for kind in depth.TABLES], -5.4978862),
    "media that emit": (lambda folder: [media_light.make_scene(name, 8) for name in ("fire", "fog", "room")], 54.258493),
    "tutorial": (lambda folder: tutorial.tutorial_scene(mi.TensorXf(np.ones((2, 2, 2, 1)))), 1.3530463),
    "fog": (lambda folder: contestants.make_fog(contestants.FieldSize.quick())[0].density, 11.18664),
}
"""Function of each arrangement, and the sum of all its numbers, each times a weight of its place."""


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_arrangements(name: str, variant_rgb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Scenes are not built, and pictures of them are not rendered; dictionaries hold their numbers."""
    monkeypatch.setattr(mi, "load_dict", lambda scene: scene)
    monkeypatch.setattr(mi, "render", lambda scene, **options: np.full((2, 2, 3), options["spp"] + options["seed"]))
    arrange, expected = ARRANGEMENTS[name]
    found = np.concatenate([np.ravel(numbers) for _, numbers in numbers_of(arrange(tmp_path))])
    # Float32 is rounded otherwise by another processor.
    assert found @ np.cos(np.arange(found.size)) == pytest.approx(expected, abs=1e-6 * np.abs(found).sum())
