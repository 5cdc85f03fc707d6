"""The table of estimators that a plan chooses from by name, and the estimators of one render.

Each entry states which scenes the estimator can render, its bias and variance, and the papers that it follows. The plan picks
one for the segments of a path, ``mivol explain`` prints it, and tests measure what is promised.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import mitsuba as mi

from mivol.transport.estimators.flights.free_flight import FreeFlight
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.emission_sampling import EmissionSampling
from mivol.transport.estimators.segment import Absorption, SegmentEstimator, TrackedAbsorption
from mivol.transport.estimators.single_scattering.scattering_quadrature import ScatteringQuadrature
from mivol.transport.estimators.single_scattering.shadow_tables import (
    TransmittanceGrid,
    VisibilityCache,
)
from mivol.transport.estimators.single_scattering.single_scattering import SingleScattering
from mivol.transport.line_integrals.emission import Emission
from mivol.transport.media.scene_media import SceneMedia

__all__ = [
    "SEGMENT_ESTIMATORS",
    "Estimators",
    "SegmentInputs",
    "SegmentEntry",
    "SegmentNeeds",
    "choose_segment_estimator",
    "Settings",
]


UNLIMITED = 0xFFFFFFFF


@dataclass(frozen=True)
class Settings:
    """How long a path may be, and how scattered light is computed.

    Attributes:
        max_depth: largest path depth, counted as in ``volpath``; -1 for no limit.
        rr_depth: depth from which Russian roulette may end a path.
        hide_emitters: emitters are not seen directly by the camera.
        deterministic: single scattering by quadrature in place of Monte Carlo.
        shadows: with ``deterministic``, ``exact`` or interpolated in a ``grid``; else ``exact`` or ``estimated`` (ratio
            tracking); ``auto`` leaves the choice to the plan.
        media_light: light that media emit is ``drawn`` where paths scatter, or ``met`` by chance; ``auto`` leaves the choice to
            the plan.
    """

    max_depth: int = 6
    rr_depth: int = 5
    hide_emitters: bool = False
    deterministic: bool = False
    shadows: str = "auto"
    media_light: str = "auto"

    @property
    def depth_limit(self) -> int:
        """Largest path depth, as a number of 32 bits."""
        return self.max_depth if self.max_depth >= 0 else UNLIMITED

    @property
    def may_draw_emission(self) -> bool:
        """Whether light that media emit may be drawn where paths scatter."""
        return self.scatterings >= 1 and self.media_light != "met"

    @property
    def scatterings(self) -> float:
        """Largest number of scattering events between an emitter and the camera, on surfaces and in media; may be infinite."""
        return math.inf if self.max_depth < 0 else max(self.max_depth - 1, 0)


@dataclass
class SegmentInputs:
    """The arguments that a segment estimator is made from.

    Attributes:
        direct: the estimator of direct lighting, at surfaces and in media.
        count: number of scattering points on a segment, in images; derivatives have one.
        visibility_cache: rough visibility of the emitters, which distance sampling is guided by; None for none.
        transmittance_grid: a lattice that replaces shadow rays; None for exact shadow rays.
    """

    direct: DirectLighting
    count: int = 1
    visibility_cache: VisibilityCache | None = None
    transmittance_grid: TransmittanceGrid | None = None


@dataclass(frozen=True)
class SegmentNeeds:
    """What a scene and its settings ask of the segment estimator.

    Attributes:
        scatters: some medium scatters light to the camera.
        emits: some medium emits light.
        deterministic: images without noise were asked for.
        is_bounded: some medium is known by a majorant only.
        scatterings: largest number of scattering events between an emitter and the camera; may be infinite.
        refracts: the boundary of some medium bends or blurs the light that passes it, so that no straight shadow ray does.
        has_gaussians: some medium is made of Gaussians, in which no cell has a polynomial to draw a distance from.
    """

    scatters: bool
    emits: bool
    deterministic: bool
    is_bounded: bool = False
    scatterings: float = 1
    refracts: bool = False
    has_gaussians: bool = False

    @property
    def is_single(self) -> bool:
        """Whether straight shadow rays from one scattering event on a segment find all light."""
        return self.scatterings <= 1 and not (self.emits or self.is_bounded or self.refracts or self.has_gaussians)


@dataclass(frozen=True)
class SegmentEntry:
    """An entry of :data:`SEGMENT_ESTIMATORS`.

    Attributes:
        make: builds the estimator.
        applies: whether the estimator answers a question.
        scatterings: number of scattering events in media between an emitter and the camera that it accounts for.
        needs: the condition on the scene, in words.
        promises: bias and variance, in words.
        cites: keys of :mod:`mivol.cite`.
    """

    make: Callable[[SegmentInputs], SegmentEstimator]
    applies: Callable[[SegmentNeeds], bool]
    scatterings: int
    needs: str
    promises: str
    cites: tuple[str, ...]


def _make_quadrature(choice: SegmentInputs) -> ScatteringQuadrature:
    drawn = SingleScattering(choice.direct, visibility_cache=choice.visibility_cache)
    return ScatteringQuadrature(drawn, choice.transmittance_grid)


SEGMENT_ESTIMATORS = {
    "absorption": SegmentEntry(
        lambda choice: Absorption(choice.direct.media),
        lambda asked: not asked.scatters and not asked.emits and not asked.is_bounded,
        0,
        "no medium emits, or scatters light to the camera",
        "no bias, no variance",
        ("amanatides_1987", "vicini_2021"),
    ),
    "tracked_absorption": SegmentEntry(
        lambda choice: TrackedAbsorption(choice.direct.media),
        lambda asked: asked.is_bounded and not asked.scatters and not asked.emits,
        0,
        "a medium is bounded, and none emits, or scatters light to the camera",
        "no bias, of derivatives neither; variance of ratio tracking, and of one point a segment for derivatives",
        ("novak_2014", "amanatides_1987", "vicini_2021"),
    ),
    "emission": SegmentEntry(
        lambda choice: Emission(choice.direct.media),
        lambda asked: asked.emits and not asked.scatters and not asked.is_bounded,
        0,
        "a medium emits, and none scatters light to the camera",
        "error of the fourth order in the size of a cell, no variance",
        ("max_1995", "amanatides_1987", "hairer_1996"),
    ),
    "single_scattering": SegmentEntry(
        lambda choice: SingleScattering(choice.direct, choice.count, choice.visibility_cache),
        lambda asked: asked.scatters and asked.is_single and not asked.deterministic,
        1,
        "a medium scatters once, none emits, is bounded or made of Gaussians, and no boundary refracts",
        "no bias",
        (
            *("chao_1982", "kulla_2012", "miller_2019", "veach_1995"),
            *("amanatides_1987", "novak_2014", "hofmann_2021", "rousselle_2016", "vicini_2021"),
        ),
    ),
    "free_flight": SegmentEntry(
        lambda choice: FreeFlight(choice.direct.media),
        lambda asked: asked.scatters and not asked.is_single and not asked.deterministic,
        math.inf,
        "media scatter any number of times, emit beside it, are bounded or Gaussians, or lie behind boundaries that refract",
        "no bias; variance of one flight a segment",
        (
            *("woodcock_1965", "hofmann_2021", "amanatides_1987", "veach_1995", "wilkie_2014", "miller_2019"),
            *("vicini_2021", "nimier_david_2022"),
        ),
    ),
    "scattering_quadrature": SegmentEntry(
        _make_quadrature,
        lambda asked: asked.scatters and asked.is_single and asked.deterministic,
        1,
        "one medium scatters once, its grids share their cells, every emitter has one position or direction",
        "error of the fourth order in the size of a cell where light is smooth, no variance; derivatives are drawn",
        ("hairer_1996", "kulla_2012", "amanatides_1987", "vicini_2021"),
    ),
}
"""Estimators of what media add along a segment, by the name that a plan chooses them by. A question has one answer, or none."""


def choose_segment_estimator(asked: SegmentNeeds) -> str | None:
    """The name of the estimator that answers a question; None where none does."""
    return next((name for name, entry in SEGMENT_ESTIMATORS.items() if entry.applies(asked)), None)


@dataclass
class Estimators:
    """The estimators of one render, and its settings.

    Attributes:
        direct: the estimator of direct lighting, at surfaces and in media.
        segment: the estimator of what media add and transmit along a segment.
        settings: depth, roulette, hidden emitters.
        lights_surfaces: some surface scatters light, so that emitters are hit by emitter samples and by BSDF samples, which are
            combined by multiple importance sampling.
        lights_media: likewise where a path ends a segment in a medium. Under a constant environment alone it is not so: light
            that is the same from everywhere is found without noise by the paths that escape.
        lobe: mean cosine of the lobe that side flights are drawn from (:mod:`.side_flight`); None for no side flights.
        emission: draws light of media that emit, where paths scatter; None where they find it by chance.
        long_paths_count: long paths have as much light as short ones, where it is the same from everywhere, or more, where
            media emit; roulette spares them.
        media: of the scene.
        draws_shadows: shadow rays of vertices are estimated, by tracking or by roulette, which takes a random number.
    """

    direct: DirectLighting
    segment: SegmentEstimator
    settings: Settings
    lights_surfaces: bool
    lights_media: bool = False
    lobe: mi.Float | None = None
    emission: EmissionSampling | None = None
    long_paths_count: bool = False
    media: SceneMedia = field(init=False)
    draws_shadows: bool = field(init=False)

    def __post_init__(self) -> None:
        self.media = self.direct.media
        self.draws_shadows = self.media.is_bounded or self.segment.ends_in_media

    def replayed(self) -> Estimators:
        """Estimators of the radiance that a replay subtracts from: without light that is sampled anew for its derivatives."""
        return replace(self, segment=self.segment.replayed())
