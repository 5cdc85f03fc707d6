"""Tomography from a TOML file: the run folder, its outputs, resumption, refusals."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from false_alarms import assert_same_variance, fresh
from scattering_scenes import cases
from tiny_experiment import assert_explained

from mivol import config
from mivol.cli import main
from mivol.errors import MivolError
from mivol.experiments import kinds, projections, readings, scan_fit
from mivol.experiments.run_folder import RunFolder
from mivol.experiments.scan_fit import make_problem, write_outputs
from mivol.experiments.solver_choice import Storage, choose_matrix_storage
from mivol.files import read_exr, read_volume, write_volume
from mivol.tomography.geometry import ParallelBeam, VoxelGrid
from mivol.tomography.phantoms import shepp_logan
from mivol.tomography.projector import Projector
from mivol.validate.metrics import nrmse

SCAN = """title = "tiny head"
held_out_every = 6
threads = 1
scan = { beam = "cone", views = 18, arc = 360, detector = [14, 14], pitch = 0.2, source_to_axis = 6, source_to_detector = 6 }
data = { source = "shepp_logan", scale = 2.0 }
grid = { shape = [12, 12, 12], voxel_size = 0.16666667 }
solve = { name = "pcg", iterations = 6 }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "fit.toml").write_text(SCAN)
    return tmp_path


def run(folder: Path, *changes: str, to: str = "run") -> int:
    """The exit code of a fit with changed settings, or with --resume."""
    flags = [flag for change in changes for flag in ([change] if change == "--resume" else ["--set", change])]
    return main(["optimize", str(folder / "fit.toml"), "-o", str(folder / to), *flags])


def rows_of(folder: Path, to: str = "run") -> list[dict]:
    return [json.loads(line) for line in (folder / to / "metrics.jsonl").read_text().splitlines()]


def test_a_scan_leaves_a_whole_run_folder(variant_rgb, folder: Path) -> None:
    """Noise-free chords: the residual falls at every iteration. Voxels of 1/6 are three times as thick as the skull, whose
    value is five times the brain's: the volume is found to half of what an empty one misses, no better."""
    assert run(folder) == 0
    rows = rows_of(folder)
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4, 5, 6]
    assert np.all(np.diff([row["residual"] for row in rows]) < 0)
    assert rows[-1]["nrmse"] < 0.5
    record = json.loads((folder / "run" / "run.json").read_text())
    assert (folder / "run" / "preview.png").read_bytes()[:4] == b"\x89PNG"
    assert record["status"] == "finished"
    assert record["results"]["views"] == 15
    assert [image["view"] for image in record["images"] if image.get("held_out")] == ["view 3"] * 2 + ["view 9"] * 2 + [
        "view 15"
    ] * 2
    assert {"run.json", "report.html", "checkpoint.npz"} <= {path.name for path in (folder / "run").iterdir()}
    assert read_volume(folder / "run" / "volumes" / "reconstruction.vol").values.shape == (12, 12, 12, 1)
    assert np.allclose(read_volume(folder / "run" / "volumes" / "truth.npz").to_world[:3, 3], -1)


def test_a_lost_view_is_neither_fitted_nor_held_out(variant_rgb: str, tmp_path: Path) -> None:
    """Views 3 and 4 of 24 are dark; views 3, 9, 15 and 21 would be held out. The sinogram of the model has all views."""
    beam = ParallelBeam(np.arange(24) * np.pi / 24, (2, 16), 0.125)
    light = np.exp(-shepp_logan().integrate_lines(*beam.rays(), whole_lines=True)).astype(np.float32)
    light[[3, 4]] = 0
    np.save(tmp_path / "a.npy", light)
    (tmp_path / "fit.toml").write_text(
        """title = "a"
        held_out_every = 6
        scan = { beam = "parallel", pitch = 0.125 }
        data = { source = "stack", file = "a.npy", reading = "transmission", find_axis = false }
        solve = { iterations = 2 }
        """
    )
    assert run(tmp_path) == 0
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["results"]["views"] == 24 - 5
    assert {image["view"] for image in record["images"] if image.get("held_out")} == {"view 9", "view 15", "view 21"}
    assert any("2 of 24 views are not used, because they are without light: 3, 4" in note for note in record["notes"])
    channels, _ = read_exr(tmp_path / "run" / "views" / "view_9.exr")
    assert nrmse(channels["Y"], channels["reference.Y"]) < 0.3
    modelled = read_exr(tmp_path / "run" / "views" / "sinogram.exr")[0]["Y"]
    assert nrmse(modelled[[3, 4]], -np.log(light[[2, 5], 1])) < 0.3  # views 7.5 degrees away


@pytest.mark.slow_for("ml-tr", "os-sart", "sart")
@pytest.mark.parametrize("solver", cases(["pcg", "cgls", "sirt", "sart", "os-sart", "ml-tr"], ["pcg", "cgls", "sirt"]))
def test_every_solver_is_reached_by_name(variant_rgb, folder: Path, solver: str) -> None:
    """And lowers the error of the volume well below that of an empty one, which is 1."""
    extra = ["data.photons=1e5"] if solver == "ml-tr" else []
    assert run(folder, f"solve.name={solver}", "solve.iterations=3", "solve.subsets=3", *extra) == 0
    assert rows_of(folder)[-1]["nrmse"] < 0.75


