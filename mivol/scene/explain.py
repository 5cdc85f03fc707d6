"""The facts of a scene and the plan of its render, in words.

Conventions. The facts come first, even for a refused scene. A refusal is the last part of the text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.cite import list_citations
from mivol.errors import MivolError
from mivol.scene.choices import Choice, describe_orders, is_scattering_visible, shares_cells
from mivol.scene.depth_two import depth_two_error, mean_albedo, scattering_depth
from mivol.scene.needs import MediumFacts, Needs, find_clipped_view, find_needs, find_undefined_light, mean_cosine
from mivol.scene.nesting import shape_bounds
from mivol.scene.plan import Plan, build_media, make_plan
from mivol.scene.previews import (
    find_sufficient_depth,
    measure_emitter_noise,
    measure_noise,
)
from mivol.scene.render_tasks import find_unrecorded
from mivol.scene.scene_state import list_fixed_numbers
from mivol.scene.sensors import check_film, find_sensor
from mivol.scene.survey import survey_scene
from mivol.scene_graph import traverse_children
from mivol.transport.estimators.lighting.emitters import SceneEmitters
from mivol.transport.estimators.lighting.tabulated_shadows import TransmittanceGrid, measure_transmittance_bias
from mivol.transport.path.estimators import SEGMENT_ESTIMATORS, Settings
from mivol.transport.traversal.box import Box

UNLIMITED = 0xFFFFFFFF
"""The depth printed by Mitsuba's integrators for -1."""


def read_integrator_settings(scene: mi.Scene) -> Settings:
    """Read the settings of the scene's integrator: all of mivol, or the depth and ``hide_emitters`` of another integrator."""
    integrator = scene.integrator()
    session = getattr(integrator, "session", None)
    if session is not None:
        return session.settings
    printed = re.search(r"max_depth ?= ?(-?\d+)", str(integrator))
    depth = Settings().max_depth if printed is None else int(printed.group(1))
    hidden = bool(getattr(integrator, "hide_emitters", False))
    return Settings(max_depth=-1 if depth == UNLIMITED else depth, hide_emitters=hidden)


def describe_light(scene: mi.Scene, max_depth: int | None = None) -> dict[str, Any]:
    """Settings with which any integrator renders the same light as the scene's: its longest path, and its hidden emitters.

    Args:
        scene: the scene.
        max_depth: another longest path; None means the scene's.
    """
    settings = read_integrator_settings(scene)
    depth = settings.max_depth if max_depth is None else max_depth
    return {"max_depth": depth, "hide_emitters": settings.hide_emitters}


@dataclass(frozen=True)
class Explanation:
    """The description of a scene.

    Attributes:
        lines: facts, plan and references.
        refusal: the reason why the scene cannot be rendered; empty for a scene that can.
    """

    lines: tuple[str, ...]
    refusal: str = ""

    @property
    def text(self) -> str:
        """The whole description."""
        return "\n".join([*self.lines, *(["refused", f"  {self.refusal}"] if self.refusal else [])])


def explain_scene(
    scene: mi.Scene, max_depth: int | None = None, sensor: int | mi.Sensor = 0, noise: float | None = None
) -> Explanation:
    """Describe the facts of a scene and the plan of its render. At most small previews are rendered.

    Arguments as in :func:`mivol.experiments.script.explain`.

    Returns:
        Facts and choices with their reasons, and a refusal separately.
    """
    eye = find_sensor(scene, sensor)
    settings = read_integrator_settings(scene)
    if max_depth is not None:
        settings = replace(settings, max_depth=max_depth)
    try:
        survey = survey_scene(scene)
        needs = find_needs(scene, eye, survey, reads_emission=settings.may_draw_emission)
    except MivolError as error:
        return Explanation(("facts", *_describe_unread_scene(scene), *_find_warnings(scene)), str(error))
    misplaced = (medium.misplacement for medium in needs.media)
    unseen = [*misplaced, find_clipped_view(needs, eye), find_undefined_light(needs, scene, eye)]
    facts = ("facts", *_describe_facts(needs), *_find_warnings(scene), *(f"  warning   {said}" for said in unseen if said))
    try:
        check_film(eye)
        make_plan(needs, settings)
        needs = measure_noise(scene, eye, needs, survey, settings, for_images=True)
        shares = measure_emitter_noise(scene, eye, needs, survey, settings)
        return Explanation((*facts, *_describe_plan(scene, eye, needs, settings, noise, shares)))
    except MivolError as error:
        return Explanation(facts, str(error))


