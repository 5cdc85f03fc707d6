"""Choices about a scene: one function for each, with the reason that ``mivol explain`` prints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mitsuba as mi

from mivol.files.volume import VOXELS
from mivol.scene.needs import MediumFacts, Needs
from mivol.scene.survey import OwnRaysNoise
from mivol.transport.estimators.lighting.shadow_rays import FACES_ON_EDGE, LOOKUPS, STEPS_PER_LOOKUP
from mivol.transport.media.body import flight_parts
from mivol.transport.media.medium_view import MediumView
from mivol.transport.path.estimators import Settings

__all__ = [
    "MAX_SKIPPED_SHARE",
    "MAX_TRIMMED_SHARE",
    "Choice",
    "choose_branches",
    "choose_channels",
    "choose_emission",
    "choose_emission_rays",
    "choose_scattering_points",
    "choose_flights",
    "choose_image_branches",
    "choose_lamp_rays",
    "choose_lighting",
    "choose_media_light",
    "choose_mirror_rays",
    "choose_near_light",
    "describe_orders",
    "is_branch_noise_open",
    "is_emission_noise_open",
    "is_lamp_noise_open",
    "is_mirror_noise_open",
    "is_refracted_light_open",
    "is_near_light_open",
    "choose_shadow_table",
    "choose_shadows",
    "choose_side_flights",
    "choose_skipping",
    "choose_storage",
    "choose_successive_paths",
    "choose_tracing",
    "choose_transport",
    "draws_points",
    "is_scattering_visible",
    "is_thin",
    "looks_up",
    "shares_cells",
]


MAX_SKIPPED_SHARE = 0.45
"""Share of occupied blocks below which every step of a walk looks for empty blocks; above, only the steps before the first and
behind the last occupied block of a ray do. Measured rate over the walk through every cell: smoke with 48 % occupied, camera
and random rays, 1.2 and 0.8 with looks in every step, 1.6 and 1.1 without; with looks, CT with 43 % 1.05 to 1.1 and smoke of
256^3 with 43 % 1.3 to 1.4."""

MAX_TRIMMED_SHARE = 0.9
"""Share of occupied blocks above which no walk looks for empty blocks. Measured rate over the walk through every cell, camera
and random rays: balls with 52 % occupied 1.54 and 1.4, with 80 % 1.2 and 1.1; a full grid 0.98 and 1.05."""

MIN_ESTIMATED_CELLS = 300
"""Number of occupied cells along the three axes above which random look-ups for a shadow cost less than walking all cells.
Measured on 2 cores, efficiency (variance x time): smoke of 142 cells 0.4, smoke of 256^3 2, CT of 445 cells 1.9, threads of
111 cells 0.9."""

SCATTERING_POINTS = {(True, False): 4, (True, True): 8, (False, False): 2, (False, True): 2}
"""Scattering points per camera ray, by (grid is filled, all emitters have one position or direction). Walking a filled grid
costs more, and a shadow ray to such an emitter less. Measured efficiency (variance x time) over 1 point: smoke 1.5 to 2, CT
1.5 to 2.4; threads, whose noise comes from the pixel's own footprint, 1.0 to 1.2 with 2 points and 0.9 to 1.3 with 4. With 8
points over 4, point lights: smoke 1.1, CT 1.1 and 1.3."""

LAMP_RAYS, LAMP_COST, MIN_LAMP_GAIN, MIN_LAMP_SAMPLES = (4, 8, 16), 0.05, 1.2, 1 << 15
"""Own camera rays a sample for lamps in view, the time of one over the time of a path (measured: 0.03 in a room of depth 10,
0.07 to 0.14 beside glass), the smallest predicted gain, and the samples of an image below which nothing is measured."""

OWN_RAYS, EMISSION_COST, MIRROR_COST, MIN_OWN_GAIN = (0.0625, 0.125, 0.25, 0.5, 1.0), 1.0, 0.5, 1.2
"""Own camera rays a sample for the light of media that does not scatter, or the light that glass mirrors; the time of one over
the time of a path (measured: 0.9 in an explosion of 160 x 160 x 240 nodes, depth 8; mirrors 0.3 to 0.5 in balls of glass), and
the smallest predicted gain."""

KEPT_COST = 1.2
"""Time of a path with a kept mirrored ray over the time of a path without (measured: 1.07 and 1.2 in balls of thin glass, 1.25
in milk in a glass)."""

REFRACTED_COST, MIN_REFRACTED_GAIN = 2.2, 1.2
"""Time of an image whose vertices draw directions through glass over the time without (measured: 1.7 to 2.7 in balls, cubes, a
pane, a lantern and milk in a glass), and the smallest predicted gain in variance x time."""

MIN_BRANCHING_SAMPLES, MAX_IMAGE_BRANCHES, MAX_BRANCHING_TIME, MIN_BRANCHING_GAIN = 1 << 16, 4, 2.0, 1.1
"""Samples of an image below which no preview measures branches, most branches of a path, most time of an image over the time
without branches, and the smallest predicted gain in variance x time."""

BRANCH_COST, EVENT_COST = 0.5, 0.5
"""Time of a branch without scattering events, and of an event, over the time of a camera ray up to the first collision.
Measured for an event, with this time of a branch: jade 0.4, tissue 0.2, wax behind rough glass 0.9, smokes and a cloud 0.5 to
0.8, smoke on a floor 0.5."""

NEAR_EVENT_COST, MAX_NEAR_BRANCHING_TIME = 1.2, 1.6
"""``EVENT_COST`` and ``MAX_BRANCHING_TIME`` of paths whose segments draw the light of near emitters. Measured for an event: 1.2
with a lamp inside a random grid."""

MIN_SIDE_FLIGHT_COSINE = 0.5
"""Mean cosine of a phase function above which side flights pay. Below, samples of the phase function find the light. Measured
for Henyey-Greenstein with g = 0.8 under a sun: variance x time is 2 to 4 times smaller."""

MIN_TABLE_NODES, MAX_TABLE_NODES, TABLE_SHARE = 8, 24, 1 / 32
"""Fewest and most nodes along an edge of a table of shadows, and most nodes for each sample of an image. Measured variance x
time over that of shadow rays, 48^2 x 64 samples, with 8, 12, 24 and 33 nodes: a cloud 0.60, 0.53, 0.53, 0.57; smoke of HG 0.8
under a sun 0.72, 0.66, 0.60, 0.65 (with an additive correction of the table). A table of 65 nodes costs as many rays as it
saves there."""

SUCCESSIVE_PATHS, MIN_SUCCESSIVE_SCATTERINGS = 16, 4
"""Paths per lane walked one after the other, and the number of scatterings from which successive paths pay. Measured processor
time of 1 path per lane over 16, on 2 cores: smoke in a room 1.25, coloured water behind glass 1.3, fog, god rays and milk 1.0
(depths of 8 and 10). With as many paths for each lane, in place of a common list: a cloud of albedo 0.999 1.5 (depth 64), a
white box of optical depth 64 2.2 (unlimited); with the list, tissue takes 0.73 of that time (unlimited)."""

NEAR_DISTANCE = 1.0
"""Distance of an emitter to a medium, over the longest edge of the medium [1], beyond which collisions draw its light: 1 / r^2
varies by less than 4 across the medium."""

DENSE = 70.0
"""Bound of the optical depth through a grid [1] from which segments also draw the light of an emitter near the grid in
derivatives. Measured gain of segments in variance x time of gradients, by this bound (lamps 0.05 to 0.9 edges from smoke):
3: 0.1, 35: 0.4 to 0.8, 69: 1.0, 104: 1.5, 208: 3.7, 416: 8 to 11. The gain in images falls meanwhile, from 30 to 1.2."""

MAX_THIN_CELL = 0.85
"""Bound of the optical depth along the edge of a cell [1] up to which look-ups at random points take fewer steps than a walk of
cells. (Time of a gradient, by flights through rgb grids over that of inverted optical depths: 0.7 to 0.8 with 0.25, 1.06 with
1.6. By near light at points over that in coarse cells: 0.78 to 0.9 with 0.15, 1.0 with 1.7.)"""

MAX_LOOKED_UP_CELL = FACES_ON_EDGE / (STEPS_PER_LOOKUP * LOOKUPS)
"""The same bound for shadow rays in gradients."""

MIN_FILLED_SHARE = 0.25
"""Share of occupied blocks above which a grid counts as filled."""


@dataclass(frozen=True)
class Choice:
    """A decision: its subject, the choice and the reason."""

    subject: str
    choice: str
    reason: str


def shares_cells(view: MediumView) -> bool:
    """Whether one walk visits the cells of all parts of a medium."""
    return len(flight_parts(view.parts)) == len(view.parts)


def is_scattering_visible(needs: Needs, settings: Settings) -> bool:
    """Whether media scatter light to the camera.

    Media with unreadable values, in a recording, count as scattering unless an earlier render has read them.
    """
    return settings.scatterings >= 1 and any(m.is_scattering for m in needs.media)


def choose_transport(needs: Needs, settings: Settings, segment: str) -> Choice:
    """Choose how to integrate light through media."""
    if not needs.media:
        return Choice("media", "none", "no shape bounds a medium")
    if segment == "free_flight":
        often = (
            "any number of scatterings" if math.isinf(settings.scatterings) else f"at most {settings.scatterings} scatterings"
        )
        return Choice("media", f"free flights from collision to collision; {often}", _explain_free_flights(needs, settings))
    if is_scattering_visible(needs, settings):
        where = "by quadrature" if settings.deterministic else "at a distance sampled in proportion to the scattered light"
        shadows = "a light grid for shadows" if settings.shadows == "grid" else "exact shadow rays"
        method = f"{_describe_depths(needs, settings)}; one scattering {where}, {shadows}"
        return Choice("media", method, "an albedo is above 0 and max_depth is 2")
    why = "albedo 0" if not any(m.is_scattering for m in needs.media) else "max_depth 1 includes no scattered light"
    if any(m.unread for m in needs.media):
        why = "values cannot be read while dr.freeze records; max_depth or an earlier render implies absorption only"
    method = f"{_describe_depths(needs, settings)}; no phase function, no light sampling in media, no albedo look-up"
    return Choice("media", method, why)


def _describe_depths(needs: Needs, settings: Settings) -> str:
    """How optical depths are found."""
    names = ", ".join(m.name for m in needs.media if m.bounded)
    if not names:
        return "exact optical depth"
    if settings.deterministic:
        return f"optical depth of {names} by two points in each half of a cell, exact elsewhere"
    return f"transmittance of {names} by ratio tracking, exact elsewhere"


def _explain_free_flights(needs: Needs, settings: Settings) -> str:
    """List the effects that a single scattering on straight segments would leave out."""
    reasons = [f"{m.name} emits and scatters" for m in needs.media if m.emits]
    reasons += [f"{m.name} is bounded" for m in needs.media if m.bounded]
    reasons += [f"{m.name} is made of Gaussians" for m in needs.media if m.gaussians]
    reasons += [f"{m.name} is an octree" for m in needs.media if m.leaves]
    reasons += [f"{name} refracts" for name in needs.refractive]
    if settings.scatterings > 1:
        reasons.insert(0, f"an albedo is above 0 and max_depth is {settings.max_depth}")
    return "; ".join(reasons)


def choose_emission(needs: Needs, segment: str) -> list[Choice]:
    """Choose how to sum emitted light."""
    choices = []
    names = [m.name for m in needs.media if m.emits and m.gaussians]
    if names:
        where = "flight through them" if segment == "free_flight" else "ray"
        choices.append(Choice("Gaussians", f"in the order of their peaks along each {where}", f"{', '.join(names)}: colours"))
    names = ", ".join(m.name for m in needs.media if m.emits and not m.gaussians)
    if names and segment == "free_flight":
        choices.append(Choice("emission", "at one point of each flight", f"{names} emit, and light scatters"))
    elif names:
        choices.append(Choice("emission", "two points per cell, summed from the far end", f"{names} emit"))
    return choices


def choose_lighting(needs: Needs, settings: Settings, segment: str) -> list[Choice]:
    """Choose how to find scattered light."""
    if not is_scattering_visible(needs, settings):
        return []
    drawn = [kind for kind in needs.emitter_kinds if kind != "uniform"]
    met = [kind for kind in needs.emitter_kinds if kind != "delta"]
    if not needs.emitter_kinds:
        return [Choice("directions", "none", "the scene has no emitter")]
    if settings.deterministic:
        where = "at two points of each piece of a cell, from every emitter"
        return [Choice("where to scatter", where, "deterministic is set")]
    if segment == "free_flight":
        if not drawn:
            return [
                Choice(
                    "directions",
                    "one sample of the phase function",
                    "all emitters are uniform: escaping paths find their light",
                )
            ]
        if needs.is_sealed:
            why = "media lie behind refracting boundaries: no straight ray finds an emitter, and paths hit emitters by chance"
            return [Choice("directions", "one sample of the phase function", why)]
        method = "an emitter sample at each collision, and a phase function sample onwards"
        return [Choice("directions", method, "the power heuristic weighs both samples")]
    if not drawn:
        choices = [Choice("directions", "one sample of the phase function", "all emitters are uniform")]
    elif not met:
        choices = [Choice("directions", f"one, to one of {len(drawn)} emitters", "no phase function sample can hit an emitter")]
    else:
        why = (
            f"{len(drawn)} emitters to sample, {len(met)} reachable by phase function samples: the power heuristic weighs both"
        )
        choices = [Choice("directions", "two: an emitter sample and a phase function sample", why)]
    if "delta" in drawn:
        alone = len(needs.media) == 1 and len(needs.media[0].resolutions) == 1
        method = (
            "weighed by optical depth towards the emitters, from blocks of the grid" if alone else "along the camera ray only"
        )
        why = "an emitter of one position or direction" + ("" if alone else ", but more than one grid or none")
        choices.append(Choice("where to scatter", method, why))
    return choices


def choose_tracing(needs: Needs) -> Choice:
    """Choose whether rays are traced through Mitsuba's acceleration structure."""
    traced = [m.name for m, b in zip(needs.media, needs.boundaries, strict=True) if b.box is None]
    if needs.surfaces:
        return Choice("acceleration structure", "traced", f"surfaces may stop a ray: {', '.join(sorted(set(needs.surfaces)))}")
    if traced:
        why = f"not a box or ball, or overlapping another boundary: {', '.join(traced)}"
        return Choice("acceleration structure", "traced", why)
    why = "every shape is the box or ball of a medium: rays are clipped in float64"
    return Choice("acceleration structure", "not traced", why)


