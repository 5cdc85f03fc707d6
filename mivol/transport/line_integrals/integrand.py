r"""The protocol of emission-absorption integrands: the quantity that a line integral sums over the media of a ray.

.. math:: N = \sum_i T_1 \cdots T_{i-1} N_i

An :class:`Integrand` returns N_i of one cell: its emitted light, or the distance at which the cell stops a ray. Compositing
(:mod:`mivol.transport.line_integrals.composite`) needs no other knowledge of the integrand.

Conventions. A row is one sum: a channel of the extinction, or a colour over a channel.

References: Max 1995 (the discrete emission-absorption integral).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mitsuba as mi

from mivol.errors import MivolError
from mivol.transport.media.body import Body
from mivol.transport.media.compositing import CellIntegral
from mivol.transport.media.grid_extinction import have_same_cells
from mivol.transport.media.ray_intervals import RaySegment
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.traversal.rays import Ray

__all__ = ["Integrand", "LineIntegral", "RayPiece", "check_cells_shared"]


@dataclass
class RayPiece:
    """A piece of a ray integrated at once: its part in one cell, or in a region of constant extinction.

    Attributes:
        body: medium of the piece.
        ray: world space, unit direction.
        a: distance of the near end from the ray's origin [length].
        dt: length of the piece [length]; infinite only for a constant.
        on: lanes with this piece.
    """

    body: Body
    ray: Ray
    a: mi.Float
    dt: mi.Float
    on: mi.Bool


class Integrand(Protocol):
    """The quantity of a line integral.

    Attributes:
        rows: number of sums, a multiple of the channels of the extinction.
        points: points of a cell at which the extinction is needed, as fractions of its length, nearest to the camera first.
        request, alternative: beginning and end of a sentence that refuses a medium: the user's request, and the way around.
    """

    rows: int
    points: tuple[float, ...]
    request: str
    alternative: str

    def integrate_cell(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> list[CellIntegral]:
        """Integrate each row over a cell, from the extinction [row][point]."""

    def integrate_constant(self, piece: RayPiece, sigma: list[mi.Float]) -> list[CellIntegral]:
        """Integrate each row over a piece of constant extinction, with one derivative."""

    def vjp(self, piece: RayPiece, sigma: list[list[mi.Float]], weight: list[mi.Float]) -> None:
        """Add ``weight`` (d loss / d N of each row) times the derivatives of N by all parameters except the extinction."""

    def jvp(self, piece: RayPiece, sigma: list[list[mi.Float]]) -> list[mi.Float]:
        """Tangent of N of each row, from the tangents of all parameters except the extinction."""

    def lower_bound(self, t1: mi.Float) -> mi.Float | float:
        """A lower bound of the contribution of a unit of opacity behind the distance ``t1``."""


@dataclass
class LineIntegral:
    """A sum along rays.

    Attributes:
        media: media of the scene.
        integrand: quantity of the sum.
        ray_segment: ray, medium around its origin, and length; world space, unit direction.
        active: lanes to follow.
    """

    media: SceneMedia
    integrand: Integrand
    ray_segment: RaySegment
    active: mi.Bool


def check_cells_shared(media: SceneMedia, integrand: Integrand) -> None:
    """Check that a sweep can integrate the media cell by cell.

    Raises:
        MivolError: a medium with grids of two resolutions or places, or with an extinction that depends on the direction.
    """
    for body in media.bodies:
        if body.view.microflakes is not None:
            raise MivolError(f"{integrand.request} and a medium has the phase function sggx; {integrand.alternative}.")
        grids = [p.lattice for p in body.view.parts if p.lattice is not None]
        for other in grids[1:]:
            if not have_same_cells(grids[0], other):
                raise MivolError(
                    f"{integrand.request} and a medium sums grids of {grids[0].res} and {other.res} voxels (Z, Y, X); "
                    f"give both the same resolution and to_world, or {integrand.alternative}."
                )
