"""The cost of a cluster: time of two workers over one process, overhead of a step, and a model for up to 1,000 workers?

    mivol bench cluster

Two local workers of one thread alternate with one process of one thread, on this machine. The machine may be busy, and time is
processor time: for streaming units the time of the slowest worker, and at least half of the total (two cores); for steps the
times of the slowest worker and of the owner, added. A model of the time is fitted to these figures: larger workloads scale them
by views, pixels and voxels.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mivol import config
from mivol.back_end import choose_back_end
from mivol.bench.harness.study import AT_MOST, Promise, Size, Study, amount
from mivol.bench.studies.cluster_kills import write_experiments
from mivol.cluster.connection import open_pool
from mivol.cluster.distribution import ClusterDistribution
from mivol.cluster.packages import SceneSource, share_scene
from mivol.cluster.pool import Pool, Unit
from mivol.cluster.reference import complete_on
from mivol.cluster.steps import Steps
from mivol.cluster.workplace import Workplace
from mivol.experiments.examples import copy_example
from mivol.experiments.field_fit import FieldFit
from mivol.experiments.fit_kind import RunContext
from mivol.experiments.run_folder import RunFolder
from mivol.experiments.scene_fit import SceneFit
from mivol.optim.problem import to_arrays
from mivol.scene.load import load_scene
from mivol.scene.sensors import Ring
from mivol.validate.reference import render_photographs

# -- A model of the time ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Workload:
    """The work of a step or a reference.

    Attributes:
        name: for tables.
        units: number of units of work, B.
        unit_seconds: time of a unit on a worker [s], t.
        message_bytes: bytes to and from a worker in a step, or of a unit that streams, S.
        owner_seconds: time of the owner alone [s], s.
        streams: whether units follow each other without a common step.
    """

    name: str
    units: int
    unit_seconds: float
    message_bytes: float
    owner_seconds: float = 0.0
    streams: bool = False


@dataclass(frozen=True)
class Connection:
    """Connection of the owner.

    Attributes:
        latency: time of a message to a worker and its answer [s], l.
        bandwidth: [bytes/s], b.
    """

    latency: float
    bandwidth: float

    def message_seconds(self, size: float) -> float:
        """Time of a message of this size with its answer [s]."""
        return self.latency + size / self.bandwidth


def step_seconds(work: Workload, network: Connection, workers: int) -> float:
    r"""T(W) [s]: time of a step, or of all units that stream.

    The owner has one network connection: it sends each worker the inputs of a step and receives its answer, one after another.
    Workers compute at the same time. With B units of work of t seconds, W workers (at most B have work), S bytes to and
    from a worker, latency l and bandwidth b, and s seconds of the owner alone,

    .. math:: T(W) = s + \lceil B/W \rceil\, t + W\,(l + S/b).

    The smallest time is near :math:`W = \sqrt{B t / (l + S/b)}`. If units stream (batches of references need no common step),
    messages overlap with the work, and the larger of both counts:

    .. math:: T(W) = s + \max(\lceil B/W \rceil\, t,\; B\,(l + S/b)).

    Args:
        work: the workload.
        network: the owner's connection.
        workers: W, 1 or more.
    """
    active = min(workers, work.units)
    compute = math.ceil(work.units / active) * work.unit_seconds
    message = network.message_seconds(work.message_bytes)
    if work.streams:
        return work.owner_seconds + max(compute, work.units * message)
    return work.owner_seconds + compute + active * message


def best_workers(work: Workload, network: Connection) -> int:
    """The smallest number of workers with the smallest time."""
    return min(range(1, work.units + 1), key=lambda workers: (step_seconds(work, network, workers), workers))


def say_limit(work: Workload, network: Connection) -> str:
    """The limit of the scaling, in words."""
    best = best_workers(work, network)
    message = network.message_seconds(work.message_bytes)
    if work.streams and work.units * message >= math.ceil(work.units / best) * work.unit_seconds:
        return f"{best} workers: the owner receives images one after another"
    if best == work.units:
        return f"{best} workers: no more pieces of work"
    if math.ceil(work.units / best) == 1:
        return f"{best} workers: a unit is not divided"
    share = "bytes" if work.message_bytes / network.bandwidth > network.latency else "latency"
    return f"{best} workers: {share} of the messages, one worker after another"


# -- Measurements -------------------------------------------------------------------------------------------------------------

WORKERS = (1, 2, 4, 8, 16, 32, 100, 1000)


@dataclass(frozen=True)
class ClusterSize(Size):
    """Amount of work."""

    views: int = amount(16, 2, doc="views")
    side: int = amount(128, 16, doc="edge of a reference [pixel]")
    spp: int = amount(64, 32, doc="samples a pixel of a reference")
    fit_spp: int = amount(64, 2, doc="samples a pixel of a step")
    rounds: int = amount(3, 1, doc="rounds of one process and two workers in turn")


def worker_seconds(pool: Pool) -> np.ndarray:
    """Processor time of each worker [s]."""
    ticks = []
    for worker in pool.workers.values():
        fields = Path(f"/proc/{worker.facts.pid}/stat").read_text().rpartition(")")[2].split()
        ticks.append(int(fields[11]) + int(fields[12]))
    return np.array(ticks) / 100.0


def measure(pool: Pool, run: Callable[[], object]) -> dict[str, Any]:
    """Processor time of the workers and of this process, and wall time, during a call [s]."""
    workers, owner, wall = worker_seconds(pool), time.process_time(), time.perf_counter()
    run()
    wall = time.perf_counter() - wall
    return {"wall": wall, "owner": time.process_time() - owner, "workers": (worker_seconds(pool) - workers).tolist()}


@contextlib.contextmanager
def two_workers() -> Iterator[tuple[Pool, Path]]:
    """Two workers of one thread, this process with one thread, and a copy of the example demo."""
    choose_back_end("llvm_ad_rgb", 1)
    with tempfile.TemporaryDirectory() as folder, open_pool("local:2", threads=1, say=lambda line: None) as pool:
        copy_example("demo", Path(folder) / "demo")
        yield pool, Path(folder) / "demo"


def measure_reference(size: ClusterSize) -> dict:
    """Time of the references of all views by two workers over one process."""
    found = []
    with two_workers() as (pool, folder):
        path = folder / "scene.xml"
        loaded = load_scene(path, {})
        looks = Ring(count=size.views, width=size.side, height=size.side).sensors(loaded.scene)
        options = {"sensors": looks, "max_depth": 6, "max_spp": size.spp}
        complete = complete_on(pool, share_scene(pool, SceneSource(path), loaded))
        for number in range(size.rounds + 1):  # the first compiles kernels
            alone = measure(pool, lambda n=number: render_photographs(loaded, folder / f"one{n}", progress=False, **options))
            both = measure(pool, lambda n=number: render_photographs(loaded, folder / f"two{n}", complete=complete, **options))
            slowest = max(max(both["workers"]), (sum(both["workers"]) + both["owner"]) / 2)
            share = {"owner": both["owner"] / alone["owner"], "workers": sum(both["workers"]) / alone["owner"]}
            uneven = max(both["workers"]) / (sum(both["workers"]) / 2)
            row = {"one": alone["owner"], "two": slowest, "wall": [alone["wall"], both["wall"]]}
            found.append(row | share | {"ratio": slowest / alone["owner"], "uneven": uneven})
    found = found[1:]
    return {"rounds": found} | {
        name: float(np.median([row[name] for row in found])) for name in ("ratio", "owner", "workers", "uneven")
    }


def measure_gradient(size: ClusterSize) -> dict:
    """Time of a gradient over all views at depth 6 by two workers over one process."""
    found = []
    with two_workers() as (pool, folder):
        changes = [
            f"views.count={size.views}", "reference.spp=32", "reference.held_out=[]", "threads=1", f"fit.spp={size.fit_spp}",
            'optimizer={name="adam"}', "event=[]",
        ]  # fmt: skip
        settings = config.load(folder / "fit.toml", changes)
        workers = ClusterDistribution(pool)
        kind = SceneFit(RunContext(settings, folder, folder / "run", distribution=workers))
        kind.load(lambda line: None)
        kind.render_data(RunFolder(folder / "run", kind.record))
        alone, shared = kind.make_problem(), workers.make_problem(kind)
        reals = alone.initial_reals()
        for number in range(size.rounds + 3):  # kernels are compiled, then recorded
            one = measure(pool, lambda n=number: alone.loss_and_gradient(reals, n))
            two = measure(pool, lambda n=number: shared.loss_and_gradient(reals, n))
            row = {"one": one["owner"], "two": max(two["workers"]) + two["owner"], "wall": [one["wall"], two["wall"]]}
            found.append(row | {"owner": two["owner"], "blocks": len(shared.batches)})
    found = found[3:]
    answer = {name: float(np.median([row[name] for row in found])) for name in ("one", "two", "owner")}
    return answer | {"rounds": found, "ratio": answer["two"] / answer["one"], "blocks": found[0]["blocks"]}


def echo(place: Workplace, arrays: np.ndarray) -> np.ndarray:
    """Answer with as many bytes as came."""
    return np.asarray(arrays)


def measure_messages(size: ClusterSize) -> dict:
    """Overhead of a step: a message to each of two workers and its answer, by size."""
    found = {}
    with two_workers() as (pool, _):
        for count in (1 << 10, 1 << 18, 1 << 20):
            array, times = np.zeros(count, np.float32), []
            for _ in range(6 * size.rounds):
                start = time.perf_counter()
                list(pool.run([Unit(part, echo, (array,)) for part in range(2)], ahead=1))
                times.append(time.perf_counter() - start)
            found[4 * count] = {"median": float(np.median(times)), "fastest": min(times)}
    small, large = found[4 << 10]["fastest"] / 2, found[4 << 20]["fastest"] / 2
    bandwidth = 2 * (4 << 20) / (large - small)
    return {"seconds": found, "latency": small, "bandwidth": bandwidth}


def measure_photographs(size: ClusterSize) -> dict:
    """Time of a view in a step of a grid for photographs, and of the owner's part, in one process of one thread."""
    choose_back_end("llvm_ad_rgb", 1)
    with tempfile.TemporaryDirectory() as name:
        write_experiments(Path(name))
        changes = ['field.preset="cpu"', "field.longest=64", "field.degree=2"]
        settings = config.load(Path(name) / "grid.toml", changes)
        kind = FieldFit(RunContext(settings, Path(name), Path(name) / "run"))
        kind.load(lambda line: None)
        problem = kind.make_problem()
        reals, views = problem.initial_reals(), problem.plan.stages[0].views
        run, seconds = problem.plan.optimizer.begin(problem), {"view": [], "step": []}
        for iteration in range(2 * size.rounds + 1):  # the first compiles kernels
            start = time.process_time()
            to_arrays(problem.compute_part(reals, iteration, 0, (0,)))
            middle = time.process_time()
            run.step(iteration, 1.0)
            dr.eval(run.reals)
            dr.sync_thread()
            seconds["view"].append(middle - start)
            seconds["step"].append(time.process_time() - middle)
        view, step = (float(np.median(seconds[name][1:])) for name in ("view", "step"))
        numbers = sum(int(np.prod(value.shape)) for value in reals.values())
    return {"views": views, "numbers": numbers, "view": view, "step": step, "owner": max(step - views * view, 0.1 * step)}


