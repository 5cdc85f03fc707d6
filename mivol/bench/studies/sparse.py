"""What does a sparse grid cost beside the dense one: walks, memory, pictures, fits?

    mivol bench sparse [--only read,walk,memory,picture,fit]

Volumes: smoke.vdb of the OpenVDB samples (from MIVOL_DATA; left out if it is not there, and the JSON says so), thin threads in
1 % of their box, and a cumulus (:func:`mivol.fields.procedural.make_cumulus`). Walks skip empty blocks as a plan lets them: in
every step, or before and behind the content of a ray. "sparse over dense": the sparse grid, over the dense grid or its walk
through every cell, whichever is faster. "default over dense": the grid that ``storage = "auto"`` makes; a sparse one over the
dense one, a dense one over its walk through every cell. A rate is the fastest of several walks in turns, over all threads, in
processor time, since other work on the machine changes the wall clock. Memory is counted (arrays of the medium), and measured:
the peak of a separate process, less its peak for a grid of one brick; there, a fit takes three steps of RMSprop with means in
half precision, or of Adam. The question "fit" takes steps of Adam; bricks appear and vanish. Its time is the time of a step,
trials of neighbours included, over the time of a dense step.
"""

from __future__ import annotations

import gc
import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.bench.harness.contests import (
    Contestant,
    agreement_figures,
    compete,
    fastest,
    finite_or_none,
    gain_figures,
    image_errors,
    peak_bytes,
    race,
    render_method,
)
from mivol.bench.harness.study import AT_LEAST, AT_MOST, Bar, Promise, Size, Study, amount, judge_agreement
from mivol.bench.scenes import DATA, TO_WORLD, camera_rays, threads_in_space
from mivol.bench.studies.optical_depth import shuffle
from mivol.errors import MivolError
from mivol.fields.bricks import Bricks
from mivol.fields.procedural import make_cumulus
from mivol.fields.voxels import is_worth_bricks
from mivol.files import SparseVolumeData, read_sparse_volume, write_volume
from mivol.machine import peak_memory
from mivol.optim.events import AdaptBricks
from mivol.optim.first_order import Adam, RMSprop
from mivol.optim.loop import Course, begin_fit
from mivol.optim.parameters import Parameter
from mivol.optim.scenes.scene_problem import SceneProblem
from mivol.optim.scenes.views import View
from mivol.scene.plan import find_skipping
from mivol.scene_graph import find_children
from mivol.threads import run_child
from mivol.transport.media.grid_extinction import integrate_tau
from mivol.transport.traversal.grid_blocks import (
    bound_blocks,
    find_distances_of_bounds,
    find_occupied_blocks,
    find_stored_distances,
)
from mivol.transport.traversal.lattice import Lattice

KEY = "cloud.interior_medium.sigma_t.data"


@dataclass(frozen=True)
class SparseSize(Size):
    """Amount of work."""

    rounds: int = amount(9, 2, "walks of each contestant")
    side: int = amount(512, 32, "edge of the image whose rays are walked [pixels]")
    walk_res: int = amount(512, 64, "voxels along an edge of the threads and the cloud that are walked")
    cloud_res: int = amount(1024, 64, "voxels along an edge of the cloud")
    processes: int = amount(2, 1, "processes of each task whose memory is measured; the second finds its kernels on disk")
    image_side: int = amount(256, 16, "edge of the pictures [pixels]")
    image_spp: tuple[int, ...] = amount((4, 4), (2, 2), "samples per pixel of mivol and of volpath")
    image_rounds: int = amount(4, 2, "pictures of each integrator")
    fit_res: int = amount(256, 32, "voxels along an edge of the fitted smoke")
    fit_views: int = amount(32, 3, "views of a fit")
    fit_side: int = amount(64, 16, "edge of a view [pixels]")
    fit_steps: int = amount(40, 4, "steps of the sparse fit")
    fit_every: int = amount(20, 2, "steps between two changes of bricks")
    fit_dense_steps: int = amount(40, 4, "steps of the dense fit; the same number makes the losses comparable")


# -- Files and walks ----------------------------------------------------------------------------------------------------------


