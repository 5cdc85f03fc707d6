r"""What a line integral sums over the media of a ray, and along which ray: the protocol of emission-absorption integrands.

.. math:: N = \sum_i T_1 \cdots T_{i-1} N_i

An :class:`Integrand` returns N_i of one cell: the light that it emits, or the distance at which it stops a ray. Compositing
(:mod:`mivol.transport.line_integrals.composite`) knows nothing else of it.

Conventions. A row is one sum that is followed: a channel of the extinction, or a colour over it.

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
    """A piece of a ray that is integrated at once: its part in one cell, or in a region of constant extinction.

    Attributes:
        body: the medium.
        ray: world space, unit direction.
        a: distance of the near end from the ray's origin [length].
        dt: length of the piece [length]; only that of a constant may be infinite.
        on: lanes that have it.
    """

    body: Body
    ray: Ray
    a: mi.Float
    dt: mi.Float
    on: mi.Bool


class Integrand(Protocol):
    """What a line integral sums.

    Attributes:
        rows: number of sums that are followed, a multiple of the channels of the extinction.
        points: where a cell needs its extinction, as fractions of its length, nearest to the camera first.
        asked, way_out: the beginning and the end of a sentence that refuses a medium: what asked for the integral, and how to
            do without it.
    """

    rows: int
    points: tuple[float, ...]
    asked: str
    way_out: str

    def cell(self, site: RayPiece, sigma: list[list[mi.Float]]) -> list[CellIntegral]:
        """Integrate each row over a cell, from the extinction [row][point]."""

    def constant(self, site: RayPiece, sigma: list[mi.Float]) -> list[CellIntegral]:
        """Integrate each row over a piece of constant extinction (which has one derivative)."""

    def vjp(self, site: RayPiece, sigma: list[list[mi.Float]], weight: list[mi.Float]) -> None:
        """Add ``weight`` (d loss / d N of each row) times the derivatives of N by all parameters but the extinction."""

    def jvp(self, site: RayPiece, sigma: list[list[mi.Float]]) -> list[mi.Float]:
        """Tangent of N of each row from the tangents of all parameters but the extinction."""

    def least(self, t1: mi.Float) -> mi.Float | float:
        """A lower bound of what a unit of opacity behind the distance ``t1`` may add."""


@dataclass
class LineIntegral:
    """A sum along rays.

    Attributes:
        media: of the scene.
        integrand: what is summed.
        ray_segment: the ray, the medium around its origin, and how far it goes; world space, unit direction.
        active: lanes to follow.
    """

    media: SceneMedia
    integrand: Integrand
    ray_segment: RaySegment
    active: mi.Bool


def check_cells_shared(media: SceneMedia, integrand: Integrand) -> None:
    """Refuse media that cannot be swept cell by cell.

    Raises:
        MivolError: a medium sums grids of two resolutions or places, or its extinction depends on the direction.
    """
    for body in media.bodies:
        if body.view.microflakes is not None:
            raise MivolError(f"{integrand.asked} and a medium has the phase function sggx; {integrand.way_out}.")
        grids = [p.lattice for p in body.view.parts if p.lattice is not None]
        for other in grids[1:]:
            if not have_same_cells(grids[0], other):
                raise MivolError(
                    f"{integrand.asked} and a medium sums grids of {grids[0].res} and {other.res} voxels (Z, Y, X); "
                    f"give both the same resolution and to_world, or {integrand.way_out}."
                )
