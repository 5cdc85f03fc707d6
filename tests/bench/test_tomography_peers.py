"""Slices by several programs: all get the same object in the same orientation."""

from __future__ import annotations

import importlib.util
import itertools
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from mivol.bench.studies.tomography import peers, slices
from mivol.bench.studies.tomography.slices import Slice, make_slice
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.optim.projections.solvers import ALL_SOLVERS
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import random_ellipsoids, shepp_logan
from mivol.tomography.projector import Projector


def curve(errors: list[float], seconds: list[float]) -> peers.Curve:
    """A curve of a method."""
    return {"errors": errors, "seconds": seconds}


@pytest.mark.slow
@pytest.mark.parametrize("who", ["mivol", *peers.PEERS])
def test_everyone_finds_the_object(variant_rgb: str, monkeypatch: pytest.MonkeyPatch, who: str) -> None:
    """Each method's least error is below 0.75, where an empty slice has 1 and one that is upside down, or mirrored, more."""
    module, run = peers.PEERS.get(who, ("numpy", peers.run_solvers))
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{who} is not installed")
    monkeypatch.setattr(peers, "STEPS", dict.fromkeys(peers.STEPS, 12))
    # Ellipsoids that lie anywhere: a head is nearly its own mirror image.
    monkeypatch.setattr(slices, "shepp_logan", lambda table, half: random_ellipsoids(5, seed=8).scaled(0.8 * half))
    scan = make_slice(33, 40, 0.0)
    for turned in (scan.truth[:, ::-1], scan.truth[:, :, ::-1], scan.truth.transpose(0, 2, 1)):
        assert scan.error(turned) > 0.75
    assert scan.error(0 * scan.truth) == pytest.approx(1)
    result = run(scan)
    for curve in result.values():
        assert min(curve["errors"]) < 0.75
        assert np.all(np.diff(curve["seconds"]) >= 0)


def test_the_table_has_the_least_error_of_each() -> None:
    result = {"few": {"a": curve([0.5, 0.25, 0.3], [1.0, 2.0, 3.0])}, "many": {"a": curve([0.1], [0.5])}}
    assert peers.error_rows(result)[2] == "| a | 0.2500 (2, 2.00 s) | 0.1000 (1, 0.50 s) |"
    result["many"]["b"] = curve([0.2], [3.0])
    assert peers.error_rows(result)[3] == "| b |  | 0.2000 (1, 3.00 s) |"


