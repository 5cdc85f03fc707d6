"""Where workers are, which are refused, what is sent to them, and how work is cut: without a worker."""

from __future__ import annotations

import ast
import asyncio
import logging
import multiprocessing
import zlib
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from refusals import assert_refused
from syntax import tree_of
from tiny_experiment import refused, write_experiment

from mivol import config
from mivol.bench.studies.cluster import Connection, Workload, best_workers, say_limit, step_seconds
from mivol.cli import cluster as verbs
from mivol.cluster import distribution, packages, reference
from mivol.cluster.address import ClusterSettings, is_loopback, parse_cluster
from mivol.cluster.connection import _collect_failures, _connect, _connect_address, import_distributed
from mivol.cluster.distribution import ClusterDistribution, make_blocks
from mivol.cluster.packages import (
    decode_sensor,
    encode_sensor,
    find_experiment_files,
    map_paths,
    pack_files,
    place_below,
    unpack_files,
)
from mivol.cluster.pool import Pool, Unit, _Worker, check_equal_workers, check_worker
from mivol.cluster.reference import LONGEST_UNIT, _View
from mivol.cluster.sweep import WorkerProgress, has_absolute_paths, read_files, write_run
from mivol.cluster.workplace import Facts, Failure, Workplace, find_facts
from mivol.doctor import FAULT, Finding
from mivol.errors import MivolError
from mivol.experiments.field_fit import FieldFit
from mivol.experiments.scan_fit import ScanFit
from mivol.experiments.scene_fit import SceneFit
from mivol.optim.scenes.views import View
from mivol.report.page import SweepRow
from mivol.scene import explain
from mivol.scene.load import load_scene
from mivol.validate.reference import prepare_reference, render_reference

TLS = 'scheduler = "address"\naddress = "tls://node1:8786"\n[security]\nca = "a.pem"\ncert = "b.pem"\nkey = "c.pem"\n'


# -- Where workers are -------------------------------------------------------------------------------------------------------


def test_forms_of_cluster(tmp_path: Path) -> None:
    """The three forms; names of files in TOML start beside the TOML."""
    local = parse_cluster("local:3", threads=2)
    assert (local.scheduler, local.workers, local.threads) == ("local", 3, 2)
    assert parse_cluster("tcp://127.0.0.1:8786").address == "tcp://127.0.0.1:8786"
    for name in ("a.pem", "b.pem", "c.pem"):
        (tmp_path / name).write_text("")
    (tmp_path / "tls.toml").write_text(TLS)
    assert parse_cluster(str(tmp_path / "tls.toml")).security.ca == str(tmp_path / "a.pem")


def test_jobs_that_could_not_be_submitted_are_collected(capsys: pytest.CaptureFixture[str]) -> None:
    """Dask logs them as exceptions; lines are joined, and nothing is printed."""
    with _collect_failures() as found:
        for error in (OSError("sbatch:\n  not found"), None):
            logging.getLogger("asyncio").error("a task failed", exc_info=(type(error), error, None))
    assert found == ["sbatch: not found"]
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("local:0", "has no worker"),
        ("local", "names no cluster"),
        ("tcp://node1:8786", "not encrypted: start scheduler and workers with --tls-ca-file"),
        ("tcp://0.0.0.0:8786", "not encrypted"),
        ("tls://node1:8786", "needs certificates"),
        ("tcp://node1", "not of the form"),
        ("missing.toml", "there is no such file"),
    ],
)
def test_wrong_clusters_are_refused(text: str, reason: str) -> None:
    assert_refused(reason, parse_cluster, text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('scheduler = "slum"', 'did you mean "slurm"'),
        ('scheduler = "slurm"\nworker = 2', 'did you mean "workers"'),
        ('scheduler = "local"\naddress = "tcp://127.0.0.1:1"', "goes with an address"),
        ('scheduler = "local"\n[job]\nqueue = "a"', "is for a batch system"),
        ('scheduler = "address"\naddress = "tcp://node1:1"', "not encrypted"),
        (TLS, "found no file"),
        (TLS.replace("tls:", "tcp:"), "found no file"),
        ("scheduler = ", "cannot be read"),
    ],
)
def test_wrong_files_are_refused(text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / "cluster.toml").write_text(text)
    assert_refused(reason, parse_cluster, str(tmp_path / "cluster.toml"))


