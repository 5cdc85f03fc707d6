"""The bench of splatting: what is scaled, what has a bar, and that the peer draws the same cloud."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bench_figures import drawn, kept
from readable_figures import assert_readable

from mivol.bench.harness.timing import Timing
from mivol.bench.studies import points


def test_rates_are_scaled_round_by_round() -> None:
    """A machine that walks 1 M rays in 0.08 s is half as fast as one of 25 M rays/s; rounds on which something else ran are
    slower for both, and the median is over the rounds."""
    ours = Timing({}, [0.02, 0.06, 0.02], [0.03, 0.03, 0.06])
    walk = Timing({}, [0.08, 0.24, 0.02], [0.12, 0.12, 0.12])
    found = points.scaled(ours, 40_000, walk, points.Size(walk_side=1000))
    assert found["pixels_per_second_scaled"] == pytest.approx(40_000 * 25 / 0.25)
    assert found["pixels_per_second_scaled_by_processor"] == pytest.approx(40_000 * 25 / 0.25)


def test_promises() -> None:
    names = [f"{name}, forward and backward" for name in points.RATES]
    answers = {
        "clouds": {name: {"pixels_per_second_scaled": 1.5e6} for name in names},
        "peer": {"mivol_is_faster": 39.0},
        "rays": {"cloud": "10,000 at 200^2", "mivol": {"pixels_per_second_scaled": 0.2e6}},
        "biker": {"seconds_median": 2.1},
        "chair": {"pixels": [200, 200], "seeds": {"0": {"psnr": 34.1}, "1": {"psnr": 33.9}}},
    }
    judged = [(bar["value"], bar["bar"], bar["met"]) for name, a in answers.items() for bar in points.compare(name, a)]
    assert judged == [
        (1.5, 1.7, False),
        (1.5, 1.3, True),
        (39, 40, False),
        (0.2, 0.14, True),
        (2.1, 2, False),
        (34.1, 34, True),
        (33.9, 34, False),
    ]
    assert points.compare("clouds", {}) == []


@pytest.mark.slow
def test_the_peer_draws_the_same_cloud(variant_rgb: str, tmp_path: Path) -> None:
    """Pictures differ by 0.03 RMS where order and place within the pixel are all that separates them (measured, 10,000
    Gaussians at 200^2), and by 0.07 where a pixel is as wide as a Gaussian; those of another cloud by 0.2."""
    answer = points.measure_peer(points.QUICK)
    ours, peers = answer["pictures"]
    assert answer["rms_difference"] == pytest.approx(np.sqrt(np.mean((ours - peers) ** 2)))
    assert answer["rms_difference"] < 0.1
    assert np.sqrt(np.mean((ours[:, ::-1] - peers) ** 2)) > 0.15
    points.draw({"peer": answer, "biker": points.measure_biker(points.QUICK)}, tmp_path)
    assert (tmp_path / "bench_points.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_peers_needles_point_where_ours_do(variant_rgb: str) -> None:
    """Twelve needles: the pictures differ by 0.015 RMS of 0.14, and by 0.115 where the parts of quaternions are mistaken."""
    cloud = points.dense_cloud(12, seed=3)
    cloud = dataclasses.replace(cloud, log_scales=np.log(np.full((12, 3), [0.2, 0.03, 0.03], np.float32)))
    camera = points.camera_before(np.zeros(3), 1.0, 64)
    ours = np.array(points.Drawing.of(cloud, camera).forward()(0))[..., :3]
    peers = np.array(mi.render(points.ellipsoids(cloud, camera), spp=4))
    assert np.sqrt(np.mean((ours - peers) ** 2)) < 0.03


def paces(*seconds: float, results: list[np.ndarray] | None = None) -> Timing:
    """A contestant that took so long, in each round, and twice as much of the processors."""
    return Timing({"seconds": 9.0}, list(seconds), [2 * s for s in seconds], results or [])


def test_a_dense_cloud_is_what_its_seed_says() -> None:
    """Eight Gaussians: a quarter of the mean distance 1/2 of places in a unit cube, times 1/2 to 3/2."""
    rng = np.random.default_rng(5)
    means, spread = rng.uniform(-0.5, 0.5, (8, 3)), rng.uniform(0.5, 1.5, (8, 3))
    found = points.dense_cloud(8, seed=5)
    assert np.array_equal(found.means, means.astype(np.float32))
    assert np.array_equal(found.log_scales, np.log(0.25 * 8 ** (-1 / 3) * spread).astype(np.float32))
    assert np.array_equal(found.quaternions, rng.normal(size=(8, 4)).astype(np.float32))
    assert np.array_equal(found.opacity_logits, rng.normal(size=8).astype(np.float32))
    assert np.array_equal(found.harmonics, (0.3 * rng.normal(size=(8, 9, 3))).astype(np.float32))
    assert np.array_equal(points.dense_cloud(8).means, points.dense_cloud(8, 0).means)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_the_camera_stands_before_the_cloud(up: float) -> None:
    """1.8 edges behind the middle along z, 1.6 widths of focal length, the middle of the picture at the middle of the cube."""
    camera = points.camera_before(np.array([1.0, 2.0, 3.0]), 10.0, 60, up)
    assert camera.to_world.tolist() == [[up, 0, 0, 1], [0, up, 0, 2], [0, 0, 1, 21], [0, 0, 0, 1]]
    assert camera.K.tolist() == [[96, 0, 30], [0, 96, 30], [0, 0, 1]] and camera.size == (60, 60)


class Asked:
    """In the place of :func:`mivol.bench.harness.timing.race`: remembers who runs, and returns made-up paces."""

    def __init__(self, *timings: dict[str, Timing]) -> None:
        self.timings, self.heard = list(timings), []

    def __call__(self, contestants: dict, rounds: int, keep: bool = False) -> dict[str, Timing]:
        self.heard.append((contestants, rounds, keep))
        found = self.timings.pop(0)
        assert list(found) == list(contestants)
        return found


@pytest.fixture
def drawings(monkeypatch: pytest.MonkeyPatch) -> list:
    """The clouds and cameras of the drawings that a question makes; none is drawn."""
    made = []

    def of(cloud: points.Gaussians, camera: points.Camera) -> SimpleNamespace:
        made.append((cloud, camera))
        return SimpleNamespace(forward=lambda: f"forward {len(made)}", both=lambda: f"both {len(made)}")

    monkeypatch.setattr(points, "Drawing", SimpleNamespace(of=of))
    return made


def test_clouds_are_drawn_in_turns_with_the_walk(monkeypatch: pytest.MonkeyPatch, drawings: list) -> None:
    """A walk of 10,000 rays in 0.5 ms is one of 20 M rays a second: rates are scaled by 5/4."""
    walk = SimpleNamespace(tau=lambda: "tau")
    monkeypatch.setattr(points, "smoke", lambda: SimpleNamespace(values="smoke"))
    monkeypatch.setattr(points, "camera_rays", lambda side: (f"rays {side}",))
    monkeypatch.setattr(points, "Work", lambda values, rays: walk if (values, rays) == ("smoke", "rays 100") else None)
    names = [
        "1,000 at 8^2, forward",
        "1,000 at 8^2, forward and backward",
        "20 at 4^2, forward",
        "20 at 4^2, forward and backward",
    ]
    seconds = dict(zip(names, (0.1, 0.4, 0.05, 0.2), strict=True))
    race = Asked({"walk": paces(5e-4, 5e-4)} | {name: paces(s, s) for name, s in seconds.items()})
    monkeypatch.setattr(points, "race", race)
    found = points.measure_clouds(points.Size(rounds=2, clouds=((1000, 8), (20, 4)), walk_side=100))
    ((contestants, rounds, keep),) = race.heard
    assert (rounds, keep) == (2, False)
    assert contestants == {"walk": "tau"} | dict(zip(names, ("forward 1", "both 1", "forward 2", "both 2"), strict=True))
    assert [(cloud.count, camera.size) for cloud, camera in drawings] == [(1000, (8, 8)), (20, (4, 4))]
    for (cloud, camera), edge in zip(drawings, (8, 4), strict=True):
        assert np.array_equal(cloud.means, points.dense_cloud(cloud.count).means)
        assert np.array_equal(camera.to_world, points.camera_before(np.zeros(3), 1.0, edge).to_world)
    assert found["walk"] == paces(5e-4, 5e-4).report(10_000, "rays")
    assert list(found) == ["walk", *names]
    for name, pixels in zip(names, (64, 64, 16, 16), strict=True):
        rate = pytest.approx(1.25 * pixels / seconds[name])
        scaled = {"pixels_per_second_scaled": rate, "pixels_per_second_scaled_by_processor": rate}
        assert found[name] == paces(seconds[name], seconds[name]).report(pixels, "pixels") | scaled


@pytest.mark.slow_for("2-3")
@pytest.mark.parametrize(("rounds", "times"), [(2, 3), (9, 4)])
def test_what_is_said_of_the_peer(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch, drawings: list, rounds: int, times: int
) -> None:
    """Both ways in half the rounds, three at least; pictures that differ by 1/2 in half of their numbers."""
    pictures = np.zeros((4, 4, 4)), np.ones((4, 4, 4))
    pictures[0][..., :2] = 2.0
    both = {"mivol": paces(1.0, 2.0, 1.0), "volprim_rf_basic": paces(30.0, 80.0, 40.0)}
    both["volprim_rf_basic"].processor[1:] = [320.0, 160.0]
    forward = {"mivol": paces(0.5, results=[pictures[0]]), "volprim_rf_basic": paces(4.0, results=[pictures[1]])}
    race = Asked(both, forward)
    monkeypatch.setattr(points, "race", race)
    found = points.measure_peer(points.Size(rounds=rounds, peer=(30, 4)))
    (contestants, asked, keep), (_, others, kept) = race.heard
    assert (asked, keep, others, kept) == (times, False, 3, True) and contestants["mivol"] == "both 1"
    ((cloud, camera),) = drawings
    assert (cloud.count, camera.size) == (30, (4, 4)) and np.array_equal(cloud.means, points.dense_cloud(30).means)
    assert camera.to_world.tolist() == points.camera_before(np.zeros(3), 1.0, 4).to_world.tolist()
    assert np.array_equal(found.pop("pictures"), np.stack([p[..., :3] for p in pictures]))
    assert found == {
        "cloud": "30 at 4^2",
        "forward and backward": {name: t.report(16, "pixels") for name, t in both.items()},
        "forward": {name: t.report(16, "pixels") for name, t in forward.items()},
        "mivol_is_faster": 40.0,
        "mivol_is_faster_by_processor": 80.0,
        "mivol_is_faster_forward": 8.0,
        "rms_difference": 1.0,
        "mean_difference": pytest.approx(1 / 3),
        "mean": pytest.approx(4 / 3),
    }


def test_the_peer_is_told_the_same_cloud(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every number of its scene; its camera looks along +z with x to the left, ours along -z with x to the right."""
    monkeypatch.setattr(points.mi, "load_dict", lambda parts: parts)
    cloud, camera = points.dense_cloud(5, seed=2), points.camera_before(np.array([1.0, 2.0, 3.0]), 1.0, 16)
    parts = points.ellipsoids(cloud, camera)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    place = np.array(parts["sensor"].pop("to_world").matrix).tolist()
    assert place == pytest.approx(np.array([[-1, 0, 0, 1], [0, 1, 0, 2], [0, 0, -1, 4.8], [0, 0, 0, 1]]))
    fov = pytest.approx(np.degrees(2 * np.arctan(0.5 / 1.6)))
    assert parts["sensor"] == {"type": "perspective", "fov": fov, "film": film}
    assert parts["integrator"] == {"type": "volprim_rf_basic", "srgb_primitives": False}
    held = parts["cloud"]
    turns = cloud.quaternions.astype(np.float64)
    turns = (turns / np.linalg.norm(turns, axis=1)[:, None])[:, [1, 2, 3, 0]]
    assert np.array(held["quaternions"]) == pytest.approx(turns, rel=1e-5)
    assert np.array_equal(held["centers"], cloud.means)
    assert np.array(held["scales"]) == pytest.approx(np.exp(cloud.log_scales), rel=1e-6)
    assert np.array(held["opacities"]) == pytest.approx(1 / (1 + np.exp(-cloud.opacity_logits[:, None])), rel=1e-6)
    assert np.array_equal(held["sh_coeffs"], cloud.harmonics.reshape(5, 27))
    assert (parts["type"], held["type"]) == ("scene", "ellipsoids")