def smoke_file() -> Path | None:
    """smoke.vdb; None if the data folder lacks it."""
    path = DATA / "volumes_vdb" / "smoke.vdb"
    return path if path.is_file() else None


MISSING = "volumes_vdb/smoke.vdb is not in MIVOL_DATA"


def measure_read(size: SparseSize) -> dict:
    """How long does smoke.vdb take to be read into bricks?"""
    path = smoke_file()
    if path is None:
        return {"skipped": MISSING}
    volume = read_sparse_volume(path)
    return {
        "active": int(np.count_nonzero(volume.values)),
        "bricks": len(volume.values),
        "processor_seconds": fastest(lambda: read_sparse_volume(path), time.process_time, size.rounds),
    }


def measure_walk(size: SparseSize) -> dict:
    """What is the rate of walks in sparse grids over the rate in dense ones?"""
    path = smoke_file()
    sources: dict[str, Callable[[], SparseVolumeData]] = {
        "threads": lambda: SparseVolumeData.from_dense(threads_in_space(size.walk_res).values[..., None]),
        "cloud": lambda: make_cumulus(size.walk_res),
    }
    answer: dict = {}
    if path is None:
        answer["smoke"] = {"skipped": MISSING}
    else:
        sources = {"smoke": lambda: read_sparse_volume(path)} | sources
    for name, source in sources.items():
        answer[name] = race_walks(source(), size)
        gc.collect()
        dr.flush_malloc_cache()
    return answer


LEAST_SHARE = 0.1
"""Share of voxels above 0 from which the dense peer also walks every cell; below, that takes many times as long."""

DENSE, EVERY_CELL = "dense", "dense, every cell"
"""Names of the walks of a dense grid: as planned, and without a look for empty blocks."""


def race_walks(volume: SparseVolumeData, size: SparseSize) -> dict:
    """Rates [rays/s] of camera rays, in the order of the image and in random order, on the dense and on the sparse grid."""
    tensor, sparse = mi.TensorXf(volume.dense()), lattice_of(volume)
    share = np.count_nonzero(volume.values) / dr.width(tensor.array)
    lattices = {DENSE: plan_walk(Lattice(tensor, TO_WORLD), bound_blocks(tensor) > 0), "sparse": sparse}
    is_sparse = is_worth_bricks(volume)
    if share > LEAST_SHARE or not is_sparse:
        lattices[EVERY_CELL] = Lattice(tensor, TO_WORLD)
    default = ("sparse", DENSE) if is_sparse else (DENSE, EVERY_CELL)
    coherent = camera_rays(size.side)
    answer: dict = {"bricks": len(volume.values), "share_above_0": share, "default": default[0]}
    for order, (o, d) in {"camera order": coherent, "random order": shuffle(*coherent)}.items():
        timings = race({name: depths(lattice, o, d) for name, lattice in lattices.items()}, size.rounds)
        rates = {name: size.side**2 * dr.thread_count() / min(t.processor) for name, t in timings.items()}
        dense = max(rate for name, rate in rates.items() if name != "sparse")
        default_gain = rates[default[0]] / rates[default[1]]
        answer[order] = rates | {"sparse over dense": rates["sparse"] / dense, "default over dense": default_gain}
    for ratio in ("sparse over dense", "default over dense"):
        answer[ratio] = math.sqrt(math.prod(answer[order][ratio] for order in ("camera order", "random order")))
    return answer


def plan_walk(lattice: Lattice, occupied: mi.Bool) -> Lattice:
    """The lattice whose walk skips empty blocks as a plan lets it, from whether each block is occupied."""
    skips, lattice.trims = find_skipping(float(dr.count(occupied)[0]) / dr.width(occupied), lattice.bricks is not None)
    if skips:
        lattice.empty_distances = find_distances_of_bounds(occupied, lattice.res)
    return lattice


