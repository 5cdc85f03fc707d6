"""The plan of a render: choices with reasons, and the media and estimators built from them.

Conventions. ``explain`` prints the choices. The plan refuses, with a sentence, a scene that cannot be rendered before a kernel
runs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mivol.back_end import free_memory
from mivol.errors import MivolError
from mivol.files.volume import VOXELS
from mivol.scene.choices import (
    MAX_SKIPPED_SHARE,
    MAX_TRIMMED_SHARE,
    MIN_ESTIMATED_CELLS,
    MIN_FILLED_SHARE,
    Choice,
    choose_branches,
    choose_channels,
    choose_emission,
    choose_emission_rays,
    choose_flights,
    choose_image_branches,
    choose_lamp_rays,
    choose_lighting,
    choose_media_light,
    choose_mirror_rays,
    choose_near_light,
    choose_refracted_light,
    choose_scattering_points,
    choose_shadow_table,
    choose_shadows,
    choose_side_flights,
    choose_skipping,
    choose_storage,
    choose_successive_paths,
    choose_tracing,
    choose_transport,
    count_occupied_cells,
    draws_points,
    is_dense,
    is_scattering_visible,
    is_thin,
    looks_up,
    tracks_flights,
)
from mivol.scene.media_light import find_emitting_boxes
from mivol.scene.needs import MediumFacts, Needs
from mivol.scene.readings import PartReading, read_coarse_grid, read_part
from mivol.scene.refusals import (
    check_bounded,
    check_emission_cells,
    check_gaussians,
    check_media_light,
    check_near_light,
    check_nested,
    check_placements,
    check_quadrature,
    check_scattering,
)
from mivol.scene.survey import SceneSurvey
from mivol.transport.estimators.flights.flight_derivatives import MIN_ALBEDO
from mivol.transport.estimators.lighting.bright_map import BrightMap
from mivol.transport.estimators.lighting.direct_lighting import DirectLighting
from mivol.transport.estimators.lighting.emission_sampling import EmissionSampling, EmissionTable
from mivol.transport.estimators.lighting.emitters import find_even_share
from mivol.transport.estimators.lighting.kept_rays import MirroredEmitters
from mivol.transport.estimators.lighting.refracted_light import RefractedLighting
from mivol.transport.estimators.lighting.tabulated_shadows import TransmittanceGrid
from mivol.transport.estimators.single_scattering.near_light import NearLighting
from mivol.transport.estimators.single_scattering.single_scattering import PROBE_DEPTH
from mivol.transport.estimators.single_scattering.visibility_cache import VisibilityCache, build_visibility_cache
from mivol.transport.media.grid_extinction import gradient_bytes, packs_gradient
from mivol.transport.media.scene_media import SceneMedia
from mivol.transport.path.estimators import (
    SEGMENT_ESTIMATORS,
    Estimators,
    SegmentInputs,
    SegmentNeeds,
    Settings,
    choose_segment_estimator,
)

__all__ = ["Plan", "build_estimators", "build_media", "choose_segment", "find_skipping", "make_plan", "plan_key"]


PASS_RAYS = {"llvm": 1 << 22, "cuda": 1 << 25, "metal": 1 << 24}
"""Most rays of a pass through media with small grids or without grids."""

PASS_STEPS = {"llvm": 1 << 29, "cuda": 1 << 34, "metal": 1 << 32}
"""Most cells crossed by all rays of a pass: a second or two of work, so that Ctrl-C acts soon."""


SMALL_STEP = 1 << 28
"""Memory of a gradient step [byte] up to which it is not compared with the free memory."""

OCCUPIED_STEP = 0.125
"""Step of the share of occupied blocks [1]."""

THICK = 1.0
"""Optical depth across a homogeneous medium [1] from which collisions alone give its derivatives."""


@dataclass(frozen=True)
class Plan:
    """The choices for a scene.

    Attributes:
        choices: all choices with their reasons.
        skips_empty: whether empty blocks of each medium are skipped.
        trims: whether only those before the first and behind the last occupied block of a ray are skipped.
        estimates_shadows: whether shadows of each medium are estimated in images.
        tracks_flights: whether delta tracking draws flights through the grids of each medium.
        segment: name of the segment estimator in :data:`mivol.transport.path.estimators.SEGMENT_ESTIMATORS`.
        scattering_points: scattering points per camera ray in images.
        pass_rays: most rays of a pass.
        gradient_bytes: memory of a gradient step besides the rays [byte].
        side_flight_cosine: mean cosine of the lobe for side flights; None without side flights.
        draws_emission: whether scattering points sample the light emitted by media.
        successive_paths: most paths per lane, walked one after the other.
        branches: whether paths branch at their first collision for derivatives.
        image_branches: branches of a path at the first collision, in images; 1 for none.
        draws_near_light: whether segments of paths draw the light of emitters with a position, in images.
        near_light_in_derivatives: the same, in derivatives.
        draws_points: whether they draw it at points found by look-ups, in place of coarse cells.
        looks_up: whether few look-ups may estimate transmittances of thin grids: of near light, and of shadows in derivatives.
        near_emitters: numbers of the emitters inside of media.
        are_thick: whether collisions alone find the derivatives of each medium's extinction.
        have_low_albedo: whether some albedo of each medium may be too low for derivatives to be found at collisions.
        shadow_nodes: nodes along an edge of the table of shadows, in images; 0 for shadow rays.
        emission_rays: own camera rays of a pixel for the light of media that does not scatter, in images; 0 for none.
        mirror_rays: own camera rays of a pixel for the light that glass mirrors to the camera, in images; 0 for none.
        keeps_mirrors: whether paths find lamps in mirrors by kept rays, in images.
        draws_refracted_light: whether vertices draw directions to lamps through smooth glass, in images.
        lamp_rays: own camera rays a sample for the light of lamps seen directly, in images; 0 for none.
        occupied: share of occupied blocks of the first medium's grid, in steps of ``OCCUPIED_STEP`` [1]; None if unknown.
    """

    choices: tuple[Choice, ...]
    skips_empty: tuple[bool, ...]
    trims: tuple[bool, ...]
    estimates_shadows: tuple[bool, ...]
    tracks_flights: tuple[bool, ...]
    segment: str
    scattering_points: int
    pass_rays: int
    gradient_bytes: int
    side_flight_cosine: float | None
    draws_emission: bool
    successive_paths: int
    branches: bool
    image_branches: int
    draws_near_light: bool
    near_light_in_derivatives: bool
    draws_points: bool
    looks_up: bool
    near_emitters: tuple[int, ...]
    are_thick: tuple[bool, ...]
    have_low_albedo: tuple[bool, ...]
    occupied: float | None
    lamp_rays: int
    shadow_nodes: int
    emission_rays: int
    mirror_rays: int
    keeps_mirrors: bool
    draws_refracted_light: bool

    @property
    def decisions(self) -> tuple:
        """All that a kernel depends on, without the reasons: equal plans give the same kernels."""
        skipped = {"choices", "gradient_bytes"}
        return tuple(value for name, value in vars(self).items() if name not in skipped)

    def light_of_paths(self, estimators: Estimators) -> Estimators:
        """The estimators of the light without camera rays of its own."""
        if self.lamp_rays:
            estimators = replace(estimators, shows="rest")
        if self.mirror_rays:
            estimators = replace(estimators, glass="transmits")
        return replace(estimators, camera_emission=0.0) if self.emission_rays else estimators

    def readings(self, for_images: bool) -> tuple:
        """All that decides what is read of the values of media (:func:`read_parts`)."""
        near = self.draws_near_light if for_images else self.near_light_in_derivatives
        coarsens = near and not self.draws_points
        return self.skips_empty, self.trims, self.estimates_shadows, self.tracks_flights, self.looks_up, coarsens


def find_skipping(occupied: float, is_sparse: bool) -> tuple[bool, bool]:
    """Whether walks through a grid skip empty blocks, and only those before and behind the occupied ones of a ray.

    Args:
        occupied: share of occupied blocks [1].
        is_sparse: whether the grid is stored in bricks.
    """
    skips = is_sparse or occupied < MAX_TRIMMED_SHARE
    return skips, skips and occupied >= MAX_SKIPPED_SHARE


def _find_way(medium: MediumFacts) -> tuple[bool, bool]:
    """:func:`find_skipping` of a medium's grids; false without a grid."""
    return find_skipping(medium.occupied, any(medium.bricks)) if medium.resolutions else (False, False)