def choose_channels(needs: Needs) -> Choice:
    """Choose the number of channels for integrating the extinction."""
    rgb = [m.name for m in needs.media if m.extinction == "rgb"]
    if rgb:
        return Choice("channels", "3", f"rgb extinction in {', '.join(rgb)}")
    return Choice("channels", "1", "every extinction is grey")


def choose_skipping(medium: MediumFacts, skip: bool, trim: bool) -> Choice:
    """Choose whether a walk skips empty blocks of a medium."""
    share = f"{medium.occupied:.0%} of its blocks are occupied"
    way = "skipped before and behind the content" if trim else "skipped" if skip else "walked"
    return Choice(f"empty space in {medium.name}", way, share)


def choose_storage(medium: MediumFacts) -> Choice:
    """Say what a sparse grid stores."""
    stored = sum(VOXELS * n for n in medium.bricks)
    whole = sum(z * y * x for (z, y, x), n in zip(medium.resolutions, medium.bricks, strict=True) if n)
    size = f"{stored / whole:.1%} of its voxels are stored, {4 * stored / 2**20:.3g} MiB a channel"
    return Choice(f"storage of {medium.name}", "sparse", f"{size} instead of {4 * whole / 2**20:.3g}")


def choose_flights(medium: MediumFacts, segment: str) -> Choice | None:
    """Choose how to sample flights through a medium; None without flights."""
    if segment != "free_flight":
        return None
    subject = f"flights in {medium.name}"
    if medium.bounded == "GridVolume":
        why = "its grid is not trilinear in its box: another filter_type or wrap_mode than trilinear and clamp, or a to_world"
        return Choice(subject, "delta tracking", f"{why} with a wrong inverse (rotate about an axis that is not normalised)")
    if medium.bounded:
        return Choice(subject, "delta tracking", "only a majorant is known")
    if medium.gaussians:
        return Choice(
            subject, "exact, one flight in each Gaussian along a ray", "the shortest flight is a flight through the sum"
        )
    if medium.leaves:
        return Choice(subject, "exact, leaf by leaf", "the extinction is constant in each leaf")
    if not medium.resolutions:
        return Choice(subject, "exact", "its extinction is a constant")
    if medium.extinction == "rgb" and not tracks_flights(medium):
        why = f"with up to {medium.cell_depth:.3g} tentative collisions in a cell, a walk of the cells takes fewer steps"
        return Choice(subject, "exact, with one sampled channel per flight", why)
    if medium.extinction == "rgb":
        return Choice(
            subject,
            "delta tracking, with one sampled channel per flight",
            "majorants of blocks are known; tentative collisions weigh all channels",
        )
    return Choice(subject, "delta tracking", "majorants of blocks are known; derivatives walk every cell")


