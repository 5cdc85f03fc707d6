"""What is done about a scene's needs: choices, each with its reason, before anything is rendered.

Conventions. A plan is made of :class:`Choice` only; ``explain`` prints it. What cannot be rendered is refused here, with a
sentence, before a kernel runs.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.machine import available_memory
from mivol.scene.depth_two import depth_two_error, mean_albedo, mean_cosine, scattering_depth
from mivol.scene.load import find_sensor
from mivol.scene.needs import MediumFacts, Needs, Survey, find_needs, read_block_ranges, read_empty_distances, survey_scene
from mivol.scene.nesting import bounds
from mivol.transport.estimators.emitters import SceneEmitters
from mivol.transport.estimators.transmittance_grid import build_transmittance_grid, measure_transmittance_bias
from mivol.transport.line_integrals.aovs import AOVS
from mivol.transport.media.body import Body, flight_parts
from mivol.transport.media.box import Box
from mivol.transport.media.grid_integral import PACKED_LIMIT, gradient_bytes
from mivol.transport.media.medium_view import MediumView
from mivol.transport.media.read_medium import traverse_medium
from mivol.transport.media.scene_media import World
from mivol.transport.media.summed_extinction import share_cells
from mivol.transport.path.settings import Settings

__all__ = ["Choice", "Plan", "build_world", "check_aovs", "explain", "make_plan"]

SKIP_BELOW = 0.45
"""Share of occupied blocks below which skipping pays (it costs 8 reads a cell in place of 4; measured, as fast as
without: smoke of 48 % 0.9 times, CT of 43 % 1.05 to 1.1 times, smoke of 256^3, 43 %, 1.3 to 1.4 times)."""

UNLIMITED = 0xFFFFFFFF
"""The depth that Mitsuba's integrators print for -1."""

PASS_RAYS = {"llvm": 1 << 22, "cuda": 1 << 25, "metal": 1 << 24}
"""Most rays of one pass, through media without grids or with small ones."""

PASS_STEPS = {"llvm": 1 << 29, "cuda": 1 << 34, "metal": 1 << 32}
"""Most cells that the rays of one pass may cross: a second or two of work, so that Ctrl-C is heard."""


SHADOWS = ("auto", "exact", "estimated", "grid")
"""How light from lamps is dimmed: ``grid`` for quadrature only, ``estimated`` for pictures that are drawn; ``auto`` chooses."""

FINE = 300
"""Occupied cells along the three axes together from which look-ups for a shadow cost less than its cells (measured on 2 cores,
variance x time: smoke of 142 cells 0.4 times as fast, of 256^3 twice; CT of 445 cells 1.9 times; threads of 111 0.9)."""

EVENTS = {(True, False): 4, (True, True): 8, (False, False): 2, (False, True): 2}
"""Points of a camera ray that scatter, by whether its grid is filled and whether every lamp has one position or direction, so
that a walk costs more and a shadow ray less (measured, variance x time over that of 1 point: smoke 1.5 to 2, CT 1.5 to 2.4;
threads, whose noise is what a pixel sees of them: 1.0 to 1.2, 4 points 0.9 to 1.3; of 8 points over 4, point lights: smoke 1.1,
CT 1.1 and 1.3)."""

FILLED = 0.25
"""Share of occupied blocks from which a grid counts as filled."""


@dataclass(frozen=True)
class Choice:
    """One decision: about what, which, and why."""

    about: str
    choice: str
    reason: str


@dataclass(frozen=True)
class Plan:
    """The choices for a scene.

    ``skips`` tells for each medium whether empty blocks are skipped, ``tracks`` whether its shadows are estimated in pictures;
    ``events`` how many points of a camera ray scatter in pictures; ``pass_rays`` how many rays a pass may hold;
    ``gradient_bytes`` what a gradient step takes beyond the rays.
    """

    choices: tuple[Choice, ...]
    skips: tuple[bool, ...]
    tracks: tuple[bool, ...]
    events: int
    pass_rays: int
    gradient_bytes: int


