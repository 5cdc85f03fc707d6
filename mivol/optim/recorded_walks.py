"""The walks of a fit through a radiance field, there and back, recorded once for each list of cells.

Python takes 5 ms of processor time to trace the two walks, of 60 of a step at 128^3 nodes. What is recorded holds the numbers
of rows and pinholes; other ones need another recording.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.fields.spherical import Pinholes, SphericalGrid
from mivol.optim.ray_batches import RayBatch
from mivol.transport.line_integrals.radiance_field import Model, RayBundle, RayGradient, RenderedRays, backward, render
from mivol.transport.line_integrals.radiance_source import bake, fold, table_of
from mivol.transport.traversal.occupied_cells import Cells

__all__ = ["RecordedWalks"]


@dataclass
class RecordedWalks:
    """Renders rays of pinholes, and takes derivatives of what was seen back to the rows of the field.

    Attributes:
        field: whose nodes are those of all fields that are rendered; its values are let go.
        cells: its occupied cells.
        model: activation, clamp and stop.
        near: as that of :func:`mivol.transport.line_integrals.radiance_field.backward`.
        pinholes, rays: how many of them there are.
    """

    field: SphericalGrid
    cells: Cells
    model: Model
    near: float
    pinholes: int
    rays: int

    def __post_init__(self) -> None:
        zeros = (dr.zeros(mi.Float, dr.width(a)) for a in (self.field.density, self.field.harmonics))
        self.field = self.field.with_values(*zeros)
        self._there, self._back = dr.freeze(self._trace_there), dr.freeze(self._trace_back)

    def suits(self, batch: RayBatch) -> bool:
        """Whether what is recorded is of as many pinholes and rays."""
        return (len(batch.origins), dr.width(batch.slot)) == (self.pinholes, self.rays)

    def there(self, field: SphericalGrid, batch: RayBatch) -> tuple[mi.Float, RenderedRays]:
        """What the rays of a batch see; beside it the table of what its pinholes see of each node."""
        pinholes = field.pinholes(batch.origins)
        return self._there(*self._arrays(field), pinholes.starts, batch.slot, batch.rays.o, batch.rays.d)

    def back(
        self, field: SphericalGrid, batch: RayBatch, table: mi.Float, seen: RenderedRays, by: RayGradient
    ) -> tuple[mi.Float, mi.Float]:
        """Derivatives of a scalar by the densities and the harmonics of a field, from those by what was seen of it."""
        pinholes = field.pinholes(batch.origins)
        return self._back(*self._arrays(field), pinholes.starts, batch.slot, table, seen, by.colour, by.T)

    def _arrays(self, field: SphericalGrid) -> list:
        """All arrays of a field and of its cells: a recorded function must be given them."""
        index = self.cells.index
        cells = [index.words, index.before, self.cells.corners, self.cells.rows, self.cells.from_world]
        return [[field.density, field.harmonics, field.nodes], cells]

    def _with_arrays(self, values: list, listed: list) -> tuple[SphericalGrid, Cells]:
        """The field and the cells that have these arrays."""
        density, harmonics, nodes = values
        words, before, corners, rows, from_world = listed
        index = replace(self.cells.index, words=words, before=before)
        cells = replace(self.cells, index=index, corners=corners, rows=rows, from_world=from_world)
        return replace(self.field, density=density, harmonics=harmonics, nodes=nodes), cells

    def _trace_there(
        self, values: list, listed: list, starts: mi.Float, slot: mi.UInt32, o: mi.Point3f, d: mi.Vector3f
    ) -> tuple[mi.Float, RenderedRays]:
        field, cells = self._with_arrays(values, listed)
        source = bake(field, cells, Pinholes(starts, self.pinholes), slot)
        seen = render(cells, source, self.model, RayBundle(o, d))
        dr.eval(seen)
        return source.table, seen

    def _trace_back(
        self,
        values: list,
        listed: list,
        starts: mi.Float,
        slot: mi.UInt32,
        table: mi.Float,
        seen: RenderedRays,
        by_colour: mi.Color3f,
        by_T: mi.Float,
    ) -> tuple[mi.Float, mi.Float]:
        field, cells = self._with_arrays(values, listed)
        source = table_of(cells, table, slot, slope=True)
        backward(cells, source, self.model, seen, RayGradient(by_colour, by_T), near=self.near)
        dr.eval(source.slope)
        return fold(field, cells, source, Pinholes(starts, self.pinholes))