def tracks_flights(medium: MediumFacts) -> bool:
    """Whether delta tracking draws flights through the grids of a medium.

    A flight in a clear channel of an rgb grid passes the tentative collisions of the densest channel.
    """
    return medium.extinction != "rgb" or medium.cell_depth is None or is_thin(medium)


def is_thin(medium: MediumFacts) -> bool:
    """Whether look-ups at random points take fewer steps than a walk through the cells of a medium's grids."""
    return medium.cell_depth is not None and medium.cell_depth <= MAX_THIN_CELL


def draws_points(needs: Needs, settings: Settings) -> bool:
    """Whether near light is drawn at points found by look-ups: in a single medium with an albedo and a thin grid."""
    if not looks_up(needs, settings) or len(needs.media) != 1 or not is_thin(needs.media[0]):
        return False
    return all(_is_looked_up(view) for view in needs.views)


def looks_up(needs: Needs, settings: Settings) -> bool:
    """Whether few look-ups may estimate the light that thin grids let pass, where shadow rays lead to emitters."""
    return settings.shadows != "exact" and any(kind != "uniform" for kind in needs.emitter_kinds)


def _is_looked_up(view: MediumView) -> bool:
    """Whether one corner of a cell stands for the extinction at a point."""
    (part,) = view.parts if len(view.parts) == 1 else (None,)
    if part is None or view.albedo is None or part.lattice is None or part.activation is not None:
        return False
    # A grey variant averages the channels; the transmittance of the mean is not the mean transmittance.
    return not (mi.is_monochromatic and view.channels > 1)


