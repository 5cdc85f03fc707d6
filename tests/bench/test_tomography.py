"""Slices by several programs: every method nears the truth in the same orientation, and measured slices are centred."""

from __future__ import annotations

import importlib.util
import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from mivol.bench.studies import tomography as study
from mivol.bench.studies.tomography import peers
from mivol.bench.studies.tomography.peers import MeasuredSlice, Slice, centre_axis, load_tooth, make_slice
from mivol.files import write_volume
from mivol.optim.projections.inversion import ALL_SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.tomography.filtered import filtered_backprojection
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import random_ellipsoids, shepp_logan
from mivol.tomography.projector import Projector


@pytest.fixture(scope="module")
def head(request: pytest.FixtureRequest) -> study.Scan:
    """Shepp and Logan's head of 16^3 voxels from 24 views."""
    mi.set_variant(request.config.getoption("--variant"))
    return study.make_head_scan("yu-ye-wang", 16, 24)


@pytest.mark.slow
def test_every_method_nears_the_truth(variant_rgb: str, head: study.Scan) -> None:
    """The error of each falls below that of 0, which is 1, within four iterations, and its volume has that error."""
    answer = study.reconstruct(head, 4)
    curves, volumes = answer["curves"], answer["volumes"]
    assert set(curves) == set(volumes) == set(study.solver_problems(head.a, head.y))
    for label, curve in curves.items():
        assert len(curve["nrmse"]) == len(curve["seconds"]) == 4
        assert curve["nrmse"][-1] < 0.9
        error = np.linalg.norm(volumes[label] - head.truth) / np.linalg.norm(head.truth)
        assert error == pytest.approx(curve["nrmse"][-1], rel=1e-6)
    table = answer["nrmse"]
    assert set(table["CG"]) == {"seconds_per_iteration"}
    assert study.tabulate({"x": {"nrmse": [0.5] * 12, "seconds": [24.0] * 12}}) == {
        "x": {"5": 0.5, "10": 0.5, "seconds_per_iteration": 2.0}
    }


def test_the_pair_is_adjoint(head: study.Scan) -> None:
    """Sums of float32 products: |Ax| |y| times a few 2^-24; a transpose of something else is off by much of it."""
    rng = np.random.default_rng(3)
    x, y = (rng.uniform(size=n).astype(np.float32) for n in head.a.shape[::-1])
    assert study.adjoint_mismatch(head.a, x, y) < 1e-6
    halved = type("Halved", (SimpleNamespace,), {"__matmul__": lambda self, v: (head.a @ v) / 2})(T=head.a.T)
    assert study.adjoint_mismatch(halved, x, y) > 0.1


def test_costs(head: study.Scan) -> None:
    result = study.measure_costs(head)
    assert set(result) == {
        *("seconds_A", "seconds_AT", "rays_per_second_A", "AT_over_A", "adjoint_mismatch", "voxels_own_error")
    }
    assert result["rays_per_second_A"] == pytest.approx(24 * 16 * 16 / result["seconds_A"])
    assert 0 < result["voxels_own_error"] < 0.3


def test_a_volume_is_projected_at_twice_the_resolution(variant_rgb: str, tmp_path: Path) -> None:
    """The truth is the mean of 2 x 2 x 2 voxels of the file, over its largest value; the detector sees all of it."""
    values = np.random.default_rng(0).uniform(0, 4, (6, 9, 8)).astype(np.float32)
    write_volume(tmp_path / "a.nrrd", values, np.diag([8.0, 9.0, 6.0, 1.0]))
    scan = study.make_volume_scan(tmp_path / "a.nrrd", 5)
    assert (scan.name, scan.truth.shape) == ("a.nrrd", (3, 4, 4))
    assert scan.truth[1, 2, 3] == pytest.approx(values[2:4, 4:6, 6:8].mean() / values.max(), rel=1e-6)
    assert scan.y.size == scan.a.shape[0]
    assert scan.y.max() > 1