def lattice_of(volume: SparseVolumeData) -> Lattice:
    """A sparse volume in the box [-1, 1]^3, whose walk skips empty blocks as planned."""
    bricks = Bricks.from_numbers(volume.shape, volume.offset, mi.UInt32(volume.numbers))
    bricks.distances = find_stored_distances(bricks)
    tensor = mi.TensorXf(np.ascontiguousarray(volume.values))
    return plan_walk(Lattice(tensor, TO_WORLD, bricks=bricks), find_occupied_blocks(tensor, bricks))


def depths(lattice: Lattice, o: mi.Point3f, d: mi.Vector3f) -> Contestant:
    """Contestant that integrates the optical depth of each ray."""
    return lambda _: integrate_tau(lattice, o, d)


# -- Memory and the first picture ------------------------------------------------------------------------------------------


def cloud_scene(grid: dict, side: int) -> dict:
    """A grid in the unit cube under a sun and a sky, seen from the ground."""
    to_world = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": side, "height": side, "component_format": "float32", "rfilter": {"type": "box"}}
    view = to_world().look_at([0.5, -1.05, 0.12], [0.5, 0.5, 0.4], [0, 0, 1])
    cloud = {"type": "heterogeneous", "sigma_t": grid, "albedo": 0.999, "phase": {"type": "hg", "g": 0.8}}
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 29, "to_world": view, "film": film, "sampler": {"type": "independent"}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.07, 0.17, 0.42]}},
        "sun": {
            "type": "directional",
            "direction": [0.8, 0.25, -0.55],
            "irradiance": {"type": "rgb", "value": [4.4, 3.9, 3.2]},
        },
        "cloud": {
            "type": "cube",
            "to_world": to_world().scale(0.5).translate(1),
            "bsdf": {"type": "null"},
            "interior": cloud,
        },
    }


OPTIMIZERS = {"fit": RMSprop(half=True), "fit by Adam": Adam()}

MEMORY_TASKS = ("medium", "gradient", *OPTIMIZERS)


def measure_memory(size: SparseSize) -> dict:
    """How much memory do the cloud, its density gradient and the fit need, and how long does its first picture take?"""
    with tempfile.TemporaryDirectory() as folder:
        paths = {"cloud": Path(folder) / "cloud.vdb", "one brick": Path(folder) / "one.vdb"}
        cloud = make_cumulus(size.cloud_res)
        write_volume(paths["cloud"], cloud)
        write_volume(paths["one brick"], SparseVolumeData(cloud.values[:1], np.zeros((1, 3), np.int32), (8, 8, 8), np.eye(4)))
        bricks, above = len(cloud.values), int(np.count_nonzero(cloud.values))
        del cloud
        runs = {}
        for name, path in paths.items():
            for task in MEMORY_TASKS:
                for _ in range(size.processes):
                    runs[name, task] = in_new_process(path, size.image_side, task)
    held = runs["cloud", "medium"]["held"]
    more = {task: runs["cloud", task]["peak"] - runs["one brick", task]["peak"] for task in MEMORY_TASKS}
    return {
        "bricks": bricks,
        "voxels_above_0": above,
        "bytes_of_voxels_above_0": 4 * above,
        "bytes_of_bricks": 4 * 512 * bricks,
        "held_bytes": held,
        "held_over_bricks": held["all"] / (4 * 512 * bricks),
        "held_over_voxels_above_0": held["all"] / (4 * above),
        "peak_bytes": more,
        "fit_over_medium": {task: more[task] / held["all"] for task in OPTIMIZERS},
        "first_picture": runs["cloud", "medium"]["seconds"],
    }


CHILD = "import json, sys; from mivol.bench.studies import sparse; print(json.dumps(sparse.measure_child(*sys.argv[1:])))"


def in_new_process(path: Path, side: int, task: str) -> dict:
    """:func:`measure_child` in a process of its own.

    Raises:
        MivolError: the process failed; the message ends with its last line.
    """
    child = run_child(CHILD, str(path), str(side), task, timeout=3600.0)
    if child.returncode:
        raise MivolError(f"the process that measures {task} failed: {(child.stderr.strip().splitlines() or ['killed'])[-1]}")
    return json.loads(child.stdout)


