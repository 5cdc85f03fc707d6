"""What studies arrange before they measure, as when the published figures were made, and their answers of made-up times."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scene_numbers import numbers_of

from mivol.bench.harness.contests import Timing
from mivol.bench.scenes import StudyExtinction
from mivol.bench.studies import (
    cluster,
    cluster_kills,
    conversions,
    depth,
    everyday,
    gradients,
    media_light,
    multiple_scattering,
    optical_depth,
    points,
    representations,
    sparse,
    steps,
    viewer,
)
from mivol.bench.studies.gradients import tutorial
from mivol.bench.studies.radiance_field import contestants
from mivol.files import read_volume
from mivol.optim.gaussians import gaussian_plan
from mivol.optim.photographs import radiance_plan, sampled_problem
from mivol.optim.photographs.octree_problem import LeafPlan
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


def arrange_plans(folder: Path) -> list:
    """The presets that fits begin with."""
    presets = gaussian_plan.PRESETS, radiance_plan.PRESETS, *sampled_problem.PRESETS.values()
    plans = [LeafPlan(100), *(plan for named in presets for plan in named.values())]
    return [{name: each for name, each in asdict(plan).items() if not isinstance(each, type)} for plan in plans]


def arrange_tiny_fits(folder: Path) -> list:
    photos = [[photo.image, photo.alpha, photo.camera.to_world] for photo in steps._photograph_cloud()]
    return [steps._draw_places(9, 1), photos]


def arrange_everyday(folder: Path) -> list:
    """All but the smoke, which is a ramp here."""
    with patch.object(everyday, "_puffs", lambda res: np.linspace(0, 1, 24, dtype=np.float32).reshape(2, 3, 4)):
        return [scene.load(2) for scene in everyday.SCENES.values()]


def arrange_derivatives(folder: Path) -> list:
    """Of one scattering and of many, where light is trapped and where it leaves."""
    lights = [light for _, named in gradients.CONTESTS.values() for light in named.values()]
    kinds = [replace(lights[0], depth=depth) for depth in (-1, 4)]
    trapping = [light for light in lights if light.traps_light]
    deep = [gradients.make_deep_cases(4, light) for light in (*kinds, *(replace(x, depth=-1) for x in trapping[:1]))]
    return [asdict(case) for cases in (gradients.make_cases(4), *deep) for case in cases.values()]


def arrange_volumes(folder: Path) -> list:
    """Of those without public data, for which another volume stands in on a machine without them."""
    volumes = [make().values for make in (multiple_scattering.white_box, multiple_scattering.milk)]
    return [np.ravel(values)[:: max(1, np.size(values) // 999)] for values in volumes]


ARRANGEMENTS: dict[str, tuple[Callable[[Path], object], float]] = {
    "clouds of Gaussians": (arrange_clouds, -36.0922162),
    "sparse fit": (arrange_sparse_fit, 48.3591594),
    "photographs of kills": (arrange_photographs_of_kills, 19.5740119),
    "workloads": (arrange_workloads, 16.9040942),
    "subjects of the viewer": (arrange_subjects, 116.971472),
    "settings": (arrange_settings, -3.4204918),
    "plans of fits": (arrange_plans, -85.9905014),
    "tiny fits": (arrange_tiny_fits, -59.4630654),
    "everyday scenes": (arrange_everyday, -79.0907063),
    "cases of derivatives": (arrange_derivatives, 3.40218109),
    "volumes of many scatterings": (arrange_volumes, -0.562458898),
    "cubes": (lambda folder: [depth.make_cube(*kind, 0.5, 2.0) for kind in depth.TABLES], -29.4280929),
    "media that emit": (lambda folder: [media_light.make_scene(name, 8) for name in ("fire", "fog", "room")], 166.266753),
    "tutorial": (lambda folder: tutorial.tutorial_scene(mi.TensorXf(np.ones((2, 2, 2, 1)))), 32.1874398),
    "fog": (lambda folder: contestants.make_fog(contestants.FieldSize.quick())[0].density, 14.2311516),
}
"""Function of each arrangement, and the sum of all its numbers, each times a weight of its place."""


def add_up(answer: object) -> tuple[float, float]:
    """The sum of all numbers, each times a weight of its place, and how far another processor, which rounds float32 in other
    ways, may be from it. On a scale of logarithms, so that rates do not hide ratios."""
    found = np.concatenate([np.ravel(numbers) for _, numbers in numbers_of(answer)])
    found = np.arcsinh(100 * np.nan_to_num(found, posinf=1e6))
    return float(found @ np.cos(np.arange(found.size))), 1e-6 * float(np.abs(found).sum())


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_arrangements(name: str, variant_rgb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Scenes are not built, and pictures of them are not rendered; dictionaries hold their numbers."""
    monkeypatch.setattr(mi, "load_dict", lambda scene: scene)
    monkeypatch.setattr(mi, "render", lambda scene, **options: np.full((2, 2, 3), options["spp"] + options["seed"]))
    arrange, expected = ARRANGEMENTS[name]
    total, tolerance = add_up(arrange(tmp_path))
    assert total == pytest.approx(expected, abs=tolerance)


