"""Slabs of a volume beyond memory: equal to the whole, resumable, bounded, and refused where rays cross them."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from refusals import assert_refused

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments import slab_scan
from mivol.experiments.projections import Projections
from mivol.experiments.slab_scan import SlabPlan, plan_slabs, reconstruct_slab, rows_of_slab
from mivol.files import read_volume, write_volume
from mivol.files.image_stack import read_stack, stack_shape
from mivol.optim.projections.disk_sweeps import DiskSweeps
from mivol.optim.projections.inversion import SOLVERS
from mivol.optim.projections.linear_problems import LeastSquares
from mivol.tomography.geometry import ConeBeam, ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector

SCAN = """title = "slabs"
threads = 1
slabs = { memory = 1.0 }
data = { source = "shepp_logan", scale = 2.0 }
"""
PARALLEL = 'scan = { beam = "parallel", views = 40, detector = [24, 24], pitch = 0.09 }\n'
CONE = """scan = { beam = "cone", views = 40, arc = 360, detector = [30, 24], pitch = 0.11, source_to_axis = 6, \
source_to_detector = 7 }
"""
ROWS = "grid = { shape = [24, 22, 22], voxel_size = 0.09 }\n"
BETWEEN = "grid = { shape = [19, 22, 22], voxel_size = [0.09, 0.09, 0.1], centre = [0, 0, 0.03] }\n"
CASES = {
    "layers are rows": PARALLEL + ROWS,
    "layers between rows": PARALLEL + BETWEEN,
    "cone": CONE + BETWEEN,
    "sirt": PARALLEL + ROWS + 'solve = { name = "sirt", iterations = 4 }\n',
    "quanta": PARALLEL + ROWS,
}


@pytest.mark.parametrize("name", CASES)
def test_slabs_equal_the_whole_to_rounding(variant_rgb: str, tmp_path: Path, name: str) -> None:
    """Float32 sums of 40 views in another order, and four iterations of sirt with sums over rays: 2e-5 of the largest value."""
    text = SCAN.replace("scale = 2.0", "scale = 2.0, photons = 1e4") if name == "quanta" else SCAN
    (tmp_path / "fit.toml").write_text(text + CASES[name])
    plan = plan_slabs(config.load(tmp_path / "fit.toml", []), tmp_path)
    n = plan.grid.shape[0]
    assert plan.layers == (slice(0, n),) and plan.overlap == 0
    whole = reconstruct_slab(plan, slice(0, n))
    parts = [reconstruct_slab(plan, slice(a, min(a + 7, n))) for a in range(0, n, 7)]
    assert np.abs(np.concatenate(parts) - whole).max() < 2e-5 * whole.max()
    truth = plan.source.truth(plan.grid)
    assert np.linalg.norm(whole - truth) < 0.75 * np.linalg.norm(truth)


def sweep_cone(folder: Path, solver: str, monkeypatch: pytest.MonkeyPatch, layers: int = 7) -> tuple[SlabPlan, DiskSweeps]:
    """A cone beam of 19 layers whose object and box leave the detector above and below; seven views a product."""
    text = SCAN + CONE.replace("[30, 24]", "[14, 24]") + BETWEEN
    (folder / "fit.toml").write_text(text + f'solve = {{ name = "{solver}", subsets = 3, iterations = 3, relaxation = 0.8 }}\n')
    monkeypatch.setattr(slab_scan, "_most_layers", lambda *_: layers)
    monkeypatch.setattr(slab_scan, "_views_at_once", lambda *_: 7)
    plan = plan_slabs(config.load(folder / "fit.toml", []), folder)
    return plan, slab_scan.make_sweeps(plan, folder)


@pytest.mark.parametrize(("solver", "start"), [("sirt", "empty"), ("os-sart", "filtered")])
def test_sweeps_over_the_disk_equal_those_in_memory(
    variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, solver: str, start: str
) -> None:
    """Three slabs of a cone beam, some unused rays: volume and residuals of the solver in memory, to float32 sums in another
    order (2e-5 of the largest value)."""
    plan, sweeps = sweep_cone(tmp_path, solver, monkeypatch)
    assert len(plan.layers) == 3 and plan.overlap == 0
    settings = msgspec.structs.replace(plan.settings, solve=msgspec.structs.replace(plan.settings.solve, start=start))
    whole = plan.source.read(slice(0, 14))
    weights = np.where(np.random.default_rng(1).random(whole.y.shape) < 0.1, 0.0, whole.weights)
    read = plan.source.read
    source = replace(plan.source, read=lambda rows: replace(read(rows), weights=weights[:, rows]))
    plan = replace(plan, settings=settings, source=source)
    begin = slab_scan.prepare_sweeps(plan, sweeps)
    x0 = sweeps.volume(begin).copy()
    assert bool(x0.any()) == (start == "filtered")
    state = list(itertools.islice(sweeps.run(begin), 3 * sweeps.n_subsets))[-1]
    a = Projector(plan.source.beam, plan.grid)
    options = {} if solver == "sirt" else {"n_subsets": 3, "decay": 0.99}
    problem = LeastSquares(a, whole.y, weights, x0, nonnegative=True)
    relaxation = 1.0 if solver == "sirt" else 0.8
    expected = list(itertools.islice(SOLVERS[solver].run(problem, relaxation=relaxation, **options), 3))
    x = expected[-1].x.reshape(plan.grid.shape)
    assert np.abs(sweeps.volume(state) - x).max() < 2e-5 * x.max()
    np.testing.assert_allclose(state.residuals, [one.residual_norm for one in expected], rtol=1e-5)


def test_sweeps_go_on_after_a_stop(variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C within the fifth of nine subsets, after the first slab was updated: --resume gives the volume of an undisturbed
    run bit by bit, and the files of the sweeps are gone."""
    sweep_cone(tmp_path, "os-sart", monkeypatch)
    command = ["optimize", str(tmp_path / "fit.toml"), "-o"]
    assert main([*command, str(tmp_path / "whole")]) == 0
    update, calls = DiskSweeps._update, []

    def stop(*given: object) -> None:
        calls.append(1)
        if len(calls) == 14:
            raise KeyboardInterrupt
        update(*given)

    monkeypatch.setattr(DiskSweeps, "_update", stop)
    assert main([*command, str(tmp_path / "run")]) == 130
    state = json.loads((tmp_path / "run" / slab_scan.STATE).read_text())
    assert state["sweeps"]["steps"] == 4 and not state["done"]
    assert main([*command, str(tmp_path / "run"), "--resume"]) == 0
    assert len(calls) == 14 + 3 * 5
    volumes = [read_volume(tmp_path / name / "volumes/slices").values for name in ("whole", "run")]
    np.testing.assert_array_equal(*volumes)
    assert volumes[0].max() > 0.5 and not (tmp_path / "run" / slab_scan.SWEEPS).exists()
    assert main([*command, str(tmp_path / "run"), "--resume"]) == 0 and len(calls) == 14 + 3 * 5