def count_occupied_cells(medium: MediumFacts) -> float:
    """Number of occupied cells along the three axes of a medium's largest grid; 0 without a grid."""
    return medium.occupied * max((sum(res) for res in medium.resolutions), default=0)


def choose_shadows(medium: MediumFacts, needs: Needs, settings: Settings) -> Choice | None:
    """Choose whether shadow rays walk all cells of a medium or sample a few; None without shadows in a grid."""
    if not medium.resolutions or not is_scattering_visible(needs, settings) or settings.deterministic:
        return None
    subject, cells = f"shadows of {medium.name}", count_occupied_cells(medium)
    if medium.unread:
        return Choice(subject, "exact", "values cannot be read while dr.freeze records")
    if settings.shadows != "auto":
        return Choice(subject, settings.shadows, "set by the user")
    size = f"{cells:.0f} occupied cells along the three axes"
    looked_up = settings.scatterings > 1 and looks_up(needs, settings) and (medium.cell_depth or 1.0) < MAX_LOOKED_UP_CELL
    gradients = "gradients take a few look-ups" if looked_up else "gradients walk every cell"
    if cells < MIN_ESTIMATED_CELLS:
        return Choice(subject, "exact", f"{size}: a walk is cheap" + (f"; {gradients}" if looked_up else ""))
    if set(needs.emitter_kinds) == {"delta"}:
        return Choice(subject, "exact", "no emitter is extended: estimates are coarse where all light is faint")
    return Choice(subject, "estimated", f"{size}: unbiased look-ups cost less; {gradients}")