def make_plan(needs: Needs, settings: Settings) -> Plan:
    """Choose from the facts.

    Raises:
        MivolError: what is asked for is not there yet (a medium that scatters, at depth 3 or more; derivatives of shapes),
            or a gradient step would not fit into memory.
    """
    _refuse_scattering(needs, settings)
    _refuse_refraction(needs, settings)
    _refuse_emission(needs, settings)
    _refuse_quadrature(needs, settings)
    _refuse_places(needs)
    choices = [_transport(needs, settings), *_emission(needs), *_lighting(needs, settings), _tracing(needs), _channels(needs)]
    skips = tuple(bool(m.resolutions) and m.occupied < SKIP_BELOW for m in needs.media)
    choices += [_skipping(m, skip) for m, skip in zip(needs.media, skips, strict=True) if m.resolutions]
    shadows = [_shadows(m, needs, settings) for m in needs.media]
    tracks = tuple(choice is not None and choice.choice == "estimated" for choice in shadows)
    choices += [choice for choice in shadows if choice is not None]
    events, why = _events(needs, settings)
    choices += why
    pass_rays = _pass_rays(needs)
    passes = -(-needs.film_samples // pass_rays)
    choices.append(
        Choice("passes", f"{passes} of at most {pass_rays} rays", f"{needs.film_samples} samples; a pass ends within seconds")
    )
    memory, choice = _gradient(needs)
    choices.append(choice)
    return Plan(tuple(choices), skips, tracks, events, pass_rays, memory)


def check_aovs(names: str) -> tuple[str, ...]:
    """Split a comma list of AOVs.

    Raises:
        MivolError: a name that is not in :data:`mivol.transport.line_integrals.aovs.AOVS`, or one given twice.
    """
    asked = tuple(n.strip() for n in names.split(",") if n.strip())
    for name in asked:
        if name not in AOVS:
            near = difflib.get_close_matches(name, AOVS, 1, 0.0)[0]
            raise MivolError(f"aovs asks for {name!r}; mivol has {', '.join(AOVS)} (did you mean {near!r}?).")
        if asked.count(name) > 1:
            raise MivolError(f"aovs asks for {name!r} {asked.count(name)} times; a film has one channel of a name: ask once.")
    return asked


def _refuse_scattering(needs: Needs, settings: Settings) -> None:
    for medium in needs.media:
        if medium.is_scattering and not medium.unread and settings.max_depth not in (0, 1, 2):
            raise MivolError(
                f"the medium in {medium.name} scatters (its albedo is above 0) and max_depth is {settings.max_depth}; mivol "
                "renders one scattering so far: set max_depth to 2, to 1 (what is seen through the medium), or the albedo to 0."
            )


def _refuse_refraction(needs: Needs, settings: Settings) -> None:
    if needs.refractive and settings.max_depth == 2 and any(m.is_scattering for m in needs.media):
        raise MivolError(
            f"the boundary {needs.refractive[0]} refracts and its scene has a medium that scatters; no straight shadow ray "
            "reaches a lamp through it: make the boundary's BSDF null, set max_depth to 1, or the albedo to 0."
        )


def _refuse_emission(needs: Needs, settings: Settings) -> None:
    glowing = [m.name for m in needs.media if m.emits]
    if glowing and _is_lit(needs, settings):
        raise MivolError(
            f"the medium in {glowing[0]} emits and a medium of its scene scatters at max_depth 2; the light of one that is "
            "scattered by the other is not there yet: set max_depth to 1, or the albedo to 0."
        )
    for facts, view in zip(needs.media, needs.views, strict=True):
        if isinstance(view.emission_density, mi.Volume) and not share_cells(view.walked_lattice, view.emission_lattice):
            raise MivolError(
                f"the emission_density of the medium in {facts.name} has {view.emission_lattice.res} voxels (Z, Y, X) and its "
                f"extinction {view.walked_lattice.res}, or they lie in different places; it is summed in the cells of the "
                "extinction: give both the same resolution and to_world."
            )
        for name, volume in (("emission", view.emission), ("albedo", view.albedo)) if view.emission is not None else ():
            least = _voxel_over_cells(volume, view) if isinstance(volume, mi.Volume) else 1.0
            if least < 1 - 1e-4:  # the place of a stock grid is known to 5e-6
                led = any(p.lattice is not None for p in view.parts)
                whose, advice = ("extinction", ", or give it as a number") if led else ("emission_density", "")
                raise MivolError(
                    f"the {name} of the medium in {facts.name} varies over lengths of {least:.2g} of its {whose}'s cells, "
                    f"which are looked at in two points; resample the {whose} to voxels as small{advice}."
                )


def _voxel_over_cells(volume: mi.Volume, view: MediumView) -> float:
    """A voxel of a volume over the longest edge of a cell that is walked, both as the volume counts lengths."""
    cells = view.walked_lattice
    place = volume.mivol_to_world if hasattr(volume, "mivol_to_world") else view.stock_boxes[volume.ptr].to_world
    edges = cells.to_world[:3, :3] / np.array(cells.res[::-1])
    voxels = np.linalg.solve(place[:3, :3], edges) * np.array(volume.resolution(), dtype=np.float64)[:, None]
    return 1 / float(np.linalg.norm(voxels, axis=0).max())


def _refuse_places(needs: Needs) -> None:
    if needs.places:
        raise MivolError(
            f"the derivative of {needs.places[0]} was asked for; mivol has none of shapes, of lamps that have a size, nor of "
            "cameras: take that of a point, spot or directional light, or finite differences."
        )


def _refuse_quadrature(needs: Needs, settings: Settings) -> None:
    if settings.shadows not in SHADOWS:
        raise MivolError(f"shadows is {settings.shadows!r}; {', '.join(SHADOWS[:-1])} or {SHADOWS[-1]} is expected.")
    if settings.shadows == "estimated" and settings.deterministic:
        raise MivolError("shadows is 'estimated' and deterministic is set: estimates are noise; set shadows to exact or grid.")
    if settings.shadows == "grid" and not settings.deterministic:
        raise MivolError("shadows is 'grid' without deterministic, and drawn light has exact shadows: set deterministic too.")
    if not settings.deterministic or not _is_lit(needs, settings):
        return
    other = [kind for kind, lamp in zip(needs.emitters, needs.lamps, strict=True) if lamp != "sharp"]
    if other:
        raise MivolError(
            f"deterministic is set and the scene has a {other[0]}; quadrature is for lamps of one position or direction "
            "(point, spot, directional): leave deterministic out."
        )
    if len(needs.media) > 1 or not _share_cells(needs):
        grids = sum(len(m.resolutions) for m in needs.media)
        raise MivolError(
            f"deterministic is set and the scene has {len(needs.media)} media with {grids} grids of extinction; quadrature is "
            "for one medium whose grids share their cells: leave deterministic out."
        )
    constant = next((part.name for part in needs.views[0].parts if part.lattice is None), None)
    if settings.shadows == "grid" and constant is not None:
        raise MivolError(
            f"shadows is 'grid' and {constant} of the medium in {needs.media[0].name} is a constant, which may fill more than "
            "the cells that shadows are looked up in: set shadows to exact."
        )


def _share_cells(needs: Needs) -> bool:
    """Whether one walk passes all of the first medium."""
    parts = needs.views[0].parts
    return len(flight_parts(parts)) == len(parts)


def _pass_rays(needs: Needs) -> int:
    """How many rays a pass may hold: fewer where each has many cells to cross."""
    backend = needs.variant.split("_")[0]
    cells = sum(sum(res) for medium in needs.media for res in medium.resolutions)
    return min(PASS_RAYS[backend], PASS_STEPS[backend] // max(cells, 1))


def _is_lit(needs: Needs, settings: Settings) -> bool:
    """Whether media scatter light to the camera."""
    return settings.max_depth == 2 and any(m.is_scattering for m in needs.media)


def _transport(needs: Needs, settings: Settings) -> Choice:
    if not needs.media:
        return Choice("media", "none", "no shape bounds a medium")
    if _is_lit(needs, settings):
        where = "by quadrature" if settings.deterministic else "at a distance drawn in proportion to the light it takes"
        shadows = "a light grid for shadows" if settings.shadows == "grid" else "exact shadow rays"
        what = f"exact optical depth; one scattering {where}, {shadows}"
        return Choice("media", what, "an albedo is above 0 and max_depth is 2")
    why = "albedo 0" if not any(m.is_scattering for m in needs.media) else "max_depth 1 sees no scattered light"
    if any(m.unread for m in needs.media):
        why = "values cannot be read while dr.freeze records; absorption was promised by max_depth or by an earlier render"
    what = "exact optical depth; no phase function, no light sampling in media, no albedo look-up"
    return Choice("media", what, why)


def _emission(needs: Needs) -> list[Choice]:
    """How emitted light is summed."""
    names = [m.name for m in needs.media if m.emits]
    if not names:
        return []
    return [Choice("emission", "two points a cell, swept from the far end", f"{', '.join(names)} emit")]


def _lighting(needs: Needs, settings: Settings) -> list[Choice]:
    """How scattered light is found."""
    if not _is_lit(needs, settings):
        return []
    drawn = [lamp for lamp in needs.lamps if lamp != "uniform"]
    met = [lamp for lamp in needs.lamps if lamp != "sharp"]
    if not needs.lamps:
        return [Choice("directions", "none", "the scene has no emitter")]
    if settings.deterministic:
        where = "at two points of each piece of a cell, from every lamp"
        return [Choice("where to scatter", where, "deterministic was asked for")]
    if not drawn:
        choices = [Choice("directions", "one, of the phase function", "light is the same from everywhere")]
    elif not met:
        choices = [Choice("directions", f"one, to one of {len(drawn)} lamps", "no lamp can be met by chance")]
    else:
        why = f"{len(drawn)} lamps to aim at, {len(met)} that can be met by chance: the power heuristic weighs both"
        choices = [Choice("directions", "two: to a lamp, and of the phase function", why)]
    if "sharp" in drawn:
        alone = len(needs.media) == 1 and len(needs.media[0].resolutions) == 1
        what = "weighed by optical depth towards the lamps, from blocks of the grid" if alone else "by the camera's own ray"
        why = "a lamp of one position or direction" + ("" if alone else ", but more than one grid or none")
        choices.append(Choice("where to scatter", what, why))
    return choices


def _tracing(needs: Needs) -> Choice:
    traced = [m.name for m, b in zip(needs.media, needs.boundaries, strict=True) if b.box is None]
    if needs.surfaces:
        return Choice("acceleration structure", "traced", f"surfaces may stop a ray: {', '.join(sorted(set(needs.surfaces)))}")
    if traced:
        return Choice("acceleration structure", "traced", f"not a box, or not alone in its place: {', '.join(traced)}")
    return Choice("acceleration structure", "not traced", "every shape is the box of a medium: slab tests in float64")


def _channels(needs: Needs) -> Choice:
    rgb = [m.name for m in needs.media if m.extinction == "rgb"]
    if rgb:
        return Choice("channels", "3", f"rgb extinction in {', '.join(rgb)}")
    return Choice("channels", "1", "every extinction is grey")


def _skipping(medium, skip: bool) -> Choice:
    share = f"{medium.occupied:.0%} of its blocks hold anything"
    return Choice(f"empty space in {medium.name}", "skipped" if skip else "walked", share)


def _shadows(medium: MediumFacts, needs: Needs, settings: Settings) -> Choice | None:
    """Whether shadow rays walk every cell of a medium or look here and there; None where the question does not arise."""
    if not medium.resolutions or not _is_lit(needs, settings) or settings.deterministic:
        return None
    about, cells = f"shadows of {medium.name}", medium.occupied * max(sum(r) for r in medium.resolutions)
    if medium.unread:
        return Choice(about, "exact", "values cannot be read while dr.freeze records")
    if settings.shadows != "auto":
        return Choice(about, settings.shadows, "it was asked for")
    size = f"{cells:.0f} occupied cells along the three axes"
    if cells < FINE:
        return Choice(about, "exact", f"{size}: they are soon walked")
    if set(needs.lamps) == {"sharp"}:
        return Choice(about, "exact", "no lamp is wide: where all light is faint, estimates are coarse")
    return Choice(about, "estimated", f"{size}: unbiased look-ups cost less; gradients walk every cell")


def _events(needs: Needs, settings: Settings) -> tuple[int, list[Choice]]:
    """How many points of a camera ray scatter."""
    if not _is_lit(needs, settings) or settings.deterministic:
        return 1, []
    about = "points that scatter"
    if len(needs.media) != 1 or len(needs.media[0].resolutions) != 1:
        return 1, [Choice(about, "1 of a camera ray", "there is more than one grid or none")]
    share = needs.media[0].occupied
    count = EVENTS[share >= FILLED, set(needs.lamps) == {"sharp"}]
    return count, [Choice(about, f"{count} of a camera ray", f"one walk for them all; {share:.0%} of the blocks hold anything")]


def _gradient(needs: Needs) -> tuple[int, Choice]:
    memory, ways = 0, set()
    for medium in needs.media:
        channels = 3 if medium.extinction == "rgb" else 1
        for z, y, x in medium.resolutions:
            packed = gradient_bytes((z, y, x), channels)
            fits = needs.variant.startswith("llvm") and packed <= PACKED_LIMIT
            memory += (packed if fits else 0) + 8 * z * y * x * channels
            ways.add("packed corners, one copy a thread" if fits else "added to the nodes")
    free = available_memory()
    if needs.parameters and needs.variant.startswith("llvm") and free is not None and memory > free:
        raise MivolError(
            f"a gradient step would take {memory / 2**30:.1f} GiB and {free / 2**30:.1f} GiB are free; lower the resolution "
            "of the grids."
        )
    asked = ", ".join(needs.parameters) or "none asked for yet"
    what = f"{memory / 2**20:.1f} MiB beyond the rays ({'; '.join(sorted(ways)) or 'no grid'})"
    return memory, Choice("gradient step", what, f"parameters: {asked}")


def build_world(scene: mi.Scene, needs: Needs, plan: Plan, settings: Settings, survey: Survey) -> World:
    """Build the media that transport walks through, as planned."""
    bodies = []
    for boundary, view, skip, tracks in zip(needs.boundaries, needs.views, plan.skips, plan.tracks, strict=True):
        for part in view.parts:
            if skip and part.lattice is not None:
                part.lattice.empty_distances = read_empty_distances(part, survey, boundary.name)
            # A grey variant sees the mean of an rgb extinction, and its transmittance is no mean.
            mixes = mi.is_monochromatic and part.channels > 1
            if tracks and part.lattice is not None and part.activation is None and not mixes:
                part.lattice.block_ranges = read_block_ranges(part, survey)
        bodies.append(Body(view, boundary.box))
    return World(
        bodies,
        has_surfaces=bool(needs.surfaces),
        scatters=bool(needs.surfaces) and settings.max_depth not in (0, 1),
        has_null_transmission=needs.has_null_transmission,
        start=needs.start,
        locates_camera=needs.camera_inside and needs.start is None,
        emitters=SceneEmitters(scene) if needs.lamps and _is_lit(needs, settings) else None,
        is_deterministic=settings.deterministic,
        events=plan.events,
        size=survey.size,
    )


def settings_of(scene: mi.Scene) -> Settings:
    """What the scene's own integrator is set to: all of it where it is mivol, the depth of others, which they print."""
    integrator = scene.integrator()
    session = getattr(integrator, "session", None)
    if session is not None:
        return session.settings
    told = re.search(r"max_depth ?= ?(-?\d+)", str(integrator))
    depth = Settings().max_depth if told is None else int(told.group(1))
    return Settings(max_depth=-1 if depth == UNLIMITED else depth)


def explain(scene: mi.Scene | str | Path, max_depth: int | None = None, sensor: int = 0) -> str:
    """Say what a scene needs and what will be done about it, before anything is rendered.

    Args:
        scene: a loaded scene, or the path of its XML.
        max_depth: of the integrator asked about; None: that of the scene's own integrator, with its other settings.
        sensor: index of the sensor asked about.

    Raises:
        MivolError: as :func:`make_plan`.
    """
    loaded = scene if isinstance(scene, mi.Scene) else mi.load_file(str(scene))
    needs = find_needs(loaded, find_sensor(loaded, sensor), survey_scene(loaded))
    settings = settings_of(loaded) if max_depth is None else Settings(max_depth=max_depth)
    plan = make_plan(needs, settings)
    lines = ["facts"]
    for m in needs.media:
        grids = ", ".join("x".join(map(str, r)) for r in m.resolutions) or "homogeneous"
        scatters = "scatters" if m.is_scattering else "albedo 0"
        tau = "" if m.tau_max is None else f", optical depth at most {m.tau_max:.3g}"
        lines.append(
            f"  medium    {m.name}: {m.kind} in {m.boundary}, {m.extinction} extinction, {grids}, {scatters}, {m.phase}{tau}"
        )
    lines += [
        f"  surfaces  {', '.join(needs.surfaces) or 'none'}",
        f"  emitters  {', '.join(needs.emitters) or 'none'}",
        f"  camera    {'may be inside a medium' if needs.start or needs.camera_inside else 'in no traced boundary'}",
        f"  variant   {needs.variant}, {dr.thread_count()} threads",
        "plan",
    ]
    width = max(len(c.about) for c in plan.choices)
    lines += [f"  {c.about:<{width}}  {c.choice}\n  {'':<{width}}    because {c.reason}" for c in plan.choices]
    lines += [f"  table     {text}" for text in _tables(needs)]
    if settings.max_depth == 2:
        lines += [f"  model     {text}" for text in _depth_two(loaded, needs)]
        lines += [f"  shadows   {text}" for text in _light_grid(loaded, needs, plan, settings)]
    return "\n".join(lines)


def _light_grid(scene: mi.Scene, needs: Needs, plan: Plan, settings: Settings) -> list[str]:
    """What a light grid in place of shadow rays costs, and how wrong it is."""
    if not _is_lit(needs, settings) or set(needs.lamps) != {"sharp"} or len(needs.media) != 1:
        return []
    if not _share_cells(needs) or any(part.lattice is None for part in needs.views[0].parts):
        return []
    with dr.suspend_grad():
        world = build_world(scene, needs, plan, settings, survey_scene(scene))
        grid = build_transmittance_grid(scene, world)
        bias, rms = measure_transmittance_bias(scene, world, grid)
    nodes = grid.nodes[0] * grid.nodes[1] * grid.nodes[2]
    rays = needs.film_samples * sum(needs.media[0].resolutions[0])
    pays = "pays" if nodes < rays else "does not pay"
    offer = "asked for" if settings.shadows == "grid" else "exact; with deterministic"
    return [
        f"{offer}, a light grid of {nodes} nodes {pays} against about {rays} shadow rays, at a bias of "
        f"{bias:+.2g} of a lamp's light (rms {rms:.2g}, measured against exact shadows)"
    ]


def _tables(needs: Needs) -> list[str]:
    """What grids that were seen through a table miss of it between their nodes."""
    lines = []
    for facts, boundary in zip(needs.media, needs.boundaries, strict=True):
        volumes = {key.split(".")[0]: entry[2] for key, entry in traverse_medium(boundary.medium).properties.items()}
        for name, volume in volumes.items():
            if not hasattr(volume, "mivol_transfer"):
                continue
            table = volume.mivol_transfer
            missed, finer = table.departure(), table.refine + 2
            advice = f"; refine = {finer} would follow it closer, at {(finer / table.refine) ** 3:.3g} times the memory"
            lines.append(
                f"{name} of {facts.name} departs from its table by {missed:.2g} of the largest entry half-way between nodes "
                f"(rms){advice if missed > 0.02 else ''}"
            )
    return lines


def _depth_two(scene: mi.Scene, needs: Needs) -> list[str]:
    """What a model of one scattering leaves out of each medium."""
    lines = []
    light = "collimated" if "sharp" in needs.lamps else "constant"
    for facts, boundary, view in zip(needs.media, needs.boundaries, needs.views, strict=True):
        box, traced = (boundary.box, None) if boundary.box is not None else (_box_around(scene, boundary.medium), scene)
        if not facts.is_scattering or box is None:
            continue
        tau, albedo = scattering_depth(view, box, scene=traced), mean_albedo(view)
        phase = "forward" if mean_cosine(boundary.medium.phase_function()) > 0.4 else "isotropic"
        missing = depth_two_error(min(albedo, 1.0), tau, light, phase)
        warning = "; depth 2 is a poor model of it" if missing > 0.1 else ""
        lines.append(
            f"one scattering leaves out {missing:.0%} of the light that {facts.name} scatters (albedo {albedo:.2f}, optical "
            f"depth {tau:.2g}, {light} light, {phase} phase){warning}"
        )
    return lines


def _box_around(scene: mi.Scene, medium: mi.Medium) -> Box | None:
    """A box around all that a medium fills; None where it lies outside of shapes, without an end."""
    inside = [s.interior_medium() for s in scene.shapes()]
    boxes = [bounds(s) for s, m in zip(scene.shapes(), inside, strict=True) if m is not None and m.ptr == medium.ptr]
    if not boxes:
        return None
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    # Lines begin outside of what they are to enter.
    room, place = 1e-3 * (high - low).max(), np.eye(4)
    place[:3, :3], place[:3, 3] = np.diag(high - low + 2 * room), low - room
    return Box(place)