STEP_SECONDS = 0.1
"""Time of the work of each worker in a step [s]."""


class WaitingTwin:
    """A twin whose part of a step takes a fixed time: a sleep, independent of other processes of the machine."""

    def take_state(self, state: dict[str, Any]) -> None:
        """Nothing: the time does not depend on a state."""

    def compute(self, what: str, arrays: Sequence[dict[str, np.ndarray]], parts: Sequence[tuple]) -> dict[str, np.ndarray]:
        """A gradient of the size of the reals, after the time of a step."""
        time.sleep(STEP_SECONDS)
        return {name: value.astype(np.float64) for name, value in arrays[0].items()}


def make_waiting_twin(place: Workplace, content: None) -> WaitingTwin:
    """The twin of a step of fixed time."""
    return WaitingTwin()


def measure_overhead(size: ClusterSize) -> dict:
    """What does a step of 100 ms of work on two workers take beyond that time, by the number of its reals?"""
    found = {}
    with two_workers() as (pool, _):
        for edge in (1, 40, 64):
            steps, rows = Steps(pool, make_waiting_twin, None), []
            reals = [{"sigma_t": np.zeros(edge**3, np.float32)}]
            for _ in range(7 * size.rounds):
                taken = measure(pool, lambda steps=steps, reals=reals: steps.compute("", reals, [(0,), (1,)]))
                rows.append({"overhead": steps.times.last, "processor": taken["owner"] + max(taken["workers"])})
            rows = rows[1:] or rows  # the first makes the twin
            found[f"{edge}^3"] = {
                "median": float(np.median([row["overhead"] for row in rows])),
                "fastest": min(row["overhead"] for row in rows),
                "processor": float(np.mean([row["processor"] for row in rows])),
            }
    return found