WALK, CLOUD = optical_depth.OpticalDepthSize.quick(), points.PointsSize("quick", clouds=((40, 8),), peer=(30, 8), walk_side=16)
SMOKE = StudyExtinction(np.linspace(0, 2, 60, dtype=np.float32).reshape(3, 4, 5), "made up")

MEASURED: dict[str, tuple[Callable[[], object], float]] = {
    "clouds": (lambda: points.measure_clouds(CLOUD), 18.8076134),
    "peer of clouds": (lambda: points.measure_peer(CLOUD), -7.02326162),
    "rays through clouds": (lambda: points.measure_rays(CLOUD), -7.45853598),
    "walk": (lambda: optical_depth.measure_walk(WALK), 45.4695887),
    "reverse": (lambda: optical_depth.measure_reverse(WALK), 65.2800749),
    "image": (lambda: optical_depth.measure_image(WALK), -10.5387001),
    "peers of walks": (lambda: optical_depth.measure_peers(WALK), 2.18059234),
}
"""Function of each answer, and the sum of all its numbers, each times a weight of its place."""


@pytest.mark.parametrize("name", MEASURED)
def test_answers_of_made_up_times(name: str, variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three rounds of each contestant, of which none is called; their results are ramps."""

    def race(contestants: dict, rounds: int, keep: bool = False) -> dict[str, Timing]:
        ramp = np.linspace(0.1, 0.9, 64 * 64 * 4).reshape(64, 64, 4)
        results = [np.ravel(ramp)[: 64 * 64] * k if name == "peers of walks" else ramp * k for k in (1, 3, 4)]
        return {
            key: Timing(
                {"seconds": 0.5 * k}, [k + 1.0, k + 2.0, k * k + 4.0], [2.0 * k, k + 3.0, 7.0], [k * r for r in results]
            )
            for k, key in enumerate(contestants, 1)
        }

    load_dict, unbuilt = mi.load_dict, ("scene", "mivol", "volpath")
    monkeypatch.setattr(mi, "load_dict", lambda parts: SimpleNamespace() if parts["type"] in unbuilt else load_dict(parts))
    for study in (optical_depth, points):
        monkeypatch.setattr(study, "race", race)
    monkeypatch.setattr(mi, "traverse", lambda scene: SimpleNamespace(properties={}))
    monkeypatch.setattr(points, "reference_walk", lambda side: None)
    monkeypatch.setattr(optical_depth, "ParameterGradient", lambda *given: None)
    monkeypatch.setattr(optical_depth, "smoke", lambda: SMOKE)
    monkeypatch.setattr(optical_depth, "ct_scan", lambda res: SMOKE)
    answer, expected = MEASURED[name]
    total, tolerance = add_up(answer())
    assert total == pytest.approx(expected, abs=tolerance)


def test_workers_of_a_study_have_a_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder of their own, which is gone afterwards."""
    monkeypatch.setattr(cluster, "choose_back_end", lambda variant, threads: None)
    monkeypatch.setattr(cluster, "open_pool", lambda address, **options: nullcontext((address, options["threads"])))
    with cluster.two_workers() as (pool, folder):
        assert pool == ("local:2", 1) and (folder / "scene.xml").is_file()
    assert not folder.exists()


def test_kills_are_told_in_a_line() -> None:
    answer = {"ended": 4, "missing": 1, "equal": 3, "largest_difference": 2e-8, "repeated": 7}
    (line,) = cluster_kills.table("render", answer)
    found = "render: 4 of 5 runs with a killed worker ended, 3 equal to the bit, largest difference 2e-08, 7 pieces of"
    assert line.startswith(found)


def test_the_cost_of_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock by which a round takes 1 ms and 2 ns a byte, and the first three rounds of a size 1 ms more."""
    clock, sent = [0.0], []

    def run(units: list, ahead: int) -> list:
        sizes = {unit.args[0].nbytes for unit in units}
        sent.extend(sizes)
        clock[0] += 1e-3 + 1e-3 * (sent.count(sent[-1]) <= 3) + 2e-9 * sum(sizes)
        return [cluster.echo(None, unit.args[0]) for unit in units]

    monkeypatch.setattr(cluster, "two_workers", lambda: nullcontext((SimpleNamespace(run=run), Path())))
    monkeypatch.setattr(cluster.time, "perf_counter", lambda: clock[0])
    answer = cluster.measure_messages(replace(cluster.ClusterSize.quick(), rounds=2))
    sizes = [4 << 10, 4 << 18, 4 << 20]
    assert sent == [size for size in sizes for _ in range(12)]
    assert answer["seconds"] == {
        size: {k: pytest.approx(1e-3 + 2e-9 * size) for k in ("median", "fastest")} for size in sizes
    }
    assert answer["latency"] == pytest.approx((1e-3 + 2e-9 * sizes[0]) / 2)
    assert answer["bandwidth"] == pytest.approx(2 * sizes[2] / (1e-9 * (sizes[2] - sizes[0])))


def test_a_smoke_is_fitted_for_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of 0.3 s after one that compiles; views of two are held out, whose renders are half as bright."""
    views = [representations.View(str(k), f"sensor {k}", np.full((2, 2, 3), 0.5)) for k in range(4)]
    begun = SimpleNamespace(next_iteration=0)
    seen: dict = {}

    class Stopwatch:
        processor = 0.0

        def __enter__(self) -> None: ...

        def __exit__(self, *error: object) -> None:
            self.processor += 0.3

    def make_problem(scene: dict, train: list, parameters: list, integrator: object, spp: int) -> SimpleNamespace:
        seen.update(scene=scene, train=[view.name for view in train], rates={p.name: p.lr for p in parameters}, spp=spp)
        arrays = {"a": mi.Float(1, 2, 3), "b": mi.Float(4)}
        return SimpleNamespace(values=lambda: {name: SimpleNamespace(array=array) for name, array in arrays.items()})

    def begin(problem: object, optimizer: object, steps: int) -> SimpleNamespace:
        seen.update(epsilon=optimizer.epsilon, steps=steps)
        return begun

    def advance() -> None:
        begun.next_iteration += 1

    def render(scene: dict, sensor: str, **options: object) -> np.ndarray:
        seen.setdefault("judged", []).append((sensor, options["spp"]))
        return np.full((2, 2, 3), 0.25 if sensor == "sensor 1" else 0.5)

    begun.advance = advance
    monkeypatch.setattr(mi, "load_dict", lambda parts: parts)
    monkeypatch.setattr(mi, "render", render)
    for name, made in {"Stopwatch": Stopwatch, "SceneProblem": make_problem, "begin_fit": begin, "SMOKE_JUDGED": (1,)}.items():
        monkeypatch.setattr(representations, name, made)
    monkeypatch.setattr(representations, "make_integrator", lambda name, depth: (name, depth))
    size = replace(representations.RepresentationSize.quick(), smoke_seconds=1.0)
    fit = representations.SmokeFit({"type": "given"}, {"data": 0.5}, (0, 1), 1e-3)
    answer = representations.fit_smoke(fit, views, {}, 0.9, size)
    interior = seen["scene"]["box"]["interior"]
    assert (interior["type"], interior["sigma_t"]) == ("mivol_medium", {"type": "given"})
    assert seen["train"] == ["0", "2", "3"] and list(seen["rates"].values()) == [0.5]
    assert (seen["epsilon"], seen["spp"], seen["judged"]) == (1e-3, size.smoke_spp, [("sensor 1", size.smoke_reference)])
    half, quarter = (1.055 * x ** (1 / 2.4) - 0.055 for x in (0.5, 0.25))
    assert answer == {"psnr": pytest.approx(-20 * np.log10(half - quarter), rel=1e-5), "steps": 5, "numbers": 4}
