"""All solvers of line integrals by name: iterative ones for any operator with ``@`` and ``.T``, direct ones for scans."""

from __future__ import annotations

from mivol.optim.algebraic import check_sweeps, ordered_subsets_sart, sart, sirt
from mivol.optim.direct import check_fbp, check_fdk, fbp, fdk
from mivol.optim.linear_problems import LeastSquares, PoissonCounts
from mivol.optim.projected_cg import cgls, projected_cg
from mivol.optim.solver import Solver
from mivol.optim.transmission_likelihood import transmission_likelihood

#: Iterative methods by name. ``run(problem, state=None, **options)``.
SOLVERS: dict[str, Solver] = {
    "pcg": Solver(
        projected_cg,
        LeastSquares,
        needs="A and its exact transpose; weights, x >= 0 and a prior if wanted",
        promises="the objective never rises; without bounds and prior, the least error in the energy norm at each step",
        citation="Hestenes & Stiefel 1952; Polak & Ribiere 1969; Bertsekas 1982; preconditioner Erdogan & Fessler 1999",
    ),
    "cgls": Solver(
        cgls,
        LeastSquares,
        needs="A and its exact transpose",
        promises="the least residual over the Krylov space of each iteration; stopping early regularises",
        citation="Hestenes & Stiefel 1952; Paige & Saunders 1982",
    ),
    "sirt": Solver(
        sirt,
        LeastSquares,
        needs="A with entries >= 0 and its transpose",
        promises="converges to a least-squares solution weighted by 1 / (ray length)",
        citation="Gregor & Benson 2008",
        check=check_sweeps,
    ),
    "sart": Solver(
        sart,
        LeastSquares,
        needs="A with entries >= 0, its transpose, n_views and subset(views)",
        promises="the fastest first sweeps; a limit cycle on inconsistent data, which relaxation and decay shrink",
        citation="Andersen & Kak 1984",
        check=check_sweeps,
    ),
    "os-sart": Solver(
        ordered_subsets_sart,
        LeastSquares,
        needs="A with entries >= 0, its transpose, n_views and subset(views)",
        promises="n_subsets times SIRT's progress at first; a limit cycle on inconsistent data, which decay shrinks",
        citation="Andersen & Kak 1984; Wang & Jiang 2004",
        check=check_sweeps,
    ),
    "ml-tr": Solver(
        transmission_likelihood,
        PoissonCounts,
        needs="A with entries >= 0 and its transpose; counts, blank and background in quanta",
        promises="the negative log-likelihood never rises; x >= 0; no logarithm of a count is taken",
        citation="Nuyts et al. 1998; Erdogan & Fessler 1999",
    ),
}

#: Methods of one step. ``run(problem, state=None, window=..., cutoff=...)``; the problem's operator is a projector.
DIRECT: dict[str, Solver] = {
    "fbp": Solver(
        fbp,
        LeastSquares,
        needs="a parallel beam over half a turn or more",
        promises="exact for many views without noise; linear, so that values below 0 stay",
        citation="Kak & Slaney 1988, section 3.3",
        check=check_fbp,
    ),
    "fdk": Solver(
        fdk,
        LeastSquares,
        needs="a cone beam on a circle, over half a turn and the fan or more",
        promises="exact in the source's plane for many views without noise; linear, so that values below 0 stay",
        citation="Feldkamp, Davis & Kress 1984; Parker 1982; Wang 2002",
        check=check_fdk,
    ),
}

METHODS: dict[str, Solver] = SOLVERS | DIRECT
"""What a file may ask for."""