def measure_cluster(size: ClusterSize) -> dict:
    """Time of two workers over one process, overhead of a step, and the model of larger numbers of workers."""
    messages, gradient, reference = measure_messages(size), measure_gradient(size), measure_reference(size)
    photographs = measure_photographs(size)
    network = Connection(messages["latency"], messages["bandwidth"])
    rows = [
        {
            "name": load.name,
            "seconds": [step_seconds(load, network, workers) for workers in WORKERS],
            "limit": say_limit(load, network),
        }
        for load in make_workloads(size, gradient, reference, photographs)
    ]
    found = {"messages": messages, "gradient": gradient, "reference": reference, "photographs": photographs}
    return found | {"scaling": rows}


def make_workloads(size: ClusterSize, gradient: dict, reference: dict, photographs: dict) -> list[Workload]:
    """The measured workloads, and larger ones by views, pixels and voxels. A step sends float32 and returns float64."""
    path = float(np.median([row["one"] for row in reference["rounds"]])) / (size.views * size.side**2 * size.spp)
    block, blocks, owner = gradient["one"] / gradient["blocks"], gradient["blocks"], gradient["owner"]
    view = 16 * gradient["one"] / size.views
    batch = size.side**2 * size.spp / 32
    return [
        Workload(f"step of {size.views} views of 64^2 pixels, 40^3 voxels", blocks, block, 12 * 40**3, owner),
        Workload("step of 256 views of 256^2 pixels, 128^3 voxels", 256, view, 12 * 128**3, owner),
        Workload(f"step of {photographs['views']} photographs, a grid of {photographs['numbers']:,} numbers",
                 photographs["views"], photographs["view"], 12 * photographs["numbers"], photographs["owner"]),
        Workload(f"reference of {size.views} views of {size.side}^2 pixels", 32 * size.views, batch * path, 12 * size.side**2,
                 streams=True),
        Workload("reference of 64 views of 1024^2 pixels, 256 samples", 64 * 256, 2**20 * path, 12 * 1024**2, streams=True),
    ]  # fmt: skip


