r"""One piece of a ray over the pieces behind it: emission-absorption compositing from the far end, with tangent and transpose.

.. math:: N \leftarrow N_i + T_i N

Conventions. Rows are the followed sums: channels or colours; rows of tangents come after them. A piece is a cell of a grid, a
region of constant extinction, or a Gaussian. N of a piece depends on a few numbers of its extinction (its points), and
derivatives are given by these numbers.

References: Max 1995 (the discrete emission-absorption integral); Porter & Duff 1984 (``over``, from back to front).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

__all__ = [
    "BodyIntegral",
    "CellIntegral",
    "ReverseState",
    "pass_cell",
    "composite_over",
    "transmittance_of",
    "zeros",
]


@dataclass
class CellIntegral:
    """A row of a cell, as seen from its near end.

    Attributes:
        tau, T: optical depth and transmittance [1].
        N: contribution of the cell.
        dtau, dN: derivatives of ``tau`` and ``N`` with respect to the extinction at each point of the integrand.
    """

    tau: mi.Float
    T: mi.Float
    N: mi.Float
    dtau: list[mi.Float]
    dN: list[mi.Float]


@dataclass
class BodyIntegral:
    """The rows of a medium by itself.

    Attributes:
        tau: optical depth [1], in float64 since parts of the sum are subtracted again.
        N: the sum, as seen from the near end.
    """

    tau: list[mi.Float64]
    N: list[mi.Float]


@dataclass
class ReverseState:
    """State of a reverse sweep.

    Attributes:
        N: sum over the swept cells.
        ahead: optical depth between the camera and the last swept cell.
        constant: derivatives with respect to the constants, so far.
    """

    N: list[mi.Float]
    ahead: list[mi.Float64]
    constant: list[mi.Float]


def composite_over(
    integral: BodyIntegral, integrals: list[CellIntegral], changes: list[list[mi.Float]], jvp: list[mi.Float]
) -> BodyIntegral:
    """Composite a cell over the swept cells: the cell adds its own N and attenuates the rest.

    Args:
        integral: sum over the swept cells.
        integrals: rows of the cell.
        changes: [row][point] tangents of the extinction; empty without tangents.
        jvp: tangent of N of each row by the other parameters of the integrand.
    """
    tau = [t + mi.Float64(s.tau) for t, s in zip(integral.tau, integrals, strict=False)]
    N = [dr.fma(s.T, n, s.N) for n, s in zip(integral.N, integrals, strict=False)]
    for c, (s, change) in enumerate(zip(integrals, changes, strict=False)):
        dtau, row = _dot(s.dtau, change), len(integrals) + c
        tau.append(integral.tau[row] + mi.Float64(dtau))
        N.append(_dot(s.dN, change) + jvp[c] + s.T * (integral.N[row] - dtau * integral.N[c]))
    return BodyIntegral(tau, N)


def pass_cell(
    sweep: ReverseState, integrals: list[CellIntegral], weight: list[mi.Float], behind: list[mi.Float]
) -> tuple[ReverseState, list[list[mi.Float]], list[mi.Float]]:
    """Pass a cell in a reverse sweep.

    Returns:
        The state, the derivatives with respect to the extinction of the cell [row][point], and with respect to its own N.
    """
    ahead = [a - mi.Float64(s.tau) for a, s in zip(sweep.ahead, integrals, strict=True)]
    weights = [w * transmittance_of(a) for w, a in zip(weight, ahead, strict=True)]
    slopes = []
    for s, P, n, b in zip(integrals, weights, sweep.N, behind, strict=True):
        # More extinction in this cell dims what was swept of this medium, and what lies behind the medium.
        dims = dr.fma(P * s.T, n, b)
        slopes.append([dr.fma(P, dN, -dims * dtau) for dN, dtau in zip(s.dN, s.dtau, strict=True)])
    N = [dr.fma(s.T, n, s.N) for n, s in zip(sweep.N, integrals, strict=True)]
    constant = [sum(g, total) for total, g in zip(sweep.constant, slopes, strict=True)]
    return ReverseState(N, ahead, constant), slopes, weights


def transmittance_of(tau: mi.Float64) -> mi.Float:
    """exp(-tau) of an optical depth [1] in float64, which rounding may have left a little below 0."""
    return dr.exp(-mi.Float(dr.maximum(tau, 0)))


def zeros(kind: type, rows: int) -> list:
    """A list of zeros of a type, one for each row."""
    return [kind(0) for _ in range(rows)]


def _dot(a: list[mi.Float], b: list[mi.Float]) -> mi.Float:
    return sum((x * y for x, y in zip(a, b, strict=True)), mi.Float(0))
