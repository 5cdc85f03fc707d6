"""The table of segment estimators from which a plan chooses, and the estimators and settings of a render.

Each entry states the scenes that the estimator can render, its bias and variance, and the papers it follows. The plan chooses
one entry for the segments of a path, ``mivol explain`` prints it, and tests measure its promises."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import mitsuba as mi

from mivol.transport.estimators.flights.free_flight import FreeFlight
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.emission_sampling import EmissionSampling
from mivol.transport.estimators.lighting.kept_rays import KeptMirror, KeptRay, MirroredEmitters
from mivol.transport.estimators.lighting.refracted_light import RefractedLighting
from mivol.transport.estimators.lighting.tabulated_shadows import KeptShadow, TransmittanceGrid
from mivol.transport.estimators.segment import Absorption, AbsorptionToLamps, SegmentEstimator, TrackedAbsorption
from mivol.transport.estimators.single_scattering.near_light import NearLighting
from mivol.transport.estimators.single_scattering.scattering_quadrature import ScatteringQuadrature
from mivol.transport.estimators.single_scattering.single_scattering import SingleScattering
from mivol.transport.estimators.single_scattering.visibility_cache import VisibilityCache
from mivol.transport.line_integrals.emission import Emission
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.kept_segments import KeptSegments

__all__ = [
    "SEGMENT_ESTIMATORS",
    "Estimators",
    "SegmentEntry",
    "SegmentInputs",
    "SegmentNeeds",
    "Settings",
    "choose_segment_estimator",
]


UNLIMITED = 0xFFFFFFFF
"""Largest path depth without a limit."""


@dataclass(frozen=True)
class Settings:
    """The settings of an integrator: path length, Russian roulette, quadrature and shadows.

    Attributes:
        max_depth: largest path depth, counted as in ``volpath``; -1 for no limit.
        rr_depth: depth from which Russian roulette may end a path.
        hide_emitters: the camera does not see emitters directly.
        deterministic: single scattering by quadrature instead of Monte Carlo.
        shadows: with ``deterministic``, ``exact`` or interpolated in a ``grid``; without, ``exact`` or ``estimated`` by ratio
            tracking; ``auto`` leaves the choice to the plan.
        media_light: ``drawn`` samples the emission of media at scattering events, ``met`` leaves it to paths passing through
            the media; ``auto`` leaves the choice to the plan.
        near_light: in media that scatter several times, the light of emitters with a position is drawn along ``segments``, at
            distances of its own, or at ``vertices``, the collisions; ``auto`` leaves the choice to the plan."""

    max_depth: int = 6
    rr_depth: int = 5
    hide_emitters: bool = False
    deterministic: bool = False
    shadows: str = "auto"
    media_light: str = "auto"
    near_light: str = "auto"

    @property
    def depth_limit(self) -> int:
        """Largest path depth as an unsigned 32-bit number."""
        return self.max_depth if self.max_depth >= 0 else UNLIMITED

    @property
    def may_draw_emission(self) -> bool:
        """Whether scattering events may sample the emission of media."""
        return self.scatterings >= 1 and self.media_light != "met"

    @property
    def scatterings(self) -> float:
        """Largest number of scattering events between an emitter and the camera, on surfaces and in media; may be infinite."""
        return math.inf if self.max_depth < 0 else max(self.max_depth - 1, 0)


# -- The table -----------------------------------------------------------------------------------------------------------


@dataclass
class SegmentInputs:
    """The arguments for making a segment estimator.

    Attributes:
        direct: estimator of direct lighting, at surfaces and in media.
        count: number of scattering points on a segment in images; derivatives use one.
        visibility_cache: rough visibility of the emitters, guiding distance sampling; None without guidance.
        transmittance_grid: lattice replacing shadow rays; None means exact shadow rays.
    """

    direct: DirectLighting
    count: int
    visibility_cache: VisibilityCache | None = None
    transmittance_grid: TransmittanceGrid | None = None


@dataclass(frozen=True)
class SegmentNeeds:
    """Facts about a scene and its settings, by which the segment estimator is chosen.

    Attributes:
        scatters: a medium scatters light to the camera.
        emits: a medium emits light.
        deterministic: the user has requested images without noise.
        is_bounded: only a majorant of some medium is known.
        scatterings: largest number of scattering events between an emitter and the camera; may be infinite.
        refracts: the boundary of a medium refracts or blurs light, and blocks straight shadow rays.
        has_own_walk: a medium consists of Gaussians or of the leaves of an octree; no cells have polynomials for drawing
            distances.
    """

    scatters: bool
    emits: bool
    deterministic: bool
    is_bounded: bool = False
    scatterings: float = 1
    refracts: bool = False
    has_own_walk: bool = False

    @property
    def is_single(self) -> bool:
        """Whether straight shadow rays from one scattering event on a segment find all light."""
        return self.scatterings <= 1 and not (self.emits or self.is_bounded or self.refracts or self.has_own_walk)

    @property
    def has_flights(self) -> bool:
        """Whether collisions find the light: of several scatterings, or of an emission that no sum over cells holds."""
        return (self.scatters and not self.is_single) or (self.emits and self.is_bounded)


@dataclass(frozen=True)
class SegmentEntry:
    """An entry of :data:`SEGMENT_ESTIMATORS`.

    Attributes:
        make: makes the estimator.
        applies: whether the estimator serves a scene with the given needs.
        scatterings: largest number of scattering events in media between an emitter and the camera.
        needs: condition on the scene, in words.
        promises: bias and variance, in words.
        cites: keys of :mod:`mivol.cite`.
    """

    make: Callable[[SegmentInputs], SegmentEstimator]
    applies: Callable[[SegmentNeeds], bool]
    scatterings: int
    needs: str
    promises: str
    cites: tuple[str, ...]


def _make_quadrature(inputs: SegmentInputs) -> ScatteringQuadrature:
    sampled = SingleScattering(inputs.direct, visibility_cache=inputs.visibility_cache)
    return ScatteringQuadrature(sampled, inputs.transmittance_grid)


SEGMENT_ESTIMATORS = {
    "absorption": SegmentEntry(
        lambda inputs: Absorption(inputs.direct.media),
        lambda needs: not needs.scatters and not needs.emits and not needs.is_bounded,
        0,
        "no medium emits or scatters light to the camera",
        "no bias, no variance",
        ("amanatides_1987", "vicini_2021"),
    ),
    "tracked_absorption": SegmentEntry(
        lambda inputs: TrackedAbsorption(inputs.direct.media),
        lambda needs: needs.is_bounded and not needs.scatters and not needs.emits,
        0,
        "a medium is bounded, and no medium emits or scatters light to the camera",
        "no bias, also of derivatives; variance of ratio tracking, and for derivatives of one point a segment",
        ("novak_2014", "amanatides_1987", "vicini_2021"),
    ),
    "emission": SegmentEntry(
        lambda inputs: Emission(inputs.direct.media),
        lambda needs: needs.emits and not needs.scatters and not needs.is_bounded,
        0,
        "a medium emits, and no medium scatters light to the camera",
        "error of the fourth order in the size of a cell, no variance",
        ("max_1995", "amanatides_1987", "hairer_1996"),
    ),
    "single_scattering": SegmentEntry(
        lambda inputs: SingleScattering(inputs.direct, inputs.count, inputs.visibility_cache),
        lambda needs: needs.scatters and needs.is_single and not needs.deterministic,
        1,
        "light scatters once in media, no medium emits, is bounded or consists of Gaussians, and no boundary refracts",
        "no bias",
        (
            *("chao_1982", "kulla_2012", "miller_2019", "veach_1995"),
            *("amanatides_1987", "novak_2014", "hofmann_2021", "rousselle_2016", "vicini_2021"),
        ),
    ),
    "free_flight": SegmentEntry(
        lambda inputs: FreeFlight(inputs.direct.media),
        lambda needs: needs.has_flights and not needs.deterministic,
        math.inf,
        "media scatter any number of times, scatter and emit, are bounded, hold Gaussians or have refracting boundaries",
        "no bias; variance of one flight a segment",
        (
            *("woodcock_1965", "hofmann_2021", "amanatides_1987", "veach_1995", "wilkie_2014", "miller_2019"),
            *("vicini_2021", "nimier_david_2022"),
        ),
    ),
    "scattering_quadrature": SegmentEntry(
        _make_quadrature,
        lambda needs: needs.scatters and needs.is_single and needs.deterministic,
        1,
        "light scatters once in one medium, whose grids share cells, and every emitter has a single position or direction",
        "error of the fourth order in the size of a cell for smooth light, no variance; derivatives are Monte Carlo estimates",
        ("hairer_1996", "kulla_2012", "amanatides_1987", "vicini_2021"),
    ),
}
"""Segment estimators by name. At most one entry applies to any needs."""


def choose_segment_estimator(needs: SegmentNeeds) -> str | None:
    """Choose the name of the segment estimator for the given needs; None if no estimator applies."""
    return next((name for name, entry in SEGMENT_ESTIMATORS.items() if entry.applies(needs)), None)


# -- The estimators of a render ------------------------------------------------------------------------------------------


@dataclass
class Estimators:
    """The estimators and the settings of a render.

    Attributes:
        direct: estimator of direct lighting, at surfaces and in media.
        segment: estimator of the light and the transmittance of media along a segment.
        settings: depth, roulette, hidden emitters.
        lights_surfaces: a surface scatters light; multiple importance sampling combines emitter samples with BSDF samples.
        lights_media: emitter samples light the collisions in media too. Not used if a constant environment is the only emitter,
            since escaping paths find its light without noise.
        lobe: mean cosine of the lobe of side flights (:mod:`.side_flight`); None without side flights.
        even_share: share of constant environments in the light of all emitters, for side flights [1].
        meets_light: paths can meet light by chance: an emitter with a size or without a place, or an emitting medium.
        emission: sampler of the emission of media at scattering events; None to leave the emission to paths passing through.
        long_paths_count: long paths carry as much light as short ones (an even environment) or more (emitting media); roulette
            then spares them.
        near: estimator of the light of near emitters along segments of paths in media; None if vertices draw this light.
        camera_emission: weight of the light that media emit towards the camera without scattering [1]: 0 if this light has
            camera rays of its own.
        glass: what the first smooth glass of a camera ray does to it: "any" by chance, "transmits", or "mirrors"; the light of
            the last two adds up to that of the first.
        mirrored: guesses of the light in mirrors, for kept rays (:mod:`.kept_rays`); None to find lamps in mirrors by chance.
        refracted: estimator of the light of lamps behind smooth glass, in images; None if paths meet these lamps by chance.
        kept: what walks find along their segments, in memory for replays (:mod:`.kept_segments`); None without memory.
        writes_segments: walks write to this memory; replays read it.
        shows: emitters that the camera sees directly: "all", the "lamps" (emitters with a surface), or the "rest".
        media: media of the scene.
        draws_shadows: shadow rays of vertices are estimated, by tracking or by roulette, with a random number.
    """

    direct: DirectLighting
    segment: SegmentEstimator
    settings: Settings
    lights_surfaces: bool
    lights_media: bool = False
    lobe: mi.Float | None = None
    emission: EmissionSampling | None = None
    long_paths_count: bool = False
    near: NearLighting | None = None
    mirrored: MirroredEmitters | None = None
    refracted: RefractedLighting | None = None
    shows: str = "all"
    kept: KeptSegments | None = None
    writes_segments: bool = False
    camera_emission: mi.Float | float = 1.0
    glass: str = "any"
    even_share: mi.Float | float = 0.0
    meets_light: bool = True
    media: SceneMedia = field(init=False)
    draws_shadows: bool = field(init=False)

    def __post_init__(self) -> None:
        self.media = self.direct.media
        self.draws_shadows = self.media.is_bounded or self.segment.ends_in_media

    @property
    def lights_media_at_vertices(self) -> bool:
        """Whether emitter samples light the collisions in media: not if segments draw the light of all sampled emitters."""
        return self.lights_media and (self.near is None or self.near.lights_vertices)

    def start_kept_rays(self, n: int) -> dict[str, KeptRay]:
        """Rays kept by paths, by name of the path's attribute: a shadow ray of vertices in media, and a mirrored ray."""
        kept: dict[str, KeptRay] = {}
        if self.segment.ends_in_media and self.direct.shadow_table is not None:
            kept["tabulated"] = KeptShadow.empty(n)
        if self.mirrored is not None:
            kept["mirror"] = KeptMirror.empty(n)
        return kept

    def is_shown(self, si: mi.SurfaceInteraction3f) -> mi.Bool | bool:
        """Whether the camera sees the emitter at the end of its ray."""
        if self.settings.hide_emitters or self.shows == "all":
            return not self.settings.hide_emitters
        return si.is_valid() if self.shows == "lamps" else ~si.is_valid()

    def of_lamps(self) -> Estimators:
        """The estimators of the light of lamps that reaches the camera without scattering."""
        settings = replace(self.settings, max_depth=1)
        return Estimators(self.direct, AbsorptionToLamps(self.media), settings, lights_surfaces=False, shows="lamps")

    def of_camera_emission(self) -> Estimators:
        """The estimators of the light that media emit towards the camera, attenuated and without scattering."""
        settings = replace(self.settings, max_depth=1, hide_emitters=True)
        return Estimators(self.direct, Emission(self.media, is_sampled=True), settings, lights_surfaces=False)

    def of_mirrors(self) -> Estimators:
        """The estimators of the light that the first glass of a camera ray mirrors."""
        settings = replace(self.settings, hide_emitters=True)
        return replace(self, settings=settings, camera_emission=0.0 if self.media.emits else 1.0, glass="mirrors")

    def replayed(self) -> Estimators:
        """The estimators of the radiance that a replay subtracts from, without light sampled anew for its derivatives."""
        return replace(self, segment=self.segment.replayed())