def _describe_facts(needs: Needs) -> list[str]:
    lines = []
    for m in needs.media:
        grids = ", ".join("x".join(map(str, r)) for r in m.resolutions) or _kind_without_grids(m)
        scatters = "scatters" if m.is_scattering else "albedo 0"
        tau = "" if m.tau_max is None else f", optical depth at most {m.tau_max:.3g}"
        lines.append(
            f"  medium    {m.name}: {m.kind} in {m.boundary}, {m.extinction} extinction, {grids}, {scatters}, {m.phase}{tau}"
        )
    return [
        *lines,
        f"  surfaces  {', '.join(needs.surfaces) or 'none'}",
        f"  emitters  {', '.join(needs.emitters) or 'none'}",
        f"  camera    {'may be inside a medium' if needs.start or needs.camera_inside else 'outside all traced boundaries'}",
        f"  variant   {needs.variant}, {dr.thread_count()} threads",
    ]


def _kind_without_grids(medium: MediumFacts) -> str:
    """The kind of a medium without grids."""
    if medium.gaussians:
        return f"{medium.gaussians} Gaussians"
    if medium.leaves:
        return f"an octree of {medium.leaves} leaves"
    return f"a bounded {medium.bounded}" if medium.bounded else "homogeneous"


def _describe_unread_scene(scene: mi.Scene) -> list[str]:
    """Facts printed by Mitsuba, for a scene that mivol refuses to read."""
    lines = []
    for shape in scene.shapes():
        medium = shape.interior_medium()
        inside = "" if medium is None else f", {medium.class_name()} inside"
        lines.append(f"  shape     {shape.id()}: {shape.class_name()}{inside}")
    integrator = scene.integrator()
    return [
        *lines,
        f"  emitters  {', '.join(emitter.class_name() for emitter in scene.emitters()) or 'none'}",
        f"  sensors   {len(scene.sensors())}",
        f"  traced by {'nothing' if integrator is None else str(integrator).partition('[')[0].strip()}",
        f"  variant   {mi.variant()}, {dr.thread_count()} threads",
    ]


def _find_warnings(scene: mi.Scene) -> list[str]:
    """Warn of media without light: media behind an opaque BSDF, such as Mitsuba's default BSDF."""
    lines, open_ = [], int(mi.BSDFFlags.Null) | int(mi.BSDFFlags.Transmission)
    for shape in scene.shapes():
        if shape.interior_medium() is None:
            continue
        bsdf = shape.bsdf()
        flags = 0 if bsdf is None else int(mi.BSDFFlags.Null) if bsdf.class_name() == "NullBSDF" else _flags(bsdf)
        if bsdf is not None and not flags & open_:
            lines.append(
                f"  warning   the medium of {shape.id()} lies behind an opaque {bsdf.class_name()}, so no light enters: "
                'give the shape <bsdf type="null"/> (the default of Mitsuba is a diffuse BSDF)'
            )
    return lines


def _flags(bsdf: mi.BSDF) -> int:
    flags = bsdf.flags()
    return int(flags[0]) if dr.is_array_v(flags) else int(flags)


def _describe_plan(
    scene: mi.Scene,
    eye: mi.Sensor,
    needs: Needs,
    settings: Settings,
    noise: float | None,
    shares: list[tuple[str, float]],
) -> list[str]:
    plan = make_plan(needs, settings)
    orders = describe_orders(needs, settings, plan.segment, plan.draws_near_light, plan.side_flight_cosine is not None)
    choices = [*plan.choices, *([orders] if orders else []), *([_describe_noise(shares)] if shares else [])]
    choices += [choose_recording(scene, eye, needs, plan, for_images) for for_images in (True, False)]
    width = max(len(c.subject) for c in choices)
    lines = ["plan", *(f"  {c.subject:<{width}}  {c.choice}\n  {'':<{width}}    because {c.reason}" for c in choices)]
    lines += [f"  table     {text}" for text in _describe_transfer_tables(needs)]
    if settings.scatterings == 1:
        lines += [f"  model     {text}" for text in _describe_depth_two(scene, needs)]
        lines += [f"  shadows   {text}" for text in _describe_light_grid(scene, needs, plan, settings)]
    if noise is not None and is_scattering_visible(needs, settings):
        answer = find_sufficient_depth(scene, eye, settings, noise)
        depth = "-1 (no limit)" if answer.depth < 0 else answer.depth
        lines += [f"  depth     max_depth {depth} is enough\n              because {answer.reason}"]
    return [*lines, "references", *(f"  {source}" for source in list_citations(SEGMENT_ESTIMATORS[plan.segment].cites))]


def _describe_noise(shares: list[tuple[str, float]]) -> Choice:
    """Name the lights that make most of the noise."""
    most = [f"{name} makes {share:.0%}" for name, share in shares[:2] if share >= 0.01]
    if sum(share for _, share in shares) < 0.9:
        most.append("several lights together make the rest")
    return Choice("noise", ", ".join(most), "without a light, the variance of a small preview falls by its share")