def choose_side_flights(needs: Needs, settings: Settings, segment: str) -> tuple[float | None, list[Choice]]:
    """Choose the mean cosine of the lobe for side flights; None for no side flights."""
    if segment != "free_flight" or settings.scatterings < 2 or not needs.are_emitters_far or needs.is_sealed:
        return None, []
    if needs.endless_media:
        # In these, the light from infinity that Mitsuba lets through depends on the technique and the point.
        return None, []
    cosine = max((m.mean_cosine for m in needs.media if m.mean_cosine is not None), default=0.0)
    if cosine < MIN_SIDE_FLIGHT_COSINE:
        return None, []
    why = f"emitters are at infinity, and a phase function has a mean cosine of {cosine:.2f}"
    return min(cosine, 0.95), [Choice("side flights", "towards the emitter of the next collision", why)]


def choose_shadow_table(needs: Needs, settings: Settings, segment: str) -> tuple[int, list[Choice]]:
    """Choose the nodes along an edge of a table of shadows for images; 0 for a shadow ray at each vertex of a path."""
    if segment != "free_flight" or settings.scatterings < 2 or settings.shadows in ("exact", "estimated") or needs.is_sealed:
        return 0, []
    walked = any(m.resolutions or m.has_own_walk for m in needs.media)
    ends = all(boundary.around is not None for boundary in needs.boundaries)
    emitters = sum(kind != "uniform" for kind in needs.emitter_kinds)
    if not walked or not ends or not emitters or any(m.bounded for m in needs.media):
        return 0, []
    nodes = int(min((TABLE_SHARE * needs.film_samples / emitters) ** (1 / 3), MAX_TABLE_NODES))
    if nodes < MIN_TABLE_NODES:
        return 0, []
    method = f"one exact shadow ray a path, chosen by a table of {nodes}^3 nodes for {emitters} emitters"
    return nodes, [Choice("shadows in media", method, "no bias, and few rays to walk")]


def choose_successive_paths(needs: Needs, settings: Settings, segment: str) -> tuple[int, list[Choice]]:
    """Choose the number of paths per lane, walked one after the other, for images with enough paths."""
    if segment != "free_flight" or settings.scatterings < MIN_SUCCESSIVE_SCATTERINGS:
        return 1, []
    subject = "lanes"
    if not needs.are_samples_independent:
        return 1, [Choice(subject, "one path each", "the scene's sampler has numbers for one path per lane")]
    many = f"up to {SUCCESSIVE_PATHS} paths one after the other"
    return SUCCESSIVE_PATHS, [Choice(subject, many, "path lengths differ, and lanes would wait for the longest path")]


def choose_branches(needs: Needs, settings: Settings, segment: str) -> tuple[bool, list[Choice]]:
    """Choose whether paths branch at their first collision, for derivatives."""
    if segment != "free_flight" or settings.scatterings < 1 or not needs.are_samples_independent:
        return False, []
    why = "colliding paths cause most noise of derivatives, and few camera rays may collide"
    return True, [Choice("derivatives", "paths branch where they first collide", why)]


def is_branch_noise_open(needs: Needs, settings: Settings, segment: str) -> bool:
    """Whether a preview decides if paths branch at their first collision, in images."""
    if segment != "free_flight" or settings.scatterings < 2 or not is_scattering_visible(needs, settings):
        return False
    return needs.are_samples_independent and needs.film_samples >= MIN_BRANCHING_SAMPLES


def choose_image_branches(needs: Needs, settings: Settings, segment: str, draws_near_light: bool) -> tuple[int, list[Choice]]:
    """Choose the number of branches of a path at the first collision, in images; 1 for none.

    With k branches at r times the time of a stem each, variance x time is (A + B / k)(1 + r k). Segments that draw the light of
    near emitters (``draws_near_light``) raise r.
    """
    if not is_branch_noise_open(needs, settings, segment) or needs.branch_noise is None:
        return 1, []
    noise, event, most = needs.branch_noise, EVENT_COST, MAX_BRANCHING_TIME
    if draws_near_light:
        event, most = NEAR_EVENT_COST, MAX_NEAR_BRANCHING_TIME
    r = noise.share * (BRANCH_COST + event * noise.events)
    counts = [k for k in range(1, MAX_IMAGE_BRANCHES + 1) if 1 + r * k <= most * (1 + r)]
    work = {k: (noise.stem + noise.branch / k) * (1 + r * k) for k in counts}
    best = min(work, key=work.get)
    gain = work[1] / work[best] if work[best] > 0 else 0.0
    total = noise.stem + noise.branch
    share = f"light behind first collisions has {noise.branch / total if total > 0 else 0:.0%} of the noise in a preview"
    if gain < MIN_BRANCHING_GAIN:
        return 1, [Choice("paths in images", "paths do not branch", share)]
    why = f"{share}, and {noise.share:.0%} of the camera rays collide: the same error {gain:.2g} times as fast"
    return best, [Choice("paths in images", f"paths have {best} branches behind their first collision", why)]


