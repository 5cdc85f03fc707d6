"""From a plan to the media that transport walks through, and the estimators that find their light."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mivol.scene.facts import Needs
from mivol.scene.media_light import find_emitting_boxes
from mivol.scene.plan import Plan
from mivol.scene.readings import read_block_ranges, read_coarse, read_empty_distances
from mivol.scene.survey import SceneSurvey
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.emission_sampling import EmissionSampling, EmissionTable
from mivol.transport.estimators.single_scattering.shadow_tables import (
    VisibilityCache,
    build_transmittance_grid,
    build_visibility_cache,
)
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.estimators import SEGMENT_ESTIMATORS, Estimators, SegmentInputs, Settings

__all__ = ["build_estimators", "build_media"]


def build_media(scene: mi.Scene, needs: Needs, plan: Plan, survey: SceneSurvey) -> SceneMedia:
    """Build the media that transport walks through, as planned."""
    bodies = []
    for boundary, view, skip, tracks in zip(needs.boundaries, needs.views, plan.skips, plan.tracks, strict=True):
        for part in view.parts:
            if skip and part.lattice is not None:
                part.lattice.empty_distances = read_empty_distances(part, survey, boundary.name)
            # A grey variant sees the mean of an rgb extinction, and its transmittance is no mean.
            mixes = mi.is_monochromatic and part.channels > 1
            flies = plan.segment == "free_flight" and part.channels == 1
            if (tracks or flies) and part.lattice is not None and part.activation is None and not mixes:
                part.lattice.block_ranges = read_block_ranges(part, survey)
        bodies.append(boundary.body(view, tracks))
    return needs.media_of(scene, bodies, survey.size)


def build_estimators(
    scene: mi.Scene, needs: Needs, plan: Plan, settings: Settings, survey: SceneSurvey, pictures: bool
) -> Estimators:
    """Build the estimators that the plan has chosen, for pictures or for derivatives."""
    media = build_media(scene, needs, plan, survey)
    direct = DirectLighting(media)
    choice = SegmentInputs(direct, plan.events)
    if plan.segment in ("single_scattering", "scattering_quadrature"):
        with dr.suspend_grad():
            choice.visibility_cache = _find_visibility(direct, needs, plan, survey, pictures)
            if settings.shadows == "grid":
                choice.transmittance_grid = build_transmittance_grid(media, direct.emitters)
    lights_surfaces = bool(needs.surfaces) and settings.scatterings >= 1
    segment = SEGMENT_ESTIMATORS[plan.segment].make(choice)
    is_even = all(kind == "uniform" for kind in needs.emitter_kinds)
    lights_media = segment.ends_in_media and not needs.is_sealed and not is_even
    lobe = None if plan.lobe is None else dr.opaque(mi.Float, plan.lobe)
    emission = _draw_emission(scene, media, needs) if plan.draws_emission else None
    long_paths_count = is_even or any(medium.emits for medium in needs.media)
    return Estimators(direct, segment, settings, lights_surfaces, lights_media, lobe, emission, long_paths_count)


def _draw_emission(scene: mi.Scene, media: SceneMedia, needs: Needs) -> EmissionSampling:
    """The estimator of light of media, by the table that was read of them."""
    found = needs.media_light
    table = EmissionTable(find_emitting_boxes(scene, media, needs), found.density, found.cumulative)
    return EmissionSampling(media, table)


def _find_visibility(
    direct: DirectLighting, needs: Needs, plan: Plan, survey: SceneSurvey, pictures: bool
) -> VisibilityCache | None:
    """Find where emitters shine; derivatives are not 0 in empty blocks, which only values that were read can tell."""
    blind = not pictures or any(m.unread for m in needs.media)
    rays = needs.film_samples * (plan.events if pictures else 1)
    occupied = None if blind else needs.media[0].occupied
    take = lambda *asked: read_coarse(survey, *asked)  # noqa: E731
    return build_visibility_cache(direct.media, direct.emitters, rays, occupied, take)