def test_files_without_certificates_are_refused(tmp_path: Path) -> None:
    """TLS refuses them before the scheduler is asked, so the sentence is about the files."""
    for name in ("a.pem", "b.pem", "c.pem"):
        (tmp_path / name).write_text("no certificate")
    (tmp_path / "tls.toml").write_text(TLS)
    with pytest.raises(MivolError, match="without certificates and key of TLS"):
        _connect_address(import_distributed(), parse_cluster(str(tmp_path / "tls.toml")))


def test_messages_of_dask_are_not_shown() -> None:
    import_distributed()
    assert not logging.getLogger("distributed.scheduler").isEnabledFor(logging.CRITICAL)


def test_loopback() -> None:
    assert all(map(is_loopback, ("localhost", "127.0.0.1", "127.8.0.1", "::1")))
    assert not any(map(is_loopback, ("", "0.0.0.0", "10.0.0.1", "node1", "localhost.example.org")))


def test_a_script_that_workers_import_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker imports the script: it ends there in silence, and the process of the script gives the sentence."""

    def fail(**options: object) -> None:
        raise RuntimeError("Nanny failed to start.")

    fake = SimpleNamespace(Security=SimpleNamespace(temporary=lambda: None), LocalCluster=fail)
    settings = ClusterSettings(scheduler="local", workers=1, threads=1)
    with (
        pytest.raises(MivolError, match=r"\(Nanny failed to start\): in a script, write if __name__ == "),
        _connect(fake, settings),
    ):
        pass
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit), _connect(fake, settings):
        pass


# -- Which workers are refused -----------------------------------------------------------------------------------------------


def test_equal_workers_are_admitted() -> None:
    own = find_facts()
    check_worker("tls://a:1", own)
    check_equal_workers({"a": own, "b": own._replace(host="node2", cores=64)})


@pytest.mark.parametrize("name", ["mivol", "mivol code", "Mitsuba", "Dr.Jit", "LLVM"])
def test_other_software_is_refused(name: str) -> None:
    own = find_facts()
    odd = own._replace(host="node7", software=own.software | {name: "0.0"})
    assert_refused(f"worker tls://a:1 on node7 has {name} 0.0, and this process", check_worker, "tls://a:1", odd)


def test_workers_that_cannot_render_are_named() -> None:
    own = find_facts()
    with pytest.raises(MivolError, match="on node7 cannot render: no LLVM; follow mivol doctor there"):
        check_worker("tls://a:1", own._replace(host="node7", fault="no LLVM."))
    assert_refused("2 threads of Dask.*--nthreads 1", check_worker, "tls://a:1", own._replace(dask_threads=2))


def test_mivol_doctor_runs_on_workers_that_cannot_render(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its faults are told with the host, before the refusal; other software of that worker is no news then."""
    faulty = Finding("LLVM", FAULT, "none usable", ("install LLVM 20",))
    monkeypatch.setattr("mivol.cluster.workplace.diagnose", lambda: [Finding("Python", "ok", "3.11"), faulty])
    facts = find_facts(fault="no LLVM.")._replace(host="node7", software={})
    assert [line.split() for line in facts.doctor] == [["FAULT", "LLVM", "none", "usable"], [">", "install", "LLVM", "20"]]
    pool, said = make_pool(0), []
    pool.say = said.append
    assert_refused("on node7 cannot render: no LLVM; follow", pool._admit, "tls://a:1", None, facts)
    assert said[0].startswith("mivol doctor on node7 (tls://a:1):\nFAULT LLVM")


def test_the_smaller_group_of_cpus_is_refused() -> None:
    new = find_facts()._replace(cpu="x86_64 avx2 avx512f", host="new")
    old = new._replace(cpu="x86_64 avx2", host="old")
    with pytest.raises(MivolError, match=r"worker b on old has other CPU features than 2 other worker\(s\), namely in avx512f"):
        check_equal_workers({"a": new, "b": old, "c": new})