def test_times_are_compared_at_the_error_that_both_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ours has 0.2 after 2 s, theirs in the end after 4; and ours ends at 0.4, which theirs has after 1 s."""
    monkeypatch.setattr(peers, "PAIRS", (("a", "b"), ("a", "who is missing")))
    mivol = {"few": curve([0.5, 0.2, 0.1], [1.0, 2.0, 3.0]), "many": curve([0.5, 0.4], [1.0, 2.0])}
    peer = {"few": curve([0.3, 0.2], [1.0, 4.0]), "many": curve([0.4, 0.3], [1.0, 4.0])}
    result = {kind: {"a": mivol[kind], "b": peer[kind]} for kind in mivol}
    assert peers.ratio_rows(result)[2:] == ["| a / b | 0.50 (0.2000) | 2.00 (0.4000) |"]


def test_times_are_medians_of_runs() -> None:
    runs = [{"a": curve([0.5, 0.2], seconds)} for seconds in ([1.0, 9.0], [3.0, 5.0], [2.0, 7.0])]
    assert peers.median_times(runs) == {"a": curve([0.5, 0.2], [2.0, 7.0])}


@pytest.mark.slow
@pytest.mark.parametrize("photons", [0.0, 1e3])
def test_the_default_of_a_slice_is_that_of_a_file(variant_rgb: str, photons: float) -> None:
    """Twelve iterations of it have a lower error than as many of pcg from nothing, with noise and without, and keep the voxels;
    counts have a likelihood besides."""
    scan = make_slice(33, 40, photons)
    last = dict(zip(range(12), peers.default_states(scan), strict=False))[11]
    assert last.shape == scan.truth.shape
    problem = LeastSquares(Projector(scan.beam, scan.grid), scan.y, scan.weights, nonnegative=True)
    plain = dict(zip(range(12), ALL_SOLVERS["pcg"].run(problem), strict=False))[11]
    assert scan.error(last) < scan.error(plain.x)
    if photons:
        assert scan.error(next(peers.likelihood_states(scan))) < 1


@pytest.mark.parametrize("photons", [0.0, 50.0])
def test_a_slice_and_its_projections(variant_rgb: str, photons: float) -> None:
    """Chords of the head at 4 / n, so that 1 across the grid has an optical depth of 4; quanta from the seed 0 where the kind
    of data has noise, their numbers for weights."""
    scan = make_slice(9, 5, photons)
    assert (scan.beam.shape, scan.grid.shape, scan.truth.shape) == ((5, 1, 13), (1, 9, 9), (1, 9, 9))
    assert scan.beam.angles == pytest.approx(np.arange(5) * np.pi / 5)
    head = shepp_logan("toft-schabel", 4.5)
    exact = 4 / 9 * head.project(ParallelBeam(np.arange(5) * np.pi / 5, (1, 13)))
    thin = VoxelGrid((1, 9, 9), (1.0, 1.0, 1e-6))
    assert np.array_equal(scan.truth, 4 / 9 * head.voxelise(thin, 4))
    if photons == 0:
        assert np.array_equal(scan.y, exact) and np.array_equal(scan.weights, np.ones_like(exact))
        return
    counts = np.maximum(np.random.default_rng(0).poisson(50 * np.exp(-exact)), 1)
    assert np.array_equal(scan.y, -np.log(counts / 50)) and np.array_equal(scan.weights, counts) and scan.photons == 50


def test_errors_count_inside_the_disc(variant_rgb: str) -> None:
    """Corners, and what touches the rim, do not count: the disc reaches from the middle to the last column, without it."""
    truth = np.ones((1, 5, 5))
    scan = Slice(None, VoxelGrid((1, 5, 5)), None, None, truth)
    inside = np.array([[0, 0, 0, 0, 0], [0, 1, 1, 1, 0], [0, 1, 1, 1, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 0]], bool)
    assert scan.error(np.where(inside, 1.0, 7.0)) == 0
    assert scan.error(np.where(inside, 0.0, 1.0).ravel()) == 1


def test_steps_are_timed_and_judging_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step takes twice as long as the one before; judging takes 100 s; one that ends early has a short curve."""
    now = [0.0]
    monkeypatch.setattr(peers.time, "process_time", lambda: now[0])

    def passes(seconds: float, value: float) -> float:
        now[0] += seconds
        return value

    scan = type("Scan", (), {"error": lambda self, x: passes(100.0, x / 2)})()
    states = (passes(2.0**k, float(k)) for k in range(3))
    assert peers.time_states(scan, states, 2) == curve([0.0, 0.5], [1.0, 3.0])
    assert peers.time_states(scan, iter([]), 2) == curve([], [])


def sliced(views: int = 3) -> Slice:
    """A slice of 5 x 5 voxels seen by 9 pixels, its projections numbered."""
    beam = ParallelBeam(np.arange(views) * np.pi / views, (1, 9))
    return Slice(beam, VoxelGrid((1, 5, 5)), np.arange(9.0 * views).reshape(views, 1, 9), None, np.ones((1, 5, 5)))