@pytest.mark.slow
def test_direct_methods_are_reached_by_name(variant_rgb, folder: Path) -> None:
    """FDK of 15 views, smoothed, is well below an empty volume; it ends after its one step, and has nothing to resume."""
    changes = ["solve.name=fdk", "solve.window=hann"]
    assert run(folder, *changes) == 0
    rows = rows_of(folder)
    assert len(rows) == 1
    assert rows[0]["nrmse"] < 0.75
    assert run(folder, "--resume", *changes) == 0
    assert len(rows_of(folder)) == 1
    record = json.loads((folder / "run" / "run.json").read_text())
    assert "feldkamp_1984" in record["citations"]


@pytest.mark.slow_for("ml-tr", "sirt")
@pytest.mark.parametrize("solver", cases(["pcg", "sirt", "ml-tr"], ["pcg"]))
def test_solvers_start_where_fdk_ends(variant_rgb, folder: Path, solver: str) -> None:
    """One iteration from FDK has a lower error than one from nothing."""
    changes = [f"solve.name={solver}", "solve.iterations=1", "data.photons=1e5"]
    assert run(folder, *changes, to="cold") == 0
    assert run(folder, *changes, "solve.start=filtered", to="warm") == 0
    assert rows_of(folder, "warm")[0]["nrmse"] < 0.95 * rows_of(folder, "cold")[0]["nrmse"]


PARALLEL = 'scan={beam="parallel", views=18, detector=[4,14], pitch=0.2}'
RESUMED = {
    "pcg": [],
    "pcg with a prior": ["solve.tv=10", "solve.delta=0.01"],
    "pcg from fdk": ["solve.start=filtered"],
    "pcg of stored rows": [PARALLEL, "solve.storage=matrix"],
    "pcg of a light that drifts": ['data={source="stack", file="y.npy", reading="line_integral", drift=2, find_axis=false}'],
    "pcg of unknown gains": ['data={source="stack", file="y.npy", reading="line_integral", rings="fit", find_axis=false}'],
    "cgls": ["solve.nonnegative=false"],
    "sirt": [],
    "sirt from fdk": ["solve.start=filtered"],
    "sart": [],
    "sart of stored rows": [PARALLEL, "solve.storage=matrix"],
    "os-sart": ["solve.subsets=4"],
    "ml-tr": [],
    "ml-tr with a prior": ["solve.tv=10", "solve.delta=0.01"],
}


@pytest.mark.slow
@pytest.mark.parametrize("case", RESUMED)
def test_an_interrupted_scan_is_resumed(variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    """Ctrl-C after the third iteration, then --resume: every number as if it had not stopped, to the last bit (one thread).

    Pages and curves are left out: they are drawn of these numbers."""
    changes = ["data.photons=1e4", f"solve.name={case.split()[0]}", *RESUMED[case]]
    if "drifts" in case or "gains" in case:
        chosen = config.load(folder / "fit.toml", changes[:1])
        data = projections.make_data(chosen, folder, projections.make_voxel_grid(chosen, folder))
        np.save(folder / "y.npy", data.y + np.linspace(0, 0.1, 18)[:, None, None] * np.linspace(-1, 1, 14))
        changes = changes[1:]
    monkeypatch.setattr(kinds, "write_page", lambda folder: folder)
    monkeypatch.setattr(RunFolder, "write_curves", lambda run: None)
    assert run(folder, *changes, to="whole") == 0
    append = RunFolder.append

    def stop(run: RunFolder, iteration: int, seconds: float, **values: float) -> None:
        append(run, iteration, seconds, **values)
        if iteration == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "append", stop)
        assert run(folder, *changes, to="cut") == 130
    assert json.loads((folder / "cut" / "run.json").read_text())["status"] == "stopped"
    assert (folder / "cut" / "preview.png").exists()
    continued = []
    with monkeypatch.context() as patch:
        patch.setattr(RunFolder, "append", lambda run, i, t, **v: (continued.append(i), append(run, i, t, **v)))
        assert run(folder, "--resume", *changes, to="cut") == 0
    assert continued == [4, 5, 6]
    values = [[row | {"seconds": 0} for row in rows_of(folder, to)] for to in ("whole", "cut")]
    assert values[0] == values[1]
    files = [(folder / to / "volumes" / "reconstruction.vol").read_bytes() for to in ("whole", "cut")]
    assert files[0] == files[1]