def make_pool(*memories: int) -> Pool:
    """A pool of workers on one host, without a network."""
    pool = Pool(SimpleNamespace(status="running"), ClusterSettings(scheduler="local"), say=lambda line: None)
    facts = Facts("node1", 1, {}, "x86_64", 1, 0)
    pool.workers = {f"w{i}": _Worker(f"w{i}", None, facts._replace(memory=size)) for i, size in enumerate(memories)}
    return pool


def test_inputs_are_counted_before_they_are_sent() -> None:
    """Two workers of a host share its free memory of 400 bytes: half of the share of each is 100 bytes."""
    pool = make_pool(400, 400)
    pool.share("a", None, 60)
    pool.share("a", None, 60)  # the same content again
    assert_refused("half of the memory of a worker on node1", pool.share, "b", None, 41)
    pool.forget("b")
    pool.check_room(40)
    assert_refused("half of the memory of a worker on node1", pool.check_room, 41)


def test_work_that_kills_its_workers_ends() -> None:
    """A unit of a lost worker is given back twice; the third loss is a refusal that names the unit."""
    pool = make_pool(0, 0, 0)
    unit = Unit("view 3", len)
    for worker in pool.workers.values():
        worker.units[7] = unit
    pool._lose("w0")
    pool._lose("w1")
    assert (pool.lost, pool.repeated) == (2, 2)
    assert_refused(r"work view 3 \(len\) ended 3 workers", pool._lose, "w2")


def test_a_worker_at_the_address_of_a_lost_one_joins() -> None:
    """Dask remembers the failed actor of a lost worker by its key, so each attempt has another key."""
    pool, keys = make_pool(0), []
    pool.client.submit = lambda *args, key, **options: keys.append(key)
    pool.client.loop = SimpleNamespace(add_callback=lambda begin: None)
    for _ in range(2):
        pool._join("w1")
    assert len(set(keys)) == 2
    pool._lose("w0")
    assert [worker.actor for worker in pool.gone] == [None]


@pytest.mark.parametrize(
    ("error", "is_told"),
    [
        (RuntimeError("Worker holding Actor was lost.  Status: error"), False),
        (OSError("connection closed"), False),
        (RuntimeError("a bug"), True),
    ],
)
def test_a_lost_actor_is_no_error_of_the_work(error: Exception, is_told: bool) -> None:
    """Dask's words for a worker that is gone: its units come back when the list of workers tells of the loss."""
    pool = make_pool(0)
    pool.client.loop = SimpleNamespace(add_callback=lambda work: asyncio.run(work()))

    class Actor:
        async def work(self, *args: object) -> None:
            raise error

    pool.workers["w0"].actor = Actor()
    pool._send(pool.workers["w0"], 3, Unit("view 3", len))
    assert pool._news.empty() != is_told
    assert list(pool.workers["w0"].units) == [3]


def test_errors_of_work_are_values() -> None:
    place = Workplace()
    assert place.work(lambda place, x: x + 1, 2) == 3
    assert isinstance(place.work(lambda place: 1 / 0), Failure)


# -- What is sent ------------------------------------------------------------------------------------------------------------


def test_files_arrive_below_the_folder_of_the_worker(tmp_path: Path) -> None:
    """Relative names stay valid, and no name leads out of the worker's folder."""
    here, there = tmp_path / "here", tmp_path / "there"
    (here / "meshes").mkdir(parents=True)
    (here / "a.xml").write_text("a")
    (here / "meshes" / "b.ply").write_bytes(b"b" * 1000)
    bundle = pack_files([here / "a.xml", here / "meshes" / ".." / "meshes"])
    assert len(bundle.files) == 2
    assert bundle.size < 100
    unpack_files(bundle.files, there)
    assert place_below(there, str(here / "a.xml")).read_text() == "a"
    assert place_below(there, str(here / "meshes" / "b.ply")).read_bytes() == b"b" * 1000
    unpack_files({"/x/../../../up": zlib.compress(b"")}, there)
    assert (there / "up").is_file()
    assert pack_files([here]).digest == bundle.digest
    (here / "a.xml").write_text("A")
    assert pack_files([here]).digest != bundle.digest