def test_the_scan_of_the_head(head: study.Scan) -> None:
    """The phantom in a cube of half width 128, projected by chords, averaged over 4^3 points a voxel."""
    phantom = shepp_logan("yu-ye-wang", 128.0)
    assert head.name == "Shepp-Logan (yu-ye-wang)"
    assert np.array_equal(np.ravel(head.y), np.ravel(phantom.project(head.a.geometry)))
    assert np.array_equal(head.truth, phantom.voxelise(head.a.grid, 4))


def test_the_detector_holds_a_measured_volume(variant_rgb: str, tmp_path: Path) -> None:
    """Voxels of 1 x 2 x 3 of a file of 9 x 8 x 6: odd ends are left out, the grid has twice the spacing. Seen from twice the
    radius, magnified by 3/2, with 1/5 to spare, in pixels that are 3/2 of the least spacing at the object's magnification."""
    values = np.random.default_rng(0).uniform(0, 4, (6, 9, 8)).astype(np.float32)
    write_volume(tmp_path / "a.nrrd", values, np.diag([8.0, 18.0, 18.0, 1.0]))
    scan = study.make_volume_scan(tmp_path / "a.nrrd", 5)
    grid, beam = scan.a.grid, scan.a.geometry
    assert (grid.shape, grid.voxel_size) == ((3, 4, 4), (2, 4, 6))
    radius = np.linalg.norm([8.0, 16.0, 18.0]) / 2
    assert grid.radius == pytest.approx(radius)
    assert (beam.source_to_axis, beam.source_to_detector) == pytest.approx((4 * radius, 6 * radius))
    assert beam.angles == pytest.approx(np.arange(5) * 2 * np.pi / 5)
    assert beam.shape[1:] == (int(np.ceil(1.8 * 18 / 3)), int(np.ceil(1.8 * np.hypot(8, 16) / 3)))
    assert beam.pitch == (3, 3)
    fine = Projector(beam, VoxelGrid((6, 8, 8), (1.0, 2.0, 3.0))) @ (values[:, :8] / values.max())
    assert np.array_equal(scan.y, fine)


