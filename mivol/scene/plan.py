"""What is done about a scene's needs: choices, each with its reason, before anything is rendered.

Conventions. A plan is made of :class:`Choice` only; ``explain`` prints it. What cannot be rendered is refused here, with a
sentence, before a kernel runs.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mivol.errors import MivolError
from mivol.machine import available_memory
from mivol.scene.needs import MediumFacts, Needs
from mivol.transport.line_integrals.aovs import AOVS
from mivol.transport.media.body import flight_parts
from mivol.transport.media.grid_integral import PACKED_LIMIT, gradient_bytes
from mivol.transport.media.medium_view import MediumView
from mivol.transport.media.summed_extinction import share_cells
from mivol.transport.path.settings import Settings

__all__ = ["Choice", "Plan", "check_aovs", "is_lit", "make_plan", "shares_cells"]

SKIP_BELOW = 0.45
"""Share of occupied blocks below which skipping pays (it costs 8 reads a cell in place of 4; measured, as fast as
without: smoke of 48 % 0.9 times, CT of 43 % 1.05 to 1.1 times, smoke of 256^3, 43 %, 1.3 to 1.4 times)."""

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
    ``segment`` names the estimator of what media add along a segment, in
    :data:`mivol.transport.path.estimators.SEGMENT_ESTIMATORS`; ``events`` how many points of a camera ray scatter in
    pictures; ``pass_rays`` how many rays a pass may hold; ``gradient_bytes`` what a gradient step takes beyond the rays.
    """

    choices: tuple[Choice, ...]
    skips: tuple[bool, ...]
    tracks: tuple[bool, ...]
    segment: str
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
    return Plan(tuple(choices), skips, tracks, _segment(needs, settings), events, pass_rays, memory)


def _segment(needs: Needs, settings: Settings) -> str:
    """Name of the estimator of what media add along a segment."""
    if any(m.emits for m in needs.media):
        return "emission"
    if not needs.lamps or not is_lit(needs, settings):
        return "absorption"
    return "scattering_quadrature" if settings.deterministic else "single_scattering"


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
    if glowing and is_lit(needs, settings):
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
    if not settings.deterministic or not is_lit(needs, settings):
        return
    other = [kind for kind, lamp in zip(needs.emitters, needs.lamps, strict=True) if lamp != "sharp"]
    if other:
        raise MivolError(
            f"deterministic is set and the scene has a {other[0]}; quadrature is for lamps of one position or direction "
            "(point, spot, directional): leave deterministic out."
        )
    if len(needs.media) > 1 or not shares_cells(needs):
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


def shares_cells(needs: Needs) -> bool:
    """Whether one walk passes all of the first medium."""
    parts = needs.views[0].parts
    return len(flight_parts(parts)) == len(parts)


def _pass_rays(needs: Needs) -> int:
    """How many rays a pass may hold: fewer where each has many cells to cross."""
    backend = needs.variant.split("_")[0]
    cells = sum(sum(res) for medium in needs.media for res in medium.resolutions)
    return min(PASS_RAYS[backend], PASS_STEPS[backend] // max(cells, 1))


def is_lit(needs: Needs, settings: Settings) -> bool:
    """Whether media scatter light to the camera."""
    return settings.max_depth == 2 and any(m.is_scattering for m in needs.media)


def _transport(needs: Needs, settings: Settings) -> Choice:
    if not needs.media:
        return Choice("media", "none", "no shape bounds a medium")
    if is_lit(needs, settings):
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
    if not is_lit(needs, settings):
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
    if not medium.resolutions or not is_lit(needs, settings) or settings.deterministic:
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
    if not is_lit(needs, settings) or settings.deterministic:
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