def test_sensors_cross_processes(variant_rgb: str) -> None:
    """A dict of a rig comes back with its transform, and an existing sensor as its number."""
    to_world = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    sent = encode_sensor(None, {"type": "perspective", "to_world": to_world, "film": {"type": "hdrfilm", "width": 4}})
    assert "ScalarTransform" not in repr(sent)
    back = decode_sensor(sent)
    assert np.array_equal(np.array(back["to_world"].matrix), np.array(to_world.matrix))
    assert back["film"] == {"type": "hdrfilm", "width": 4}
    scene = mi.load_dict({"type": "scene", "a": {"type": "perspective"}, "b": {"type": "orthographic"}})
    assert [encode_sensor(scene, sensor) for sensor in scene.sensors()] == [0, 1]
    assert_refused("which workers do not have", encode_sensor, scene, mi.load_dict({"type": "perspective"}))


def test_files_of_an_experiment_are_found(variant_rgb: str, tmp_path: Path) -> None:
    """The scene with its volume, and the references; the run folder is no input."""
    folder = write_experiment(tmp_path)
    settings = config.load(folder / "fit.toml", ['reference={source="files", paths=["a.exr", "b.exr", "c.exr"]}'])
    files = find_experiment_files(settings, folder)
    assert {path.name for path in files} == {"scene.xml", "start.vol", "a.exr", "b.exr", "c.exr"}
    changed = map_paths(settings, lambda key, name: f"{key} {name}")
    assert changed.scene.file == "scene.file scene.xml"
    assert changed.reference.paths[1] == "reference.paths b.exr"
    assert changed.output == settings.output


# -- How work is cut ---------------------------------------------------------------------------------------------------------


def make_view(done: int, wanted: int, pixels: int, pass_spp: int) -> _View:
    reference = SimpleNamespace(
        run=SimpleNamespace(moments=SimpleNamespace(n=done)),
        setup=SimpleNamespace(shape=(1, pixels, 3), pass_spp=pass_spp),
        count_batches=lambda: wanted,
        is_reached=done >= wanted,
    )
    return _View(0, reference, 0, sent=done)


def test_batches_are_cut_by_paths() -> None:
    """A unit has about 2^18 paths, at most 8 batches, and none beyond the wanted number."""
    assert make_view(0, 40, 1 << 18, 1).next_numbers(4) == range(0, 1)
    assert make_view(0, 40, 1 << 16, 1).next_numbers(4) == range(0, 4)
    assert make_view(0, 40, 16, 1).next_numbers(4) == range(0, LONGEST_UNIT)
    assert make_view(38, 40, 16, 1).next_numbers(4) == range(38, 40)
    assert not make_view(40, 40, 16, 1).next_numbers(4)


def test_finished_views_need_no_batches(variant_rgb: str, tmp_path: Path) -> None:
    """A run over several views continues behind those that are on disk; the page shows their samples."""
    options = {"out": tmp_path / "r.exr", "max_depth": 2, "max_spp": 64, "pass_spp": 2}
    scene = load_scene(write_experiment(tmp_path) / "scene.xml")
    render_reference(scene, **options, progress=False)
    view = _View(0, prepare_reference(scene, **options), 0)
    assert not view.next_numbers(4)
    assert view.row("running") == SweepRow("r.exr", {}, "finished", "", {"samples a pixel": 64.0})


def test_units_wait_for_earlier_ones() -> None:
    """At most ``most`` units of a view are ahead of its first missing batch: their images fill the memory."""
    view = make_view(0, 400, 1 << 18, 1)
    for expected in range(4):
        numbers = view.next_numbers(4)
        assert numbers == range(expected, expected + 1)
        view.sent = numbers.stop
    assert not view.next_numbers(4)


# -- Runs of a sweep ---------------------------------------------------------------------------------------------------------