def choose_recording(scene: mi.Scene, sensor: mi.Sensor, needs: Needs, plan: Plan, for_images: bool) -> Choice:
    """Whether images, or gradients, are recorded in their first call and replayed in later ones."""
    reason = find_unrecorded(scene, sensor, 0, needs, plan, for_images)
    choice = "recorded in the first call, then replayed" if reason is None else "traced in every call"
    fixed = ", ".join(["the film", "the number of samples", *list_fixed_numbers(scene)])
    followed = (
        "a recording follows values, places, cameras and seeds that change between calls; each change of these is recorded "
        f"anew: {fixed}"
    )
    return Choice("images" if for_images else "gradients", choice, reason or followed)


def _describe_light_grid(scene: mi.Scene, needs: Needs, plan: Plan, settings: Settings) -> list[str]:
    """Cost and measured bias of a transmittance grid in place of shadow rays."""
    if not is_scattering_visible(needs, settings) or set(needs.emitter_kinds) != {"delta"} or len(needs.media) != 1:
        return []
    if not shares_cells(needs.views[0]) or any(part.lattice is None for part in needs.views[0].parts):
        return []
    with dr.suspend_grad():
        media, emitters = build_media(scene, needs, plan, survey_scene(scene)), SceneEmitters(scene)
        lattice = media.bodies[0].view.parts[0].lattice
        grid = TransmittanceGrid.over_lattice(media, emitters, lattice)
        bias, rms = measure_transmittance_bias(media, emitters, grid, lattice)
    nodes = grid.nodes[0] * grid.nodes[1] * grid.nodes[2]
    rays = needs.film_samples * sum(needs.media[0].resolutions[0])
    pays = "pays" if nodes < rays else "does not pay"
    asked = "set" if settings.shadows == "grid" else "exact; with deterministic"
    return [
        f"{asked}, a light grid of {nodes} nodes {pays} against about {rays} shadow rays, at a bias of "
        f"{bias:+.2g} of an emitter's light (rms {rms:.2g}, measured against exact shadows)"
    ]


def _describe_transfer_tables(needs: Needs) -> list[str]:
    """Error of each ``mivol_transfer`` between its nodes, compared with its table."""
    lines = []
    for facts, boundary in zip(needs.media, needs.boundaries, strict=True):
        volumes = {key.split(".")[0]: entry[2] for key, entry in traverse_children(boundary.medium).properties.items()}
        for name, volume in volumes.items():
            if not hasattr(volume, "mivol_transfer"):
                continue
            table = volume.mivol_transfer
            missed, finer = table.interpolation_error(), table.refine + 2
            advice = f"; refine = {finer} would be closer, at {(finer / table.refine) ** 3:.3g} times the memory"
            lines.append(
                f"{name} of {facts.name} differs from its table by {missed:.2g} of the largest entry halfway between nodes "
                f"(rms){advice if missed > 0.02 else ''}"
            )
    return lines


def _describe_depth_two(scene: mi.Scene, needs: Needs) -> list[str]:
    """Share of the scattered light of each medium that ``max_depth`` 2 omits (:mod:`mivol.scene.depth_two`).

    Bounded media are left out: their optical depth is unknown.
    """
    lines = []
    light = "collimated" if "delta" in needs.emitter_kinds else "constant"
    for facts, boundary, view in zip(needs.media, needs.boundaries, needs.views, strict=True):
        box, traced = boundary.box, None
        if box is None or box.is_round:
            box, traced = _padded_box(scene, boundary.medium), scene
        if not facts.is_scattering or facts.bounded or box is None:
            continue
        tau, albedo = scattering_depth(view, box, scene=traced), mean_albedo(view)
        phase = "forward" if mean_cosine(boundary.medium.phase_function()) > 0.4 else "isotropic"
        missing = depth_two_error(min(albedo, 1.0), tau, light, phase)
        way_out = "; depth 2 is a poor model of this medium: raise max_depth (docs/examples.md shows the effect on fits)"
        lines.append(
            f"max_depth 2 leaves out {missing:.0%} of the light that {facts.name} scatters (albedo {albedo:.2f}, optical "
            f"depth {tau:.2g}, {light} light, {phase} phase){way_out if missing > 0.1 else ''}"
        )
    return lines


def _padded_box(scene: mi.Scene, medium: mi.Medium) -> Box | None:
    """A box slightly larger than a medium, so that the lines of :func:`sample_lines` start outside; None for a medium outside
    shapes.
    """
    inside = [s.interior_medium() for s in scene.shapes()]
    boxes = [shape_bounds(s) for s, m in zip(scene.shapes(), inside, strict=True) if m is not None and m.ptr == medium.ptr]
    if not boxes:
        return None
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    # The padding lets the lines of :func:`sample_lines` start outside of the boundary.
    room, place = 1e-3 * (high - low).max(), np.eye(4)
    place[:3, :3], place[:3, 3] = np.diag(high - low + 2 * room), low - room
    return Box(place)
