"""Whether a reconstruction stores a layer's rows or walks them anew in every product: counted beforehand, and said."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mivol import config
from mivol.errors import MivolError
from mivol.optim.projections.inversion import Inversion
from mivol.optim.projections.solvers import DIRECT
from mivol.report.record import PlanLine
from mivol.tomography.projector import Projector
from mivol.tomography.stored import bytes_to_store, is_worth_storing, store

BY_SUBSETS = ("sart", "os-sart")
"""Solvers that take many small products an iteration."""


@dataclass(frozen=True)
class Storage:
    """What was chosen.

    Attributes:
        is_stored: whether the rows of a layer are kept.
        line: the choice and its reason.
    """

    is_stored: bool
    line: PlanLine

    def apply(self, problem: Inversion) -> None:
        """Give the solver's problem the operator that was chosen."""
        if self.is_stored:
            problem.linear_problem = replace(problem.linear_problem, A=store(problem.linear_problem.A))


def choose_storage(wanted: config.Solve, walk: Projector) -> Storage:
    """Count, and choose; nothing is stored yet.

    Args:
        wanted: its ``storage``, ``memory``, solver and iterations.
        walk: of the views that are fitted.

    Raises:
        MivolError: stored rows were asked for that the solver does not read, do not exist, or need more memory than is allowed.
    """
    if wanted.storage == "walk":
        return walked("as asked for")
    if wanted.name in DIRECT:
        return refused(wanted, f"{wanted.name} takes one step, without a matrix")
    size = bytes_to_store(walk)
    if size is None:
        return refused(wanted, "only the rays of a parallel beam, or of a fan of one row, lie in layers that share a matrix")
    rows, said = walk.projection_shape[1], f"{size / 2**20:.3g} MiB, of at most {wanted.memory:.3g} GiB"
    if size > wanted.memory * 2**30:
        return refused(wanted, f"the rows of a layer take {said} (solve.memory)")
    if wanted.storage == "auto" and not is_worth_storing(rows, wanted.iterations, wanted.name in BY_SUBSETS):
        return walked(f"{wanted.iterations} iterations on {rows} rows of the detector do not pay for storing {said}")
    shared = "" if rows == 1 else f", shared by the {rows} rows of the detector"
    return Storage(True, PlanLine(choice="storage: the exact integrals of a layer, kept as sparse rows", reason=said + shared))


def walked(reason: str) -> Storage:
    """Nothing is stored."""
    return Storage(False, PlanLine(choice="storage: none, each product walks through the grid", reason=reason))


def refused(wanted: config.Solve, reason: str) -> Storage:
    """A walk, unless stored rows were asked for by name.

    Raises:
        MivolError: they were.
    """
    if wanted.storage == "matrix":
        raise MivolError(f"solve.storage = matrix cannot be had: {reason}: choose auto or walk.")
    return walked(reason)