def test_scikit_image_is_asked_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of its images run against y, and its images are as wide as the detector: what is judged is the middle, turned."""
    scan, calls = sliced(), []
    sinogram, theta = scan.y[:, 0].T, [0.0, 60.0, 120.0]
    image = np.arange(81.0).reshape(9, 9)

    def iradon(given: np.ndarray, angles: np.ndarray, output_size: int) -> np.ndarray:
        calls.append((given.tolist(), angles.round(9).tolist(), output_size))
        return np.arange(25.0).reshape(5, 5)

    def iradon_sart(given: np.ndarray, angles: np.ndarray, image: np.ndarray | None) -> np.ndarray:
        calls.append((given.tolist(), angles.round(9).tolist(), None if image is None else image[0, 0]))
        return np.arange(81.0).reshape(9, 9) + (0 if image is None else image[0, 0] + 100)

    transform = SimpleNamespace(iradon=iradon, iradon_sart=iradon_sart)
    monkeypatch.setitem(sys.modules, "skimage", SimpleNamespace(transform=transform))
    monkeypatch.setitem(sys.modules, "skimage.transform", transform)
    monkeypatch.setattr(
        peers, "time_states", lambda scan, states, steps: (list(itertools.islice(states, min(steps, 2))), steps)
    )
    result = peers.run_scikit_image(scan)
    (filtered, one), (swept, six) = result["scikit-image iradon"], result["scikit-image iradon_sart"]
    assert (one, six, len(filtered), len(swept)) == (1, 6, 1, 2)
    assert np.array_equal(filtered[0], np.arange(25.0).reshape(5, 5)[::-1])
    assert np.array_equal(swept[0], image[::-1][2:7, 2:7]) and np.array_equal(swept[1], image[::-1][2:7, 2:7] + 100)
    assert calls == [(sinogram.tolist(), theta, last) for last in (5, None, 0.0)]


def test_astra_is_asked_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """SART's iterations are views, and a sweep is all of them; what is below 0 is cut off where ours is; rows run against y."""
    scan, ran, created = sliced(), [], []
    geometry = ("parallel", 1.0, 9, scan.beam.angles.tolist())
    image = np.arange(25.0).reshape(5, 5)

    def project(kind: str, pitch: float, columns: int, angles: np.ndarray) -> tuple:
        return kind, pitch, columns, angles.tolist()

    astra = SimpleNamespace(
        create_vol_geom=lambda rows, columns: ("volume", rows, columns),
        create_proj_geom=project,
        create_projector=lambda kind, beam, volume: ("projector", kind, beam, volume),
        data2d=SimpleNamespace(
            create=lambda kind, place, data: ("data", kind, place, np.asarray(data).tolist()), get=lambda target: image
        ),
        astra_dict=lambda name: {"type": name},
        algorithm=SimpleNamespace(
            create=lambda settings: created.append(settings) or len(created), run=lambda *asked: ran.append(asked)
        ),
    )
    monkeypatch.setitem(sys.modules, "astra", astra)
    monkeypatch.setattr(peers, "time_states", lambda scan, states, steps: (next(states).tolist(), steps))
    result = peers.run_astra(scan)
    steps = {"FBP": 1, "CGLS": 20, "SIRT": 60, "SART": 6}
    assert result == {f"astra {name}": (image[::-1].tolist(), n) for name, n in steps.items()}
    volume = ("volume", 5, 5)
    common = {
        "ProjectorId": ("projector", "linear", geometry, volume),
        "ProjectionDataId": ("data", "-sino", geometry, scan.y[:, 0].tolist()),
        "ReconstructionDataId": ("data", "-vol", volume, 0.0),
    }
    bounded = {"option": {"MinConstraint": 0.0}}
    assert created == [{"type": name} | common | (bounded if name in ("SIRT", "SART") else {}) for name in steps]
    assert ran == [(1, 1), (2, 1), (3, 1), (4, 3)]


@pytest.mark.slow
def test_rows_of_parts_differ(variant_rgb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a slice of 33^2 with noise: no row equals another, and the last but one is the default."""
    monkeypatch.setattr(peers, "PART_KINDS", {"noisy": (20, 1e3)})
    answer = peers.measure_parts(None, 33)
    assert list(answer["noisy"]) == list(peers.PARTS) and len(set(answer["noisy"].values())) == len(peers.PARTS)
    scan = make_slice(33, 20, 1e3)
    *_, last = itertools.islice(peers.default_states(scan), 20)
    # Float32 sums in another order.
    assert answer["noisy"]["from fbp, twice as fine, tv = 1"] == pytest.approx(scan.error(last), rel=1e-3)
    assert peers.part_rows({"few": {"a": 0.25, "b": 0.5}, "many": {"a": 0.125, "b": 1.0}})[2:] == [
        "| a | 0.250 | 0.125 |", "| b | 0.500 | 1.000 |",
    ]  # fmt: skip


@pytest.mark.slow
def test_packages_that_are_missing_are_named(
    variant_rgb: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """A tiny slice by all methods of mivol, and by those packages that are installed."""
    monkeypatch.setattr(peers, "KINDS", {"noisy": (20, 1e3)})
    monkeypatch.setattr(peers, "STEPS", dict.fromkeys(peers.STEPS, 1))
    monkeypatch.setattr(
        peers, "PEERS", {"there": ("json", lambda scan: {"theirs": curve([0.5], [1.0])}), "gone": ("no_module", None)}
    )
    (curves,) = peers.measure_peers(None, 9).values()
    assert {"mivol fbp", "mivol pcg from fbp", "mivol default", "mivol ml-tr from fbp", "theirs"} <= set(curves)
    assert "gone is not installed: left out" in capsys.readouterr().err
