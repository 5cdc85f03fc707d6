"""Runs on real workers: the same result with one, two and three of them, and with one killed in the middle."""

from __future__ import annotations

import gc
import os
import re
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from local_workers import kill_once, kill_worker, some_workers
from refusals import assert_refused
from tiny_experiment import PHOTOS, run, write_experiment

from mivol import config
from mivol.cluster.distribution import ClusterDistribution, SharedSceneProblem
from mivol.cluster.packages import SceneSource, share_scene
from mivol.cluster.pool import Pool, Unit
from mivol.cluster.reference import complete_on, passes_on
from mivol.cluster.sweep import run_on
from mivol.cluster.workplace import Workplace
from mivol.errors import MivolError
from mivol.experiments.fit_kind import NullProgress, RunContext
from mivol.experiments.kinds import run_experiment
from mivol.experiments.render import render_image
from mivol.experiments.run_folder import CHECKPOINT
from mivol.experiments.sweep import plan_sweep, run_in_turn, run_sweep
from mivol.files import read_volume
from mivol.optim import checkpoint
from mivol.report.page import SweepRow
from mivol.report.record import RECORD, read_record
from mivol.scene.load import load_scene
from mivol.scene.sensors import Ring
from mivol.validate.reference import render_photographs

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]


# -- The pool ----------------------------------------------------------------------------------------------------------------


def answer(place: Workplace, number: int, fault: str) -> int:
    """Work for the tests of the pool: a number, a refusal, or a bug."""
    if fault == "refusal":
        raise MivolError("this scene is refused.")
    time.sleep(0.05)
    return number // (fault != "bug")


# -- References --------------------------------------------------------------------------------------------------------------


def write_scattering_scene(folder: Path) -> Path:
    """The cube of the tiny experiment, with scattered light, so that its references have noise."""
    path = write_experiment(folder) / "scene.xml"
    path.write_text(path.read_text().replace('name="albedo" value="0"', 'name="albedo" value="0.8"'))
    return path


@pytest.fixture(autouse=True, scope="module")
def no_leftovers() -> None:
    """References are rendered in this process too, where shapes that other tests left behind in cycles would take part."""
    gc.unfreeze()
    gc.collect()


def test_references_do_not_depend_on_workers(client: object, tmp_path: Path, variant_rgb: str) -> None:
    """Rationale: seeds belong to batches, and the owner adds batches in their order.

    Expected: mean and variance of each view equal to the bit alone, with 1, 2 and 3 workers, with one killed, and if some views
    are on disk; the first view stops at its error, not at the largest number of samples.
    """
    path = write_scattering_scene(tmp_path)
    loaded = load_scene(path)
    sensors = Ring(count=3, width=24, height=24).sensors(loaded.scene)
    options = {"sensors": sensors, "max_depth": 4, "target_se": 6e-3, "max_spp": 1 << 12, "pass_spp": 4}
    alone = render_photographs(loaded, tmp_path / "alone", progress=False, **options)
    assert all(32 < view.batches < 1024 for view in alone)

    def compare(name: str, pool: Pool, show: Callable[[str], None] = lambda line: None, numbers: type = np.float64) -> None:
        scene = share_scene(pool, SceneSource(path), loaded)
        pages: list[tuple[list[SweepRow], bool]] = []
        complete = complete_on(pool, scene, show, lambda rows, is_running: pages.append((rows, is_running)))
        found = render_photographs(loaded, tmp_path / name, complete=complete, **options)
        assert [(row.name, row.status) for row in pages[-1][0]] == [(f"view_{n:03d}.exr", "finished") for n in range(3)]
        assert [row.results["samples a pixel"] for row in pages[-1][0]] == [4.0 * view.batches for view in found]
        assert [is_running for _, is_running in pages] == [True] * (len(pages) - 1) + [False]
        for one, other in zip(alone, found, strict=True):
            assert (one.batches, one.identity) == (other.batches, other.identity)
            assert np.array_equal(one.mean.astype(numbers), other.mean.astype(numbers))
            assert np.array_equal(one.variance.astype(numbers), other.variance.astype(numbers))

    for count in (1, 2, 3):
        with some_workers(client, count) as pool:
            compare(f"{count}", pool)
    (tmp_path / "3" / "view_001.exr").unlink()
    (tmp_path / "3" / "view_001.state.npz").unlink(missing_ok=True)
    with some_workers(client, 1) as pool:
        compare("3", pool, numbers=np.float32)  # the first and the last view come from files of float32
    said: list[str] = []
    with some_workers(client, 2, said) as pool:
        compare("killed", pool, kill_once(pool))
        assert pool.lost == 1
        assert pool.repeated >= 1
        assert "1 worker(s) of the cluster were lost" in pool.describe_losses()[0]
    assert any("lost a worker" in line for line in said)


