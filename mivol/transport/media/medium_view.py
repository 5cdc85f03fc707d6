r"""The extinction of a medium as a sum of fields, each in its place, the same for our plugins and for stock ones.

.. math:: \sigma_t(x) = s \sum_k f_k(x)

with a scale s and parts f_k that are a grid or a constant (``sigma_t`` alone, or ``sigma_a`` and ``sigma_s``). Optical depth
is linear in each of them, so it is integrated part by part (:mod:`mivol.transport.media.extinction`): a homogeneous medium
stores no grid and two grids need not share a resolution.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi

from mivol.transport.media.box import Box
from mivol.transport.media.extinction import Extinction
from mivol.transport.media.gaussian_extinction import GaussianExtinction
from mivol.transport.traversal.lattice import Lattice

__all__ = ["MediumView"]


@dataclass
class MediumView:
    """The extinction of one medium, as transport sees it.

    Attributes:
        medium: the Mitsuba object.
        parts: their sum, times ``scale``, is sigma_t.
        scale: dimensionless factor, differentiable where the plugin makes it so.
        albedo_arrays: the arrays behind the albedo, or behind the ``sigma_s`` part.
        albedo: the albedo itself, a volume or a constant; None where ``sigma_s`` is a part.
        microflakes: the matrix S (xx, yy, zz, xy, xz, yz) of an ``sggx`` phase function, which makes the extinction depend on
            the direction: sigma_t sqrt(w^T S w) (Heitz et al. 2015, Eq. 6), with derivatives; None elsewhere.
        emission: Le [radiance], a volume or a constant; its source function is (1 - albedo) Le. None where there is none.
        emission_density: [radiance/length], which does not depend on the extinction; likewise.
        emission_lattice: the grid of ``emission_density``, ``emission`` or ``albedo``, whose cells are walked where the
            extinction has no grid. Its values are zeros.
        emission_arrays: the arrays behind ``emission`` and ``emission_density``.
        numbers: the constants among ``scale`` and the coefficients of the extinction, as ``mi.traverse`` hands them out.
        stock_boxes: the boxes of stock grids of emission and albedo, by the volume's pointer. Mitsuba repeats the border of
            such a grid outside of its box, where mivol has no emission.
    """

    medium: mi.Medium
    parts: list[Extinction]
    scale: mi.Float
    albedo_arrays: list = field(default_factory=list)
    albedo: mi.Volume | mi.Float | mi.Color3f | None = None
    microflakes: list[mi.Float] | None = None
    emission: mi.Volume | mi.Float | mi.Color3f | None = None
    emission_density: mi.Volume | mi.Float | mi.Color3f | None = None
    emission_lattice: Lattice | None = None
    emission_arrays: list = field(default_factory=list)
    stock_boxes: dict[int, Box] = field(default_factory=dict)
    numbers: dict[str, float | mi.Float | mi.Color3f] = field(default_factory=dict)

    def holds(self, volume: mi.Volume, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies in the box of a stock volume of emission; our volumes are 0 outside, and always hold it."""
        if volume.ptr not in self.stock_boxes:
            return mi.Bool(True)
        rows = self.stock_boxes[volume.ptr].rows()
        local = [x * p.x + y * p.y + z * p.z + shift for x, y, z, shift in rows]
        return (local[0] >= 0) & (local[0] <= 1) & (local[1] >= 0) & (local[1] <= 1) & (local[2] >= 0) & (local[2] <= 1)

    @property
    def emits(self) -> bool:
        """Whether the medium is a source of light."""
        return self.emission is not None or self.emission_density is not None or self.shows_gaussians

    @property
    def gaussians(self) -> GaussianExtinction | None:
        """The Gaussians that the medium is made of, which are then its only part; None elsewhere."""
        return next((part for part in self.parts if isinstance(part, GaussianExtinction)), None)

    @property
    def shows_gaussians(self) -> bool:
        """Whether the medium shows the colours of its Gaussians: light in an order along a ray, and no function of place."""
        return self.gaussians is not None and self.gaussians.shows

    @property
    def channels(self) -> int:
        """1 where every part is grey, 3 where one is rgb."""
        return max(part.channels for part in self.parts)

    @property
    def walked_lattice(self) -> Lattice | None:
        """The grid whose cells a sweep follows; None where everything is a constant."""
        return next((p.lattice for p in self.parts if p.lattice is not None), self.emission_lattice)