def choose_media_light(needs: Needs, settings: Settings) -> tuple[bool, list[Choice]]:
    """Choose whether scattering points sample the light emitted by media."""
    subject = "light of media"
    if settings.scatterings < 1 or not any(m.emits for m in needs.media):
        return False, []
    if not needs.surfaces and not any(m.is_scattering for m in needs.media):
        return False, []
    if settings.media_light == "met":
        return False, [Choice(subject, "met by chance", "set by the user")]
    light = needs.media_light
    if light is None:
        return False, [Choice(subject, "met by chance", _explain_missing_light(needs))]
    draws, gain = settings.media_light == "drawn" or light.gain > 1, f"{light.gain:.2g} times as fast as chance alone"
    method = "sampled by emission, and met by chance" if draws else "met by chance"
    return draws, [Choice(subject, method, f"sampling reaches the same error {gain}")]


def distance_class(distance: float) -> tuple[bool, bool, bool]:
    """What a plan depends on in the distance of an emitter to a medium (``Needs.emitter_distances``)."""
    return distance == 0, distance < NEAR_DISTANCE, math.isinf(distance)


def is_near_light_open(needs: Needs, settings: Settings, segment: str) -> bool:
    """Whether a preview decides where the light of near emitters is drawn."""
    can_draw = _explain_missing_near_light(needs, segment) is None
    return can_draw and settings.near_light == "auto" and 0 < needs.nearness < NEAR_DISTANCE


def is_dense(medium: MediumFacts) -> bool:
    """Whether segments through a medium also draw the light of near emitters in derivatives."""
    return (medium.tau_max or 0.0) >= DENSE


def choose_near_light(needs: Needs, settings: Settings, segment: str) -> tuple[bool, bool, list[Choice]]:
    """Choose whether segments of paths in media draw the light of near emitters: in images, and in derivatives."""
    subject, vertices, segments = "near emitters", "lit at collisions", "lit at a distance drawn on each segment"
    if segment != "free_flight" or math.isinf(needs.nearness):
        return False, False, []
    missing = _explain_missing_near_light(needs, segment)
    if missing is not None:
        return False, False, [Choice(subject, vertices, missing)]
    if settings.near_light != "auto":
        draws = settings.near_light == "segments"
        return draws, draws, [Choice(subject, segments if draws else vertices, "set by the user")]
    if needs.nearness == 0:
        why = "an emitter with a position lies inside a medium, and its light at collisions has a heavy tail"
        return True, True, [Choice(subject, f"{segments}; directions are drawn around emitters inside", why)]
    where = f"the nearest emitter with a position is {needs.nearness:.2g} edge lengths away from a medium"
    if needs.nearness >= NEAR_DISTANCE:
        return False, False, [Choice(subject, vertices, where)]
    if needs.near_gain is None:
        return False, False, [Choice(subject, vertices, f"{where}, and no preview has measured the noise")]
    why = f"{where}; a distance on each segment reaches the same error {needs.near_gain:.2g} times as fast as collisions"
    if needs.near_gain <= 1:
        return False, False, [Choice(subject, vertices, why)]
    grids = [m for m in needs.media if m.resolutions]
    if not grids or any(is_dense(m) for m in grids):
        return True, True, [Choice(subject, segments, why)]
    why += f" in an image; derivatives by a grid have less noise with collisions, up to an optical depth of about {DENSE:g}"
    return True, False, [Choice(subject, f"{segments}; in derivatives, {vertices}", why)]


def is_lamp_noise_open(needs: Needs, settings: Settings) -> bool:
    """Whether a preview decides if lamps that the camera sees get camera rays of their own."""
    return _explain_missing_lamp_rays(needs, settings) is None