def measure_child(path: str, side: str, task: str) -> dict:
    """Times, arrays of the medium and peak memory of a picture of a file, or of a gradient or a fit at an edge of 64 pixels."""
    mi.set_variant("llvm_ad_rgb")
    start = time.process_time()
    grid = {"type": "mivol_voxels", "filename": path, "storage": "sparse"}
    scene = mi.load_dict(cloud_scene(grid, int(side) if task == "medium" else min(int(side), 64)))
    loaded = time.process_time()
    integrator = mi.load_dict({"type": "mivol", "max_depth": 6})
    if task == "medium":
        dr.eval(mi.render(scene, integrator=integrator, spp=1))
    elif task in OPTIMIZERS:
        view = View("view", scene.sensors()[0], mi.TensorXf(np.full((min(int(side), 64),) * 2 + (3,), 0.1, np.float32)))
        problem = SceneProblem(scene, [view], [Parameter(KEY, domain=(0.0, 1e4), lr=0.1)], spp=1, integrator=integrator)
        fit = begin_fit(problem, OPTIMIZERS[task], Course(3))
        while not fit.is_done:
            fit.advance()
    else:
        params = mi.traverse(scene)
        dr.enable_grad(params[KEY])
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))
        dr.eval(dr.grad(params[KEY]))
    dr.sync_thread()
    seconds = {"load": loaded - start, "picture": time.process_time() - loaded, "both": time.process_time() - start}
    voxels = find_children(scene.shapes()[0].interior_medium())["sigma_t"]
    # The parameter ``bricks`` shares the memory of ``stored``.
    arrays = {name: getattr(voxels, name) for name in ("data", "table", "distances", "stored")}
    held = {name: byte_count(array) for name, array in arrays.items()}
    return {"seconds": seconds, "held": held | {"all": sum(held.values())}, "peak": peak_memory()}


def byte_count(array: object) -> int:
    """Bytes of the values of an array or tensor."""
    flat = array.array if hasattr(array, "array") and dr.is_tensor_v(array) else array
    return dr.width(flat) * dr.itemsize_v(type(flat))


# -- Pictures ---------------------------------------------------------------------------------------------------------------


def measure_picture(size: SparseSize) -> dict:
    """How much sooner has a picture of the cloud the same error as one of ``volpath`` on the dense grid?"""
    cloud = make_cumulus(size.cloud_res)
    sparse = {"type": "mivol_voxels", "data": mi.TensorXf(cloud.values), "bricks": mi.UInt32(cloud.numbers)}
    sparse |= {"resolution": list(cloud.shape[::-1])}
    dense = {"type": "gridvolume", "grid": mi.VolumeGrid(cloud.dense()), "raw": True}
    dense_bytes = cloud.dense_bytes
    del cloud
    grids, methods = {"mivol": sparse, "volpath": dense}, {}
    for (name, grid), spp in zip(grids.items(), size.image_spp, strict=True):
        scene = mi.load_dict(cloud_scene(grid, size.image_side))
        render = render_method(scene, mi.load_dict({"type": name, "max_depth": 6, "rr_depth": 64}))
        methods[name] = lambda seed, _, render=render, spp=spp: render(seed, spp)
    contest = compete(methods, size.image_rounds, 0.0, 1)
    counts = np.ones((size.image_side,) * 2, bool)
    answer: dict = {name: image_errors(contest, name, 1, counts) for name in methods}
    for name, spp in zip(methods, size.image_spp, strict=True):
        answer[name]["spp"] = spp
    gains = gain_figures(contest, "volpath", "mivol", counts) | agreement_figures(contest, "volpath", "mivol", counts, 1)
    # Pixels of the sky alone have no noise by mivol, and an infinite ratio.
    gains = {name: None if value is None else finite_or_none(value) for name, value in gains.items()}
    return answer | {"dense_grid_bytes": dense_bytes, "peak_bytes_of_the_process": peak_memory(), "mivol over volpath": gains}


# -- Fits -------------------------------------------------------------------------------------------------------------------


