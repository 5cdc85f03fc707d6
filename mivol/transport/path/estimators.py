"""The estimators that a plan chooses among, by name, and those of one render.

Each entry says what a scene must be like for the estimator to serve it, what it promises, and whom it follows; the plan picks
one for the segments of a path, ``mivol explain`` prints it, and tests measure what is promised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mitsuba as mi

from mivol.transport.estimators.direct_lighting import DirectLighting
from mivol.transport.estimators.emitters import SceneEmitters
from mivol.transport.estimators.scattering_quadrature import ScatteringQuadrature
from mivol.transport.estimators.segment import Absorption, SegmentEstimator
from mivol.transport.estimators.single_scattering import SingleScattering
from mivol.transport.estimators.transmittance_grid import TransmittanceGrid
from mivol.transport.estimators.visibility_cache import VisibilityCache
from mivol.transport.line_integrals.emitting_segment import Emission
from mivol.transport.media.scene_media import SceneMedia

__all__ = ["SEGMENT_ESTIMATORS", "Estimators", "SegmentChoice", "SegmentEntry"]


@dataclass
class SegmentChoice:
    """What a segment estimator is made from.

    Attributes:
        direct: light that arrives at points of surfaces and media.
        count: points of a segment that scatter, in pictures.
        visibility_cache: where emitters shine; None where that is not known.
        transmittance_grid: in place of shadow rays; None for exact ones.
    """

    direct: DirectLighting
    count: int = 1
    visibility_cache: VisibilityCache | None = None
    transmittance_grid: TransmittanceGrid | None = None


@dataclass(frozen=True)
class SegmentEntry:
    """A segment estimator by name.

    Attributes:
        make: builds it.
        needs: what a scene must be like.
        promises: bias and variance, in words.
        cites: keys of :mod:`mivol.report.cite`.
    """

    make: Callable[[SegmentChoice], SegmentEstimator]
    needs: str
    promises: str
    cites: tuple[str, ...] = ()


SEGMENT_ESTIMATORS = {
    "absorption": SegmentEntry(
        lambda choice: Absorption(choice.direct.media),
        "no medium shines or scatters light to the camera",
        "no bias, no variance",
    ),
    "emission": SegmentEntry(
        lambda choice: Emission(choice.direct.media),
        "a medium emits and none scatters light to the camera",
        "error of the fourth order in the size of a cell, no variance",
    ),
    "single_scattering": SegmentEntry(
        lambda choice: SingleScattering(choice.direct, choice.count, choice.visibility_cache),
        "a medium scatters once",
        "no bias",
    ),
    "scattering_quadrature": SegmentEntry(
        lambda choice: ScatteringQuadrature(
            SingleScattering(choice.direct, visibility_cache=choice.visibility_cache), choice.transmittance_grid
        ),
        "one medium scatters once, its grids share their cells, every emitter has one position or direction",
        "error of the fourth order in the size of a cell where light is smooth, no variance; derivatives are drawn",
    ),
}
"""Estimators of what media add along a segment, by the name that a plan chooses them by."""


class Estimators:
    """The estimators of one render.

    Args:
        direct: light that arrives at points of surfaces and media.
        segment: what media add and take along a segment.
        lights_surfaces: surfaces turn light, so that emitters are met by two kinds of samples.
    """

    def __init__(self, direct: DirectLighting, segment: SegmentEstimator, lights_surfaces: bool) -> None:
        self.media, self.direct, self.segment, self.lights_surfaces = direct.media, direct, segment, lights_surfaces

    @classmethod
    def of_media(cls, media: SceneMedia) -> Estimators:
        """Those of media that only absorb, without surfaces that turn light."""
        return cls(DirectLighting(media, SceneEmitters(media.scene)), Absorption(media), False)

    def find_controls(self, ray: mi.Ray3f) -> None:
        """Find control variates for derivatives along camera rays, once for all passes."""
        if isinstance(self.segment, SingleScattering | ScatteringQuadrature):
            self.segment.find_controls(ray)

    def replayed(self) -> Estimators:
        """Estimators of the radiance that a replay counts down: without light that is drawn anew for its derivative."""
        if not isinstance(self.segment, SingleScattering | ScatteringQuadrature):
            return self
        return Estimators(self.direct, Absorption(self.media, drawn_by=self.segment), self.lights_surfaces)