def table(question: str, answer: dict) -> list[str]:
    """Markdown lines of the answer."""
    if question == "overhead":
        return [
            f"a step of {1e3 * STEP_SECONDS:.0f} ms with {name} reals takes {1e3 * row['median']:.2g} ms more (median; fastest "
            f"{1e3 * row['fastest']:.2g} ms; processor time of owner and worker {1e3 * row['processor']:.2g} ms)"
            for name, row in answer.items()
        ]
    names = "reference", "gradient"
    lines = [f"{name}: two workers take {answer[name]['ratio']:.3f} of the time of one process" for name in names]
    split = answer["reference"]
    lines.append(
        f"reference: the workers take {split['workers']:.3f} of the time of one process together, the slower one "
        f"{split['uneven']:.3f} of their mean, and the owner {split['owner']:.3f}"
    )
    for size, taken in answer["messages"]["seconds"].items():
        median, fastest = 1e3 * taken["median"], 1e3 * taken["fastest"]
        lines.append(f"{size} bytes to two workers and back: median {median:.2g} ms, fastest {fastest:.2g} ms")
    latency, bandwidth = answer["messages"]["latency"], answer["messages"]["bandwidth"]
    lines += [f"latency {1e3 * latency:.2g} ms a worker, bandwidth {bandwidth / 1e6:.3g} MB/s", ""]
    lines += ["| workload | " + " | ".join(map(str, WORKERS)) + " | fastest |", "|---" * (len(WORKERS) + 2) + "|"]
    for row in answer["scaling"]:
        lines.append(f"| {row['name']} | " + " | ".join(f"{s:.3g}" for s in row["seconds"]) + f" | {row['limit']} |")
    return lines


PROMISES = {
    "cluster": [
        Promise("reference of all views, time over one process", ("reference", "ratio"), AT_MOST, 0.55),
        Promise("gradient over all views, time over one process", ("gradient", "ratio"), AT_MOST, 0.65),
    ],
    "overhead": [Promise("overhead of a step of 100 ms with 40^3 reals [ms]", ("40^3", "median"), AT_MOST, 15.0, 1e3)],
}

STUDY = Study(
    __name__, __doc__, ClusterSize, {"overhead": measure_overhead, "cluster": measure_cluster}, table=table, promises=PROMISES
)