def test_errors_of_workers_are_sentences(client: object) -> None:
    """A refusal comes as it is, a bug with its type, and the pool goes on after each."""
    with some_workers(client, 1) as pool:
        assert_refused("this scene is refused", list, pool.run([Unit(0, answer, (0, "refusal"))]))
        with pytest.raises(ZeroDivisionError):
            list(pool.run([Unit(0, answer, (0, "bug"))]))
        assert sorted(pool.run(Unit(i, answer, (i, "")) for i in range(5))) == [(i, i) for i in range(5)]


# -- Images ------------------------------------------------------------------------------------------------------------------


def test_images_do_not_depend_on_workers(
    client: object, tmp_path: Path, variant_rgb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An image of five passes is equal to the bit alone and by three workers, in the order of its passes."""
    monkeypatch.setattr("mivol.experiments.render.SAMPLES_PER_PASS", 48 * 4)
    path = write_scattering_scene(tmp_path)
    loaded = load_scene(path)
    alone, names = render_image(loaded.scene, 0, None, 18, 3)
    with some_workers(client, 3) as pool:
        passes = passes_on(pool, share_scene(pool, SceneSource(path), loaded), 0, None)
        found, others = render_image(loaded.scene, 0, None, 18, 3, passes)
    assert names == others
    assert alone.std() > 0
    assert np.array_equal(alone, found)


# -- Sweeps ------------------------------------------------------------------------------------------------------------------


def test_a_sweep_does_not_depend_on_workers(client: object, tmp_path: Path) -> None:
    """Rationale: a fit is a function of its settings.

    Expected: fits on two workers, one of them killed, have the numbers of the same fits in one process, to the bit.
    """
    path = write_experiment(tmp_path) / "fit.toml"
    over, changes = ["fit.spp=1,2,4"], PHOTOS[1::2]
    run_sweep(plan_sweep(path, over, changes, tmp_path / "alone"), run_in_turn(NullProgress()))
    sweep = plan_sweep(path, over, changes, tmp_path / "two")
    with some_workers(client, 2) as pool:
        kill, ended = kill_once(pool), []

        def say(lines: list[str]) -> None:
            if lines[0].endswith("finished"):
                ended.append(lines[0])
                kill("")

        page, refused = run_sweep(sweep, run_on(pool), say)
        assert (pool.lost, refused) == (1, 0)
    for one in sweep.runs:
        alone, two = (read_record(tmp_path / name / one.name) for name in ("alone", "two"))
        assert {**alone.results, "fit_seconds": 0} == {**two.results, "fit_seconds": 0}
        assert one.name in page.read_text()
    assert len(ended) == 3


# -- Fits --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", ["adam", "gauss_newton"])
def test_a_fit_does_not_depend_on_workers(client: object, tmp_path: Path, optimizer: str) -> None:
    """Rationale: blocks depend on the views only, and sums of float32 numbers in float64 do not depend on their order.

    Expected: the volumes of 1 and 3 workers, and of 2 with one killed among the references and one in a step, are equal to 1e-6
    of their largest value.
    """
    folder = write_experiment(tmp_path)
    changes = ["views.count=5", f'optimizer={{name="{optimizer}"}}', "event=[]", "fit.iterations=3", "fit.spp=3"]
    settings = config.load(folder / "fit.toml", changes)

    def fit(name: str, count: int, killed: bool = False) -> np.ndarray:
        said: list[str] = []
        with some_workers(client, count, said) as pool:
            distribution = ClusterDistribution(pool)
            if killed:
                distribution.show = kill_once(pool)  # among the references
                ask = SharedSceneProblem.ask
                patch = pytest.MonkeyPatch()
                strikes = iter([False, True] + 99 * [False])

                def strike(problem: SharedSceneProblem, *args: object, **more: object) -> object:
                    if next(strikes):
                        kill_worker(pool)
                    return ask(problem, *args, **more)

                patch.setattr(SharedSceneProblem, "ask", strike)
            context = RunContext(settings, folder, tmp_path / name, distribution=distribution)
            run_experiment(context)
            if killed:
                patch.undo()
                assert pool.lost == 2
                assert "2 worker(s) of the cluster were lost" in " ".join(read_record(tmp_path / name).notes)
        return read_volume(next((tmp_path / name / "volumes").glob("*.npz"))).values

    one, other = fit("one", 1), fit("two", 2, killed=True) if optimizer == "adam" else fit("three", 3)
    assert one.std() > 0
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-6 * one.max())


# -- Schedulers --------------------------------------------------------------------------------------------------------------

SBATCH = """#!/bin/bash
script=$(mktemp -p "$(dirname "$0")")
cp "$1" "$script"
setsid bash "$script" > "$script.log" 2>&1 < /dev/null &
echo "Submitted batch job $!"
"""
"""A batch system of one machine: runs the script in the background, and prints the number of the job."""


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_jobs_of_slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant_rgb: str) -> None:
    """The example of the docs with a faked sbatch: a reference comes out, encrypted, and the jobs end."""
    page = (ROOT / "docs" / "tutorials" / "cluster.md").read_text()
    (tmp_path / "slurm.toml").write_text(page.split("```toml", 1)[1].split("```", 1)[0])
    for name, text in (("sbatch", SBATCH), ("scancel", '#!/bin/bash\nkill -- -"$1"\n')):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(tmp_path))
    path = write_scattering_scene(tmp_path)
    assert (
        run("reference", path, "--max-depth", 4, "--spp", 64, "-o", tmp_path / "r.exr", "--cluster", tmp_path / "slurm.toml")
        == 0
    )
    assert (tmp_path / "r.exr").is_file()
    (script, *_) = [file for file in tmp_path.glob("tmp.*") if file.suffix != ".log"]
    text = script.read_text()
    assert "#SBATCH -p normal" in text
    assert "tls://" in text
    assert text.rindex("--nthreads 1") > text.index("--nthreads")
    assert stat.S_IMODE((tmp_path / ".mivol").stat().st_mode) == stat.S_IRWXU


MANY = {
    "sweep": (["fit.toml", *PHOTOS, "--over", "fit.spp=1,2,4", "--over", "seed=0..3"], "2 of 12 runs", "sweep.html", 12),
    "reference": (["many.xml", "--sensor", "all", "--max-depth", "4", "--spp", "16384"], "batches of", "references.html", 16),
}
"""Flags of a verb, words on the error output once it works, its page, and the rows of the page."""


@pytest.mark.parametrize("verb", MANY)
def test_a_command_ends_without_one_of_two_workers(tmp_path: Path, verb: str) -> None:
    """Expected: exit code 0; the page has 12 fits, or 16 views, all finished, and tells of the loss and of repeated work."""
    scene = write_scattering_scene(tmp_path).read_text()
    first, end = scene.index("    <sensor"), scene.index("    <shape")
    (tmp_path / "many.xml").write_text(scene[:first] + 16 * scene[first:end] + scene[end:])
    flags, at_work, page, rows = MANY[verb]
    child = subprocess.Popen(
        [sys.executable, "-m", "mivol", verb, *flags, "-o", "out", "--cluster", "local:2"], cwd=tmp_path, text=True,
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert "2 workers on 1 host" in child.stderr.readline()
    workers = find_workers(child.pid)
    assert len(workers) == 2
    while at_work not in child.stderr.readline():
        assert child.poll() is None
    os.kill(workers[0], signal.SIGKILL)
    rest = child.stderr.read()
    child.stderr.close()
    assert child.wait(60) == 0
    assert "lost a worker" in rest
    text = (tmp_path / "out" / page).read_text()
    assert text.count("<td>finished</td>") == rows
    assert re.search(r"1 worker\(s\) of the cluster were lost, and [1-9] piece\(s\) of work were done again", text)
    assert "<td>lost</td>" in text


LONG = {
    "reference": (["scene.xml", "--max-depth", "4", "--spp", f"{1 << 24}"], "1 worker, batches of view 0: "),
    "optimize": (["fit.toml", *PHOTOS, "--set", "fit.iterations=300"], "300 iterations, 1 worker"),
    "sweep": (["fit.toml", *PHOTOS, "--over", "fit.iterations=2,100000"], "1 of 2 runs"),
}
"""Flags of a verb that takes long on the tiny experiment, and words once it works: of the error output, or of a record."""


ONE_WORKER = """
import sys
from distributed import LocalCluster
cluster = LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0)
print(cluster.scheduler_address, flush=True)
sys.stdin.read()
"""
"""A scheduler and a worker in processes of their own."""


@pytest.mark.parametrize("verb", LONG)
def test_a_scheduler_that_dies_is_a_sentence(tmp_path: Path, variant_rgb: str, verb: str) -> None:
    """Rationale: a fit without events writes no checkpoint before its end, so the loss itself must write one.

    Expected: one sentence, exit code 1, and finished work on disk: batches, the iterations of a fit, ended runs of a sweep.
    """
    write_scattering_scene(tmp_path)
    flags, at_work = LONG[verb]
    here = {"text": True, "cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(ROOT)}}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    scheduler = subprocess.Popen([sys.executable, "-c", ONE_WORKER], **pipes, start_new_session=True, **here)
    out = "r.exr" if verb == "reference" else "run"
    command = [sys.executable, "-m", "mivol", verb, *flags, "-o", out, "--cluster", scheduler.stdout.readline().strip()]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, **here)
    assert "1 worker on 1 host" in child.stderr.readline()
    record = tmp_path / "run" / RECORD
    while at_work not in ((record.read_text() if record.exists() else "") if verb == "optimize" else child.stderr.readline()):
        assert child.poll() is None
        time.sleep(0.1)
    os.killpg(scheduler.pid, signal.SIGKILL)
    scheduler.communicate()
    rest = child.stderr.read()
    child.stderr.close()
    assert child.wait(60) == 1
    assert rest.count("mivol: ") == 1
    assert "does not answer any more: start a scheduler, then give the same command again" in rest
    if verb == "reference":
        assert (tmp_path / "r.state.npz").is_file()
    elif verb == "optimize":
        path = tmp_path / "run" / CHECKPOINT
        assert 0 < checkpoint.read(path, checkpoint.read_settings(path))[1]["next_iteration"] < 300
        assert run("optimize", tmp_path / "fit.toml", *flags[1:], "--resume", "-o", tmp_path / "run") == 0
        assert read_record(tmp_path / "run").results["iterations"] == 300
    else:
        kept = (tmp_path / "run" / "iterations=2" / RECORD).stat().st_mtime_ns
        assert run("sweep", tmp_path / "fit.toml", *PHOTOS, "--over", "fit.iterations=2,3", "-o", tmp_path / "run") == 0
        assert (tmp_path / "run" / "iterations=2" / RECORD).stat().st_mtime_ns == kept


def test_ctrl_c_ends_workers_and_keeps_batches(tmp_path: Path) -> None:
    """As in a terminal, where all processes of the group get the signal."""
    path, out = write_scattering_scene(tmp_path), tmp_path / "r.exr"
    command = [sys.executable, "-m", "mivol", "reference", str(path), "--max-depth", "4", "--spp", f"{1 << 24}", "-o", str(out)]
    child = subprocess.Popen(
        [*command, "--cluster", "local:1"], stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert "1 worker on 1 host" in child.stderr.readline()
    workers = find_children(child.pid)
    assert "1 worker, batches of view 0: " in child.stderr.readline()
    os.killpg(child.pid, signal.SIGINT)
    rest = child.stderr.read()
    child.stderr.close()
    assert child.wait(60) == 130
    assert rest.endswith("mivol: stopped; finished work is kept.\n")
    assert "Traceback" not in rest
    assert (tmp_path / "r.state.npz").is_file()
    assert workers
    ends = time.monotonic() + 20
    while any(map(is_alive, workers)) and time.monotonic() < ends:
        time.sleep(0.1)
    assert not any(map(is_alive, workers))


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that waits for its parent to read its exit code does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def find_workers(owner: int) -> list[int]:
    """Processes of the workers that a process has started."""
    return [pid for pid in find_children(owner) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


def find_children(parent: int) -> list[int]:
    """Processes started by a process."""
    found = []
    for stat_file in Path("/proc").glob("[0-9]*/stat"):
        fields = stat_file.read_text().rpartition(")")[2].split()
        if int(fields[1]) == parent:
            found.append(int(stat_file.parent.name))
    return found