def plan_key(medium: MediumFacts) -> tuple:
    """All that plans depend on among the facts of a medium. Facts with the same key have plans with the same decisions.

    A number counts only by the side of its limits on which it lies: a grid that changes a little keeps its plan.
    """
    shares = (
        _find_way(medium),
        count_occupied_cells(medium) < MIN_ESTIMATED_CELLS,
        medium.occupied >= MIN_FILLED_SHARE,
        _round_share(medium.occupied),
    )
    depths = {"tau_max": is_dense(medium), "tau_min": _is_thick(medium), "cell_depth": is_thin(medium)}
    numbers = {"occupied": shares, "albedo_min": _is_dark(medium)}
    return tuple((vars(medium) | depths | numbers).values())


def _is_thick(medium: MediumFacts) -> bool:
    return medium.tau_min >= THICK


def _is_dark(medium: MediumFacts) -> bool:
    return medium.albedo_min < MIN_ALBEDO


def make_plan(needs: Needs, settings: Settings, aovs: tuple[str, ...] = ()) -> Plan:
    """Choose from the facts.

    Raises:
        MivolError: a request that mivol does not answer (quadrature of several scatterings, derivatives of shapes), or a
            gradient step larger than the memory.
    """
    check_bounded(needs, settings)
    check_scattering(needs, settings)
    check_emission_cells(needs, settings)
    check_quadrature(needs, settings)
    check_placements(needs)
    check_gaussians(needs, aovs)
    check_nested(needs)
    check_media_light(needs, settings)
    segment = choose_segment(needs, settings)
    check_near_light(needs, settings, segment)
    choices = [
        choose_transport(needs, settings, segment),
        *choose_emission(needs, segment),
        *choose_lighting(needs, settings, segment),
        choose_tracing(needs),
        choose_channels(needs),
    ]
    ways = [_find_way(m) for m in needs.media]
    skips, trims = tuple(skip for skip, _ in ways), tuple(trim for _, trim in ways)
    choices += [choose_storage(m) for m in needs.media if any(m.bricks)]
    choices += [choose_skipping(m, *way) for m, way in zip(needs.media, ways, strict=True) if m.resolutions]
    choices += [choice for m in needs.media if (choice := choose_flights(m, segment)) is not None]
    shadows = [choose_shadows(m, needs, settings) for m in needs.media]
    tracks = tuple(choice is not None and choice.choice == "estimated" for choice in shadows)
    choices += [choice for choice in shadows if choice is not None]
    events, why = choose_scattering_points(needs, settings, segment)
    choices += why
    pass_rays = _rays_per_pass(needs)
    passes = -(-needs.crop_samples // pass_rays)
    choices.append(
        Choice(
            "passes",
            f"{passes}, of at most {pass_rays:,} rays each",
            f"{needs.crop_samples:,} samples; a pass ends within seconds",
        )
    )
    memory, choice = _plan_gradient_memory(needs)
    choices.append(choice)
    lobe, why = choose_side_flights(needs, settings, segment)
    choices += why
    draws_emission, why = choose_media_light(needs, settings)
    choices += why
    successive, why = choose_successive_paths(needs, settings, segment)
    choices += why
    branches, why = choose_branches(needs, settings, segment)
    choices += why
    near, near_in_derivatives, near_reasons = choose_near_light(needs, settings, segment)
    image_branches, why = choose_image_branches(needs, settings, segment, near)
    choices += why + near_reasons
    lamp_rays, why = choose_lamp_rays(needs, settings)
    choices += why
    emission_rays, why = choose_emission_rays(needs, settings, segment)
    choices += why
    mirror_rays, keeps_mirrors, why = choose_mirror_rays(needs, settings, segment)
    choices += why
    draws_refracted_light, why = choose_refracted_light(needs, settings, segment)
    choices += why
    nodes, why = choose_shadow_table(needs, settings, segment)
    choices += why
    return Plan(
        tuple(choices),
        skips,
        trims,
        tracks,
        tuple(segment == "free_flight" and tracks_flights(m) for m in needs.media),
        segment,
        events,
        pass_rays,
        memory,
        lobe,
        draws_emission,
        successive,
        branches,
        image_branches,
        near,
        near_in_derivatives,
        (near or near_in_derivatives) and draws_points(needs, settings),
        segment == "free_flight" and looks_up(needs, settings),
        tuple(k for k, distance in enumerate(needs.emitter_distances) if distance == 0),
        tuple(_is_thick(m) for m in needs.media),
        tuple(_is_dark(m) for m in needs.media),
        _round_occupied(needs),
        lamp_rays,
        nodes,
        emission_rays,
        mirror_rays,
        keeps_mirrors,
        draws_refracted_light,
    )


def _round_occupied(needs: Needs) -> float | None:
    """``Plan.occupied``: in steps, so that a grid that changes a little keeps its plan."""
    if not needs.media or any(m.unread for m in needs.media):
        return None
    return _round_share(needs.media[0].occupied)


def _round_share(occupied: float) -> float:
    return math.ceil(occupied / OCCUPIED_STEP) * OCCUPIED_STEP


def settings_for(settings: Settings, needs: Needs, for_images: bool) -> Settings:
    """The settings of an integrator for a purpose: quadrature of a field known at points is for images only.

    Its derivatives are Monte Carlo estimates, as those of other quadrature, but its flights need no cells.
    """
    if for_images or not any(m.bounded for m in needs.media):
        return settings
    return replace(settings, deterministic=False, shadows="auto" if settings.shadows == "grid" else settings.shadows)


def choose_segment(needs: Needs, settings: Settings) -> str:
    """Choose the name of the segment estimator. Requests without an estimator have been refused before."""
    emits = any(m.emits for m in needs.media)
    is_bounded = any(m.bounded for m in needs.media) and not settings.deterministic
    scatters = (emits or bool(needs.emitter_kinds)) and is_scattering_visible(needs, settings)
    question = SegmentNeeds(
        scatters,
        emits,
        settings.deterministic,
        is_bounded,
        settings.scatterings,
        bool(needs.refractive),
        any(m.has_own_walk for m in needs.media),
    )
    return choose_segment_estimator(question)


def _rays_per_pass(needs: Needs) -> int:
    """Number of rays per pass: fewer for grids with many cells."""
    backend = needs.variant.split("_")[0]
    cells = sum(sum(res) for medium in needs.media for res in medium.resolutions)
    return min(PASS_RAYS[backend], PASS_STEPS[backend] // max(cells, 1))


def _plan_gradient_memory(needs: Needs) -> tuple[int, Choice]:
    memory, ways = 0, set()
    for medium in needs.media:
        channels = 3 if medium.extinction == "rgb" else 1
        for (z, y, x), bricks in zip(medium.resolutions, medium.bricks or (0,) * len(medium.resolutions), strict=True):
            if bricks:
                memory += 8 * VOXELS * bricks * channels
                ways.add("stored nodes")
                continue
            packs = needs.variant.startswith("llvm") and packs_gradient((z, y, x), channels, needs.crop_samples)
            memory += (gradient_bytes((z, y, x), channels) if packs else 0) + 8 * z * y * x * channels
            ways.add("corners of cells, one copy per thread" if packs else "nodes")
    # Asking for the free memory takes as long as all other choices: a small step is not asked about.
    asks = needs.parameters and memory > SMALL_STEP
    free = free_memory() if asks else None
    if free is not None and memory > free:
        edge = math.floor(100 * (free / memory) ** (1 / 3))
        raise MivolError(
            f"a gradient step would take {memory / 2**30:.1f} GiB and {free / 2**30:.1f} GiB are free; lower the resolution "
            f"of the grids: {edge} % of their nodes along each axis fit."
        )
    size = f"{memory / 2**20:.1f} MiB besides the rays ({'; '.join(sorted(ways)) or 'no grid'})"
    return memory, Choice(
        "gradient step",
        size,
        f"images are differentiated by {', '.join(needs.parameters)}" if needs.parameters else "no parameter has gradients yet",
    )


Readings = list[list[PartReading]]
"""What transport reads of the values of each part of each medium before a render."""


def read_parts(needs: Needs, plan: Plan, survey: SceneSurvey, for_images: bool) -> Readings:
    """Read the values that the planned estimators need besides the values themselves."""
    skips_empty, trims, estimates_shadows, tracks_flights, looks_up, coarsens = plan.readings(for_images)
    media = zip(needs.boundaries, needs.views, skips_empty, trims, estimates_shadows, tracks_flights, strict=True)
    return [
        [read_part(p, survey, boundary.name, skip, trim, estimates or tracks, looks_up, coarsens) for p in view.parts]
        for boundary, view, skip, trim, estimates, tracks in media
    ]


def build_media(
    scene: mi.Scene,
    needs: Needs,
    plan: Plan,
    survey: SceneSurvey,
    readings: Readings | None = None,
    for_images: bool = True,
    tracer: mi.Scene | None = None,
) -> SceneMedia:
    """Build the media for transport as planned; ``readings`` are read, and the ``tracer`` is the survey's, if not given."""
    if readings is None:
        readings = read_parts(needs, plan, survey, for_images)
    bodies = []
    for index, (boundary, view, read) in enumerate(zip(needs.boundaries, needs.views, readings, strict=True)):
        for part, reading in zip(view.parts, read, strict=True):
            reading.apply(part)
        body = boundary.body(view, plan.estimates_shadows[index])
        body.is_thick, body.has_low_albedo = plan.are_thick[index], plan.have_low_albedo[index]
        bodies.append(body)
    return needs.make_media(scene, bodies, survey.size, tracer or survey.usable_tracer)


def build_estimators(
    scene: mi.Scene,
    needs: Needs,
    plan: Plan,
    settings: Settings,
    survey: SceneSurvey,
    for_images: bool,
    readings: Readings | None = None,
    tracer: mi.Scene | None = None,
    emitters: mi.Float | None = None,
    bright: BrightMap | None = None,
) -> Estimators:
    """Build the planned estimators, for images or for derivatives; ``readings`` and ``tracer`` as for :func:`build_media`,
    ``emitters`` and ``bright``, in images, as for :class:`DirectLighting`.
    """
    draws_near_light = plan.draws_near_light if for_images else plan.near_light_in_derivatives
    media = build_media(scene, needs, plan, survey, readings, for_images, tracer)
    if settings.deterministic:
        media = media.by_quadrature()
    # Candidates would lengthen gradients by a tenth.
    direct = DirectLighting(media, emitters, resamples=for_images, bright=bright if for_images else None)
    direct.looks_up = plan.looks_up and not for_images
    choice = SegmentInputs(direct, plan.scattering_points)
    if plan.segment in ("single_scattering", "scattering_quadrature"):
        with dr.suspend_grad():
            if not any(m.bounded for m in needs.media):
                choice.visibility_cache = _make_visibility_cache(direct, needs, plan, survey, for_images)
            if settings.shadows == "grid":
                lattice = next(p.lattice for p in media.bodies[0].view.parts if p.lattice is not None)
                choice.transmittance_grid = TransmittanceGrid.over_lattice(media, direct.emitters, lattice)
    segment = SEGMENT_ESTIMATORS[plan.segment].make(choice)
    is_even = all(kind == "uniform" for kind in needs.emitter_kinds)
    lights_surfaces = bool(needs.surfaces) and settings.scatterings >= 1 and not is_even
    lights_media = segment.ends_in_media and not needs.is_sealed and not is_even
    if lights_surfaces or lights_media:
        direct.emitters  # noqa: B018  (made now, not in the loop of a path)
    if for_images and plan.shadow_nodes:
        with dr.suspend_grad():
            direct.shadow_table = TransmittanceGrid.over_box(media, direct.emitters, needs.lit_box, plan.shadow_nodes)
    lobe = None if plan.side_flight_cosine is None else dr.opaque(mi.Float, plan.side_flight_cosine)
    even_share = mi.Float(0)
    if lobe is not None and not is_even and "uniform" in needs.emitter_kinds:
        with dr.suspend_grad():
            even_share = find_even_share(scene, emitters)
    emission = _make_emission_sampling(scene, media, needs) if plan.draws_emission else None
    long_paths_count = is_even or any(medium.emits for medium in needs.media)
    near = None
    if draws_near_light:
        inside = [scene.emitters()[number] for number in plan.near_emitters]
        near = NearLighting(direct, 0.0 if for_images else PROBE_DEPTH, inside, plan.looks_up, plan.draws_points)
    mirrored = None
    if for_images and plan.keeps_mirrors:
        with dr.suspend_grad():
            mirrored = MirroredEmitters(scene, direct.emitters)
    refracted = None
    if for_images and plan.draws_refracted_light:
        with dr.suspend_grad():
            refracted = RefractedLighting.of_lamps(direct, settings.depth_limit)
    ways = lobe, emission, long_paths_count, near, mirrored, refracted
    meets_light = any(kind != "delta" for kind in needs.emitter_kinds) or any(medium.emits for medium in needs.media)
    shares = {"even_share": even_share, "meets_light": meets_light}
    return Estimators(direct, segment, settings, lights_surfaces, lights_media, *ways, **shares)


def _make_emission_sampling(scene: mi.Scene, media: SceneMedia, needs: Needs) -> EmissionSampling:
    """Make the estimator of the light of media from the table of the needs."""
    light = needs.media_light
    boxes = find_emitting_boxes(media, needs.boundaries)
    for box in boxes:
        box.rows, box.to_world  # noqa: B018  (read now, with the placements)
    return EmissionSampling(media, EmissionTable(boxes, light.density, light.cumulative))


def _make_visibility_cache(
    direct: DirectLighting, needs: Needs, plan: Plan, survey: SceneSurvey, for_images: bool
) -> VisibilityCache | None:
    """Make the cache of emitter visibility. Derivatives are nonzero in empty blocks, and only values that were read tell the
    empty blocks.
    """
    rays = needs.film_samples * (plan.scattering_points if for_images else 1)
    occupied = plan.occupied if for_images else None
    take = lambda *arguments: read_coarse_grid(survey, *arguments)  # noqa: E731
    return build_visibility_cache(direct.media, direct.emitters, rays, occupied, take)
