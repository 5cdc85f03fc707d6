"""The media of a scene in their boundaries: what a stretch of a ray passes through, forwards and backwards.

Conventions. A body is one medium behind one boundary. Where the boundary is a box it is cut by a slab test in float64;
elsewhere its stretches are found by tracing. A stretch [t0, t1] is given in world lengths along the camera's own ray, never
from the last boundary on, so that entry points keep the precision of the walk's set-up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from mivol.transport.media.body import Body, is_followed, part_values
from mivol.transport.media.channels import as_rows
from mivol.transport.media.grid_integral import Gradient
from mivol.transport.traversal.ray_spawning import spawn_ray

if TYPE_CHECKING:
    from mivol.transport.estimators.emitters import SceneEmitters
    from mivol.transport.estimators.grid_control import GridControl
    from mivol.transport.estimators.transmittance_grid import TransmittanceGrid
    from mivol.transport.estimators.visibility_cache import VisibilityCache

__all__ = ["World"]


class World:
    """The media of a scene, and what of Mitsuba's scene has to be traced.

    Args:
        bodies: the media.
        has_surfaces: some shape is more than the boundary of a medium.
        scatters: light may turn at a surface (``max_depth`` above 1 and surfaces to turn at).
        has_null_transmission: some surface lets part of the light through undeviated, so that a path of depth 1 may pass it.
        start: the medium that the sensor names, or None.
        locates_camera: the camera may be inside a boundary that has to be traced, and the sensor names no medium.
        emitters: what lights the media that scatter; None where none does.
        is_deterministic: images of scattered light are made by quadrature; derivatives are still drawn.
        events: points of a camera ray that scatter, in pictures.
        size: of the scene [length], by which rays start anew behind a surface.
    """

    def __init__(
        self,
        bodies: list[Body],
        has_surfaces: bool,
        scatters: bool = False,
        has_null_transmission: bool = False,
        start: mi.Medium | None = None,
        locates_camera: bool = False,
        emitters: SceneEmitters | None = None,
        is_deterministic: bool = False,
        events: int = 1,
        size: float = 1.0,
    ) -> None:
        self.boxed = [b for b in bodies if b.box is not None]
        # A traced stretch is recognised by its medium, which several boundaries may share.
        self.traced = list({b.view.medium.ptr: b for b in bodies if b.box is None}.values())
        self.has_surfaces = has_surfaces
        self.traces = has_surfaces or bool(self.traced)
        self.channels = 1 if mi.is_monochromatic else max([b.view.channels for b in bodies], default=1)
        self.scatters, self.has_null_transmission, self.start, self.locates_camera = (
            scatters,
            has_null_transmission,
            start,
            locates_camera,
        )
        self.emitters = emitters
        self.grid_control: GridControl | None = None
        self.constant_control: mi.Spectrum | None = None
        self.visibility_cache: VisibilityCache | None = None
        self.transmittance_grid: TransmittanceGrid | None = None
        self.is_deterministic, self.events = is_deterministic, events
        self.size = dr.opaque(mi.Float, size)
        self.is_tracked = any(
            p.lattice is not None and p.lattice.block_ranges is not None for b in bodies for p in b.view.parts
        )

    @property
    def takes_grid_control(self) -> bool:
        """Whether a control variate for derivatives can be used: one grid in a box that scatters by an albedo."""
        parts = [p for b in self.bodies for p in b.view.parts]
        alone = len(parts) == 1 and not self.traced and parts[0].lattice is not None
        return self.emitters is not None and alone and self.bodies[0].view.albedo is not None and not self.has_microflakes

    @property
    def has_microflakes(self) -> bool:
        """Whether some phase function has flakes among its lobes."""
        phases = [b.view.medium.phase_function() for b in self.bodies]
        return any(p is not None and int(p.flags()) & int(mi.PhaseFunctionFlags.Microflake) for p in phases)

    @property
    def bodies(self) -> list[Body]:
        """All media."""
        return self.boxed + self.traced

    @property
    def is_single(self) -> bool:
        """Whether one walk passes all extinction in its order."""
        return len(self.bodies) == 1 and len(self.bodies[0].flight_parts) == len(self.bodies[0].view.parts)

    def rows(self, values: list[mi.Float]) -> list[mi.Float]:
        """Numbers of a grey or rgb body, for each channel of the world."""
        return as_rows(values, self.channels)

    def sums(self, rows: list[mi.Float]) -> list[mi.Float]:
        """The derivative of each channel of the world from that of each colour: a grey one gets the sum."""
        return rows if len(rows) == self.channels else [sum(rows[1:], rows[0])]

    @property
    def emits(self) -> bool:
        """Whether some medium is a source of light."""
        return any(b.view.emits for b in self.bodies)

    def vectors(self, values: list[mi.Vector3f]) -> list[mi.Vector3f]:
        """Vectors of a grey or rgb body, for each channel of the world."""
        axes = [self.rows([v[a] for v in values]) for a in range(3)]
        return [mi.Vector3f(*v) for v in zip(*axes, strict=True)]

    def medium_at(self, scene: mi.Scene, ray: mi.Ray3f) -> mi.MediumPtr:
        """The medium around the origin of camera rays."""
        n = dr.width(ray)
        if self.start is not None:
            return dr.select(dr.full(mi.Bool, True, n), mi.MediumPtr(self.start), None)
        if self.locates_camera:
            return _locate(scene, ray, self.size)
        return dr.zeros(mi.MediumPtr, n)

    def start_gradients(self) -> None:
        """Begin a reverse pass: gradients of zero for each part."""
        for body in self.bodies:
            body.microflakes_gradient = dr.zeros(mi.Float, 6) if is_followed(body.view.microflakes) else None
            body.gradients = [
                Gradient.zeros(p.lattice) if p.lattice is not None else dr.zeros(mi.Float, p.channels) for p in body.view.parts
            ]

    def deliver_gradients(self) -> None:
        """End a reverse pass: hand the gradients of the parts to the parameters behind them."""
        total = mi.Float(0)
        for body in self.bodies:
            for part, gradient in zip(body.view.parts, body.gradients, strict=True):
                flat = gradient.fold() if part.lattice is not None else gradient
                dr.eval(flat)
                # The derivative of this product is the gradient, for the values and for the scale alike.
                total += dr.sum(dr.ravel(body.view.scale * part_values(part)) * flat)
            if body.microflakes_gradient is not None:
                slopes = (dr.gather(mi.Float, body.microflakes_gradient, mi.UInt32(k)) for k in range(6))
                total += sum(s * g for s, g in zip(body.view.microflakes, slopes, strict=True))
            body.gradients, body.microflakes_gradient = [], None
        if dr.grad_enabled(total):
            dr.backward(total)

    def start_tangent(self) -> None:
        """Begin a forward pass: take the tangent of each part from the parameters."""
        for body in self.bodies:
            products = [body.view.scale * part_values(p) for p in body.view.parts]
            asked = [p for p in products if dr.grad_enabled(p)]
            if asked:
                # The tangents of the parameters are kept: what else was made of them, such as an albedo, is followed later.
                dr.forward_to(*asked, flags=dr.ADFlag.ClearEdges)
            body.tangents = [dr.detach(dr.grad(p)) for p in products]
            if is_followed(body.view.microflakes):
                dr.forward_to(body.view.microflakes, flags=dr.ADFlag.ClearEdges)
                body.microflakes_tangent = dr.detach(dr.grad(body.view.microflakes))
            dr.eval(body.tangents, body.microflakes_tangent)


@dr.syntax
def _locate(scene: mi.Scene, ray: mi.Ray3f, size: mi.Float) -> mi.MediumPtr:
    """Find the medium around a point: the near side of the first boundary along a ray, through all else."""
    probe = mi.Ray3f(ray)
    medium = dr.zeros(mi.MediumPtr, dr.width(ray))
    going = dr.full(mi.Bool, True, dr.width(ray))
    while dr.hint(going, label="the medium around the camera"):
        si = scene.ray_intersect(probe, mi.RayFlags.All, False, going)
        found = going & si.is_valid()
        boundary = found & si.is_medium_transition()
        medium = dr.select(boundary, si.target_medium(-ray.d), medium)
        probe = spawn_ray(si, ray.d, size)
        going = found & ~boundary
    return medium