def test_returned_files_replace_a_run_folder(tmp_path: Path) -> None:
    """A new run puts the earlier one away, a continued one does not; nothing of the old files stays beside the new."""
    target = tmp_path / "spp=4"
    first = {"run.json": zlib.compress(b"1"), "views/a.png": zlib.compress(b"a")}
    write_run(target, first, False)
    assert read_files(target).keys() == first.keys()
    write_run(target, {"run.json": zlib.compress(b"2")}, False)
    assert {path.relative_to(target).as_posix() for path in target.rglob("*") if path.is_file()} == {
        "run.json",
        "earlier/run.json",
    }
    assert (target / "earlier" / "run.json").read_bytes() == b"1"
    write_run(target, {"run.json": zlib.compress(b"3")}, True)
    assert sorted(path.name for path in target.iterdir()) == ["run.json"]
    assert list(tmp_path.iterdir()) == [target]


def test_absolute_paths_are_found(tmp_path: Path) -> None:
    """A checkpoint holds them, and they differ between workers."""
    path = write_experiment(tmp_path) / "fit.toml"
    assert not has_absolute_paths(config.load(path))
    assert has_absolute_paths(config.load(path, [f'scene.file="{tmp_path}/scene.xml"']))


def test_a_worker_stops_at_the_owner_s_request() -> None:
    place = Workplace()
    progress = WorkerProgress(place)
    assert list(progress.track("ab", "views")) == ["a", "b"]
    assert place.says == "views 1 of 2"
    place.is_stopped = True
    with pytest.raises(KeyboardInterrupt):
        next(progress.track("ab", "views"))


# -- Steps of a fit ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "size", "spp", "blocks"),
    [(5, 8, 1, [3, 2]), (16, 64, 8, [8, 8]), (16, 64, 64, [1] * 16), (5, 64, 20, [3, 2]), (3, 512, 2, [1] * 3), (1, 8, 1, [1])],
)
def test_blocks_depend_on_the_views_only(variant_rgb: str, count: int, size: int, spp: int, blocks: list[int]) -> None:
    """At least two blocks, of at most 2^18 samples or a view each."""
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "film": film})
    views = [View(f"{i}", sensor, mi.TensorXf(np.zeros((size, size, 3), np.float32))) for i in range(count)]
    assert [block.n_views for block in make_blocks(views, spp)] == blocks


@pytest.mark.parametrize(("kind", "share"), [(SceneFit, "scene"), (ScanFit, "projector"), (FieldFit, "problem")])
def test_each_kind_of_fit_has_its_part_on_the_workers(monkeypatch: pytest.MonkeyPatch, kind: type, share: str) -> None:
    """Views of scenes, products of scans, views of photographs; the times are those of the part's steps."""
    shared = []

    def note(name: str, times: str) -> Callable:
        steps = SimpleNamespace(times=times)
        return lambda *given: shared.append((name, given)) or SimpleNamespace(steps=steps, times=times)

    monkeypatch.setattr(distribution, "share_scene_problem", note("scene", "of a scene"))
    monkeypatch.setattr(distribution, "share_projector", note("projector", "of a projector"))
    monkeypatch.setattr(distribution, "share_problem", note("problem", "of a problem"))
    monkeypatch.setattr(kind, "make_problem", lambda self: "a problem")
    fit, workers = object.__new__(kind), ClusterDistribution("a pool")
    fit.projector = "rays"
    problem = workers.make_problem(fit)
    given = {"scene": fit, "projector": "rays", "problem": "a problem"}[share]
    assert shared == [(share, ("a pool", given))] and workers.times == f"of a {share}"
    assert (problem == "a problem") == (share != "scene") and (fit.projector != "rays") == (share == "projector")


def test_sums_in_float64_do_not_depend_on_their_order() -> None:
    """The claim behind equal gradients: 64 numbers of float32 over 20 octaves add up without a rounding."""
    rng = np.random.default_rng(1)
    numbers = (rng.normal(size=(64, 100)) * 2.0 ** rng.integers(-10, 10, size=(64, 100))).astype(np.float32)
    sums = [numbers[order].astype(np.float64).sum(axis=0) for order in (rng.permutation(64) for _ in range(5))]
    assert all(np.array_equal(sums[0], other) for other in sums)