def measure_fit(size: SparseSize) -> dict:
    """How large are time and memory of a fit whose bricks appear and vanish, over time and memory of the dense fit?"""
    truth = smoke_puff(size.fit_res)
    views = views_of(truth, size)
    start = SparseVolumeData.from_dense(np.where(smoke_puff(size.fit_res, 0.6) > 0, np.float32(1), np.float32(0)))
    grids = {
        "dense": {"type": "mivol_voxels", "data": mi.TensorXf(start.dense()), "storage": "dense"},
        "sparse": {
            "type": "mivol_voxels",
            "data": mi.TensorXf(start.values),
            "bricks": mi.UInt32(start.numbers),
            "resolution": [size.fit_res] * 3,
        },
    }
    answer: dict = {"share_above_0": float(np.count_nonzero(truth) / truth.size), "bricks_of_truth": count_held(truth)}
    for name, grid in grids.items():
        answer[name] = run_fit(name, grid, views, truth, size)
        gc.collect()
        dr.flush_malloc_cache()
    sparse, dense = answer["sparse"], answer["dense"]
    answer["time"] = sparse["processor_seconds_per_step"] / dense["processor_seconds_per_step"]
    answer["memory"] = sparse["peak_bytes"] / dense["peak_bytes"]
    answer["volume_error"] = sparse["volume_error"] / dense["volume_error"]
    return answer


def smoke_puff(res: int, thick: float = 1.0) -> np.ndarray:
    """A smoke (Z, Y, X, 1) along a curl, in 5 % of the box; ``thick`` is a factor on its radius."""
    z, y, x = np.meshgrid(*[(np.arange(res, dtype=np.float32) + 0.5) / res] * 3, indexing="ij", sparse=True)
    away = np.hypot(x - 0.5 - 0.15 * np.cos(7 * z), y - 0.5 - 0.15 * np.sin(7 * z))
    inside = thick * (0.09 + 0.07 * z) - away + 0.012 * np.sin(40 * x) * np.sin(40 * y) * np.sin(40 * z)
    inside = np.where((z > 0.1) & (z < 0.9), inside, np.float32(-1))
    return np.clip(160 * inside, 0, 8)[..., None].astype(np.float32)


def count_held(values: np.ndarray) -> int:
    """Number of bricks with a value other than 0."""
    return len(SparseVolumeData.from_dense(values).values)


def fit_scene(grid: dict) -> mi.Scene:
    """An absorbing smoke in [-1, 1]^3 in front of a white sky."""
    smoke = {"type": "mivol_medium", "sigma_t": grid | {"to_world": mi.ScalarTransform4f(np.float32(TO_WORLD))}, "albedo": 0.0}
    cube = {"type": "cube", "bsdf": {"type": "null"}, "interior": smoke}
    return mi.load_dict({"type": "scene", "integrator": {"type": "mivol"}, "sky": {"type": "constant"}, "cloud": cube})


def views_of(truth: np.ndarray, size: SparseSize) -> list[View]:
    """Views from a ring of cameras."""
    scene = fit_scene({"type": "mivol_voxels", "data": mi.TensorXf(truth)})
    film = {"type": "hdrfilm", "width": size.fit_side, "height": size.fit_side, "component_format": "float32"}
    views = []
    for k in range(size.fit_views):
        angle = 2 * np.pi * k / size.fit_views
        place = mi.ScalarTransform4f().look_at([4 * np.cos(angle), 4 * np.sin(angle), 1], [0, 0, 0], [0, 0, 1])
        given = {"film": film | {"rfilter": {"type": "box"}}}
        sensor = mi.load_dict({"type": "perspective", "fov": 36, "to_world": place, **given})
        views.append(View(f"view {k}", sensor, mi.TensorXf(mi.render(scene, sensor=sensor, spp=16, seed=100 + k))))
    return views


