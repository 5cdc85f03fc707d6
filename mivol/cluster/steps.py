"""Steps of a fit over the workers of a cluster: parts of a step as work, and their sum.

Conventions. The owner has the whole problem, and takes the steps. A worker has a *twin*: what it needs to compute parts, made
once from an input. A step sends each worker the arrays of the step and the parts to compute. The worker adds their results, and
the owner adds the sums of the workers, in float64 (:func:`mivol.optim.problem.add_parts`). A part is the same wherever it is
computed, so the result does not depend on the number of workers, on their order, or on a lost one.

Twins of photographs and of projectors are here, twins of scenes in :mod:`mivol.cluster.distribution`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import itertools
import pickle
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.cluster.pool import Pool, Unit
from mivol.cluster.workplace import Workplace
from mivol.errors import MivolError
from mivol.optim.problem import DividedProblem, Part, Reals, add_parts, to_arrays, to_tensors
from mivol.tomography.projector import CACHE_BYTES, RAY_BYTES, Projector
from mivol.tomography.stored import store_matrix

Arrays = dict[str, np.ndarray]


class Twin(Protocol):
    """What computes parts in a worker."""

    def take_state(self, state: dict[str, Any]) -> None:
        """Continue from another state of the owner's problem."""

    def compute(self, what: str, arrays: Sequence[Arrays], parts: Sequence[Part]) -> Arrays:
        """Sum of the results of some parts.

        Args:
            what: kind of result, a word of the twin.
            arrays: of the step, the same for all parts.
            parts: plain Python and NumPy.
        """


# -- Objects with arrays of Dr.Jit -------------------------------------------------------------------------------------------


class _Pickler(pickle.Pickler):
    """Pickles arrays of Dr.Jit by their values."""

    def reducer_override(self, value: Any) -> Any:
        if not isinstance(value, type) and dr.is_array_v(value):
            return type(value), (np.array(value),)
        return NotImplemented


def to_bytes(value: Any) -> bytes:
    """An object of mivol's own classes, plain Python, NumPy and Dr.Jit, for workers of the same software."""
    file = io.BytesIO()
    _Pickler(file, protocol=5).dump(value)
    return file.getvalue()


# -- In the worker -----------------------------------------------------------------------------------------------------------


def compute_parts(
    place: Workplace, twin: str, state: str, what: str, arrays: Sequence[Arrays], parts: Sequence[Part]
) -> tuple[Arrays, float]:
    """Compute parts in a worker.

    Args:
        place: the worker.
        twin: content hash of the twin.
        state: content hash of the problem's state; empty without one.
        what, arrays, parts: as :meth:`Twin.compute`.

    Returns:
        Sum of the results, and the time of the computation [s].
    """
    used = place.made(f"twin {twin}", lambda: _make_twin(place, twin))
    start = time.monotonic()
    if state and place.kept.get(f"state {twin}") != state:
        used.take_state(pickle.loads(zlib.decompress(place.kept[state])))
        place.kept[f"state {twin}"] = state
    return used.compute(what, arrays, parts), time.monotonic() - start


def _make_twin(place: Workplace, digest: str) -> Twin:
    make, content = pickle.loads(zlib.decompress(place.kept[digest]))
    return make(place, content)


# -- In the owner ------------------------------------------------------------------------------------------------------------


@dataclass
class StepTimes:
    """Sums over the steps of a run [s].

    Attributes:
        steps: number of sums that workers computed.
        wall: time of the owner.
        computing: time of the slowest worker of each step.
        last: time of the owner beyond the slowest worker in the latest step.
    """

    steps: int = 0
    wall: float = 0.0
    computing: float = 0.0
    last: float = 0.0

    def add(self, wall: float, computing: float) -> None:
        """Add a step."""
        self.steps, self.wall, self.computing = self.steps + 1, self.wall + wall, self.computing + computing
        self.last = wall - computing

    def describe(self) -> str:
        """Mean time of a step in words."""
        wall, computing = (1e3 * value / max(self.steps, 1) for value in (self.wall, self.computing))
        return f"a step takes {wall:.3g} ms, {computing:.3g} of them on the slowest worker"