def choose_lamp_rays(needs: Needs, settings: Settings) -> tuple[int, list[Choice]]:
    """Choose the number of own camera rays a sample for the light of lamps seen directly, in images; 0 for none.

    Variance: with n samples spread over a pixel, an edge has n^(-3/2) times its variance for one sample, and all other light
    n^-1 times.
    """
    if not needs.has_lamps or needs.lamp_noise is None or _explain_missing_lamp_rays(needs, settings) is not None:
        return 0, []
    edge, rest = needs.lamp_noise
    edge /= math.sqrt(needs.spp)
    work = {k: (edge * k**-1.5 + rest) * (1 + k * LAMP_COST) for k in LAMP_RAYS}
    best = min(work, key=work.get)
    gain = (edge + rest) / work[best] if work[best] > 0 else 0.0
    share = f"edges of lamps have {edge / (edge + rest) if edge + rest > 0 else 0:.0%} of the noise in a preview"
    if gain < MIN_LAMP_GAIN:
        return 0, [Choice("lamps in view", "found by paths", share)]
    why = f"{share}; their rays are cheap, and reach the same error {gain:.2g} times as fast"
    return best, [Choice("lamps in view", f"{best} camera rays of their own for each path, in images", why)]


def is_emission_noise_open(needs: Needs, settings: Settings, segment: str) -> bool:
    """Whether a preview decides if the light of media that reaches the camera unscattered gets camera rays of its own."""
    if segment != "free_flight" or not any(m.emits for m in needs.media):
        return False
    if not needs.are_samples_independent or not needs.is_colour_film or needs.film_samples < MIN_LAMP_SAMPLES:
        return False
    # One walk of the cells sums the light.
    walks = not any(m.bounded or m.has_own_walk or m.unread for m in needs.media)
    return walks and all(shares_cells(view) and view.microflakes is None for view in needs.views)


def choose_emission_rays(needs: Needs, settings: Settings, segment: str) -> tuple[int, list[Choice]]:
    """Choose the number of own camera rays of a pixel for the unscattered light of media, in images; 0 for none.

    Variance: as of lamps in :func:`choose_lamp_rays`. This light and the light behind the medium may make up for each other, so
    the variance of whole paths is measured too.
    """
    if not is_emission_noise_open(needs, settings, segment) or needs.emission_noise is None:
        return 0, []
    words = "emission in view", "found by paths", "summed"
    count, _, choice = _choose_own_rays(needs.emission_noise, needs.spp, EMISSION_COST, *words)
    return count, [choice]


def is_mirror_noise_open(needs: Needs, settings: Settings, segment: str) -> bool:
    """Whether a preview decides if the light that glass mirrors to the camera gets camera rays of its own."""
    if segment != "free_flight" or settings.scatterings < 1 or not needs.has_glass:
        return False
    if any(m.emits and m.has_own_walk for m in needs.media):
        return False  # the rays of mirrors would count the light of Gaussians before the glass once more
    return needs.are_samples_independent and needs.is_colour_film and needs.film_samples >= MIN_LAMP_SAMPLES


def is_refracted_light_open(needs: Needs, settings: Settings, segment: str) -> bool:
    """Whether a preview decides if vertices draw the light of lamps behind smooth glass, in images."""
    shines = needs.has_lamps or "EnvironmentMapEmitter" in needs.emitters
    if segment != "free_flight" or settings.scatterings < 2 or not (needs.has_glass and shines):
        return False
    return needs.are_samples_independent and needs.is_colour_film and needs.film_samples >= MIN_LAMP_SAMPLES


def choose_refracted_light(needs: Needs, settings: Settings, segment: str) -> tuple[bool, list[Choice]]:
    """Choose whether vertices draw directions to lamps through smooth glass, in images, or paths meet these lamps by chance."""
    if not is_refracted_light_open(needs, settings, segment) or needs.refracted_noise is None:
        return False, []
    noise, subject = needs.refracted_noise, "lamps behind glass"
    gain = noise.by_chance / (noise.drawn * REFRACTED_COST) if noise.drawn > 0 else 0.0
    if gain < MIN_REFRACTED_GAIN:
        how = "the time of directions through the glass is not worth their gain in a preview"
        return False, [Choice(subject, "met by chance", f"{how}: the same error {gain:.2g} times as fast")]
    why = f"paths seldom meet the lamps by chance: in a preview the same error {gain:.2g} times as fast"
    return True, [Choice(subject, "a direction drawn through the glass at each vertex, in images", why)]


def choose_mirror_rays(needs: Needs, settings: Settings, segment: str) -> tuple[int, bool, list[Choice]]:
    """Choose a way to find the light mirrored by glass, in images.

    Glass mirrors 4 to 8 % of the light, so by chance few samples see a mirror image.

    Returns:
        Number of own camera rays of a pixel for the light mirrored by the first glass, or 0; and whether paths keep a mirrored
        ray.
    """
    if not is_mirror_noise_open(needs, settings, segment) or needs.mirror_noise is None:
        return 0, False, []
    noise, subject = needs.mirror_noise, "light mirrored by glass"
    count, gain, choice = _choose_own_rays(noise.own, needs.spp, MIRROR_COST, subject, "found by chance", "found")
    kept = noise.own.paths / (noise.kept * KEPT_COST) if noise.kept > 0 else 0.0
    if kept < max(gain, MIN_OWN_GAIN):
        return count, False, [choice]
    why = f"lamps in mirrors have much of the noise of paths in a preview: the same error {kept:.2g} times as fast"
    how = "lamps in it found by one ray that a path keeps of all that glass mirrors, in images"
    return 0, True, [Choice(subject, how, why)]