@pytest.mark.slow
def test_more_iterations_resume_a_run_that_is_done(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Four iterations, then two more, with the state kept: every number as if there had been six; fewer than there are is
    another run. What is on record is the command as it was typed, and the last line on the console is what was saved."""
    assert run(folder, to="whole") == 0
    assert run(folder, "solve.iterations=4", "keep_state=true", to="more") == 0
    assert run(folder, "--resume", to="more") == 0
    said = capsys.readouterr().err.splitlines()
    losses = [[(row["iteration"], row["loss"], row["nrmse"]) for row in rows_of(folder, to)] for to in ("whole", "more")]
    assert losses[0] == losses[1]
    record = json.loads((folder / "more" / "run.json").read_text())
    assert record["command"].startswith("mivol optimize ")
    assert record["command"].endswith("more --resume")
    assert said[-1].startswith("result: ")
    assert f"nRMSE of the volume {record['results']['nrmse']:.4g}" in said[-1]
    assert run(folder, "--resume", "solve.iterations=3", to="more") == 1
    assert "solve.iterations is 6 there and 3 here" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("case", ["pcg", "pcg, finer unknowns", "pcg of unknown gains", "sart"])
def test_a_finished_run_continues_from_its_volume(
    variant_rgb, folder: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    """The checkpoint of a finished run holds neither volume nor memory: it is smaller than the volume. More iterations start at
    the volume, and the record says so: sart depends on nothing else, conjugate gradients go further down. Without more, the
    volume stays."""
    changes = {
        "pcg, finer unknowns": ["solve.supersampling=2"],
        "pcg of unknown gains": ['data={source="stack", file="y.npy", reading="line_integral", rings="fit", find_axis=false}'],
        "sart": ["solve.name=sart"],
    }.get(case, [])
    monkeypatch.setattr(kinds, "write_page", lambda folder: folder)
    monkeypatch.setattr(RunFolder, "write_curves", lambda run: None)
    for picture in ("film_of_volume", "draw_scanner"):
        monkeypatch.setattr(scan_fit, picture, lambda *arguments: [])
    if "gains" in case:
        chosen = config.load(folder / "fit.toml")
        data = projections.make_data(chosen, folder, projections.make_voxel_grid(chosen, folder))
        np.save(folder / "y.npy", data.y + 0.1 * np.sin(np.arange(14)))
    assert run(folder, "solve.iterations=4", *changes) == 0
    volume = read_volume(folder / "run/volumes/reconstruction.npz").values
    # A volume of 12^3 float32 is smaller than the text of the settings: the arrays are compared.
    with np.load(folder / "run/checkpoint.npz") as arrays:
        assert sum(arrays[name].size for name in arrays if "offset" not in name and "slope" not in name) < 10
    assert run(folder, "--resume", "solve.iterations=4", *changes) == 0
    assert np.array_equal(read_volume(folder / "run/volumes/reconstruction.npz").values, volume)
    assert run(folder, "--resume", *changes) == 0
    losses = [row["loss"] for row in rows_of(folder)]
    assert len(losses) == 6
    if case == "sart":
        assert run(folder, *changes, to="whole") == 0
        assert losses == [row["loss"] for row in rows_of(folder, "whole")]
    # The mean of finer unknowns explains the data less well than they did, and gains change what there is to explain.
    earlier = {"pcg": 3, "pcg, finer unknowns": 4}.get(case, 0)
    assert losses[5] < losses[earlier]
    notes = json.loads((folder / "run/run.json").read_text())["notes"]
    assert any("continues from volumes/reconstruction.npz" in note for note in notes)


@pytest.mark.slow
def test_a_rise_is_flagged_and_the_best_volume_kept(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """100 quanta a pixel are a noise of 10 %: conjugate gradients without bounds fit it after a few iterations."""
    noisy = ["data.photons=100", "solve.iterations=12", "solve.nonnegative=false"]
    assert run(folder, *noisy) == 0
    errors = [row["nrmse"] for row in rows_of(folder)]
    lowest = int(np.argmin(errors))
    assert errors[-1] > errors[lowest]
    said = f"nRMSE of the volume was best at iteration {lowest + 1}"
    assert said in capsys.readouterr().err
    assert any(said in note for note in json.loads((folder / "run" / "run.json").read_text())["notes"])
    volumes = {name: read_volume(folder / f"run/volumes/{name}.npz").values for name in ("reconstruction_best", "truth")}
    difference = volumes["reconstruction_best"] - volumes["truth"]
    # Volumes are stored in float32.
    assert np.isclose(np.linalg.norm(difference) / np.linalg.norm(volumes["truth"]), errors[lowest], rtol=1e-6)


@pytest.mark.slow_for("ml-tr", "sirt")
@pytest.mark.parametrize("solver", cases(["pcg", "sirt", "ml-tr"], ["pcg"]))
def test_a_solver_stops_at_the_noise(variant_rgb, folder: Path, solver: str) -> None:
    """The first residual that is at most 1.5 times the noise is the last, again after --resume, and the page says so.

    200 quanta a pixel: the noise is 7 % and voxels of 1/6 explain the head to about that.
    """
    changes = ["solve.iterations=40", "data.photons=200", "solve.discrepancy=1.5", f"solve.name={solver}"]
    assert run(folder, *changes) == 0
    over = [row["discrepancy"] for row in rows_of(folder)]
    assert over[-1] <= 1.5
    assert all(value > 1.5 for value in over[:-1])
    assert 1 < len(over) < 40
    record = json.loads((folder / "run" / "run.json").read_text())
    assert f"stopped after iteration {len(over)} of 40: the residual is as small as the noise" in record["notes"]
    assert record["results"]["discrepancy"] == pytest.approx(over[-1])
    assert run(folder, "--resume", *changes) == 0
    assert len(rows_of(folder)) == len(over)


@pytest.mark.slow
def test_a_prior_in_units_of_the_noise_says_what_it_did(variant_rgb, folder: Path) -> None:
    changes = ["data.photons=200", "solve.tv=1", "solve.delta=0.1", "solve.tv_unit=noise"]
    assert run(folder, *changes) == 0
    (line,) = [line for line in json.loads((folder / "run/run.json").read_text())["plan"] if "variation" in line["choice"]]
    assert "strength" in line["choice"]
    assert "% of the differences between neighbours count as edges" in line["reason"]


@pytest.mark.slow
def test_what_is_left_open_is_chosen_and_said(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    """By the table of the benchmarks: a lower error than the solver that is named, and as many voxels. Its noise is
    found; a resumed run goes on from a file that leaves the same open."""
    assert run(folder, to="named") == 0
    (folder / "fit.toml").write_text(SCAN.replace('name = "pcg", ', ""))
    assert run(folder) == 0
    assert rows_of(folder)[-1]["nrmse"] < rows_of(folder, "named")[-1]["nrmse"]
    assert read_volume(folder / "run" / "volumes" / "reconstruction.vol").values.shape == (12, 12, 12, 1)
    record = json.loads((folder / "run" / "run.json").read_text())
    plan = [line["choice"] for line in record["plan"]]
    assert [line.split(":")[0] for line in plan] == [
        *("projector", "solver", "start", "unknowns", "storage", "noise", "total variation")
    ]
    assert record["results"]["nrmse"] == pytest.approx(rows_of(folder)[-1]["nrmse"])
    assert {"hestenes_1952", "rudin_1992"} <= set(record["citations"])
    assert run(folder, "--resume") == 0
    capsys.readouterr()
    assert main(["explain", str(folder / "fit.toml")]) == 0
    said = capsys.readouterr().out
    assert "unknowns: two along each edge of a voxel; the voxel is their mean, because surfaces pass through voxels" in said
    assert "total variation: 1 in units of the noise" in said
    assert "pcg, at most 6 iterations" in said


@pytest.mark.statistical
def test_noise_has_the_variance_that_its_weight_claims(variant_rgb, folder: Path) -> None:
    """z = (y - exact) sqrt(counts) has mean square 1 + O(1/counts); 3528 pixels know it to sqrt(2 / 3528) = 2.4 %."""
    chosen = config.load(folder / "fit.toml", ["data.photons=2e3", f"data.seed={fresh(0)}"])
    grid = projections.VoxelGrid(chosen.grid.shape, chosen.grid.voxel_size)
    noisy = projections.make_data(chosen, folder, grid)
    exact = projections.make_data(config.load(folder / "fit.toml"), folder, grid)
    z = (noisy.y - exact.y) * np.sqrt(noisy.weights)
    # 2000 photons behind an optical depth of 2.6 at most are 150: 1 / 150 of the mean square, and 2 of the logarithm's order.
    assert_same_variance(z, 1.0, mean=0.0, what="counts")
    dark = projections.add_noise(noisy.geometry, np.full(noisy.y.shape, 50.0), exact.truth, 10.0, 0)
    assert np.all(dark.weights == 0)
    assert np.all(dark.y == 0)


def test_a_known_volume_is_projected_by_the_projector(variant_rgb, folder: Path) -> None:
    values = np.random.default_rng(0).uniform(0, 1, (12, 12, 12, 1)).astype("f")
    write_volume(folder / "v.npz", values)
    chosen = config.load(folder / "fit.toml", ['data={source="volume", file="v.npz", scale=2.0}'])
    grid = projections.VoxelGrid(chosen.grid.shape, chosen.grid.voxel_size)
    data = projections.make_data(chosen, folder, grid)
    assert np.array_equal(data.truth, 2 * values[..., 0])
    assert np.allclose(data.y, projections.Projector(data.geometry, grid) @ (2 * values[..., 0]))


PARALLEL = 'scan={beam="parallel", views=12, detector=[12, 14], pitch=0.2}'


def storage_of(folder: Path, rows: int = 12, **settings: object) -> Storage:
    parallel = PARALLEL.replace("[12, 14]", f"[{rows}, 14]")
    chosen = config.load(folder / "fit.toml", [parallel, *(f"solve.{name}={value}" for name, value in settings.items())])
    grid = projections.make_voxel_grid(chosen, folder)
    return choose_matrix_storage(chosen.solve, Projector(projections.make_geometry(chosen, folder), grid))


def test_rows_are_stored_where_they_fit_and_pay(variant_rgb, folder: Path) -> None:
    """12 layers share the rows of 168 lines of 12 voxels: about 40 kB, which pay at once; those of 8 do
    after two iterations."""
    found = storage_of(folder, iterations=1)
    assert found.is_stored
    assert "shared by the 12 rows of the detector" in found.line.reason
    assert re.match(r"0\.0\d+ MiB, of at most 1 GiB", found.line.reason)
    assert not storage_of(folder, storage="walk").is_stored
    too_large = storage_of(folder, memory=1e-6)
    assert not too_large.is_stored
    assert "of at most 1e-06 GiB (solve.memory)" in too_large.line.reason
    too_few = storage_of(folder, rows=8, iterations=1)
    assert not too_few.is_stored
    assert "1 iterations on 8 rows" in too_few.line.reason
    assert storage_of(folder, rows=8, iterations=2).is_stored
    assert storage_of(folder, iterations=1, name="sart").is_stored
    assert not storage_of(folder, name="fbp").is_stored


@pytest.mark.slow
def test_stored_rows_find_what_the_walk_finds(variant_rgb, folder: Path) -> None:
    """2e-6 a product, times 10 for each of 6 iterations of conjugate gradients; the record says which it was."""
    found = {}
    for storage in ("walk", "matrix"):
        assert run(folder, PARALLEL, f"solve.storage={storage}", to=storage) == 0
        found[storage] = read_volume(folder / storage / "volumes/reconstruction.npz").values
        plan = json.loads((folder / storage / "run.json").read_text())["plan"]
        assert any(line["choice"].startswith(f"storage: {'none' if storage == 'walk' else 'the exact'}") for line in plan)
    assert np.abs(found["matrix"] - found["walk"]).max() < 6 * 10 * 2e-6 * found["walk"].max()


def circle_table(views: int) -> np.ndarray:
    """The cone beam of SCAN as a table."""
    panels = projections.ConeBeam(np.arange(views) * 2 * np.pi / views, (1, 1), 6.0, 6.0, 0.2).panels()
    return np.hstack([panels.source, panels.corner, panels.along_u, panels.along_v])


@pytest.mark.slow
def test_a_table_of_views_is_the_beam_that_it_lists(variant_rgb, folder: Path) -> None:
    """Chords along the rays of the table are those of the circular cone beam, and a helix is a table like any other."""
    np.savetxt(folder / "table.txt", circle_table(18), header="source, middle, step u, step v")
    beam = projections.make_geometry(config.load(folder / "fit.toml"), folder)
    table = projections.make_geometry(
        config.load(folder / "fit.toml", ['scan={beam="table", file="table.txt", detector=[14,14]}']), folder
    )
    for found, expected in zip(table.rays([0, 7]), beam.rays([0, 7]), strict=True):
        assert np.abs(found - expected).max() < 1e-12
    helix = circle_table(36)
    helix[:, [2, 5]] += np.linspace(-0.4, 0.4, 36)[:, None]
    np.savetxt(folder / "table.txt", helix, delimiter=",", header="sx,sy,sz,dx,dy,dz,ux,uy,uz,vx,vy,vz", comments="")
    assert run(folder, 'scan={beam="table", file="table.txt", detector=[20,14]}') == 0
    assert rows_of(folder)[-1]["nrmse"] < 0.5


@pytest.mark.slow_for("npy", "tif")
@pytest.mark.parametrize("kind", ["npy", "tif", "h5"])
def test_cone_beam_data_from_files_need_no_python(variant_rgb, folder: Path, kind: str) -> None:
    """Counts with flats and darks, first row at the top, in a table's geometry: the line integrals that made the counts.

    Flats and darks scatter about means that are exact. Counts reach down to 7 % of 1e6 and are stored as float32, whose
    rounding of 6e-8 is all that differs: y to 1e-7, and the rays to that of float64.
    """
    chosen = config.load(folder / "fit.toml")
    grid = projections.VoxelGrid(chosen.grid.shape, chosen.grid.voxel_size)
    data = projections.make_data(chosen, folder, grid)
    scatter = np.where(np.arange(6) % 2, 1.0, -1.0)[:, None, None] * np.ones((1, 14, 14))
    stacks = {"counts": 64.0 + 1e6 * np.exp(-data.y), "flats": 1000064.0 + 1000 * scatter, "darks": 64.0 + scatter}
    for name, values in stacks.items():
        write_stack(folder / f"{name}.{kind}", values[:, ::-1].astype(np.float32))
    np.savetxt(folder / "table.txt", circle_table(18))
    files = ", ".join(f'{key}="{name}.{kind}"' for key, name in (("file", "counts"), ("flats", "flats"), ("darks", "darks")))
    changes = [
        f'data={{source="stack", reading="intensity", first_row="highest", {files}}}',
        'scan={beam="table", file="table.txt"}',
        "solve.iterations=2",
    ]
    found = projections.make_data(config.load(folder / "fit.toml", changes), folder, grid)
    assert np.abs(found.y - data.y).max() < 2e-7
    for ours, theirs in zip(found.geometry.rays(), data.geometry.rays(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-14)
    assert run(folder, *changes) == 0


def test_the_axis_of_cone_data_from_files_is_found(variant_rgb, folder: Path) -> None:
    """The head, its axis two and a half columns beside the middle, where nobody says so: found to what its note claims.

    A column is 0.1 wide and lies where the axis is, so the offset is that of the note; the two differ by its rounding.
    """
    beam = ["scan.views=48", "scan.detector=[2,36]", "scan.pitch=0.1"]
    data = projections.make_data(
        config.load(folder / "fit.toml", [*beam, "scan.axis_offset=0.25"]), folder, projections.VoxelGrid((2, 2, 2))
    )
    np.save(folder / "y.npy", data.y)
    asked = config.load(folder / "fit.toml", [*beam, 'data={source="stack", file="y.npy", reading="line_integral"}'])
    found = projections.make_data(asked, folder, projections.VoxelGrid((2, 2, 2)))
    (note,) = found.notes
    said = re.match(r"rotation axis at column (\S+) \+- (\S+) \(rays measured from both ends", note)
    column, error = map(float, said.groups())
    assert error < 0.05
    assert abs(column - 20.0) < 3 * error
    assert found.geometry.axis_offset == pytest.approx((column - 17.5) * 0.1, abs=0.00051)


@pytest.mark.slow
def test_readings_are_fitted_as_counts(variant_rgb, folder: Path) -> None:
    """ML-TR of raw readings, a tenth of them saturated and a column dead: as near the head as with the quanta themselves.

    The flats' variance of 2e6 at a signal of 1e5 is a gain of 20 readings a quantum: 5000 quanta. Twice the error is allowed
    for a sixth of the rays that are missing, and less than the three quarters that every solver is held to.
    """
    chosen = config.load(folder / "fit.toml", ["data.photons=5000"])
    grid = projections.make_voxel_grid(chosen, folder)
    data = projections.make_data(chosen, folder, grid)
    readings = 64.0 + 20 * data.quanta.counts
    readings[np.random.default_rng(0).random(readings.shape) < 0.1] = 2e5
    scatter = np.where(np.arange(6) % 2, 1.0, -1.0)[:, None, None] * np.ones((1, 14, 14))
    flats = 100064.0 + np.sqrt(2e6 * 5 / 6) * scatter
    readings[..., 5] = flats[..., 5] = 64.0
    for name, values in {"counts": readings, "flats": flats, "darks": 64.0 + 0 * scatter}.items():
        np.save(folder / f"{name}.npy", values.astype("f"))
    files = 'file="counts.npy", flats="flats.npy", darks="darks.npy"'
    stack = f'data={{source="stack", reading="intensity", {files}, saturation=2e5}}'
    asked = config.load(folder / "fit.toml", [stack, "solve.name=ml-tr"])
    read = projections.make_data(asked, folder, grid)
    problem = make_problem(asked, Projector(data.geometry, grid), read, np.arange(len(readings)))
    expected = readings < 2e5
    expected[..., 5] = False
    np.testing.assert_array_equal(problem.linear_problem.used, expected)
    found = {}
    for name, change in {"quanta": "data.photons=5000", "readings": stack}.items():
        changes = (change, "solve.name=ml-tr", "solve.iterations=4")
        assert run(folder, *changes, to=name) == 0
        found[name] = nrmse(read_volume(folder / name / "volumes/reconstruction.npz").values[..., 0], data.truth)
    assert found["quanta"] < 0.75
    assert found["readings"] < 2 * found["quanta"]
    assert found["readings"] < 0.75


def write_stack(path: Path, values: np.ndarray) -> None:
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["projections"] = values
    else:
        from PIL import Image

        pages = [Image.fromarray(page) for page in values]
        pages[0].save(path, save_all=True, append_images=pages[1:])


def test_angles_that_turn_back_are_said() -> None:
    assert readings.note_order(np.radians([0.0, 1.0, 2.0])) == readings.note_order(np.radians([2.0, 1.0, 0.0])) == []
    (note,) = readings.note_order(np.radians([0.0, 1.0, 3.0, 2.0, 4.0]))
    assert "turn back 1 times (view 3 at 2.00 degrees follows view 2 at 3.00)" in note


REFUSED = {
    "misspelt key": (["solve.iteratons=3"], 'did you mean "iterations"'),
    "misspelt beam": (["scan.beam=fan"], 'scan.beam = "fan" is unknown'),
    "misspelt solver": (["solve.name=pcgg"], 'did you mean "pcg"'),
    "counts that are not there": (["solve.name=ml-tr"], "needs counts of quanta"),
    "counts of line integrals": (
        ["solve.name=ml-tr", 'data={source="stack", file="y.npy", reading="line_integral"}'],
        "found line integrals, transmissions, a drift or ring removal",
    ),
    "saturation of line integrals": (
        ['data={source="stack", file="y.npy", reading="line_integral", saturation=3}'],
        "only readings of an intensity saturate",
    ),
    "noise that is not known": (["solve.discrepancy=1"], "solve.discrepancy needs the noise of the projections"),
    "negative total variation": (["solve.tv=-1"], "solve.tv = -1: expected `float` >= 0"),
    "no unknowns": (["solve.supersampling=0"], "solve.supersampling = 0: expected `int` >= 1"),
    "all views held out": (["held_out_every=1"], "holds out all views"),
    "volume that is not there": (['data={source="volume", file="none.npz"}'], "none.npz"),
    "volume of another shape": (['data={source="volume", file="v.npz"}'], "make them equal"),
    "grid that no ray meets": (["grid.centre=[0,0,400]"], "no ray meets the grid, which reaches 1.732 from (0.0, 0.0, 400.0)"),
    "source among the voxels": (
        ["scan.source_to_axis=0.5"],
        "the source of view 0 is inside the grid, whose edges are (2.0, 2.0, 2.0): give all lengths",
    ),
    "stack that is not there": (['data={source="stack", file="a.npy", reading="line_integral"}'], "a.npy"),
    "intensity alone": (['data={source="stack", file="a.npy", reading="intensity"}'], "an intensity needs flats"),
    "stack with a hole": (
        ['data={source="stack", file="hole.npy", reading="line_integral"}'],
        "1 pixels that are not finite, the first at (view, row, column) = (1, 2, 3)",
    ),
    "degrees as radians": (
        ['data={source="stack", file="y.npy", reading="line_integral", angles="degrees.txt", angle_unit="radian"}'],
        "span 340 radians (54 turns): they seem to be degrees",
    ),
    "radians as degrees": (
        ['data={source="stack", file="y.npy", reading="line_integral", angles="radians.txt"}'],
        "18 views span 5.934 degrees: they seem to be radians",
    ),
    "radians in Data Exchange": (
        ['data={source="measured", file="radians.h5"}', 'scan={beam="parallel"}'],
        '18 views span 5 degrees: they seem to be radians, set data.angle_unit = "radian"',
    ),
    "angles of another scan": (
        ['data={source="stack", file="y.npy", reading="line_integral", angles="few.txt"}'],
        "3 angles for 18 projections",
    ),
    "flats of another size": (
        ['data={source="stack", file="y.npy", reading="intensity", flats="flats.npy", darks="flats.npy"}'],
        "expected three stacks (n, rows, cols) of one detector",
    ),
    "table of another scan": (
        ['data={source="stack", file="y.npy", reading="line_integral"}', 'scan={beam="table", file="table.txt"}'],
        "18 projections and a geometry of 3 views",
    ),
    "table with a line too short": (['scan={beam="table", file="degrees.txt", detector=[14,14]}'], "12 finite numbers"),
    "measured file that is not there": (['data={source="measured", file="a.h5"}', 'scan={beam="parallel"}'], "a.h5"),
    "unknown table": (['data={source="shepp_logan", table="x"}'], "x"),
    "source inside the object's axis": (["scan.source_to_axis=0"], "> 0"),
    "prior where none is used": (["solve.name=sirt", "solve.tv=1"], "prior"),
    "misspelt window": (["solve.window=han"], 'did you mean "hann"'),
    "stored rows of a cone": (["solve.storage=matrix"], "solve.storage = matrix is impossible: only a parallel beam"),
    "filtered back-projection of a cone": (["solve.name=fbp"], "fdk is filtered"),
    "prior beside a direct method": (["solve.name=fdk", "solve.tv=1"], "prior"),
    "subsets beyond the views": (["solve.name=os-sart", "solve.subsets=99"], "99 subsets"),
    "circles of a parallel beam": (['scan={beam="parallel", views=18}', "solve.name=fdk"], "expected a ConeBeam on a circle"),
    "a grid beyond the memory": (["grid.shape=[20000,20000,20000]"], "of 20000 x 20000 x 20000 unknowns needs"),
    "unknowns beyond the memory": (["solve.supersampling=1000"], "a reconstruction of 12000 x 12000 x 12000 unknowns needs"),
    "a panel beyond the memory": (["scan.detector=[100000,100000]"], "a scan of 18 x 100000 x 100000 rays needs"),
    "views beyond the memory": (["scan.views=2000000000"], "a scan of 2000000000 x 14 x 14 rays needs"),
    "a grid without voxels": (["grid.shape=[12,0,12]"], "grid.shape.1 = 0"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_scans_that_are_refused(variant_rgb, folder: Path, capsys: pytest.CaptureFixture, case: str) -> None:
    changes, sentence = REFUSED[case]
    write_volume(folder / "v.npz", np.ones((3, 3, 3, 1), "f"))
    hole = np.zeros((18, 14, 14), "f")
    np.save(folder / "y.npy", hole)
    hole[1, 2, 3] = np.nan
    np.save(folder / "hole.npy", hole)
    np.save(folder / "flats.npy", np.ones((3, 14, 13), "f"))
    np.savetxt(folder / "degrees.txt", 20.0 * np.arange(18))
    np.savetxt(folder / "radians.txt", np.radians(20.0 * np.arange(18)))
    if case == "radians in Data Exchange":
        with h5py.File(folder / "radians.h5", "w") as file:
            file["exchange/data"], file["exchange/theta"] = np.ones((18, 4, 14), "f"), np.linspace(0, 5, 18)
            file["exchange/data_white"], file["exchange/data_dark"] = 2 * np.ones((2, 4, 14), "f"), np.zeros((2, 4, 14), "f")
    np.savetxt(folder / "few.txt", np.arange(3))
    np.savetxt(folder / "table.txt", circle_table(3))
    assert run(folder, *changes) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("mivol: ")]
    assert len(said) == 1
    assert sentence in said[0]
    assert_explained(folder / "fit.toml", changes, said[0])


def test_resume_refuses_other_projections(variant_rgb, folder: Path, capsys: pytest.CaptureFixture) -> None:
    assert run(folder, "solve.iterations=1") == 0
    assert run(folder, "--resume", "solve.iterations=1", "data.scale=3.0") == 1
    assert "belongs to another run: data" in capsys.readouterr().err


def test_a_scan_is_read_as_one(folder: Path) -> None:
    found = config.load(folder / "fit.toml")
    assert isinstance(found, config.ScanExperiment)
    assert config.from_dict(config.list_all_settings(found)) == found
    with pytest.raises(MivolError, match="missing: give it"):
        config.from_dict({"title": "x", "scan": {"beam": "parallel"}, "grid": {"shape": [1, 2, 3]}})


GRID = VoxelGrid((2, 3, 4), (0.5, 0.25, 0.75))


def written(
    folder: Path,
    y: np.ndarray,
    held_out: np.ndarray,
    truth: np.ndarray | None,
    is_noise_known: bool = False,
    removed_rings: np.ndarray | None = None,
) -> SimpleNamespace:
    """The record of a run whose volume is 0, 1, 2, ... and projects to half of what was measured."""
    record = SimpleNamespace(volumes=[], images=[], results={})
    run = SimpleNamespace(path=folder, record=record, write_curves=lambda: None)
    run.make = lambda *names: [(folder / name).mkdir() for name in names]

    weights = np.full(y.shape, 4.0)
    weights[..., 0] = 0 if is_noise_known else 4.0
    beam = ParallelBeam(np.arange(len(y)) / len(y), y.shape[1:])
    facts = {"is_noise_known": is_noise_known, "removed_rings": removed_rings, "pictures": ()}
    data = SimpleNamespace(y=y, weights=weights, truth=truth, geometry=beam, **facts)
    write_outputs(run, 0.5 * y, GRID, data, held_out, np.arange(24.0, dtype=np.float32).reshape(GRID.shape))
    return record


def test_outputs_of_a_scan(tmp_path: Path) -> None:
    """Six views of 4 x 5 pixels, of which all but the first are held out: the first four of these are shown, upright."""
    y = np.arange(120.0, dtype=np.float32).reshape(6, 4, 5)
    held_out = np.arange(1, 6)
    record = written(tmp_path, y, held_out, np.arange(24.0).reshape(GRID.shape))
    *views, side, plan = record.images
    assert [(image.path, image.role) for image in (side, plan)] == [
        ("scanner_side.png", "picture"),
        ("scanner_plan.png", "picture"),
    ]
    shown = [(image.view, image.role, image.held_out) for image in views]
    names = [("sinogram", False), *((f"view {k}", True) for k in (1, 2, 3, 4))]
    assert shown == [(name, role, kept) for name, kept in names for role in ("render", "reference")]
    for name, expected in (("sinogram", y[:, 2]), ("view_3", y[3, ::-1])):
        channels, _ = read_exr(tmp_path / "views" / f"{name}.exr")
        np.testing.assert_array_equal(channels["reference.Y"], expected)
        np.testing.assert_array_equal(channels["Y"], 0.5 * expected)
    assert {image.caption for image in views} == {"row 3 of 4", ""}
    assert all(volume.profiles for volume in record.volumes)
    # A residual of half of what was measured, over a noise of 1/2.
    assert record.results == {
        "nrmse": 0.0,
        "held_out_rms_of_residual_over_noise": pytest.approx(np.sqrt(np.mean(y[1:] ** 2)), rel=1e-6),
    }
    assert [(volume.role, volume.size) for volume in record.volumes] == [
        (role, tuple(float(edge) for edge in GRID.extent)) for role in ("reconstruction", "truth")
    ]
    assert read_volume(tmp_path / "volumes/reconstruction.vol").values.ravel().tolist() == list(range(24))


def test_gains_are_unknowns_of_a_scan_with_rings() -> None:
    asked, not_asked = (SimpleNamespace(data=SimpleNamespace(rings=rings)) for rings in ("fit", "gain"))
    with_rings, without = (SimpleNamespace(removed_rings=rings) for rings in (np.ones((6, 5)), None))
    assert scan_fit.fits_gains(asked, with_rings)
    assert not scan_fit.fits_gains(asked, without) and not scan_fit.fits_gains(not_asked, with_rings)


def test_removed_rings_are_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The middle row with what was removed from it, and without."""
    drawn = []
    plot = scan_fit.plot_ring_removal
    monkeypatch.setattr(scan_fit, "plot_ring_removal", lambda *images: drawn.append(images) or plot(*images))
    y, removed = np.random.default_rng(1).normal(size=(2, 6, 4, 5))[0], np.full((6, 5), 0.25)
    record = written(tmp_path, y, np.arange(0), None, removed_rings=removed)
    ((before, after),) = drawn
    np.testing.assert_array_equal(before, y[:, 2] + 0.25)
    np.testing.assert_array_equal(after, y[:, 2])
    (picture,) = (image for image in record.images if image.path == "rings.png")
    assert (picture.role, picture.caption) == ("picture", "ring removal in row 3 of 4, each line one view")
    assert (tmp_path / "rings.png").read_bytes()[:4] == b"\x89PNG"


def test_a_single_row_is_the_sinogram(tmp_path: Path) -> None:
    """Views of one row are shown as the sinogram alone; without a truth or views held out nothing is said of them."""
    record = written(tmp_path, np.ones((4, 1, 5), np.float32), np.arange(0), None)
    assert {image.view for image in record.images if image.role != "picture"} == {"sinogram"}
    assert record.results == {}
    assert [volume.role for volume in record.volumes] == ["reconstruction"]
    (tmp_path / "held out").mkdir()
    record = written(tmp_path / "held out", np.ones((4, 1, 5), np.float32), np.arange(1), None)
    assert {image.view for image in record.images if image.role != "picture"} == {"sinogram"}


def test_noise_that_is_known_stands_beside_the_lines(tmp_path: Path) -> None:
    """A weight of 4 is a noise of 1/2, and one of 0 has no bound."""
    record = written(tmp_path, np.ones((4, 1, 5), np.float32), np.arange(0), None, is_noise_known=True)
    (noise,) = (image for image in record.images if image.role == "standard error")
    channels, _ = read_exr(tmp_path / noise.path)
    np.testing.assert_array_equal(channels[noise.layer], [[np.inf, 0.5, 0.5, 0.5, 0.5]] * 4)