class Steps:
    """Computes parts of steps on workers.

    Attributes:
        pool: workers.
        twin: content hash of the twin.
        needs: content hashes of all inputs of the twin.
        times: of all steps.
    """

    def __init__(self, pool: Pool, make: Callable[[Workplace, Any], Twin], content: Any, needs: Sequence[str] = ()) -> None:
        """Register a twin as an input of work.

        Args:
            pool: workers.
            make: function of a module of mivol that makes the twin of a worker from ``content``.
            content: of the twin.
            needs: content hashes of other inputs that ``make`` reads.

        Raises:
            MivolError: inputs larger than half of the memory of a worker.
        """
        data = zlib.compress(to_bytes((make, content)), 1)
        self.pool, self.times, self.state = pool, StepTimes(), ""
        self.twin = pool.share(hashlib.sha256(data).hexdigest(), data, len(data))
        self.needs = (*needs, self.twin)
        self._known: dict[str, Any] = {}

    def compute(
        self,
        what: str,
        arrays: Sequence[Mapping[str, np.ndarray]],
        parts: Sequence[Part],
        check: Callable[[], None] = lambda: None,
    ) -> Arrays:
        """Sum of the results of all parts.

        Args:
            what, arrays, parts: as :meth:`Twin.compute`.
            check: called while waiting; may raise.

        Raises:
            MivolError: arrays that would fill a worker, a refusal of a worker, or as :meth:`mivol.cluster.pool.Pool.run`.
        """
        self.pool.check_room(sum(value.nbytes for group in arrays for value in group.values()))
        start, count = time.monotonic(), min(len(parts), max(1, len(self.pool.workers)))
        needs = (*self.needs, self.state) if self.state else self.needs
        units = [
            Unit(number, compute_parts, (self.twin, self.state, what, arrays, parts[number::count]), needs)
            for number in range(count)
        ]
        answers = dict(self.pool.run(units, ahead=1, check=check))
        total: Arrays = {}
        for number in sorted(answers):
            add_parts(total, answers[number][0])
        self.times.add(time.monotonic() - start, max(seconds for _, seconds in answers.values()))
        return total

    def divide(self, problem: DividedProblem, reals: Reals, parts: Sequence[Part]) -> Arrays:
        """As :data:`mivol.optim.problem.Divide`."""
        self.share_state(problem.step_state())
        return self.compute("gradient", [to_arrays(reals)], parts, lambda: problem.safe_point())

    def share_state(self, state: dict[str, Any]) -> None:
        """Register the state of the problem as an input, if it is another one than before."""
        if _is_same(state, self._known):
            return
        data, self._known = zlib.compress(to_bytes(state), 1), state
        digest = hashlib.sha256(self.twin.encode() + data).hexdigest()
        if self.state and self.state != digest:
            self.pool.forget(self.state)
        self.state = self.pool.share(digest, data, len(data))


def _is_same(state: dict[str, Any], known: dict[str, Any]) -> bool:
    """Whether two states have the same objects, or equal numbers."""
    plain = int, float, str
    return state.keys() == known.keys() and all(
        value is known[name] or (isinstance(value, plain) and value == known[name]) for name, value in state.items()
    )


# -- Photographs -------------------------------------------------------------------------------------------------------------


class ProblemTwin:
    """A problem of photographs in a worker."""

    def __init__(self, problem: DividedProblem) -> None:
        self.problem = problem

    def take_state(self, state: dict[str, Any]) -> None:
        self.problem.take_step_state(state)

    def compute(self, what: str, arrays: Sequence[Arrays], parts: Sequence[Part]) -> Arrays:
        reals, total = to_tensors(arrays[0]), {}
        for part in parts:
            add_parts(total, to_arrays(self.problem.compute_part(reals, *part)))
        return total


def make_problem_twin(place: Workplace, content: tuple[type[DividedProblem], dict[str, Any]]) -> ProblemTwin:
    """The twin of a problem from its class and the fields of the class."""
    make, fields = content
    return ProblemTwin(make(**fields))


def share_problem(pool: Pool, problem: DividedProblem) -> Steps:
    """Let workers compute the steps of a problem of photographs.

    Raises:
        MivolError: photographs larger than half of the memory of a worker.
    """
    given = {one.name: getattr(problem, one.name) for one in dataclasses.fields(problem) if one.init}
    fields = {name: value for name, value in given.items() if value is not None and not callable(value)}
    steps = Steps(pool, make_problem_twin, (type(problem), fields))
    problem.divide = steps.divide
    return steps


# -- Projections -------------------------------------------------------------------------------------------------------------

BLOCK_CELLS = 1 << 25
"""Cells crossed by the rays of a block of views, about: some 50 ms of a core."""

MOST_BLOCKS = 64
"""Blocks of a product at most."""


