"""The folder of a run: one run at a time, and a record that says how it ended."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mivol import config
from mivol.errors import MivolError
from mivol.experiments.fit_kind import NullProgress, RunContext
from mivol.experiments.kinds import LivePage, run_experiment
from mivol.experiments.run_folder import EARLIER, KEPT, BestFiles, BestIterate, RunFolder
from mivol.files.atomic import whole_file
from mivol.report.pixel_scale import write_preview
from mivol.report.record import Image, RunRecord, Table, read_metrics, read_record


def folder(path: Path, title: str = "a run", is_resumed: bool = False) -> RunFolder:
    return RunFolder(path / "run", RunRecord.new(title), is_resumed)


def finished(path: Path) -> RunFolder:
    """A run of two iterations that is done."""
    run = folder(path)
    with run.at_work():
        run.begin(0)
        run.append(1, 0.1, loss=3.0)
        run.append(2, 0.2, loss=2.0)
    return run


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    """Rationale: two runs in one folder would mix their metrics. Expected: the second is refused before it writes anything,
    and the folder is free again when the first has ended, however it ended."""
    first, second = folder(tmp_path), folder(tmp_path)
    second.record.title = "another run"
    with pytest.raises(KeyError), first.at_work():
        with pytest.raises(MivolError, match='another run uses the folder "run"'), second.at_work():
            pass
        assert read_record(first.path).title == "a run"
        raise KeyError
    with second.at_work():
        assert read_record(first.path).title == "another run"


def page_of_a_kind(has_live_page: bool) -> SimpleNamespace:
    def draw(run: RunFolder) -> list[Image]:
        write_preview(run.path, np.ones((2, 3, 4)), (4.0, 3.0, 2.0))
        return [Image(path="preview.png", role="picture", caption="slices so far")]

    return SimpleNamespace(stages=SimpleNamespace(fit="fit"), has_live_page=has_live_page, live_images=draw)


def test_the_page_of_a_scan_is_live(tmp_path: Path) -> None:
    """Without a cluster too, after some seconds, with pictures and the errors so far; a fit of less than 50 seconds is too
    short for a page."""
    short, fit = (SimpleNamespace(next_iteration=2, seconds=seconds) for seconds in (2.4, 2.6))
    run = folder(tmp_path)
    with LivePage(page_of_a_kind(has_live_page=True), run, None) as page, run.at_work():
        run.begin(0)
        for iteration in (1, 2):
            run.append(iteration, 1.0, loss=0.5, residual=0.25)
        page.show(fit, 40)
        assert not (run.path / "report.html").exists()  # too early
        page.due = 0.0
        page.show(short, 40)
        assert not (run.path / "report.html").exists()
        page.show(fit, 40)
        said = (run.path / "report.html").read_text()
        assert all(words in said for words in ("2 of 40 iterations<", "slices so far", "Residual", REFRESH))
    assert run.record.images == []


def test_the_page_of_a_fit_on_a_cluster_is_live(tmp_path: Path) -> None:
    """While the fit runs, the page has the workers and is read again; a stopped run has the last page. Alone: no page."""
    rows = Table(title="Workers", head=("host",), rows=(("node7",),))
    workers = SimpleNamespace(describe=lambda: "2 workers, a step takes 9 ms", tables=lambda: [rows])
    kind, fit = page_of_a_kind(has_live_page=False), SimpleNamespace(next_iteration=3, seconds=2.0)
    for distribution in (None, workers):
        run = folder(tmp_path)
        with pytest.raises(KeyError), LivePage(kind, run, distribution) as page, run.at_work():
            run.begin(0)
            page.show(fit, 40)
            page.show(fit, 41)  # too early
            if distribution is not None:
                said = (run.path / "report.html").read_text()
                assert all(words in said for words in ("3 of 40 iterations, 2 workers, a step takes 9", "node7", REFRESH))
            raise KeyError
        assert (run.path / "report.html").exists() == (distribution is not None)
    said = (run.path / "report.html").read_text()
    assert "Stopped" in said and REFRESH not in said
    assert run.record.tables == []


REFRESH = 'http-equiv="refresh"'


def test_the_record_says_what_stopped_a_run(tmp_path: Path) -> None:
    run = folder(tmp_path)
    with pytest.raises(MivolError), run.at_work():
        assert read_record(run.path).status == "running"
        raise MivolError("the disk is full")
    record = read_record(run.path)
    assert (record.status, record.notes) == ("stopped", ["stopped by: the disk is full"])
    with folder(tmp_path).at_work():
        pass
    assert read_record(run.path).status == "finished"


def test_a_refused_run_leaves_a_finished_one_alone(tmp_path: Path) -> None:
    """Whatever a second command is refused for: record and metrics of the first stay, byte for byte."""
    run = finished(tmp_path)
    before = [(run.path / name).read_bytes() for name in ("run.json", "metrics.jsonl")]
    with pytest.raises(MivolError), folder(tmp_path, "another").at_work():
        raise MivolError("no such file")
    assert [(run.path / name).read_bytes() for name in ("run.json", "metrics.jsonl")] == before


def test_curves_of_two_runs_are_never_mixed(tmp_path: Path) -> None:
    """A new run begins with no metrics, and what the earlier one recorded lies beside it; a resumed one keeps its own."""
    finished(tmp_path)
    run = folder(tmp_path, "another")
    with run.at_work():
        run.begin(2)
        assert read_metrics(run.path) == []
        run.append(1, 0.1, loss=9.0)
        run.append(2, 0.2, loss=8.0)
    assert [row["loss"] for row in read_metrics(run.path / EARLIER)] == [3.0, 2.0]
    assert read_record(run.path / EARLIER).title == "a run"
    resumed = folder(tmp_path, "another", is_resumed=True)
    with resumed.at_work():
        resumed.begin(1)
        assert [row["loss"] for row in read_metrics(run.path)] == [9.0]
    assert read_record(run.path / EARLIER).title == "a run"


def contents(path: Path) -> dict[str, bytes]:
    """The files of a folder."""
    return {file.name: file.read_bytes() for file in path.glob("*") if file.is_file()}


class Killed(BaseException):
    """What no code is to catch."""


@contextmanager
def dying(at: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No change of the disk is made any more from the one with this number on, as after a kill just before it."""
    made = []

    def counted(change):
        def changes(*args: object, **named: object) -> object:
            made.append(change)
            if len(made) >= at:
                raise Killed
            return change(*args, **named)

        return changes

    with monkeypatch.context() as patched:
        for name in ("link", "mkdir", "rename", "replace", "rmdir", "unlink"):
            patched.setattr(os, name, counted(getattr(os, name)))
        yield