@pytest.mark.parametrize("work", [verbs.complete_references, verbs.render_passes, verbs.validate_on_workers])
def test_work_goes_to_the_workers_of_the_flag(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, work: Callable) -> None:
    """Without the flag none are opened."""
    opened: list[tuple[str, str, int]] = []
    monkeypatch.setattr(verbs, "open_workers", lambda *given: opened.append(given) or nullcontext("pool"))
    monkeypatch.setattr(packages, "share_scene", lambda pool, source, loaded: (pool, source.path, loaded.scene))
    monkeypatch.setattr(explain, "describe_light", lambda scene, depth: {"max_depth": depth})
    for name in ("complete_on", "passes_on"):
        monkeypatch.setattr(reference, name, lambda pool, scene, *more, name=name: (name, pool, scene))
    path = tmp_path / "a.xml"
    given = {"mode": "llvm_ad_rgb", "threads": 2, "output": tmp_path, "sensor": 0, "integrator": {}}
    given |= {"scene": path, "a": "", "define": []}
    more = (7,) if work is verbs.validate_on_workers else ()
    with work(SimpleNamespace(**given, cluster=None), SimpleNamespace(scene="smoke"), *more):
        assert opened == []
    with work(SimpleNamespace(**given, cluster="local:2"), SimpleNamespace(scene="smoke"), *more) as found:
        complete, passes = ((name, "pool", ("pool", path, "smoke")) for name in ("complete_on", "passes_on"))
        if more:
            assert found["complete"] == complete and found["make_passes"]("own") == passes
        else:
            assert found == (complete if work is verbs.complete_references else passes)
    assert opened == [("local:2", "llvm_ad_rgb", 2)]


def test_images_of_points_are_refused_before_workers_start(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    np.save(tmp_path / "points.npy", np.eye(4, 3))
    assert "--cluster renders scenes" in refused(capsys, "render", tmp_path / "points.npy", "--cluster", "local:1")


# -- The model of larger clusters --------------------------------------------------------------------------------------------


def test_time_of_a_step_by_hand() -> None:
    """12 units of 1 s, 1 MB at 10 MB/s and 0.1 s: a message takes 0.2 s; the fewest seconds are near sqrt(12 / 0.2) = 7.7."""
    network, step = Connection(0.1, 10e6), Workload("a", 12, 1.0, 1e6, owner_seconds=0.5)
    assert network.message_seconds(1e6) == pytest.approx(0.2)
    expected = {1: 12.7, 2: 6.9, 5: 4.5, 6: 3.7, 12: 3.9, 1000: 3.9}
    assert {workers: pytest.approx(step_seconds(step, network, workers)) for workers in expected} == expected
    assert best_workers(step, network) == 6
    assert say_limit(step, network) == "6 workers: latency of the messages, one worker after another"


def test_time_of_units_that_stream_by_hand() -> None:
    """Messages overlap with the work: 12 messages of 0.2 s take 2.4 s, as 5 workers do in 3 rounds."""
    network, views = Connection(0.1, 10e6), Workload("a", 12, 1.0, 1e6, streams=True)
    assert [round(step_seconds(views, network, workers), 6) for workers in (1, 4, 6, 12)] == [12.0, 3.0, 2.4, 2.4]
    assert say_limit(views, network) == "6 workers: the owner receives images one after another"
    assert say_limit(Workload("b", 3, 1.0, 0.0, streams=True), network) == "3 workers: no more pieces of work"


def test_dask_is_imported_with_the_switch_only() -> None:
    """Nothing else is slower: each import of Dask stands inside of a function, or is for types."""
    package = Path(__file__).parents[2] / "mivol"
    found = {}
    for path in package.rglob("*.py"):
        nodes = [node for node in tree_of(path).body if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        names |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
        found |= {str(path): name for name in names if name.partition(".")[0] in ("dask", "distributed", "dask_jobqueue")}
    assert found == {}