def make_view_blocks(projector: Projector) -> list[slice]:
    """Blocks of neighbouring views of a product, a function of the scan only; two blocks at least."""
    cells = projector.shape[0] * sum(projector.grid.shape)
    count = min(max(2, min(-(-cells // BLOCK_CELLS), MOST_BLOCKS)), projector.n_views)
    ends = np.linspace(0, projector.n_views, count + 1).astype(int).tolist()
    return [slice(first, end) for first, end in itertools.pairwise(ends)]


PROJECT, BACKPROJECT = "project", "backproject"


class ProjectorTwin:
    """The rays of a scan in a worker, by blocks of views."""

    def __init__(self, projector: Projector) -> None:
        self.projector = projector
        self.blocks: dict[tuple[bytes, bool], Projector] = {}

    def take_state(self, state: dict[str, Any]) -> None:
        raise MivolError("a projector has no state.")

    def compute(self, what: str, arrays: Sequence[Arrays], parts: Sequence[Part]) -> Arrays:
        total: Arrays = {}
        for name, views, is_stored, *y in parts:
            block = self._open_block(views, is_stored)
            if what == PROJECT:
                total[name] = block @ arrays[0]["x"]
            else:
                add_parts(total, {"x": block.T @ y[0]})
        return total

    def _open_block(self, views: np.ndarray, is_stored: bool) -> Projector:
        """The rays of some views; blocks of at most ``CACHE_BYTES`` are kept."""
        key = views.tobytes(), is_stored
        if key not in self.blocks:
            block = self.projector.subset(views)
            if RAY_BYTES * (block.shape[0] + sum(known.shape[0] for known in self.blocks.values())) > CACHE_BYTES:
                self.blocks.clear()
            self.blocks[key] = store_matrix(block) if is_stored else block
        return self.blocks[key]


def make_projector_twin(place: Workplace, content: dict[str, Any]) -> ProjectorTwin:
    """The twin of a projector from its geometry and grid."""
    return ProjectorTwin(Projector(content["geometry"], content["grid"]))


class SharedProjector(Projector):
    """The operators of a :class:`~mivol.tomography.projector.Projector`, computed by workers in blocks of views."""

    def __init__(self, walk: Projector, steps: Steps, is_stored: bool = False) -> None:
        """Share the rays of a projector.

        Args:
            walk: the projector.
            steps: from :func:`share_projector`.
            is_stored: whether workers store the rows of their blocks.
        """
        super().__init__(walk.geometry, walk.grid, walk.views, walk._kernels)
        self.steps, self.is_stored = steps, is_stored

    def subset(self, views: Sequence[int] | np.ndarray) -> SharedProjector:
        """Select the rows of some views, counted among this projector's own."""
        return SharedProjector(super().subset(views), self.steps, self.is_stored)

    def _project_array(self, x: np.ndarray) -> np.ndarray:
        blocks = make_view_blocks(self)
        parts = [(f"{number:04d}", self.views[block], self.is_stored) for number, block in enumerate(blocks)]
        found = self.steps.compute(PROJECT, [{"x": x}], parts, self.safe_point)
        return np.concatenate([found[name] for name, *_ in parts])

    def _backproject_array(self, y: np.ndarray) -> np.ndarray:
        rows = y.reshape(self.n_views, -1)
        parts = [("", self.views[block], self.is_stored, rows[block].reshape(-1)) for block in make_view_blocks(self)]
        return self.steps.compute(BACKPROJECT, [], parts, self.safe_point)["x"].astype(np.float32)

    def safe_point(self) -> None:
        """Products are not interrupted; a fit asks between its iterations."""

    def _project(self, values: mi.Float) -> mi.Float:
        return mi.Float(self._project_array(np.array(values)))

    def _backproject(self, y: mi.Float) -> mi.Float:
        return mi.Float(self._backproject_array(np.array(y)))


@store_matrix.register
def _(projector: SharedProjector) -> SharedProjector:
    """Let the workers store the rows of their blocks."""
    return SharedProjector(projector, projector.steps, is_stored=True)


def share_projector(pool: Pool, projector: Projector) -> SharedProjector:
    """Let workers compute the products of a projector.

    Raises:
        MivolError: rays of the caller's own class, which workers do not have, or larger than half of the memory of a worker.
    """
    if not type(projector.geometry).__module__.startswith("mivol."):
        raise MivolError(
            f"the rays are a {type(projector.geometry).__name__} of this process, which workers cannot make: give a "
            "ParallelBeam, a ConeBeam or PencilRays."
        )
    content = {"geometry": projector.geometry, "grid": projector.grid}
    return SharedProjector(projector, Steps(pool, make_projector_twin, content))