def refuse_links(source: Path, target: Path) -> None:
    """What a file system says that knows no links."""
    raise OSError(errno.EPERM, os.strerror(errno.EPERM), str(source))


def begin_another(base: Path, at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that is killed at a change of the disk, or is stopped by an error where there was none of that number."""
    run = folder(base, "another")
    with suppress(KeyError), dying(at, monkeypatch), run.at_work():
        run.begin(0)
        raise KeyError


@pytest.mark.parametrize("has_links", [True, False])
def test_a_kill_while_a_run_is_put_away_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_links: bool) -> None:
    """Before each change of the disk by the run that begins: the finished one is whole in its place or in earlier/, and the
    run after that leaves it in earlier/. Rationale: files moved one by one are half here and half there, and the next run
    took what was left here for all."""
    if not has_links:
        monkeypatch.setattr(os, "link", refuse_links)
    for at in range(1, 100):
        base = tmp_path / str(at)
        finished(base)
        run = finished(base)  # with one in earlier/ already
        for name in ("checkpoint.npz", "best.npz", "report.html"):
            (run.path / name).write_text(f"{name} of the finished run")
        before = {name: (run.path / name).read_bytes() for name in KEPT}
        try:
            begin_another(base, at, monkeypatch)
            break
        except Killed:
            pass
        places = [contents(place) for place in (run.path, run.path / EARLIER)]
        assert any(before.items() <= place.items() for place in places)
        third = folder(base, "the third")
        with third.at_work():
            third.begin(0)
            assert read_metrics(third.path) == []
            assert read_record(third.path).title == "the third"
        assert contents(run.path / EARLIER) == before
        assert {path.name for path in run.path.iterdir()} == {"run.json", EARLIER}
    assert at > 15


def test_a_finished_run_without_a_curve_is_left_alone(tmp_path: Path) -> None:
    """A closed formula takes no steps, and its record is one all the same."""
    run = folder(tmp_path)
    with run.at_work():
        run.begin(0)
    before = (run.path / "run.json").read_bytes()
    with pytest.raises(MivolError), folder(tmp_path, "another").at_work():
        raise MivolError("no such file")
    assert (run.path / "run.json").read_bytes() == before


def test_what_a_killed_run_was_writing_is_swept(tmp_path: Path) -> None:
    """Only names that mivol's writer gives, and the folders in it too; the user's own files are left."""
    run = folder(tmp_path)
    (run.path / "views").mkdir()
    for name in (".run.json.0123abcd.part", "views/.a.exr.89abcdef.part", "own.part", ".own.part"):
        (run.path / name).touch()
    with run.at_work():
        pass
    left = {str(path.relative_to(run.path)) for path in run.path.rglob("*.part")}
    assert left == {"own.part", ".own.part"}
    with whole_file(run.path / "a") as temporary:
        temporary.touch()
        other = folder(tmp_path)
        with other.at_work():
            assert not temporary.exists()
        temporary.touch()


def test_the_best_iterate_is_kept(tmp_path: Path) -> None:
    """The error falls and rises: the smallest one's values lie in the file, and the rise is said. The same after a stop."""
    run = folder(tmp_path)
    best = BestIterate(run)
    assert best.is_newest
    with run.at_work():
        run.begin(0)
        for iteration, error in enumerate([0.9, 0.4, 0.6]):
            best.see(iteration, {"nrmse": error, "held_out_psnr": 10.0 + iteration}, {"volume": np.full(2, iteration)})
            run.append(iteration, 0.0, nrmse=error)
    again = BestIterate(folder(tmp_path, is_resumed=True))
    again.restore()
    for one in (best, again):
        assert not one.is_newest
        assert np.array_equal(one.read()["volume"], [1, 1])
        assert "nRMSE of the volume was best at iteration 1, 0.4, and is 0.6 at the end" in one.says()[0]
    again.see(3, {"nrmse": 0.3}, {"volume": np.full(2, 3)})
    assert again.is_newest
    assert again.says() == []
    views = BestIterate(folder(tmp_path / "views"))
    views.see(0, {"held_out_psnr": 20.0}, {})
    views.see(1, {"held_out_psnr": 25.0}, {})
    assert views.is_newest


def test_the_best_iterate_may_be_files(tmp_path: Path) -> None:
    """Of a field: its files are those of the best iterate, are named where the fit has become worse, else go."""
    run, now = folder(tmp_path), {"iteration": 0}
    files = BestFiles(("field_best.npz",), lambda where: (where / "field_best.npz").write_text(str(now["iteration"])))
    best = BestIterate(run, files)
    for iteration, error in enumerate([20.0, 25.0, 22.0]):
        now["iteration"] = iteration
        best.see(iteration, {"few_psnr": error})
    best.settle()
    assert (run.path / "field_best.npz").read_text() == "1"
    assert best.says() == [
        "PSNR of the same few held-out views was best at iteration 1, 25 dB, and is 22 dB at the end: "
        "field_best.npz holds the best iterate, all other files hold the last iterate."
    ]
    best.see(3, {"few_psnr": 26.0})
    best.settle()
    assert not (run.path / "field_best.npz").exists()


def test_the_summary_is_what_was_recorded(tmp_path: Path) -> None:
    run = folder(tmp_path)
    run.record.results = {"held_out_psnr": 30.25, "nrmse": 0.863, "gone": None}
    assert run.summary() == "result: PSNR of the held-out views 30.25 dB, nRMSE of the volume 0.863"
    # A count is said to the last digit.
    run.record.results = {"gaussians": 12345.0}
    assert run.summary() == "result: Gaussians 12345"
    # The time of all stages, not that of the iterations alone.
    run.record.timings = {"projections": 0.25, "solve": 77.04}
    assert run.summary() == "result: Gaussians 12345 (projections 0.2 s, solve 77.0 s)"


SCAN = {
    "title": "unwatched",
    "threads": 1,
    "scan": {"beam": "parallel", "views": 4, "detector": [1, 6], "pitch": 0.5},
    "data": {"source": "shepp_logan"},
    "grid": {"shape": [1, 6, 6], "voxel_size": 0.33333333},
    "solve": {"name": "pcg", "iterations": 2},
}


def test_a_run_needs_nobody_who_watches(variant_rgb: str, tmp_path: Path) -> None:
    assert list(NullProgress().track([3, 4], "items")) == [3, 4]
    page = run_experiment(RunContext(config.from_dict(SCAN), tmp_path, tmp_path / "run"))
    assert page == tmp_path / "run" / "report.html"
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2