@pytest.mark.slow
def test_what_is_said_of_rays(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What both show, and the rate of what is hidden; a walk of 10,000 rays in 0.4 ms has the pace that is scaled to."""
    results = {"mivol": np.full((4, 4, 3), 0.25), "volprim_rf_basic": np.full((4, 4, 4), 0.5)}
    results |= {"walk": np.zeros(1), "extinction": np.zeros(1)}
    seconds = {"walk": 4e-4, "mivol": 0.5, "extinction": 0.25, "volprim_rf_basic": 2.0}
    timings = {name: paces(s, s, results=[results[name]]) for name, s in seconds.items()}
    timings["volprim_rf_basic"].processor[:] = [12.0, 12.0]
    race = Asked(timings)
    monkeypatch.setattr(points, "race", race)
    found = points.measure_rays(points.Size(rounds=2, peer=(30, 4), walk_side=100))
    ((contestants, rounds, keep),) = race.heard
    assert (rounds, keep) == (2, True)
    # The contestants draw the same cloud: colours and what is hidden, up to the order in which Gaussians add up.
    ours, hidden, peers = (np.array(contestants[name](0))[..., :3] for name in ("mivol", "extinction", "volprim_rf_basic"))
    assert ours.max() > 0.2
    assert 0.5 < (1 - hidden).max() < 1
    assert np.corrcoef(ours.ravel(), peers.ravel())[0, 1] > 0.9
    assert np.corrcoef(1 - hidden.mean(axis=2).ravel(), peers.mean(axis=2).ravel())[0, 1] > 0.7
    assert found == {
        "cloud": "30 at 4^2",
        "mivol": timings["mivol"].report(16, "pixels")
        | {
            "pixels_per_second_scaled": pytest.approx(32.0),
            "pixels_per_second_scaled_by_processor": pytest.approx(32.0),
        },
        "extinction": timings["extinction"].report(16, "pixels")
        | {
            "pixels_per_second_scaled": pytest.approx(64.0),
            "pixels_per_second_scaled_by_processor": pytest.approx(64.0),
        },
        "volprim_rf_basic": timings["volprim_rf_basic"].report(16, "pixels"),
        "mivol_is_faster": 4.0,
        "mivol_is_faster_by_processor": 12.0,
        "rms_difference": 0.25,
        "mean": 0.25,
    }


@pytest.mark.parametrize("name", ["full", "quick"])
def test_the_biker_fills_the_picture(monkeypatch: pytest.MonkeyPatch, drawings: list, tmp_path: Path, name: str) -> None:
    """The camera stands before all but the outermost two hundredths of it, along the largest of its edges, y downwards; a
    made-up cloud takes its place where the sizes are small. Percentiles of float32 are known to 1e-6."""
    biker, rng = points.dense_cloud(1000, seed=1), np.random.default_rng(3)
    biker = dataclasses.replace(biker, means=rng.uniform([0, 0, 0], [1, 4, 2], (1000, 3)).astype(np.float32))
    (tmp_path / "splats").mkdir()
    (tmp_path / "splats" / "biker.compressed.ply").touch()
    monkeypatch.setattr(points, "DATA", tmp_path)
    monkeypatch.setattr(points, "read_gaussians", {tmp_path / "splats" / "biker.compressed.ply": biker}.get)
    timing = paces(1.0, 3.0, results=[np.arange(64.0).reshape(4, 4, 4), np.zeros((4, 4, 4))])
    race = Asked({"forward": timing})
    monkeypatch.setattr(points, "race", race)
    found = points.measure_biker(points.Size(name, rounds=2, biker_side=4, substitute=600))
    assert race.heard == [({"forward": "forward 1"}, 2, True)]
    ((cloud, camera),) = drawings
    assert (found.pop("cloud"), cloud.count) == {"full": ("biker.compressed.ply", 1000), "quick": ("made up", 600)}[name]
    low, high = np.percentile(cloud.means, 2, axis=0), np.percentile(cloud.means, 98, axis=0)
    place = (low + high) / 2 + [0, 0, 1.8 * (high - low).max()]
    assert camera.size == (4, 4) and np.diag(camera.to_world).tolist() == [-1, -1, 1, 1]
    assert camera.to_world[:3, 3] == pytest.approx(place, abs=1e-6)
    assert np.array_equal(found.pop("pictures"), np.arange(64.0).reshape(1, 4, 4, 4)[..., :3])
    assert found == {"gaussians": cloud.count, **timing.report(16, "pixels")}


def test_figures_show_what_was_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three pictures of the peer's cloud and one of the biker, or those that there are; without any nothing is drawn."""
    ramp = np.linspace(-0.2, 1.2, 27).reshape(3, 3, 3)
    peer = {"pictures": np.stack([ramp, ramp[::-1]])}
    biker = {"cloud": "made up", "seconds_median": 1.234, "pictures": ramp[None]}
    figure = drawn(points, monkeypatch, {"peer": peer, "biker": biker}, Path())
    assert_readable(figure)
    alone = drawn(points, monkeypatch, {"biker": biker}, Path())
    assert [axes.get_title("left") for axes in alone.axes] == ["made up, 1.23 s"] and alone.get_figwidth() == 4
    found: list = []
    with kept(points, found, monkeypatch):
        points.draw({"clouds": {}}, Path())
    assert found == []


@pytest.mark.slow
def test_every_step_of_the_peer_derives_anew(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The derivatives of the sum of the picture's numbers, in each call those of this call alone (float32 sums, 1e-3)."""
    monkeypatch.setattr(points, "Drawing", SimpleNamespace(of=lambda *_: SimpleNamespace(forward=dict, both=dict)))
    caught = {}

    def raced(contestants: dict, rounds: int, keep: bool = False) -> dict[str, Timing]:
        caught.update(contestants)
        raise StopIteration

    monkeypatch.setattr(points, "race", raced)
    with pytest.raises(StopIteration):
        points.measure_peer(points.Size(peer=(30, 8)))
    step = caught["volprim_rf_basic"]
    once, again = ([np.array(g) for g in step(3)] for _ in range(2))
    scene = points.ellipsoids(points.dense_cloud(30), points.camera_before(np.zeros(3), 1.0, 8))
    params = mi.traverse(scene)
    keys = [key for key in params.properties if key.endswith((".data", ".opacities", ".sh_coeffs"))]
    for key in keys:
        dr.enable_grad(params[key])
    dr.backward(dr.sum(mi.render(scene, params, spp=1, seed=3), axis=None))
    for key, one, two in zip(keys, once, again, strict=True):
        wanted = np.array(dr.grad(params[key]))
        rounding = 1e-3 * float(np.abs(wanted).max())
        assert one == pytest.approx(wanted, abs=rounding)
        assert two == pytest.approx(wanted, abs=rounding)


def test_a_quick_fit_has_fewer_steps(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    said = lambda folder, asked, *seconds: {"effort": asked.effort, "folder": folder.name}  # noqa: E731
    monkeypatch.setattr(points, "fit_and_judge", said)
    assert points.measure_chair(points.QUICK) == {"effort": pytest.approx(1.2 * 0.02), "folder": "chair"}