def run_fit(name: str, grid: dict, views: list[View], truth: np.ndarray, size: SparseSize) -> dict:
    """Steps of a fit: processor time of a step without the first two, peak memory, and the errors at the end.

    The error of the volume is the root mean square of its difference from the truth, over that of the truth.
    """
    scene = fit_scene(grid)
    problem = SceneProblem(scene, views, [Parameter(KEY, domain=(0.0, 50.0), lr=0.3)], spp=4)
    steps = size.fit_steps if name == "sparse" else size.fit_dense_steps
    events = (AdaptBricks(every=size.fit_every, threshold=0.02),) if name == "sparse" else ()
    stamps = [time.process_time()]
    answer: dict = {"steps": steps}

    def run() -> None:
        fit = begin_fit(problem, Adam(), Course(steps, events=events))
        while not fit.is_done:
            fit.advance()
            stamps.append(time.process_time())
        answer["log"] = [line for line in fit.log if "bricks" in line]
        answer["loss"] = float(problem.loss_value(fit.run.reals, 0))

    answer["peak_bytes"] = peak_bytes(run)
    seconds = np.diff(stamps)
    answer["processor_seconds_per_step"] = float(np.mean(seconds[2:] if len(seconds) > 3 else seconds[-1:]))
    voxels = find_children(scene.shapes()[0].interior_medium())["sigma_t"].field
    fitted = np.array(voxels.tensor) if voxels.bricks is None else voxels.volume().dense()
    answer["volume_error"] = float(np.linalg.norm(fitted - truth) / np.linalg.norm(truth))
    if name == "sparse":
        answer["bricks"] = len(problem.brick_numbers(KEY))
    return answer


# -- Bars and table ---------------------------------------------------------------------------------------------------------


def compare(question: str, answer: dict) -> list[Bar]:
    """Judge the agreement of the means of the pictures."""
    if question != "picture":
        return []
    figures = answer["mivol over volpath"]
    return [judge_agreement("picture of the cloud", figures["z"], figures["z_bound"])]


PROMISES = {
    "read": [Promise("smoke.vdb read [s]", ("processor_seconds",), AT_MOST, 0.3)],
    "walk": [
        Promise("walk in the smoke, default over dense", ("smoke", "default over dense"), AT_LEAST, 1.0),
        Promise("walk in threads [M rays/s]", ("threads", "camera order", "sparse"), AT_LEAST, 7.4, 1e-6),
    ],
    "memory": [
        Promise("cloud, arrays of the medium [MB]", ("held_bytes", "all"), AT_MOST, 250, 1e-6),
        Promise("cloud, peak of its gradient [MB]", ("peak_bytes", "gradient"), AT_MOST, 900, 1e-6),
        Promise("peak of a fit over the arrays of the medium", ("fit_over_medium", "fit"), AT_MOST, 5),
        Promise("arrays of the medium over its bricks", ("held_over_bricks",), AT_MOST, 1.02),
        Promise("first picture [s]", ("first_picture", "both"), AT_MOST, 3),
    ],
    "picture": [Promise("picture over volpath", ("mivol over volpath", "variance_x_time_mean_over_pixels"), AT_LEAST, 10)],
    "fit": [
        Promise("time of a fit over the dense fit", ("time",), AT_MOST, 0.5),
        Promise("memory of a fit over the dense fit", ("memory",), AT_MOST, 0.3),
    ],
}


def tabulate(question: str, answer: dict) -> list[str]:
    """Rows of the figures of an answer."""
    if "skipped" in answer:
        return [f"| {question} | skipped: {answer['skipped']} |"]
    if question != "walk":
        return []
    lines = ["| M rays/s, camera / random order | every cell | dense | sparse | sparse over dense |", "|---|---|---|---|---|"]
    for name, row in answer.items():
        if "skipped" in row:
            lines.append(f"| {name} | skipped: {row['skipped']} | | | |")
            continue
        orders = [row["camera order"], row["random order"]]
        ways = (EVERY_CELL, DENSE, "sparse")
        rates = [" / ".join(f"{o[way] / 1e6:.2f}" for o in orders if way in o) for way in ways]
        ratios = " / ".join(f"{o['sparse over dense']:.2f}" for o in orders)
        lines.append(f"| {name} | {' | '.join(rates)} | {ratios} |")
    return lines


QUESTIONS = {
    "read": measure_read,
    "walk": measure_walk,
    "memory": measure_memory,
    "picture": measure_picture,
    "fit": measure_fit,
}
STUDY = Study(__name__, __doc__, SparseSize, QUESTIONS, compare, table=tabulate, promises=PROMISES)