def _choose_own_rays(
    noise: OwnRaysNoise, spp: int, cost: float, subject: str, without: str, verb: str
) -> tuple[int, float, Choice]:
    """Choose the number of own camera rays of a pixel with the least variance x time, 0 for none; also returns the gain.

    Args:
        noise: measured variances.
        spp: samples per pixel.
        cost: time of an own ray over the time of a path [1].
        subject: the light.
        without: how the light is found without own rays.
        verb: what own rays do with the light.
    """
    counts = {max(1, round(share * spp)) for share in OWN_RAYS}
    work = {k: (noise.rays * k**-1.5 + noise.rest / spp) * (1 + cost * k / spp) for k in sorted(counts)}
    best = min(work, key=work.get)
    gain = noise.paths / spp / work[best] if work[best] > 0 else 0.0
    ratio = noise.paths / noise.rest if noise.rest > 0 else math.inf
    share = f"with it, paths have {ratio:.2g} times the noise of all other light in a preview"
    if gain < MIN_OWN_GAIN:
        return 0, 1.0, Choice(subject, without, share)
    why = f"{share}: the same error {gain:.2g} times as fast"
    return best, gain, Choice(subject, f"{verb} along {best} camera rays of its own a pixel, in images", why)


def _explain_missing_lamp_rays(needs: Needs, settings: Settings) -> str | None:
    """The reason why lamps cannot have camera rays of their own; None if they can."""
    if settings.scatterings == 0 or settings.hide_emitters or not needs.has_lamps:
        return "the image shows nothing else, or no lamps"
    if any(m.bounded or m.has_own_walk for m in needs.media):
        return "the transmittance to a lamp has no closed form"
    if not needs.are_samples_independent or not needs.is_colour_film:
        return "another sampler or film is asked for"
    return "a preview costs more than the image" if needs.film_samples < MIN_LAMP_SAMPLES else None


def _explain_missing_near_light(needs: Needs, segment: str) -> str | None:
    """The reason why segments cannot draw the light of near emitters; None if they can."""
    if segment != "free_flight" or math.isinf(needs.nearness):
        return "no path in media meets the light of an emitter with a position"
    if any(m.bounded for m in needs.media):
        return "only a majorant of a medium is known"
    if any(m.has_own_walk for m in needs.media):
        return "a medium consists of Gaussians or is an octree"
    return "media lie behind refracting boundaries" if needs.is_sealed else None


def _explain_missing_light(needs: Needs) -> str:
    """The reason why the light of media cannot be sampled."""
    if any(m.unread for m in needs.media):
        return "the emission cannot be read while dr.freeze records"
    if any(m.bounded for m in needs.media):
        return "only a majorant of a medium is known"
    if any(m.has_own_walk for m in needs.media):
        return "a medium consists of Gaussians or is an octree, which the table of light does not hold"
    return "an emitting medium fills no shape of its own, or shapes are instances"


def describe_orders(needs: Needs, settings: Settings, segment: str, draws_near_light: bool, flies_aside: bool) -> Choice | None:
    """Say which estimator finds which order of scattering in images, and why; None without scattered light."""
    if not is_scattering_visible(needs, settings):
        return None
    subject = "scattering orders"
    if segment != "free_flight":
        return Choice(
            subject, "one scattering, at points of each camera ray", "no light scatters twice, and none is left to chance"
        )
    if needs.is_sealed:
        return Choice(subject, "all by paths that leave the media by chance", "no straight ray leads from inside to an emitter")
    if all(kind == "uniform" for kind in needs.emitter_kinds):
        return Choice(subject, "all by paths that escape", "every direction out of the media ends in the same light")
    if draws_near_light:
        others = "" if min(needs.emitter_distances) == max(needs.emitter_distances) else ", the light of others at collisions"
        method = f"each by a distance of its own on each segment for near emitters{others}"
        return Choice(subject, method, "collisions seldom lie where light of near emitters is strong")
    if flies_aside:
        method = "the first at collisions, the second and later ones also by side flights and directions about the emitter"
        return Choice(subject, method, "a peaked phase function turns light towards the path near the emitter's direction only")
    return Choice(subject, "each at the collisions of a path", "the light of emitters changes little along a flight")


def choose_scattering_points(needs: Needs, settings: Settings, segment: str) -> tuple[int, list[Choice]]:
    """Choose the number of scattering points per camera ray."""
    if segment != "single_scattering":
        return 1, []
    subject = "points that scatter"
    if len(needs.media) != 1 or len(needs.media[0].resolutions) != 1:
        return 1, [Choice(subject, "1 per camera ray", "there is more than one grid or none")]
    share = needs.media[0].occupied
    count = SCATTERING_POINTS[share >= MIN_FILLED_SHARE, set(needs.emitter_kinds) == {"delta"}]
    return count, [
        Choice(subject, f"{count} per camera ray", f"one walk for all points; {share:.0%} of the blocks are occupied")
    ]
