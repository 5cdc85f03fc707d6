"""Fits on a cluster: which parts of each kind of fit the workers compute.

Conventions. Steps of scenes and of photographs are sums over views; a scan has products with A and its transpose, sums over
blocks of views. Everything else of a run stays in the owner's process.
"""

from __future__ import annotations

from collections.abc import Callable

from mivol.cluster.packages import share_scene
from mivol.cluster.pool import Pool
from mivol.cluster.reference import ReferencePage, complete_on
from mivol.cluster.scene_steps import make_source, share_scene_problem
from mivol.cluster.steps import StepTimes, share_problem, share_projector
from mivol.experiments.fit_kind import FitKind
from mivol.experiments.scan_fit import ScanFit
from mivol.experiments.scene_fit import SceneFit
from mivol.optim.problem import Problem
from mivol.report.record import Table
from mivol.validate.reference import Complete


class ClusterDistribution:
    """A :class:`mivol.experiments.fit_kind.Distribution` over a pool.

    Attributes:
        pool: workers.
        show: receives the progress of references in a line.
        times: of the steps, once the fit has a problem.
    """

    def __init__(self, pool: Pool, show: Callable[[str], None] = lambda line: None) -> None:
        self.pool, self.show, self.times = pool, show, StepTimes()

    def make_problem(self, kind: FitKind) -> Problem:
        """The problem of a fit, whose steps workers compute.

        Raises:
            MivolError: inputs larger than half of the memory of a worker.
        """
        if isinstance(kind, SceneFit):
            problem = share_scene_problem(self.pool, kind)
            self.times = problem.steps.times
        elif isinstance(kind, ScanFit):
            kind.projector = share_projector(self.pool, kind.projector)
            self.times = kind.projector.steps.times
            problem = kind.make_problem()
        else:
            problem = kind.make_problem()
            self.times = share_problem(self.pool, problem).times
        return problem

    def complete_references(self, kind: SceneFit) -> Complete:
        """The function that renders the references of a fit to images of a scene, which show the truth if it is known; its page
        stands in the folder of the references."""
        key = getattr(kind.settings.truth, "key", "")
        values = {} if kind.truth is None else {key: kind.truth}
        scene = share_scene(self.pool, make_source(kind, values), kind.loaded)
        page = ReferencePage(self.pool, kind.context.folder / "references", f"References of {kind.settings.title}")
        return complete_on(self.pool, scene, self.show, page)

    def describe(self) -> str:
        """The workers and the time of a step, in a line; only the workers before the first step."""
        return ", ".join([self.pool.describe(), *([self.times.describe()] if self.times.steps else [])])

    def tables(self) -> list[Table]:
        """The workers and what they did."""
        return [self.pool.tabulate()]

    def notes(self) -> list[str]:
        """Where the fit ran, and what was lost."""
        count = len(self.pool.workers)
        where = f"{count} worker{'s' * (count != 1)} of a cluster computed the steps: {self.times.describe()}."
        return [where, *self.pool.describe_losses()]