def test_a_short_arc_of_a_cone_is_swept(variant_rgb: str, tmp_path: Path) -> None:
    """Filtered back-projection refuses 100 degrees, so auto is os-sart."""
    (tmp_path / "fit.toml").write_text(SCAN + CONE + ROWS)
    plan = plan_slabs(config.load(tmp_path / "fit.toml", ["scan.arc=100"]), tmp_path)
    assert plan.settings.solve.name == "os-sart"


def test_sweeps_within_the_memory(variant_rgb: str, tmp_path: Path) -> None:
    """1024^3 voxels from 1024 cone views of 1024^2 within 4 GiB: of what is above the base, a third holds
    the rays of seven views, and two thirds hold 41 layers and more."""
    scan = CONE.replace("views = 40", "views = 1024").replace("[30, 24]", "[1024, 1024]").replace("0.11", "0.0025")
    text = SCAN + scan + 'grid = { shape = [1024, 1024, 1024], voxel_size = 0.002 }\nsolve = { name = "os-sart" }\n'
    (tmp_path / "fit.toml").write_text(text)
    plan = plan_slabs(config.load(tmp_path / "fit.toml", ["slabs.memory=4"]), tmp_path)
    above = 4 * 2**30 - slab_scan.BASE_BYTES
    views = slab_scan._views_at_once(plan.settings, plan.source.beam)
    assert views == int(above / 3 / (160 * 2**20)) == 7 and 41 <= plan.layers[0].stop <= 62


def test_a_slab_reads_the_rows_that_it_needs() -> None:
    """The layers 4 to 7 of a grid whose layers are rows; in a cone of magnification 2 +- 1/6 at +-1 a height h needs
    rows between h (2 - 1/6) and h (2 + 1/6) or so."""
    beam = ParallelBeam(np.arange(8) * 0.3, (12, 5))
    grid = VoxelGrid((12, 5, 5))
    assert rows_of_slab(beam, grid.select_layers(slice(4, 8))) == slice(4, 8)
    assert rows_of_slab(beam, VoxelGrid((4, 5, 5), centre=(0, 0, 50))).start == 12
    cone = ConeBeam(np.arange(8) * 0.3, (41, 5), 6.0, 12.0)
    rows = rows_of_slab(cone, VoxelGrid((1, 2, 2), 1.0, (0.0, 0.0, 6.0)))
    near, far = 6 * 12 / (6 - 0.5 * np.sqrt(2)), 6 * 12 / (6 + 0.5 * np.sqrt(2))
    assert rows.start - 20 <= far and rows.stop - 1 - 20 >= near - 0.3 and rows.stop - rows.start <= 5