def test_the_result_of_the_solvers(
    variant_rgb: str, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A head of 8^3 from 20 views and a volume, for one iteration of one method: JSON and both figures."""
    every = study.solver_problems
    monkeypatch.setattr(study, "solver_problems", lambda a, y: dict(list(every(a, y).items())[:1]))
    write_volume(tmp_path / "a.nrrd", np.ones((4, 4, 4), np.float32), np.diag([4.0, 4.0, 4.0, 1.0]))
    work = ["--size", "8", "--views", "20", "--iterations", "1", "--variant", variant_rgb, "--out", str(tmp_path)]
    assert study.STUDY.run([*work, "--volume", str(tmp_path / "a.nrrd")]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads((tmp_path / "bench_tomography.json").read_text())
    solvers = result["solvers"]
    assert (solvers["grid"], solvers["projections"]) == ([8, 8, 8], [20, 8, 8])
    assert set(solvers["curves"]) == set(solvers["nrmse"]) == set(solvers["volume"]["nrmse"]) == {"CG"}
    assert (solvers["object"], solvers["volume"]["object"]) == ("Shepp-Logan (yu-ye-wang)", "a.nrrd")
    for name in ("bench_tomography.png", "volume.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert study.STUDY.run([*work, "--volume", str(tmp_path / "absent.nrrd")]) == 1
    assert "absent.nrrd" in capsys.readouterr().err


def test_tables_of_slices() -> None:
    """Least errors and ratios of times for slices."""
    curves = {"few": {"mivol fbp": {"errors": [0.5], "seconds": [1.0]}, "astra FBP": {"errors": [0.5], "seconds": [2.0]}}}
    assert study.table("peers", curves)[2:] == [
        "| mivol fbp | 0.5000 (1, 1.00 s) |", "| astra FBP | 0.5000 (1, 2.00 s) |", "",
        "| time at equal error | few |", "|---|---|", "| mivol fbp / astra FBP | 0.50 (0.5000) |",
    ]  # fmt: skip
    assert study.table("solvers", {}) == []


def test_products_of_a_volume(variant_rgb: str, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The calls are the two products of each beam, and times become rays per second."""
    shapes = []

    def shortest_time(call: Callable[[], np.ndarray]) -> float:
        shapes.append(np.shape(call()))
        return 0.25 * len(shapes)

    monkeypatch.setattr(study, "shortest_time", shortest_time)
    monkeypatch.setattr(study.importlib.util, "find_spec", lambda name: None)
    answer = study.measure_volume(None, 8, 3)
    assert shapes == 2 * [(3, 8, 8), (8, 8, 8)]
    assert list(answer) == ["cone", "parallel"]
    assert answer["cone"]["seconds_A"] == 0.25 and answer["parallel"]["seconds_AT"] == 1.0
    assert answer["parallel"]["rays_per_core_second_A"] == 3 * 8 * 8 / 0.75
    assert 0.05 < answer["cone"]["peak_gib"] < 64
    assert "astra-toolbox is not installed" in capsys.readouterr().err


def test_readings_are_moved_to_the_middle() -> None:
    """A parabola about column 3.3 of 11: cubic interpolation finds it about the middle one of 7, but where it meets the end of
    the readings, whose mirrors it takes for their continuation."""
    column = 3.3
    values = np.tile((np.arange(41.0) - 15 - column) ** 2, (2, 3, 1))
    result = centre_axis(values, 15 + column, 3)
    assert result.shape == (2, 3, 2 * 18 + 1)
    # What the ends do falls by the root of 3 less 2, 0.27, a column: 400 units of slope are 1e-8 after 20 columns.
    np.testing.assert_allclose(result[0, 0, 16:21], (np.arange(5.0) - 2) ** 2, atol=1e-5)
    weights = centre_axis(np.arange(41.0)[None, None], 15 + column, 0)
    assert np.array_equal(weights[0, 0], np.arange(37.0))


def test_the_error_is_what_a_prediction_misses_over_the_noise(variant_rgb: str) -> None:
    """Two deviations in each pixel that counts; one without a weight does not."""
    grid = VoxelGrid((1, 5, 5))
    held_out = Projector(ParallelBeam(np.array([0.3, 1.1]), (1, 7)), grid)
    x = np.random.default_rng(0).uniform(size=(1, 5, 5)).astype(np.float32)
    certain = np.full((2, 1, 7), 16.0)
    certain[1, 0, 3] = 0
    image = held_out @ x + 2 / 4
    image[1, 0, 3] = 1e3
    scan = MeasuredSlice(None, grid, None, None, None, held_out=held_out, measured=image, certainty=certain)
    assert scan.error(x.ravel()) == pytest.approx(2, rel=1e-5)


@pytest.mark.slow
def test_the_load_tooth(variant_rgb: str, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every tenth view is kept back; none sees the object it was given mirrored, turned or moved."""
    monkeypatch.setenv("MIVOL_DATA", str(data_dir))
    scan = load_tooth()
    assert scan.y.shape[0] + scan.measured.shape[0] == 181 and scan.measured.shape[0] == 18
    assert scan.y.shape[2] % 2 == 1 and scan.grid.shape == (1, 381, 381)
    assert not set(scan.beam.angles) & set(scan.held_out.geometry.angles)
    result = filtered_backprojection(Projector(scan.beam, scan.grid), scan.y)
    error = scan.error(result)
    others = [scan.error(a) for a in (result[:, ::-1], result[:, :, ::-1], np.roll(result, 1, axis=2), 0 * result)]
    # By the scene's page conjugate gradients with a prior predict to 1.52 times the noise; the bare filter does not reach that.
    assert 1.52 < error < min(others)


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
    monkeypatch.setattr(peers, "shepp_logan", lambda table, half: random_ellipsoids(5, seed=8).scaled(0.8 * half))
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