def test_the_preview_reads_a_few_rows_at_once(variant_rgb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of a memory of 12 rows beyond the base: six rows at once, the same line integrals as of all rows."""
    (tmp_path / "fit.toml").write_text(SCAN + PARALLEL + ROWS)
    plan = plan_slabs(config.load(tmp_path / "fit.toml", []), tmp_path)
    assert plan.choices[-1].choice == "1 slab of 24 layers"
    row = slab_scan.RAY_BYTES["direct"] * 40 * 24
    monkeypatch.setattr(slab_scan, "BASE_BYTES", 2**30 - 12 * row)
    read, views, counts = plan.source.read, np.arange(0, 40, 3), []

    def watch(rows: slice) -> Projections:
        data = read(rows)
        counts.append(data.y.shape[1])
        return data

    plan = replace(plan, source=replace(plan.source, read=watch))
    lines = slab_scan._read_lines(plan, slice(1, 24, 2), views)
    assert counts == [6, 6] and lines.dtype == np.float32
    np.testing.assert_array_equal(lines, read(slice(1, 24, 2)).y[views].astype(np.float32))


def test_coarse_voxels_lower_the_cutoff_of_the_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Voxels of twice the size show half of the frequencies."""
    monkeypatch.setattr(slab_scan, "filtered_backprojection", lambda projector, y, window, cutoff: cutoff)
    projector = SimpleNamespace(geometry=ParallelBeam(np.zeros(1), (1, 4), 1.0))
    solve = config.SolveSettings(name="fbp", cutoff=0.8)
    assert slab_scan._reconstruct_directly(projector, np.zeros(1), solve, 0.5) == 0.4


def test_rows_and_layers_are_where_they_were() -> None:
    beam = ConeBeam(np.zeros(1), (9, 4), 5.0, 8.0, (0.5, 1.0), 0.25, (0.125, 0.5))
    some = beam.select_rows(slice(2, 9, 3))
    np.testing.assert_allclose(some.v, beam.v[2:9:3])
    np.testing.assert_array_equal(some.u, beam.u)
    grid = VoxelGrid((9, 4, 4), (1.0, 2.0, 0.5), (1.0, 2.0, 3.0))
    np.testing.assert_allclose(grid.select_layers(slice(1, 8, 2)).axis("z"), grid.axis("z")[1:8:2])


def write_views(folder: Path, highest_first: bool = False) -> None:
    """Readings of a head with flats of 1000, a file a view."""
    from tifffile import imwrite

    beam = ParallelBeam(np.pi * np.arange(40) / 40, (24, 24), 0.09)
    readings = 1000 * np.exp(-shepp_logan().project(beam)).astype(np.float32)
    for k, image in enumerate(readings):
        imwrite(folder / f"view_{k:03d}.tif", image[::-1] if highest_first else image)
    for k in range(3):
        imwrite(folder / f"flat_{k}.tif", np.full((24, 24), 1000 + k, np.float32))


MEASURED = """title = "slabs"
threads = 1
scan = { beam = "parallel", pitch = 0.09 }
data = { source = "stack", file = "view_*.tif", flats = "flat_*.tif", reading = "intensity" }
slabs = { memory = 1.0 }
"""


@pytest.mark.parametrize("is_flipped", [False, True])
def test_measured_slabs_find_axis_and_air_once(variant_rgb: str, tmp_path: Path, is_flipped: bool) -> None:
    """A slab of a stack equals the same layers of the whole scan, with either order of the rows."""
    write_views(tmp_path, is_flipped)
    first = 'first_row = "highest", ' if is_flipped else ""
    (tmp_path / "fit.toml").write_text(MEASURED.replace("data = { ", "data = { " + first))
    plan = plan_slabs(config.load(tmp_path / "fit.toml", []), tmp_path)
    assert any("rotation axis" in note for note in plan.source.notes)
    assert abs(plan.source.beam.axis_offset) < 0.02 and plan.source.beam.shape == (40, 24, 24)
    whole = reconstruct_slab(plan, slice(0, 24))
    part = reconstruct_slab(plan, slice(3, 9))
    assert np.abs(part - whole[3:9]).max() < 2e-5 * whole.max()
    assert whole[16].max() > 0.5 and not np.allclose(whole[16], whole[7], atol=0.1)


def test_rows_of_a_stack_are_read_alone(tmp_path: Path) -> None:
    """Uncompressed and compressed TIFF, and .npy: some rows equal those of the whole stack."""
    from tifffile import imwrite

    stack = np.arange(3 * 7 * 5, dtype=np.uint16).reshape(3, 7, 5)
    for k, image in enumerate(stack):
        imwrite(tmp_path / f"a_{k}.tif", image)
        imwrite(tmp_path / f"b_{k}.tif", image, compression="zlib")
    imwrite(tmp_path / "c.tif", stack, photometric="minisblack")
    write_volume(tmp_path / "d.npy", stack)
    for name in ("a_*.tif", "b_*.tif", "c.tif", "d.npy"):
        assert stack_shape(tmp_path / name) == (3, 7, 5)
        np.testing.assert_array_equal(read_stack(tmp_path / name, rows=slice(1, 6, 2)), stack[:, 1:6:2])


@pytest.mark.parametrize("form", ["tiff", "zarr"])
def test_an_interrupted_run_goes_on(variant_rgb: str, tmp_path: Path, monkeypatch, capsys, form: str) -> None:
    """Ctrl-C in the second of four slabs; --resume takes the other three, and other settings are refused."""
    if form == "zarr":
        pytest.importorskip("tensorstore")
    (tmp_path / "fit.toml").write_text(SCAN + PARALLEL + ROWS)
    monkeypatch.setattr(slab_scan, "_most_layers", lambda *_: 6)
    done, whole = [], slab_scan.reconstruct_slab

    def stop(plan, layers):
        if layers.start == 6 and len(done) == 1:
            raise KeyboardInterrupt
        done.append(layers.start)
        return whole(plan, layers)

    monkeypatch.setattr(slab_scan, "reconstruct_slab", stop)
    command = ["optimize", str(tmp_path / "fit.toml"), "-o", str(tmp_path / "run"), "--set", f"slabs.format={form}"]
    assert main(command) == 130
    assert main([*command, "--resume", "--set", "solve.window=hann"]) == 1
    assert "found solve.window = ram-lak, expected hann" in capsys.readouterr().err
    done.append(-1)
    assert main([*command, "--resume"]) == 0
    assert done == [0, -1, 6, 12, 18]
    name = "slices" if form == "tiff" else "reconstruction.zarr"
    volume = read_volume(tmp_path / "run/volumes" / name)
    record = json.loads((tmp_path / "run/run.json").read_text())
    assert volume.values.shape == (24, 22, 22, 1) and record["results"]["slabs"] == 4
    plan = plan_slabs(config.load(tmp_path / "fit.toml", []), tmp_path)
    np.testing.assert_array_equal(volume.values[..., 0], np.concatenate([whole(plan, s) for s in plan.layers]))
    assert record["results"]["nrmse"] < 0.75 and (tmp_path / "run/preview.png").stat().st_size > 500
    if form == "zarr":
        np.testing.assert_allclose(volume.to_world, plan.grid.to_world, atol=1e-12)


def test_memory_bounds_the_slabs(variant_rgb: str, tmp_path: Path) -> None:
    """Twice the memory above the base gives twice the layers; whole packets of sixteen from sixteen layers on."""
    scan = 'scan = { beam = "parallel", views = 1024, detector = [1024, 1024] }\ngrid = { shape = [1024, 1024, 1024] }\n'
    (tmp_path / "fit.toml").write_text(SCAN + scan)
    counts = {}
    for memory in (2.0, 4.0):
        plan = plan_slabs(config.load(tmp_path / "fit.toml", [f"slabs.memory={memory}"]), tmp_path)
        counts[memory] = plan.layers[0].stop
        assert plan.layers[-1].stop == 1024 and counts[memory] % 16 == 0
        assert plan.choices[-1].choice == f"{len(plan.layers)} slabs of {counts[memory]} layers"
    assert counts[4.0] >= 2 * counts[2.0] > 0
    with pytest.raises(MivolError, match=r"a slab of one layer needs 0\.41 GiB, found slabs.memory = 0\.35: set it to 0\.5"):
        plan_slabs(config.load(tmp_path / "fit.toml", ["slabs.memory=0.35"]), tmp_path)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        (
            ["solve.name=pcg"],
            "found pcg for slabs of a cone beam, expected fdk, sirt or os-sart: rays cross slabs.*give grid.shape fewer voxels",
        ),
        (["solve.name=ml-tr"], "slabs take neither ml-tr nor data.drift"),
        (["data.source=volume", "data.file=a.npy"], 'found data.source = "volume"'),
        (["solve.name=sirt", "solve.tv=1"], "found solve.tv = 1 and solve.supersampling = 1 for slabs of a cone beam by sirt"),
        (["solve.name=os-sart", "solve.supersampling=2"], "found solve.tv = 0 and solve.supersampling = 2"),
        (["solve.name=fdk", "solve.tv=1"], "fdk takes no solve.tv"),
    ],
)
def test_slabs_refuse(variant_rgb: str, tmp_path: Path, changes: list[str], found: str) -> None:
    text = SCAN.replace(", scale = 2.0", "") if "data.source=volume" in changes else SCAN
    (tmp_path / "fit.toml").write_text(text + CONE + ROWS)
    assert_refused(found, plan_slabs, config.load(tmp_path / "fit.toml", changes), tmp_path)
